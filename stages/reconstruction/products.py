"""Products beside the scored spectra: another window, phase correction or spacing, and the best mean over whole panels."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stages.reconstruction.interferograms import Extracted, Extraction, gain_of
from stages.reconstruction.panel import PanelPoints, best_weights
from tsmftis import fourier
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]
PhaseCorrection = Literal["mertz", "forman"]


def spectra_by(
    ac: Array,
    variance: Array,
    opd: Array,
    interferometer: Interferometer,
    wavenumber: Array,
    phase: Array,
    centre: float,
    response: Array,
    apodization: str,
    phase_correction: PhaseCorrection,
    band: Array,
    band_phase: Array,
) -> tuple[Array, Array]:
    """Radiance and sigma (point, k) of interferograms ac with sample variances (point, col); opd (col,) or (point, col).

    phase, response (k,) on wavenumber (k,); centre: of the fringes [m]; band, band_phase: all wavenumbers with light, for
    Forman's convolution.
    """
    window = fourier.apodization(apodization, opd / interferometer.longest_opd)
    if phase_correction == "mertz":
        window = window * fourier.mertz_ramp(opd, interferometer.shortest_side, centre)
        return fourier.radiance(ac, opd, window, wavenumber, phase, response, variance)
    if opd.ndim == 1:
        matrix = fourier.forman_operator(opd, window, wavenumber, response, band, band_phase)
        return ac @ matrix, np.sqrt(variance @ matrix**2)
    value, sigma = np.empty((2, len(ac), wavenumber.size))
    for p in range(len(ac)):
        matrix = fourier.forman_operator(opd[p], window[p], wavenumber, response, band, band_phase)
        value[p], sigma[p] = ac[p] @ matrix, np.sqrt(variance[p] @ matrix**2)
    return value, sigma


def panel_levels(extracted: Extracted) -> Array:
    """Mean signal of a panel's points (point,) [DN], NaN where they were not seen well enough."""
    return np.where(extracted.counted, extracted.value.mean(axis=1), np.nan)


def panel_mean(
    points: PanelPoints,
    blur: float,
    extracted: Extracted,
    noise: tuple[float, float],
    rows: int,
    breaks: list[int],
    how: Extraction,
) -> tuple[Array, Array, Array, int, float] | None:
    """The panel's best mean interferogram, its samples' variances, its mean row (col,), the number of points in it, and the
    contrast of the surroundings over the panel's own rms (NaN where no surroundings were seen).

    None where no point of the panel was seen well enough. blur [px]; noise: read² [DN²] and gain [DN].
    """
    counted, within = extracted.counted, points.inside(blur)
    if not (counted & (within > 0.5)).any():
        return None
    inside, value = within[counted], extracted.value[counted]
    signal = np.average(value, axis=0, weights=np.maximum(inside, 1e-6))
    pixel_variance = noise[0] + noise[1] * np.maximum(signal, 0.0)
    variance = float((pixel_variance * extracted.gain[counted].mean(axis=0)).mean())
    around = inside < 0.02
    contrast, relative = 0.0, np.nan
    if around.any():
        best = inside >= min(0.98, inside.max())
        difference = value[around].mean(axis=0) - value[best].mean(axis=0)
        contrast = float(np.sqrt(np.mean(difference**2)))
        relative = contrast / float(np.sqrt(np.mean(value[best].mean(axis=0) ** 2)))
    share = np.zeros(len(counted))
    share[counted] = best_weights(inside, contrast, variance)
    gain = gain_of(points.row, points.col, share, extracted.crossings, rows, breaks, how)
    mean, row = share @ extracted.value, share @ extracted.row
    variances = (noise[0] + noise[1] * np.maximum(mean, 0.0)) * gain
    return mean, variances, row, int((share > 0.0).sum()), relative


def imaginary_residue(
    ac: Array, variance: Array, opd: Array, interferometer: Interferometer, wavenumber: Array, phase: Array
) -> Array:
    """Mean of (Im/σ)² over the wavenumbers of the two-sided spectrum after phase correction, one value a point.

    About 1 where phase and noise are what they are taken for; more where an interferogram is not one of one place.
    """
    short = interferometer.shortest_side
    centre = fourier.fringe_centre(phase, wavenumber)
    out = np.empty(len(ac))
    for p in range(len(ac)):
        x = opd if opd.ndim == 1 else opd[p]
        window = fourier.apodization("connes", (x - centre) / max(short - abs(centre), 1e-12))
        matrix = fourier.operator(x, window, wavenumber, phase - 0.5 * np.pi, np.ones_like(phase))
        out[p] = np.mean((ac[p] @ matrix) ** 2 / np.maximum(variance[p] @ matrix**2, 1e-300))
    return out
