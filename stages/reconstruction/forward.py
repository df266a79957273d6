"""The interferogram that an instrument makes of known spectra, at any path differences, fast.

    J_b(x) = ∫ R(σ)·B_b(σ)·exp(i(2πσx + φ(σ))) dσ,      I_b = Re J_b,      ∂I_b/∂c_k = −Im ∫ u^k·R·B_b·exp(…) dσ

with φ = Σ c_k·u^k. J is tabulated on a fine grid of x and interpolated by cubic splines: its band is known, so that the table's
error is (2πσ·h)⁴/384 of the fringes, 1.2e-5 at 24 points a period of the shortest wave.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tsmftis.fourier import quadrature

Array = NDArray[np.float64]

POINTS_A_PERIOD = 24.0


@dataclass(frozen=True)
class Forward:
    """Spectra `radiance` (b, k) on `wavenumber` (k,) [m-1]; path differences within `low` … `high` [m]; phase of `order`."""

    wavenumber: Array
    radiance: Array
    low: float
    high: float
    order: int

    @cached_property
    def grid(self) -> Array:
        count = int(np.ceil((self.high - self.low) * self.wavenumber[-1] * POINTS_A_PERIOD)) + 1
        return np.linspace(self.low, self.high, max(count, 4))

    @cached_property
    def carrier(self) -> tuple[Array, Array]:
        """cos and sin of 2πσx (k, grid)."""
        angle = 2.0 * np.pi * np.outer(self.wavenumber, self.grid)
        return np.cos(angle), np.sin(angle)

    @cached_property
    def powers(self) -> Array:
        """u^k (order + 1, k), u from −1 to 1 over the wavenumbers."""
        u = 2.0 * (self.wavenumber - self.wavenumber[0]) / (self.wavenumber[-1] - self.wavenumber[0]) - 1.0
        return np.stack([u**k for k in range(self.order + 1)])

    def tables(self, response: Array, phase: Array, derivatives: bool) -> list[CubicSpline]:
        """Splines over x of I (b,), and of ∂I/∂c_0, ∂I/∂c_1, …, if they are asked for."""
        strength = self.radiance * response * quadrature(self.wavenumber)
        angle = phase @ self.powers
        real, imaginary = strength * np.cos(angle), strength * np.sin(angle)
        cosine, sine = self.carrier
        b = len(strength)
        rows = [(real, -imaginary)]
        if derivatives:
            rows += [(-imaginary * p, -real * p) for p in self.powers]
        values = np.concatenate([r for r, _ in rows]) @ cosine + np.concatenate([i for _, i in rows]) @ sine
        return [CubicSpline(self.grid, values[i * b : (i + 1) * b].T) for i in range(len(rows))]
