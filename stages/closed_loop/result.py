"""What the loop answers for one stage: the parts of loop.json that are its own, and what a person reads.

`taken_back` is the answer once some of what was added has failed on data that the engine does not have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stages.closed_loop.identifiability import Limit
from stages.closed_loop.noise import Noise

Verdict = Literal["effects_added", "no_effect", "unexplained"]


@dataclass(frozen=True)
class Value:
    """A parameter's value with its sigma and unit."""

    value: float
    sigma: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        return {"value": self.value, "sigma": self.sigma, "unit": self.unit}


@dataclass(frozen=True)
class Step:
    """One effect added; held-out figures are RMS in the residual's unit. `table`: the curve of a learned term."""

    stage: str
    effect: str
    parameters: Mapping[str, Value]
    evidence: str
    indistinguishable_from: tuple[str, ...]
    heldout_before: float
    heldout_after: float
    p_value: float
    correlations: Mapping[str, float] = field(default_factory=dict)
    table: Mapping[str, list[float]] | None = None

    def to_dict(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "stage": self.stage,
            "effect": self.effect,
            "parameters": {name: value.to_dict() for name, value in self.parameters.items()},
            "evidence": self.evidence,
            "indistinguishable_from": list(self.indistinguishable_from),
            "heldout_before": self.heldout_before,
            "heldout_after": self.heldout_after,
            "p_value": self.p_value,
            "correlations": dict(self.correlations),
        }
        if self.table is not None:
            out["table"] = dict(self.table)
        return out


@dataclass(frozen=True)
class Considered:
    """A candidate as it stood before anything was added: χ² of its best member and rank, p of that member alone (not yet of the
    largest of many), how many tests it makes, and what became of it."""

    effect: str
    chi2: float
    rank: int
    p: float
    tests: int
    outcome: str


@dataclass(frozen=True)
class Pictures:
    """Residual (n,) with the stage's own columns taken out by generalised least squares, before and after; `terms`: what each
    effect added contributes (n,), the same columns taken out, so that residual against term has the slope one."""

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    terms: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Sealed:
    """The group that was touched once, at the end: RMS before and after, gain in log-likelihood."""

    group: str
    before: float
    after: float
    log_likelihood: float


@dataclass(frozen=True)
class LoopResult:
    """Verdict of one stage with its steps, limits, notes; `values` are the effects that its model lacked; `considered` the
    library as it was first looked at; `pictures` the residual for a figure; `unexplained`: whether something is left for which
    nothing that was added accounts, whatever the verdict."""

    stage: str
    verdict: Verdict
    steps: tuple[Step, ...]
    not_identifiable: tuple[Limit, ...]
    values: Mapping[str, Mapping[str, float]]
    noise: Noise
    rms_before: float
    rms_after: float
    sealed: Sealed | None
    notes: tuple[str, ...]
    considered: tuple[Considered, ...]
    pictures: Pictures
    unexplained: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Verdict, steps, limits and notes as plain data, with the keys of loop.json."""
        return {
            "verdict": self.verdict,
            "steps": [step.to_dict() for step in self.steps],
            "not_identifiable": [
                {"effects": list(one.effects), "why": one.why, "would_separate": one.would_separate}
                for one in self.not_identifiable
            ],
            "notes": list(self.notes),
        }


def taken_back(result: LoopResult, why: Mapping[str, str], considered: Sequence[Considered]) -> LoopResult:
    """The answer of a library without some effects, that an answer with them had added: effect → what speaks against it;
    `considered`: of the whole library. Where nothing else is added, something is there, and what was added is not it."""
    outcome = {name: f"taken back: {text}" for name, text in why.items()}
    known = {one.effect: one for one in (*considered, *result.considered)}
    return replace(
        result,
        verdict=result.verdict if result.steps or not why else "unexplained",
        unexplained=result.unexplained or bool(why),
        notes=(*result.notes, *(f"{name} {text}" for name, text in outcome.items())),
        considered=tuple(replace(one, outcome=outcome.get(name, one.outcome)) for name, one in known.items()),
    )
