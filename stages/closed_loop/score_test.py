"""Which member of a library stands out of coloured noise: generalised least squares, judged by the largest statistic.

Of the Gram matrix M = C'K⁻¹C of C = [N | S₁ | S₂ | … | r], with N projected off, a member's statistic is

    χ²_k = r'S_k·(S_k'S_k)⁻¹·S_k'r        (all products projected and in the metric K⁻¹)

K is fitted by REML with the member in the model: an effect that is there must not count as noise. The p-value of a member is
the mean of P(χ²_q > χ²_k(K_m)) over noise K_m drawn from its restricted likelihood, which is the F-test where the noise is
white; or that of the likelihood ratio, if it is larger:

    Λ_k = min_K D(r; K) − min_{K, β} D(r − S_k·β; K) ~ χ²_q,      D = −2·l restricted by N alone

A slow signature takes from r what tells that the noise is slow, so that the noise left beside it seems whiter than it is; the
ratio lets each side have the noise that suits it. Where the stage knows its noise, as picks and detectors have it, no drift is to
be feared, and it is not asked for. A curve of time is what coloured noise looks like, and is judged in the noise without it.

An effect that makes n tests (a grid) pays for them itself: its p-values count n times, so that effects of one test do not lose
power to it; so do its kinds of hypothesis (one number for several sensors, one sensor, several): n tests of one of m kinds count
m·n times. Family-wise: the share of draws u ~ N(0, S'K⁻¹S) in which the smallest p of the library, so counted, is below
it, or the number of effects times it (Bonferroni's bound), whichever is smaller.

Functions
---------
search        the best member with its family-wise p-value
likelihood_ratio   Λ of one member
project       a Gram matrix with columns projected off
statistic     χ² and rank of some columns
solve         their coefficients and covariance
log_counts    how many tests each member stands for
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, gammaincc, gammaln, log_ndtr, logsumexp

from stages.closed_loop.noise import Layout, Noise, deviance, fit_noise, gram, noise_draws

Array = NDArray[np.float64]

RCOND = 1e-9  # of a Gram matrix with unit diagonal
NOISE_DRAWS = 48
LOOKED_AT = 3  # members whose own noise is fitted, of each of two first looks
RATIO_ROUNDS = 2  # of coefficients and noise in turn
NOWHERE_NEAR = 0.3  # family-wise p at both first looks, beyond which there is no closer look


@dataclass(frozen=True)
class Finding:
    """The best member: index, p family-wise, log of its effect's p, χ² and rank, and the noise with it in the model (of a curve
    of time: without it)."""

    index: int
    p: float
    log_p: float
    chi2: float
    rank: int
    noise: Noise


def inverse(matrix: Array) -> tuple[Array, int]:
    """Pseudo-inverse and rank of a Gram matrix, scaled to unit diagonal before directions are thrown away."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    used = values > RCOND * max(float(values[-1]), 1.0)
    half = vectors[:, used] / np.sqrt(values[used]) / scale[:, None]
    return half @ half.T, int(used.sum())


def project(m: Array, off: slice | Sequence[int]) -> Array:
    """Gram matrix of all columns with those of `off` projected off (theirs become zero).

    What is left below 1e-10 of a column's norm² is rounding, and set to zero.
    """
    block = m[:, off]
    if block.shape[1] == 0:
        return m
    inv, _ = inverse(block[off])
    left = m - block @ inv @ block.T
    gone = np.diag(left) <= 1e-10 * np.diag(m)
    left[gone] = 0.0
    left[:, gone] = 0.0
    return left


def statistic(projected: Array, columns: Sequence[int], target: int = -1) -> tuple[float, int]:
    """χ² and rank of `columns` for the column `target` of a projected Gram matrix."""
    columns = [c for c in columns if projected[c, c] > 0.0]
    if not columns:
        return 0.0, 0
    inv, rank = inverse(projected[np.ix_(columns, columns)])
    u = projected[columns, target]
    return float(u @ inv @ u), rank


def solve(m: Array, columns: Sequence[int], target: int = -1) -> tuple[Array, Array]:
    """Coefficients (q,) and covariance (q, q) of `columns` for the column `target`."""
    inv, _ = inverse(m[np.ix_(columns, columns)])
    return inv @ m[columns, target], inv


def spans(sizes: Sequence[int], first: int) -> list[list[int]]:
    """Columns of each member in C."""
    ends = first + np.cumsum(sizes)
    return [list(range(int(e) - s, int(e))) for e, s in zip(ends, sizes, strict=True)]


def search(
    layout: Layout,
    nuisance: Array,
    signatures: Sequence[Array],
    residual: Array,
    start: Noise | None,
    draws: int,
    rng: np.random.Generator,
    log_tests: Array | None = None,
    of_time: Collection[int] = (),
    drifts: bool = True,
) -> tuple[Finding | None, Noise]:
    """The most significant of `signatures` [(rows, q), …] in `residual` (rows,) beside `nuisance` (rows, p), and the noise
    without any of them; no finding where no signature is left beside the nuisance. `log_tests`: of `log_counts` (default: 0);
    `of_time`: those that are curves of time; `drifts`: see `ResidualProblem`."""
    log_tests = np.zeros(len(signatures)) if log_tests is None else log_tests
    everything = np.column_stack([nuisance, *signatures, residual])
    p = nuisance.shape[1]
    where = spans([s.shape[1] for s in signatures], p)
    null = fit_noise(layout, nuisance, residual, start)
    if not signatures:
        return None, null
    order: list[int] = []
    sizes = [s.shape[1] for s in signatures]
    lowest = 1.0
    # Not from `null`: where an effect is strong, that is another maximum, and a search from there would stay in it.
    for noise in (null, fit_noise(layout, np.column_stack([nuisance, *signatures]), residual)):
        projected = project(gram(layout, noise, everything), slice(0, p))
        log_p = _log_p(projected, where) + log_tests
        good = [int(k) for k in np.argsort(log_p)[:LOOKED_AT] if np.isfinite(log_p[k])]
        if good:
            lowest = min(
                lowest,
                family_wise(projected[p:-1, p:-1], spans(sizes, 0), float(log_p[good[0]]), draws, rng, log_tests),
            )
        order += good
    if not order:
        return None, null
    if lowest > NOWHERE_NEAR:  # whatever the noise: no need to look closer
        return Finding(order[0], lowest, 0.0, 0.0, 0, null), null
    best: Finding | None = None
    for k in dict.fromkeys(order):
        with_k = np.column_stack([nuisance, signatures[k]])
        known = nuisance if k in of_time else with_k
        noise = null if k in of_time else fit_noise(layout, known, residual)
        narrow = np.column_stack([with_k, residual])
        own = list(range(p, p + signatures[k].shape[1]))
        logs = []
        for one in noise_draws(layout, known, residual, noise, NOISE_DRAWS, rng):
            value, rank = statistic(project(gram(layout, one, narrow), slice(0, p)), own)
            logs.append(log_tail(value, rank) if rank else 0.0)
        log_p_k = float(logsumexp(logs) - np.log(len(logs)))
        if drifts:
            ratio, rank = likelihood_ratio(layout, nuisance, signatures[k], residual, null, noise)
            log_p_k = max(log_p_k, log_tail(ratio, rank) if rank else 0.0)
        log_p_k += float(log_tests[k])
        if best is None or log_p_k < best.log_p:
            value, rank = statistic(project(gram(layout, noise, narrow), slice(0, p)), own)
            best = Finding(k, 1.0, log_p_k, value, rank, noise)
    assert best is not None
    projected = project(gram(layout, best.noise, everything), slice(0, p))
    family = family_wise(projected[p:-1, p:-1], spans(sizes, 0), best.log_p, draws, rng, log_tests)
    return Finding(best.index, family, best.log_p, best.chi2, best.rank, best.noise), null


def likelihood_ratio(
    layout: Layout, nuisance: Array, signature: Array, residual: Array, null: Noise, beside: Noise
) -> tuple[float, int]:
    """Λ and q of a `signature` (rows, q) in `residual` (rows,) beside `nuisance` (rows, p).

    null, beside: noise without and with it, from where the likeliest is looked for.
    """
    p, noise = nuisance.shape[1], beside
    whole = np.column_stack([nuisance, signature, residual])
    rank, lowest = 0, np.inf
    for _ in range(RATIO_ROUNDS):
        m = project(gram(layout, noise, whole), slice(0, p))
        own = [c for c in range(p, p + signature.shape[1]) if m[c, c] > 0.0]
        if not own:
            return 0.0, 0
        inv, rank = inverse(m[np.ix_(own, own)])
        left = residual - whole[:, own] @ (inv @ m[own, -1])
        noise = fit_noise(layout, nuisance, left, noise)
        lowest = min(lowest, deviance(layout, noise, nuisance, left))
    without = min(deviance(layout, n, nuisance, residual) for n in (null, fit_noise(layout, nuisance, residual, noise)))
    ratio = without - lowest
    return (max(ratio, 0.0), rank) if np.isfinite(ratio) else (0.0, rank)


def log_counts(effects: Sequence[str], kinds: Sequence[str]) -> Array:
    """Logarithm of how many times a member's p counts (members,), by its effect and its kind of hypothesis."""
    both = list(zip(effects, kinds, strict=True))
    return np.log([both.count(one) * len({k for e, k in both if e == one[0]}) for one in both])


def _log_p(projected: Array, where: Sequence[Sequence[int]]) -> Array:
    out = np.zeros(len(where))
    for k, columns in enumerate(where):
        value, rank = statistic(projected, columns)
        out[k] = log_tail(value, rank) if rank else np.inf
    return out


def family_wise(
    information: Array,
    where: Sequence[Sequence[int]],
    log_p: float,
    draws: int,
    rng: np.random.Generator,
    log_tests: Array | None = None,
) -> float:
    """P(some member of the library has a smaller p) under the null, for score vectors u ~ N(0, information); `log_tests`
    (members,): logarithm of how many times a member's p counts."""
    weight = np.exp(np.zeros(len(where)) if log_tests is None else log_tests)
    tested = [k for k, c in enumerate(where) if any(information[i, i] > 0.0 for i in c)]
    bound = min(1.0, float(np.sum(1.0 / weight[tested])) * float(np.exp(log_p)))
    if bound < 1.0 / draws:
        return bound
    values, vectors = np.linalg.eigh(information)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    u = rng.standard_normal((draws, half.shape[1])) @ half.T
    reached = np.zeros(draws, bool)
    for k in tested:
        used = [i for i in where[k] if information[i, i] > 0.0]
        inv, rank = inverse(information[np.ix_(used, used)])
        limit = chdtri(rank, min(np.exp(log_p) / weight[k], 1.0))
        reached |= np.einsum("di,ij,dj->d", u[:, used], inv, u[:, used]) >= limit
    return min(bound, (1.0 + np.count_nonzero(reached)) / (draws + 1.0))


def log_tail(value: float, rank: int) -> float:
    """ln P(χ²_rank > value), far into the tail."""
    if rank == 1:
        return float(np.log(2.0) + log_ndtr(-np.sqrt(max(value, 0.0))))
    tail = float(gammaincc(0.5 * rank, 0.5 * max(value, 0.0)))
    if tail > 1e-290:
        return float(np.log(tail))
    return float((0.5 * rank - 1.0) * np.log(0.5 * value) - 0.5 * value - gammaln(0.5 * rank))
