"""Spectra: what surfaces reflect, what lights them, what the instrument passes.

Wavenumbers σ in m⁻¹, wavelengths in nm.

Functions
---------
illumination    sunlight at the ground
reflectance     of a named material
response        of optics and detector
phase           of the interferometer
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SECOND_RADIATION = 1.438777e-2  # hc/k [m K]
_SUN = 5778.0  # K
# Absorption of the clear sky at sea level: centre [nm], width [nm], depth; Fraunhofer lines, ozone, oxygen, water.
_ABSORPTION = (
    (486.1, 1.5, 0.10),
    (517.5, 2.5, 0.08),
    (589.3, 2.0, 0.06),
    (600.0, 45.0, 0.07),
    (656.3, 1.5, 0.12),
    (687.5, 3.0, 0.20),
    (719.0, 6.0, 0.16),
    (761.0, 3.0, 0.38),
    (818.0, 8.0, 0.12),
    (937.0, 16.0, 0.35),
)


def _dip(wavelength: Array, centre: float, width: float, depth: float) -> Array:
    """1 − depth·exp(−½((λ − centre)/width)²)."""
    return 1.0 - depth * np.exp(-0.5 * ((wavelength - centre) / width) ** 2)


def _edge(wavelength: Array, centre: float, width: float) -> Array:
    """Smooth step from 0 to 1."""
    return 0.5 * (1.0 + np.tanh((wavelength - centre) / width))


def _peak(wavelength: Array, centre: float, width: float, height: float) -> Array:
    return height * np.exp(-0.5 * ((wavelength - centre) / width) ** 2)


def illumination(wavenumber: Array) -> Array:
    """Sunlight on the ground per unit wavenumber: Planck's σ³/(e^{c₂σ/T} − 1) at 5778 K, peak 1, through the sky."""
    planck = wavenumber**3 / np.expm1(_SECOND_RADIATION * wavenumber / _SUN)
    peak = 2.8214393721 * _SUN / _SECOND_RADIATION  # Wien's law per unit wavenumber
    light = planck / (peak**3 / np.expm1(_SECOND_RADIATION * peak / _SUN))
    wavelength = 1e9 / wavenumber
    for centre, width, depth in _ABSORPTION:
        light = light * _dip(wavelength, centre, width, depth)
    return light * np.exp(-0.12 * (550.0 / wavelength) ** 4)  # Rayleigh scattering, one vertical pass


_REFLECTANCE: dict[str, Callable[[Array], Array]] = {
    "white": lambda w: 0.92 - 0.10 * _edge(-w, -430.0, 30.0),
    "grey": lambda w: 0.42 + 0.02 * (w - 650.0) / 250.0,
    "black": lambda w: 0.07 + 0.005 * (w - 650.0) / 250.0,
    "red": lambda w: 0.06 + 0.80 * _edge(w, 605.0, 18.0),
    "green": lambda w: 0.06 + _peak(w, 535.0, 28.0, 0.55) + 0.40 * _edge(w, 800.0, 30.0),
    "blue": lambda w: 0.06 + _peak(w, 468.0, 30.0, 0.65) + 0.25 * _edge(w, 860.0, 25.0),
    "holmium": lambda w: (
        0.85
        * _dip(w, 454.0, 5.0, 0.45)
        * _dip(w, 486.0, 4.0, 0.30)
        * _dip(w, 537.0, 5.0, 0.25)
        * _dip(w, 640.0, 6.0, 0.22)
        * _dip(w, 890.0, 8.0, 0.10)
    ),
    "grass": lambda w: 0.035 + _peak(w, 552.0, 30.0, 0.07) + 0.42 * _edge(w, 718.0, 18.0),
    "soil": lambda w: 0.05 + 0.26 * (w / 900.0) ** 1.6 * _dip(w, 870.0, 60.0, 0.08),
    "asphalt": lambda w: 0.07 + 0.05 * (w - 400.0) / 600.0,
    "water": lambda w: 0.015 + _peak(w, 500.0, 70.0, 0.03),
}

NAMES = tuple(_REFLECTANCE)


def reflectance(name: str, wavenumber: Array) -> Array:
    """Reflectance [1] of a material of `NAMES` at wavenumbers (n,) [m⁻¹]."""
    if name not in _REFLECTANCE:
        raise ValueError(f"no material {name}; there are {', '.join(NAMES)}")
    return np.asarray(_REFLECTANCE[name](1e9 / np.asarray(wavenumber, float)))


def response(
    wavenumber: Array, peak: float, wavelength: float, width: float, band: tuple[float, float], edge: float
) -> Array:
    """Fringe amplitude response: a Gaussian in wavelength [nm] between logistic edges of scale `edge` [m⁻¹]."""
    low, high = 1e9 / band[1], 1e9 / band[0]
    inside = 1.0 / ((1.0 + np.exp((low - wavenumber) / edge)) * (1.0 + np.exp((wavenumber - high) / edge)))
    return peak * np.exp(-0.5 * ((1e9 / wavenumber - wavelength) / width) ** 2) * inside


def phase(wavenumber: Array, coefficients: Array) -> Array:
    """φ(σ) = Σ_k c_k·u^k [rad], u from −1 to 1 over the grid."""
    u = 2.0 * (wavenumber - wavenumber[0]) / (wavenumber[-1] - wavenumber[0]) - 1.0
    return np.polynomial.polynomial.polyval(u, coefficients)
