"""The camera: pin-hole projection with one radial term, and how it sits in the body.

Functions
---------
Camera.project          camera frame → row, column
Camera.directions       row, column → unit directions in the camera frame (the inverse)
Mounting                IMU→body rotation, lever arms, boresight, and how far it gives way
camera_pose             projection centre and C_camera→ECEF from a body pose
angular_acceleration    what a mount bends under, from the rates of the unit
Camera.with_effects, Mounting.with_effects      what a model update adds

The camera's x points forward, y right, z along the optical axis (down). With x = X/Z, y = Y/Z and
s = 1 + k1·(x² + y²): row = row0 + s·y·f/p, col = col0 − s·x·f/p; pixel centres lie at integers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.signal import butter, sosfiltfilt

from tsmftis.effects import Effects, amounts
from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm
from tsmftis.rotation import exp_so3, rpy_to_dcm

Array = NDArray[np.float64]

FLEXURE_CUTOFF = 12.0  # Hz, above which a mount does not follow
DRIFT_REFERENCE = 25.0  # degC, of the accelerometers, at which the boresight is the declared one


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

    def with_effects(self, effects: Effects) -> Camera:
        """latency + camera_latency, f·(1 + focal_length), k1 + radial_distortion."""
        (late,), (scale,), (k1,) = (
            amounts(effects, name) for name in ("camera_latency", "focal_length", "radial_distortion")
        )
        return replace(
            self,
            latency=self.latency + late,
            focal_length=self.focal_length * (1.0 + scale),
            radial_k1=self.radial_k1 + k1,
        )


@dataclass(frozen=True)
class Mounting:
    """How IMU, antenna and camera sit in the body (FRD): angles [rad], lever arms from the IMU [m].

    C_camera→body = Exp(flexure_roll·α_x, flexure_pitch·α_y, 0)·Exp(drift·(T − 25 °C))·C_boresight; no declared mount bends or
    drifts. drift (3,) [rad/K], flexure (2,) [rad per rad/s²].
    """

    imu_to_antenna: Array
    imu_to_camera: Array = field(default_factory=lambda: np.zeros(3))
    boresight: Array = field(default_factory=lambda: np.zeros(3))
    imu_to_body: Array = field(default_factory=lambda: np.zeros(3))
    drift: Array = field(default_factory=lambda: np.zeros(3))
    flexure: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def dcm_imu_to_body(self) -> Array:
        return rpy_to_dcm(*self.imu_to_body)

    @property
    def dcm_camera_to_body(self) -> Array:
        return rpy_to_dcm(*self.boresight)

    def dcm_at(self, temperature: Array | None, acceleration: Array | None) -> Array:
        """C_camera→body (3, 3), or (n, 3, 3) where the mount drifts or bends.

        temperature (n,) [degC]: mean of the accelerometers, needed for drift; acceleration (n, 3) [rad/s²], for flexure.
        """
        dcm = self.dcm_camera_to_body
        if self.drift.any():
            if temperature is None:
                raise ValueError("a boresight that drifts needs temperatures")
            dcm = exp_so3((temperature - DRIFT_REFERENCE)[:, None] * self.drift) @ dcm
        if self.flexure.any():
            if acceleration is None:
                raise ValueError("a mount that bends needs angular accelerations")
            bend = np.zeros((len(acceleration), 3))
            bend[:, :2] = self.flexure * acceleration[:, :2]
            dcm = exp_so3(bend) @ dcm
        return dcm

    def with_effects(self, effects: Effects) -> Mounting:
        """boresight + boresight, drift + boresight_thermal_drift, flexure + mount_flexure."""
        return replace(
            self,
            boresight=self.boresight + amounts(effects, "boresight"),
            drift=self.drift + amounts(effects, "boresight_thermal_drift"),
            flexure=self.flexure + amounts(effects, "mount_flexure"),
        )


def camera_pose(
    latitude: Array,
    longitude: Array,
    height: Array,
    body_to_ned: Array,
    mounting: Mounting,
    temperature: Array | None = None,
    acceleration: Array | None = None,
) -> tuple[Array, Array]:
    """Projection centre (..., 3) [m] in ECEF and C_camera→ECEF (..., 3, 3) from the IMU's pose.

    temperature, acceleration: as in `Mounting.dcm_at`.
    """
    body_to_ecef = ned_to_ecef_dcm(latitude, longitude) @ body_to_ned
    centre = geodetic_to_ecef(latitude, longitude, height) + body_to_ecef @ mounting.imu_to_camera
    return centre, body_to_ecef @ mounting.dcm_at(temperature, acceleration)


def angular_acceleration(time: Array, rate: Array, at: Array) -> Array:
    """α = dω/dt (k, 3) [rad/s²] at times (k,), of mean rates ω (n, 3) [rad/s] over the intervals that end at time (n,) [s].

    A second-order Butterworth low pass at 12 Hz, forwards and backwards (zero phase), then the derivative of a cubic spline
    through the intervals' middles. A gap is bridged by a straight line.
    """
    step = float(np.median(np.diff(time)))
    even = time[0] + step * np.arange(int(np.ceil((time[-1] - time[0]) / step - 1e-6)) + 1)
    smooth = np.stack([np.interp(even, time, axis) for axis in rate.T], -1)
    if 0.5 / step > FLEXURE_CUTOFF:
        smooth = sosfiltfilt(butter(2, FLEXURE_CUTOFF, fs=1.0 / step, output="sos"), smooth, axis=0)
    return np.asarray(make_interp_spline(even - 0.5 * step, smooth).derivative()(at))
