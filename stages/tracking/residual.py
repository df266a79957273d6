"""What the closed loop is offered of the geometry: where points are in the images, how the scene moves, how high it lies.

    r = (1 + U·U')^(−1/2)·D⁻¹·(seen − predicted)

Three kinds of rows: control points as picked minus the POS' prediction; motion between frames some way apart, as images show it
(`stages.registration.image_motion`), minus that of the ground seen through both poses; surveyed heights minus the DEM's. D is
the noise of each. U is what else the residual may hold with nothing missing: errors of the POS within its own sigmas, the same
over a line or over a flight, and what registration and DEM are biased by (`stages.tracking.pos_errors`).

The motion of a pair of frames comes as coefficients of a polynomial over the image, 1, y, x, x², xy, y², orthonormal over the
points of the pair, for row and column: the noise of registration is alike all over a frame, and rows of single points would
count it many times.

Functions
---------
residual_problem      of some lines; None where there is nothing to compare
geometry_residual_px  RMS of the control points [px], held out from the estimate of the effects
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pipeline.raster import Dem
from pipeline.records import Gcps, ImageMotion, Targets, Temperatures, Trajectory
from pipeline.residual_problem import Candidate, Parameter, Parameters, ResidualProblem
from stages.tracking.collinearity import Condition, camera_poses, poses_at
from stages.tracking.pos_errors import Offsets, offsets, whitener
from tsmftis.camera import Camera, Mounting
from tsmftis.effects import EFFECTS, Effects, amounts
from tsmftis.geodesy import ecef_to_geodetic, geodetic_to_ecef, ned_to_ecef_dcm, radii_of_curvature

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

CELLS = (3, 5)  # of the detector, rows and columns: in each the points of a pair are averaged
DEGREES = ((0, 0), (1, 0), (0, 1), (0, 2), (1, 1), (2, 0))  # of row and column in the modes of a motion
OUTLIER = 4.0  # scatters of a pair beyond which a point is left out
ROUNDS = 8  # of ray and terrain
SLOPE_M = 10.0  # over which the terrain's slope is taken
UNEVEN_M = 10.0  # relief of ground that no DEM tells of, where surveyed points do not say more
LEAST_DEM_SIGMA_M = 0.02
MOST_CONDITION = 30.0  # of a pair's modes: fewer are taken where the points do not carry them
TIE_S = 1e-6
GROSS = 6.0  # sigma of a pick that no effect accounts for, and that is taken for a mistake
RATHER = 1.5  # sigma beyond which a pick counts less while mistakes are looked for
PLAUSIBLE: Mapping[str, float] = {
    "camera_latency": 2e-3,
    "boresight": 5e-4,
    "boresight_thermal_drift": 5e-5,
    "mount_flexure": 2e-4,
    "focal_length": 2e-3,
    "dem_bias": 1.0,
}
CORNER_PX = 0.5  # by which a plausible distortion moves the corner of the image


class ResidualSettings(BaseModel):
    """What is believed of POS, registration and DEM before the data say more."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    motion_sigma_px: float = Field(0.02, gt=0, description="noise of a pair's motion, alike all over the image")
    shape_sigma_px: float = Field(
        0.01, gt=0, description="the same of what is not alike: slopes and curves over the image"
    )
    motion_bias_px: float = Field(0.005, ge=0, description="what registration is off by throughout a line")
    dem_datum_m: float = Field(0.05, ge=0, description="agreement of DEM and survey on what height is")
    least_sigma_position_m: float = Field(
        0.01, ge=0, description="errors of the fixes that last for minutes, which no receiver's sigma holds"
    )
    sigma_attitude_deg: float = Field(0.01, gt=0, description="of roll, pitch and yaw where the POS states none")
    sigma_position_m: float = Field(0.05, gt=0, description="where the POS states none")
    sigma_velocity_m_per_s: float = Field(0.01, gt=0, description="where the POS states none")
    least_groups: int = Field(6, ge=2, description="lines are cut into blocks of frames to give as many")


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

    frame: where in the line; series: rows that follow each other in time; `local` names covariates of these rows alone.
    """

    channel: Labels
    series: Labels
    frame: Array
    sigma: Array
    local: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Modes:
    """Points of pairs (point,) averaged over cells, and how a pair's residuals make its modes.

    first, second: place of the pair's frames among the frames used; ground (point, 3), normal and up (point, 3): where the first
    frame's ray met the terrain; maps (pair) → (mode, point of the pair).
    """

    first: Labels
    second: Labels
    row: Array
    col: Array
    row_shift: Array
    col_shift: Array
    ground: Array
    normal: Array
    up: Array
    pairs: tuple[tuple[slice, Array], ...]


class _Line:
    """A line's rows: predicted at any geometry. Poses are kept for the last latencies; all else is cheap."""

    def __init__(self, line: Line, geometry: Geometry, dem: Dem | None, settings: ResidualSettings) -> None:
        self.line, self.settings, self.dem, self.null_latency = line, settings, dem, geometry.camera.latency
        motion, gcps = line.motion, line.gcps
        used = [np.zeros(0, int)]
        used += [] if gcps is None else [gcps.frame[(gcps.frame >= 0) & (gcps.frame < line.stamps.size)]]
        used += [] if motion is None else [motion.first, motion.second]
        self.frames = np.unique(np.concatenate(used)).astype(int)
        self.at = lru_cache(maxsize=8)(self._at)
        surveyed = [p for p in (gcps, line.targets) if p is not None]
        places = [np.stack([p.latitude, p.longitude, p.height], -1) for p in surveyed]
        self.points = np.unique(np.round(np.concatenate([np.zeros((0, 3)), *places]), 12), axis=0)
        known = np.zeros(self.frames.size, bool)
        if self.frames.size:
            known = np.isfinite(self.at(geometry.camera.latency)[0].latitude)
        self.picked = self._picked(known)
        self.modes, self.motion_sigma = self._modes(geometry, known)
        self.heights = self._heights(geometry)

    def _at(self, latency: float) -> tuple[Trajectory, Condition]:
        line = self.line
        time = line.stamps[self.frames] - latency
        everything = Mounting(np.zeros(3), drift=np.full(3, float(line.temperatures is not None)), flexure=np.ones(2))
        return poses_at(line.trajectory, time), Condition.at(time, line.trajectory, everything, line.temperatures)

    def poses(self, geometry: Geometry, error: Offsets | None = None) -> tuple[Array, Array]:
        """Projection centre (frame, 3) and C_camera→ECEF (frame, 3, 3) of the frames used."""
        if self.frames.size == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 3))
        events, under = self.at(geometry.camera.latency)
        poses = camera_poses(events if error is None else error.applied(events), geometry.mounting, under)
        return poses.centre, poses.dcm

    def _picked(self, known: NDArray[np.bool_]) -> Gcps | None:
        """Control points in frames of known pose, by frame."""
        gcps = self.line.gcps
        if gcps is None:
            return None
        order = np.argsort(gcps.frame, kind="stable")
        order = order[np.isin(gcps.frame[order], self.frames[known])]
        return self.only(gcps, order) if order.size else None

    @staticmethod
    def only(gcps: Gcps, index: Labels | NDArray[np.bool_]) -> Gcps:
        return Gcps(**{name: getattr(gcps, name)[index] for name in Gcps.__dataclass_fields__})

    def _modes(self, geometry: Geometry, known: NDArray[np.bool_]) -> tuple[Modes | None, tuple[Array, ...]]:
        motion = self.line.motion
        if motion is None or not self._has_ground:
            return None, ()
        camera = geometry.camera
        place = {int(f): i for i, f in enumerate(self.frames)}
        first, second = (np.array([place[int(f)] for f in v], int) for v in (motion.first, motion.second))
        good = (known[first] & known[second])[motion.pair]
        pair = motion.pair[good]
        one = Modes(
            first[pair],
            second[pair],
            *(v[good] for v in (motion.row, motion.col, motion.row_shift, motion.col_shift)),
            *(np.zeros((0, 3)),) * 3,
            (),
        )
        one = self._grounded(one, geometry)
        row, col = self._moved(one, geometry, *self.poses(geometry))
        sum_, pairs, cells = 0, [], []
        sigmas: list[Array] = []
        scale = np.array([camera.rows, camera.cols]) / 2.0
        for p in np.unique(pair):
            mine = np.flatnonzero(pair == p)
            left = np.stack([row[mine], col[mine]], -1)
            away = np.abs(left - np.median(left, axis=0))
            scatter = np.maximum(1.4826 * np.median(away, axis=0), motion.sigma[p])
            mine, left = (v[(away < OUTLIER * scatter).all(axis=1)] for v in (mine, left))
            at = np.stack([one.row[mine], one.col[mine]], -1)
            cell = np.minimum(at / (2.0 * scale) * CELLS, np.array(CELLS) - 1).astype(int) @ [CELLS[1], 1]
            labels, index, size = np.unique(cell, return_inverse=True, return_counts=True)
            if labels.size == 0:
                continue
            mean = np.stack([np.bincount(index, v) / size for v in (*at.T, *left.T)])
            y, x = (mean[:2] - scale[:, None]) / scale[:, None]
            columns = np.stack([y**a * x**b for a, b in DEGREES], -1) * np.sqrt(size / size.sum())[:, None]
            columns = columns[:, : _full(columns)]
            q = np.linalg.qr(columns)[0]
            q *= np.sign(np.einsum("ij,ij->j", q, columns))
            pairs.append((slice(sum_, sum_ + labels.size), q.T * np.sqrt(size / size.sum())))
            alike = np.where(
                np.arange(columns.shape[1]) == 0, self.settings.motion_sigma_px, self.settings.shape_sigma_px
            )
            sigmas.append(np.hypot(motion.sigma[p] / np.sqrt(size.sum()), alike))
            cells.append(np.vstack([np.full(labels.size, p), mean]))
            sum_ += labels.size
        if not pairs:
            return None, ()
        table = np.concatenate(cells, axis=1)
        p = table[0].astype(int)
        zero = np.zeros(p.size)
        made = Modes(first[p], second[p], table[1], table[2], zero, zero, *(np.zeros((0, 3)),) * 3, tuple(pairs))
        made = self._grounded(made, geometry)
        # What a cell's points have in common is what they miss on average; the cell's own shift is made to miss as much.
        row, col = self._moved(made, geometry, *self.poses(geometry))
        made = replace(made, row_shift=table[3] - row, col_shift=table[4] - col)
        return made, tuple(sigmas)

    @property
    def _has_ground(self) -> bool:
        return self.dem is not None or len(self.points) > 0

    def ground_height(self, latitude: Array, longitude: Array) -> Array:
        """The DEM's; without one, a level surface at the mean of the surveyed points."""
        if self.dem is not None:
            return self.dem.height(latitude, longitude)
        return np.full(latitude.shape, float(self.points[:, 2].mean()))

    def _grounded(self, modes: Modes, geometry: Geometry) -> Modes:
        """Where the rays meet the terrain, and the terrain's normal there: a plane is near enough for any small change."""
        centre, dcm = self.poses(geometry)
        start = centre[modes.first]
        ray = np.einsum("pij,pj->pi", dcm[modes.first], geometry.camera.directions(modes.row, modes.col))
        latitude, longitude, height = ecef_to_geodetic(start)
        sink = np.einsum("pi,pi->p", ray, ned_to_ecef_dcm(latitude, longitude)[:, :, 2])
        along = (height - self.ground_height(latitude, longitude)) / sink
        for _ in range(ROUNDS):
            latitude, longitude, height = ecef_to_geodetic(start + along[:, None] * ray)
            along = along + (height - self.ground_height(latitude, longitude) - geometry.height) / sink
        ground = start + along[:, None] * ray
        latitude, longitude, _ = ecef_to_geodetic(ground)
        north, east = radii_of_curvature(latitude)
        steps = SLOPE_M / north, SLOPE_M / (east * np.cos(latitude))
        slope = [
            (
                self.ground_height(latitude + a * steps[0], longitude + b * steps[1])
                - self.ground_height(latitude - a * steps[0], longitude - b * steps[1])
            )
            / (2.0 * SLOPE_M)
            for a, b in ((1, 0), (0, 1))
        ]
        axes = ned_to_ecef_dcm(latitude, longitude)
        normal = np.einsum("pij,pj->pi", axes, np.stack([-slope[0], -slope[1], -np.ones(latitude.size)], -1))
        return replace(modes, ground=ground, normal=normal, up=-axes[:, :, 2])

    def _moved(
        self, modes: Modes, geometry: Geometry, centre: Array, dcm: Array, raised: float = 0.0
    ) -> tuple[Array, Array]:
        """Shift seen minus shift predicted (point,) of row and column, over ground that lies `raised` higher."""
        ray = np.einsum("pij,pj->pi", dcm[modes.first], geometry.camera.directions(modes.row, modes.col))
        start = centre[modes.first]
        plane = modes.ground + raised * modes.up
        along = np.einsum("pi,pi->p", modes.normal, plane - start) / np.einsum("pi,pi->p", modes.normal, ray)
        point = start + along[:, None] * ray
        sight = np.einsum("pij,pi->pj", dcm[modes.second], point - centre[modes.second])
        row, col = geometry.camera.project(sight)
        return modes.row + modes.row_shift - row, modes.col + modes.col_shift - col

    def _heights(self, geometry: Geometry) -> tuple[Array, Array]:
        """Surveyed minus DEM's heights (point,) and the frame that is nearest to each, in that order."""
        if self.dem is None or not len(self.points):
            return np.zeros(0), np.zeros(0)
        covered = self.dem.covers(self.points[:, 0], self.points[:, 1])
        points = self.points[covered]
        if not len(points):
            return np.zeros(0), np.zeros(0)
        every = np.unique(np.linspace(0, self.line.stamps.size - 1, 50).astype(int))
        path = poses_at(self.line.trajectory, self.line.stamps[every] - geometry.camera.latency)
        known = np.isfinite(path.latitude)
        if not known.any():
            return np.zeros(0), np.zeros(0)
        unit = geodetic_to_ecef(path.latitude[known], path.longitude[known], path.height[known])
        away = np.linalg.norm(geodetic_to_ecef(*points.T)[:, None] - unit, axis=-1)
        frame = every[known][np.argmin(away, axis=1)]
        order = np.argsort(frame, kind="stable")
        left = points[:, 2] - self.dem.height(points[:, 0], points[:, 1])
        return left[order], frame[order].astype(float)

    def picks(self, geometry: Geometry, centre: Array, dcm: Array) -> Array:
        """Picked minus predicted [px] (pick, 2)."""
        gcps = self.picked
        if gcps is None:
            return np.zeros((0, 2))
        at = np.searchsorted(self.frames, gcps.frame)
        point = geodetic_to_ecef(gcps.latitude, gcps.longitude, gcps.height)
        row, col = geometry.camera.project(np.einsum("gij,gi->gj", dcm[at], point - centre[at]))
        return np.stack([gcps.row - row, gcps.col - col], -1)

    def residual(self, geometry: Geometry, null: Geometry, error: Offsets | None = None, raised: float = 0.0) -> Array:
        """Seen minus predicted (n,), in pixels and metres: picks' rows, columns; pairs' modes of rows, columns; heights."""
        centre, dcm = self.poses(geometry, error)
        picks = self.picks(geometry, centre, dcm)
        parts = [picks[:, 0], picks[:, 1]]
        if self.modes is not None:
            row, col = self._moved(self.modes, geometry, centre, dcm, geometry.height - null.height + raised)
            for left in (row, col):
                parts += [maps @ left[mine] for mine, maps in self.modes.pairs]
        return np.concatenate([*parts, self.heights[0] - geometry.height])

    def rows(self) -> list[Rows]:
        """In the order of `residual`; channels: 0, 1 picks; 2, 3 mean motion, 4 its slopes, 5 its curves; 6 heights."""
        out = []
        if self.picked is not None:
            frame = self.picked.frame.astype(float)
            for axis in (0, 1):
                out.append(self._rows(axis, frame, self.picked.sigma, axis, self._covariates(axis)))
        if self.modes is not None:
            motion = self.line.motion
            assert motion is not None
            for axis in (0, 1):
                for sigma, (mine, maps) in zip(self.motion_sigma, self.modes.pairs, strict=True):
                    frames = self.frames[[self.modes.first[mine][0], self.modes.second[mine][0]]]
                    k = len(maps)
                    mode = np.arange(k)
                    channel = np.select([mode == 0, mode < 3], [2 + axis, 4], 5)
                    series = 2 + axis * len(DEGREES) + mode
                    out.append(Rows(channel, series, np.full(k, frames.mean()), sigma))
        left, frame = self.heights
        if left.size:
            sigma = max(1.4826 * float(np.median(np.abs(left - np.median(left)))), LEAST_DEM_SIGMA_M)
            out.append(self._rows(6, frame, np.full(left.size, sigma), 2 + 2 * len(DEGREES), {}))
        return out

    def _rows(self, channel: int, frame: Array, sigma: Array, series: int, local: Mapping[str, Array]) -> Rows:
        n = frame.size
        return Rows(np.full(n, channel), np.full(n, series), frame, sigma, local)

    def _covariates(self, axis: int) -> dict[str, Array]:
        """Of the picks' rows (axis 0: across track) or columns (1: along track)."""
        assert self.picked is not None
        events, under = self.at(self.null_latency)
        at = np.searchsorted(self.frames, self.picked.frame)
        angle, where = ("roll", "across track") if axis == 0 else ("pitch", "along track")
        assert under.acceleration is not None
        out = {
            f"time {where}": events.time[at],
            f"row {where}": self.picked.row,
            f"column {where}": self.picked.col,
            angle: events.rpy[at, axis],
            f"{angle} rate": events.rate[at, axis],
            f"{angle} acceleration": under.acceleration[at, axis],
            f"ground height {where}": self.picked.height,
        }
        if under.temperature is not None:
            out[f"temperature {where}"] = under.temperature[at]
        if axis == 1:
            out["ground speed"] = np.hypot(events.velocity[at, 0], events.velocity[at, 1])
        return out

    def seconds(self, frame: Array) -> Array:
        """Stamp of frames, also of those half way between."""
        return np.interp(frame, np.arange(self.line.stamps.size), self.line.stamps)

    def pos_columns(self, geometry: Geometry) -> Array:
        """What one standard deviation of each constant error of the POS does to the residual (n, 9)."""
        null = self.residual(geometry, geometry)
        if self.frames.size == 0:
            return np.zeros((null.size, 9))
        believed, events = self.settings, self.at(geometry.camera.latency)[0]
        stated = {
            "sigma_attitude": (np.deg2rad(believed.sigma_attitude_deg), 0.0),
            "sigma_position": (believed.sigma_position_m, believed.least_sigma_position_m),
            "sigma_velocity": (believed.sigma_velocity_m_per_s, 0.0),
        }
        sizes = []
        for name, (unknown, least) in stated.items():
            values = getattr(events, name)
            values = values[np.isfinite(values).all(axis=1)]
            sizes.append(np.maximum(values.mean(axis=0) if len(values) else np.full(3, unknown), least))
        return np.stack([self.residual(geometry, geometry, error) - null for error in offsets(*sizes)], -1)

    def other_columns(self, geometry: Geometry, rows: Sequence[Rows]) -> Array:
        """The same of registration's own bias, mode by mode, and of the ground's height where no DEM tells it."""
        if self.modes is None:
            return np.zeros((sum(r.frame.size for r in rows), 0))
        channel, series, frame = (np.concatenate([getattr(r, n) for r in rows]) for n in ("channel", "series", "frame"))
        moving = (channel >= 2) & (channel <= 5)
        columns = [self.settings.motion_bias_px * (moving & (series == one)) for one in np.unique(series[moving])]
        if self.dem is None:
            relief = max(float(np.std(self.points[:, 2])), UNEVEN_M)
            raised = self.residual(geometry, geometry, raised=relief) - self.residual(geometry, geometry)
            columns += [raised, *(raised * (frame == one) for one in np.unique(frame[moving]))]
        return np.stack(columns, -1).astype(float)


def _full(columns: Array) -> int:
    """How many of the first columns are safely independent."""
    for count in (columns.shape[1], 3, 1):
        part = columns[:, :count]
        if count == 1 or (len(part) >= count and np.linalg.cond(part) < MOST_CONDITION):
            return count
    return 1


class _Campaign:
    """All lines, their rows in series of growing time, whitened."""

    def __init__(
        self,
        lines: Sequence[Line],
        camera: Camera,
        mounting: Mounting,
        dem: Dem | None,
        settings: ResidualSettings,
        effects: Effects,
    ) -> None:
        own = {name: values for name, values in effects.items() if EFFECTS[name].stage == "geometry"}
        self.null, self.dem = Geometry.of(camera, mounting, own), dem
        self.lines = [_Line(line, self.null, dem, settings) for line in lines]
        self._lay_out(settings)
        if self.mistaken():
            self._lay_out(settings)

    def _lay_out(self, settings: ResidualSettings) -> None:
        rows = [line.rows() for line in self.lines]
        flat = [r for one in rows for r in one]
        size = [sum(r.frame.size for r in one) for one in rows]
        n = sum(size)
        self.count = n
        if n == 0:
            return
        self.line = np.repeat(np.arange(len(rows)), size)
        self.channel, series, frame, sigma = (
            np.concatenate([getattr(r, name) for r in flat]) for name in ("channel", "series", "frame", "sigma")
        )
        time = np.concatenate([line.seconds(frame[self.line == i]) for i, line in enumerate(self.lines)])
        self.frame = frame
        self.order = np.lexsort((time, series, self.line))
        self.sigma = sigma
        blocks = -(-settings.least_groups // max(len({i for i in self.line}), 1))
        frames = np.array([line.line.stamps.size for line in self.lines])[self.line]
        self.blocks = blocks
        self.group = self.line * blocks + np.minimum((frame / frames * blocks).astype(int), blocks - 1)
        self.series = self.line * 100 + series
        self.time = _growing(time[self.order], self.series[self.order])
        u = self._shared(rows, n, settings) / sigma[:, None]
        self.whiten = whitener(u)
        self.covariates = {}
        place = 0
        for r in flat:
            for name, values in r.local.items():
                self.covariates.setdefault(name, np.full(n, np.nan))[place : place + values.size] = values
            place += r.frame.size

    def _shared(self, rows: Sequence[Sequence[Rows]], n: int, settings: ResidualSettings) -> Array:
        """Columns (n, m), in the residual's own units, of what many rows share."""
        flights: dict[str, list[Array]] = {}
        columns = []
        for i, (line, own) in enumerate(zip(self.lines, rows, strict=True)):
            mine = self.line == i
            if not own:
                continue
            pos = np.zeros((n, 9))
            pos[mine] = line.pos_columns(self.null)
            other = line.other_columns(self.null, own)
            wide = np.zeros((n, other.shape[1]))
            wide[mine] = other
            flights.setdefault(line.line.flight, []).append(pos)
            columns += [pos, wide]
        columns += [np.sum(same, axis=0) for same in flights.values() if len(same) > 1]
        columns.append(settings.dem_datum_m * (self.channel == 6).astype(float)[:, None])
        return np.concatenate(columns, axis=1)

    def raw(self, effects: Parameters) -> Array:
        """Over each row's sigma (n,), lines one after the other."""
        geometry = self.null.plus(effects)
        return np.concatenate([line.residual(geometry, self.null) for line in self.lines]) / self.sigma

    def residual(self, effects: Parameters) -> Array:
        return np.asarray(self.whiten(self.raw(effects))[self.order])

    def picks(self, effects: Parameters) -> Array:
        """[px] (pick, 2), in the order of the rows of the channels 0 and 1."""
        geometry = self.null.plus(effects)
        return np.concatenate([line.picks(geometry, *line.poses(geometry)) for line in self.lines])

    def candidates(self) -> tuple[Candidate, ...]:
        names = [name for name, effect in EFFECTS.items() if effect.stage == "geometry"]
        if self.dem is None:
            names.remove("dem_bias")
        if any(line.line.temperatures is None for line in self.lines):
            names.remove("boresight_thermal_drift")
        camera = self.null.camera
        half = np.hypot(camera.rows, camera.cols) / 2.0
        plausible = dict(PLAUSIBLE)
        plausible["radial_distortion"] = CORNER_PX / half / (half * camera.pixel_pitch / camera.focal_length) ** 2
        return tuple(
            Candidate(
                name,
                {
                    key: Parameter(
                        unit, EFFECTS[name].largest[key], plausible=min(plausible[name], EFFECTS[name].largest[key])
                    )
                    for key, unit in EFFECTS[name].units.items()
                },
            )
            for name in names
        )

    def signatures(self, at: Parameters, of: Sequence[tuple[str, str, float]], whitened: bool = True) -> Array:
        """∂prediction/∂parameter (n, k) by differences of the given steps."""
        residual = self.residual if whitened else self.raw
        columns = []
        for effect, key, step in of:
            ends = [residual(_moved(at, effect, key, sign * step)) for sign in (1.0, -1.0)]
            columns.append((ends[1] - ends[0]) / (2.0 * step))
        return np.stack(columns, -1)

    def steps(self, effects: Sequence[str]) -> list[tuple[str, str, float]]:
        return [
            (c.effect, key, p.difference)
            for c in self.candidates()
            if c.effect in effects
            for key, p in c.parameters.items()
        ]

    def mistaken(self) -> bool:
        """Leave out picks that no combination of effects brings near; whether there were any.

        Where more than a tenth of them are, it is no mistake of picking, and all stay.
        """
        if self.count == 0:
            return False
        pick = self.channel < 2
        if not pick.any():
            return False
        s = self.signatures({}, self.steps([c.effect for c in self.candidates()]), whitened=False)[pick]
        s = s[:, np.any(s != 0.0, axis=0)]
        s = s / np.linalg.norm(s, axis=0)
        r = self.raw({})[pick]
        if r.size < 3 * s.shape[1]:
            return False
        weight = np.ones(r.size)
        for _ in range(20):
            left = r - s @ np.linalg.lstsq(s * weight[:, None], r * weight, rcond=1e-8)[0]
            scale = max(1.4826 * float(np.median(np.abs(left))), 1.0)
            weight = np.sqrt(np.minimum(1.0, (RATHER * scale / np.maximum(np.abs(left), 1e-12)) ** 2))
        bad = np.zeros(self.count, bool)
        bad[np.flatnonzero(pick)[np.abs(left) > GROSS * scale]] = True
        found = [bad[(self.line == i) & pick].reshape(2, -1).any(axis=0) for i in range(len(self.lines))]
        number, all_picks = sum(int(f.sum()) for f in found), sum(f.size for f in found)
        if number == 0 or number > 0.1 * all_picks:
            return False
        for line, f in zip(self.lines, found, strict=True):
            if line.picked is not None and f.any():
                line.picked = line.only(line.picked, ~f) if not f.all() else None
        return True


def _moved(values: Parameters, effect: str, key: str, change: float) -> Parameters:
    own = values.get(effect, {})
    return {**values, effect: {**own, key: own.get(key, 0.0) + change}}


def _growing(time: Array, series: Labels) -> Array:
    """Time with ties inside a series parted, by what no noise notices."""
    out = time.copy()
    for i in range(1, out.size):
        if series[i] == series[i - 1] and out[i] <= out[i - 1]:
            out[i] = out[i - 1] + TIE_S
    return out


def residual_problem(
    lines: Sequence[Line],
    camera: Camera,
    mounting: Mounting,
    dem: Dem | None,
    settings: ResidualSettings | None = None,
    effects: Effects | None = None,
) -> ResidualProblem | None:
    """The problem of all lines together, or None where no line has a control point, a motion or a surveyed height on the DEM.

    `effects` are those that models have by now; those of other stages change nothing here.
    """
    made = _Campaign(lines, camera, mounting, dem, settings or ResidualSettings(), effects or {})
    if made.count == 0:
        return None
    order, blocks = made.order, made.blocks
    names = {
        i * blocks + b: one.line.name + (f", part {b + 1} of {blocks}" if blocks > 1 else "")
        for i, one in enumerate(made.lines)
        for b in range(blocks)
    }
    return ResidualProblem(
        stage="geometry",
        residual=made.residual,
        candidates=made.candidates(),
        group=made.group[order],
        series=made.series[order],
        time=made.time,
        nuisance=np.zeros((order.size, 0)),
        channel=made.channel[order],
        covariates={name: values[order] for name, values in made.covariates.items() if np.nanstd(values) > 0.0},
        unit="sigma",
        group_names=names,
    )


def geometry_residual_px(
    lines: Sequence[Line],
    camera: Camera,
    mounting: Mounting,
    dem: Dem | None,
    found: Parameters,
    settings: ResidualSettings | None = None,
    effects: Effects | None = None,
) -> tuple[float, float]:
    """RMS of control points [px], per coordinate, without `found` and with; NaN where there are none.

    With: each group is predicted by the effects' values as all other groups give them (one Gauss–Newton step from `found`, which
    has seen all), so that no point is held against a fit of its own.
    """
    made = _Campaign(lines, camera, mounting, dem, settings or ResidualSettings(), effects or {})
    if made.count == 0 or not (made.channel < 2).any():
        return float("nan"), float("nan")
    before = float(np.sqrt(np.mean(made.picks({}) ** 2)))
    known = {name: dict(found[name]) for name in found if name in EFFECTS and EFFECTS[name].stage == "geometry"}
    if not known:
        return before, before
    steps = made.steps(list(known))
    s, r = made.signatures(known, steps), made.residual(known)
    length = np.linalg.norm(s, axis=0)
    length[length == 0.0] = 1.0
    group, squares = made.group[made.order], []
    of_pick = np.concatenate([made.group[(made.line == i) & (made.channel == 0)] for i in range(len(made.lines))])
    for one in np.unique(of_pick):
        train = group != one
        change = np.linalg.lstsq((s / length)[train], r[train], rcond=1e-6)[0] / length
        values: Parameters = known
        for (effect, key, _), value in zip(steps, change, strict=True):
            values = _moved(values, effect, key, float(value))
        squares.append(made.picks(values)[of_pick == one].ravel() ** 2)
    return before, float(np.sqrt(np.mean(np.concatenate(squares))))
