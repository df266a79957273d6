"""Boresight and latency as the ground control points (GCPs) have them: least squares on collinearity.

With p = (roll, pitch, yaw, latency) added to the declared ones and r(p) the picked minus the projected rows and columns,

    p̂ = argmin Σ (r/σ)²,   C = (Jᵀ·W·J)⁻¹·max(1, χ²/ν),

χ² the minimum and ν the degrees of freedom: where poses or points are worse than the points' own sigmas say, the residuals
show it and the covariance grows with them. A constant error of the navigation's attitude in a line is not told apart from the
boresight by that line; several lines share one boresight, yet each has its own attitude error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMES = ("roll", "pitch", "yaw", "latency")
STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-4])  # rad, s: a pixel or less, far from rounding
ROUNDS = 3
WORST_CONDITION = 1e4  # of the normalised Jacobian: beyond it two parameters do the same to every point


@dataclass(frozen=True)
class Control:
    """What must be added to boresight [rad] and latency [s] (4,) to match the points, covariance (4, 4), χ² over `freedom`."""

    value: Array
    covariance: Array
    chi2: float
    freedom: int
    points: int

    @property
    def sigma(self) -> Array:
        """σ of roll, pitch, yaw [rad] and latency [s] (4,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def pitch_latency_correlation(self) -> float:
        return float(self.covariance[1, 3] / (self.sigma[1] * self.sigma[3]))


def fit_control(predict: Callable[[Array], Array], picked: Array, sigma: Array) -> Control:
    """Fit p (4,) [rad, rad, rad, s]; predict(p) and picked: rows and columns (n, 2) [px], sigma (n,) [px].

    Points that `predict` cannot place (NaN) are left out. Raises ValueError where the points do not determine p.
    """
    value = np.zeros(len(NAMES))
    known = np.isfinite(predict(value)).all(axis=1)
    points = int(known.sum())
    if 2 * points <= len(NAMES):
        raise ValueError(f"{points} usable points are too few for {len(NAMES)} parameters")
    weight = np.repeat(1.0 / sigma[known], 2)

    def residual(at: Array) -> Array:
        return weight * (picked[known] - predict(at)[known]).ravel()

    for _ in range(ROUNDS):
        jacobian = np.stack(
            [(residual(value + s) - residual(value - s)) / (2.0 * s.sum()) for s in np.diag(STEPS)], axis=1
        )
        size = np.linalg.norm(jacobian, axis=0)
        if not np.isfinite(size).all() or (size == 0).any() or np.linalg.cond(jacobian / size) > WORST_CONDITION:
            raise ValueError("the points do not tell boresight and latency apart")
        value = value - np.linalg.lstsq(jacobian, residual(value), rcond=None)[0]
    chi2, freedom = float((residual(value) ** 2).sum()), 2 * points - len(NAMES)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * max(1.0, chi2 / freedom)
    return Control(value, covariance, chi2, freedom, points)
