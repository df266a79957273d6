"""The detector: from raw counts to signal, and the noise of a signal.

Functions
---------
correct             dark, non-linearity, flat; saturated pixels become NaN
noise_out_of_band   variance of an interferogram's samples from a band that holds no light
photon_transfer     var = read² + gain·signal through many of them
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from tsmftis.fourier import apodization, quadrature, transform

Array = NDArray[np.float64]

NONLINEARITY_SCALE = 12000.0  # DN; recorded s' = s·(1 − a·s/12000)


def correct(
    counts: NDArray[np.uint16], dark: Array, flat: Array, saturation: float, nonlinearity: float = 0.0
) -> NDArray[np.float32]:
    """(counts − dark)/flat as float32 (frame, row, col), NaN where counts ≥ saturation.

    With a non-linearity a the signal after dark, s' = s·(1 − a·s/12000), is first inverted exactly:
    s = (1 − √(1 − 4as'/12000))·12000/(2a).
    """
    signal = counts.astype(np.float32)
    signal -= dark.astype(np.float32)
    if nonlinearity != 0.0:
        b = nonlinearity / NONLINEARITY_SCALE
        # The same root written so that it stays exact for a small a.
        signal = 2.0 * signal / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * b * signal, 0.0)))
    signal *= (1.0 / flat).astype(np.float32)
    signal[counts >= saturation] = np.nan
    return signal.astype(np.float32, copy=False)


def noise_out_of_band(
    interferogram: Array, gain: Array, opd: Array, lowest_wavenumber: float, highest_wavenumber: float
) -> Array:
    """Variance of one pixel (...,) from interferograms (..., n) and their noise gains (..., n), opd (n,).

    E|Σ w·I·dx·e^{−2πiσx}|² = var·Σ w²·gain·dx² at a wavenumber without light. The band lies between the highest
    wavenumber with light and Nyquist if that is at least three line widths wide, else between 0.3 and 0.9 of the lowest one
    (there the scene's own texture counts in).
    """
    span = float(np.ptp(opd))
    nyquist = 0.5 / float(np.median(np.abs(np.diff(opd))))
    low, high = highest_wavenumber + 2.0 / span, nyquist - 0.5 / span
    if high - low < 3.0 / span:
        low, high = 0.3 * lowest_wavenumber, 0.9 * lowest_wavenumber
    band = np.arange(low, high, 0.5 / span)
    window = apodization("connes", 2.0 * (opd - opd.min()) / span - 1.0)
    power = np.abs(transform(interferogram, opd, window, band)) ** 2
    expected = (gain * (window * quadrature(opd)) ** 2).sum(axis=-1)
    return power.mean(axis=-1) / expected


def photon_transfer(signal: Array, variance: Array, rounds: int = 8) -> tuple[float, float]:
    """read² [DN²] and gain [DN] of var = read² + gain·signal, both ≥ 0.

    Weighted least squares with the weights 1/var² of the fitted line, not of the scattered values: weighing each value by
    its own inverse would favour those that came out low.
    """
    design = np.stack([np.ones_like(signal), np.maximum(signal, 0.0)], 1)
    fitted = np.full_like(variance, variance.mean())
    for _ in range(rounds):
        weighted = design / fitted[:, None]
        column = np.maximum(weighted.max(axis=0), 1e-300)
        solution, _ = nnls(weighted / column, variance / fitted)
        solution = solution / column
        fitted = np.maximum(design @ solution, 1e-6 * variance.mean())
    return float(solution[0]), float(solution[1])
