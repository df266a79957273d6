"""The static interferometer: each detector pixel sees one optical path difference (OPD).

Functions
---------
Interferometer.opd          OPD(row, col) = step·d + quadratic·d² + tilt·(row − (rows−1)/2), d = col − zpd_col
Interferometer.scored_wavenumbers
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Interferometer:
    """Named parameters of the interferometer; OPD in metres, `zpd_col` in columns, wavelengths in metres."""

    rows: int
    cols: int
    opd_step: float
    zpd_col: float
    wavelength_low: float
    wavelength_high: float
    opd_quadratic: float = 0.0
    fringe_tilt: float = 0.0
    detector_nonlinearity: float = 0.0

    def opd(self, row: ArrayLike, col: ArrayLike) -> Array:
        """OPD [m] at detector positions; row and col broadcast."""
        d = np.asarray(col, float) - self.zpd_col
        return (
            self.opd_step * d
            + self.opd_quadratic * d * d
            + self.fringe_tilt * (np.asarray(row, float) - (self.rows - 1) / 2)
        )

    @property
    def longest_opd(self) -> float:
        """L, the largest one-sided OPD [m] along the middle row; it sets the apodization and the resolution."""
        return float(np.abs(self.opd((self.rows - 1) / 2, np.arange(self.cols))).max())

    @property
    def shortest_side(self) -> float:
        """Largest OPD [m] of the short side, over which the Mertz ramp rises."""
        opd = self.opd((self.rows - 1) / 2, np.arange(self.cols))
        return float(min(-opd.min(), opd.max()))

    def scored_wavenumbers(self, step: float = 5000.0) -> Array:
        """1/λ_high, + step, … up to 1/λ_low [m-1]."""
        return np.arange(1.0 / self.wavelength_high, 1.0 / self.wavelength_low, step)
