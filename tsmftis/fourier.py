"""From interferograms to spectra: windows, phase, transform, line shape, score.

The AC part of an interferogram is I(x) = ∫ R(σ)·B(σ)·cos(2πσx + φ(σ)) dσ with x the optical path difference (OPD) [m] and
σ the wavenumber [m-1]. Its transform is S(σ) = ∫ w(x)·I(x)·exp(−2πiσx) dx with a window w; for a ramp with
w(x) + w(−x) = 1 the part in phase is Re(S·exp(−iφ)) = R·B/4, smoothed by the line shape.

The transform is a matrix product over the samples' own OPD, so uniform and non-uniform sampling take one code path, and
the spectrum comes out on exactly the wavenumbers asked for (for uniform OPD it equals a zero-filled FFT there).

Functions
---------
apodization         the window family
mertz_ramp          weights that count the doubly measured short side once
scored_window       both, as the score is defined
quadrature          dx of each sample
remove_constant     DC and slow drift
transform           S(σ)
phase_polynomial, smooth_phase      φ(σ) from the two-sided part
fringe_centre       the OPD that φ's slope shifts the fringes to
operator, forman_operator   the linear map from interferogram to B(σ), after Mertz and after Forman
radiance            B(σ) and its sigma
line_shape_response, line_width     B as the instrument's line shape shows it, and that shape's width
rqe                 relative quadratic error

References
----------
.. [1] L. Mertz, Auxiliary computation for Fourier spectrometry, Infrared Physics 7 (1967) 17–23.
.. [2] S. P. Davis, M. C. Abrams, J. W. Brault, Fourier Transform Spectrometry, Academic Press 2001.
.. [3] G. P. Happ, L. Genzel, Interferenz-Modulation mit monochromatischen Millimeterwellen, Infrared Phys. 1 (1961) 39.
.. [4] R. H. Norton, R. Beer, New apodizing functions for Fourier spectrometry, JOSA 66 (1976) 259; 67 (1977) 419 (errata).
.. [5] M. L. Forman, W. H. Steel, G. A. Vanasse, Correction of asymmetric interferograms obtained in Fourier spectroscopy,
       JOSA 56 (1966) 59.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NORTON_BEER = {
    "norton-beer-weak": (0.384093, -0.087577, 0.703484, 0.0),
    "norton-beer-medium": (0.152442, -0.136176, 0.983734, 0.0),
    "norton-beer-strong": (0.045335, 0.0, 0.554883, 0.399782),
}
BLACKMAN_HARRIS = {
    "blackman-harris-3": (0.42323, 0.49755, 0.07922),
    "blackman-harris-4": (0.35875, 0.48829, 0.14128, 0.01168),
}
# The score is defined on these; they are no settings.
SCORED_APODIZATION = "connes"
LEAST_SEEN = 0.97  # of the columns, for a point or a cell to have a spectrum

APODIZATIONS = ("boxcar", "triangle", "connes", "happ-genzel", "gaussian", *NORTON_BEER, *BLACKMAN_HARRIS)


def apodization(name: str, u: Array) -> Array:
    """Window at u = OPD/L, zero for |u| > 1 (bar rounding); `name` is one of `APODIZATIONS`.

    connes (1−u²)²; triangle 1−|u|; happ-genzel 0.54 + 0.46 cos πu; Norton–Beer Σ c_i (1−u²)^i with i = 0, 1, 2, 4 as
    published [4]_; Blackman–Harris Σ a_i cos iπu; gaussian exp(−ln 100·u²), 1 % at u = 1. Raises ValueError for another
    name.
    """
    u = np.asarray(u, float)
    inside = np.abs(u) <= 1.0 + 1e-12
    v = 1.0 - np.clip(u * u, 0.0, 1.0)
    if name == "boxcar":
        window = np.ones_like(u)
    elif name == "triangle":
        window = 1.0 - np.minimum(np.abs(u), 1.0)
    elif name == "connes":
        window = v * v
    elif name == "happ-genzel":
        window = 0.54 + 0.46 * np.cos(np.pi * u)
    elif name == "gaussian":
        window = np.exp(-np.log(100.0) * u * u)
    elif name in NORTON_BEER:
        c0, c1, c2, c4 = NORTON_BEER[name]
        window = c0 + c1 * v + c2 * v**2 + c4 * v**4
    elif name in BLACKMAN_HARRIS:
        window = sum((a * np.cos(i * np.pi * u) for i, a in enumerate(BLACKMAN_HARRIS[name])), np.zeros_like(u))
    else:
        raise ValueError(f"unknown apodization '{name}': use one of {', '.join(APODIZATIONS)}")
    return np.where(inside, window, 0.0)


def mertz_ramp(opd: Array, short_side: float, centre: float = 0.0) -> Array:
    """Weights 0 → 1 that count the doubly measured part once and the long side fully [1]_; opd (..., n) [m].

    w(c + x) + w(c − x) = 1 about the fringes' centre c (see `fringe_centre`), rising over |x| ≤ short_side − |c|, so that the
    ramp stays within what the short side measured. The long side may be the positive or the negative one.
    """
    opd = np.asarray(opd, float)
    direction = 1.0 if opd.max() >= -opd.min() else -1.0
    return np.clip(0.5 * (1.0 + direction * (opd - centre) / (short_side - abs(centre))), 0.0, 1.0)


def scored_window(opd: Array, longest: float, short_side: float, centre: float) -> Array:
    """The window of every scored spectrum and of the cube: Mertz ramp about `centre` times `SCORED_APODIZATION` of OPD/L."""
    return mertz_ramp(opd, short_side, centre) * apodization(SCORED_APODIZATION, opd / longest)


def quadrature(opd: Array) -> Array:
    """dx of each sample (..., n) by the trapezoid rule; the end samples stand for half an interval."""
    opd = np.asarray(opd, float)
    step = np.diff(opd, axis=-1)
    dx = np.zeros_like(opd)
    dx[..., :-1] += 0.5 * step
    dx[..., 1:] += 0.5 * step
    return np.abs(dx)


def remove_constant(interferogram: Array, opd: Array, order: int) -> Array:
    """The interferogram (..., n) less its least-squares polynomial of `order` in OPD: DC and slow drift of the scene.

    A polynomial of order m over a scan of length D holds nothing above about m/(2D), far below the instrument's band.
    """
    opd = np.asarray(opd, float)
    u = (opd - opd.mean(axis=-1, keepdims=True)) / np.ptp(opd, axis=-1)[..., None] * 2.0
    q, _ = np.linalg.qr(np.stack([u**k for k in range(order + 1)], -1))
    if q.ndim == 2:
        return interferogram - (interferogram @ q) @ q.T
    drift: Array = np.einsum("...nk,...k->...n", q, np.einsum("...nk,...n->...k", q, interferogram))
    return interferogram - drift


def transform(interferogram: Array, opd: Array, window: Array, wavenumber: Array) -> Complex:
    """S(σ) = Σ w·I·exp(−2πiσx)·dx; interferogram (..., n), opd and window (n,) or like it → (..., len(wavenumber))."""
    weighted = interferogram * window * quadrature(opd)
    if opd.ndim == 1:
        angle = 2.0 * np.pi * np.outer(opd, wavenumber)
        return weighted @ np.cos(angle) - 1j * (weighted @ np.sin(angle))
    flat = weighted.reshape(-1, weighted.shape[-1])
    x = np.broadcast_to(opd, weighted.shape).reshape(-1, weighted.shape[-1])
    return _by_series(flat, x, wavenumber).reshape(*weighted.shape[:-1], wavenumber.size)


def _by_series(weighted: Array, opd: Array, wavenumber: Array) -> Complex:
    """Σ_j v_j·exp(−2πiσx_j) for interferograms (m, n) that each have their own OPDs near common ones.

    With x_j = c_j + s + d_j, c the mean over the interferograms, s one shift each and d what is left, the factor
    exp(−2πiσd) is expanded in powers of d, so that each order is one product with a table that all share. Where 2πσd goes
    beyond 4 rad, which would want many orders, the sum is taken as it stands.
    """
    common = opd.mean(axis=0)
    shift = (opd - common).mean(axis=1, keepdims=True)
    left = opd - common - shift
    largest = 2.0 * np.pi * float(np.abs(wavenumber).max()) * float(np.abs(left).max(initial=0.0))
    if largest > 4.0:
        return np.stack([np.exp(-2j * np.pi * np.outer(wavenumber, x)) @ v for v, x in zip(weighted, opd, strict=True)])
    angle = 2.0 * np.pi * np.outer(common, wavenumber)
    cosine, sine = np.cos(angle), np.sin(angle)
    total = np.zeros((len(weighted), wavenumber.size), complex)
    term, size, order = weighted, 1.0, 0
    factor = np.ones(wavenumber.size, complex)
    while size > 1e-9 or order <= largest:
        total += factor * (term @ cosine - 1j * (term @ sine))
        order += 1
        term = term * left
        factor = factor * (-2j * np.pi * wavenumber / order)
        size *= largest / order
    return total * np.exp(-2j * np.pi * shift * wavenumber)


def phase_polynomial(spectrum: Complex, wavenumber: Array, order: int, rounds: int = 4) -> Array:
    """Coefficients of φ(u), u ∈ [−1, 1] over the wavenumbers, lowest first, from a two-sided low-resolution spectrum.

    The angle is unwrapped, fitted with weights |S|², and refined on the residual angle, so that a turn lost in the noise
    of a weak part does not bend the rest. spectrum (k,), wavenumber (k,) → (order + 1,).
    """
    u = _unit(wavenumber)
    weight = np.abs(spectrum) / np.abs(spectrum).max()
    coefficients: NDArray[Any] = np.polynomial.polynomial.polyfit(u, np.unwrap(np.angle(spectrum)), order, w=weight)
    for _ in range(rounds):
        left = np.angle(spectrum * np.exp(-1j * np.polynomial.polynomial.polyval(u, coefficients)))
        coefficients = coefficients + np.polynomial.polynomial.polyfit(u, left, order, w=weight)
    return coefficients


def smooth_phase(coefficients: Array, wavenumber: Array, span: tuple[float, float] | None = None) -> Array:
    """φ [rad] at wavenumbers; `span`: first and last of those the coefficients were fitted on, if these are others."""
    return np.asarray(np.polynomial.polynomial.polyval(_unit(wavenumber, span), coefficients), float)


def _unit(wavenumber: Array, span: tuple[float, float] | None = None) -> Array:
    low, high = span or (wavenumber[0], wavenumber[-1])
    return 2.0 * (wavenumber - low) / (high - low) - 1.0


def fringe_centre(phase: Array, wavenumber: Array) -> float:
    """OPD [m] x₀ = −φ′/2π about which the fringes are symmetric: the mean slope of φ is a shift of zero path difference.

    The Mertz ramp must rise about it: about any other point w(x₀ + x) + w(x₀ − x) ≠ 1, a scale error in every spectrum.
    """
    return float(-np.polyfit(wavenumber, phase, 1)[0] / (2.0 * np.pi))


def operator(opd: Array, window: Array, wavenumber: Array, phase: Array, response: Array) -> Array:
    """The matrix (n, k) that takes an interferogram (n,) to B = 4·Re(S·exp(−iφ))/R: 4·w·dx·cos(2πσx + φ)/R.

    window (n,) must hold a Mertz ramp; phase, response (k,) on wavenumber (k,). With the phase turned by −π/2 it gives the
    imaginary part. Its squares take the variances of white samples to the variance of B.
    """
    angle = 2.0 * np.pi * np.outer(opd, wavenumber) + phase
    return (4.0 * window * quadrature(opd))[:, None] * np.cos(angle) / response


def forman_operator(
    opd: Array,
    apodized: Array,
    wavenumber: Array,
    response: Array,
    band: Array,
    band_phase: Array,
) -> Array:
    """`operator` by Forman's way [5]_: the interferogram is made symmetric by a convolution, then transformed from one side.

    I′(x) = ∫ I(y)·p(x − y) dy with p(x) = 2∫ cos(2πσx − φ) dσ over `band` (m,), all wavenumbers with light, and φ there;
    B = 4·∫₀ w(x)·I′(x)·cos(2πσx) dx/R over the long side. opd (n,) need not be uniform; apodized (n,): the window w without
    a ramp; response (k,) on wavenumber (k,). Where Mertz's ramp weighs the short side down gradually, here it counts fully
    and its end cuts the convolution off. `band` must be finer than 1/(4·ptp(opd)).
    """
    sign = 1.0 if opd.max() >= -opd.min() else -1.0
    far, step = sign * opd[np.argmax(sign * opd)], float(np.median(np.abs(np.diff(opd))))
    side = sign * np.arange(0.0, sign * far + 0.5 * step, step)
    turned = np.exp(2j * np.pi * np.outer(opd, band) + 1j * band_phase) * quadrature(band)
    kernel = 2.0 * np.real(turned @ np.exp(-2j * np.pi * np.outer(band, side)))
    weight = np.interp(side, *_rising(opd, apodized)) * quadrature(side)
    back = weight[:, None] * np.cos(2.0 * np.pi * np.outer(side, wavenumber))
    return 4.0 * (quadrature(opd)[:, None] * kernel) @ back / response


def _rising(x: Array, y: Array) -> tuple[Array, Array]:
    order = np.argsort(x)
    return x[order], y[order]


def radiance(
    interferogram: Array,
    opd: Array,
    window: Array,
    wavenumber: Array,
    phase: Array,
    response: Array,
    variance: Array | None = None,
) -> tuple[Array, Array]:
    """B = 4·Re(S·exp(−iφ))/R and its sigma, zero where no variance is given; see `operator`.

    interferogram, variance (..., n): AC part and variance of each sample (white between samples); opd and window (n,), or
    like the interferograms where each has its own. sigma² = (4/R)²·Σ (w·dx·cos(2πσx + φ))²·var.
    """
    if opd.ndim == 1:
        matrix = operator(opd, window, wavenumber, phase, response).astype(interferogram.dtype, copy=False)
        value = interferogram @ matrix
        return value, np.zeros_like(value) if variance is None else np.sqrt(variance @ matrix**2)
    spectrum = transform(interferogram, opd, window, wavenumber)
    value = 4.0 * np.real(spectrum * np.exp(-1j * phase)) / response
    if variance is None:
        return value, np.zeros_like(value)
    flat, w, x = (np.broadcast_to(a, variance.shape).reshape(-1, variance.shape[-1]) for a in (variance, window, opd))
    total = np.stack(
        [v @ operator(at, ww, wavenumber, phase, response) ** 2 for v, ww, at in zip(flat, w, x, strict=True)]
    )
    return value, np.sqrt(total).reshape(*variance.shape[:-1], wavenumber.size)


def line_shape_response(
    spectrum: Array, response: Array, table_wavenumber: Array, longest_opd: float, name: str, wavenumber: Array
) -> Array:
    """`spectrum` as an ideal instrument of this OPD range and window shows it: R·B → interferogram → window → transform → /R.

    spectrum (..., m) and response (m,) on table_wavenumber (m,) [m-1] → (..., k). The interferogram is two-sided and free
    of noise: F(x) = ∫ R·B·cos(2πσx) dσ, B' = 2∫ w(x)·F(x)·cos(2πσx) dx / R.
    """
    step = 0.2 / table_wavenumber[-1]  # five samples a period of the shortest wave
    count = int(np.ceil(longest_opd / step))
    x = np.linspace(0.0, longest_opd, count + 1)
    forward = np.cos(2.0 * np.pi * np.outer(table_wavenumber, x)) * (response * quadrature(table_wavenumber))[:, None]
    dx = np.full(x.size, x[1])
    dx[[0, -1]] *= 0.5
    back = np.cos(2.0 * np.pi * np.outer(x, wavenumber)) * (apodization(name, x / longest_opd) * dx)[:, None]
    # Both sides are equal, hence 4 instead of 2 over one side.
    return 4.0 * (spectrum @ forward) @ back / np.interp(wavenumber, table_wavenumber, response)


def line_width(name: str, longest_opd: float) -> float:
    """Full width at half maximum [m-1] of the line shape f(σ) = ∫₀ᴸ w(x)·cos(2πσx) dx of a window `name` of half-length L [m]."""
    u = np.linspace(0.0, 1.0, 2001)
    s = np.linspace(0.0, 4.0, 4001)  # σ·L
    shape = np.cos(2.0 * np.pi * np.outer(s, u)) @ (apodization(name, u) * quadrature(u))
    below = int(np.argmax(shape < 0.5 * shape[0]))
    half = np.interp(0.5 * shape[0], shape[[below, below - 1]], s[[below, below - 1]])
    return float(2.0 * half / longest_opd)


def rqe(spectrum: Array, reference: Array) -> Array:
    """Relative quadratic error ‖B − B_ref‖₂/‖B_ref‖₂ along the last axis; NaN where either holds one."""
    return np.linalg.norm(spectrum - reference, axis=-1) / np.linalg.norm(reference, axis=-1)
