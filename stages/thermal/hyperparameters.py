"""How well the data determine the hyperparameters of a network, and what they could as well have been.

The evidence has a width, not only a maximum: networks whose evidence is as good to a nat or two may differ, outside the training
data, by several sigmas of one of them. Draws from a Student-t about the maximum, shaped by the curvature there, are weighed by
evidence times prior over the density of the draw, and thinned to a few of equal share.

References
----------
.. [1] J. Geweke, Bayesian inference in econometric models using Monte Carlo integration, Econometrica 57 (1989) 1317.
.. [2] H. Rue, S. Martino, N. Chopin, Approximate Bayesian inference for latent Gaussian models by using integrated nested Laplace
   approximations, J. R. Stat. Soc. B 71 (2009) 319.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRAWS = 384
# Heavier tails than the posterior's, so that no weight runs away.
FREEDOM = 7
STEP = 1e-3
# Along a direction that the data leave open a draw goes this far at most (a factor of e² in a width), one sigma.
WIDEST = 2.0


def curvature(gradient: Callable[[Array], Array], mode: Array) -> Array:
    """Hessian (d, d) of a loss at `mode` from central differences of its gradient, made symmetric."""
    steps = STEP * np.eye(len(mode))
    hessian = np.stack([(gradient(mode + h) - gradient(mode - h)) / (2.0 * STEP) for h in steps])
    return 0.5 * (hessian + hessian.T)


def alternatives(
    loss: Callable[[Array], float],
    gradient: Callable[[Array], Array],
    mode: Array,
    bounds: Array,
    count: int,
    seed: int,
) -> tuple[Array, Array, float]:
    """Up to `count` points (k, d) within bounds (d, 2) and their shares (k,), a sample of the density e^(−loss) about `mode`.

    `loss` is −ln(evidence·prior). Shares add up to 1; a point drawn more than once comes once with its share. The mode itself is
    returned alone where no draw is worth counting. The last is the effective size of the sample, (Σw)²/Σw² of the weights of all
    draws: where it is small a few draws stand for the whole density, and the sample says little about its width.
    """
    rng = np.random.default_rng(seed)
    size = len(mode)
    values, vectors = np.linalg.eigh(curvature(gradient, mode))
    sigma = 1.0 / np.sqrt(np.maximum(values, 1.0 / WIDEST**2))
    normal = rng.standard_normal((DRAWS, size)) / np.sqrt(rng.chisquare(FREEDOM, (DRAWS, 1)) / FREEDOM)
    points = mode + (normal * sigma) @ vectors.T
    within = ((points >= bounds[:, 0]) & (points <= bounds[:, 1])).all(axis=1)
    if not within.any():
        return mode[None], np.ones(1), 0.0
    points, normal = points[within], normal[within]
    log_density = -0.5 * (FREEDOM + size) * np.log1p((normal**2).sum(axis=1) / FREEDOM)
    log_weight = -np.array([loss(p) for p in points]) - log_density
    weight = np.exp(log_weight - log_weight.max())
    edges = np.cumsum(weight) / weight.sum()
    chosen = np.searchsorted(edges, (np.arange(count) + 0.5) / count)
    chosen, times = np.unique(np.minimum(chosen, len(points) - 1), return_counts=True)
    return points[chosen], times / count, float(weight.sum() ** 2 / (weight**2).sum())
