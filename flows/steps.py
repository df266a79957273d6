"""Each stage as a cached step on files: what it reads, what it writes, which settings it hangs on.

A step is ten lines around `stages.<name>.run`: records in from files, records out to files, `pipeline.run_stage` deciding
whether it has to run at all. No science here, and no Prefect: `flows.campaign` wraps steps as tasks.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from flows.settings import Settings
from pipeline.campaign import Campaign, read_campaign
from pipeline.datasets import open_dataset, write_dataset
from pipeline.errors import InputError
from pipeline.formats import sbet, smrmsg
from pipeline.formats.table import write_csv
from pipeline.model_update import Effects, ModelUpdate
from pipeline.raster import CubeGrid, Dem, write_cube
from pipeline.records import CameraPoses, Spectra, Tracks, Trajectory
from pipeline.run_stage import StageRecord, run_stage, write_json
from pipeline.truth import read_true_poses, true_poses_file
from stages import bench as bench_stage
from stages import mapping, navigation, reconstruction, registration, scoring, thermal, tracking
from tsmftis import __version__
from tsmftis.effects import EFFECTS
from tsmftis.fourier import SCORED_APODIZATION, line_width, rqe, smooth_phase

# Each stage and the stages whose results it reads, in the order in which a reader should meet them.
NEEDS: Mapping[str, tuple[str, ...]] = {
    "thermal": (),
    "navigation": ("thermal",),
    "tracking": ("navigation",),
    "registration": ("tracking",),
    "reconstruction": ("registration",),
    "mapping": ("tracking", "reconstruction"),
    "scoring": ("reconstruction",),
    "bench": (),
}
STAGES = tuple(NEEDS)


def reaches(stage: str, later: str) -> bool:
    """Whether `later` is `stage` or hangs on its result."""
    return stage == later or any(reaches(stage, before) for before in NEEDS[later])


Paths = Mapping[str, Path]


@dataclass(frozen=True)
class Plan:
    """What a run is about: plain data, handed to every task."""

    campaign: Path
    out: Path
    settings: Settings = field(default_factory=Settings)
    start: str | None = None  # --from: this stage and those after it run again
    only: str | None = None  # --only: this stage alone
    lines: tuple[str, ...] = ()  # --line: LINE or FLIGHT/LINE; empty: all
    update: ModelUpdate = field(default_factory=ModelUpdate)  # --model-update: what the declared models lack
    truth: Path | None = None  # --truth: folder with true poses, of which the method `true` is made

    @cached_property
    def opened(self) -> Campaign:
        return read_campaign(self.campaign)

    def effects(self, *stages: str) -> Effects:
        """The update's effects on the models of these stages, as `tsmftis.effects` names them."""
        return {name: v for name, v in self.update.effects.items() if EFFECTS[name].stage in stages}

    def bench_effects(self, bench: str) -> Effects:
        """Those on a laboratory interferogram: its own where the update names it, else those of the instrument."""
        own = self.update.bench.get(bench)
        return self.effects("spectral") if own is None else own

    def wants(self, flight: str, line: str) -> bool:
        return not self.lines or line in self.lines or f"{flight}/{line}" in self.lines

    def does(self, stage: str) -> bool:
        """Whether a stage is looked at: with --only, the stages up to that one, and only it may run."""
        return self.only is None or reaches(stage, self.only)

    def switches(self, stage: str) -> dict[str, bool]:
        if self.only is not None:
            return {"force": stage == self.only, "forbid": stage != self.only}
        return {"force": self.start is not None and reaches(self.start, stage), "forbid": False}


def plain(value: Any) -> Any:
    """Parameters and figures as JSON data."""
    if hasattr(value, "__dataclass_fields__"):
        return {n: plain(getattr(value, n)) for n in value.__dataclass_fields__}
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def thermal_step(plan: Plan) -> StageRecord:
    """Chamber runs → thermal_model.nc, thermal_figures.json; the verification is the summary."""
    campaign = plan.opened
    keys = campaign.keys.thermal
    assert keys is not None
    names = [*keys.train, *keys.verify]

    def work(to: Paths) -> dict[str, Any]:
        train, verify = ([campaign.chamber(n) for n in part] for part in (keys.train, keys.verify))
        result = thermal.run(train, verify, plan.settings.thermal, turn_on(campaign), plan.effects("thermal"))
        write_dataset(result.model.to_dataset(), to["model"])
        write_json(to["figures"], plain(result.figures))
        return {"verify": result.verification, "notes": list(result.notes)}

    return run_stage(
        plan.out,
        "thermal",
        "campaign",
        ("stages.thermal",),
        {
            "settings": plain(plan.settings.thermal),
            "train": list(keys.train),
            "verify": list(keys.verify),
            "turn_on": plain(turn_on(campaign)),
            "effects": plan.effects("thermal"),
        },
        {n: campaign.path(n) for n in names},
        {"model": "thermal_model.nc", "figures": "thermal_figures.json"},
        work,
        **plan.switches("thermal"),
    )


def navigation_step(plan: Plan, flight: str) -> StageRecord:
    """IMU, GNSS and the thermal model → trajectory.nc, trajectory.sbet, navigation.json (and thermal.nc, the correction)."""
    campaign = plan.opened
    entry, instrument = campaign.flight(flight), campaign.instrument
    model = plan.out / "thermal_model.nc"
    inputs = {"imu": campaign.path(entry.imu), "gnss": campaign.path(entry.gnss)}
    outputs = {
        "trajectory": f"{flight}/trajectory.nc",
        "sbet": f"{flight}/trajectory.sbet",
        "smrmsg": f"{flight}/trajectory.smrmsg",
        "figures": f"{flight}/navigation.json",
    }
    about = {
        "title": f"smoothed trajectory of flight {flight}",
        "campaign": campaign.keys.name,
        "epoch": campaign.keys.time.epoch,
        "time_scale": campaign.keys.time.scale,
        "source": f"tsmftis {__version__}",
    }
    if update := plan.effects("navigation"):
        about["model_update"] = json.dumps(update, sort_keys=True)
    if lag := plan.update.velocity_lag(flight):
        about["velocity_lag_s"] = f"{lag:.6g}"
    method = plan.settings.thermal.method
    if compensated := compensation(plan, flight) != "none":
        inputs["model"] = needed(model, "thermal")
        outputs["correction"] = f"{flight}/thermal.nc"

    def work(to: Paths) -> dict[str, Any]:
        imu = campaign.imu(flight)
        known = thermal.ThermalModel.from_file(model) if compensated else None
        correction = None
        if known is not None and imu.temperatures is not None:
            correction = known.correction(imu.temperatures, method, of=imu.time, where=inputs["imu"])
        assert instrument.imu is not None and instrument.mounting is not None
        with naming(gnss=inputs["gnss"], imu=inputs["imu"], **{"campaign.yaml": campaign.root / "campaign.yaml"}):
            result = navigation.run(
                imu,
                campaign.gnss(flight),
                instrument.imu,
                instrument.mounting,
                plan.settings.navigation,
                initial=initial_attitude(campaign, flight),
                correction=correction,
                effects=plan.effects("navigation"),
                velocity_lag=plan.update.velocity_lag(flight),
            )
        if correction is not None:
            write_dataset(correction.to_dataset(), to["correction"])
        write_dataset(result.trajectory.to_dataset().assign_attrs(about), to["trajectory"])
        sbet.write_sbet(sbet.from_trajectory(result.trajectory), to["sbet"])
        smrmsg.write_smrmsg(smrmsg.from_trajectory(result.trajectory), to["smrmsg"])
        write_json(to["figures"], {"quality": result.quality, "figures": result.figures})
        if known is None or correction is None:
            told = [] if imu.compensated_by is None else [f"compensated already, by {imu.compensated_by}: not again"]
            return result.quality | {"compensated": False, "warnings": [*result.quality["warnings"], *told]}
        warnings = [*result.quality["warnings"], *known.doubts, *correction.warnings]
        return result.quality | {"compensated": True, "warnings": warnings} | correction.reach

    return run_stage(
        plan.out,
        "navigation",
        flight,
        ("stages.navigation", "stages.thermal", "pipeline.formats.sbet", "pipeline.formats.smrmsg"),
        {
            "settings": plain(plan.settings.navigation),
            "effects": plan.effects("navigation"),
            "velocity_lag": plan.update.velocity_lag(flight),
            "thermal": method,
            "about": about,
            "imu": plain(instrument.imu),
            "initial": plain(entry.initial),
            "antenna": plain(instrument.mounting.imu_to_antenna if instrument.mounting else None),
            "imu_to_body": plain(instrument.mounting.imu_to_body if instrument.mounting else None),
        },
        inputs,
        outputs,
        work,
        **plan.switches("navigation"),
    )


def tracking_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """Trajectory, frame times and targets → pos_tracks.nc (nominal, tracking, true), poses.nc (camera), events.csv (unit)."""
    campaign = plan.opened
    entry, instrument = campaign.line(flight, line), campaign.instrument
    trajectory = plan.out / flight / "trajectory.nc"
    effects = of_camera(plan)
    inputs = {
        "trajectory": needed(trajectory, "navigation"),
        "frames": campaign.path(entry.frames),
        "targets": campaign.path(entry.targets),
    }
    learned = tracking.applied(plan.update.learned)
    warm = "boresight_thermal_drift" in effects or any(one["covariate"] == "temperature" for one in learned)
    if warm:
        inputs["imu"] = campaign.path(campaign.flight(flight).imu)
    if plan.truth is not None and (path := true_poses_file(plan.truth, line)) is not None:
        inputs["truth"] = path

    def work(to: Paths) -> dict[str, Any]:
        assert instrument.camera is not None and instrument.mounting is not None
        stamps = campaign.frames(flight, line).time
        with naming(**{n: inputs[n] for n in ("frames", "targets", "imu") if n in inputs}):
            result = tracking.run(
                Trajectory.from_file(trajectory),
                stamps,
                campaign.targets(flight, line),
                instrument.camera,
                instrument.mounting,
                plan.settings.tracking,
                read_true_poses(inputs["truth"], stamps.size) if "truth" in inputs else None,
                campaign.imu(flight).temperatures if warm else None,
                effects,
                learned,
            )
        write_dataset(result.tracks.to_dataset(), to["tracks"])
        write_dataset(result.poses.to_dataset(), to["poses"])
        write_csv(result.events, to["events"], ("frame", np.arange(result.events.time.size)))
        return {
            "course_deg": float(np.rad2deg(result.course)) % 360.0,
            "ground_speed_m_per_s": result.ground_speed,
            "range_m": result.range,
        }

    return run_stage(
        plan.out,
        "tracking",
        f"{flight}/{line}",
        ("stages.tracking", "pipeline.formats.table"),
        {
            "settings": plain(plan.settings.tracking),
            "effects": effects,
            "learned": plain(learned),
            "camera": plain(instrument.camera),
            "mounting": plain(instrument.mounting),
        },
        inputs,
        {
            "tracks": f"{flight}/{line}/pos_tracks.nc",
            "poses": f"{flight}/{line}/poses.nc",
            "events": f"{flight}/{line}/events.csv",
        },
        work,
        **plan.switches("tracking"),
    )


def registration_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """Frames, camera poses and the POS tracks' anchors → tracks.nc with all methods."""
    campaign = plan.opened
    folder = plan.out / flight / line
    camera = campaign.instrument.camera
    assert camera is not None
    inputs = {
        "tracks": needed(folder / "pos_tracks.nc", "tracking"),
        "poses": needed(folder / "poses.nc", "tracking"),
        "frames": campaign.path(campaign.line(flight, line).frames),
    }

    def work(to: Paths) -> dict[str, Any]:
        tracks = Tracks.from_file(inputs["tracks"])
        followed = registration.run(
            campaign.frames(flight, line),
            tracks.only("tracking"),
            tracks.only("nominal"),
            CameraPoses.from_file(inputs["poses"]),
            camera,
            plan.settings.registration,
            of_camera(plan),
        )
        write_dataset(tracks.joined(followed).to_dataset(), to["tracks"])
        return dict(followed.notes)

    return run_stage(
        plan.out,
        "registration",
        f"{flight}/{line}",
        ("stages.registration",),
        {
            "settings": plain(plan.settings.registration),
            "effects": of_camera(plan),
            "camera": plain(camera),
        },
        inputs,
        {"tracks": f"{flight}/{line}/tracks.nc"},
        work,
        **plan.switches("registration"),
    )


def reconstruction_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """Frames and tracks → spectra.nc as scored, products.nc, interferograms.nc."""
    campaign = plan.opened
    entry, instrument = campaign.line(flight, line), campaign.instrument
    folder = plan.out / flight / line
    inputs = {
        "tracks": needed(folder / "tracks.nc", "registration"),
        "frames": campaign.path(entry.frames),
        "targets": campaign.path(entry.targets),
        "calibration": campaign.path(campaign.keys.calibration or ""),
    }
    if campaign.keys.references is not None:
        inputs["references"] = campaign.path(campaign.keys.references)

    def work(to: Paths) -> dict[str, Any]:
        assert instrument.camera is not None and instrument.interferometer is not None
        result = reconstruction.run(
            campaign.frames(flight, line),
            Tracks.from_file(folder / "tracks.nc"),
            campaign.targets(flight, line),
            campaign.calibration(),
            campaign.references() if campaign.keys.references is not None else None,
            instrument.camera,
            instrument.interferometer,
            plan.settings.reconstruction,
            plan.effects("spectral"),
        )
        write_dataset(result.spectra.to_dataset(), to["spectra"])
        write_dataset(result.products.to_dataset(), to["products"])
        updated = instrument.interferometer.with_effects(plan.effects("spectral"))
        opd = updated.opd((updated.rows - 1) / 2, np.arange(updated.cols))
        interferograms = result.interferograms.to_dataset().assign_coords(
            opd=(("col",), opd, {"units": "m", "long_name": "optical path difference in the middle row"})
        )
        write_dataset(interferograms, to["interferograms"])
        return {
            "phase": result.phase.tolist(),
            "read_variance_dn2": result.read_variance,
            "gain_dn": result.gain,
            "bad_pixels": result.bad_pixels,
            "blur_px": result.products.attributes["blur_px"],
            **{
                name: {
                    t: None if np.isnan(v) else float(v) for t, v in zip(result.products.targets, values, strict=True)
                }
                for name, values in (
                    ("imaginary_residue", result.products.imaginary),
                    ("panel_rqe", rqe(result.products.panel, result.products.reference)),
                )
            },
        }

    return run_stage(
        plan.out,
        "reconstruction",
        f"{flight}/{line}",
        ("stages.reconstruction",),
        {
            "settings": plain(plan.settings.reconstruction),
            "effects": plan.effects("spectral"),
            "camera": plain(instrument.camera),
            "interferometer": plain(instrument.interferometer),
        },
        inputs,
        {n: f"{flight}/{line}/{n}.nc" for n in ("spectra", "products", "interferograms")},
        work,
        **plan.switches("reconstruction"),
    )


def mapping_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """Frames, poses, terrain and the line's phase → cube.tif, location.tif, quicklook.png (and cube.img with cube.hdr)."""
    campaign = plan.opened
    entry, instrument = campaign.line(flight, line), campaign.instrument
    folder = plan.out / flight / line
    settings, effects = plan.settings.mapping, plan.effects("geometry", "spectral")
    inputs = {
        "poses": needed(folder / "poses.nc", "tracking"),
        "spectra": needed(folder / "spectra.nc", "reconstruction"),
        "frames": campaign.path(entry.frames),
        "calibration": campaign.path(campaign.keys.calibration or ""),
        "targets": campaign.path(entry.targets),
    }
    if campaign.keys.dem is not None:
        inputs["dem"] = campaign.path(campaign.keys.dem)
    files = {"cube": "cube.tif", "quicklook": "quicklook.png", "location": "location.tif"}
    if settings.envi:
        files |= {"envi": "cube.img", "envi_header": "cube.hdr"}

    def work(to: Paths) -> dict[str, Any]:
        camera, interferometer = instrument.camera, instrument.interferometer
        assert camera is not None and interferometer is not None
        targets, poses = campaign.targets(flight, line), CameraPoses.from_file(folder / "poses.nc")
        dem = None if campaign.keys.dem is None else Dem.from_file(inputs["dem"])
        heights, ground = mapping.surface(targets, dem, effects)
        grid = mapping.line_grid(poses, camera, ground, settings, effects)
        spectra = Spectra.from_file(folder / "spectra.nc")
        wavenumber = interferometer.scored_wavenumbers(settings.wavenumber_step_per_m)
        phase = smooth_phase(spectra.phase, wavenumber, (spectra.wavenumber[0], spectra.wavenumber[-1]))
        strips = mapping.run(
            campaign.frames(flight, line),
            poses,
            heights,
            grid,
            wavenumber,
            phase,
            campaign.calibration(),
            camera,
            interferometer,
            int(spectra.attributes["drift_order"]),
            effects,
        )
        width = line_width(SCORED_APODIZATION, interferometer.with_effects(effects).longest_opd)
        seen = write_cube(
            CubeGrid(grid.crs, grid.affine, grid.shape, wavenumber, width),
            strips,
            lambda start, stop: grid.places(start, stop, heights),
            to,
        )
        return {
            "cells": list(grid.shape),
            "cell_m": grid.cell,
            "crs": grid.crs,
            "bands": wavenumber.size,
            "seen_fraction": seen,
            "warnings": _beyond_terrain(mapping.share_outside(grid, dem) if dem is not None else 0.0),
            "terrain": "dem" if dem is not None else f"flat at {ground:.1f} m",
        }

    return run_stage(
        plan.out,
        "mapping",
        f"{flight}/{line}",
        ("stages.mapping", "pipeline.raster"),
        {
            "settings": plain(settings),
            "effects": effects,
            "camera": plain(instrument.camera),
            "interferometer": plain(instrument.interferometer),
        },
        inputs,
        {n: f"{flight}/{line}/{file}" for n, file in files.items()},
        work,
        **plan.switches("mapping"),
    )


def _beyond_terrain(share: float) -> list[str]:
    if share == 0.0:
        return []
    return [
        f"{share:.0%} of the map lie beyond the edge of the terrain model, whose last height is held on there: these cells may "
        "be displaced, and their spectra mixed"
    ]


def scoring_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """spectra.nc, and from products.nc how much the targets' surroundings differ → scores.json."""
    spectra, products = (plan.out / flight / line / f"{n}.nc" for n in ("spectra", "products"))

    def work(to: Paths) -> dict[str, Any]:
        with open_dataset(products) as d:
            contrast = dict(zip(map(str, d["target"].values), d["contrast"].values.tolist(), strict=True))
        content: dict[str, Any] = plain(scoring.run(Spectra.from_file(spectra), contrast))
        write_json(to["scores"], content)
        return content

    return run_stage(
        plan.out,
        "scoring",
        f"{flight}/{line}",
        ("stages.scoring",),
        {},
        {"spectra": needed(spectra, "reconstruction"), "products": needed(products, "reconstruction")},
        {"scores": f"{flight}/{line}/scores.json"},
        work,
        **plan.switches("scoring"),
    )


def bench_step(plan: Plan, bench: str) -> StageRecord:
    """A laboratory interferogram → bench/<id>.nc."""
    campaign = plan.opened
    entry = next(b for b in campaign.keys.bench if b.id == bench)

    def work(to: Paths) -> dict[str, Any]:
        with naming(bench=campaign.path(entry.file)):
            result = bench_stage.run(campaign.bench(bench), plan.settings.bench, plan.bench_effects(bench))
        write_dataset(result.to_dataset(), to["spectrum"])
        return {
            "relative_rms": result.relative_rms,
            "relative_rms_scaled": result.relative_rms_scaled,
            "scale": result.scale,
            "notes": list(result.notes),
        }

    return run_stage(
        plan.out,
        "bench",
        bench,
        ("stages.bench",),
        {"settings": plain(plan.settings.bench), "effects": plan.bench_effects(bench)},
        {"interferogram": campaign.path(entry.file)},
        {"spectrum": f"bench/{bench}.nc"},
        work,
        **plan.switches("bench"),
    )


def needed(path: Path, stage: str) -> Path:
    if not path.exists():
        raise InputError(path, "file", "is not there", f"run stage {stage} first: `--from {stage}` or no stage option")
    return path


def of_camera(plan: Plan) -> Effects:
    """Effects on camera and mounting: those of the geometry but the terrain's."""
    return {name: values for name, values in plan.effects("geometry").items() if name != "dem_bias"}


def turn_on(campaign: Campaign) -> tuple[float, float] | None:
    """Declared sigmas of what gyros [rad/s] and accelerometers [m/s²] are off by from one start to the next."""
    unit = campaign.instrument.imu
    return None if unit is None else (unit.gyro.bias_sigma, unit.accel.bias_sigma)


def compensation(plan: Plan, flight: str) -> str:
    """The method whose thermal correction is to be taken off a flight; "none" where there is none, or nothing to make it of."""
    if plan.opened.keys.thermal is None:
        return "none"
    imu = plan.opened.imu(flight)
    return "none" if imu.temperatures is None or imu.compensated_by is not None else plan.settings.thermal.method


def initial_attitude(campaign: Campaign, flight: str) -> tuple[float, np.ndarray, np.ndarray] | None:
    keys = campaign.flight(flight).initial
    if keys is None:
        return None
    return (
        keys.time_s,
        np.deg2rad([keys.roll_deg, keys.pitch_deg, keys.yaw_deg]),
        np.deg2rad([keys.sigma_roll_deg, keys.sigma_pitch_deg, keys.sigma_yaw_deg]),
    )


@contextmanager
def naming(**files: Path) -> Iterator[None]:
    """Stages know records, not files: an InputError about a record is raised again with the file's name."""
    try:
        yield
    except InputError as error:
        if error.where not in files:
            raise
        raise InputError(files[error.where], error.place, error.problem, error.mend) from error
