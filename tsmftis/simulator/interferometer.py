"""From a spectrum to the interferogram that lies across the detector.

    I(row, col) = ∫ response·B/V dσ + ∫ response·B·cos(2πσ·OPD(row, col) + φ) dσ        [DN, after dark and flat]

`response` is that of the fringes, so the constant part divides by the visibility V.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NONLINEARITY_SIGNAL = 12000.0  # DN, the signal at which the loss is the fraction a
_BLOCK = 2048  # path differences transformed at a time


def path_difference(
    rows: int, cols: int, step: float, zpd_col: float, quadratic: float = 0.0, tilt: float = 0.0
) -> Array:
    """OPD = step·d + quadratic·d² + tilt·(row − (rows−1)/2), d = col − zpd_col; (rows, cols) [m]."""
    d = np.arange(cols) - zpd_col
    return step * d + quadratic * d**2 + tilt * (np.arange(rows)[:, None] - (rows - 1) / 2.0)


def channel_fringe(wavenumber: Array, amplitude: float, thickness: float, phase: float) -> Array:
    """Transmission 1 + amplitude·cos(2πσ·thickness + phase) of a thin plate of optical thickness [m] (both passes)."""
    return 1.0 + amplitude * np.cos(2.0 * np.pi * wavenumber * thickness + phase)


def interferogram(
    opd: Array, wavenumber: Array, response: Array, radiance: Array, phase: Array, visibility: float
) -> Array:
    """Signal [DN] at opd (...) [m] of spectra radiance (material, wavenumber) → (material, ...), trapezoidal rule.

    wavenumber (k,) [m⁻¹], response (k,) [DN per radiance and m⁻¹], phase (k,) [rad].
    """
    weight = np.zeros_like(wavenumber)
    weight[1:] += 0.5 * np.diff(wavenumber)
    weight[:-1] += 0.5 * np.diff(wavenumber)
    strength = radiance * response * weight
    flat = opd.ravel()
    out = np.empty((len(radiance), flat.size))
    for start in range(0, flat.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        out[:, block] = strength @ np.cos(2.0 * np.pi * np.outer(wavenumber, flat[block]) + phase[:, None])
    out += strength.sum(axis=1, keepdims=True) / visibility
    return out.reshape(-1, *opd.shape)


def saturate(signal: Array, a: float) -> Array:
    """Detector non-linearity s·(1 − a·s/12000) of the signal after dark with its constant part [DN]."""
    return signal * (1.0 - a * signal / NONLINEARITY_SIGNAL)
