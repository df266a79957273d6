"""What the closed loop is offered of the geometry: where points are in the images, how the scene moves, how high it lies.

    r = (1 + U·U')^(−1/2)·D⁻¹·(seen − predicted)

Control points as picked minus the POS' prediction; motion between frames some way apart, as images show it
(`stages.registration.image_motion`), minus that of the ground seen through both poses; surveyed heights minus the DEM's
(`stages.tracking.line_rows`). D is the noise of each. U is what else the residual may hold with nothing missing: errors of the
POS within its own sigmas, the same over a line or over a flight or wandering with the gyros' noise, and what registration and
DEM are biased by (`stages.tracking.pos_errors`).

Functions
---------
residual_problem      of some lines; None where there is nothing to compare
geometry_residual_px  RMS of the control points [px], held out from the estimate of the effects
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.curves import Curves, curves_of
from pipeline.residual_problem import Basis, Candidate, Parameter, Parameters, ResidualProblem
from stages.tracking.curves import COVARIATES, UNITS, Place
from stages.tracking.learned import AXES
from stages.tracking.line_rows import SERIES, Geometry, GeometrySettings, Line, LineRows, Rows, Terrain, chosen
from stages.tracking.pos_errors import whitener
from tsmftis.camera import Camera, Mounting
from tsmftis.effects import EFFECTS, Effects
from tsmftis.inertial import SensorModel

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

HEIGHTS = 6  # channel
GROSS = 6.0  # sigma of a pick that no effect accounts for, and that is taken for a mistake
RATHER = 1.5  # sigma beyond which a pick counts less while mistakes are looked for
MISTAKEN = 0.1  # of the picks, at most
TIE_S = 1e-3  # least step of time where even the usual one is none
LEAST_STEP = 0.25
PLAUSIBLE: Mapping[str, float] = {
    "camera_latency": 2e-3,
    "boresight": 5e-4,
    "boresight_thermal_drift": 5e-5,
    "mount_flexure": 2e-4,
    "focal_length": 2e-3,
    "dem_bias": 1.0,
}
CORNER_PX = 0.5  # by which a plausible distortion moves the corner of the image


class _Campaign:
    """All lines, their rows in series of growing time, whitened."""

    def __init__(
        self,
        lines: Sequence[Line],
        camera: Camera,
        mounting: Mounting,
        dem: Terrain | None,
        settings: GeometrySettings,
        effects: Effects,
        gyro: SensorModel | None,
    ) -> None:
        own = {name: values for name, values in effects.items() if EFFECTS[name].stage == "geometry"}
        self.null, self.dem, self.gyro = Geometry.of(camera, mounting, own), dem, gyro
        self.lines = [LineRows(line, self.null, dem, settings) for line in lines]
        self._lay_out(settings)
        if self.mistaken():
            self._lay_out(settings)

    def _lay_out(self, settings: GeometrySettings) -> None:
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
        self.series = self.line * SERIES + series
        # Surveyed heights follow no clock: in one series, a datum would pass for noise that hardly changes.
        heights = np.flatnonzero(self.channel == HEIGHTS)
        self.series[heights] = len(rows) * SERIES + np.arange(heights.size)
        self.time = _growing(time[self.order], self.series[self.order])
        u = self._shared(rows, n, settings) / sigma[:, None]
        self.whiten = whitener(u)

    def _shared(self, rows: Sequence[Sequence[Rows]], n: int, settings: GeometrySettings) -> Array:
        """Columns (n, m), in the residual's own units, of what many rows share."""
        flights: dict[str, Array] = {}
        columns = []
        for i, (line, own) in enumerate(zip(self.lines, rows, strict=True)):
            mine = np.flatnonzero(self.line == i)
            if not mine.size:
                continue
            for_line, common = line.own(own, self.gyro), line.common(self.gyro)
            columns.append(np.zeros((n, for_line.shape[1])))
            columns[-1][mine] = for_line
            flights.setdefault(line.line.flight, np.zeros((n, common.shape[1])))[mine] = common
        datum = settings.dem_datum_m * (self.channel == HEIGHTS).astype(float)[:, None]
        return np.concatenate([*columns, *flights.values(), datum], axis=1)

    def raw(self, effects: Parameters) -> Array:
        """Over each row's sigma (n,), lines one after the other."""
        geometry = self.null.plus(effects)
        return np.concatenate([line.residual(geometry) for line in self.lines]) / self.sigma

    def residual(self, effects: Parameters) -> Array:
        return np.asarray(self.whiten(self.raw(effects))[self.order])

    def displaced(self, bases: Sequence[Basis], beta: Array) -> Array:
        """[px] (pick, 2) that curves with coefficients (q,), basis after basis, move the picks."""
        picks = int((self.channel == 0).sum())
        out, begun = np.zeros((picks, 2)), 0
        for basis in bases:
            own = beta[begun : begun + basis.columns.shape[1]]
            begun += own.size
            value = np.empty(self.count)
            value[self.order] = basis.values
            for axis, name in enumerate(AXES):
                out[:, axis] += np.interp(value[self.channel == axis], basis.at, basis.curves[name] @ own)
        return out

    def picks(self, effects: Parameters) -> Array:
        """[px] (pick, 2), in the order of the rows of the channels 0 and 1."""
        geometry = self.null.plus(effects)
        return np.concatenate([line.picks(geometry) for line in self.lines])

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

    def covariates(self) -> dict[str, Basis]:
        """Displacements in row and column as curves of time, place in the image, attitude and its rates, temperature, speed."""
        places = [line.places() for line in self.lines]
        every = [p for one in places for p in one]
        if not every:
            return {}
        camera = self.null.camera

        def radial(p: Place) -> Array:
            away = np.stack([p.row - camera.principal_row, p.col - camera.principal_col], -1)
            return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)

        def radius(p: Place) -> Array:
            return np.hypot(p.row - camera.principal_row, p.col - camera.principal_col)

        out = {}
        for name, of in COVARIATES.items():
            curve_of = [curves_of(np.concatenate([of(p)[:, axis] for p in every])) for axis in (0, 1)]
            if any(c is None for c in curve_of):
                continue
            out[name] = self._basis(name, places, of, curve_of, None)
        ring = curves_of(np.concatenate([radius(p) for p in every]), distance=True)
        if ring is not None:
            out["image radius"] = self._basis(
                "image radius", places, lambda p: np.stack([radius(p)] * 2, -1), [ring], radial
            )
        return out

    def _basis(
        self,
        name: str,
        places: Sequence[Sequence[Place]],
        of: Callable[[Place], Array],
        curves: Sequence[Curves | None],
        along: Callable[[Place], Array] | None,
    ) -> Basis:
        """Curves of a covariate (place, 2), for row and column each or for the direction `along`, in the samples."""
        known = [c for c in curves if c is not None]
        k = known[0].count

        def move(p: Place) -> Array:
            x = of(p)
            if along is not None:
                return np.asarray(along(p)[:, :, None] * known[0](x[:, 0])[:, None, :])
            out = np.zeros((len(x), 2, 2 * k))
            for axis in (0, 1):
                out[:, axis, axis * k : (axis + 1) * k] = known[axis](x[:, axis])
            return out

        columns = np.concatenate(
            [line.spread([move(p) for p in one]) for line, one in zip(self.lines, places, strict=True)]
        )
        columns = np.asarray(self.whiten(columns / self.sigma[:, None])[self.order])
        scale = np.sqrt(np.mean(columns**2, axis=0))
        scale[scale == 0.0] = 1.0
        values = np.full(self.count, np.nan)
        for i, one in enumerate(places):
            if self.lines[i].picked is not None:
                mine = np.flatnonzero((self.line == i) & (self.channel < 2))
                values[mine] = of(one[0]).T.ravel()
        at = known[0].table if along is not None or len(known) == 1 else np.union1d(known[0].table, known[1].table)
        if along is not None:
            table = {"radial_px": known[0](at) / scale}
        else:
            wide = [np.zeros((at.size, 2 * k)) for _ in (0, 1)]
            for axis in (0, 1):
                wide[axis][:, axis * k : (axis + 1) * k] = known[axis](at)
            table = {axis: w / scale for axis, w in zip(AXES, wide, strict=True)}
        return Basis(columns / scale, values[self.order], at, table, UNITS[name], dict.fromkeys(table, "px"))

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
        if number == 0 or number > MISTAKEN * all_picks:
            return False
        for line, f in zip(self.lines, found, strict=True):
            if line.picked is not None and f.any():
                line.picked = chosen(line.picked, ~f) if not f.all() else None
        return True


def _moved(values: Parameters, effect: str, key: str, change: float) -> Parameters:
    own = values.get(effect, {})
    return {**values, effect: {**own, key: own.get(key, 0.0) + change}}


def _growing(time: Array, series: Labels) -> Array:
    """Time with no step inside a series under a quarter of the usual one: of two picks in one frame coloured noise without
    a white part would say that they err alike, to the last digit."""
    same = np.diff(series) == 0
    steps = np.where(same, np.diff(time), np.nan)
    out = time.copy()
    least = {one: LEAST_STEP * float(np.nanmedian(steps[series[1:] == one])) for one in np.unique(series[1:][same])}
    for i in np.flatnonzero(same) + 1:
        out[i] = max(out[i], out[i - 1] + max(least[series[i]], TIE_S))
    return out


def residual_problem(
    lines: Sequence[Line],
    camera: Camera,
    mounting: Mounting,
    dem: Terrain | None,
    settings: GeometrySettings | None = None,
    effects: Effects | None = None,
    gyro: SensorModel | None = None,
) -> ResidualProblem | None:
    """The problem of all lines together, or None where no line has a control point, a motion or a surveyed height on the DEM.

    `effects` are those that models have by now; those of other stages change nothing here.
    """
    made = _Campaign(lines, camera, mounting, dem, settings or GeometrySettings(), effects or {}, gyro)
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
        covariates=made.covariates(),
        # Of picks it is declared; of the images' motion it is a guess.
        sigma=np.where(made.channel < 2, 1.0, np.nan)[order],
        drifts=False,
        unit="sigma",
        group_names=names,
    )


def geometry_residual_px(
    lines: Sequence[Line],
    camera: Camera,
    mounting: Mounting,
    dem: Terrain | None,
    found: Parameters,
    settings: GeometrySettings | None = None,
    effects: Effects | None = None,
    gyro: SensorModel | None = None,
    learned: Sequence[str] = (),
) -> tuple[float, float]:
    """RMS of control points [px], per coordinate, without `found` and curves of the `learned` covariates, and with; NaN where
    there are none.

    With: each group is predicted by the effects' values as all other groups give them (one Gauss–Newton step from `found`, which
    has seen all), and by curves fitted to those, so that no point is held against a fit of its own.
    """
    made = _Campaign(lines, camera, mounting, dem, settings or GeometrySettings(), effects or {}, gyro)
    if made.count == 0 or not (made.channel < 2).any():
        return float("nan"), float("nan")
    before = float(np.sqrt(np.mean(made.picks({}) ** 2)))
    known = {name: dict(found[name]) for name in found if name in EFFECTS and EFFECTS[name].stage == "geometry"}
    if not known and not learned:
        return before, before
    covariates = made.covariates() if learned else {}
    steps, bases = made.steps(list(known)), [covariates[name] for name in learned]
    r = made.residual(known)
    s = made.signatures(known, steps) if steps else np.zeros((r.size, 0))
    length = np.linalg.norm(s, axis=0)
    length[length == 0.0] = 1.0
    columns = np.column_stack([s / length, *(b.columns for b in bases)])
    group, squares = made.group[made.order], []
    of_pick = np.concatenate([made.group[(made.line == i) & (made.channel == 0)] for i in range(len(made.lines))])
    for one in np.unique(of_pick):
        train = group != one
        beta = _ridged(columns[train], _ridge(columns[train], len(steps), r[train]), r[train])
        values: Parameters = known
        for (effect, key, _), value in zip(steps, beta[: len(steps)] / length, strict=True):
            values = _moved(values, effect, key, float(value))
        left = made.picks(values) - made.displaced(bases, beta[len(steps) :])
        squares.append(left[of_pick == one].ravel() ** 2)
    return before, float(np.sqrt(np.mean(np.concatenate(squares))))


def _ridged(columns: Array, ridge: Array, y: Array) -> Array:
    """argmin |y − C·β|² + Σ ridge²·β² (q,)."""
    both = np.vstack([columns, np.diag(ridge)])
    return np.asarray(np.linalg.lstsq(both, np.append(y, np.zeros(ridge.size)), rcond=1e-6)[0])


def _ridge(columns: Array, free: int, y: Array) -> Array:
    """1/τ (q,) of columns beyond the first `free`, whose coefficients are N(0, τ²), by themselves; zero for the others."""
    ridge = np.zeros(columns.shape[1])
    for _ in range(3):
        beta = _ridged(columns, ridge, y)[free:]
        ridge[free:] = 1.0 / max(float(np.sqrt(np.mean(beta**2))), 1e-9) if beta.size else 0.0
    return ridge
