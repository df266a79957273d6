"""Collinearity: trajectory, mounting and camera say on which row and column a ground point falls in each frame.

p_camera = C_camera→ECEFᵀ·(P_point − P_camera), then the camera's projection. The pose is taken at the frame's true time,
stamp − latency, by splines through the trajectory. Effects of a model update change camera and mounting; a boresight that
drifts is that of the frame's temperature, a mount that bends follows the unit's angular acceleration. What the closed loop has
learnt without a name turns the camera from frame to frame (`stages.tracking.learned`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.interpolate import CubicHermiteSpline

from pipeline.errors import InputError, StageError
from pipeline.records import DATA_GAP, CameraPoses, Targets, Temperatures, Tracks, Trajectory
from pipeline.truth import TruePoses
from stages.tracking.learned import Learned, turned
from tsmftis.camera import Camera, Mounting, angular_acceleration, camera_pose
from tsmftis.effects import refuse_others
from tsmftis.geodesy import ecef_to_geodetic, geodetic_to_ecef, ned_to_ecef_dcm, radii_of_curvature
from tsmftis.rotation import Attitude, dcm_to_rpy, rpy_to_dcm

Array = NDArray[np.float64]

MARGIN_S = 0.25  # trajectory kept beyond the line's ends, so that the splines have no end inside it
FILTER_MARGIN_S = 2.0  # the same for a low pass of 12 Hz


class TrackingSettings(BaseModel):
    """How far a target may lie from the flight before its coordinates are taken for wrong."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    farthest_target_m: float = Field(
        50_000.0, gt=0, description="a target farther from the line than this is an error in its coordinates"
    )


@dataclass(frozen=True)
class TrackingResult:
    """Tracks of `nominal` and `tracking`; the camera's pose in each frame, and the unit's with sigmas (the event file); mean
    course [rad], ground speed [m/s], range [m]."""

    tracks: Tracks
    poses: CameraPoses
    events: Trajectory
    course: float
    ground_speed: float
    range: float


def run(
    trajectory: Trajectory,
    stamps: Array,
    targets: Targets,
    camera: Camera,
    mounting: Mounting,
    settings: TrackingSettings,
    truth: TruePoses | None = None,
    temperatures: Temperatures | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    learned: Sequence[Learned] = (),
) -> TrackingResult:
    """Tracks of every point of every target through the frames with these time stamps [s]; by true poses too, if given.

    `effects` of the stage geometry are what a model update adds to camera and mounting, `learned` its curves that
    `learned.applied` has chosen; `temperatures` are the unit's, which a boresight that drifts needs. Raises InputError where the
    frames lie outside the trajectory or a target lies nowhere near the line, or where temperatures are needed and missing.
    """
    refuse_others(effects or {}, "geometry")
    camera, mounting = camera.with_effects(effects or {}), mounting.with_effects(effects or {})
    time = stamps - camera.latency
    curves_of = {one["covariate"] for one in learned}
    asked = replace(
        mounting,
        drift=np.ones(3) if "temperature" in curves_of else mounting.drift,
        flexure=np.ones(2) if "angular acceleration" in curves_of else mounting.flexure,
    )
    moved = Condition.at(time, trajectory, asked, temperatures)
    events = poses_at(trajectory, time)

    def as_learned(poses: CameraPoses) -> CameraPoses:
        return turned(poses, events, moved.temperature, moved.acceleration, camera, learned)

    poses = as_learned(camera_poses(events, mounting, moved))
    inside = np.isfinite(poses.centre[:, 0])
    if inside.sum() < 2:
        raise InputError(
            "frames",
            "variable 'time'",
            f"spans {time[0]:.2f} to {time[-1]:.2f} s but the trajectory {trajectory.time[0]:.2f} to "
            f"{trajectory.time[-1]:.2f} s: no frame lies inside it",
            "frames and IMU must share the campaign's one clock",
        )
    below = distance_down(target_points(targets, 0.0), poses)
    if (np.nanmean(below, axis=1) <= 0.0).any():
        i = int(np.argmin(np.nanmean(below, axis=1)))
        raise StageError(
            f"the camera flies {-np.nanmean(below[i]):.0f} m below target {targets.ids[i]}: heights of targets and trajectory "
            "are not both above the ellipsoid"
        )
    towards = poses.centre[inside] / np.linalg.norm(poses.centre[inside], axis=1, keepdims=True)
    if float(np.median(np.einsum("fi,fi->f", towards, poses.dcm[inside, :, 2]))) > -0.2:
        raise StageError(
            "the camera does not look down along the line: check mounting.boresight_deg and imu_to_body_deg"
        )
    course, speed = mean_course(trajectory, float(time[inside][0]), float(time[inside][-1]))
    points = target_points(targets, course)
    distance = np.linalg.norm(points[:, Tracks.CENTRE] - np.nanmean(poses.centre, axis=0), axis=-1)
    if (distance > settings.farthest_target_m).any():
        i = int(np.argmax(distance))
        raise InputError(
            "targets",
            f"target {targets.ids[i]}",
            f"lies {distance[i] / 1000:.0f} km from the line",
            "latitude and longitude may be swapped: correct them",
        )
    row, col = project(points, poses, camera)
    nominal = nominal_track(row, col, time, camera, speed, float(np.nanmean(distance_down(points, poses))))
    tracks = Tracks(("nominal", "tracking"), targets.ids, np.stack([nominal[0], row]), np.stack([nominal[1], col]))
    if truth is not None:
        row, col = project(points, as_learned(true_camera(time, truth, mounting, moved)), camera)
        tracks = tracks.joined(Tracks(("true",), targets.ids, row[None], col[None]))
    return TrackingResult(tracks, poses, events, course, speed, float(np.nanmean(distance_down(points, poses))))


@dataclass(frozen=True)
class Condition:
    """What the mount is under in each frame: mean accelerometer temperature (n,) [degC], angular acceleration (n, 3) [rad/s²].

    None where nothing depends on it.
    """

    temperature: Array | None = None
    acceleration: Array | None = None

    @classmethod
    def at(
        cls, time: Array, trajectory: Trajectory, mounting: Mounting, temperatures: Temperatures | None
    ) -> Condition:
        temperature = acceleration = None
        if mounting.drift.any():
            if temperatures is None:
                raise InputError(
                    "imu",
                    "temperature_accel",
                    "is missing, and the model update turns the camera by it",
                    "record temperatures, or leave boresight_thermal_drift and curves of temperature out of the model update",
                )
            temperature = np.interp(time, temperatures.time, temperatures.accel.mean(axis=1))
        if mounting.flexure.any():
            part = trajectory.between(time.min() - FILTER_MARGIN_S, time.max() + FILTER_MARGIN_S)
            acceleration = np.zeros((time.size, 3))
            if part.time.size > 1:
                inside = (time >= part.time[0]) & (time <= part.time[-1])
                acceleration[inside] = angular_acceleration(part.time, part.rate, time[inside])
        return cls(temperature, acceleration)

    def of(self, frames: NDArray[np.bool_]) -> Condition:
        """That of some frames."""
        chosen = (None if v is None else v[frames] for v in (self.temperature, self.acceleration))
        return Condition(*chosen)


def poses_at(trajectory: Trajectory, time: Array) -> Trajectory:
    """The trajectory at times (n,) [s]: the unit's pose by splines, velocity, sigmas and inertial data linearly.

    NaN where the trajectory does not reach, or has a gap in the inertial data: nothing tells how the body moved in a gap.
    """
    after = np.clip(np.searchsorted(trajectory.time, time), 1, trajectory.time.size - 1)
    step = trajectory.time[after] - trajectory.time[after - 1]
    inside = (time >= trajectory.time[0]) & (time <= trajectory.time[-1])
    inside &= step <= DATA_GAP * np.median(np.diff(trajectory.time))
    out = {f.name: np.full((time.size, *getattr(trajectory, f.name).shape[1:]), np.nan) for f in fields(Trajectory)}
    out["time"] = time
    if inside.any():
        part = trajectory.between(time[inside].min() - MARGIN_S, time[inside].max() + MARGIN_S)
        part = replace(part, longitude=np.unwrap(part.longitude))  # across the date line
        at = time[inside]
        try:
            attitude = Attitude.fit(part.time, rpy_to_dcm(*part.rpy.T))
        except ValueError as error:
            raise StageError(f"no track can be laid through these frames: {error}") from error
        north, east = radii_of_curvature(part.latitude)
        rates = {
            "latitude": part.velocity[:, 0] / (north + part.height),
            "longitude": part.velocity[:, 1] / ((east + part.height) * np.cos(part.latitude)),
            "height": -part.velocity[:, 2],
        }
        for name, rate in rates.items():
            out[name][inside] = CubicHermiteSpline(part.time, getattr(part, name), rate)(at)
        out["rpy"][inside] = np.stack(dcm_to_rpy(attitude(at)), -1)
        for name in ("velocity", "sigma_position", "sigma_velocity", "sigma_attitude", "rate", "specific_force"):
            values = getattr(part, name)
            out[name][inside] = np.stack([np.interp(at, part.time, values[:, i]) for i in range(3)], -1)
    return Trajectory(**out)


def camera_poses(events: Trajectory, mounting: Mounting, under: Condition | None = None) -> CameraPoses:
    """The camera where the unit is at `events` (n,); NaN where that is not known."""
    centre, dcm = np.full((events.time.size, 3), np.nan), np.full((events.time.size, 3, 3), np.nan)
    known = np.isfinite(events.latitude)
    now = (under or Condition()).of(known)
    centre[known], dcm[known] = camera_pose(
        events.latitude[known],
        events.longitude[known],
        events.height[known],
        rpy_to_dcm(*events.rpy[known].T),
        mounting,
        now.temperature,
        now.acceleration,
    )
    return CameraPoses(events.time, centre, dcm)


def true_camera(time: Array, truth: TruePoses, mounting: Mounting, under: Condition | None = None) -> CameraPoses:
    """The camera as mounted on the unit at its true poses."""
    latitude, longitude, height = ecef_to_geodetic(truth.position)
    to_ned = np.swapaxes(ned_to_ecef_dcm(latitude, longitude), -1, -2)
    now = under or Condition()
    pose = camera_pose(latitude, longitude, height, to_ned @ truth.dcm, mounting, now.temperature, now.acceleration)
    return CameraPoses(time, *pose)


def mean_course(trajectory: Trajectory, start: float, stop: float) -> tuple[float, float]:
    """Course [rad, from north over east] and ground speed [m/s] of the mean velocity between two times."""
    part = trajectory.between(start, stop)
    north, east = part.velocity[:, 0].mean(), part.velocity[:, 1].mean()
    return float(np.arctan2(east, north)), float(np.hypot(north, east))


def target_points(targets: Targets, course: float) -> Array:
    """ECEF points (target, 25, 3): a 5 × 5 grid along and across the course, within ±size/4, flat at the target's height."""
    along, across = (g.ravel() for g in np.meshgrid(*[np.linspace(-0.25, 0.25, Tracks.GRID)] * 2, indexing="ij"))
    north = along * np.cos(course) - across * np.sin(course)
    east = along * np.sin(course) + across * np.cos(course)
    offset = np.stack([north, east, np.zeros_like(north)], -1) * targets.size[:, None, None]
    centre = geodetic_to_ecef(targets.latitude, targets.longitude, targets.height)
    frame = ned_to_ecef_dcm(targets.latitude, targets.longitude)
    return centre[:, None, :] + np.einsum("tij,tpj->tpi", frame, offset)


def project(points: Array, poses: CameraPoses, camera: Camera) -> tuple[Array, Array]:
    """Row and column (target, point, frame) of ECEF points (target, point, 3), also where they fall off the detector."""
    line_of_sight = points[:, :, None, :] - poses.centre
    return camera.project(np.einsum("fij,tpfi->tpfj", poses.dcm, line_of_sight))


def distance_down(points: Array, poses: CameraPoses) -> Array:
    """Height of the camera above each target's centre (target, frame) [m]."""
    _, _, camera_height = ecef_to_geodetic(poses.centre)
    _, _, height = ecef_to_geodetic(points[:, Tracks.CENTRE])
    return camera_height - height[:, None]


def nominal_track(
    row: Array, col: Array, time: Array, camera: Camera, speed: float, height: float
) -> tuple[Array, Array]:
    """Uniform straight motion from the anchor frame: col += v·Δt·f/(p·H) a frame, row unchanged; no attitude."""
    anchor = camera.central_frame(row[:, Tracks.CENTRE], col[:, Tracks.CENTRE])
    pixels = speed * camera.focal_length / (camera.pixel_pitch * height) * (time - time[anchor][:, None])
    pick = anchor[:, None, None]
    row0, col0 = np.take_along_axis(row, pick, 2), np.take_along_axis(col, pick, 2)
    return np.broadcast_to(row0, row.shape).copy(), col0 + pixels[:, None, :]
