"""Signatures of effects: S = −∂r/∂θ by central differences; members of a grid counted one by one.

Functions
---------
members        the tests that a candidate makes at the present parameters
derivatives    S of given parameters about a point
untied         values with shared parameters as those that they stand for
tied           the reverse
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.residual_problem import Candidate, Parameters, ResidualProblem

Array = NDArray[np.float64]
Values = dict[str, dict[str, float]]

SAME = 1e-9  # relative change of the residual below which a grid point leaves it as it is


@dataclass(frozen=True)
class Member:
    """One test: `columns` (n, q) of an effect begun at `point`; the first one a secant (1 = all of `point`) if `secant`,
    the others belong to `names`. `kind` of hypothesis: one "shared" number, "one" parameter, or "several"."""

    effect: str
    point: dict[str, float]
    names: tuple[str, ...]
    columns: Array
    secant: bool = False
    kind: str = "several"

    def start(self, amplitude: Array) -> dict[str, float]:
        """Parameters that the linear fit (q,) of the columns stands for; a secant within 0.3 to 2 of its point.

        What the grid point puts to zero, the null, is not named: it stays out of the estimate.
        """
        values = {name: value for name, value in self.point.items() if value != 0.0}
        if self.secant:
            share = float(np.clip(amplitude[0], 0.3, 2.0))
            values = {name: share * value for name, value in values.items()}
            amplitude = amplitude[1:]
        for name, value in zip(self.names, amplitude, strict=True):
            values[name] = values.get(name, 0.0) + float(value)
        return values


def merged(values: Parameters, effect: str, change: dict[str, float]) -> Values:
    """`values` with the parameters `change` of `effect` set."""
    out = {name: dict(parameters) for name, parameters in values.items()}
    out[effect] = {**out.get(effect, {}), **change}
    return out


def untied(values: Parameters, candidates: Mapping[str, Candidate]) -> Values:
    """`values` without shared parameters, each of those that they stand for by its own name."""
    out: Values = {}
    for effect, given in values.items():
        out[effect] = {n: v for n, v in given.items() if n not in candidates[effect].shared}
        for name, each in candidates[effect].shared.items():
            if name in given:
                out[effect] |= {n: given.get(n, 0.0) + given[name] for n in each}
    return out


def tied(values: Parameters, candidates: Mapping[str, Candidate]) -> Values:
    """`values` with parameters that may share a number, and are equal to the last digit, as the one that they share."""
    out: Values = {effect: dict(given) for effect, given in values.items()}
    for effect, given in out.items():
        for name, each in candidates[effect].shared.items():
            if all(n in given for n in each) and len({given[n] for n in each}) == 1:
                given[name] = given[each[0]]
                for n in each:
                    del given[n]
    return out


def derivatives(problem: ResidualProblem, values: Parameters, candidate: Candidate, names: Sequence[str]) -> Array:
    """−∂r/∂θ (n, q) at `values`; one-sided where a central step would leave the physical bounds."""
    columns = []
    for name in names:
        parameter = candidate.parameters[name]
        at = values.get(candidate.effect, {}).get(name, 0.0)
        high = min(at + parameter.difference, parameter.largest)
        low = max(at - parameter.difference, parameter.low)
        up = problem.residual(merged(values, candidate.effect, {name: high}))
        down = problem.residual(merged(values, candidate.effect, {name: low}))
        columns.append(-(up - down) / (high - low))
    return np.column_stack(columns) if columns else np.zeros((problem.group.size, 0))


def members(problem: ResidualProblem, values: Parameters, residual: Array, candidate: Candidate) -> list[Member]:
    """The tests of a candidate at `values`, where the residual (n,) is `residual`; signatures that are zero are left out."""
    found = []
    for point in candidate.grid or ({},):
        at = merged(values, candidate.effect, dict(point)) if point else values
        names = tuple(name for name in candidate.parameters if name not in point)
        columns = derivatives(problem, at, candidate, names)
        secant = False
        if point:
            change = residual - problem.residual(at)
            secant = bool(np.linalg.norm(change) > SAME * np.linalg.norm(residual))
            if secant:
                columns = np.column_stack([change, columns])
        if columns.shape[1] and np.isfinite(columns).all() and np.any(columns):
            kind = "several" if len(names) != 1 else "shared" if names[0] in candidate.shared else "one"
            found.append(Member(candidate.effect, dict(point), names, columns, secant, kind))
    return found
