"""The static interferometer: each detector pixel sees one optical path difference (OPD).

Functions
---------
Interferometer.opd          OPD(row, col) = step·d + quadratic·d² + tilt·(row − (rows−1)/2), d = col − zpd_col
Interferometer.scored_wavenumbers
Interferometer.with_effects what a model update adds
response_with_effects       the same for the calibrated response
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsmftis.effects import Effects, amounts

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

    def with_effects(self, effects: Effects) -> Interferometer:
        """step·(1 + opd_scale), quadratic + opd_quadratic, tilt + fringe_tilt, a + detector_nonlinearity."""
        (scale,), (quadratic,), (tilt,), (a,) = (
            amounts(effects, name) for name in ("opd_scale", "opd_quadratic", "fringe_tilt", "detector_nonlinearity")
        )
        return replace(
            self,
            opd_step=self.opd_step * (1.0 + scale),
            opd_quadratic=self.opd_quadratic + quadratic,
            fringe_tilt=self.fringe_tilt + tilt,
            detector_nonlinearity=self.detector_nonlinearity + a,
        )


def response_with_effects(wavenumber: Array, response: Array, effects: Effects) -> Array:
    """response·(1 + response_scale)·(1 + amplitude·cos(2πσ·thickness + phase)), the latter of channel_fringe."""
    (scale,) = amounts(effects, "response_scale")
    amplitude, thickness, phase = amounts(effects, "channel_fringe")
    fringe = 1.0 + amplitude * np.cos(2.0 * np.pi * wavenumber * thickness + phase)
    return response * (1.0 + scale) * fringe
