"""The Prefect flow that closes the loop, and loop.json.

before/           the campaign as declared
loop/             the engine's answer for each part, in the order of processing; each part reads what the stages before it
                  left, made with the effects found so far
model-update.yaml what the models lack
after/            the campaign with it; what the update does not touch is taken over from before/
loop.json, loop.html
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.campaign import Graph, Listener, run_flow

# isort: split
# Prefect reads its environment when flows.campaign imports the engine.
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.loop.examine import examine_step, learned_of
from flows.loop.held_out import Answers, held_out_step
from flows.loop.problems import NothingThere, Part, lines_of, parts_of
from flows.results import assemble, write_run
from flows.steps import Plan, reaches
from pipeline.errors import StageError, TsmftisError
from pipeline.model_update import ModelUpdate, write_model_update
from pipeline.run_stage import StageRecord, write_json
from stages import tracking
from tsmftis import __version__

SCHEMA = "tsmftis-loop/1"
BEFORE, AFTER, UPDATE = "before", "after", "model-update.yaml"
DOUBTFUL_PATH = "navigation left something unexplained: what is added here may stand for an error of the path"


@dataclass(frozen=True)
class Closed:
    """What the flow came to: content of loop.json, all stages' records."""

    content: dict[str, Any]
    records: list[StageRecord]


@task(name="loop", task_run_name="loop {part.name}", cache_policy=NO_CACHE, persist_result=False)
def examine(root: Path, plan: Plan, part: Part, seed: int) -> StageRecord:
    """The engine on one part. What the part's files cannot serve for is said in the record."""
    try:
        return examine_step(root, plan, part, seed)
    except TsmftisError as error:
        status = "skipped" if isinstance(error, NothingThere) else "failed"
        return StageRecord("loop", part.name, status, False, 0.0, "", {}, error)


@task(name="held-out", cache_policy=NO_CACHE, persist_result=False)
def hold_out(
    root: Path, before: Plan, last: Plan, answers: Answers, runs: tuple[dict[str, Any], dict[str, Any]]
) -> StageRecord:
    """Figures on held-out data. Where they cannot be made, the answer stands without them."""
    try:
        return held_out_step(root, before, last, answers, runs)
    except TsmftisError as error:
        return StageRecord("loop", "held-out", "failed", False, 0.0, "", {}, error)


@flow(name="close-loop", validate_parameters=False, persist_result=False)
def close_loop_flow(plan: Plan, seed: int) -> Closed:
    """`plan.out` is the loop's folder; see the module for what lies in it."""
    root, listener = plan.out, _listener.get()
    before, after = replace(plan, out=root / BEFORE), replace(plan, out=root / AFTER)
    for folder in (root, before.out):
        folder.mkdir(parents=True, exist_ok=True)
    records = _campaign(before)
    write_run(before, first := assemble(before, records))
    parts, missing = parts_of(before)
    update, answers = ModelUpdate(), dict[str, dict[str, Any]]()
    made = records
    for part in parts:
        now = replace(after, update=update) if _changes(update) else before
        if _changes(update) and part.needs is not None:
            _take_over(before.out, after.out)
            records += (made := _campaign(now, upto=part.needs))
        if failed := _failed(made, part):
            missing[part.name] = f"the stage {failed} before it failed"
            continue
        record = examine.submit(root, now, part, seed).result()
        if listener:
            listener(record)
        records.append(record)
        if record.problem is not None:
            missing[part.name] = str(record.problem)
            continue
        answers[part.name] = _doubted(part, record.summary, answers)
        update = _with(update, part, record.summary, alone=_is_all(before))
    if not answers:
        problem = next((record.problem for record in records if record.problem is not None), None)
        raise problem or StageError("; ".join(f"{name}: {why}" for name, why in missing.items()))
    write_model_update(update, root / UPDATE)
    second, last = first, before
    if _changes(update) or any(update.bench.values()):
        _take_over(before.out, after.out)
        last = replace(after, update=update)
        records += (done := _campaign(last))
        write_run(last, second := assemble(last, done))
    elif after.out.exists():
        shutil.rmtree(after.out)  # of an earlier look that found something
    record = hold_out.submit(root, before, last, answers, (first, second)).result()
    records.append(record)
    if listener:
        listener(record)
    if record.problem is not None:
        missing["held-out figures"] = str(record.problem)
    figures = record.summary or {"before": {}, "after": {}, "how": {}}
    return Closed(_content(plan, seed, answers, missing, second is not first, figures), records)


def run_loop(plan: Plan, seed: int, listener: Listener | None = None) -> Closed:
    """Close the loop over a campaign; writes loop.json, loop.html and the runs before and after into `plan.out`."""
    token = _listener.set(listener)
    try:
        closed: Closed = run_flow(close_loop_flow, listener, None, plan, seed)
    finally:
        _listener.reset(token)
    write_json(plan.out / "loop.json", closed.content)
    return closed


# As in flows.campaign: a terminal does not travel with tasks.
_listener: ContextVar[Callable[[StageRecord], None] | None] = ContextVar("loop_listener", default=None)


def _campaign(plan: Plan, upto: str | None = None) -> list[StageRecord]:
    plan.out.mkdir(parents=True, exist_ok=True)
    graph = Graph(plan, upto)
    graph.campaign()
    return graph.results()


def _failed(records: list[StageRecord], part: Part) -> str | None:
    """A stage that the part needs and that was not done: what it left in earlier runs is not what these models make."""
    return next((r.stage for r in records if part.needs and reaches(r.stage, part.needs) and r.status != "done"), None)


def _is_all(plan: Plan) -> bool:
    """Whether the campaign is one laboratory interferogram: its detector is then the instrument's."""
    return not lines_of(plan) and len(plan.opened.keys.bench) == 1


def _take_over(before: Path, after: Path) -> None:
    """What `after` has not yet, as links into `before`: stages that the update does not touch are then found done. A stage that
    runs again replaces a link, and never writes through it."""
    for path in sorted(before.rglob("*")):
        to = after / path.relative_to(before)
        if path.is_dir() or path.name == ".lock" or to.exists():
            continue
        to.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path, to)
        except OSError:  # another file system, or one without links
            shutil.copy2(path, to)


def _changes(update: ModelUpdate) -> bool:
    """Whether it changes what a run over the campaign makes of its flights."""
    return bool(update.effects or update.receiver or tracking.applied(update.learned))


def _doubted(part: Part, answer: dict[str, Any], before: Answers) -> dict[str, Any]:
    """The answer of a part, with a word of warning where geometry adds something to a path that navigation could not explain."""
    if part.stage != "geometry" or not answer["steps"] or not before.get("navigation", {}).get("unexplained"):
        return answer
    return answer | {"notes": [*answer["notes"], DOUBTFUL_PATH]}


def _with(update: ModelUpdate, part: Part, answer: dict[str, Any], alone: bool) -> ModelUpdate:
    """The update with what a part's model was found to lack. A bench interferogram has effects of its own, unless it is the only
    one that the campaign has, and there are no lines."""
    effects = {
        name: {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        for name, values in answer["effects"].items()
    }
    update = replace(
        update,
        learned=(*update.learned, *learned_of(answer)),
        receiver={**update.receiver, **answer.get("receiver", {})},
    )
    if part.bench is not None and not alone:
        return replace(update, bench={**update.bench, part.bench: effects})
    return replace(update, effects={**update.effects, **effects})


def _content(
    plan: Plan,
    seed: int,
    answers: dict[str, dict[str, Any]],
    missing: dict[str, str],
    again: bool,
    held_out: dict[str, Any],
) -> dict[str, Any]:
    steps = [
        step | ({"bench": answer["bench"]} if answer["bench"] else {})
        for answer in answers.values()
        for step in answer["steps"]
    ]
    verdicts = {answer["verdict"] for answer in answers.values()}
    verdict = "effects_added" if steps else "unexplained" if "unexplained" in verdicts else "no_effect"
    return {
        "schema": SCHEMA,
        "campaign": plan.opened.keys.name,
        "verdict": verdict,
        "steps": steps,
        "not_identifiable": [
            {"part": name, **limit} for name, answer in answers.items() for limit in answer["not_identifiable"]
        ],
        "before": held_out["before"],
        "after": held_out["after"],
        "held_out": held_out["how"],
        "model_update": UPDATE,
        "parts": answers,
        "not_examined": missing,
        "provenance": {
            "tsmftis": __version__,
            "seed": seed,
            "settings": plan.settings.model_dump(mode="json"),
            "runs": {"before": f"{BEFORE}/run.json", "after": f"{AFTER if again else BEFORE}/run.json"},
        },
    }
