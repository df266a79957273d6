"""Whether a candidate that stands out is added: its estimate, its controls, what covariates say of it, groups held out.

A name is refused where a covariate explains the same data so much better that nothing is left for it, or where it is itself a
curve of one while the data ask for another: then the covariate is reported (`learned:<covariate>`), never the name that fits a
little.

Functions
---------
examine      the new estimate and its step, or why not
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.residual_problem import Basis, Candidate, ResidualProblem
from stages.closed_loop import confirmation, identifiability
from stages.closed_loop.confirmation import Model
from stages.closed_loop.estimation import Estimate, descend, estimate
from stages.closed_loop.learned import splines_of
from stages.closed_loop.noise import Layout, Noise, fit_noise, gram
from stages.closed_loop.result import Step
from stages.closed_loop.score_test import Finding, project, solve, spans, statistic
from stages.closed_loop.settings import LoopSettings
from stages.closed_loop.signatures import Member, merged
from stages.closed_loop.state import UNNEEDED, State
from stages.closed_loop.wording import controls_text, held_out_text, noise_text, p_text, why_not

Array = NDArray[np.float64]
Index = NDArray[np.intp]

NESTED_FROM = 6  # groups; of fewer a training part may lack the very range that places a width or a lag
COVARIATE_WINS = 0.01
CHANGES = 0.1  # of an effect's χ²
IS_CURVE = (
    0.05  # of a term's norm, left beside the curves of a covariate: one of them, but for rounding and perspective
)


@dataclass(frozen=True)
class Refusal:
    """Why something that stands out is not added, and whether it shows structure all the same; `channel`: the one that refuses,
    where it is one alone."""

    why: str
    structure: bool
    channel: int | None = None


def examine(
    problem: ResidualProblem,
    layout: Layout,
    state: State,
    candidates: Mapping[str, Candidate],
    found: Sequence[Member],
    finding: Finding,
    settings: LoopSettings,
    rng: np.random.Generator,
) -> tuple[Estimate, Step] | Refusal:
    """The new estimate and its step, or why not."""
    rows, columns, data = layout.rows, state.columns, state.residual
    member, p = found[finding.index], columns.shape[1]
    if np.unique(problem.group[rows]).size < 2:
        return Refusal("there are no groups to hold out", True)
    whole = np.column_stack([columns, *(m.columns for m in found), data])[rows]
    projected = project(gram(layout, finding.noise, whole), slice(0, p))
    where = spans([m.columns.shape[1] for m in found], p)
    amplitude, _ = solve(projected, where[finding.index])
    rivals = identifiability.rivals(projected, where, [m.effect for m in found], finding.index, settings.snr)

    values = merged(state.values, member.effect, member.start(amplitude))
    estimated = estimate(problem, layout, state.nuisance, values, candidates, finding.noise)
    if outside := [name for name in estimated.at_bound if name.startswith(f"{member.effect}.")]:
        return Refusal(f"{', '.join(outside)} ends on its physical bound", True)
    reached, valid = confirmation.controls(
        problem, layout, finding.noise, columns[rows], member.columns[rows], data[rows], settings.controls, rng
    )
    if not confirmation.controls_fail(reached, valid):
        return Refusal(f"{reached} of {valid} shifted copies of its signature do as well", False)
    term = data - estimated.residual
    helped = _beside(layout, columns, data, term, found, member.effect, estimated.noise)
    if winner := _better_covariate(
        problem, layout, helped, columns, data, term, estimated.noise, settings.spline_columns
    ):
        return Refusal(f"a spline of {winner} explains the same and more, and leaves nothing for it", True)

    if worst := _varies_with(problem, layout, helped, p, data, term, estimated.noise):
        return Refusal(
            f"its size changes with {worst}: it stands for something else", True, _channel_of(problem, worst)
        )
    before = Model(data, columns)
    library = [Model(data, np.column_stack([columns, m.columns])) for m in found]
    own = tuple(state.nuisance.shape[1] + c for c in estimated.columns(member.effect))
    refined = Model(estimated.residual, np.column_stack([state.nuisance, estimated.signatures]), added=own, term=term)
    families = [m.effect if m.effect not in rivals else member.effect for m in found]
    refine = None
    if candidates[member.effect].grid and np.unique(problem.group[rows]).size >= NESTED_FROM:
        refine = _refiner(problem, state, candidates, found, before, finding.noise)
    checked = confirmation.confirm(
        problem,
        rows,
        before,
        library,
        families,
        [m.kind for m in found],
        finding.index,
        refined,
        finding.noise,
        settings.snr,
        refine,
    )
    if not checked.passes(settings.gain, settings.decisive):
        return Refusal(why_not(checked), checked.repeats)
    tests = f"largest of {len(found)} tests, {noise_text(problem, finding.noise)}"
    evidence = f"p {p_text(finding.p)} ({tests}); {held_out_text(problem, checked)}; {controls_text(reached, valid)}"
    if rivals:
        beside = ", ".join(f"{name} ({snr:.1f} sigma left)" for name, snr in rivals.items())
        evidence += f"; cannot be told from {beside}"
    record = Step(
        problem.stage, member.effect, {}, evidence, tuple(rivals), checked.before, checked.after, finding.p
    )  # fmt: skip
    return estimated, record


def _refiner(
    problem: ResidualProblem,
    state: State,
    candidates: Mapping[str, Candidate],
    found: Sequence[Member],
    before: Model,
    noise: Noise,
) -> Callable[[Index, int], Model]:
    """(training samples, member) → the model that the effect has by these samples alone."""

    def refine(train: Index, index: int) -> Model:
        layout, member = Layout.of(problem, train), found[index]
        p = before.columns.shape[1]
        m = gram(layout, noise, np.column_stack([before.columns, member.columns, before.data])[train])
        amplitude, _ = solve(project(m, slice(0, p)), range(p, p + member.columns.shape[1]))
        values = merged(state.values, member.effect, member.start(amplitude))
        e = descend(problem, layout, state.nuisance, values, candidates, noise, rounds=1)
        own = tuple(state.nuisance.shape[1] + c for c in e.columns(member.effect))
        columns = np.column_stack([state.nuisance, e.signatures])
        return Model(e.residual, columns, added=own, term=before.data - e.residual)

    return refine


def _beside(
    layout: Layout,
    columns: Array,
    data: Array,
    term: Array,
    found: Sequence[Member],
    effect: str,
    noise: Noise,
) -> Array:
    """Columns (rows, p + 1 + …): the model's, the effect's term, and the two other effects that best add to it, if any does."""
    rows = layout.rows
    beside = [columns[rows], term[rows, None]]
    rest = [m for m in found if m.effect != effect]
    for _ in range(2):
        if not rest:
            break
        now = np.column_stack(beside)
        whole = np.column_stack([now, *(r.columns[rows] for r in rest), data[rows]])
        m = project(gram(layout, noise, whole), slice(0, now.shape[1]))
        scores = []
        for own in spans([r.columns.shape[1] for r in rest], now.shape[1]):
            value, rank = statistic(m, own)
            scores.append(float(chdtrc(rank, value)) if rank else 1.0)
        best = int(np.argmin(scores))
        if scores[best] > UNNEEDED / len(rest):
            break
        beside.append(rest[best].columns[rows])
        rest = [r for r in rest if r.effect != rest[best].effect]
    return np.column_stack(beside)


def _varies_with(
    problem: ResidualProblem, layout: Layout, helped: Array, p: int, data: Array, term: Array, noise: Noise
) -> str | None:
    """The covariate with which the size of the effect's term (n,), column `p` of `helped`, changes by over a third (a tenth of
    its χ²), "group" for the held-out groups: a parameter of the instrument is one number, so that a term that wants several
    stands for something else. A little less is an effect that is not exactly of the declared form."""
    rows = layout.rows
    labels = np.unique(problem.group[rows])
    trials = {name: (term * _centred(c, rows))[rows, None] for name, c in problem.covariates.items()}
    trials["group"] = np.column_stack([term[rows] * (problem.group[rows] == one) for one in labels[1:]])
    h = helped.shape[1]
    m = gram(layout, noise, np.column_stack([helped, *trials.values(), data[rows]]))
    size, _ = statistic(project(m, [i for i in range(h) if i != p]), [p])
    m = project(m, slice(0, h))
    worst, lowest = None, COVARIATE_WINS / len(trials)
    for name, own in zip(trials, spans([t.shape[1] for t in trials.values()], h), strict=True):
        value, rank = statistic(m, own)
        chance = float(chdtrc(rank, value)) if rank else 1.0
        if chance < lowest and value > CHANGES * size:
            worst, lowest = name, chance
    return worst


def _centred(covariate: Array | Basis, rows: Index) -> Array:
    """About its mean over `rows`; zero where it is not known."""
    covariate = covariate.values if isinstance(covariate, Basis) else covariate
    used = covariate[rows]
    used = used[np.isfinite(used)]
    return np.where(np.isfinite(covariate), covariate - (used.mean() if used.size else 0.0), 0.0)


def _better_covariate(
    problem: ResidualProblem,
    layout: Layout,
    helped: Array,
    columns: Array,
    data: Array,
    term: Array,
    noise: Noise,
    count: int,
) -> str | None:
    """The covariate whose spline leaves nothing of the effect's term, while the term leaves much of the spline; or of which the
    term is itself a curve, while the data ask for another one.

    What the next two other effects take up beside the term (`helped`) is not held against it.
    """
    rows, p = layout.rows, columns.shape[1]
    winner, lowest = None, COVARIATE_WINS / max(len(problem.covariates), 1)
    for name, spline in splines_of(problem, layout, count).items():
        q = spline.shape[1]
        extra = fit_noise(layout, np.column_stack([columns[rows], term[rows], spline[rows]]), data[rows], noise)
        m = gram(layout, extra, np.column_stack([helped, spline[rows], data[rows]]))
        h = helped.shape[1]
        gained, rank = statistic(project(m, slice(0, h)), range(h, h + q))
        if not rank or (p_spline := float(chdtrc(rank, gained))) >= lowest:
            continue
        rest = [i for i in range(h) if i != p]
        own, beside = project(m, rest), project(m, [*rest, *range(h, h + q)])
        explained, _ = statistic(own, [p])
        is_curve = beside[p, p] <= IS_CURVE**2 * own[p, p] and gained > CHANGES * explained
        value, rank = statistic(beside, [p])
        if is_curve or not rank or float(chdtrc(rank, value)) > UNNEEDED:
            winner, lowest = name, p_spline
    return winner


def _channel_of(problem: ResidualProblem, covariate: str) -> int | None:
    """The channel that a covariate alone is of."""
    if problem.channel is None or covariate not in problem.covariates:
        return None
    values = problem.covariates[covariate]
    known = np.isfinite(values.values if isinstance(values, Basis) else values)
    labels = np.unique(problem.channel[known])
    return int(labels[0]) if labels.size == 1 and np.unique(problem.channel).size > 1 else None
