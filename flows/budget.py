"""The error budget of a campaign: each part switched off or perturbed by its sigma, and what tracks and spectra say to it.

Tracks of all variants of a line are stacked as methods of one record and reconstructed in one pass over the frames, with the
phase of the base. What a perturbation is and how results are compared stands in `stages.budget`; here is what runs when.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from flows.settings import Settings
from flows.steps import Paths, Plan, navigation_step
from pipeline.errors import InputError, StageError, TsmftisError
from pipeline.raster import Dem, from_crs
from pipeline.records import (
    Calibration,
    CameraPoses,
    Frames,
    Gcps,
    Interferograms,
    References,
    Spectra,
    Targets,
    Tracks,
    Trajectory,
)
from pipeline.report.budget import write_budget_page
from pipeline.run_stage import StageRecord, run_stage, write_json
from pipeline.truth import TruePoses, read_true_poses, true_poses_file
from stages import budget, mapping, reconstruction, tracking
from stages.budget import Comparison, Control, Part, Variant
from tsmftis.camera import Camera, Mounting
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]

SCHEMA = "tsmftis-budget/1"
OUTPUTS = {"json": "budget.json", "csv": "budget.csv", "page": "budget.html"}
UNCOMPENSATED = ".budget/uncompensated"
MARGIN_S = 1.0  # trajectory kept about a line
MOST_VALUES = 60_000_000  # of a stack of tracks: beyond it variants go in batches
BETWEEN = "between-frames"  # the extraction whose noise of a difference is known
MAP_CELLS = (40, 12)  # along and across, that stand for the map
MAP_FRAMES = 1200
TOO_MUCH = 1.2  # times the error: more noise than that cannot be
FEW, MOST = 3, 0.6  # so few targets that hold more than this part of what is left are named

THERMAL = "thermal compensation off"
TRUTH = "true poses instead"
NAVIGATION = "navigation, its σ"
WANDER = "gyro noise in a pass"
BORESIGHT = "boresight σ"
LATENCY = "latency σ"
HEIGHT = "target height σ"
TERRAIN = "terrain model off"
EXTRACTION = "other extraction"
PARTS = (THERMAL, TRUTH, NAVIGATION, WANDER, BORESIGHT, LATENCY, HEIGHT, TERRAIN, EXTRACTION)


@dataclass(frozen=True)
class World:
    """What all lines share: the declared instrument, its calibration, the settings."""

    camera: Camera
    mounting: Mounting
    interferometer: Interferometer
    calibration: Calibration
    references: References | None
    angle_random_walk: float
    pixel: tuple[float, float]
    settings: Settings


@dataclass(frozen=True)
class Line:
    """One line's records; trajectories cut to it. `uncompensated`, `truth`, `gcps` may be missing."""

    unit: str
    frames: Frames
    targets: Targets
    gcps: Gcps | None
    trajectory: Trajectory
    uncompensated: Trajectory | None
    truth: TruePoses | None

    @property
    def middle(self) -> float:
        return float(self.frames.time[[0, -1]].mean())

    def sigma(self, name: str) -> Array:
        """The trajectory's own `sigma_position` [m] or `sigma_attitude` [rad] (3,) in the middle of the line."""
        values = getattr(self.trajectory, name)
        return np.array([np.interp(self.middle, self.trajectory.time, values[:, i]) for i in range(3)])


def lines_of(plan: Plan) -> list[tuple[str, str]]:
    """Flight and line of all lines that the plan wants; InputError where there are none."""
    found = [(f.id, entry.id) for f in plan.opened.keys.flights for entry in f.lines if plan.wants(f.id, entry.id)]
    if not found:
        raise InputError(
            plan.campaign / "campaign.yaml",
            "flights[].lines",
            "there is no line",
            "an error budget is made of targets on frames: give a campaign with lines",
        )
    return found


def budget_step(plan: Plan, truth: Path | None) -> StageRecord:
    """After a run of the campaign into the plan's folder: budget.json, budget.csv and budget.html, cached as a stage."""
    campaign, units = plan.opened, lines_of(plan)
    without = {flight: _uncompensated(plan, flight) for flight in dict.fromkeys(flight for flight, _ in units)}
    inputs = {"instrument": campaign.path(campaign.keys.instrument)}
    inputs |= {k: campaign.path(v) for k in ("calibration", "references", "dem") if (v := getattr(campaign.keys, k))}
    poses = {line: true_poses_file(truth, line) if truth is not None else None for _, line in units}
    for flight, line in units:
        entry = campaign.line(flight, line)
        inputs[f"{flight}/trajectory"] = plan.out / flight / "trajectory.nc"
        inputs |= {f"{flight}/{line}/{k}": plan.out / flight / line / f"{k}.nc" for k in ("spectra", "interferograms")}
        files = {"frames": entry.frames, "targets": entry.targets, "gcps": entry.gcps}
        inputs |= {f"{flight}/{line}/{k}": campaign.path(v) for k, v in files.items() if v is not None}
        if (path := poses[line]) is not None:
            inputs[f"{flight}/{line}/truth"] = path
    inputs |= {f"{flight}/uncompensated": path for flight, path in without.items() if isinstance(path, Path)}

    def work(to: Paths) -> dict[str, Any]:
        with threadpool_limits(limits=1):
            content = _content(plan, [_line(plan, f, i, without[f], poses[i]) for f, i in units], without)
        write_json(to["json"], content)
        _write_csv(content, to["csv"])
        write_budget_page(content, to["page"])
        return {"lines": content["lines"]}

    return run_stage(
        plan.out,
        "budget",
        "campaign",
        ("stages.budget", "stages.tracking", "stages.reconstruction", "stages.mapping", "pipeline.report.budget"),
        {
            "settings": plan.settings.model_dump(mode="json"),
            "units": units,
            "without": {k: v if isinstance(v, str) else None for k, v in without.items()},
        },
        inputs,
        OUTPUTS,
        work,
    )


def _uncompensated(plan: Plan, flight: str) -> Path | str:
    """The trajectory without thermal correction, or why there is none."""
    if plan.opened.keys.thermal is None:
        return "the campaign has no chamber run, so nothing was compensated"
    if plan.settings.thermal.method == "none":
        return "thermal.method is none in these settings already"
    if plan.opened.imu(flight).temperatures is None:
        return f"the inertial data of flight {flight} have no temperatures, so nothing was compensated"
    thermal = plan.settings.thermal.model_copy(update={"method": "none"})
    other = replace(plan, out=plan.out / UNCOMPENSATED, settings=plan.settings.model_copy(update={"thermal": thermal}))
    other.out.mkdir(parents=True, exist_ok=True)
    navigation_step(other, flight)
    return other.out / flight / "trajectory.nc"


def _line(plan: Plan, flight: str, line: str, without: Path | str, truth: Path | None) -> Line:
    campaign = plan.opened
    frames = campaign.frames(flight, line)

    def cut(path: Path) -> Trajectory:
        return Trajectory.from_file(path).between(frames.time[0] - MARGIN_S, frames.time[-1] + MARGIN_S)

    return Line(
        f"{flight}/{line}",
        frames,
        campaign.targets(flight, line),
        campaign.gcps(flight, line),
        cut(plan.out / flight / "trajectory.nc"),
        cut(without) if isinstance(without, Path) else None,
        read_true_poses(truth, frames.time.size) if truth is not None else None,
    )


def _content(plan: Plan, lines: list[Line], without: dict[str, Path | str]) -> dict[str, Any]:
    """The content of budget.json."""
    campaign = plan.opened
    instrument = campaign.instrument
    assert instrument.camera and instrument.mounting and instrument.interferometer and instrument.imu
    pixel, noise_note = _pixel_noise(plan, [line.unit for line in lines])
    world = World(
        instrument.camera,
        instrument.mounting,
        instrument.interferometer,
        campaign.calibration(),
        campaign.references() if campaign.keys.references is not None else None,
        instrument.imu.gyro.white_noise,
        pixel,
        plan.settings,
    )
    control = _control(lines, world)
    parts = {part.name: part for part in _parts(lines, world, control, without)}
    comparisons: list[Comparison] = []
    terrain: list[Array | str] = []
    dem = None if campaign.keys.dem is None else Dem.from_file(campaign.path(campaign.keys.dem))
    for number, line in enumerate(lines):
        base = _track(line, world)
        variants = _variants(line, number, world, control)
        comparisons.append(_compared(line, base.tracks.only("tracking"), variants, world))
        terrain.append(_terrain(line, base.poses, dem, world))
        other = _other_extraction(line, base.tracks.only("tracking"), world)
        if isinstance(other, str):
            parts[EXTRACTION] = replace(parts[EXTRACTION], cannot_tell=other)
        else:
            comparisons.append(other)
    parts[TERRAIN] = _with_terrain(parts[TERRAIN], terrain)
    result = budget.run([parts[name] for name in PARTS], comparisons)
    return {
        "schema": SCHEMA,
        "campaign": campaign.keys.name,
        "lines": [line.unit for line in lines],
        "rows": result.rows,
        "total": result.total,
        "control": None if isinstance(control, str) else _control_figures(control),
        "settings": plan.settings.budget.model_dump(mode="json"),
        "notes": [*_notes(world, control, comparisons), *noise_note, *_left_notes(result.total)],
    }


def _pixel_noise(plan: Plan, units: Sequence[str]) -> tuple[tuple[float, float], list[str]]:
    """read² [DN²] and gain [DN] of the least noisy line of the base run, and what to say where the lines do not agree."""
    models, signal = [], []
    for unit in units:
        attributes = Spectra.from_file(plan.out / unit / "spectra.nc").attributes
        models.append((float(attributes["read_variance_dn2"]), float(attributes["gain_dn"])))
        record = Interferograms.from_file(plan.out / unit / "interferograms.nc")
        value = record.value[record.methods.index("tracking")]
        signal.append(value[record.seen[record.methods.index("tracking")] > 0].mean(axis=-1))
    levels = np.concatenate(signal)
    best = budget.least_noise(models, levels)
    mean = [float((read + gain * np.maximum(levels, 0.0)).mean()) for read, gain in models]
    noisier = [
        f"{unit} {np.sqrt(m / mean[best]):.2f}" for unit, m in zip(units, mean, strict=True) if m > 1.2 * mean[best]
    ]
    said = (
        f"Noise is that of the least noisy line, {units[best]} (read noise {np.sqrt(models[best][0]):.1f} DN, "
        f"{models[best][1]:.2f} DN of variance a DN of signal); times its σ by their own estimate: {', '.join(noisier)}. Where "
        "they differ by much, more than noise is in the larger one."
    )
    return models[best], [said] if noisier else []


# --- tracks of variants -----------------------------------------------------------------------------------------------


def _track(
    line: Line,
    world: World,
    trajectory: Trajectory | None = None,
    targets: Targets | None = None,
    rpy: Array | None = None,
    latency: float = 0.0,
    truth: TruePoses | None = None,
) -> tracking.TrackingResult:
    """Tracking of a line with what is given in place of its own; rpy [rad] and latency [s] are added."""
    return tracking.run(
        trajectory or line.trajectory,
        line.frames.time,
        targets or line.targets,
        budget.later(world.camera, latency),
        budget.turned(world.mounting, np.zeros(3) if rpy is None else rpy),
        world.settings.tracking,
        truth,
    )


def _variants(line: Line, number: int, world: World, control: Control | str) -> dict[Variant, Tracks]:
    """Tracks of every variant that this line can have; `number` is the line's, for the draws."""
    settings = world.settings.budget
    out: dict[Variant, Tracks] = {}

    def add(part: str, direction: int, sample: int, **changed: Any) -> None:
        out[Variant(part, direction, sample)] = _track(line, world, **changed).tracks.only("tracking")

    if line.uncompensated is not None:
        add(THERMAL, 0, 0, trajectory=line.uncompensated)
    if line.truth is not None:
        out[Variant(TRUTH)] = _track(line, world, truth=line.truth).tracks.only("true")
    position, attitude = line.sigma("sigma_position"), line.sigma("sigma_attitude")
    for draw in range(settings.draws):
        rng = np.random.default_rng([settings.seed, number, draw])
        error = rng.standard_normal((2, 3)) * [position, attitude]
        add(NAVIGATION, 0, draw, trajectory=budget.displaced(line.trajectory, *error))
        walk = budget.random_walk(line.trajectory.time, world.angle_random_walk, rng)
        add(WANDER, 0, draw, trajectory=budget.displaced(line.trajectory, np.zeros(3), walk))
    angles, latency = _alignment(world, control)
    for sample, sign in enumerate((1.0, -1.0)):
        for direction, rpy in enumerate(angles):
            add(BORESIGHT, direction, sample, rpy=sign * rpy)
        add(LATENCY, 0, sample, latency=sign * latency)
        add(HEIGHT, 0, sample, targets=budget.raised(line.targets, sign * settings.target_height_sigma_m))
    return out


def _alignment(world: World, control: Control | str) -> tuple[Array, float]:
    """Boresight errors (3, 3) [rad], one a row, along the principal directions of their covariance, and the latency's σ [s]."""
    if isinstance(control, str):
        settings = world.settings.budget
        return np.eye(3) * np.deg2rad(settings.boresight_sigma_deg), 1e-3 * settings.latency_sigma_ms
    variance, direction = np.linalg.eigh(control.covariance[:3, :3])
    return np.asarray((direction * np.sqrt(np.maximum(variance, 0.0))).T), float(control.sigma[3])


def _control(lines: Sequence[Line], world: World) -> Control | str:
    """Boresight and latency from the GCPs of all lines, or why they cannot be had."""
    usable = [(line, line.gcps) for line in lines if line.gcps is not None and line.gcps.frame.size]
    if not usable:
        return "there are no ground control points"

    def predict(p: Array) -> Array:
        found = []
        for line, gcps in usable:
            result = _track(line, world, targets=budget.as_targets(gcps), rpy=p[:3], latency=float(p[3]))
            t = result.tracks.only("tracking")
            at = np.arange(gcps.frame.size), Tracks.CENTRE, gcps.frame
            found.append(np.stack([t.row[0][at], t.col[0][at]], axis=1))
        return np.concatenate(found)

    picked = np.concatenate([np.stack([g.row, g.col], axis=1) for _, g in usable])
    try:
        return budget.fit_control(predict, picked, np.concatenate([g.sigma for _, g in usable]))
    except (ValueError, TsmftisError) as error:
        return f"the ground control points do not tell: {error}"


# --- from tracks to comparisons ---------------------------------------------------------------------------------------


def _reconstructed(line: Line, tracks: Tracks, world: World, **changed: Any) -> reconstruction.ReconstructionResult:
    return reconstruction.run(
        line.frames,
        tracks,
        line.targets,
        world.calibration,
        world.references,
        world.camera,
        world.interferometer,
        world.settings.reconstruction.model_copy(update=changed),
    )


def _compared(line: Line, base: Tracks, variants: dict[Variant, Tracks], world: World) -> Comparison:
    """Reconstruct base and variants together, in batches that memory holds, each led by the base."""
    breaks = [start for start, _ in line.frames.segments()[1:]]
    batch = max(1, MOST_VALUES // base.row.size - 1)
    between = getattr(world.settings.reconstruction, "extraction", BETWEEN) == BETWEEN
    found = []
    names = tuple(variants)
    for some in (names[i : i + batch] for i in range(0, len(names), batch)):
        stacked = _stacked(base, {f"{v.part} {v.direction} {v.sample}": variants[v] for v in some})
        result = _reconstructed(line, stacked, world)
        found.append(
            budget.compare(
                line.unit,
                some,
                stacked,
                result.spectra,
                result.interferograms if between else None,
                world.pixel,
                breaks,
                world.calibration,
                world.camera,
                world.interferometer,
            )
        )
    return reduce(Comparison.joined, found)


def _stacked(base: Tracks, others: Mapping[str, Tracks]) -> Tracks:
    """The base, named `tracking`, and others by name as methods of one record, in this order."""
    return Tracks(
        (*base.methods, *others),
        base.targets,
        np.concatenate([base.row, *(tracks.row for tracks in others.values())]),
        np.concatenate([base.col, *(tracks.col for tracks in others.values())]),
    )


def _other_extraction(line: Line, base: Tracks, world: World) -> Comparison | str:
    """The base extracted the other way against the base, or why it cannot be."""
    said, changed = _other(world)
    if not changed:
        return said
    try:
        two = [
            _reconstructed(line, base, world).spectra,
            _reconstructed(line, base, world, **changed).spectra,
        ]
    except StageError as error:
        return f"{said}, on {line.unit}: {error}"
    stacked = replace(
        two[0],
        methods=("tracking", "other"),
        points=np.concatenate([s.points for s in two]),
        radiance=np.concatenate([s.radiance for s in two]),
        sigma_radiance=np.concatenate([s.sigma_radiance for s in two]),
        radiance_area=np.concatenate([s.radiance_area for s in two]),
        sigma_radiance_area=np.concatenate([s.sigma_radiance_area for s in two]),
    )
    twice = _stacked(base, {"other": base})
    return budget.compare(
        line.unit,
        (Variant(EXTRACTION),),
        twice,
        stacked,
        None,
        world.pixel,
        [],
        world.calibration,
        world.camera,
        world.interferometer,
    )


def _other(world: World) -> tuple[str, dict[str, str]]:
    """The extraction that is not the base's, in words and as a change of settings; none where there is but one."""
    settings = world.settings.reconstruction
    field = type(settings).model_fields.get("extraction")
    used = getattr(settings, "extraction", BETWEEN)
    others = [choice for choice in get_args(field.annotation) if choice != used] if field else []
    if not others:
        return "the reconstruction knows one extraction only", {}
    return f"{others[0]} instead of {used}", {"extraction": others[0]}


def _terrain(line: Line, poses: CameraPoses, dem: Dem | None, world: World) -> Array | str:
    """Mean squares (4,) [px²] of map cells on a flat surface at the targets' mean height, or why there are none."""
    if dem is None:
        return "the campaign has no terrain model: its maps are flat already"
    try:
        heights, ground = mapping.surface(line.targets, dem)
        grid = mapping.line_grid(poses, world.camera, ground, world.settings.mapping)
    except StageError as error:
        return str(error)
    along, across = (
        np.unique(np.linspace(0, n - 1, k).round().astype(int)) for n, k in zip(grid.shape, MAP_CELLS, strict=True)
    )
    centres = [grid.centres(i, i + 1) for i in along]
    x, y = (np.concatenate([c[k][0, across] for c in centres]) for k in (0, 1))
    latitude, longitude = from_crs(grid.crs, x, y)
    _, flat = mapping.surface(line.targets, None)
    step = max(1, poses.time.size // MAP_FRAMES)
    thinned = CameraPoses(poses.time[::step], poses.centre[::step], poses.dcm[::step])
    found = budget.terrain_displacement(thinned, world.camera, latitude, longitude, heights(latitude, longitude), flat)
    return found if np.isfinite(found).all() else "no cell of the map is on the detector"


def _with_terrain(part: Part, found: Sequence[Array | str]) -> Part:
    known = [f for f in found if not isinstance(f, str)]
    if not known:
        return replace(part, cannot_tell=next(f for f in found if isinstance(f, str)))
    return replace(part, pixels=np.mean(known, axis=0))


# --- words ------------------------------------------------------------------------------------------------------------


def _parts(lines: Sequence[Line], world: World, control: Control | str, without: dict[str, Path | str]) -> list[Part]:
    """The rows to be, in words; those of which nothing can be told say why."""
    settings = world.settings.budget
    position = np.sqrt(np.mean([line.sigma("sigma_position") ** 2 for line in lines], axis=0))
    attitude = np.rad2deg(np.sqrt(np.mean([line.sigma("sigma_attitude") ** 2 for line in lines], axis=0)))
    walk = np.rad2deg(world.angle_random_walk) * 60.0
    if isinstance(control, str):
        angles, late = np.full(3, settings.boresight_sigma_deg), settings.latency_sigma_ms
        source = f"assumed, since {control}"
    else:
        angles, late = np.rad2deg(control.sigma[:3]), 1e3 * control.sigma[3]
        source = f"from {control.points} ground control points, χ²/ν = {control.chi2 / control.freedom:.2f}"
    compensated = any(line.uncompensated is not None for line in lines)
    true = any(line.truth is not None for line in lines)
    return [
        Part(
            THERMAL,
            "navigation again without thermal correction of the inertial data",
            cannot_tell=None if compensated else next(v for v in without.values() if isinstance(v, str)),
        ),
        Part(
            TRUTH,
            "tracks by the true poses: the navigation's actual errors, where the next two rows have what it believes of them",
            cannot_tell=None if true else "no true poses are given (--truth)",
        ),
        Part(
            NAVIGATION,
            f"{settings.draws} draws a line of constant errors by the trajectory's own σ: {_list(position, 'm')} north, east, "
            f"down; {_list(attitude, '°')} roll, pitch, yaw",
            adds=True,
        ),
        Part(
            WANDER,
            f"{settings.draws} draws of an attitude that wanders with the gyros' angle random walk, {walk:.3g} °/√h, less its "
            "mean over the line",
            adds=True,
        ),
        Part(BORESIGHT, f"± σ of {_list(angles, '°')} roll, pitch, yaw ({source})", adds=True),
        Part(LATENCY, f"± σ of {late:.3g} ms ({source})", adds=True),
        Part(HEIGHT, f"± σ of {settings.target_height_sigma_m:g} m (assumed) on the targets' heights", adds=True),
        Part(
            TERRAIN,
            "map cells on a flat surface at the targets' mean height; targets keep their surveyed heights, so their spectra do "
            "not change",
        ),
        Part(EXTRACTION, f"{_other(world)[0]}; the noise of both is taken off, as if they shared no pixel"),
    ]


def _list(values: Array, unit: str) -> str:
    return ", ".join(f"{v:.2g}" for v in values) + f" {unit}"


def _control_figures(control: Control) -> dict[str, Any]:
    """What the GCPs say of boresight and latency, as a fit beside the declared values."""
    deg = np.rad2deg
    return {
        "points": control.points,
        "chi2_over_freedom": control.chi2 / control.freedom,
        "boresight_deg": dict(zip(("roll", "pitch", "yaw"), deg(control.value[:3]).tolist(), strict=True)),
        "boresight_sigma_deg": dict(zip(("roll", "pitch", "yaw"), deg(control.sigma[:3]).tolist(), strict=True)),
        "latency_ms": 1e3 * float(control.value[3]),
        "latency_sigma_ms": 1e3 * float(control.sigma[3]),
        "pitch_latency_correlation": control.pitch_latency_correlation,
    }


def _notes(world: World, control: Control | str, comparisons: Sequence[Comparison]) -> list[str]:
    """What a reader must know beside the table."""
    said = [
        "Share: ‖B′ − B‖/‖B_ref‖ in rms over the targets, with what the noise of other pixels makes of it taken off; shares and "
        "noise add in quadrature. < marks a share that is not told from noise (two standard deviations of it by chance, and a "
        "tenth of its variance not known): it is at most that.",
        "A constant error of the attitude in one line does the same to tracks and to ground control points as a boresight: rows "
        "navigation and boresight may hold the same error twice.",
    ]
    if not isinstance(control, str):
        names = ("boresight roll", "boresight pitch", "boresight yaw", "latency")
        scale = [*np.rad2deg([1.0, 1.0, 1.0]), 1e3]
        said += [
            f"The ground control points want {v * k:.3g} ± {s * k:.2g} {u} added to the {name}: more than three σ, so it, or the "
            "attitude of these lines, is off."
            for name, v, s, k, u in zip(names, control.value, control.sigma, scale, ("°", "°", "°", "ms"), strict=True)
            if abs(v) > 3.0 * s
        ]
        said.append(
            f"Boresight pitch and latency correlate by {control.pitch_latency_correlation:.2f} in that fit: only jitter tells "
            "them apart."
        )
    seen = {c.line: c for c in comparisons}
    missing = [
        f"{c.line}/{t}" for c in seen.values() for t, v in zip(c.targets, c.noise[0, :, 0], strict=True) if np.isnan(v)
    ]
    if missing:
        said.append(f"Not seen well enough for spectra: {', '.join(missing)}.")
    if world.references is None:
        said.append("There are no reference spectra: no RQE, and shares are relative to the spectra themselves.")
    return said


def _left_notes(total: dict[str, Any]) -> list[str]:
    """Which targets hold most of what noise does not explain, where a few do."""
    said = []
    for kind, words in (("point", "one point"), ("area", "area means")):
        each = total[kind]["targets"]
        if each and total[kind]["noise_rms"] > TOO_MUCH * total[kind]["rqe_rms"]:
            said.append(
                f"The noise that is foretold for {words} is more than the whole error: texture of the scene counts as noise in "
                "every line, for instance since the tracks are off. Then shares are too small, and what is left tells nothing."
            )
        left = {name: max(v["rqe"] ** 2 - v["noise"] ** 2, 0.0) for name, v in each.items()}
        worst = sorted(left, key=lambda name: -left[name])[:FEW]
        held = sum(left[name] for name in worst) / (sum(left.values()) or 1.0)
        if total[kind]["left_rms"] is not None and held > MOST and len(each) > 2 * FEW:
            figures = ", ".join(f"{name} {each[name]['rqe']:.4f} ({each[name]['noise']:.4f})" for name in worst)
            said.append(
                f"Of what noise does not explain of {words}, {100 * held:.0f} % is in {len(worst)} of {len(each)} targets, RQE "
                f"(by noise alone): {figures}."
            )
    return said


def _write_csv(content: dict[str, Any], path: Path) -> None:
    """The table, one line a row; what is not known is empty."""
    kinds = (
        "share",
        "share_upper",
        "change_rms",
        "noise_in_change_rms",
        "rqe",
        "rqe_change",
        "standard_error",
        "targets",
    )
    pixels = ("row", "col", "row_varying", "col_varying")
    header = ["part", *(f"{p}_rms_px" for p in pixels), *(f"{kind}_{k}" for kind in ("point", "area") for k in kinds)]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*header, "adds", "done", "cannot_tell"])
        for row in content["rows"]:
            values = [row["pixels_rms"][p] for p in pixels] + [
                row[kind][k] for kind in ("point", "area") for k in kinds
            ]
            writer.writerow(
                [
                    row["part"],
                    *("" if v is None else f"{v:.6g}" for v in values),
                    row["adds"],
                    row["done"],
                    row["cannot_tell"],
                ]
            )
        for name in ("noise", "parts", "explained", "rqe", "left"):
            writer.writerow(_total_line(name, content["total"], kinds))


def _total_line(name: str, total: dict[str, Any], kinds: Sequence[str]) -> list[str]:
    """A line of the sum in the same columns: its rms as a share."""
    cells: list[str] = [f"{name} (rms)", "", "", "", ""]
    for kind in ("point", "area"):
        figures = {"share": total[kind][f"{name}_rms"], "targets": len(total[kind]["targets"])}
        if name == "left":
            figures["share_upper"] = total[kind]["left_upper"]
        if name in ("rqe", "noise"):
            figures["rqe"] = total[kind][name]
        cells += ["" if figures.get(k) is None else f"{figures[k]:.6g}" for k in kinds]
    return [*cells, "", "", ""]
