"""The engine on one part of a campaign, as a cached step: result as JSON, the residual's pictures as NetCDF.

Beside the answer it keeps, for effects that were added, their parameters without some groups (`folds_of`): figures on held-out
data are made with those.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from flows.loop.problems import Part, inputs_of, picked_px, problem_of, settings_of
from flows.steps import Paths, Plan, plain
from pipeline.datasets import write_dataset
from pipeline.residual_problem import Basis, ResidualProblem
from pipeline.run_stage import StageRecord, run_stage, write_json
from stages import closed_loop
from stages.closed_loop import LoopResult
from tsmftis.effects import EFFECTS, nested, scalars

FOLDER = "loop"


def examine_step(root: Path, plan: Plan, part: Part, seed: int) -> StageRecord:
    """`root`/loop/<part>.json and .nc from the results in `plan.out`; the content of the JSON is the record's summary."""

    def work(to: Paths) -> dict[str, Any]:
        with threadpool_limits(limits=1):
            problem = problem_of(plan, part)
            result = closed_loop.run(problem, plan.settings.closed_loop, seed)
            content = content_of(part, problem, result, folds_of(plan, part, problem))
            if part.stage == "geometry":
                content["picked_px"] = picked_px(plan, result.values)
        write_json(to["result"], content)
        write_dataset(pictures_of(problem, result), to["pictures"])
        return content

    return run_stage(
        root,
        "loop",
        part.name,
        (*part.modules, "stages.closed_loop", "flows.loop.problems"),
        {
            **settings_of(plan, part),
            "closed_loop": plain(plan.settings.closed_loop),
            "effects": plain(plan.update.effects),
            "seed": seed,
        },
        inputs_of(plan, part),
        {"result": f"{FOLDER}/{part.name}.json", "pictures": f"{FOLDER}/{part.name}.nc"},
        work,
    )


def content_of(part: Part, problem: ResidualProblem, result: LoopResult, folds: list[list[int]]) -> dict[str, Any]:
    """What loop.json and the page say of a part, in plain data; `folds`: labels of groups that figures are held out on."""
    content = result.to_dict()
    return {
        "stage": part.stage,
        "bench": part.bench,
        "verdict": result.verdict,
        "steps": [step | {"parameters": gathered(step["effect"], step["parameters"])} for step in content["steps"]],
        "not_identifiable": content["not_identifiable"],
        "considered": plain(result.considered),
        "notes": list(result.notes),
        "sealed": plain(result.sealed),
        "heldout_rms": {"before": result.rms_before, "after": result.rms_after, "unit": problem.unit},
        "samples": int(problem.group.size),
        "groups": [problem.group_names.get(int(g), str(g)) for g in np.unique(problem.group)],
        "effects": plain(nested(result.values)),
        "without": _refits(problem, result, folds),
    }


def gathered(effect: str, parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters as loop.json has them: those that are lists of three in one entry, in the order x, y, z."""
    if effect not in EFFECTS:
        return {name: dict(value) for name, value in parameters.items()}
    out: dict[str, dict[str, Any]] = {}
    for scalar, key in scalars(effect).items():
        if scalar not in parameters:
            continue
        given = parameters[scalar]
        if key not in EFFECTS[effect].lists:
            out[key] = dict(given)
            continue
        entry = out.setdefault(key, {"value": [0.0] * 3, "sigma": [0.0] * 3, "unit": given["unit"]})
        place = "xyz".index(scalar[-1])
        entry["value"][place], entry["sigma"][place] = given["value"], given["sigma"]
    return out


def folds_of(plan: Plan, part: Part, problem: ResidualProblem) -> list[list[int]]:
    """Labels of the groups that figures are held out on together: the verification runs of a chamber; else two halves, the groups
    taken in turn. No fold is all there is."""
    labels = [int(g) for g in np.unique(problem.group)]
    folds = [labels[0::2], labels[1::2]]
    if part.stage == "thermal":
        assert plan.opened.keys.thermal is not None
        verify = tuple(f"{run}," for run in plan.opened.keys.thermal.verify)
        folds = [[g for g in labels if problem.group_names.get(g, "").startswith(verify)]] if verify else []
    return [fold for fold in folds if 0 < len(fold) < len(labels)]


def _refits(problem: ResidualProblem, result: LoopResult, folds: list[list[int]]) -> list[dict[str, Any]]:
    """For each fold its groups' names, and the effects as all other groups have them; empty where nothing was added."""
    out = []
    for fold in folds if result.values else []:
        values, _ = closed_loop.refit(problem, {k: dict(v) for k, v in result.values.items()}, fold)
        names = [problem.group_names.get(g, str(g)) for g in fold]
        out.append({"groups": names, "effects": plain(nested(values))})
    return out


def pictures_of(problem: ResidualProblem, result: LoopResult) -> xr.Dataset:
    """Residual before and after, the terms of the effects, covariates; all over the samples."""
    n = problem.group.size
    unit = {"units": problem.unit}
    channel = np.zeros(n, int) if problem.channel is None else problem.channel
    variables: dict[str, Any] = {
        "before": ("sample", result.pictures.before, unit),
        "after": ("sample", result.pictures.after, unit),
        "time": ("sample", problem.time),
        "group": ("sample", problem.group),
        "series": ("sample", problem.series),
        "channel": ("sample", channel),
    }
    variables |= {f"term_{name}": ("sample", term, unit) for name, term in result.pictures.terms.items()}
    variables |= {
        f"covariate_{i}": ("sample", x.values if isinstance(x, Basis) else x, {"long_name": name})
        for i, (name, x) in enumerate(problem.covariates.items())
    }
    return xr.Dataset(variables, attrs={"stage": problem.stage})
