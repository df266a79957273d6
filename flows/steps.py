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
from rasterio.transform import Affine
from rasterio.windows import Window

from flows.settings import Settings
from pipeline.campaign import Campaign, read_campaign
from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.formats import sbet, smrmsg
from pipeline.formats.table import write_csv
from pipeline.model_update import Effects
from pipeline.raster import Dem, Quicklook, open_cube
from pipeline.records import CameraPoses, Imu, Spectra, ThermalCorrection, Tracks, Trajectory
from pipeline.run_stage import StageRecord, run_stage, write_json
from pipeline.truth import read_true_poses, true_poses_file
from stages import bench as bench_stage
from stages import mapping, navigation, reconstruction, registration, scoring, thermal, tracking
from tsmftis import __version__
from tsmftis.effects import EFFECTS
from tsmftis.fourier import smooth_phase

FAR_FROM_CHAMBER = 0.5  # standard deviations of a feature
UPDATED = frozenset({"navigation"})  # stages whose models take a model update

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
    update: Effects = field(default_factory=dict)  # --model-update: what the declared models lack
    truth: Path | None = None  # --truth: folder with true poses, of which the method `true` is made

    @cached_property
    def opened(self) -> Campaign:
        return read_campaign(self.campaign)

    def effects(self, stage: str) -> Effects:
        """The update's effects on a stage's model."""
        return {name: values for name, values in self.update.items() if EFFECTS[name].stage == stage}

    def wants(self, flight: str, line: str) -> bool:
        return not self.lines or line in self.lines or f"{flight}/{line}" in self.lines

    def does(self, stage: str) -> bool:
        """Whether a stage is looked at: with --only, the stages up to that one, and only it may run."""
        return self.only is None or reaches(stage, self.only)

    def switches(self, stage: str) -> dict[str, bool]:
        if self.only is not None:
            return {"force": stage == self.only, "forbid": stage != self.only}
        return {"force": self.start is not None and reaches(self.start, stage), "forbid": False}


def _plain(value: Any) -> Any:
    """Parameters and figures as JSON data."""
    if hasattr(value, "__dataclass_fields__"):
        return {n: _plain(getattr(value, n)) for n in value.__dataclass_fields__}
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def thermal_step(plan: Plan) -> StageRecord:
    """Chamber runs → thermal_model.nc, thermal_figures.json; the verification is the summary."""
    campaign = plan.opened
    keys = campaign.keys.thermal
    assert keys is not None
    names = [*keys.train, *keys.verify]

    def work(to: Paths) -> dict[str, Any]:
        result = thermal.run(
            [campaign.chamber(n) for n in keys.train], [campaign.chamber(n) for n in keys.verify], plan.settings.thermal
        )
        write_dataset(result.model.to_dataset(), to["model"])
        write_json(to["figures"], _plain(result.figures))
        return {"verify": result.verification, "notes": list(result.notes)}

    return run_stage(
        plan.out,
        "thermal",
        "campaign",
        ("stages.thermal",),
        {"settings": _plain(plan.settings.thermal), "train": list(keys.train), "verify": list(keys.verify)},
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
    method = plan.settings.thermal.method
    declared = campaign.keys.thermal is not None and _has_temperatures(campaign, flight)
    if compensated := declared and method != "none":
        inputs["model"] = _needed(model, "thermal")
        outputs["correction"] = f"{flight}/thermal.nc"

    def work(to: Paths) -> dict[str, Any]:
        imu = campaign.imu(flight)
        correction = _correction(model, imu, method) if compensated else None
        assert instrument.imu is not None and instrument.mounting is not None
        with _naming(gnss=inputs["gnss"], imu=inputs["imu"], **{"campaign.yaml": campaign.root / "campaign.yaml"}):
            result = navigation.run(
                imu,
                campaign.gnss(flight),
                instrument.imu,
                instrument.mounting,
                plan.settings.navigation,
                initial=_initial(campaign, flight),
                correction=correction,
                effects=plan.effects("navigation"),
            )
        if correction is not None:
            write_dataset(correction.to_dataset(), to["correction"])
        write_dataset(result.trajectory.to_dataset().assign_attrs(about), to["trajectory"])
        sbet.write_sbet(sbet.from_trajectory(result.trajectory), to["sbet"])
        smrmsg.write_smrmsg(smrmsg.from_trajectory(result.trajectory), to["smrmsg"])
        write_json(to["figures"], {"quality": result.quality, "figures": result.figures})
        if correction is None:
            return result.quality | {"compensated": False}
        reach = _reach(correction)
        warnings = [*result.quality["warnings"], *_beyond(reach)]
        return result.quality | {"compensated": True, "warnings": warnings} | reach

    return run_stage(
        plan.out,
        "navigation",
        flight,
        ("stages.navigation", "stages.thermal", "pipeline.formats.sbet", "pipeline.formats.smrmsg"),
        {
            "settings": _plain(plan.settings.navigation),
            "effects": plan.effects("navigation"),
            "thermal": method,
            "about": about,
            "imu": _plain(instrument.imu),
            "initial": _plain(entry.initial),
            "antenna": _plain(instrument.mounting.imu_to_antenna if instrument.mounting else None),
            "imu_to_body": _plain(instrument.mounting.imu_to_body if instrument.mounting else None),
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
    inputs = {
        "trajectory": _needed(trajectory, "navigation"),
        "frames": campaign.path(entry.frames),
        "targets": campaign.path(entry.targets),
    }
    if plan.truth is not None and (path := true_poses_file(plan.truth, line)) is not None:
        inputs["truth"] = path

    def work(to: Paths) -> dict[str, Any]:
        assert instrument.camera is not None and instrument.mounting is not None
        stamps = campaign.frames(flight, line).time
        with _naming(frames=inputs["frames"], targets=inputs["targets"]):
            result = tracking.run(
                Trajectory.from_file(trajectory),
                stamps,
                campaign.targets(flight, line),
                instrument.camera,
                instrument.mounting,
                plan.settings.tracking,
                read_true_poses(inputs["truth"], stamps.size) if "truth" in inputs else None,
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
            "settings": _plain(plan.settings.tracking),
            "camera": _plain(instrument.camera),
            "mounting": _plain(instrument.mounting),
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
    """Frames and the POS tracks' anchors → tracks.nc with all methods."""
    campaign = plan.opened
    source = plan.out / flight / line / "pos_tracks.nc"
    camera = campaign.instrument.camera
    assert camera is not None

    def work(to: Paths) -> dict[str, Any]:
        tracks = Tracks.from_file(source)
        by_pos = tracks.methods.index("tracking")
        followed = registration.run(
            campaign.frames(flight, line),
            Tracks(("tracking",), tracks.targets, tracks.row[[by_pos]], tracks.col[[by_pos]]),
            camera,
            plan.settings.registration,
        )
        write_dataset(tracks.joined(followed).to_dataset(), to["tracks"])
        return dict(followed.notes)

    return run_stage(
        plan.out,
        "registration",
        f"{flight}/{line}",
        ("stages.registration",),
        {"settings": _plain(plan.settings.registration), "camera": _plain(camera)},
        {"tracks": _needed(source, "tracking"), "frames": campaign.path(campaign.line(flight, line).frames)},
        {"tracks": f"{flight}/{line}/tracks.nc"},
        work,
        **plan.switches("registration"),
    )


def reconstruction_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """Frames and tracks → spectra.nc as scored, interferograms.nc."""
    campaign = plan.opened
    entry, instrument = campaign.line(flight, line), campaign.instrument
    folder = plan.out / flight / line
    inputs = {
        "tracks": _needed(folder / "tracks.nc", "registration"),
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
        )
        write_dataset(result.spectra.to_dataset(), to["spectra"])
        columns = np.arange(instrument.interferometer.cols)
        opd = instrument.interferometer.opd((instrument.interferometer.rows - 1) / 2, columns)
        interferograms = result.interferograms.to_dataset().assign_coords(
            opd=(("col",), opd, {"units": "m", "long_name": "optical path difference in the middle row"})
        )
        write_dataset(interferograms, to["interferograms"])
        return {"phase": result.phase.tolist(), "read_variance_dn2": result.read_variance, "gain_dn": result.gain}

    return run_stage(
        plan.out,
        "reconstruction",
        f"{flight}/{line}",
        ("stages.reconstruction",),
        {
            "settings": _plain(plan.settings.reconstruction),
            "camera": _plain(instrument.camera),
            "interferometer": _plain(instrument.interferometer),
        },
        inputs,
        {"spectra": f"{flight}/{line}/spectra.nc", "interferograms": f"{flight}/{line}/interferograms.nc"},
        work,
        **plan.switches("reconstruction"),
    )


def mapping_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """Frames, poses, terrain and the line's phase → cube.tif and quicklook.png."""
    campaign = plan.opened
    entry, instrument = campaign.line(flight, line), campaign.instrument
    folder = plan.out / flight / line
    settings = plan.settings.mapping
    inputs = {
        "poses": _needed(folder / "poses.nc", "tracking"),
        "spectra": _needed(folder / "spectra.nc", "reconstruction"),
        "frames": campaign.path(entry.frames),
        "calibration": campaign.path(campaign.keys.calibration or ""),
        "targets": campaign.path(entry.targets),
    }
    if campaign.keys.dem is not None:
        inputs["dem"] = campaign.path(campaign.keys.dem)

    def work(to: Paths) -> dict[str, Any]:
        camera, interferometer = instrument.camera, instrument.interferometer
        assert camera is not None and interferometer is not None
        targets, poses = campaign.targets(flight, line), CameraPoses.from_file(folder / "poses.nc")
        dem = None if campaign.keys.dem is None else Dem.from_file(inputs["dem"])
        heights, ground = mapping.surface(targets, dem)
        grid = mapping.line_grid(poses, camera, ground, settings)
        spectra = Spectra.from_file(folder / "spectra.nc")
        wavenumber = interferometer.scored_wavenumbers(settings.wavenumber_step_per_m)
        phase = smooth_phase(spectra.phase, wavenumber, (spectra.wavenumber[0], spectra.wavenumber[-1]))
        quicklook = Quicklook(grid.shape, wavenumber)
        with open_cube(to["cube"], grid.crs, Affine(*grid.affine), grid.shape, 1e9 / wavenumber) as cube:
            for start, strip in mapping.run(
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
            ):
                cube.write(np.moveaxis(strip, 2, 0), window=Window(0, start, strip.shape[1], strip.shape[0]))
                quicklook.add(start, strip)
        quicklook.write(to["quicklook"])
        return {
            "cells": list(grid.shape),
            "cell_m": grid.cell,
            "crs": grid.crs,
            "bands": wavenumber.size,
            "seen_fraction": quicklook.seen_fraction,
            "terrain": "dem" if dem is not None else f"flat at {ground:.1f} m",
        }

    return run_stage(
        plan.out,
        "mapping",
        f"{flight}/{line}",
        ("stages.mapping", "pipeline.raster"),
        {
            "settings": _plain(settings),
            "camera": _plain(instrument.camera),
            "interferometer": _plain(instrument.interferometer),
        },
        inputs,
        {"cube": f"{flight}/{line}/cube.tif", "quicklook": f"{flight}/{line}/quicklook.png"},
        work,
        **plan.switches("mapping"),
    )


def scoring_step(plan: Plan, flight: str, line: str) -> StageRecord:
    """spectra.nc → scores.json."""
    spectra = plan.out / flight / line / "spectra.nc"

    def work(to: Paths) -> dict[str, Any]:
        result = scoring.run(Spectra.from_file(spectra))
        content = {"scores": result.scores, "partly_seen": result.partly_seen}
        write_json(to["scores"], content)
        return content

    return run_stage(
        plan.out,
        "scoring",
        f"{flight}/{line}",
        ("stages.scoring",),
        {},
        {"spectra": _needed(spectra, "reconstruction")},
        {"scores": f"{flight}/{line}/scores.json"},
        work,
        **plan.switches("scoring"),
    )


def bench_step(plan: Plan, bench: str) -> StageRecord:
    """A laboratory interferogram → bench/<id>.nc."""
    campaign = plan.opened
    entry = next(b for b in campaign.keys.bench if b.id == bench)

    def work(to: Paths) -> dict[str, Any]:
        with _naming(bench=campaign.path(entry.file)):
            result = bench_stage.run(campaign.bench(bench), plan.settings.bench)
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
        {"settings": _plain(plan.settings.bench)},
        {"interferogram": campaign.path(entry.file)},
        {"spectrum": f"bench/{bench}.nc"},
        work,
        **plan.switches("bench"),
    )


def _needed(path: Path, stage: str) -> Path:
    if not path.exists():
        raise InputError(path, "file", "is not there", f"run stage {stage} first: `--from {stage}` or no stage option")
    return path


def _has_temperatures(campaign: Campaign, flight: str) -> bool:
    return campaign.imu(flight).temperatures is not None


def _correction(model: Path, imu: Imu, method: str) -> ThermalCorrection:
    assert imu.temperatures is not None
    return thermal.ThermalModel.from_file(model).correction(imu.temperatures, method)


def _reach(correction: ThermalCorrection) -> dict[str, Any]:
    """Channels that were not compensated, and how far the flight left what the chamber taught, for a reader to know."""
    values = np.hstack([correction.gyro, correction.accel])
    names = [f"{sensor} {axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    return {
        "uncompensated": [n for n, column in zip(names, values.T, strict=True) if not column.any()],
        "chamber_distance_max": float(correction.distance.max()),
    }


def _beyond(reach: Mapping[str, Any]) -> list[str]:
    """What of that a reader must not miss."""
    said = []
    if reach["uncompensated"]:
        names = ", ".join(reach["uncompensated"])
        said.append(
            f"left uncompensated, for want of a thermometer that moves or of a chamber run that teaches it: {names}"
        )
    if reach["chamber_distance_max"] > FAR_FROM_CHAMBER:
        said.append(
            f"temperatures go up to {reach['chamber_distance_max']:.1f} of their standard deviations beyond what the chamber "
            "runs taught: the thermal correction holds its last trend there, with a wider sigma"
        )
    return said


def _initial(campaign: Campaign, flight: str) -> tuple[float, np.ndarray, np.ndarray] | None:
    keys = campaign.flight(flight).initial
    if keys is None:
        return None
    return (
        keys.time_s,
        np.deg2rad([keys.roll_deg, keys.pitch_deg, keys.yaw_deg]),
        np.deg2rad([keys.sigma_roll_deg, keys.sigma_pitch_deg, keys.sigma_yaw_deg]),
    )


@contextmanager
def _naming(**files: Path) -> Iterator[None]:
    """Stages know records, not files: an InputError about a record is raised again with the file's name."""
    try:
        yield
    except InputError as error:
        if error.where not in files:
            raise
        raise InputError(files[error.where], error.place, error.problem, error.mend) from error
