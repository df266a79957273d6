"""The loop itself: test, confirm, add, estimate all together, repeat; then what covariates say; then one look at a sealed group.

1 signatures  2 what can be told at all  3 the largest statistic in coloured noise  4 held-out groups and negative controls
5 joint estimate, signatures anew, drop what is no longer needed, repeat  6 splines of covariates for what is left
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.residual_problem import Candidate, ResidualProblem
from stages.closed_loop import identifiability
from stages.closed_loop.closing import close
from stages.closed_loop.estimation import estimate
from stages.closed_loop.examination import Refusal, examine
from stages.closed_loop.noise import Layout, fit_noise, gram
from stages.closed_loop.remainder import learned_step
from stages.closed_loop.result import Considered, LoopResult
from stages.closed_loop.score_test import log_counts, project, search, spans, statistic
from stages.closed_loop.settings import LoopSettings
from stages.closed_loop.settling import drop_unneeded, narrow, settled
from stages.closed_loop.signatures import Member, Values, members, tied, untied
from stages.closed_loop.state import CERTAIN, State, rms
from stages.closed_loop.wording import p_text

Index = NDArray[np.intp]

SEALED_FROM = 4  # groups


def run(problem: ResidualProblem, settings: LoopSettings, seed: int) -> LoopResult:
    """What `problem`'s model lacks. The same problem, settings and seed give the same answer."""
    rng = np.random.default_rng(seed)
    rows, sealed = _seal(problem, settings, rng)
    layout = Layout.of(problem, rows)
    null = np.asarray(problem.residual({}), float)
    if null.shape != problem.group.shape or not np.isfinite(null[rows]).all():
        raise ValueError(f"{problem.stage}: the residual has shape {null.shape} or is not finite")
    state = State(
        np.asarray(problem.nuisance, float),
        null,
        notes=[*problem.notes, *problem.unnamed],
        certain=list(problem.unnamed),
    )
    candidates = {c.effect: c for c in problem.candidates}
    state.noise = fit_noise(layout, state.nuisance[rows], null[rows])
    limits, considered = _first_look(problem, layout, state, candidates, settings)
    while len(state.steps) < settings.steps:
        if rms(layout, state) <= problem.floor:
            state.notes.append(
                f"the residual is within the method's own accuracy, {problem.floor:.2g} {problem.unit} RMS"
            )
            state.enough = True
            break
        if _named_step(problem, layout, state, candidates, settings, rng):
            continue
        if not learned_step(problem, layout, state, settings, rng):
            break
        state.blocked.clear()
        if state.estimate is not None:
            e = state.estimate
            state.estimate = estimate(problem, layout, state.nuisance, e.values, candidates, e.noise)
            state.residual = state.estimate.residual
            drop_unneeded(problem, layout, state, candidates, state.steps[-1].effect)
    return close(problem, layout, state, candidates, null, sealed, limits, considered, settings)


def refit(problem: ResidualProblem, values: Values, without: Sequence[int] = ()) -> Values:
    """The parameters of the effects in `values` from all groups but those of `without`: what a figure on held-out data is to be
    made with. Raises ValueError where no group is left."""
    rows = np.flatnonzero(~np.isin(problem.group, list(without)))
    if rows.size == 0:
        raise ValueError(f"{problem.stage}: no group is left to fit on")
    layout, nuisance = Layout.of(problem, rows), np.asarray(problem.nuisance, float)
    candidates = {c.effect: c for c in problem.candidates}
    noise = fit_noise(layout, nuisance[rows], np.asarray(problem.residual(values), float)[rows])
    found = estimate(problem, layout, nuisance, tied(values, candidates), candidates, noise)
    return untied(found.values, candidates)


def _seal(problem: ResidualProblem, settings: LoopSettings, rng: np.random.Generator) -> tuple[Index, int | None]:
    labels = np.unique(problem.group)
    every = np.arange(problem.group.size)
    if not settings.seal or labels.size < SEALED_FROM:
        return every, None
    sealed = int(rng.choice(labels))
    return every[problem.group != sealed], sealed


def _first_look(
    problem: ResidualProblem,
    layout: Layout,
    state: State,
    candidates: Mapping[str, Candidate],
    settings: LoopSettings,
) -> tuple[list[identifiability.Limit], dict[str, Considered]]:
    """What can be told at all, and how each candidate stands. Noise with every candidate projected off: an effect must not hide
    itself."""
    found = _members(problem, state, candidates)
    rows, p = layout.rows, state.nuisance.shape[1]
    if not found:  # none leaves a trace, which must be said
        return identifiability.limits(np.zeros((1, 1)), [], [], candidates, settings.snr), {}
    both = np.column_stack([state.nuisance, *(m.columns for m in found)])[rows]
    noise = fit_noise(layout, both, state.residual[rows], state.noise)
    m = project(gram(layout, noise, np.column_stack([both, state.residual[rows]])), slice(0, p))
    where = spans([one.columns.shape[1] for one in found], p)
    considered: dict[str, Considered] = {}
    for member, own in zip(found, where, strict=True):
        value, rank = statistic(m, own)
        p_value = float(chdtrc(rank, value)) if rank else 1.0
        known = considered.get(member.effect)
        better = Considered(member.effect, value, rank, p_value, 1 if known is None else known.tests + 1, "")
        if known is not None and known.p <= p_value:
            better = replace(known, tests=known.tests + 1)
        considered[member.effect] = better
    return identifiability.limits(m, where, found, candidates, settings.snr), considered


def _members(problem: ResidualProblem, state: State, candidates: Mapping[str, Candidate]) -> list[Member]:
    out = {*state.values, *state.dropped}
    free = [
        replace(c, grid=(*c.grid, *state.narrowed.get(name, ()))) for name, c in candidates.items() if name not in out
    ]
    found = [m for c in free for m in members(problem, state.values, state.residual, c)]
    return [m for m in found if (m.effect, m.names) not in state.blocked]


def _named_step(
    problem: ResidualProblem,
    layout: Layout,
    state: State,
    candidates: Mapping[str, Candidate],
    settings: LoopSettings,
    rng: np.random.Generator,
) -> bool:
    """Add the best confirmed candidate; False where none is left that passes."""
    rows = layout.rows
    while True:
        found = _members(problem, state, candidates)
        columns, data = state.columns, state.residual
        signatures = [m.columns[rows] for m in found]
        tests = log_counts([m.effect for m in found], [m.kind for m in found])
        finding, state.noise = search(
            layout,
            columns[rows],
            signatures,
            data[rows],
            state.noise,
            settings.draws,
            rng,
            tests,
            drifts=problem.drifts,
        )
        if finding is None or finding.p > settings.p_value:
            return False
        member = found[finding.index]
        step = examine(problem, layout, state, candidates, found, finding, settings, rng)
        if isinstance(step, Refusal):
            of = f" of {', '.join(member.names)}" if 0.0 in member.point.values() else ""
            state.notes.append(f"{member.effect}{of} stands out (p {p_text(finding.p)}) but is not added: {step.why}")
            state.refused[member.effect] = step.why
            if step.structure and finding.p < CERTAIN:
                state.certain.append(member.effect)
            state.blocked.add((member.effect, member.names))
            if step.channel is not None:
                narrow(problem, state, found, member, step.channel)
            continue
        added, record = step
        added = settled(problem, layout, state.nuisance, added, candidates, member.effect)
        state.estimate, state.residual, state.noise = added, added.residual, added.noise
        state.steps.append(record)
        state.blocked.clear()
        drop_unneeded(problem, layout, state, candidates, member.effect)
        return True
