"""Figures before and after, on data that the fit of the effects has not seen, as far as a campaign has them.

    rqe_tracking_mean, rqe_area_tracking_mean   where spectral effects were found, each target with those of the other half of
                                                the targets; else targets take no part in what was fitted
    geometry_residual_px                        control points, each group of them predicted from all others
    navigation_nis_mean                         each fix predicted from those before it, effects from all fixes
    navigation_withheld_m                       where navigation's effects were found: misses of 5 of every 30 s of the fixes,
                                                withheld from the path and from the effects
    thermal_gyro_std_deg_per_h, thermal_accel_std_ug     verification runs, with effects from the training runs alone
    bench_relative_rms                          bands of wavenumber held out in turn

`how` says for each that is there what was held out.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from flows.loop.problems import Part, inputs_of, lines_of, picked_px, settings_of
from flows.results import SCORES
from flows.steps import Paths, Plan, plain, turn_on
from pipeline.model_update import Effects
from pipeline.records import Tracks
from pipeline.run_stage import StageRecord, run_stage, write_json
from stages import closed_loop, reconstruction, scoring, thermal
from tsmftis.effects import nested, scalars

FIT_ON = {
    "rqe_tracking_mean": "no target takes part in what was fitted",
    "geometry_residual_px": "each group of control points predicted from all others",
    "navigation_nis_mean": "each fix predicted from those before it; effects from all fixes",
    "thermal_gyro_std_deg_per_h": "verification runs",
    "bench_relative_rms": "bands of wavenumber held out in turn",
}
Figures = dict[str, Any]
Answers = Mapping[str, Mapping[str, Any]]


def held_out_step(root: Path, before: Plan, last: Plan, answers: Answers, runs: tuple[Figures, Figures]) -> StageRecord:
    """`root`/loop/held-out.json: {"before", "after", "how"}. `before`, `last`: the plans of the first and the last run; `runs`:
    the content of their run.json."""
    added = {
        name
        for name, answer in answers.items()
        if (answer["effects"] or answer.get("receiver")) and not answer["bench"]
    }
    first, second = (_of_run(run, before) for run in runs)
    if picked := answers.get("geometry", {}).get("picked_px"):
        first["geometry_residual_px"], second["geometry_residual_px"] = picked["before"], picked["after"]
    bench = {str(a["bench"]): a["heldout_rms"] for a in answers.values() if a["bench"]}
    bench = {name: rms for name, rms in bench.items() if rms["before"] is not None}
    for figures, when in ((first, "before"), (second, "after")) if bench else ():
        each = {name: rms[when] for name, rms in bench.items()}
        figures["bench_relative_rms"] = float(np.sqrt(np.mean(np.square(list(each.values())))))
        figures["bench_relative_rms_each"] = each
    inputs: dict[str, Path] = {}
    for name in (*added, *(["geometry"] if "geometry" in answers else [])):
        inputs |= {f"{name}/{key}": path for key, path in inputs_of(last, Part(name)).items()}

    def work(to: Paths) -> dict[str, Any]:
        how = {key: said for key, said in FIT_ON.items() if key in first}
        with threadpool_limits(limits=1):
            if "geometry_residual_px" in first and added - {"spectral"}:
                px = picked_px(before, {})
                first["geometry_residual_px"] = first["geometry_residual_px"] if px is None else px["before"]
            if "thermal" in added:
                second.update(_thermal(last, answers["thermal"]["effects"]))
                how["thermal_gyro_std_deg_per_h"] = "verification runs, with effects from the training runs alone"
            if "navigation" in added:
                missed = answers["navigation"]["withheld_m"]
                if missed is not None:
                    for figures, when in ((first, "before"), (second, "after")):
                        figures["navigation_withheld_m"] = missed[when]
                    how["navigation_withheld_m"] = (
                        "5 of every 30 s of the fixes, withheld from the path and from the effects"
                    )
            if "spectral" in added:
                how["rqe_tracking_mean"] = _spectral(last, answers["spectral"]["without"], runs[0], first, second)
        both = set(first) & set(second)
        content = {
            "before": {key: v for key, v in first.items() if key in both},
            "after": {key: v for key, v in second.items() if key in both},
            "how": how,
        }
        write_json(to["figures"], content)
        return content

    return run_stage(
        root,
        "loop",
        "held-out",
        ("stages.scoring", "stages.closed_loop", "flows.loop.problems"),
        {
            "figures": plain([first, second]),
            "effects": plain({name: answers[name]["effects"] for name in sorted(added)}),
            "withheld": plain(answers.get("navigation", {}).get("withheld_m")),
            "without": plain(answers["spectral"]["without"] if "spectral" in added else []),
            "settings": {name: settings_of(last, Part(name)) for name in sorted(added)},
        },
        inputs,
        {"figures": "loop/held-out.json"},
        work,
    )


def _of_run(run: Figures, plan: Plan) -> Figures:
    """The figures that stand in a run.json."""
    figures: Figures = {}
    for kind in SCORES:
        if "tracking" in run.get(kind, {}):
            figures[f"{kind}_tracking_mean"] = run[kind]["tracking"]
    nis = [f["navigation"] for f in run["flights"].values() if f["navigation"]]
    if nis:
        weights = [max(entry["fixes"]["used"], 1) for entry in nis]
        figures["navigation_nis_mean"] = float(np.average([e["innovation_nis_mean"] for e in nis], weights=weights))
    if verify := run.get("thermal", {}).get("verify"):
        for key in ("gyro_std_deg_per_h", "accel_std_ug"):
            figures[f"thermal_{key}"] = verify[key][_method(plan)]
    return figures


def _method(plan: Plan) -> str:
    method = plan.settings.thermal.method
    return "raw" if method == "none" else method


def _thermal(plan: Plan, effects: Effects) -> Figures:
    """Verification figures of a model whose effects are those of the training runs."""
    keys = plan.opened.keys.thermal
    assert keys is not None
    if not keys.verify:
        return {}
    train, verify = ([plan.opened.chamber(n) for n in part] for part in (keys.train, keys.verify))
    problem = thermal.residual_problem(train, [], plan.settings.thermal)
    found = closed_loop.refit(problem, flat(effects))
    table = thermal.run(train, verify, plan.settings.thermal, turn_on(plan.opened), nested(found)).verification
    return {f"thermal_{key}": table[key][_method(plan)] for key in ("gyro_std_deg_per_h", "accel_std_ug")}


def flat(effects: Effects) -> dict[str, dict[str, float]]:
    """Parameters by their scalar names, as `tsmftis.effects.scalars` has them; zeros are left out."""
    out: dict[str, dict[str, float]] = {}
    for name, values in effects.items():
        each = {s: values[key]["xyz".index(s[-1])] if s != key else values[key] for s, key in scalars(name).items()}
        out[name] = {scalar: float(v) for scalar, v in each.items() if v}
    return out


def _spectral(plan: Plan, halves: list[Mapping[str, Any]], run: Figures, first: Figures, second: Figures) -> str:
    """Means of the scores over the targets that have a half, each with the effects of the other one, into `second`; of the same
    targets in the first run into `first`. Returns what was held out."""
    if not halves:
        return "fitted and scored on the same target: there is no other"
    campaign = plan.opened
    camera, interferometer = campaign.instrument.camera, campaign.instrument.interferometer
    assert camera is not None and interferometer is not None
    scores: dict[str, dict[str, float]] = {kind: {} for kind in SCORES}
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
            for kind, of_kind in scoring.run(made.spectra).scores.items():
                for target, value in of_kind.get("tracking", {}).get("targets", {}).items():
                    if (name := f"{flight}/{line} {target}") in half["groups"]:
                        scores[kind][name] = value
    for kind, after in scores.items():
        was = {
            f"{f}/{i} {t}": v
            for f, flight in run["flights"].items()
            for i, line in flight["lines"].items()
            for t, v in line[kind].get("tracking", {}).get("targets", {}).items()
        }
        both = [name for name in after if name in was]
        if both:
            first[f"{kind}_tracking_mean"] = float(np.mean([was[name] for name in both]))
            second[f"{kind}_tracking_mean"] = float(np.mean([after[name] for name in both]))
    return f"{len(scores['rqe'])} targets, each scored with the effects of the other half of the targets"
