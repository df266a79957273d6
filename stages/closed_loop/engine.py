"""The loop itself: test, confirm, add, estimate all together, repeat; then what covariates say; then one look at a sealed group.

    1 signatures  2 what can be told at all  3 the largest statistic in coloured noise  4 held-out groups and negative controls
    5 joint estimate, signatures anew, drop what is no longer needed, repeat  6 splines of covariates for what is left

A name is refused where a covariate explains the same data so much better that nothing is left for it: then the covariate is
reported (`learned:<covariate>`), never the name that fits a little.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.residual_problem import Basis, Candidate, ResidualProblem
from stages.closed_loop import confirmation, identifiability, learned
from stages.closed_loop.confirmation import Confirmation, Model
from stages.closed_loop.estimation import Estimate, descend, estimate
from stages.closed_loop.noise import Layout, Noise, fit_noise, gram
from stages.closed_loop.result import Considered, LoopResult, Pictures, Sealed, Step, Value, Verdict
from stages.closed_loop.score_test import Finding, log_counts, project, search, solve, spans, statistic
from stages.closed_loop.separation import would_separate
from stages.closed_loop.settings import LoopSettings
from stages.closed_loop.signatures import Member, Values, derivatives, members, merged, tied, untied

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SEALED_FROM = 4  # groups
LEARNED_TRIES = 6  # covariates looked at, the most significant first
NESTED_FROM = 6  # groups; of fewer a training part may lack the very range that places a width or a lag
CERTAIN = 1e-3  # family-wise p of structure that is there, though nothing accounts for it
UNNEEDED = 0.05  # p of an effect beside others, or of sensors that differ in what they were taken to share
TOLD = 2.0  # sigma, from zero
COVARIATE_WINS = 0.01
CHANGES = 0.1  # of an effect's χ²
IS_CURVE = (
    0.05  # of a term's norm, left beside the curves of a covariate: it is one of them, but for rounding and perspective
)
EXCESS = 1.1  # RMS over a known sigma that is more than noise
LAGS = 8  # samples apart, over which it is looked at for structure


@dataclass(frozen=True)
class Refusal:
    """Why something that stands out is not added, and whether it shows structure all the same; `channel`: the one that refuses,
    where it is one alone."""

    why: str
    structure: bool
    channel: int | None = None


@dataclass
class State:
    """Where the loop stands: nuisance with learned columns (n, p); effects' values, r (n,) and S (n, q) there; the steps."""

    nuisance: Array
    residual: Array
    estimate: Estimate | None = None
    steps: list[Step] = field(default_factory=list)
    blocked: set[tuple[str, tuple[str, ...]]] = field(default_factory=set)
    dropped: set[str] = field(default_factory=set)
    narrowed: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    certain: list[str] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    enough: bool = False
    noise: Noise | None = None

    @property
    def values(self) -> Values:
        return {} if self.estimate is None else self.estimate.values

    @property
    def columns(self) -> Array:
        """Nuisance and the signatures of what was added."""
        return self.nuisance if self.estimate is None else np.column_stack([self.nuisance, self.estimate.signatures])


def run(problem: ResidualProblem, settings: LoopSettings, seed: int) -> LoopResult:
    """What `problem`'s model lacks. The same problem, settings and seed give the same answer."""
    rng = np.random.default_rng(seed)
    rows, sealed = _seal(problem, settings, rng)
    layout = Layout.of(problem, rows)
    null = np.asarray(problem.residual({}), float)
    if null.shape != problem.group.shape or not np.isfinite(null[rows]).all():
        raise ValueError(f"{problem.stage}: the residual has shape {null.shape} or is not finite")
    state = State(np.asarray(problem.nuisance, float), null, notes=list(problem.notes))
    candidates = {c.effect: c for c in problem.candidates}
    state.noise = fit_noise(layout, state.nuisance[rows], null[rows])
    limits, considered = _first_look(problem, layout, state, candidates, settings)
    while len(state.steps) < settings.steps:
        if _rms(layout, state) <= problem.floor:
            state.notes.append(
                f"the residual is within the method's own accuracy, {problem.floor:.2g} {problem.unit} RMS"
            )
            state.enough = True
            break
        if _named_step(problem, layout, state, candidates, settings, rng):
            continue
        if not _learned_step(problem, layout, state, settings, rng):
            break
        state.blocked.clear()
        if state.estimate is not None:
            e = state.estimate
            state.estimate = estimate(problem, layout, state.nuisance, e.values, candidates, e.noise)
            state.residual = state.estimate.residual
            _drop_unneeded(problem, layout, state, candidates, state.steps[-1].effect)
    return _close(problem, layout, state, candidates, null, sealed, limits, considered, settings)


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


def _left(layout: Layout, state: State) -> Array:
    """What the model's columns leave (rows,), by least squares."""
    columns, data = state.columns[layout.rows], state.residual[layout.rows]
    if columns.shape[1]:
        data = data - columns @ np.linalg.lstsq(columns, data, rcond=None)[0]
    return np.asarray(data)


def _rms(layout: Layout, state: State) -> float:
    return float(np.sqrt(np.mean(_left(layout, state) ** 2)))


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
            layout, columns[rows], signatures, data[rows], state.noise, settings.draws, rng, tests
        )
        if finding is None or finding.p > settings.p_value:
            return False
        member = found[finding.index]
        step = _examine(problem, layout, state, candidates, found, finding, settings, rng)
        if isinstance(step, Refusal):
            of = f" of {', '.join(member.names)}" if 0.0 in member.point.values() else ""
            state.notes.append(f"{member.effect}{of} stands out (p {_p_text(finding.p)}) but is not added: {step.why}")
            state.refused[member.effect] = step.why
            if step.structure and finding.p < CERTAIN:
                state.certain.append(member.effect)
            state.blocked.add((member.effect, member.names))
            if step.channel is not None:
                _narrow(problem, state, found, member, step.channel)
            continue
        added, record = step
        added = _settled(problem, layout, state.nuisance, added, candidates, member.effect)
        state.estimate, state.residual, state.noise = added, added.residual, added.noise
        state.steps.append(record)
        state.blocked.clear()
        _drop_unneeded(problem, layout, state, candidates, member.effect)
        return True


def _settled(
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


def _narrow(problem: ResidualProblem, state: State, found: Sequence[Member], member: Member, channel: int) -> None:
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


def _channel(problem: ResidualProblem, covariate: str) -> int | None:
    """The channel that a covariate alone is of."""
    if problem.channel is None or covariate not in problem.covariates:
        return None
    values = problem.covariates[covariate]
    known = np.isfinite(values.values if isinstance(values, Basis) else values)
    labels = np.unique(problem.channel[known])
    return int(labels[0]) if labels.size == 1 and np.unique(problem.channel).size > 1 else None


def _examine(
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
    if winner := _better_covariate(problem, layout, helped, columns, data, term, estimated.noise):
        return Refusal(f"a spline of {winner} explains the same and more, and leaves nothing for it", True)

    if worst := _varies_with(problem, layout, helped, p, data, term, estimated.noise):
        return Refusal(f"its size changes with {worst}: it stands for something else", True, _channel(problem, worst))
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
        return Refusal(_why_not(checked), _repeats(checked))
    tests = f"largest of {len(found)} tests, {_noise_text(problem, finding.noise)}"
    evidence = f"p {_p_text(finding.p)} ({tests}); {_held_out_text(problem, checked)}; {_controls_text(reached, valid)}"
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
    problem: ResidualProblem, layout: Layout, helped: Array, columns: Array, data: Array, term: Array, noise: Noise
) -> str | None:
    """The covariate whose spline leaves nothing of the effect's term, while the term leaves much of the spline; or of which the
    term is itself a curve, while the data ask for another one.

    What the next two other effects take up beside the term (`helped`) is not held against it.
    """
    rows, p = layout.rows, columns.shape[1]
    winner, lowest = None, COVARIATE_WINS / max(len(problem.covariates), 1)
    for name, spline in _splines(problem, layout).items():
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


def _splines(problem: ResidualProblem, layout: Layout, count: int = 7) -> dict[str, Array]:
    out = {}
    for name, covariate in problem.covariates.items():
        if isinstance(covariate, Basis):
            columns = covariate.columns
        else:
            columns = learned.spline_columns(covariate, learned.knots(covariate[layout.rows], count))
        if columns.shape[1]:
            out[name] = columns
    return out


def _drop_unneeded(
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


def _learned_step(
    problem: ResidualProblem, layout: Layout, state: State, settings: LoopSettings, rng: np.random.Generator
) -> bool:
    """Add the spline of a covariate that explains what is left, if held-out error falls; False where none does. One that stands
    out and does not help leaves the next its turn."""
    done = {s.effect.removeprefix("learned:") for s in state.steps if s.table is not None}
    splines = _splines(problem, layout, settings.spline_columns)
    splines = {name: s for name, s in splines.items() if name not in done}
    if np.unique(problem.group[layout.rows]).size < 2:
        return False
    for _ in range(min(len(splines), LEARNED_TRIES)):
        answer = _try_learned(problem, layout, state, splines, settings, rng)
        if not isinstance(answer, str):
            return answer
        del splines[answer]
    return False


def _try_learned(
    problem: ResidualProblem,
    layout: Layout,
    state: State,
    splines: Mapping[str, Array],
    settings: LoopSettings,
    rng: np.random.Generator,
) -> bool | str:
    """Whether the most significant spline was added; its name where it stands out and is refused."""
    rows, columns, data = layout.rows, state.columns, state.residual
    p = columns.shape[1]
    names = list(splines)
    drifts = [k for k, n in enumerate(names) if _is_time(problem, n)]
    finding, state.noise = search(
        layout,
        columns[rows],
        [splines[n][rows] for n in names],
        data[rows],
        state.noise,
        settings.draws,
        rng,
        None,
        drifts,
    )
    if finding is None or finding.p > settings.learned_p_value:
        return False
    name = names[finding.index]
    spline = splines[name]
    own = tuple(range(p, p + spline.shape[1]))
    reached, valid = confirmation.controls(
        problem, layout, finding.noise, columns[rows], spline[rows], data[rows], settings.controls, rng
    )
    both = np.column_stack([columns, spline])
    model = Model(data, both, smooth=own, added=own)
    m = gram(layout, finding.noise, np.column_stack([both, data])[rows])
    beta = confirmation.coefficients(m, both.shape[1], model)
    term = spline @ beta[list(own)]
    library = [
        Model(data, np.column_stack([columns, s]), smooth=tuple(range(p, p + s.shape[1]))) for s in splines.values()
    ]
    checked = confirmation.confirm(
        problem, rows, Model(data, columns), library, names, names, finding.index, model, finding.noise, settings.snr
    )
    if not confirmation.controls_fail(reached, valid):
        problem_text = f"{reached} of {valid} shifted copies of it do as well"
    elif not checked.passes(settings.gain, settings.decisive):
        problem_text = _why_not(checked)
    else:
        size = float(np.sqrt(np.mean((term[rows] - term[rows].mean()) ** 2)))
        sigma = size / float(np.sqrt(max(finding.chi2, 1e-300)))
        tests = f"largest of {len(names)} covariates, {_noise_text(problem, finding.noise)}"
        share = f"permutation p = {(1 + reached) / (1 + valid):.2g}" if valid else "no permutation possible"
        state.steps.append(
            Step(
                problem.stage,
                f"learned:{name}",
                {"rms": Value(size, sigma, problem.unit)},
                f"p {_p_text(finding.p)} ({tests}); {_held_out_text(problem, checked)}; {share} of {valid} shifts within series",
                (),
                checked.before,
                checked.after,
                finding.p,
                table=_table(problem.covariates[name], term, beta[list(own)]),
            )
        )
        state.nuisance = np.column_stack([state.nuisance, spline])
        state.noise = finding.noise
        return True
    state.notes.append(f"{name} stands out among covariates (p {_p_text(finding.p)}) but is not used: {problem_text}")
    if finding.p < CERTAIN and _repeats(checked) and confirmation.controls_fail(reached, valid):
        state.certain.append(f"learned:{name}")
    return name


def _is_time(problem: ResidualProblem, covariate: str) -> bool:
    values = problem.covariates[covariate]
    values = values.values if isinstance(values, Basis) else values
    known = np.isfinite(values)
    return bool(known.any() and np.array_equal(values[known], problem.time[known]))


def _table(covariate: Array | Basis, term: Array, beta: Array) -> dict[str, list[float]]:
    """The learned curve on values of its covariate."""
    if isinstance(covariate, Basis):
        curves = {name: (curve @ beta).tolist() for name, curve in covariate.curves.items()}
        return {"covariate": covariate.at.tolist(), **curves}
    return learned.curve(covariate, term)


def _close(
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
    )


def _excess(problem: ResidualProblem, layout: Layout, state: State) -> tuple[float, bool] | None:
    """RMS of what is left over the declared sigma, of the samples that have one, and whether it is serially correlated, which
    makes it structure and no noise that is larger than declared. None where it is no more than noise can be.

    Portmanteau: Σ_k m_k·ρ_k² ~ χ²_LAGS of white noise, ρ_k over the m_k pairs of samples k apart in a series.
    """
    sigma = np.broadcast_to(np.nan if problem.sigma is None else problem.sigma, problem.group.shape)[layout.rows]
    known = np.isfinite(sigma)
    z = np.where(known, _left(layout, state) / np.where(known, sigma, 1.0), 0.0)
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


def _repeats(checked: Confirmation) -> bool:
    """Whether what one part of the data shows helps another part at all: else it is no structure of the instrument."""
    return checked.gain > 0.0 and checked.log_likelihood > 0.0


def _why_not(checked: Confirmation) -> str:
    if 2 * checked.chosen <= checked.folds:
        return f"only {checked.chosen} of {checked.folds} training parts choose it"
    if not checked.same_sign:
        return "its sign changes from fold to fold"
    return (
        f"held-out RMS changes by {-100.0 * checked.gain:+.1f} % only, log-likelihood by {checked.log_likelihood:+.1f}"
    )


def _held_out_text(problem: ResidualProblem, c: Confirmation) -> str:
    return (
        f"held-out RMS {c.before:.4g} → {c.after:.4g} {problem.unit} ({-100.0 * c.gain:+.1f} %), log-likelihood"
        f" {c.log_likelihood:+.1f}, chosen in {c.chosen} of {c.folds} folds"
    )


def _p_text(p: float) -> str:
    return "< 1e-300" if p < 1e-300 else f"= {p:.2g}"


def _controls_text(reached: int, valid: int) -> str:
    if valid < confirmation.FEWEST_CONTROLS:
        return "its signature has no shifted copy that could serve as a control"
    return f"{reached} of {valid} shifted copies of its signature do as well"


def _noise_text(problem: ResidualProblem, noise: Noise) -> str:
    coloured = sum(c.kappa > 1e-7 for c in noise)
    if coloured == 0:
        return "white noise"
    return (
        "white and Gauss–Markov noise" if len(noise) == 1 else f"noise coloured in {coloured} of {len(noise)} channels"
    )
