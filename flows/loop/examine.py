"""The engine on one part of a campaign, as a cached step: result as JSON, the residual's pictures as NetCDF.

Effects of navigation must not make fixes worse that neither path nor effects have seen: else they are taken back.
Beside the answer it keeps, for spectral effects that were added, their parameters without each half of the groups: RQE on
held-out targets is made with those.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from flows.loop.problems import Part, inputs_of, picked_px, problem_of, receivers_of, settings_of
from flows.loop.withheld import Misses, size, withheld_m
from flows.steps import Paths, Plan, plain
from pipeline.datasets import write_dataset
from pipeline.errors import StageError
from pipeline.residual_problem import Basis, ResidualProblem
from pipeline.run_stage import StageRecord, run_stage, write_json
from stages import closed_loop, tracking
from stages.closed_loop import LoopResult
from tsmftis.effects import EFFECTS, nested, scalars

FOLDER = "loop"
WORSE = 0.01  # by which an effect may make withheld fixes worse: as much is chance, of one that hardly shows
TAKEN_BACK = (
    "withheld fixes are missed by {0:.3g} m horizontally, {1:.3g} m vertically with it, {2:.3g} and {3:.3g} m without"
)


def examine_step(root: Path, plan: Plan, part: Part, seed: int) -> StageRecord:
    """`root`/loop/<part>.json and .nc from the results in `plan.out`; the content of the JSON is the record's summary."""

    def work(to: Paths) -> dict[str, Any]:
        with threadpool_limits(limits=1), _telling(part):
            problem = problem_of(plan, part)
            result, missed = closed_loop.run(problem, plan.settings.closed_loop, seed), None
            if part.stage == "navigation":
                result, missed = _held_against_fixes(plan, problem, result, seed)
            content = content_of(part, problem, result)
            if part.stage == "navigation":
                content["withheld_m"] = None if missed is None else dict(zip(("before", "after"), missed, strict=True))
                content["receiver"] = receivers_of(problem)
                if content["receiver"] and content["verdict"] == "no_effect":
                    content["verdict"] = "unexplained"  # and told in the notes
            if part.stage == "geometry":
                learned = [one["covariate"] for one in tracking.applied(learned_of(content))]
                content["picked_px"] = picked_px(plan, result.values, learned)
                for step in content["steps"]:
                    if "table" in step:
                        step["applied"] = step["effect"].removeprefix("learned:") in learned
        write_json(to["result"], content)
        write_dataset(pictures_of(problem, result), to["pictures"])
        return content

    return run_stage(
        root,
        "loop",
        part.name,
        ("stages.closed_loop", "flows.loop.problems", "flows.loop.withheld"),
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


@contextmanager
def _telling(part: Part) -> Iterator[None]:
    """Data of which no statistics can be made end in one line, and leave the other parts their turn."""
    try:
        yield
    except (ArithmeticError, RuntimeError, ValueError) as error:  # numpy's and torch's linear algebra among them
        raise StageError(f"no residual of the part {part.name} could be examined: {error}") from error


def _held_against_fixes(
    plan: Plan, problem: ResidualProblem, result: LoopResult, seed: int
) -> tuple[LoopResult, Misses | None]:
    """The answer without effects that make fixes worse, which neither path nor effects have seen; how far these are missed."""
    first, out = result, dict[str, str]()
    while True:
        missed = withheld_m(plan, result.values) if result.values or problem.beside else None
        if missed is None or not result.values:
            break
        without: dict[str, list[float]] = {}
        for effect in result.values:
            rest = {name: v for name, v in result.values.items() if name != effect}
            other = withheld_m(plan, rest)
            if other is not None:
                without[effect] = other[1]
        if not without:
            break
        effect = min(without, key=lambda name: size(without[name]))
        if size(missed[1]) <= (1.0 + WORSE) * size(without[effect]):
            break
        out[effect] = TAKEN_BACK.format(*missed[1], *without[effect])
        kept = tuple(c for c in problem.candidates if c.effect not in out)
        result = closed_loop.run(replace(problem, candidates=kept), plan.settings.closed_loop, seed)
    return closed_loop.taken_back(result, out, first.considered) if out else result, missed


def content_of(part: Part, problem: ResidualProblem, result: LoopResult) -> dict[str, Any]:
    """What loop.json and the page say of a part, in plain data."""
    content = result.to_dict()
    return content | {
        "stage": part.stage,
        "bench": part.bench,
        "steps": [
            step | {"parameters": gathered(step["effect"], step["parameters"])} | units_of(problem, step)
            for step in content["steps"]
        ],
        "unexplained": result.unexplained,
        "considered": plain(result.considered),
        "sealed": plain(result.sealed),
        "heldout_rms": {
            "before": _known(result.rms_before),
            "after": _known(result.rms_after),
            "unit": problem.unit,
        },
        "samples": int(problem.group.size),
        "groups": [problem.group_names.get(int(g), str(g)) for g in np.unique(problem.group)],
        "effects": plain(nested(result.values)),
        "without": _refits(problem, result) if part == Part("spectral") else [],
    }


def learned_of(answer: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
    """The curves that an answer adds, as a model update has them."""
    return tuple(
        {
            "stage": step["stage"],
            "covariate": step["effect"].removeprefix("learned:"),
            "covariate_unit": step["units"]["covariate"],
            "unit": ", ".join(dict.fromkeys(u for column, u in step["units"].items() if column != "covariate")),
            "table": step["table"],
        }
        for step in answer["steps"]
        if "table" in step
    )


def _known(value: float) -> float | None:
    """None where there is no figure: of a single group nothing is held out."""
    return value if math.isfinite(value) else None


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


def _refits(problem: ResidualProblem, result: LoopResult) -> list[dict[str, Any]]:
    """For each half of the groups, taken in turn, their names and the effects as the other half has them; empty where nothing was
    added, or there are no halves."""
    labels = [int(g) for g in np.unique(problem.group)]
    out = []
    for half in (labels[0::2], labels[1::2]) if result.values and len(labels) > 1 else ():
        values = closed_loop.refit(problem, {k: dict(v) for k, v in result.values.items()}, half)
        names = [problem.group_names.get(g, str(g)) for g in half]
        out.append({"groups": names, "effects": plain(nested(values))})
    return out


def units_of(problem: ResidualProblem, step: Mapping[str, Any]) -> dict[str, Any]:
    """`units` of a learned term's table, by its columns; nothing for a named effect."""
    if "table" not in step:
        return {}
    covariate = problem.covariates[step["effect"].removeprefix("learned:")]
    if isinstance(covariate, Basis):
        return {"units": {"covariate": covariate.unit, **covariate.units}}
    return {"units": {"covariate": "", "value": problem.unit}}


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
        f"covariate_{i}": (
            ("sample", x.values, {"long_name": name, "units": x.unit})
            if isinstance(x, Basis)
            else ("sample", x, {"long_name": name})
        )
        for i, (name, x) in enumerate(problem.covariates.items())
    }
    return xr.Dataset(variables, attrs={"stage": problem.stage})
