"""Curves of a covariate for structure that no declared effect accounts for: a straight line and natural cubic splines without it.

Functions
---------
curves_of    the curves, with knots on quantiles of some values
even         with knots at even distances
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]

KNOTS = 6
TABLE = 25
EVENLY = 1001
CONSTANT = 1e-9  # relative spread below which a covariate does not vary


@dataclass(frozen=True)
class Curves:
    """Of x: (x − centre)/spread, and cardinal splines of the inner knots less their own `line` (2, k).

    A curve of a distance has its centre at zero, and the line that is taken off goes through it: a scale is then the line itself.
    """

    centre: float
    spread: float
    knots: Array
    line: Array

    @property
    def count(self) -> int:
        return 1 + self.line.shape[1]

    @property
    def table(self) -> Array:
        return np.linspace(self.knots[0], self.knots[-1], TABLE)

    def __call__(self, x: Array) -> Array:
        """(n, count)."""
        line = (x - self.centre) / self.spread
        if self.count == 1:
            return line[:, None]
        return np.column_stack([line, self.bends(x) - np.column_stack([np.ones(x.size), line]) @ self.line])

    def bends(self, x: Array) -> Array:
        """The splines themselves; beyond the outer knots straight on."""
        spline = CubicSpline(self.knots, np.eye(self.knots.size)[:, 1:-1], bc_type="natural")
        inside = np.clip(x, self.knots[0], self.knots[-1])
        return np.asarray(spline(inside) + spline(inside, 1) * (x - inside)[:, None])


def curves_of(values: Array, distance: bool = False) -> Curves | None:
    """None where the values do not vary or are not known; `distance`: they are distances from a point that does not move."""
    spread = float(np.std(values))
    if not np.isfinite(spread) or spread <= CONSTANT * max(1.0, float(np.max(np.abs(values)))):
        return None
    knots = np.unique(np.quantile(values, np.linspace(0.0, 1.0, KNOTS)))
    made = Curves(0.0 if distance else float(values.mean()), spread, knots, np.zeros((2, 0)))
    if knots.size < KNOTS:
        return made
    flat = np.column_stack([np.full(values.size, float(not distance)), (values - made.centre) / spread])
    return replace(made, line=np.asarray(np.linalg.lstsq(flat, made.bends(values), rcond=None)[0], float))


def even(low: float, high: float) -> Curves | None:
    """Curves between two values with knots at even distances; None where they are one value."""
    return curves_of(np.linspace(low, high, EVENLY))
