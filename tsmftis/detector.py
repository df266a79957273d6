"""The detector: from raw counts to signal, and the noise of a signal.

Functions
---------
correct             dark, non-linearity, flat; saturated and bad pixels become NaN
undo_nonlinearity   the same inversion for a signal in any unit
bad_pixels, stuck_pixels    those that dark and flat, or the frames themselves, give away
noise_out_of_band   variance of an interferogram's samples from a band that holds no light
photon_transfer     var = read² + gain·signal through many of them
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.optimize import nnls

from tsmftis.fourier import apodization, quadrature, transform

Array = NDArray[np.float64]

NONLINEARITY_SCALE = 12000.0  # DN; recorded s' = s·(1 − a·s/12000)


def correct(
    counts: NDArray[np.uint16], dark: Array, flat: Array, saturation: float, nonlinearity: float = 0.0
) -> NDArray[np.float32]:
    """(counts − dark)/flat as float32 (row, frame, col) of counts (frame, row, col), the layout that extraction reads.

    NaN where counts ≥ saturation, and in pixels whose dark or flat is NaN (bad ones, see `bad_pixels`). With a non-linearity a
    the signal after dark, s' = s·(1 − a·s/12000), is first inverted exactly: s = (1 − √(1 − 4as'/12000))·12000/(2a).
    """
    frames, rows, cols = counts.shape
    out = np.empty((rows, frames, cols), np.float32)
    full = int(np.ceil(min(saturation, 65536.0)))
    gain = 1.0 / np.where(flat > 0.0, flat, np.nan)
    _correct(counts, dark.astype(np.float32), gain.astype(np.float32), full, nonlinearity, out)
    return out


def undo_nonlinearity(recorded: Array, a: float, full_scale: Array | float = NONLINEARITY_SCALE) -> Array:
    """s of recorded s' = s·(1 − a·s/full_scale): s = 2s'/(1 + √(1 − 4as'/full_scale)), exact for a small a too."""
    return 2.0 * recorded / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * a * recorded / full_scale, 0.0)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _correct(counts: Any, dark: Any, gain: Any, full: int, nonlinearity: float, out: Any) -> None:
    frames, rows, cols = counts.shape
    b = np.float32(nonlinearity / NONLINEARITY_SCALE)
    one, two, four = np.float32(1.0), np.float32(2.0), np.float32(4.0)
    for r in range(rows):
        for k in range(frames):
            for c in range(cols):
                signal = np.float32(counts[k, r, c]) - dark[r, c]
                if b != 0.0:
                    # The same root written so that it stays exact for a small a.
                    signal = two * signal / (one + np.sqrt(max(one - four * b * signal, np.float32(0.0))))
                out[r, k, c] = signal * gain[r, c] if counts[k, r, c] < full else np.float32(np.nan)


def bad_pixels(dark: Array, flat: Array, threshold: float = 8.0) -> NDArray[np.bool_]:
    """Pixels (row, col) that calibration shows to be bad: no finite dark or flat, no sensitivity, or far from their neighbours.

    Far is more than `threshold` robust standard deviations (1.4826 × median absolute deviation over the detector) of the
    difference to the median of the 5 × 5 pixels around, which fringes of the flat, vignetting and column patterns follow.
    """
    bad = ~(np.isfinite(dark) & np.isfinite(flat)) | ~(flat > 0.0)
    for image in (dark, flat):
        smooth = median_filter(np.where(bad, np.median(image[~bad]), image), size=5, mode="nearest")
        left = image - smooth
        spread = 1.4826 * np.median(np.abs(left[~bad]))
        bad = bad | ~(np.abs(left) <= max(threshold * spread, 1e-6 * float(np.abs(smooth).max())))
    return bad


def stuck_pixels(counts: NDArray[np.uint16], least: float = 0.05) -> NDArray[np.bool_]:
    """Pixels (row, col) that do not follow the scene in frames (frame, row, col) spread over a line.

    Their standard deviation over time is less than `least` times the median of the nine in the same column about them, which
    see the same fringe. (Over real ground the ratio of good pixels goes from 0.2 to 6, so that too much is no sign.)
    """
    spread = counts.astype(np.float32).std(axis=0)
    return np.asarray(spread < least * median_filter(spread, size=(9, 1), mode="nearest"))


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


def photon_transfer(signal: Array, variance: Array, rounds: int = 12) -> tuple[float, float]:
    """read² [DN²] and gain [DN] of var = read² + gain·signal, both ≥ 0.

    Weighted least squares with the weights 1/var² of the fitted line, not of the scattered values: weighing each value by
    its own inverse would favour those that came out low. A variance whose relative residual is more than two robust standard
    deviations counts in proportion less (Huber): in one of them there may be more than noise.
    """
    design = np.stack([np.ones_like(signal), np.maximum(signal, 0.0)], 1)
    fitted, trust = np.full_like(variance, variance.mean()), np.ones_like(variance)
    for _ in range(rounds):
        weighted = design * (trust / fitted)[:, None]
        column = np.maximum(weighted.max(axis=0), 1e-300)
        solution, _ = nnls(weighted / column, trust * variance / fitted)
        solution = solution / column
        fitted = np.maximum(design @ solution, 1e-6 * variance.mean())
        residual = np.abs(variance / fitted - 1.0)
        limit = 2.0 * 1.4826 * max(float(np.median(residual)), 1e-9)
        trust = np.sqrt(np.minimum(1.0, limit / np.maximum(residual, 1e-300)))
    return float(solution[0]), float(solution[1])
