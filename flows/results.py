"""run.json: what the stages' records say, in the contract's form."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from flows.steps import STAGES, Plan
from pipeline.run_stage import StageRecord, earlier_records, write_json
from tsmftis import __version__

SCHEMA = "tsmftis-run/1"
SCORES = ("rqe", "rqe_area")
PACKAGES = ("numpy", "scipy", "torch", "numba", "opencv-python-headless", "rasterio", "xarray", "prefect")


def assemble(plan: Plan, records: list[StageRecord]) -> dict[str, Any]:
    """The content of run.json from this run's records and, for units it did not touch, from those of earlier runs."""
    known = {(r.stage, r.unit): r for r in [*earlier_records(plan.out), *records]}
    keys = plan.opened.keys
    units = _units(plan)
    stages: dict[str, dict[str, Any]] = {}
    for stage in STAGES:
        for unit in units[stage]:
            if record := known.get((stage, unit)):
                entry = {"status": record.status, "seconds": record.seconds, "digest": record.digest}
                stages.setdefault(stage, {})[unit] = entry | ({"error": str(record.problem)} if record.problem else {})

    def summary(stage: str, unit: str) -> dict[str, Any] | None:
        record = known.get((stage, unit))
        return record.summary if record is not None and record.status == "done" else None

    flights: dict[str, Any] = {}
    partly: dict[str, list[str]] = {}
    for flight in keys.flights:
        lines: dict[str, Any] = {}
        for line in flight.lines:
            unit = f"{flight.id}/{line.id}"
            if not any(unit in s for s in stages.values()):
                continue
            empty: dict[str, Any] = {k: {"rqe": {}, "rqe_area": {}} for k in ("scores", "noise_limit")}
            # A line that this run did not touch may have been scored by an earlier version, which said less.
            score = {**empty, "partly_seen": {}, "high_gradient": []} | (summary("scoring", unit) or {})
            lines[line.id] = {
                "rqe": score["scores"]["rqe"],
                "rqe_area": score["scores"]["rqe_area"],
                "noise_limit": score["noise_limit"],
                "high_gradient": score["high_gradient"],
                **{
                    s: summary(s, unit)
                    for s in ("tracking", "registration", "reconstruction", "mapping")
                    if summary(s, unit)
                },
            }
            for method, targets in score["partly_seen"].items():
                partly.setdefault(method, []).extend(f"{unit}/{t}" for t in targets)
        flights[flight.id] = {"navigation": summary("navigation", flight.id), "lines": lines}
    means = campaign_means(lines_of(flights))
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "targets_scored": {
            method: sum(len(line["rqe"].get(method, {}).get("targets", {})) for line in lines_of(flights))
            for method in means["rqe"]
        },
        "campaign": keys.name,
        **means,
        "noise_limit": campaign_means(_noise(line) for line in lines_of(flights)),
        "high_gradient": {
            "targets": [
                f"{f}/{i}/{t}" for f, e in flights.items() for i, n in e["lines"].items() for t in n["high_gradient"]
            ],
            **campaign_means(_steep(line) for line in lines_of(flights)),
        },
        "partly_seen": partly,
        "flights": flights,
        "bench": {b.id: s for b in keys.bench if (s := summary("bench", b.id)) is not None},
        "stages": stages,
        "provenance": _provenance(plan),
    }
    if keys.thermal and (verification := summary("thermal", "campaign")) is not None:
        content["thermal"] = verification
    return content


def _noise(line: Mapping[str, Any]) -> dict[str, Any]:
    """A line's limits by noise in the form of its scores."""
    return {kind: {m: {"targets": v} for m, v in methods.items()} for kind, methods in line["noise_limit"].items()}


def _steep(line: Mapping[str, Any]) -> dict[str, Any]:
    """A line's scores of the targets with high gradients alone."""
    return {
        kind: {
            m: {"targets": {t: v for t, v in entry["targets"].items() if t in line["high_gradient"]}}
            for m, entry in line[kind].items()
        }
        for kind in SCORES
    }


def lines_of(flights: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The entries of all lines of all flights."""
    return [line for flight in flights.values() for line in flight["lines"].values()]


def write_run(plan: Plan, content: dict[str, Any]) -> Path:
    path = plan.out / "run.json"
    write_json(path, content)
    return path


def _units(plan: Plan) -> dict[str, list[str]]:
    keys = plan.opened.keys
    flights = [f.id for f in keys.flights]
    lines = [f"{f.id}/{line.id}" for f in keys.flights for line in f.lines]
    special = {
        "thermal": ["campaign"] if keys.thermal else [],
        "navigation": flights,
        "bench": [b.id for b in keys.bench],
    }
    return {stage: special.get(stage, lines) for stage in STAGES}


def _provenance(plan: Plan) -> dict[str, Any]:
    return {
        "tsmftis": __version__,
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
        "settings": plan.settings.model_dump(mode="json"),
        "model_update": {k: v for k, v in asdict(plan.update).items() if v},
    }


def campaign_means(lines: Iterable[Mapping[str, Mapping[str, Mapping[str, Any]]]]) -> dict[str, dict[str, float]]:
    """Means over all targets of all lines, {kind: {method: mean}}, from the lines' `scores`."""
    pooled: dict[str, dict[str, list[float]]] = {kind: {} for kind in SCORES}
    for scores in lines:
        for kind in SCORES:
            for method, entry in scores.get(kind, {}).items():
                pooled[kind].setdefault(method, []).extend(entry["targets"].values())
    return {kind: {m: float(np.mean(v)) for m, v in methods.items() if v} for kind, methods in pooled.items()}
