"""Confirmation on data that the fit has not seen: leave one group out, with the selection inside the training part.

    ΔRMS = 1 − RMS_after/RMS_before,      ΔL = Σ_groups [ln p(r_g | fit without g, after) − ln p(r_g | …, before)]

In each fold the best of the library is chosen anew from the training groups, and what the residual is not linear in is estimated
from them; so the gain is that of the whole procedure, not of the name and the values that all the data chose. Columns that only
the held-out group has (its own level, say) are fitted there, before and after alike. Each side has its own noise, by REML from
the training part.

Functions
---------
confirm      the folds
controls     how many shifted signatures do as well as the real one
held_out     RMS and log-likelihood of one group
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.residual_problem import ResidualProblem
from stages.closed_loop.identifiability import rivals
from stages.closed_loop.learned import ridge
from stages.closed_loop.noise import Layout, Noise, fit_noise, gram, log_det
from stages.closed_loop.score_test import inverse, log_counts, log_tail, project, solve, spans, statistic

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MOST_FOLDS = 8
SHARED = 0.5  # of a signature that its shifted copy may explain and still be a control
FEWEST_CONTROLS = 10
NEEDED = 0.05  # p beside a fold's first choice, over the number of effects, each paying for its own tests
FEWEST_FOLDS = 4  # below which a likelihood alone decides nothing: the noise model cannot be held against itself


@dataclass(frozen=True)
class Model:
    """data (n,) = columns (n, q)·β + noise; `smooth`: those of the columns that are one penalised spline; `term`: what all the
    data say the addition contributes (n,), with the coefficients at zero, and `added` the columns that belong to it."""

    data: Array
    columns: Array
    smooth: tuple[int, ...] = ()
    added: tuple[int, ...] = ()
    term: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Confirmation:
    """RMS of held-out samples of the channels acted on, in units of the residual (channels weighted by their spread), the
    gain in log-likelihood, in how many folds the same one was chosen, whether its sign is the same in all;
    `without_best`: the gain in log-likelihood without the fold that gains most, so that no single group decides.
    """

    before: float
    after: float
    gain: float
    log_likelihood: float
    folds: int
    chosen: int
    same_sign: bool
    without_best: float = 0.0

    @property
    def repeats(self) -> bool:
        """Whether what one part of the data shows helps another part at all: else it is no structure of the instrument."""
        return self.gain > 0.0 and self.log_likelihood > 0.0

    def passes(self, gain: float, decisive: float) -> bool:
        enough = self.folds >= FEWEST_FOLDS
        likelier = enough and self.without_best > 0.0 and self.log_likelihood >= decisive and self.gain > -gain
        smaller = self.gain >= gain and not (enough and self.log_likelihood < -decisive)
        return (smaller or likelier) and self.same_sign and 2 * self.chosen > self.folds


def folds_of(group: NDArray[np.int64]) -> list[Index]:
    """Samples of each fold: the groups, neighbours joined where there are more than eight."""
    labels = np.unique(group)
    return [np.flatnonzero(np.isin(group, part)) for part in np.array_split(labels, min(labels.size, MOST_FOLDS))]


def coefficients(m: Array, count: int, model: Model) -> Array:
    """β (count,) of a Gram matrix [columns | data], the spline's columns penalised."""
    own = list(range(count))
    if not model.smooth:
        return solve(m, own)[0]
    rest = [c for c in own if c not in model.smooth]
    penalised = m.copy()
    penalised[list(model.smooth), list(model.smooth)] += ridge(m, rest, model.smooth)
    return solve(penalised, own)[0]


def held_out(
    problem: ResidualProblem, train: Index, held: Index, model: Model, start: Noise, refit: bool = True
) -> tuple[Array, float, Array]:
    """Error of the held-out samples (held,), their log-likelihood, and the coefficients (q,) from the training part.

    refit: the noise anew from the training part (else `start`, which is enough where only the error is of interest).
    """
    layout, apart = Layout.of(problem, train), Layout.of(problem, held)
    size = np.linalg.norm(model.columns, axis=0)
    local = np.linalg.norm(model.columns[train], axis=0) <= 1e-9 * np.where(size > 0.0, size, 1.0)
    shared = np.flatnonzero(~local)
    renamed = {int(c): i for i, c in enumerate(shared)}
    inner = Model(model.data, model.columns, tuple(renamed[c] for c in model.smooth if c in renamed))
    columns = model.columns[:, shared]
    noise = fit_noise(layout, columns[train], model.data[train], start) if refit else start
    m = gram(layout, noise, np.column_stack([columns, model.data])[train])
    beta = np.zeros(model.columns.shape[1])
    if shared.size:
        beta[shared] = coefficients(m, shared.size, inner)
    error = model.data[held] - model.columns[held] @ beta
    own = model.columns[np.ix_(held, np.flatnonzero(local))]
    own = own[:, np.any(own != 0.0, axis=0)]
    if own.shape[1]:
        g = gram(apart, noise, np.column_stack([own, error]))
        error = error - own @ solve(g, range(own.shape[1]))[0]
    value = float(gram(apart, noise, error[:, None])[0, 0]) + log_det(apart, noise)
    return error, -0.5 * value, beta


def confirm(
    problem: ResidualProblem,
    rows: Index,
    before: Model,
    library: Sequence[Model],
    families: Sequence[str],
    kinds: Sequence[str],
    chosen: int,
    refined: Model,
    noise: Noise,
    snr: float,
    refine: Callable[[Index, int], Model] | None = None,
) -> Confirmation:
    """`library`: what each member would make of the model (its columns are before's and its own); `families`, `kinds`: whose
    effect's test each is, and of which kind; `refined`: the chosen one's, linearised where it converged; `refine`: the same from
    training samples and the member that they choose, where the residual is not linear in it. A training part whose first choice
    cannot be told from the chosen effect on its own data (below `snr`, see identifiability) has chosen no other: branches that
    only cool tell no play from a lag.
    """
    spread = channel_spread(problem, rows, refined, noise)
    touched = _touched(problem, refined.columns[:, refined.added])
    totals, log_tests = np.zeros(2), log_counts(families, kinds)
    agree, same, gains = 0, True, []
    folds = [rows[f] for f in folds_of(problem.group[rows])]
    p = before.columns.shape[1]
    whole = np.column_stack([before.columns, *(one.columns[:, p:] for one in library), before.data])
    where = spans([one.columns.shape[1] - p for one in library], p)
    for held in folds:
        train = np.setdiff1d(rows, held)
        layout = Layout.of(problem, train)
        projected = project(gram(layout, noise, whole[train]), slice(0, p))
        scores: list[float] = []
        for columns in where:
            value, rank = statistic(projected, columns)
            scores.append(log_tail(value, rank) + log_tests[len(scores)] if rank else np.inf)
        best = int(np.argmin(scores))
        wanted = families[best] == families[chosen]
        if not wanted:  # another one comes first, and this one is needed beside it: two effects at once
            value, rank = statistic(project(projected, where[best]), where[chosen])
            tail = log_tail(value, rank) if rank else np.inf
            wanted = tail + log_tests[chosen] < np.log(NEEDED / len(set(families)))
            wanted = wanted or families[chosen] in rivals(projected, where, families, best, snr)
        model = (
            library[best]
            if not wanted
            else refined
            if refine is None
            else refine(train, _own_best(scores, families, chosen))
        )
        agree += wanted
        e0, l0, _ = held_out(problem, train, held, before, noise)
        e1, l1, beta = held_out(problem, train, held, model, noise)
        if wanted and refined.term.size:
            term = model.term + model.columns[:, model.added] @ beta[list(model.added)]
            same &= bool(term[rows] @ refined.term[rows] > 0.0)
        gains.append(l1 - l0)
        totals += [float(np.sum((e / spread[held])[touched[held]] ** 2)) for e in (e0, e1)]
    counted = rows[touched[rows]]
    typical = float(np.sqrt(np.mean(spread[counted] ** 2)))
    rms = typical * np.sqrt(totals / counted.size)
    return Confirmation(
        float(rms[0]),
        float(rms[1]),
        float(1.0 - rms[1] / rms[0]),
        float(np.sum(gains)),
        len(folds),
        agree,
        same and agree > 0,
        float(np.sum(gains) - np.max(gains)),
    )


def _own_best(scores: Sequence[float], families: Sequence[str], chosen: int) -> int:
    """The best member of the chosen one's family."""
    return min((k for k, name in enumerate(families) if name == families[chosen]), key=lambda k: scores[k])


def _touched(problem: ResidualProblem, added: Array) -> NDArray[np.bool_]:
    """Samples (n,) of the channels that some of the columns (n, k) act on: what they cannot change must not dilute their gain."""
    if problem.channel is None:
        return np.ones(problem.group.size, bool)
    acting = [one for one in np.unique(problem.channel) if added[problem.channel == one].any()]
    return np.isin(problem.channel, acting)


def channel_spread(problem: ResidualProblem, rows: Index, model: Model, noise: Noise) -> Array:
    """RMS of what the model leaves of each sample's channel (n,), one where there is a single channel: a channel counts by its
    noise, not by what an effect makes in it."""
    out = np.ones(model.data.size)
    if problem.channel is None:
        return out
    m = gram(Layout.of(problem, rows), noise, np.column_stack([model.columns, model.data])[rows])
    left = model.data - model.columns @ coefficients(m, model.columns.shape[1], model)
    for label in np.unique(problem.channel):
        mine = problem.channel == label
        used = rows[mine[rows]]
        if used.size:
            out[mine] = max(float(np.sqrt(np.mean(left[used] ** 2))), 1e-300)
    return out


def controls(
    problem: ResidualProblem,
    layout: Layout,
    noise: Noise,
    nuisance: Array,
    signature: Array,
    data: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[int, int]:
    """Of `count` copies of the signature (rows, q), each shifted round within its series by a random part of it: how many have a
    χ² as large as the real one's, and how many are controls at all (a copy that explains over half of the real signature, as
    that of a constant does, is none). All arrays on the rows of `layout`."""
    p, q = nuisance.shape[1], signature.shape[1]
    own = list(range(p, p + q))
    real_m = project(gram(layout, noise, np.column_stack([nuisance, signature, data])), slice(0, p))
    real, _ = statistic(real_m, own)
    contribution = signature @ solve(real_m, own)[0]
    series = problem.series[layout.rows]
    stretches = [np.flatnonzero(series == s) for s in np.unique(series)]
    reached = valid = 0
    for _ in range(count):
        shifted = signature.copy()
        share = rng.uniform(0.05, 0.95)
        for stretch in stretches:
            shifted[stretch] = np.roll(signature[stretch], max(1, round(share * stretch.size)), axis=0)
        m = project(gram(layout, noise, np.column_stack([nuisance, shifted, contribution, data])), slice(0, p))
        block = m[np.ix_(own, own)]
        inv, _ = inverse(block)
        explained = float(m[own, p + q] @ inv @ m[own, p + q]) / max(float(m[p + q, p + q]), 1e-300)
        if explained > SHARED:
            continue
        valid += 1
        reached += statistic(m, own)[0] >= real
    return reached, valid


def controls_fail(reached: int, valid: int) -> bool:
    """Whether the negative controls fail, as they must: at most 5 % reach the real one; too few of them say nothing."""
    return valid < FEWEST_CONTROLS or reached <= 0.05 * valid


__all__ = ["Confirmation", "Model", "confirm", "controls", "controls_fail", "folds_of", "held_out"]
