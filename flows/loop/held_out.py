"""Figures before and after, on data that the fit of the effects has not seen, as far as a campaign has them.

rqe_tracking_mean, rqe_area_tracking_mean   each target scored with spectral effects from the other half of the targets
geometry_residual_px                        of the picked points, each with effects from the other half of the groups
navigation_nis_mean                         innovations: each fix predicted from those before it
thermal_gyro_std_deg_per_h, thermal_accel_std_ug     verification runs, with effects from the training runs alone
bench_relative_rms                          bands of wavenumber held out in turn
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from flows.loop.problems import Part, flight_of, inputs_of, lines_of, problem_of
from flows.steps import Paths, Plan, plain, turn_on
from pipeline.model_update import Effects
from pipeline.records import Tracks
from pipeline.run_stage import StageRecord, run_stage, write_json
from stages import closed_loop, navigation, reconstruction, scoring, thermal

WITHHELD_S = (30.0, 5.0)
Answers = Mapping[str, Mapping[str, Any]]


def held_out_step(
    root: Path, after: Plan, answers: Answers, runs: tuple[dict[str, Any], dict[str, Any]]
) -> StageRecord:
    """`root`/loop/held-out.json: {"before", "after", "how"}. `after`: the plan of the last run; `runs`: both runs' run.json."""
    first, second = (_of_run(run, after) for run in runs)
    if rms := answers.get("geometry", {}).get("picked_px"):
        first["geometry_residual_px"], second["geometry_residual_px"] = rms["before"], rms["after"]
    bench = {str(a["bench"]): a["heldout_rms"] for a in answers.values() if a["bench"]}
    for figures, when in ((first, "before"), (second, "after")) if bench else ():
        each = {name: rms[when] for name, rms in bench.items()}
        figures["bench_relative_rms"] = float(np.sqrt(np.mean(np.square(list(each.values())))))
        figures["bench_relative_rms_each"] = each
    again = {
        name: answers[name]["without"]
        for name in ("thermal", "navigation", "spectral")
        if name in answers and answers[name]["without"]
    }
    inputs: dict[str, Path] = {}
    for name in again:
        inputs |= inputs_of(after, Part(name))

    def work(to: Paths) -> dict[str, Any]:
        how: dict[str, str] = {}
        with threadpool_limits(limits=1):
            if "thermal" in again:
                second.update(_thermal(after, again["thermal"][0]["effects"]))
                how["thermal"] = "verification runs, with effects from the training runs alone"
            if "navigation" in again:
                effects = {n: dict(v) for n, v in answers["navigation"]["effects"].items()}
                first["navigation_withheld_m"], second["navigation_withheld_m"] = _withheld(after, effects)
                how["navigation"] = "5 of every 30 s of the fixes withheld, from the path and from the effects"
            if "spectral" in again:
                figures, how["spectral"] = _spectral(after, again["spectral"])
                second.update(figures)
        content = {"before": first, "after": second, "how": how}
        write_json(to["figures"], content)
        return content

    return run_stage(
        root,
        "loop",
        "held-out",
        (
            "stages.thermal",
            "stages.navigation",
            "stages.closed_loop",
            "stages.reconstruction",
            "stages.scoring",
            "flows.loop.problems",
        ),
        {"figures": [first, second], "again": plain(again), "effects": plain(after.update.effects)},
        inputs,
        {"figures": "loop/held-out.json"},
        work,
    )


def _of_run(run: dict[str, Any], plan: Plan) -> dict[str, Any]:
    """The figures of run.json that are on held-out data where the fit did not use them."""
    figures: dict[str, Any] = {}
    for key, kind in (("rqe_tracking_mean", "rqe"), ("rqe_area_tracking_mean", "rqe_area")):
        if "tracking" in run.get(kind, {}):
            figures[key] = run[kind]["tracking"]
    nis = [f["navigation"]["innovation_nis_mean"] for f in run["flights"].values() if f["navigation"]]
    if nis:
        figures["navigation_nis_mean"] = float(np.mean(nis))
    if verify := run.get("thermal", {}).get("verify"):
        for key in ("gyro_std_deg_per_h", "accel_std_ug"):
            figures[f"thermal_{key}"] = verify[key][_method(plan)]
    return figures


def _method(plan: Plan) -> str:
    method = plan.settings.thermal.method
    return "raw" if method == "none" else method


def _thermal(plan: Plan, effects: Effects) -> dict[str, Any]:
    """Verification figures of a model with these effects."""
    keys = plan.opened.keys.thermal
    assert keys is not None
    train, verify = ([plan.opened.chamber(n) for n in part] for part in (keys.train, keys.verify))
    table = thermal.run(train, verify, plan.settings.thermal, turn_on(plan.opened), effects).verification
    return {f"thermal_{key}": table[key][_method(plan)] for key in ("gyro_std_deg_per_h", "accel_std_ug")}


def _withheld(plan: Plan, effects: Effects) -> tuple[list[float], list[float]]:
    """RMS of the smoothed antenna's misses [m] before and after, horizontal and vertical, over all flights."""
    settings = plan.settings.navigation.model_copy(update={"withhold_every_s": WITHHELD_S})
    rest = {n: v for n, v in plan.update.effects.items() if n not in effects}
    plan = replace(
        plan,
        settings=plan.settings.model_copy(update={"navigation": settings}),
        update=replace(plan.update, effects=rest),
    )
    values, _ = closed_loop.refit(problem_of(plan, Part("navigation")), effects, [])
    missed: list[dict[str, list[float]]] = []
    for model in ({}, values):
        each: dict[str, list[float]] = {"horizontal": [], "vertical": []}
        for flight in plan.opened.keys.flights:
            found = navigation.run(**flight_of(plan, flight.id), effects={**rest, **model}).quality["withheld"]
            for name, squares in each.items():
                squares.append(found[f"{name}_rms_m"] ** 2)
        missed.append(each)
    before, after = ([float(np.sqrt(np.mean(v))) for v in each.values()] for each in missed)
    return before, after


def _spectral(plan: Plan, halves: list[Mapping[str, Any]]) -> tuple[dict[str, float], str]:
    """Means of the scores over all targets, each with the effects of the half that it is not of."""
    campaign = plan.opened
    camera, interferometer = campaign.instrument.camera, campaign.instrument.interferometer
    assert camera is not None and interferometer is not None
    kept: dict[str, list[float]] = {"rqe": [], "rqe_area": []}
    used = set()
    for flight, line in lines_of(plan):
        for half in halves:
            made = reconstruction.run(
                campaign.frames(flight, line),
                Tracks.from_file(plan.out / flight / line / "pos_tracks.nc").only("tracking"),
                campaign.targets(flight, line),
                campaign.calibration(),
                campaign.references(),
                camera,
                interferometer,
                plan.settings.reconstruction,
                half["effects"],
            )
            scores = scoring.run(made.spectra).scores
            for kind, values in kept.items():
                for target, value in scores[kind].get("tracking", {}).get("targets", {}).items():
                    if (name := f"{flight}/{line} {target}") in half["groups"]:
                        values.append(value)
                        used.add(name)
    figures = {f"{kind}_tracking_mean": float(np.mean(v)) for kind, v in kept.items() if v}
    return figures, f"{len(used)} targets, each scored with the effects of the other half of the targets"
