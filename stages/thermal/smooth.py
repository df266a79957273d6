"""The smooth part of a channel's bias, as columns: what the stage's network could learn of these features, and no more.

    y = F·β + H·γ + f(x) + e,     f ~ GP(0, s²·σ²·exp(−½ Σ_d ((x_d − x'_d)/ℓ_d)²)),     e ~ σ²·(I + c²·exp(−|Δt|/τ) within a run)

F holds a level for each run and a straight line in each feature, H what a memory of temperature could add. ℓ, s, c, τ, σ are
those of the largest evidence with β and γ integrated out (flat priors, so this is restricted likelihood [1]_) times weak
log-normal priors. H matters: without it widths shrink until f imitates the memory that is to be looked for, and the looking
finds nothing; with it f has the widths that the rest of the data ask for. Of the kernel, freed of F, the directions v_k
count that the prior lets rise above the noise of a block, λ_k > KEPT·σ².

Classes and functions
---------------------
Kernel      the hyperparameters
Smooth      columns of a channel and the function fitted to it
Curve       the same of a polynomial in T, where little more can be told
find        hyperparameters of the largest evidence
evidence    their evidence on other features

References
----------
.. [1] C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press 2006, sections 2.7 and 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from stages.thermal.network import one_thread

Array = NDArray[np.float64]

KEPT = 0.1  # of a block's noise variance: plays on 8 clean units then have an RMS of 1.0 sigma, 1.15 at 0.3
LOG_WIDTH_MEAN, LOG_WIDTH_SIGMA = np.log(3.0), 1.0  # in standard deviations of the feature
LOG_SIZE_MEAN, LOG_SIZE_SIGMA = 2.0, 3.0  # of f over the noise of a block
LOG_COLOUR_MEAN, LOG_COLOUR_SIGMA = -2.0, 2.0  # of the coloured noise over the white one
JITTER = 1e-10
STARTS = (1.0, np.e)  # widths of all features but the first, which starts at 1 and at e


@dataclass(frozen=True)
class Kernel:
    """ln ℓ (D,), ln s, ln c, ln τ [s], ln σ [unit of y]."""

    log: Array

    @property
    def widths(self) -> Array:
        return np.asarray(np.exp(self.log[:-4]))

    @property
    def sigma(self) -> float:
        return float(np.exp(self.log[-1]))

    def between(self, a: Array, b: Array) -> Array:
        """Covariance over σ² of f at features (n, D) and (m, D)."""
        square = sum(((a[:, d, None] - b[None, :, d]) / w) ** 2 for d, w in enumerate(self.widths))
        return np.asarray(np.exp(2.0 * self.log[-4] - 0.5 * square))


@dataclass(frozen=True)
class Task:
    """Features x (N, D), scaled; y (N,); columns F and H (N, p) with flat priors; run (N,) and time (N,) of the blocks."""

    x: Array
    y: Array
    flat: Array
    run: NDArray[np.int64]
    time: Array

    def cost(self, q: Tensor) -> Tensor:
        """−ln evidence − ln prior at hyperparameters as in `Kernel`."""
        d = self.x.shape[1]
        x, y = torch.from_numpy(self.x), torch.from_numpy(self.y)
        apart = (x.T[:, :, None] - x.T[:, None]) ** 2
        square = torch.tensordot(torch.exp(-2.0 * q[:d]), apart, dims=1)
        same = torch.from_numpy((self.run[:, None] == self.run[None]).astype(float))
        later = torch.from_numpy(np.abs(self.time[:, None] - self.time[None]))
        colour = torch.exp(2.0 * q[d + 1]) * same * torch.exp(-later * torch.exp(-q[d + 2]))
        covariance = torch.exp(2.0 * q[d] - 0.5 * square) + colour + torch.eye(len(y), dtype=y.dtype)
        lower = torch.linalg.cholesky(torch.exp(2.0 * q[d + 3]) * covariance)
        both = torch.linalg.solve_triangular(
            lower, torch.cat([torch.from_numpy(self.flat), y[:, None]], 1), upper=False
        )
        flat, target = both[:, :-1], both[:, -1]
        gram = flat.T @ flat
        root = torch.linalg.cholesky(gram + JITTER * torch.diag(torch.diag(gram)))
        fitted = torch.linalg.solve_triangular(root, (flat.T @ target)[:, None], upper=False)[:, 0]
        value = torch.log(torch.diag(lower)).sum() + torch.log(torch.diag(root)).sum()
        value = value + 0.5 * (target @ target - fitted @ fitted)
        prior = (((q[:d] - LOG_WIDTH_MEAN) / LOG_WIDTH_SIGMA) ** 2).sum()
        prior = prior + ((q[d] - LOG_SIZE_MEAN) / LOG_SIZE_SIGMA) ** 2
        return value + 0.5 * (prior + ((q[d + 1] - LOG_COLOUR_MEAN) / LOG_COLOUR_SIGMA) ** 2)

    def slope(self, p: Array) -> tuple[float, Array]:
        q = torch.from_numpy(p.copy()).requires_grad_(True)
        cost = self.cost(q)
        cost.backward()
        assert q.grad is not None
        return float(cost.detach()), q.grad.numpy()


def find(task: Task, iterations: int = 60) -> Kernel:
    """The most probable hyperparameters; y in any unit."""
    d = task.x.shape[1]
    step = float(np.median(np.diff(task.time)))
    left = task.y - task.flat @ np.linalg.lstsq(task.flat, task.y, rcond=None)[0]
    size = float(np.log(max(left.std(), 1e-12 * np.abs(task.y).max(), 1e-300)))
    bounds = [(np.log(0.3), np.log(30.0))] * d
    bounds += [(-3.0, 9.0), (-6.0, 3.0), (np.log(2.0 * step), np.log(1e6)), (size - 8.0, size + 2.0)]
    best: tuple[float, Array] | None = None
    with one_thread():
        for first in STARTS:
            start = np.array([np.log(first), *[1.0] * (d - 1), 2.0, -2.0, np.log(10.0 * step), size - 1.4])
            options = {"maxiter": iterations}
            found = minimize(task.slope, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
            if best is None or found.fun < best[0]:
                best = float(found.fun), np.asarray(found.x)
    assert best is not None
    return Kernel(best[1])


def evidence(task: Task, kernel: Kernel) -> float:
    """ln evidence (and ln prior) of `kernel` on the task's features."""
    with one_thread(), torch.no_grad():
        return -float(task.cost(torch.from_numpy(kernel.log.copy())))


@dataclass(frozen=True)
class Smooth:
    """Columns (N, k) beside F at features x (N, D), orthonormal, and the function F·β + f fitted to y.

    `constant` are the columns of F (the first ones) that do not depend on the features.
    """

    kernel: Kernel
    x: Array
    columns: Array
    slope: Array
    weights: Array

    @classmethod
    def of(cls, kernel: Kernel, x: Array, y: Array, levels: Array) -> Smooth:
        """`levels` (N, r): F without the straight lines, which are x itself."""
        flat = np.column_stack([levels, x])
        inverse = np.linalg.pinv(flat)
        covariance = kernel.between(x, x)
        freed = covariance - flat @ (inverse @ covariance)
        freed = freed - (freed @ flat) @ inverse
        strength, vectors = np.linalg.eigh(0.5 * (freed + freed.T))
        used = strength > KEPT
        columns, strength = vectors[:, used], strength[used]
        shrunk = (columns.T @ y) * strength / (strength + 1.0)
        weights = columns @ (shrunk / strength)
        slope = inverse @ (y - covariance @ weights)
        return cls(kernel, x, columns, slope[levels.shape[1] :], weights)

    @property
    def sigma(self) -> float:
        """Noise of a block."""
        return self.kernel.sigma

    def __call__(self, x: Array) -> Array:
        """The function at features (n, D), but for the run's level."""
        return np.asarray(x @ self.slope + self.kernel.between(x, self.x) @ self.weights)


@dataclass(frozen=True)
class Curve:
    """A polynomial in the first feature beside straight lines in all, fitted to y: what little can be extrapolated to another
    branch. As `Smooth`, but for the noise of a block `sigma`, which is given.
    """

    x: Array
    columns: Array
    sigma: float
    low: float
    high: float
    slope: Array
    weights: Array

    @classmethod
    def of(cls, degree: int, x: Array, y: Array, levels: Array, sigma: float) -> Curve:
        """`degree` of the polynomial, 1 at least; x (N, D), D may be 0."""
        low, high = (float(x[:, 0].min()), float(x[:, 0].max())) if x.shape[1] else (0.0, 1.0)
        columns = _powers(x, low, high, degree)
        beta = np.linalg.lstsq(np.column_stack([levels, x, columns]), y, rcond=None)[0][levels.shape[1] :]
        return cls(
            x, columns, sigma, low, high, np.asarray(beta[: x.shape[1]], float), np.asarray(beta[x.shape[1] :], float)
        )

    def __call__(self, x: Array) -> Array:
        """The function at features (n, D), but for the run's level."""
        powers = _powers(x, self.low, self.high, len(self.weights) + 1)
        return np.asarray(x @ self.slope + powers @ self.weights)


def _powers(x: Array, low: float, high: float, degree: int) -> Array:
    """Legendre polynomials of degree 2 and more of the first feature (n, degree − 1), none without features."""
    if x.shape[1] == 0:
        return np.zeros((len(x), 0))
    return np.asarray(
        np.polynomial.legendre.legvander((2.0 * x[:, 0] - low - high) / (high - low), degree)[:, 2:], float
    )
