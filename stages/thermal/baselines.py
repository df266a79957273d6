"""What the Bayesian network is held against: polynomials and the traditional RBF, with the same fit and predict.

All are linear least squares on a design of their own, and get what cross-validation can give them: a polynomial
its degree, the RBF its number of nodes and its width. Folds are contiguous stretches of the run, because neighbouring
blocks of a slow run are nearly copies of each other and would flatter any number of nodes.

References
----------
.. [1] J. Moody, C. J. Darken, Fast learning in networks of locally-tuned processing units,
   Neural Computation 1 (1989) 281.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

Array = NDArray[np.float64]
T = TypeVar("T")

FOLDS, STRETCHES = 5, 15


@dataclass(frozen=True)
class Polynomial:
    """δ = Σ_k a_k·T^k on the scaled temperature (first column); coefficients (K+1,) in the target's unit."""

    coefficients: Array
    residual_sigma: float

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,); the latter is that of the training residuals, the same everywhere."""
        mean = polynomial_design(features, len(self.coefficients) - 1) @ self.coefficients
        return mean, np.full(len(features), self.residual_sigma)


@dataclass(frozen=True)
class MultiPolynomial:
    """δ = Σ_k a_k·Π_d x_d^(e_kd): all products of the features up to a degree; exponents e (K, D), coefficients a (K,)."""

    exponents: Array
    coefficients: Array
    residual_sigma: float

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,); the latter is that of the training residuals, the same everywhere."""
        return products(features, self.exponents) @ self.coefficients, np.full(len(features), self.residual_sigma)


@dataclass(frozen=True)
class TraditionalRbf:
    """δ = c + Σ_m v_m·exp(−|x − c_m|²/2s²): centres (M, D), one width s, unregularised weights (1 + M,)."""

    centres: Array
    width: float
    weights: Array
    residual_sigma: float

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,); the latter is that of the training residuals, the same everywhere."""
        mean = rbf_design(features, self.centres, self.width) @ self.weights
        return mean, np.full(len(features), self.residual_sigma)


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


def least_squares(design: Array, target: Array) -> Array:
    """Plain least squares; only what double precision cannot resolve is cut off."""
    return np.asarray(np.linalg.lstsq(design, target, rcond=1e-12)[0], dtype=np.float64)


def folds(count: int) -> NDArray[np.int64]:
    """The fold that holds out each of `count` successive blocks: STRETCHES contiguous stretches dealt to FOLDS."""
    return np.arange(count) * STRETCHES // count % FOLDS


def cross_validated(design: Array, target: Array) -> float:
    """Mean squared error of held-out stretches."""
    fold = folds(len(target))
    error = np.empty(len(target))
    for k in range(FOLDS):
        out = fold == k
        error[out] = target[out] - design[out] @ least_squares(design[~out], target[~out])
    return float((error**2).mean())


def fit_polynomial(features: Array, target: Array, degrees: Sequence[int]) -> Polynomial:
    """The polynomial in T whose degree predicts held-out stretches best."""
    best = _best(degrees, lambda d: cross_validated(polynomial_design(features, d), target))
    design = polynomial_design(features, best)
    coefficients = least_squares(design, target)
    return Polynomial(coefficients, _sigma(target - design @ coefficients, len(coefficients)))


def fit_multi_polynomial(features: Array, target: Array, degrees: Sequence[int]) -> MultiPolynomial:
    """The polynomial in all features whose degree predicts held-out stretches best."""
    designs = {d: exponents_up_to(d, features.shape[1]) for d in degrees}
    best = _best(degrees, lambda d: cross_validated(products(features, designs[d]), target))
    design = products(features, designs[best])
    coefficients = least_squares(design, target)
    return MultiPolynomial(designs[best], coefficients, _sigma(target - design @ coefficients, len(coefficients)))


def fit_traditional_rbf(
    features: Array, target: Array, nodes: Sequence[int], widths: Sequence[float], seed: int
) -> TraditionalRbf:
    """The RBF with k-means centres whose number and width predict held-out stretches best."""
    possible = [n for n in nodes if n < len(target) // 3] or [min(nodes)]
    centres = {n: kmeans2(features, n, minit="++", rng=np.random.default_rng(seed))[0] for n in possible}
    n, width = _best(
        [(n, w) for n in possible for w in widths],
        lambda nw: cross_validated(rbf_design(features, centres[nw[0]], nw[1]), target),
    )
    design = rbf_design(features, centres[n], width)
    weights = least_squares(design, target)
    return TraditionalRbf(centres[n], width, weights, _sigma(target - design @ weights, len(weights)))


def _best(candidates: Sequence[T], score: Callable[[T], float]) -> T:
    return min(candidates, key=score)


def _sigma(residual: Array, parameters: int) -> float:
    return float(np.sqrt((residual**2).sum() / max(1, len(residual) - parameters)))
