"""Initial position, velocity and attitude, with sigmas.

Functions
---------
starting_at     a known attitude, position and velocity from the nearest fix
heading_at_rest what a heading can be known to without motion
align           self-alignment: at rest by gyrocompassing (levelling by gravity, heading by the Earth's rotation), in motion
                (levelling by GNSS acceleration, heading by GNSS course), or from rest (levelling at standstill, heading by the
                course once the vehicle moves, carried back by the gyros)

References
----------
.. [1] P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., ch. 5.5–5.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Gnss, Imu
from stages.navigation.mechanisation import turn
from stages.navigation.standstill import Standstill
from stages.navigation.velocity import gnss_velocity, moves
from tsmftis.geodesy import EARTH_RATE, local_metres, normal_gravity, radii_of_curvature
from tsmftis.inertial import SensorModel
from tsmftis.rotation import dcm_to_quaternion, dcm_to_rpy, quaternion_to_dcm, rpy_to_dcm

Array = NDArray[np.float64]

NEIGHBOURS = 11  # fixes that a start is told by
COMPASS_WINDOWS = 20  # s: least standstill for a gyrocompass
COMPASS_LONGEST = 300.0  # s: beyond it, biases wander


@dataclass(frozen=True)
class Start:
    """The state at `time` [s]: lat, lon [rad], height [m]; velocity NED [m/s]; rpy [rad]; sigmas (3,) each (position in m)."""

    time: float
    position: Array
    velocity: Array
    rpy: Array
    sigma_position: Array
    sigma_velocity: Array
    sigma_rpy: Array
    method: str


def starting_at(time: float, rpy: Array, sigma_rpy: Array, gnss: Gnss, lever: Array, method: str) -> Start:
    """Position and velocity of the IMU at `time` from the nearest fix, with sigmas that grow with the time to it.

    An aircraft accelerates by up to some 5 m/s²: σ_v² = σ_fix² + (5·Δt)², σ_r² = σ_fix² + (2.5·Δt²)², at least 0.1 m and
    0.1 m/s because the lever arm stands on the initial attitude.
    """
    velocity, sigma_velocity = gnss_velocity(gnss)
    i = int(np.argmin(np.where(_wild(gnss, time), np.inf, np.abs(gnss.time - time))))
    dt = time - gnss.time[i]
    north, east = radii_of_curvature(gnss.latitude[i])
    offset = velocity[i] * dt - rpy_to_dcm(*rpy) @ lever
    position = np.array(
        [
            gnss.latitude[i] + offset[0] / (north + gnss.height[i]),
            gnss.longitude[i] + offset[1] / ((east + gnss.height[i]) * np.cos(gnss.latitude[i])),
            gnss.height[i] - offset[2],
        ]
    )
    sigma_position = np.sqrt(gnss.sigma_position[i] ** 2 + (2.5 * dt * dt) ** 2 + 0.1**2)
    sigma = np.sqrt(sigma_velocity[i] ** 2 + (5.0 * dt) ** 2 + 0.1**2)
    return Start(time, position, velocity[i], rpy, sigma_position, sigma, sigma_rpy, method)


def _wild(gnss: Gnss, time: float) -> NDArray[np.bool_]:
    """Which of the eleven fixes nearest to `time` disagree with the rest of them (n,), so that none of them starts a flight.

    Position and velocity are held against the median of the others' positions carried to the fix by the median velocity, within
    10 m (m/s) and ten sigmas; none is wild where none agrees.
    """
    near = np.argsort(np.abs(gnss.time - time))[:NEIGHBOURS]
    velocity, sigma_velocity = gnss_velocity(gnss)
    at = local_metres(
        gnss.latitude[near],
        gnss.longitude[near],
        gnss.height[near],
        *(float(np.median(v[near])) for v in (gnss.latitude, gnss.longitude, gnss.height)),
    )
    v, elapsed = velocity[near], gnss.time[near] - time
    typical = np.median(v, axis=0)
    carried = at - typical * elapsed[:, None]
    off = np.abs(carried - np.median(carried, axis=0))
    # A vehicle may change its velocity meanwhile, by some 5 m/s².
    slack = 2.5 * elapsed[:, None] ** 2
    fits = (off <= 10.0 + 10.0 * gnss.sigma_position[near] + slack).all(axis=1)
    fits &= (np.abs(v - typical) <= 10.0 + 10.0 * sigma_velocity[near] + 5.0 * np.abs(elapsed[:, None])).all(axis=1)
    out = np.zeros(gnss.time.size, np.bool_)
    out[near] = ~fits & fits.any()
    return out


def level(force_body: Array, force_ned: Array, yaw: float) -> tuple[float, float]:
    """Roll and pitch that turn a body specific force into a known NED one for a given yaw.

    With f_h = Rz(−yaw)·f_ned: cos r·f_y − sin r·f_z = f_h,y gives roll, then Ry(pitch)·Rx(roll)·f = f_h gives pitch.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    target = np.array([c * force_ned[0] + s * force_ned[1], -s * force_ned[0] + c * force_ned[1], force_ned[2]])
    size = np.hypot(force_body[1], force_body[2])
    # |f| differs by the accelerometer's errors: the sine is clipped rather than refused.
    roll = np.arctan2(-force_body[1], -force_body[2]) + np.arcsin(np.clip(target[1] / size, -1.0, 1.0))
    z = np.sin(roll) * force_body[1] + np.cos(roll) * force_body[2]
    pitch = np.arctan2(target[0], target[2]) - np.arctan2(force_body[0], z)
    return float(roll), float((pitch + np.pi) % (2 * np.pi) - np.pi)


def align(
    imu: Imu, gnss: Gnss, lever: Array, gyro: SensorModel, still: Standstill, course_speed: float, offset: float = 0.0
) -> Start:
    """Self-alignment: from rest by gyrocompassing where the gyros are good enough for it; else in motion where the first fixes
    move faster than `course_speed` [m/s], or from rest by the later course.

    The heading is the GNSS course turned by `offset` [rad] (no crab angle: sigma 10° in motion, 20° from rest); the flight's
    own accelerations refine it, and the filter is run again from the smoothed start. Raises InputError where the unit never
    moves fast enough for a course and is too coarse for a gyrocompass.
    """
    velocity, _ = gnss_velocity(gnss)
    start = max(float(imu.time[0]), float(gnss.time[0]) - 1.0)
    inside = (gnss.time >= start) & (gnss.time <= imu.time[-1])
    moving = np.flatnonzero(inside & moves(gnss, course_speed))
    if moving.size:
        moving = moving[~_wild(gnss, float(gnss.time[moving[0]]))[moving]]
    compass = _gyrocompass(imu, gnss, still, lever, gyro, float(gnss.time[moving[0]]) if moving.size else np.inf)
    if compass is not None:
        return compass
    if moving.size == 0:
        raise InputError(
            "gnss",
            "velocity",
            f"never exceeds {course_speed:g} m/s and five of its own sigmas, so no heading can be taken from the course",
            "give flights[].initial in campaign.yaml, or lower navigation.course_speed_m_per_s",
        )
    if gnss.time[moving[0]] - start < 2.0:
        return _in_motion(imu, gnss, velocity, int(moving[0]), lever, offset)
    return _from_rest(imu, gnss, velocity, moving, start, lever, offset)


def _gyrocompass(
    imu: Imu, gnss: Gnss, still: Standstill, lever: Array, gyro: SensorModel, moves: float
) -> Start | None:
    """Levelling by gravity and heading by the Earth's rotation over the first unbroken standstill, before `moves` [s].

    With the rate levelled, (ω_x, ω_y) = Ω·cos L·(cos yaw, −sin yaw). σ_yaw = √(σ_b² + N²/T)/(Ω·cos L), doubled for what it leaves
    out; None where that exceeds 5°: consumer and tactical gyros.
    """
    if still.start.size < COMPASS_WINDOWS:
        return None
    breaks = np.flatnonzero(np.diff(still.start) > 1.5 * (still.stop[0] - still.start[0]))
    last = int(breaks[0]) if breaks.size else still.start.size - 1
    first = still.start[0]
    stop = min(float(still.stop[last]), moves, float(first) + COMPASS_LONGEST)
    if stop - first < COMPASS_WINDOWS:
        return None
    latitude = float(gnss.latitude[np.argmin(np.abs(gnss.time - first))])
    across = EARTH_RATE * np.cos(latitude)
    sigma_yaw = float(np.sqrt(gyro.bias_sigma**2 + gyro.white_noise**2 / (stop - first)) / across)
    if 2.0 * sigma_yaw > np.deg2rad(5.0):
        return None
    force, rate = (_mean_over(imu, values, first, stop) for values in (imu.accel, imu.gyro))
    roll, pitch = level(force, np.array([0.0, 0.0, -np.linalg.norm(force)]), 0.0)
    if abs(np.linalg.norm(rate) - EARTH_RATE) > 5.0 * sigma_yaw * across:
        return None  # it turned, or the gyros are worse than declared
    north, east, _ = rpy_to_dcm(roll, pitch, 0.0) @ rate
    rpy = np.array([roll, pitch, np.arctan2(-east, north)])
    sigma = np.array([np.deg2rad(0.5), np.deg2rad(0.5), 2.0 * sigma_yaw])
    return starting_at(float(first), rpy, sigma, gnss, lever, "from rest: levelling and gyrocompassing")


def heading_at_rest(gnss: Gnss, gyro: SensorModel, course_speed: float) -> float:
    """What the Earth's rotation alone tells of a heading, σ [rad], where the receiver never moves; 0 where it does.

    A filter at rest takes changes of its own linearisation for news of the heading, so its sigma must not fall below this.
    """
    if moves(gnss, course_speed).any():
        return 0.0
    across = EARTH_RATE * np.cos(float(np.median(gnss.latitude)))
    span = max(float(np.ptp(gnss.time)), 1.0)
    return float(np.sqrt(gyro.bias_sigma**2 + gyro.white_noise**2 / span) / across)


def _mean_over(imu: Imu, values: Array, start: float, stop: float) -> Array:
    inside = (imu.time > start) & (imu.time <= stop)
    if not inside.any():
        raise InputError(
            "imu",
            "variable 'time'",
            f"has no sample between {start:.1f} and {stop:.1f} s, where the alignment needs them",
            "give flights[].initial in campaign.yaml",
        )
    return np.asarray(values[inside].mean(axis=0))


def _in_motion(imu: Imu, gnss: Gnss, velocity: Array, first: int, lever: Array, offset: float) -> Start:
    time = float(max(gnss.time[first], imu.time[0]))
    yaw = float(np.arctan2(velocity[first, 1], velocity[first, 0])) + offset
    last = min(int(np.searchsorted(gnss.time, time + 1.0)), gnss.time.size - 1)
    acceleration = (velocity[last] - velocity[first]) / max(gnss.time[last] - gnss.time[first], 1e-3)
    gravity = float(normal_gravity(gnss.latitude[first], gnss.height[first]))
    force = acceleration - np.array([0.0, 0.0, gravity])
    roll, pitch = level(_mean_over(imu, imu.accel, time, time + 1.0), force, yaw)
    method = "in motion: GNSS course and acceleration"
    return starting_at(time, np.array([roll, pitch, yaw]), np.deg2rad([3.0, 3.0, 10.0]), gnss, lever, method)


def _from_rest(
    imu: Imu, gnss: Gnss, velocity: Array, moving: NDArray[np.int64], start: float, lever: Array, offset: float
) -> Start:
    rest = min(5.0, gnss.time[moving[0]] - start - 1.0)
    force = _mean_over(imu, imu.accel, start, start + rest)
    roll, pitch = level(force, np.array([0.0, 0.0, -np.linalg.norm(force)]), 0.0)
    drift = _mean_over(imu, imu.gyro, start, start + rest)
    # Turn of the body from the start to each of the first moving fixes, by the gyros alone.
    fixes = moving[:10]
    span = (imu.time > start) & (imu.time <= gnss.time[fixes[-1]])
    steps = np.diff(imu.time, prepend=imu.time[0])[span, None]
    turned = turn(dcm_to_quaternion(rpy_to_dcm(roll, pitch, 0.0)), (imu.gyro[span] - drift) * steps)
    at = np.searchsorted(imu.time[span], gnss.time[fixes], side="right") - 1
    _, _, heading = dcm_to_rpy(quaternion_to_dcm(turned[at]))
    course = np.arctan2(velocity[fixes, 1], velocity[fixes, 0])
    yaw = float(np.angle(np.mean(np.exp(1j * (course - heading))))) + offset
    method = "from rest: levelling, then GNSS course"
    return starting_at(start, np.array([roll, pitch, yaw]), np.deg2rad([2.0, 2.0, 20.0]), gnss, lever, method)
