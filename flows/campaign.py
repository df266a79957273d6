"""Prefect flows: a line, a flight, a campaign. Tasks are whole stages of a unit and pass plans, never arrays.

`run_campaign` is what the command line calls: one flow a command, on the embedded engine, in two threads; or on a Dask
cluster whose machines share the folders.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from flows import engine

# isort: split
# Prefect reads its environment when it is imported, so the engine comes first.
from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.futures import PrefectFuture, as_completed
from prefect.task_runners import ThreadPoolTaskRunner
from threadpoolctl import threadpool_limits

from flows import steps
from flows.steps import NEEDS, Plan, reaches
from pipeline.errors import InputError, TsmftisError
from pipeline.run_stage import StageRecord

WORKERS = 2
LINE_STAGES = ("tracking", "registration", "reconstruction", "mapping", "scoring")

Listener = Callable[[StageRecord], None]
Future = PrefectFuture[StageRecord]

# Not among a flow's parameters: those travel with every task to other machines, which a terminal cannot.
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@task(name="stage", task_run_name="{stage} {unit}", cache_policy=NO_CACHE, persist_result=False)
def run_step(plan: Plan, stage: str, unit: str, before: list[StageRecord]) -> StageRecord:
    """One stage of one unit, after those `before` it. A stage that fails says so in its record, and stops its chain alone."""
    if any(record.status != "done" for record in before):
        return StageRecord(stage, unit, "skipped", False, 0.0, "", {})
    step = getattr(steps, f"{stage}_step")
    arguments = () if stage == "thermal" else tuple(unit.split("/"))
    try:
        record: StageRecord = step(plan, *arguments)
    except TsmftisError as error:
        return StageRecord(stage, unit, "failed", False, 0.0, "", {}, error)
    return record


@dataclass
class Graph:
    """Tasks in the order of submission; each waits for those of the stages that its own needs, in its own unit or above it."""

    plan: Plan
    upto: str | None = None  # only what this stage needs, and itself
    futures: list[Future] = field(default_factory=list)
    by_stage: dict[tuple[str, str], Future] = field(default_factory=dict)

    def submit(self, stage: str, unit: str) -> None:
        if not self.plan.does(stage) or not (self.upto is None or reaches(stage, self.upto)):
            return
        flight = unit.split("/")[0]
        waits = [self.by_stage.get((need, where)) for need in NEEDS[stage] for where in (unit, flight, "campaign")]
        before = [future for future in waits if future is not None]
        # Futures among the arguments are waited for and handed over as what they came to.
        future = run_step.submit(plan=self.plan, stage=stage, unit=unit, before=before, return_state=False)
        self.futures.append(future)
        self.by_stage[stage, unit] = future

    def line(self, flight: str, line: str) -> None:
        for stage in LINE_STAGES:
            self.submit(stage, f"{flight}/{line}")

    def flight(self, flight: str) -> None:
        self.submit("navigation", flight)
        for line in self.plan.opened.flight(flight).lines:
            if self.plan.wants(flight, line.id):
                self.line(flight, line.id)

    def campaign(self) -> None:
        keys = self.plan.opened.keys
        if keys.thermal is not None:
            self.submit("thermal", "campaign")
        for flight in keys.flights:
            if not self.plan.lines or any(self.plan.wants(flight.id, entry.id) for entry in flight.lines):
                self.flight(flight.id)
        for bench in keys.bench:
            if not self.plan.lines:
                self.submit("bench", bench.id)

    def results(self) -> list[StageRecord]:
        """Records in the order of submission, failed and skipped ones among them; the listener hears of each as it ends."""
        listener = _listener.get()
        for future in as_completed(self.futures):
            future.wait()
            if listener and future.state.is_completed():
                listener(future.result())
        # Only a bug in a stage leaves a task that did not complete: its exception is raised, not that of one waiting for it.
        for future in self.futures:
            if future.state.is_failed() or future.state.is_crashed():
                future.result()
        return [future.result() for future in self.futures]


@flow(name="line", validate_parameters=False, persist_result=False)
def line_flow(plan: Plan, flight: str, line: str) -> list[StageRecord]:
    """The stages of one line, on the flight's trajectory as it is."""
    graph = Graph(plan)
    graph.line(flight, line)
    return graph.results()


@flow(name="flight", validate_parameters=False, persist_result=False)
def flight_flow(plan: Plan, flight: str) -> list[StageRecord]:
    """Navigation and the lines of one flight, on the thermal model as it is."""
    graph = Graph(plan)
    graph.flight(flight)
    return graph.results()


@flow(name="campaign", validate_parameters=False, persist_result=False)
def campaign_flow(plan: Plan) -> list[StageRecord]:
    """Thermal model, flights, lines and bench interferograms of a campaign."""
    graph = Graph(plan)
    graph.campaign()
    return graph.results()


def run_campaign(plan: Plan, listener: Listener | None = None, dask: str | None = None) -> list[StageRecord]:
    """Run the campaign flow; `listener` hears of each stage as it ends; `dask`: a scheduler's address, or "local"."""
    return run_flow(campaign_flow, listener, dask, plan)


def run_flight(plan: Plan, flight: str, listener: Listener | None = None) -> list[StageRecord]:
    """Run the flight flow alone."""
    return run_flow(flight_flow, listener, None, plan, flight)


def run_line(plan: Plan, flight: str, line: str, listener: Listener | None = None) -> list[StageRecord]:
    """Run the line flow alone."""
    return run_flow(line_flow, listener, None, plan, flight, line)


def run_flow(what: Any, listener: Listener | None, dask: str | None, *arguments: Any) -> Any:
    """A flow on the embedded engine, or on Dask; what it returns."""
    runner: Any = ThreadPoolTaskRunner(max_workers=WORKERS) if dask is None else _dask_runner(dask)
    token = _listener.set(listener)
    try:
        # One thread a matrix product: rounding hangs on how a product is shared out, and two lines run at once anyway.
        with engine.quiet_engine(), threadpool_limits(limits=1):
            return what.with_options(task_runner=runner)(*arguments)
    finally:
        _listener.reset(token)


def _dask_runner(address: str) -> Any:
    try:
        from prefect_dask import DaskTaskRunner
    except ImportError as error:
        raise InputError("--dask", "prefect-dask", "is not installed", 'pip install "tsmftis[dask]"') from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if address == "local":
        quiet = {"dashboard_address": None, "silence_logs": logging.CRITICAL}
        return DaskTaskRunner(cluster_kwargs={"n_workers": WORKERS, "threads_per_worker": 1, **quiet})
    return DaskTaskRunner(address=address)
