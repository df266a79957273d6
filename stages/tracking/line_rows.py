"""The residual of one flight line: points picked in frames, motion between frames, heights of the ground.

    r = seen − predicted [px, m],    rows of seven channels

0, 1 control points, row and column; 2, 3 mean motion of pairs in row and column, 4 its slopes over the image, 5 its curves; 6
surveyed heights minus the DEM's.

Classes
-------
Line           what is known of a flight line
Geometry       camera and mounting with some effects
LineRows       the rows, predicted at any geometry; what POS errors do to them
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pipeline.errors import InputError
from pipeline.records import Gcps, ImageMotion, Targets, Temperatures, Trajectory
from pipeline.residual_problem import Parameters
from stages.tracking.collinearity import Condition, camera_poses, poses_at
from stages.tracking.curves import Place
from stages.tracking.motion_modes import DEGREES, Modes, Poses, missed, modes_of
from stages.tracking.pos_errors import Offset, constant, stretch, wander
from tsmftis.camera import Camera, Mounting
from tsmftis.effects import amounts
from tsmftis.geodesy import geodetic_to_ecef
from tsmftis.inertial import SensorModel

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

UNEVEN_M = 10.0  # relief of ground that no DEM tells of, where surveyed points do not say more
LEAST_DEM_SIGMA_M = 0.02
PATH_POINTS = 50  # of a line, to which surveyed points are ordered


class Terrain(Protocol):
    """What is asked of a DEM (`pipeline.raster.Dem`): heights [m] at geodetic positions [rad], and whether it reaches there."""

    def height(self, latitude: Array, longitude: Array) -> Array: ...

    def covers(self, latitude: Array, longitude: Array) -> NDArray[np.bool_]: ...


class GeometrySettings(BaseModel):
    """What the closed loop believes of POS, registration and DEM before the data say more."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    motion_sigma_px: float = Field(0.02, gt=0, description="noise of a pair's mean motion beside that of its points")
    scatter_share: float = Field(
        0.2, gt=0, description="noise of a pair's motion over the scatter of its points: neighbours err alike"
    )
    motion_bias_px: float = Field(0.005, ge=0, description="what registration is off by throughout a line")
    dem_datum_m: float = Field(0.05, ge=0, description="agreement of DEM and survey on what height is")
    least_sigma_position_m: float = Field(
        0.01, ge=0, description="errors of the fixes that last for minutes, which no receiver's sigma holds"
    )
    sigma_attitude_deg: float = Field(0.01, gt=0, description="of roll, pitch and yaw where the POS states none")
    sigma_position_m: float = Field(0.05, gt=0, description="where the POS states none")
    sigma_velocity_m_per_s: float = Field(0.01, gt=0, description="where the POS states none")
    least_groups: int = Field(12, ge=2, description="lines are cut into blocks of frames to give as many")


@dataclass(frozen=True)
class Line:
    """What is known of a flight line. Lines of the same `flight` share errors of the POS; stamps (frame,) [s]."""

    name: str
    trajectory: Trajectory
    stamps: Array
    gcps: Gcps | None = None
    targets: Targets | None = None
    motion: ImageMotion | None = None
    temperatures: Temperatures | None = None
    flight: str = ""


@dataclass(frozen=True)
class Geometry:
    """Camera and mounting with the effects of some values, and the height [m] that is added to the DEM."""

    camera: Camera
    mounting: Mounting
    height: float

    @classmethod
    def of(cls, camera: Camera, mounting: Mounting, effects: Parameters) -> Geometry:
        (height,) = amounts(effects, "dem_bias")
        return cls(camera.with_effects(effects), mounting.with_effects(effects), height)

    def plus(self, effects: Parameters) -> Geometry:
        new = Geometry.of(self.camera, self.mounting, effects)
        return replace(new, height=self.height + new.height)


@dataclass(frozen=True)
class Rows:
    """Rows (n,) of one kind in one line, in the order in which they are predicted.

    frame: where in the line; series: rows that follow each other in time.
    """

    channel: Labels
    series: Labels
    frame: Array
    sigma: Array


class LineRows:
    """A line's rows at any geometry. Poses are kept for the last latencies; all else is cheap."""

    def __init__(self, line: Line, null: Geometry, dem: Terrain | None, settings: GeometrySettings) -> None:
        self.line, self.null, self.dem, self.settings = line, null, dem, settings
        motion, gcps = line.motion, line.gcps
        if gcps is not None and (gcps.frame >= line.stamps.size).any():
            raise InputError(
                f"gcps of line {line.name}",
                f"frame {int(gcps.frame.max())}",
                f"does not exist: the line has {line.stamps.size} frames",
                "give indices that count from 0",
            )
        used = [np.zeros(0, int)]
        used += [] if gcps is None else [gcps.frame]
        used += [] if motion is None else [motion.first, motion.second]
        self.frames = np.unique(np.concatenate(used)).astype(int)
        self.at = lru_cache(maxsize=8)(self._at)
        surveyed = [p for p in (gcps, line.targets) if p is not None]
        places = [np.stack([p.latitude, p.longitude, p.height], -1) for p in surveyed]
        self.points = np.unique(np.round(np.concatenate([np.zeros((0, 3)), *places]), 12), axis=0)
        known = np.zeros(self.frames.size, bool)
        if self.frames.size:
            known = np.isfinite(self.at(null.camera.latency)[0].latitude)
        self.picked = None if gcps is None else self._picked(gcps, known)
        self.modes = None if motion is None else self._modes(motion, known)
        self.heights = self._heights()

    def _at(self, latency: float) -> tuple[Trajectory, Condition]:
        """The unit in the frames used, and what the mount is under there: both do not depend on anything but the latency."""
        line = self.line
        time = line.stamps[self.frames] - latency
        drifts = line.temperatures is not None or bool(self.null.mounting.drift.any())
        asked = Mounting(np.zeros(3), drift=np.full(3, float(drifts)), flexure=np.ones(2))
        return poses_at(line.trajectory, time), Condition.at(time, line.trajectory, asked, line.temperatures)

    def poses(self, geometry: Geometry, error: Offset | None = None) -> Poses:
        """The camera in the frames used."""
        if self.frames.size == 0:
            return Poses(np.zeros((0, 3)), np.zeros((0, 3, 3)))
        events, under = self.at(geometry.camera.latency)
        made = camera_poses(events if error is None else error.applied(events), geometry.mounting, under)
        return Poses(made.centre, made.dcm)

    def _picked(self, gcps: Gcps, known: NDArray[np.bool_]) -> Gcps | None:
        """Control points in frames of known pose, by frame."""
        order = np.argsort(gcps.frame, kind="stable")
        order = order[np.isin(gcps.frame[order], self.frames[known])]
        return chosen(gcps, order) if order.size else None

    def _modes(self, motion: ImageMotion, known: NDArray[np.bool_]) -> Modes | None:
        if self.dem is None and not len(self.points):
            return None  # nothing tells how far the ground is
        places = np.searchsorted(self.frames, motion.first), np.searchsorted(self.frames, motion.second)
        believed = self.settings.motion_sigma_px, self.settings.scatter_share
        return modes_of(motion, places, known, self.poses(self.null), self.null.camera, self._ground, *believed)

    def _ground(self, latitude: Array, longitude: Array) -> Array:
        """The DEM's height; without one, that of a level surface at the mean of the surveyed points."""
        if self.dem is not None:
            return self.dem.height(latitude, longitude) + self.null.height
        return np.full(latitude.shape, float(self.points[:, 2].mean()))

    def _heights(self) -> tuple[Array, Array]:
        """Surveyed minus DEM's heights (point,) and the frame that is nearest to each, in that order."""
        none = np.zeros(0), np.zeros(0)
        if self.dem is None or not len(self.points):
            return none
        points = self.points[self.dem.covers(self.points[:, 0], self.points[:, 1])]
        every = np.unique(np.linspace(0, self.line.stamps.size - 1, PATH_POINTS).astype(int))
        path = poses_at(self.line.trajectory, self.line.stamps[every] - self.null.camera.latency)
        known = np.isfinite(path.latitude)
        if not known.any() or not len(points):
            return none
        unit = geodetic_to_ecef(path.latitude[known], path.longitude[known], path.height[known])
        away = np.linalg.norm(geodetic_to_ecef(*points.T)[:, None] - unit, axis=-1)
        frame = every[known][np.argmin(away, axis=1)]
        order = np.argsort(frame, kind="stable")
        left = points[:, 2] - self.dem.height(points[:, 0], points[:, 1])
        return left[order], frame[order].astype(float)

    def picks(self, geometry: Geometry, poses: Poses | None = None) -> Array:
        """Picked minus predicted [px] (pick, 2)."""
        gcps = self.picked
        if gcps is None:
            return np.zeros((0, 2))
        point = geodetic_to_ecef(gcps.latitude, gcps.longitude, gcps.height)
        at = np.searchsorted(self.frames, gcps.frame)
        row, col = (poses or self.poses(geometry)).pixels(at, geometry.camera, point)
        return np.stack([gcps.row - row, gcps.col - col], -1)

    def residual(self, geometry: Geometry, error: Offset | None = None, raised: Array | float = 0.0) -> Array:
        """Seen minus predicted (n,): picks' rows, columns; pairs' modes of rows, of columns; heights."""
        poses = self.poses(geometry, error)
        picks = self.picks(geometry, poses)
        parts = [picks[:, 0], picks[:, 1]]
        added = geometry.height - self.null.height
        if self.modes is not None:
            for left in missed(self.modes.points, poses, geometry.camera, added + raised):
                parts += [maps @ left[mine] for mine, maps in self.modes.pairs]
        return np.concatenate([*parts, self.heights[0] - geometry.height])

    def rows(self) -> list[Rows]:
        """What the samples of `residual` are."""
        out = []
        if self.picked is not None:
            frame = self.picked.frame.astype(float)
            out += [_rows(axis, frame, self.picked.sigma, axis) for axis in (0, 1)]
        if self.modes is not None:
            points = self.modes.points
            for axis in (0, 1):
                for sigma, (mine, _) in zip(self.modes.sigma, self.modes.pairs, strict=True):
                    middle = float(self.frames[[points.first[mine][0], points.second[mine][0]]].mean())
                    mode = np.arange(sigma.size)
                    channel = np.select([mode == 0, mode < 3], [2 + axis, 4], 5)
                    out.append(Rows(channel, 2 + axis * len(DEGREES) + mode, np.full(mode.size, middle), sigma))
        left, frame = self.heights
        if left.size:
            spread = 1.4826 * float(np.median(np.abs(left - np.median(left))))
            out.append(_rows(6, frame, np.full(left.size, max(spread, LEAST_DEM_SIGMA_M)), SERIES - 1))
        return out

    def seconds(self, frame: Array) -> Array:
        """Stamp of frames, also of those half way between."""
        return np.interp(frame, np.arange(self.line.stamps.size), self.line.stamps)

    def common(self, gyro: SensorModel | None) -> Array:
        """What one standard deviation of errors that a flight's lines share does to the residual (n, m)."""
        if self.frames.size == 0:
            return np.zeros((self.residual(self.null).size, 9 if gyro is None else 12))
        errors = self._constant()
        return self._columns([*errors, *([] if gyro is None else stretch(gyro.scale_factor_sigma))])

    def own(self, rows: Sequence[Rows], gyro: SensorModel | None) -> Array:
        """The same of this line's own: the POS, also as it wanders; registration's bias; the ground where no DEM tells it."""
        if self.frames.size == 0:
            return np.zeros((self.residual(self.null).size, 0))
        errors = self._constant()
        if gyro is not None:
            start, stop = (float(self.line.stamps[i]) for i in (0, -1))
            errors = [*errors, *wander(start, stop, gyro.white_noise)]
        columns = [*self._columns(errors).T]
        if self.modes is not None:
            channel, series, frame = (
                np.concatenate([getattr(r, n) for r in rows]) for n in ("channel", "series", "frame")
            )
            moving = (channel >= 2) & (channel <= 5)
            columns += [self.settings.motion_bias_px * (moving & (series == one)) for one in np.unique(series[moving])]
            if self.dem is None:
                relief = max(float(np.std(self.points[:, 2])), UNEVEN_M)
                null, camera = self.residual(self.null), self.null.camera
                y = 2.0 * self.modes.points.row / camera.rows - 1.0
                x = 2.0 * self.modes.points.col / camera.cols - 1.0
                for a, b in DEGREES:
                    hills = self.residual(self.null, raised=relief * y**a * x**b) - null
                    columns += [hills * (frame == one) for one in np.unique(frame[moving])]
        return np.stack(columns, -1).astype(float)

    def _columns(self, errors: Sequence[Offset]) -> Array:
        null = self.residual(self.null)
        return np.stack([self.residual(self.null, error) - null for error in errors], -1)

    def _constant(self) -> list[Offset]:
        believed, events = self.settings, self.at(self.null.camera.latency)[0]
        stated = {
            "sigma_attitude": (float(np.deg2rad(believed.sigma_attitude_deg)), 0.0),
            "sigma_position": (believed.sigma_position_m, believed.least_sigma_position_m),
            "sigma_velocity": (believed.sigma_velocity_m_per_s, 0.0),
        }
        sizes = []
        for name, (unknown, least) in stated.items():
            values = getattr(events, name)
            values = values[np.isfinite(values).all(axis=1)]
            sizes.append(np.maximum(values.mean(axis=0) if len(values) else np.full(3, unknown), least))
        return constant(*sizes)

    def places(self) -> list[Place]:
        """Where control points are, and points of pairs in the first and in the second frame.

        As predicted, not as seen: in curves of a place that holds the noise, the noise would explain itself.
        """
        out = []
        poses = self.poses(self.null)
        if self.picked is not None:
            at = np.searchsorted(self.frames, self.picked.frame)
            row, col = self.picks(self.null, poses).T
            out.append(self._place(at, self.picked.row - row, self.picked.col - col))
        if self.modes is not None:
            p = self.modes.points
            row, col = missed(p, poses, self.null.camera)
            out.append(self._place(p.first, p.row, p.col))
            out.append(self._place(p.second, p.row + p.row_shift - row, p.col + p.col_shift - col))
        return out

    def _place(self, at: Labels, row: Array, col: Array) -> Place:
        events, under = self.at(self.null.camera.latency)
        temperature, acceleration = under.temperature, under.acceleration
        assert acceleration is not None
        warm = np.full(at.size, np.nan) if temperature is None else temperature[at]
        speed = np.hypot(events.velocity[at, 0], events.velocity[at, 1])
        return Place(events.time[at], warm, row, col, events.rpy[at], events.rate[at], acceleration[at], speed)

    def spread(self, moves: Sequence[Array]) -> Array:
        """Displacements (place, 2, k) [px] of the `places`, as they show in the rows (n, k)."""
        rest, parts = list(moves), []
        k = moves[0].shape[2] if moves else 0
        if self.picked is not None:
            picks = rest.pop(0)
            parts += [picks[:, 0], picks[:, 1]]
        if self.modes is not None:
            away = rest[1] - rest[0]
            parts += [maps @ away[mine, axis] for axis in (0, 1) for mine, maps in self.modes.pairs]
        return np.concatenate([*parts, np.zeros((self.heights[0].size, k))])


SERIES = 3 + 2 * len(DEGREES)  # of a line


def chosen(gcps: Gcps, index: Labels | NDArray[np.bool_]) -> Gcps:
    """Some of the control points."""
    return Gcps(**{name: getattr(gcps, name)[index] for name in Gcps.__dataclass_fields__})


def _rows(channel: int, frame: Array, sigma: Array, series: int) -> Rows:
    return Rows(np.full(frame.size, channel), np.full(frame.size, series), frame, sigma)
