"""The camera: pin-hole projection with one radial term, and how it sits in the body.

Functions
---------
Camera.project          camera frame → row, column
Camera.directions       row, column → unit directions in the camera frame (the inverse)
Mounting                IMU→body rotation, lever arms, boresight
camera_pose             projection centre and C_camera→ECEF from a body pose

The camera's x points forward, y right, z along the optical axis (down). With x = X/Z, y = Y/Z and
s = 1 + k1·(x² + y²): row = row0 + s·y·f/p, col = col0 − s·x·f/p; pixel centres lie at integers.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm
from tsmftis.rotation import rpy_to_dcm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Named parameters of the camera; lengths in metres, principal point in pixels, latency in seconds."""

    rows: int
    cols: int
    pixel_pitch: float
    focal_length: float
    principal_row: float
    principal_col: float
    frame_rate: float
    saturation: float
    radial_k1: float = 0.0
    latency: float = 0.0

    def project(self, point: Array) -> tuple[Array, Array]:
        """Row and column [px] of points (..., 3) in the camera frame; NaN behind the camera."""
        x, y, z = np.moveaxis(np.asarray(point, float), -1, 0)
        depth = np.where(z > 0, z, np.nan)
        x, y = x / depth, y / depth
        scale = (1.0 + self.radial_k1 * (x * x + y * y)) * self.focal_length / self.pixel_pitch
        return self.principal_row + scale * y, self.principal_col - scale * x

    def directions(self, row: Array, col: Array) -> Array:
        """Unit directions (..., 3) that `project` takes to row, col; Newton on the radius, exact to 1e-12."""
        u = (self.principal_col - np.asarray(col, float)) * self.pixel_pitch / self.focal_length
        v = (np.asarray(row, float) - self.principal_row) * self.pixel_pitch / self.focal_length
        distorted = np.hypot(u, v)
        radius = distorted.copy()
        for _ in range(12):
            radius -= (radius + self.radial_k1 * radius**3 - distorted) / (1.0 + 3.0 * self.radial_k1 * radius**2)
        scale = np.divide(radius, distorted, out=np.ones_like(radius), where=distorted > 0)
        ray = np.stack([u * scale, v * scale, np.ones_like(u)], -1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def central_frame(self, row: Array, col: Array) -> NDArray[np.int64]:
        """For tracks (target, frame), the frame (target,) in which each is nearest to mid-detector."""
        away = np.hypot(row - (self.rows - 1) / 2, col - (self.cols - 1) / 2)
        return np.argmin(np.where(np.isfinite(away), away, np.inf), axis=1)

    def ground_sample(self, distance: float) -> float:
        """Nominal ground sample p·distance/f [m]."""
        return self.pixel_pitch * distance / self.focal_length


@dataclass(frozen=True)
class Mounting:
    """How IMU, antenna and camera sit in the body (FRD): angles [rad], lever arms from the IMU [m]."""

    imu_to_antenna: Array
    imu_to_camera: Array = field(default_factory=lambda: np.zeros(3))
    boresight: Array = field(default_factory=lambda: np.zeros(3))
    imu_to_body: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def dcm_imu_to_body(self) -> Array:
        return rpy_to_dcm(*self.imu_to_body)

    @property
    def dcm_camera_to_body(self) -> Array:
        return rpy_to_dcm(*self.boresight)


def camera_pose(
    latitude: Array, longitude: Array, height: Array, body_to_ned: Array, mounting: Mounting
) -> tuple[Array, Array]:
    """Projection centre (..., 3) [m] in ECEF and C_camera→ECEF (..., 3, 3) from the IMU's pose."""
    body_to_ecef = ned_to_ecef_dcm(latitude, longitude) @ body_to_ned
    centre = geodetic_to_ecef(latitude, longitude, height) + body_to_ecef @ mounting.imu_to_camera
    return centre, body_to_ecef @ mounting.dcm_camera_to_body
