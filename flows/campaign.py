"""Prefect flows: a line, a flight, a campaign. Tasks are whole stages of a unit and pass plans, never arrays.

`run_campaign` is what the command line calls: one flow a command, on the embedded engine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flows import engine  # noqa: I001  (must come before prefect: it sets prefect's environment)

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.futures import PrefectFuture
from prefect.task_runners import ThreadPoolTaskRunner

from flows import steps
from flows.steps import Plan
from pipeline.errors import InputError, TsmftisError
from pipeline.run_stage import StageRecord

WORKERS = 2

Report = Callable[[StageRecord], None]
_listeners: list[Report] = []


@task(name="stage", task_run_name="{stage} {unit}", cache_policy=NO_CACHE, persist_result=False)
def run_step(plan: Plan, stage: str, unit: str) -> StageRecord:
    """One stage of one unit. A stage that fails says so in its record, so that the other lines go on."""
    step = getattr(steps, f"{stage}_step")
    arguments = () if stage == "thermal" else tuple(unit.split("/"))
    try:
        record = step(plan, *arguments)
    except InputError:
        raise
    except TsmftisError as error:
        record = StageRecord(stage, unit, "failed", False, 0.0, "", {}, str(error))
    for listener in _listeners:
        listener(record)
    return record


@dataclass
class _Graph:
    """Submitted tasks in order; a task waits for those before it in its own unit's chain."""

    plan: Plan
    futures: list[PrefectFuture[StageRecord]]

    def submit(self, stage: str, unit: str, after: list[PrefectFuture[StageRecord]]) -> list[PrefectFuture[StageRecord]]:
        if not self.plan.does(stage):
            return after
        future = run_step.submit(self.plan, stage, unit, wait_for=after)
        self.futures.append(future)
        return [future]

    def line(self, flight: str, line: str, after: list[PrefectFuture[StageRecord]]) -> None:
        for stage in ("tracking", "registration", "reconstruction", "mapping", "scoring"):
            after = self.submit(stage, f"{flight}/{line}", after)

    def flight(self, flight: str, after: list[PrefectFuture[StageRecord]]) -> None:
        after = self.submit("navigation", flight, after)
        for line in self.plan.opened.flight(flight).lines:
            if self.plan.wants(flight, line.id):
                self.line(flight, line.id, after)

    def results(self) -> list[StageRecord]:
        """Records in the order of submission; the first error of a task is raised after all have ended."""
        states = [future.state if future.wait() is None else future.state for future in self.futures]
        return [state.result() for state in states]


@flow(name="line", task_runner=ThreadPoolTaskRunner(max_workers=WORKERS), validate_parameters=False, persist_result=False)
def line_flow(plan: Plan, flight: str, line: str) -> list[StageRecord]:
    """The stages of one line, on the flight's trajectory as it is."""
    graph = _Graph(plan, [])
    graph.line(flight, line, [])
    return graph.results()


@flow(name="flight", task_runner=ThreadPoolTaskRunner(max_workers=WORKERS), validate_parameters=False, persist_result=False)
def flight_flow(plan: Plan, flight: str) -> list[StageRecord]:
    """Navigation and the lines of one flight, on the thermal model as it is."""
    graph = _Graph(plan, [])
    graph.flight(flight, [])
    return graph.results()


@flow(name="campaign", task_runner=ThreadPoolTaskRunner(max_workers=WORKERS), validate_parameters=False, persist_result=False)
def campaign_flow(plan: Plan) -> list[StageRecord]:
    """Thermal model, flights, lines and bench interferograms of a campaign."""
    graph = _Graph(plan, [])
    keys = plan.opened.keys
    thermal = graph.submit("thermal", "campaign", []) if keys.thermal is not None else []
    for flight in keys.flights:
        if any(plan.wants(flight.id, entry.id) for entry in flight.lines) or not plan.lines:
            graph.flight(flight.id, thermal)
    for bench in keys.bench:
        graph.submit("bench", bench.id, [])
    return graph.results()


def run_campaign(plan: Plan, listener: Report | None = None) -> list[StageRecord]:
    """Run the campaign flow on a quiet embedded engine; `listener` hears of each stage as it ends."""
    return _run(campaign_flow, listener, plan)


def run_flight(plan: Plan, flight: str, listener: Report | None = None) -> list[StageRecord]:
    """Run the flight flow alone."""
    return _run(flight_flow, listener, plan, flight)


def run_line(plan: Plan, flight: str, line: str, listener: Report | None = None) -> list[StageRecord]:
    """Run the line flow alone."""
    return _run(line_flow, listener, plan, flight, line)


def _run(what: Any, listener: Report | None, *arguments: Any) -> list[StageRecord]:
    listeners = [listener] if listener else []
    _listeners.extend(listeners)
    try:
        with engine.quiet_engine():
            return what(*arguments)
    finally:
        for one in listeners:
            _listeners.remove(one)
