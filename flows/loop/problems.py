"""Which parts of a campaign the loop can look at, and what it is given of each: files in, a residual problem out.

Parts come in the order of processing, since what one lacks shows in the residuals of those behind it. A part reads what the
stages before it left in the plan's folder, made with the effects that were found so far (`plan.update`).

Functions
---------
parts_of      the parts that a campaign has data for, and why others are missing
inputs_of     files that a part is made of
problem_of    its residual problem
picked_px     control points before and after
flight_of, geometry_of     the records of a flight, of all lines
settings_of   the settings that it hangs on
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.steps import Plan, compensation, initial_attitude, naming, needed, plain
from pipeline.errors import StageError, TsmftisError
from pipeline.raster import Dem
from pipeline.records import Tracks, Trajectory
from pipeline.residual_problem import Parameters, ResidualProblem, joined
from stages import bench, navigation, reconstruction, registration, thermal, tracking


class NothingThere(StageError):
    """A part whose files hold nothing that a residual can be made of."""


@dataclass(frozen=True)
class Part:
    """A stage as loop.json names it; `bench`: the laboratory interferogram that it is about, if it is one."""

    stage: str
    bench: str | None = None

    @property
    def name(self) -> str:
        return self.stage if self.bench is None else f"bench-{self.bench}"

    @property
    def needs(self) -> str | None:
        """The last stage of a run whose results it reads."""
        if self.bench is not None:
            return None
        return {"navigation": "thermal", "geometry": "navigation", "spectral": "tracking"}.get(self.stage)


def parts_of(plan: Plan) -> tuple[list[Part], dict[str, str]]:
    """Parts in the order of processing, and for those that are missing why."""
    keys, instrument = plan.opened.keys, plan.opened.instrument
    lines = any(f.lines for f in keys.flights)
    has = {
        "thermal": (keys.thermal is not None, "the campaign has no chamber run"),
        "navigation": (bool(keys.flights), "the campaign has no flight"),
        "geometry": (lines, "no flight has a line"),
        "spectral": (lines and keys.references is not None, "there are no lines with reference spectra"),
    }
    assert not lines or instrument.camera is not None
    parts = [Part(stage) for stage, (there, _) in has.items() if there]
    missing = {stage: why for stage, (there, why) in has.items() if not there}
    for entry in keys.bench:
        if plan.opened.bench(entry.id).reference is None:
            missing[f"bench-{entry.id}"] = "there is no reference spectrum to hold it against"
        else:
            parts.append(Part("spectral", entry.id))
    return parts, missing


def lines_of(plan: Plan) -> list[tuple[str, str]]:
    return [(f.id, entry.id) for f in plan.opened.keys.flights for entry in f.lines]


def inputs_of(plan: Plan, part: Part) -> dict[str, Path]:
    """Files by name, campaign's and run's."""
    campaign = plan.opened
    keys = campaign.keys
    named = {"instrument": campaign.path(keys.instrument)}
    if part.bench is not None:
        entry = next(b for b in keys.bench if b.id == part.bench)
        return {"interferogram": campaign.path(entry.file)}
    if part.stage == "thermal":
        assert keys.thermal is not None
        return named | {name: campaign.path(name) for name in (*keys.thermal.train, *keys.thermal.verify)}
    for flight in keys.flights:
        named[f"{flight.id}/imu"] = campaign.path(flight.imu)
        if part.stage == "navigation":
            named[f"{flight.id}/gnss"] = campaign.path(flight.gnss)
            if compensation(plan, flight.id) != "none":
                named[f"{flight.id}/thermal"] = needed(plan.out / "thermal_model.nc", "thermal")
        for line in flight.lines if part.stage != "navigation" else ():
            unit = f"{flight.id}/{line.id}"
            named |= {f"{unit}/frames": campaign.path(line.frames), f"{unit}/targets": campaign.path(line.targets)}
            if part.stage == "geometry":
                named[f"{flight.id}/trajectory"] = needed(plan.out / flight.id / "trajectory.nc", "navigation")
                if line.gcps is not None:
                    named[f"{unit}/gcps"] = campaign.path(line.gcps)
            else:
                named[f"{unit}/tracks"] = needed(plan.out / unit / "pos_tracks.nc", "tracking")
    if part.stage == "geometry" and keys.dem is not None:
        named["dem"] = campaign.path(keys.dem)
    if part.stage == "spectral":
        named |= {
            "calibration": campaign.path(keys.calibration or ""),
            "references": campaign.path(keys.references or ""),
        }
    return named


def settings_of(plan: Plan, part: Part) -> dict[str, Any]:
    """The settings, and what else of the campaign's keys, that its problem hangs on."""
    settings, keys = plan.settings, plan.opened.keys
    if part.bench is not None:
        return {"settings": plain(settings.bench)}
    hangs: Mapping[str, tuple[Any, ...]] = {
        "thermal": (settings.thermal, keys.thermal),
        "navigation": (settings.navigation, settings.thermal.method, [f.initial for f in keys.flights]),
        "geometry": (settings.geometry, settings.registration),
        "spectral": (settings.reconstruction,),
    }
    return {"settings": plain(hangs[part.stage])}


def problem_of(plan: Plan, part: Part) -> ResidualProblem:
    """The part's residual problem; InputError where its files cannot serve."""
    if part.bench is not None:
        with naming(bench=inputs_of(plan, part)["interferogram"]):
            return bench.residual_problem(plan.opened.bench(part.bench), plan.settings.bench)
    makers: Mapping[str, Callable[[Plan], ResidualProblem]] = {
        "thermal": _thermal,
        "navigation": _navigation,
        "geometry": _geometry,
        "spectral": _spectral,
    }
    return makers[part.stage](plan)


def _thermal(plan: Plan) -> ResidualProblem:
    keys = plan.opened.keys.thermal
    assert keys is not None
    train, verify = ([plan.opened.chamber(n) for n in part] for part in (keys.train, keys.verify))
    return thermal.residual_problem(train, verify, plan.settings.thermal, plan.effects("thermal"))


def flight_of(plan: Plan, flight: str) -> dict[str, Any]:
    """What `navigation.run` and `navigation.residual_problem` are made of, but for the effects."""
    campaign = plan.opened
    instrument = campaign.instrument
    assert instrument.imu is not None and instrument.mounting is not None
    imu, method, correction = campaign.imu(flight), compensation(plan, flight), None
    if method != "none" and imu.temperatures is not None:
        known = thermal.ThermalModel.from_file(plan.out / "thermal_model.nc")
        correction = known.correction(
            imu.temperatures, method, of=imu.time, where=campaign.path(campaign.flight(flight).imu)
        )
    return {
        "imu": imu,
        "gnss": campaign.gnss(flight),
        "model": instrument.imu,
        "mounting": instrument.mounting,
        "settings": plan.settings.navigation,
        "initial": initial_attitude(campaign, flight),
        "correction": correction,
    }


def _navigation(plan: Plan) -> ResidualProblem:
    """Of the flights whose files can serve; the others are named in its notes."""
    campaign, problems, failed = plan.opened, {}, {}
    for flight in campaign.keys.flights:
        files = {"gnss": campaign.path(flight.gnss), "imu": campaign.path(flight.imu)}
        try:
            with naming(**files, **{"campaign.yaml": campaign.root / "campaign.yaml"}):
                problems[flight.id] = navigation.residual_problem(
                    **flight_of(plan, flight.id), effects=plan.effects("navigation")
                )
        except TsmftisError as error:
            failed[flight.id] = error
    if not problems:
        raise next(iter(failed.values()))
    every = joined(problems)
    told = [f"flight {name} was not looked at: {error}" for name, error in failed.items()]
    beside = {f"{flight}/{name}": v for flight, one in problems.items() for name, v in one.beside.items()}
    return replace(every, notes=(*every.notes, *told), beside=beside)


def receivers_of(problem: ResidualProblem) -> dict[str, dict[str, float]]:
    """What navigation's part tells of the flights' receivers, as a model update has it."""
    out: dict[str, dict[str, float]] = {}
    for place, value in problem.beside.items():
        flight, name = place.rsplit("/", 1)
        out.setdefault(flight, {})[name] = value
    return out


def geometry_of(plan: Plan, motion: bool = True) -> dict[str, Any]:
    """What `tracking.residual_problem` and `tracking.geometry_residual_px` are made of; without `motion` of the images, points
    and heights alone."""
    campaign = plan.opened
    camera, mounting = campaign.instrument.camera, campaign.instrument.mounting
    assert camera is not None and mounting is not None
    lines = []
    for flight, line in lines_of(plan):
        frames = campaign.frames(flight, line)
        lines.append(
            tracking.Line(
                f"{flight}/{line}",
                Trajectory.from_file(plan.out / flight / "trajectory.nc"),
                frames.time,
                campaign.gcps(flight, line),
                campaign.targets(flight, line),
                registration.image_motion(frames, camera, plan.settings.registration) if motion else None,
                campaign.imu(flight).temperatures,
                flight,
            )
        )
    return {
        "lines": lines,
        "camera": camera,
        "mounting": mounting,
        "dem": None if campaign.keys.dem is None else Dem.from_file(campaign.path(campaign.keys.dem)),
        "settings": plan.settings.geometry,
        "effects": plan.effects("geometry"),
        "gyro": None if campaign.instrument.imu is None else campaign.instrument.imu.gyro,
    }


def _geometry(plan: Plan) -> ResidualProblem:
    made = tracking.residual_problem(**geometry_of(plan))
    if made is None:
        raise NothingThere(
            "there are no control points, no texture to follow from frame to frame, and no heights to compare"
        )
    return made


def picked_px(plan: Plan, found: Parameters, learned: Sequence[str] = ()) -> dict[str, float] | None:
    """RMS of the control points [px] without `found` and curves of the `learned` covariates, and with them, each group predicted
    from the others; None without such points."""
    made = geometry_of(plan, motion=bool(found or learned))
    before, after = tracking.geometry_residual_px(**made, found=found, learned=learned)
    return {"before": before, "after": after} if math.isfinite(before) else None


def _spectral(plan: Plan) -> ResidualProblem:
    campaign = plan.opened
    camera, interferometer = campaign.instrument.camera, campaign.instrument.interferometer
    assert camera is not None and interferometer is not None
    lines = [
        reconstruction.SpectralLine(
            campaign.frames(flight, line),
            Tracks.from_file(plan.out / flight / line / "pos_tracks.nc").only("tracking"),
            campaign.targets(flight, line),
            f"{flight}/{line}",
        )
        for flight, line in lines_of(plan)
    ]
    return reconstruction.residual_problem(
        lines,
        campaign.calibration(),
        campaign.references(),
        camera,
        interferometer,
        plan.settings.reconstruction,
        plan.effects("spectral"),
    )
