"""The end of a loop: one look at the sealed group, final values, what is left over declared noise, the verdict.

Functions
---------
close        the result
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.residual_problem import Candidate, ResidualProblem
from stages.closed_loop import confirmation, identifiability
from stages.closed_loop.confirmation import Model
from stages.closed_loop.estimation import Estimate
from stages.closed_loop.noise import Layout, Noise, fit_noise, gram
from stages.closed_loop.result import Considered, LoopResult, Pictures, Sealed, Step, Value, Verdict
from stages.closed_loop.score_test import solve
from stages.closed_loop.separation import would_separate
from stages.closed_loop.settings import LoopSettings
from stages.closed_loop.signatures import untied
from stages.closed_loop.state import CERTAIN, State, left

Array = NDArray[np.float64]
Index = NDArray[np.intp]

EXCESS = 1.1  # RMS over a known sigma that is more than noise
LAGS = 8  # samples apart, over which it is looked at for structure


def close(
    problem: ResidualProblem,
    layout: Layout,
    state: State,
    candidates: Mapping[str, Candidate],
    null: Array,
    sealed: int | None,
    limits: Sequence[identifiability.Limit],
    considered: Mapping[str, Considered],
    settings: LoopSettings,
) -> LoopResult:
    """The sealed group, once; final values of all steps; the verdict."""
    rows = layout.rows
    noise = state.noise or fit_noise(layout, state.columns[rows], state.residual[rows])
    before = Model(null, np.asarray(problem.nuisance, float))
    after = Model(state.residual, state.columns)
    rms_before = rms_after = _cross_validated(problem, rows, before, noise)
    if state.steps:
        rms_after = _cross_validated(problem, rows, after, noise)
    once: Sealed | None = None
    steps = [_with_values(problem, s, state.estimate, candidates) for s in state.steps]
    values: Mapping[str, Mapping[str, float]] = untied(state.values, candidates)
    if sealed is not None and np.isfinite(null).all():
        held = np.flatnonzero(problem.group == sealed)
        e0, l0, _ = confirmation.held_out(problem, rows, held, before, noise, refit=bool(state.steps))
        e1, l1 = e0, l0
        if state.steps:
            e1, l1, _ = confirmation.held_out(problem, rows, held, after, noise)
        name = problem.group_names.get(sealed, str(sealed))
        once = Sealed(name, float(np.sqrt(np.mean(e0**2))), float(np.sqrt(np.mean(e1**2))), l1 - l0)
        if steps and once.log_likelihood < -settings.decisive and once.after > once.before:
            names = ", ".join(s.effect for s in steps)
            state.notes.append(
                f"taken back, {names}: the sealed group {name} is worse with it,"
                f" {once.before:.3g} → {once.after:.3g} {problem.unit}"
            )
            state.certain.append(names)
            steps, values, rms_after = [], {}, rms_before
            state.refused |= {s.effect: f"taken back: the sealed group {name} is worse with it" for s in state.steps}
            state.estimate, state.residual, state.nuisance = None, null, before.columns
    if (excess := _excess(problem, layout, state)) is not None:
        rms, correlated = excess
        told = f"what is left is {rms:.3g} times the declared sigma"
        if not correlated:
            told += ", and white: the noise is larger than declared"
        else:
            told += ": something more is missing, or what was added stands for something else" if steps else ""
            state.certain.append("excess")
        state.notes.append(told)
    families = [
        identifiability.Limit(
            (s.effect, *s.indistinguishable_from), f"either explains the data: {s.evidence.rsplit('; ', 1)[-1]}",
            would_separate((s.effect, *s.indistinguishable_from)),
        )
        for s in steps
        if s.indistinguishable_from
    ]  # fmt: skip
    # What could not be told at a plausible size, and was told at the size that it has, is no limit.
    added = {s.effect for s in steps}
    limits = [*families, *(one for one in limits if not added & set(one.effects))]
    verdict: Verdict = "effects_added" if steps else "unexplained" if state.certain else "no_effect"
    return LoopResult(
        problem.stage,
        verdict,
        tuple(steps),
        tuple(limits),
        values,
        noise,
        rms_before,
        rms_after,
        once,
        tuple(state.notes),
        tuple(replace(c, outcome=_outcome(c.effect, steps, state)) for c in considered.values()),
        _pictures(problem, state, null, noise),
        bool(state.certain),
    )


def _excess(problem: ResidualProblem, layout: Layout, state: State) -> tuple[float, bool] | None:
    """RMS of what is left over the declared sigma, of the samples that have one, and whether it is serially correlated, which
    makes it structure and no noise that is larger than declared. None where it is no more than noise can be.

    Portmanteau: Σ_k m_k·ρ_k² ~ χ²_LAGS of white noise, ρ_k over the m_k pairs of samples k apart in a series.
    """
    sigma = np.broadcast_to(np.nan if problem.sigma is None else problem.sigma, problem.group.shape)[layout.rows]
    known = np.isfinite(sigma)
    z = np.where(known, left(layout, state) / np.where(known, sigma, 1.0), 0.0)
    count, power = int(known.sum()), float(z @ z)
    if count <= state.columns.shape[1] or power <= EXCESS**2 * count:
        return None
    if chdtrc(count - state.columns.shape[1], power) >= CERTAIN:
        return None
    series, total = problem.series[layout.rows], 0.0
    for k in range(1, LAGS + 1):
        pairs = (series[k:] == series[:-k]) & known[k:] & known[:-k]
        if pairs.any():
            total += pairs.sum() * float((z[k:] * z[:-k])[pairs].sum() / power * count / pairs.sum()) ** 2
    return float(np.sqrt(power / count)), bool(chdtrc(LAGS, total) < CERTAIN)


def _outcome(effect: str, steps: Sequence[Step], state: State) -> str:
    if any(step.effect == effect for step in steps):
        return "added"
    if other := [step.effect for step in steps if effect in step.indistinguishable_from]:
        return f"cannot be told from {', '.join(other)}"
    if effect in state.dropped:
        return "taken out again"
    if state.enough:
        return "not asked: what is left is within the method's own accuracy"
    return state.refused.get(effect, "does not stand out" if not steps else "does not stand out beside what was added")


def _pictures(problem: ResidualProblem, state: State, null: Array, noise: Noise) -> Pictures:
    """On all samples, the sealed group's too."""
    layout = Layout.of(problem, np.arange(problem.group.size))
    own = np.asarray(problem.nuisance, float)

    def left(data: Array, columns: Array) -> Array:
        if not columns.shape[1]:
            return data
        both = np.column_stack([columns, data])
        beta, _ = solve(gram(layout, noise, both), range(columns.shape[1]))
        return data - columns @ beta

    terms = {}
    for effect in state.values:
        without = {name: v for name, v in state.values.items() if name != effect}
        terms[effect] = left(np.asarray(problem.residual(without), float) - state.residual, own)
    return Pictures(left(null, own), left(state.residual, state.nuisance), terms)


def _cross_validated(problem: ResidualProblem, rows: Index, model: Model, noise: Noise) -> float:
    """RMS of the groups held out one by one."""
    folds = [rows[f] for f in confirmation.folds_of(problem.group[rows])]
    if len(folds) < 2:
        return float("nan")
    errors = [confirmation.held_out(problem, np.setdiff1d(rows, held), held, model, noise, False)[0] for held in folds]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def _with_values(
    problem: ResidualProblem, step: Step, estimated: Estimate | None, candidates: Mapping[str, Candidate]
) -> Step:
    """The step with the final joint estimate's parameters and their correlations with all others."""
    if estimated is None or step.effect not in estimated.values:
        return step
    units = candidates[step.effect].parameters
    every = [
        (other, name, j)
        for j, (other, what) in enumerate(estimated.order)
        for name in candidates[other].shared.get(what, (what,))
    ]
    parameters, correlations = {}, {}
    for effect, name, i in every:
        if effect != step.effect:
            continue
        value = estimated.values[effect][estimated.order[i][1]]
        parameters[name] = Value(value, float(estimated.sigma[i]), units[name].unit)
        for other, what, j in every:
            if (other, what) != (effect, name):
                correlations[f"{name}, {other}.{what}"] = float(estimated.correlation[i, j])
    return replace(step, parameters=parameters, correlations=correlations)
