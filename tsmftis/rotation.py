"""Rotations: Euler angles, direction cosine matrices (DCM), quaternions, rotation vectors.

Functions
---------
rpy_to_dcm, dcm_to_rpy      C_body→NED = Rz(yaw)·Ry(pitch)·Rx(roll) and back
exp_so3                     rotation vector → DCM
log_so3                     DCM → rotation vector
dcm_to_quaternion, quaternion_to_dcm
rpy_jacobian                errors of roll, pitch, yaw from a rotation error in NED
Attitude                    an attitude history, interpolated smoothly in time

References
----------
.. [1] P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., ch. 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def rpy_to_dcm(roll: Array | float, pitch: Array | float, yaw: Array | float) -> Array:
    """C = Rz(yaw)·Ry(pitch)·Rx(roll); angles (...) [rad] → (..., 3, 3)."""
    roll, pitch, yaw = np.broadcast_arrays(np.asarray(roll, float), np.asarray(pitch, float), np.asarray(yaw, float))
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rows = (
        (cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy),
        (cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy),
        (-sp, sr * cp, cr * cp),
    )
    return np.stack([np.stack(r, -1) for r in rows], -2)


def dcm_to_rpy(dcm: Array) -> tuple[Array, Array, Array]:
    """Roll, pitch, yaw [rad] of C_body→NED (..., 3, 3); the inverse of `rpy_to_dcm` for |pitch| < 90°."""
    roll = np.arctan2(dcm[..., 2, 1], dcm[..., 2, 2])
    pitch = -np.arcsin(np.clip(dcm[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(dcm[..., 1, 0], dcm[..., 0, 0])
    return roll, pitch, yaw


def exp_so3(vector: Array) -> Array:
    """Rotation vector (..., 3) [rad] → DCM (..., 3, 3)."""
    v = np.asarray(vector, float)
    return Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix().reshape(*v.shape[:-1], 3, 3)


def log_so3(dcm: Array) -> Array:
    """DCM (..., 3, 3) → rotation vector (..., 3) [rad]."""
    m = np.asarray(dcm, float)
    return Rotation.from_matrix(m.reshape(-1, 3, 3)).as_rotvec().reshape(*m.shape[:-2], 3)


def dcm_to_quaternion(dcm: Array) -> Array:
    """DCM (..., 3, 3) → unit quaternion (..., 4) as (w, x, y, z)."""
    m = np.asarray(dcm, float)
    return Rotation.from_matrix(m.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(*m.shape[:-2], 4)


def quaternion_to_dcm(quaternion: Array) -> Array:
    """Unit quaternion (..., 4) as (w, x, y, z) → DCM (..., 3, 3)."""
    q = np.asarray(quaternion, float)
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*q.shape[:-1], 3, 3)


def rpy_jacobian(rpy: Array) -> Array:
    """∂(roll, pitch, yaw)/∂φ for C_true = exp(φ×)·C, φ in NED; (n, 3) → (n, 3, 3).

    δroll = (cos y·φ_N + sin y·φ_E)/cos p, δpitch = −sin y·φ_N + cos y·φ_E, δyaw = φ_D + tan p·(cos y·φ_N + sin y·φ_E).
    """
    _, p, y = rpy.T
    zero, one = np.zeros_like(p), np.ones_like(p)
    return np.stack(
        [
            np.stack([np.cos(y) / np.cos(p), np.sin(y) / np.cos(p), zero], -1),
            np.stack([-np.sin(y), np.cos(y), zero], -1),
            np.stack([np.tan(p) * np.cos(y), np.tan(p) * np.sin(y), one], -1),
        ],
        -2,
    )


@dataclass(frozen=True)
class Attitude:
    """A smooth attitude history, C³ between its samples.

    The rotation vectors relative to the middle sample are splined, so the history may turn by less than 180° away
    from its middle (a flight line does). Interpolating at 200 Hz linearly would leave (dt²/8)·angular acceleration,
    3 µrad at 1 rad/s²: a hundredth of a pixel; the spline leaves none of it.
    """

    reference: Array
    spline: CubicSpline

    @classmethod
    def fit(cls, time: Array, dcm: Array) -> Attitude:
        """From samples: time (n,) [s], dcm (n, 3, 3) body→fixed frame, n ≥ 4.

        Raises ValueError where the history turns by 170° or more from its middle sample.
        """
        reference = dcm[len(dcm) // 2]
        vectors = log_so3(np.swapaxes(reference, -1, -2) @ dcm)
        if np.linalg.norm(vectors, axis=-1).max() > np.deg2rad(170.0):
            raise ValueError("the attitude turns by more than 170° within the line")
        return cls(reference, CubicSpline(time, vectors, axis=0))

    def __call__(self, time: Array) -> Array:
        """DCM (..., 3, 3) at times (...)."""
        return self.reference @ exp_so3(self.spline(time))
