"""What the Bayesian network is held against: polynomials and the traditional RBF, with the same fit and predict.

All are linear least squares on a design of their own, and get what cross-validation can give them: a polynomial
its degree, the RBF its number of nodes and its width. Folds are contiguous stretches of the run, because neighbouring
blocks of a slow run are nearly copies of each other and would flatter any number of nodes. Where several runs differ by an
offset each, its column stands beside the design, held to zero as the network's offsets are (`Free`).

The standard deviation is that of the function, as the network's is: of the coefficients, with the residuals' variance, a run of
N residuals that correlate by ρ from one to the next counting as N·(1 − ρ)/(1 + ρ); and, outside the training data, the standard
deviation of the bias for each standard deviation of distance, because nothing there says that the function goes on so.

References
----------
.. [1] J. Moody, C. J. Darken, Fast learning in networks of locally-tuned processing units,
   Neural Computation 1 (1989) 281.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

Array = NDArray[np.float64]
T = TypeVar("T")

FOLDS, STRETCHES = 5, 15
SMALLEST = 1e-12  # singular value, over the largest, that double precision resolves
MOST_ALIKE = 0.98  # correlation of successive residuals beyond which they are taken as no more alike


@dataclass(frozen=True)
class Free:
    """Offsets of runs in a least-squares fit: columns (N, R) of ones and how strongly each is held to zero (R,), 0: not at all.

    Where none of the runs is `anchored`, the level means nothing and the function's mean over the training is 0.
    """

    columns: Array
    weights: Array
    anchored: bool = True

    @classmethod
    def none(cls, count: int) -> Free:
        return cls(np.zeros((count, 0)), np.zeros(0))


@dataclass(frozen=True)
class Linear:
    """δ = (φ(x) − origin)·a: coefficients a (q,) in the target's unit, factor F (q, r) with F·Fᵀ their covariance.

    low, high (D,): the training data's range; `spread`: the bias' standard deviation there; `origin` (q,) is 0 where the level of
    the bias is known.
    """

    coefficients: Array
    factor: Array
    origin: Array
    low: Array
    high: Array
    spread: float
    residual_sigma: float

    SHAPES: ClassVar[dict[str, tuple[str, ...]]] = {
        "coefficients": ("q",),
        "factor": ("q", "r"),
        "origin": ("q",),
        "low": ("D",),
        "high": ("D",),
        "spread": (),
        "residual_sigma": (),
    }

    def design(self, features: Array) -> Array:
        """φ (n, q) at scaled features (n, D)."""
        raise NotImplementedError

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) of the function at scaled features (n, D), in the target's unit."""
        phi = self.design(features) - self.origin
        variance = ((phi @ self.factor) ** 2).sum(axis=1)
        return phi @ self.coefficients, np.sqrt(variance + (self.spread * beyond(features, self.low, self.high)) ** 2)


@dataclass(frozen=True)
class Polynomial(Linear):
    """δ = Σ_k a_k·T^k on the scaled temperature (first column)."""

    def design(self, features: Array) -> Array:
        """Powers 0 … K of the temperature (n, K + 1)."""
        return polynomial_design(features, len(self.coefficients) - 1)


@dataclass(frozen=True)
class MultiPolynomial(Linear):
    """δ = Σ_k a_k·Π_d x_d^(e_kd): all products of the features up to a degree; exponents e (K, D)."""

    exponents: Array

    SHAPES: ClassVar[dict[str, tuple[str, ...]]] = {**Linear.SHAPES, "exponents": ("q", "D")}

    def design(self, features: Array) -> Array:
        """The products (n, K)."""
        return products(features, self.exponents)


@dataclass(frozen=True)
class TraditionalRbf(Linear):
    """δ = c + Σ_m v_m·exp(−|x − c_m|²/2s²): centres (M, D), one width s, unregularised coefficients (1 + M,)."""

    centres: Array
    width: float

    SHAPES: ClassVar[dict[str, tuple[str, ...]]] = {
        **Linear.SHAPES,
        "coefficients": ("1+m",),
        "factor": ("1+m", "r"),
        "origin": ("1+m",),
        "centres": ("m", "D"),
        "width": (),
    }

    def design(self, features: Array) -> Array:
        """A constant and the Gaussian units (n, 1 + M)."""
        return rbf_design(features, self.centres, self.width)


def beyond(features: Array, low: Array, high: Array) -> Array:
    """Distance (n,) of scaled features (n, D) from the box low … high (D,)."""
    return np.sqrt(((features - np.clip(features, low, high)) ** 2).sum(axis=1))


def polynomial_design(features: Array, degree: int) -> Array:
    """Powers 0 … degree of the first feature, (n, degree + 1)."""
    return np.vander(features[:, 0], degree + 1, increasing=True)


def products(features: Array, exponents: Array) -> Array:
    """Products of powers of the features (n, D), one for each row of exponents (K, D): (n, K)."""
    return np.asarray(np.prod(features[:, None, :] ** exponents[None], axis=2))


def exponents_up_to(degree: int, dimensions: int) -> Array:
    """All exponents (K, D) whose sum is at most `degree`."""
    every = itertools.product(range(degree + 1), repeat=dimensions)
    return np.array([e for e in every if sum(e) <= degree], float)


def rbf_design(features: Array, centres: Array, width: float) -> Array:
    """A constant and Gaussian units (n, 1 + M)."""
    square = ((features[:, None, :] - centres[None]) ** 2).sum(axis=2)
    return np.hstack([np.ones((len(features), 1)), np.exp(-0.5 * square / width**2)])


def _beside(design: Array, target: Array, free: Free) -> tuple[Array, Array]:
    """Design and target with the offsets' columns, and the rows that hold them to zero."""
    held = np.hstack([np.zeros((len(free.weights), design.shape[1])), np.diag(free.weights)])
    return np.vstack([np.hstack([design, free.columns]), held]), np.r_[target, np.zeros(len(free.weights))]


def least_squares(design: Array, target: Array, free: Free) -> tuple[Array, Array]:
    """Coefficients (q,) and offsets (R,) by plain least squares; only what double precision cannot resolve is cut off."""
    found = np.asarray(np.linalg.lstsq(*_beside(design, target, free), rcond=SMALLEST)[0], dtype=np.float64)
    return found[: design.shape[1]], found[design.shape[1] :]


def folds(count: int) -> NDArray[np.int64]:
    """The fold that holds out each of `count` successive blocks: STRETCHES contiguous stretches dealt to FOLDS."""
    return np.arange(count) * STRETCHES // count % FOLDS


def cross_validated(design: Array, target: Array, free: Free) -> float:
    """Mean squared error of held-out stretches."""
    fold = folds(len(target))
    error = np.empty(len(target))
    for k in range(FOLDS):
        out = fold == k
        taught = Free(free.columns[~out], free.weights)
        coefficients, offsets = least_squares(design[~out], target[~out], taught)
        error[out] = target[out] - design[out] @ coefficients - free.columns[out] @ offsets
    return float((error**2).mean())


def fit_polynomial(features: Array, target: Array, degrees: Sequence[int], free: Free | None = None) -> Polynomial:
    """The polynomial in T whose degree predicts held-out stretches best."""
    free = free or Free.none(len(target))
    best = _best(degrees, lambda d: cross_validated(polynomial_design(features, d), target, free))
    return Polynomial(*_fitted(polynomial_design(features, best), features, target, free))


def fit_multi_polynomial(
    features: Array, target: Array, degrees: Sequence[int], free: Free | None = None
) -> MultiPolynomial:
    """The polynomial in all features whose degree predicts held-out stretches best."""
    free = free or Free.none(len(target))
    exponents = {d: exponents_up_to(d, features.shape[1]) for d in degrees}
    best = _best(degrees, lambda d: cross_validated(products(features, exponents[d]), target, free))
    return MultiPolynomial(*_fitted(products(features, exponents[best]), features, target, free), exponents[best])


def fit_traditional_rbf(
    features: Array,
    target: Array,
    nodes: Sequence[int],
    widths: Sequence[float],
    seed: int,
    free: Free | None = None,
) -> TraditionalRbf:
    """The RBF with k-means centres whose number and width predict held-out stretches best."""
    free = free or Free.none(len(target))
    possible = [n for n in nodes if n < len(target) // 3] or [min(nodes)]
    centres = {n: kmeans2(features, n, minit="++", rng=np.random.default_rng(seed))[0] for n in possible}
    n, width = _best(
        [(n, w) for n in possible for w in widths],
        lambda nw: cross_validated(rbf_design(features, centres[nw[0]], nw[1]), target, free),
    )
    return TraditionalRbf(*_fitted(rbf_design(features, centres[n], width), features, target, free), centres[n], width)


def _best(candidates: Sequence[T], score: Callable[[T], float]) -> T:
    return min(candidates, key=score)


def _fitted(
    design: Array, features: Array, target: Array, free: Free
) -> tuple[Array, Array, Array, Array, Array, float, float]:
    """The fields of `Linear`."""
    units = design.shape[1]
    coefficients, offsets = least_squares(design, target, free)
    residual = target - design @ coefficients - free.columns @ offsets
    _, values, rows = np.linalg.svd(_beside(design, target, free)[0], full_matrices=False)
    resolved = values > SMALLEST * values[0]
    factor = (rows[resolved].T / values[resolved])[:units]
    sigma = float(np.sqrt((residual**2).sum() / max(1, len(residual) - int(resolved.sum()))))
    square = float((residual**2).sum())
    alike = float(residual[1:] @ residual[:-1]) / square if square > 0.0 else 0.0
    alike = min(max(alike, 0.0), MOST_ALIKE)
    factor = sigma * np.sqrt((1.0 + alike) / (1.0 - alike)) * factor
    origin = np.zeros(units) if free.anchored else design.mean(axis=0)
    spread = float((target - free.columns @ offsets).std())
    return coefficients, factor, origin, features.min(axis=0), features.max(axis=0), spread, sigma
