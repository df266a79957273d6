"""After an effect was added: which of its parameters the data tell, and which other effects they no longer need.

Functions
---------
settled          the estimate with the parameters that are told
narrow           the next test of an effect that one channel refuses
drop_unneeded    effects that the last addition has made superfluous
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.residual_problem import Candidate, ResidualProblem
from stages.closed_loop import confirmation
from stages.closed_loop.confirmation import Model
from stages.closed_loop.estimation import Estimate, estimate
from stages.closed_loop.noise import Layout, gram
from stages.closed_loop.score_test import project, statistic
from stages.closed_loop.signatures import Member, derivatives
from stages.closed_loop.state import UNNEEDED, State

Array = NDArray[np.float64]

TOLD = 2.0  # sigma, from zero


def settled(
    problem: ResidualProblem,
    layout: Layout,
    nuisance: Array,
    found: Estimate,
    candidates: Mapping[str, Candidate],
    effect: str,
) -> Estimate:
    """The estimate with those parameters of an added effect that the data tell.

    A shared one is set free where its sensors differ beyond chance; then, the weakest first, what is not told from zero, or helps
    no group that is held out, is left out where the candidate tests the effect without it. One stays.
    """
    candidate = candidates[effect]
    for name in [n for n in candidate.shared if n in found.values[effect]]:
        if _differ(problem, layout, nuisance, found, candidate, name):
            own = {k: v for k, v in found.values[effect].items() if k != name}
            own |= dict.fromkeys(candidate.shared[name], found.values[effect][name])
            values = {**found.values, effect: own}
            found = estimate(problem, layout, nuisance, values, candidates, found.noise)
    separate = {name for point in candidate.grid for name, value in point.items() if value == 0.0}
    while True:
        told = {found.order[i][1]: i for i in found.columns(effect) if found.order[i][1] in separate}
        if len(told) < 2:
            return found
        size = {n: abs(found.values[effect][n]) / max(float(found.sigma[i]), 1e-300) for n, i in told.items()}
        out = next(
            (
                n
                for n in sorted(size, key=lambda n: size[n])
                if size[n] < TOLD or not _helps(problem, layout, nuisance, found, effect, told[n])
            ),
            None,
        )
        if out is None:
            return found
        own = {k: v for k, v in found.values[effect].items() if k != out}
        found = estimate(problem, layout, nuisance, {**found.values, effect: own}, candidates, found.noise)


def _helps(
    problem: ResidualProblem, layout: Layout, nuisance: Array, found: Estimate, effect: str, column: int
) -> bool:
    """Whether groups held out are predicted better with a parameter, estimated from the others, than with its null: in RMS or in
    likelihood."""
    rows = layout.rows
    without = {k: v for k, v in found.values[effect].items() if k != found.order[column][1]}
    null = np.asarray(problem.residual({**found.values, effect: without}), float)
    rest = np.delete(found.signatures, column, axis=1)
    models = (
        Model(null, np.column_stack([nuisance, rest])),
        Model(found.residual, np.column_stack([nuisance, found.signatures])),
    )
    acting = found.signatures[:, column] != 0.0
    if problem.channel is not None:
        acting = np.isin(problem.channel, problem.channel[acting])
    squares, likelihood = np.zeros(2), np.zeros(2)
    for held in (rows[f] for f in confirmation.folds_of(problem.group[rows])):
        train = np.setdiff1d(rows, held)
        for i, model in enumerate(models):
            error, value, _ = confirmation.held_out(problem, train, held, model, found.noise, refit=False)
            squares[i] += float(np.sum(error[acting[held]] ** 2))
            likelihood[i] += value
    return bool(squares[1] < squares[0] or likelihood[1] > likelihood[0])


def _differ(
    problem: ResidualProblem, layout: Layout, nuisance: Array, found: Estimate, candidate: Candidate, name: str
) -> bool:
    """Whether the parameters that share one number ask for several."""
    free = derivatives(problem, found.values, candidate, candidate.shared[name])
    columns = np.column_stack([nuisance, found.signatures])
    p, rows = columns.shape[1], layout.rows
    m = gram(layout, found.noise, np.column_stack([columns, free, found.residual])[rows])
    # One direction of theirs is the shared one's, which is projected off: rounding must not stand for it.
    m = m[:, [i for i in range(m.shape[1]) if i != p]][[i for i in range(m.shape[0]) if i != p]]
    value, rank = statistic(project(m, slice(0, p)), range(p, p + free.shape[1] - 1))
    return bool(rank) and float(chdtrc(rank, value)) < UNNEEDED


def narrow(problem: ResidualProblem, state: State, found: Sequence[Member], member: Member, channel: int) -> None:
    """A channel in which an effect's size is not one number has something else: the next test is the effect without it. Only what
    the candidate itself puts to zero in some of its tests, and in no channel but this one, can be left out."""
    assert problem.channel is not None
    elsewhere = problem.channel != channel
    separate = {name for m in found if m.effect == member.effect for name, value in m.point.items() if value == 0.0}
    columns = member.columns[:, member.secant :]
    acts = {
        n: bool(c[~elsewhere].any()) and not c[elsewhere].any() for n, c in zip(member.names, columns.T, strict=True)
    }
    out = [name for name, only in acts.items() if only and name in separate]
    if out and len(out) < len(member.names):
        grid = state.narrowed.setdefault(member.effect, [])
        alike = [m.point for m in found if m.effect == member.effect and m.names == member.names]
        narrower = [{**point, **dict.fromkeys(out, 0.0)} for point in alike]
        grid += [point for point in narrower if point not in grid]


def drop_unneeded(
    problem: ResidualProblem, layout: Layout, state: State, candidates: Mapping[str, Candidate], last: str
) -> None:
    """Effects that the last addition has made superfluous: a first choice that stood for something else.

    What stays must still stand out of as many tests as the library makes, counted as in the search.
    """
    while state.estimate is not None:
        e = state.estimate
        p, rows = state.nuisance.shape[1], layout.rows
        whole = np.column_stack([state.nuisance, e.signatures, e.residual])[rows]
        m = project(gram(layout, e.noise, whole), slice(0, p))
        weakest, highest = "", UNNEEDED / len(candidates)
        for effect in e.values:
            own = [p + c for c in e.columns(effect)]
            others = [p + c for c in range(len(e.order)) if p + c not in own]
            # What it contributes, not its parameters times their derivatives: a width or a thickness is no evidence.
            term = np.asarray(problem.residual({k: v for k, v in e.values.items() if k != effect}), float) - e.residual
            rank = sum(bool(m[c, c] > 0.0) for c in own) or 1
            beside = np.column_stack([whole, term[rows]])
            left = project(project(gram(layout, e.noise, beside), slice(0, p)), others)[-1, -1]
            p_value = float(chdtrc(rank, max(left, 0.0))) * max(len(candidates[effect].grid), 1)
            if effect != last and p_value > highest:
                weakest, highest = effect, p_value
        if not weakest:
            return
        state.steps = [s for s in state.steps if s.effect != weakest]
        state.notes.append(f"{weakest} is taken out again: beside {last} the data do not need it")
        state.dropped.add(weakest)
        values = {name: v for name, v in e.values.items() if name != weakest}
        if values:
            state.estimate = estimate(problem, layout, state.nuisance, values, candidates, e.noise)
            state.residual = state.estimate.residual
        else:
            state.estimate, state.residual = None, np.asarray(problem.residual({}), float)
