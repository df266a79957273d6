"""Records as they would be with an error in them.

Functions
---------
displaced       a trajectory with errors of position and attitude
random_walk     the attitude error that the gyros' white noise lets grow
turned          a mounting with another boresight
later           a camera with another latency
raised          targets at other heights
as_targets      ground control points as targets, for tracking to project
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gcps, Targets, Trajectory
from tsmftis.camera import Camera, Mounting
from tsmftis.geodesy import radii_of_curvature

Array = NDArray[np.float64]


def displaced(trajectory: Trajectory, ned: Array, rpy: Array) -> Trajectory:
    """δL = N/(R_N + h), δλ = E/((R_E + h)·cos L), δh = −D; roll, pitch, yaw + rpy.

    ned (3,) or (n, 3) [m], rpy likewise [rad], added to the trajectory's n samples.
    """
    north, east, down = np.moveaxis(np.asarray(ned, float), -1, 0)
    meridian, prime_vertical = radii_of_curvature(trajectory.latitude)
    return replace(
        trajectory,
        latitude=trajectory.latitude + north / (meridian + trajectory.height),
        longitude=trajectory.longitude + east / ((prime_vertical + trajectory.height) * np.cos(trajectory.latitude)),
        height=trajectory.height - down,
        rpy=trajectory.rpy + rpy,
    )


def random_walk(time: Array, density: float, rng: np.random.Generator) -> Array:
    """θ(t) = ∫ w dt with ⟨w(t)·w(t′)⟩ = density²·δ(t − t′), less its mean over `time`; three axes (n, 3) [rad].

    time (n,) [s]; density: angle random walk [rad/√s]. The mean is the constant error's, which the trajectory's own sigmas hold.
    """
    step = np.diff(time, prepend=time[0])
    walk = np.cumsum(density * np.sqrt(step)[:, None] * rng.standard_normal((time.size, 3)), axis=0)
    return np.asarray(walk - walk.mean(axis=0), float)


def turned(mounting: Mounting, rpy: Array) -> Mounting:
    """Boresight roll, pitch, yaw + rpy (3,) [rad]."""
    return replace(mounting, boresight=mounting.boresight + np.asarray(rpy, float))


def later(camera: Camera, seconds: float) -> Camera:
    """Latency + seconds: the poses are then taken so much earlier."""
    return replace(camera, latency=camera.latency + seconds)


def raised(targets: Targets, metres: float) -> Targets:
    """Surveyed heights + metres."""
    return replace(targets, height=targets.height + metres)


def as_targets(gcps: Gcps) -> Targets:
    """Each control point (n,) as a target without extent or reference."""
    n = gcps.frame.size
    return Targets(
        tuple(f"GCP {i + 1}" for i in range(n)),
        gcps.latitude,
        gcps.longitude,
        gcps.height,
        ("",) * n,
        np.zeros(n),
    )
