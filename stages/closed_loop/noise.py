"""Noise that may be coloured: white and a Gauss–Markov process, its variances by restricted maximum likelihood (REML).

    K = σ²·V,   V = I + ρ·A,   A_ij = exp(−|t_i − t_j|/τ) within a series,   ρ = κ/(1 − exp(−2·dt/τ))

κ is the variance that the process gains in one median step dt over that of the white noise, so that τ → ∞ is a random walk of
the same κ with an unknown start. A⁻¹ is tridiagonal [1]_, so V⁻¹ = (Q + I)⁻¹·Q with Q = A⁻¹/ρ costs n. Of what the columns X
leave, with ν = n − rank X and s² = r'Pr/ν,

    −2·l(κ, τ) = ln|V| + ln|X'V⁻¹X| + ν·ln s²                                                    [2]_

Functions
---------
Layout         the samples in use, by channel
fit_noise      the variances of each channel by REML, given X
noise_draws    variances that the data would have allowed as well
deviance       −2·l of residuals about columns
gram           C'K⁻¹C

References
----------
.. [1] H. Rue, L. Held, Gaussian Markov Random Fields, Chapman & Hall 2005, section 1.1.
.. [2] H. D. Patterson, R. Thompson, Recovery of inter-block information, Biometrika 58 (1971) 545–554.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, qr
from scipy.optimize import minimize

from pipeline.residual_problem import ResidualProblem

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LOG_KAPPA = (np.log(1e-9), np.log(1e6))
LONGEST = 30.0  # τ over the longest series: a random walk
SHORTEST = 0.7  # τ over the median step: shorter is white
RANK = 1e-9  # columns of which less than this share is left beside the others are none
ROUNDING = 1e-11  # share of a squared norm that is none
FEWEST = 4  # degrees of freedom below which no variance is estimated


@dataclass(frozen=True)
class Colour:
    """Noise of one channel: σ² [residual²], κ [1], τ [unit of time]; `dof` that σ² was estimated with."""

    variance: float
    kappa: float
    tau: float
    dof: float


Noise = tuple[Colour, ...]


@dataclass(frozen=True)
class Channel:
    """Samples of one channel: where they stand among those in use, their steps, and where a series begins."""

    index: Index
    step: Array
    starts: NDArray[np.bool_]

    @cached_property
    def median_step(self) -> float:
        inside = self.step[~self.starts]
        return float(np.median(inside)) if inside.size else 1.0

    @cached_property
    def span(self) -> float:
        """Of the longest series."""
        steps = np.where(self.starts, 0.0, self.step)
        return max(float(np.bincount(np.cumsum(self.starts), weights=steps).max()), self.median_step)

    def box(self) -> tuple[tuple[float, float], tuple[float, float]]:
        shortest = SHORTEST * self.median_step
        return LOG_KAPPA, (np.log(shortest), np.log(max(LONGEST * self.span, 10.0 * shortest)))

    def factor(self, kappa: float, tau: float) -> Factor:
        """V of unit white variance."""
        step = np.where(self.starts, np.inf, self.step)
        rho = kappa / -np.expm1(-2.0 * self.median_step / tau)
        decay = np.exp(-step / tau)
        left = -np.expm1(-2.0 * step / tau)  # 1 at the start of a series
        after = np.append(decay[1:], 0.0)
        diagonal = (1.0 / left + after**2 / np.append(left[1:], 1.0)) / rho
        beside = -(decay[1:] / left[1:]) / rho
        d, e, bad = (diagonal + 1.0, beside, 0) if beside.size == 0 else lapack.dpttrf(diagonal + 1.0, beside)
        if bad:
            raise FloatingPointError("the noise's covariance is not positive")
        log_det = float(np.log(d).sum() + np.log(left).sum() + left.size * np.log(rho))
        return Factor(diagonal, beside, d, e, log_det)


@dataclass(frozen=True)
class Factor:
    """V through its tridiagonal parts; `log_det` = ln|V|."""

    diagonal: Array
    beside: Array
    d: Array
    e: Array
    log_det: float

    def solve(self, columns: Array) -> Array:
        """V⁻¹ times (n, k)."""
        q = self.diagonal[:, None] * columns
        if len(columns) == 1:
            return q / self.d[:, None]
        q[1:] += self.beside[:, None] * columns[:-1]
        q[:-1] += self.beside[:, None] * columns[1:]
        x, _ = lapack.dpttrs(self.d, self.e, q)
        return np.asarray(x)


@dataclass(frozen=True)
class Layout:
    """The samples `rows` of a problem, by channel."""

    rows: Index
    channels: tuple[Channel, ...]

    @classmethod
    def of(cls, problem: ResidualProblem, rows: Index) -> Layout:
        label = np.zeros(rows.size, int) if problem.channel is None else problem.channel[rows]
        all_labels = np.zeros(1, int) if problem.channel is None else np.unique(problem.channel)
        channels = []
        for one in all_labels:
            index = np.flatnonzero(label == one)
            series, time = problem.series[rows[index]], problem.time[rows[index]]
            starts = np.append(True, np.diff(series) != 0)[: index.size]
            step = np.append(1.0, np.diff(time))[: index.size]
            channels.append(Channel(index, np.where(starts, 1.0, step), starts))
        return cls(rows, tuple(channels))


def gram(layout: Layout, noise: Noise, columns: Array) -> Array:
    """C'K⁻¹C of C (rows, k)."""
    total = np.zeros((columns.shape[1], columns.shape[1]))
    for channel, colour in zip(layout.channels, noise, strict=True):
        if channel.index.size:
            part = columns[channel.index]
            total += part.T @ channel.factor(colour.kappa, colour.tau).solve(part) / colour.variance
    return 0.5 * (total + total.T)


def log_det(layout: Layout, noise: Noise) -> float:
    """ln|K|."""
    return sum(
        channel.factor(c.kappa, c.tau).log_det + channel.index.size * float(np.log(c.variance))
        for channel, c in zip(layout.channels, noise, strict=True)
        if channel.index.size
    )


def basis(columns: Array) -> Array:
    """Orthonormal columns of the same span (n, rank); rank by the columns at unit length."""
    length = np.linalg.norm(columns, axis=0)
    used = length > 0.0
    if not used.any():
        return np.zeros((len(columns), 0))
    q, r, _ = qr(columns[:, used] / length[used], mode="economic", pivoting=True, check_finite=False)
    size = np.abs(np.diag(r))
    return np.asarray(q[:, : np.count_nonzero(size > RANK * size[0])])


def criterion(channel: Channel, kappa: float, tau: float, x: Array, y: Array) -> tuple[float, float, float]:
    """−2·l, s² and ν of y (n,) about the full-rank columns x (n, p)."""
    factor = channel.factor(kappa, tau)
    both = np.column_stack([x, y])
    g = both.T @ factor.solve(both)
    p = x.shape[1]
    dof = y.size - p
    if p:
        c = np.linalg.cholesky(g[:p, :p])
        z = np.linalg.solve(c, g[:p, p])
        left, inner = g[p, p] - z @ z, 2.0 * float(np.log(np.diag(c)).sum())
    else:
        left, inner = g[0, 0], 0.0
    if not left > ROUNDING * g[p, p]:
        raise FloatingPointError("nothing is left but rounding")
    variance = float(left) / dof
    return factor.log_det + inner + dof * float(np.log(variance)), variance, float(dof)


def fit_noise(layout: Layout, x: Array, y: Array, start: Noise | None = None) -> Noise:
    """κ, τ and σ² of each channel, of y (rows,) about the columns x (rows, p), by REML. `start`: from there, not everywhere."""
    out = []
    for i, channel in enumerate(layout.channels):
        out.append(_fit_channel(channel, x, y, None if start is None else start[i]))
    return tuple(out)


def _fit_channel(channel: Channel, x: Array, y: Array, start: Colour | None) -> Colour:
    part, target = _clear(channel, x, y)
    if target.size - part.shape[1] < FEWEST or not target.any():
        return start or Colour(
            max(float(np.var(target)) if target.size else 1.0, 1e-300), 1e-9, channel.median_step, 0.0
        )
    box = channel.box()

    def value(at: Array) -> float:
        inside = [float(np.clip(a, *b)) for a, b in zip(at, box, strict=True)]
        beyond = sum(abs(a - b) for a, b in zip(at, inside, strict=True))
        try:
            return (
                criterion(channel, float(np.exp(inside[0])), float(np.exp(inside[1])), part, target)[0] + 10.0 * beyond
            )
        except (FloatingPointError, np.linalg.LinAlgError):
            return 1e12

    if start is None:
        low, high = box[1]
        trials = [
            np.array([np.log(k), low + f * (high - low)]) for k in (1e-6, 1e-3, 0.1, 3.0) for f in (0.15, 0.5, 1.0)
        ]
        trials.append(np.array([box[0][0], low]))
        values = [value(t) for t in trials]
        best = trials[int(np.argmin(values))]
        size, evaluations = 1.2, 60
    else:
        best = np.log([start.kappa, start.tau])
        size, evaluations = 0.5, 30
    simplex = best + size * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
    options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 0.02, "fatol": 0.02}
    found = minimize(value, best, method="Nelder-Mead", options=options)
    at = [float(np.clip(a, *b)) for a, b in zip(found.x, box, strict=True)]
    kappa, tau = float(np.exp(at[0])), float(np.exp(at[1]))
    try:
        _, variance, dof = criterion(channel, kappa, tau, part, target)
    except (FloatingPointError, np.linalg.LinAlgError):  # all of y is in the columns
        return start or Colour(max(float(np.mean(target**2)), 1e-300), 1e-9, channel.median_step, 0.0)
    return Colour(variance, kappa, tau, dof)


def deviance(layout: Layout, noise: Noise, x: Array, y: Array) -> float:
    """−2·l summed over the channels, of y (rows,) about the columns x (rows, p): the smaller, the likelier. A channel of which
    the columns leave next to nothing says nothing; ∞ where rounding is all that is left of one."""
    total = 0.0
    for channel, colour in zip(layout.channels, noise, strict=True):
        if channel.index.size:
            part, target = _clear(channel, x, y)
            if target.size - part.shape[1] < FEWEST or not target.any():
                continue
            try:
                total += criterion(channel, colour.kappa, colour.tau, part, target)[0]
            except (FloatingPointError, np.linalg.LinAlgError):
                return float("inf")
    return total


def whitened(noise: Noise) -> Noise:
    """The same variances without the process."""
    return tuple(replace(colour, kappa=float(np.exp(LOG_KAPPA[0]))) for colour in noise)


def noise_draws(layout: Layout, x: Array, y: Array, fitted: Noise, count: int, rng: np.random.Generator) -> list[Noise]:
    """`count` sets of variances by their restricted likelihood (flat in ln κ and ln τ, σ² ~ ν·s²/χ²_ν).

    The likelihood is taken on 5 × 5 points about the best, spaced by its own curvature.
    """
    per_channel = [_likely(c, x, y, f) for c, f in zip(layout.channels, fitted, strict=True)]
    picks = []
    for points, weights in per_channel:
        chosen = rng.choice(len(points), size=count, p=weights)
        chi = [points[j].dof / rng.chisquare(points[j].dof) if points[j].dof > 0 else 1.0 for j in chosen]
        scaled = [
            Colour(points[j].variance * f, points[j].kappa, points[j].tau, points[j].dof)
            for j, f in zip(chosen, chi, strict=True)
        ]
        picks.append(scaled)
    return [tuple(column) for column in zip(*picks, strict=True)]


def _clear(channel: Channel, x: Array, y: Array) -> tuple[Array, Array]:
    """Orthonormal columns of x and y without them: what both have in common changes no likelihood, and costs digits."""
    part, target = basis(x[channel.index]), y[channel.index]
    return part, target - part @ (part.T @ target)


def _likely(channel: Channel, x: Array, y: Array, fitted: Colour) -> tuple[Sequence[Colour], Array]:
    part, target = _clear(channel, x, y)
    if fitted.dof < FEWEST or target.size - part.shape[1] < FEWEST:
        return [fitted], np.ones(1)
    box = channel.box()
    centre = np.log([fitted.kappa, fitted.tau])

    def at(point: Array) -> tuple[float, Colour]:
        inside = [float(np.exp(np.clip(a, *b))) for a, b in zip(point, box, strict=True)]
        try:
            value, variance, dof = criterion(channel, inside[0], inside[1], part, target)
        except (FloatingPointError, np.linalg.LinAlgError):
            return 1e12, fitted
        return value, Colour(variance, inside[0], inside[1], dof)

    middle = at(centre)[0]
    spread = []
    for axis in range(2):
        step = 0.3 * np.eye(2)[axis]
        rise = max(at(centre + step)[0] + at(centre - step)[0] - 2.0 * middle, 0.0)  # −2l: rise = 2·(step/sd)²
        spread.append(float(np.clip(0.3 * np.sqrt(2.0 / max(rise, 1e-6)), 0.03, 1.5)))
    offsets = (-2.0, -1.0, 0.0, 1.0, 2.0)
    values, points = zip(
        *(at(centre + np.array([a * spread[0], b * spread[1]])) for a in offsets for b in offsets), strict=True
    )
    weights = np.exp(-0.5 * (np.array(values) - min(values)))
    return points, weights / weights.sum()
