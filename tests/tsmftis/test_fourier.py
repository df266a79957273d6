"""Windows, ramp, transform, phase, radiance and its sigma, line shape: against closed forms, quadrature and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import fft
from scipy.integrate import quad
from scipy.special import jv

from tsmftis import fourier
from tsmftis.interferometer import Interferometer

COLS, STEP, ZPD = 192, 2.05e-7, 28.0
TABLE = np.linspace(1.0e6, 2.35e6, 1401)
RESPONSE = 2e-4 * np.exp(-(((TABLE - 1.6e6) / 6e5) ** 2))


def instrument(quadratic: float = 0.0, zpd: float = ZPD) -> Interferometer:
    return Interferometer(96, COLS, STEP, zpd, 450e-9, 900e-9, quadratic)


def smooth_radiance(wavenumber: np.ndarray) -> np.ndarray:
    return 1.0 + 0.4 * np.cos((wavenumber - 1.6e6) / 1.5e5) + 0.2 * (wavenumber - 1.6e6) / 6e5


def smooth_phi(wavenumber: np.ndarray) -> np.ndarray:
    u = (wavenumber - 1.6e6) / 6e5
    return 0.15 + 0.4 * u - 0.05 * u**2


def recorded(opd: np.ndarray, spectrum: np.ndarray) -> np.ndarray:
    """I(x) = ∫ R·B·cos(2πσx + φ) dσ over TABLE by the trapezoid rule, which is exact to 1e-6 at 964 m-1."""
    angle = 2 * np.pi * np.multiply.outer(opd, TABLE) + smooth_phi(TABLE)
    return np.trapezoid(RESPONSE * spectrum * np.cos(angle), TABLE, axis=-1)


def scored_window(ifm: Interferometer, opd: np.ndarray) -> np.ndarray:
    return fourier.mertz_ramp(opd, ifm.shortest_side) * fourier.apodization("connes", opd / ifm.longest_opd)


# --- windows and line shapes -----------------------------------------------------------------------------------------


def test_windows_are_the_published_formulas() -> None:
    """Values at u = ½ worked out by hand from the formulas; 1 at ZPD; rounding (1e-6: digits of Norton and Beer)."""
    half = {
        "boxcar": 1.0,
        "triangle": 0.5,
        "connes": 0.5625,
        "happ-genzel": 0.54,
        "gaussian": 0.01**0.25,
        "norton-beer-weak": 0.384093 - 0.087577 * 0.75 + 0.703484 * 0.5625,
        "norton-beer-medium": 0.152442 - 0.136176 * 0.75 + 0.983734 * 0.5625,
        "norton-beer-strong": 0.045335 + 0.554883 * 0.5625 + 0.399782 * 0.75**4,
        "blackman-harris-3": 0.42323 - 0.07922,
        "blackman-harris-4": 0.35875 - 0.14128,
    }
    assert set(half) == set(fourier.APODIZATIONS)
    for name, value in half.items():
        at = fourier.apodization(name, np.array([0.0, 0.5, -0.5, 1.001, -2.0]))
        np.testing.assert_allclose(at, [1.0, value, value, 0.0, 0.0], atol=1e-6)
    with pytest.raises(ValueError, match="connes"):
        fourier.apodization("conness", np.zeros(1))


def shape(name: str, z: np.ndarray) -> np.ndarray:
    """Line shape over 2L at z = 2π(σ − σ₀)L, in closed form."""
    z = np.where(z == 0, 1e-9, z)
    sinc = np.sin(z) / z
    if name == "boxcar":
        return sinc
    if name == "triangle":
        return 0.5 * (np.sin(z / 2) / (z / 2)) ** 2
    if name == "connes":
        return 8 * np.sqrt(np.pi / 2) * jv(2.5, np.abs(z)) / np.abs(z) ** 2.5
    terms = {
        "happ-genzel": (0.54, 0.46),
        "blackman-harris-3": fourier.BLACKMAN_HARRIS["blackman-harris-3"],
        "blackman-harris-4": fourier.BLACKMAN_HARRIS["blackman-harris-4"],
    }[name]
    return sum(0.5 * a * (np.sinc(z / np.pi - i) + np.sinc(z / np.pi + i)) for i, a in enumerate(terms))


@pytest.mark.parametrize(
    "name", ["boxcar", "triangle", "connes", "happ-genzel", "blackman-harris-3", "blackman-harris-4"]
)
def test_a_monochromatic_line_takes_the_windows_line_shape(name: str) -> None:
    """Finely sampled two-sided line: S = ½·2L·shape(2πΔσL) + the mirrored line; trapezoid of 4 001 samples: 1e-4 of the peak."""
    length, line = 3.4e-5, 1.6e6
    opd = np.linspace(-length, length, 4001)
    sigma = line + np.linspace(-1.5e5, 1.5e5, 301)
    got = fourier.transform(np.cos(2 * np.pi * line * opd), opd, fourier.apodization(name, opd / length), sigma)
    z = 2 * np.pi * length
    want = length * (shape(name, z * (sigma - line)) + shape(name, z * (sigma + line)))
    np.testing.assert_allclose(got.real, want, atol=1e-4 * length)
    np.testing.assert_allclose(got.imag, 0.0, atol=1e-12 * length)


@pytest.mark.parametrize("zpd", [28.0, 163.25])
def test_mertz_ramp_counts_every_difference_once(zpd: float) -> None:
    """w(x) + w(−x) = 1 on the doubly seen part, 1 on the long side, whichever side that is: rounding."""
    ifm = instrument(zpd=zpd)
    opd, side = ifm.opd(47.5, np.arange(COLS)), ifm.shortest_side
    x = np.linspace(-side, side, 301)
    both = np.concatenate([opd, x]), np.concatenate([opd, -x])
    np.testing.assert_allclose(fourier.mertz_ramp(both[0], side)[COLS:] + fourier.mertz_ramp(both[1], side)[COLS:], 1.0)
    weight, longer = fourier.mertz_ramp(opd, side), 1.0 if zpd < COLS / 2 else -1.0
    assert (weight[longer * opd > side * 1.0001] == 1.0).all() and (weight >= 0.0).all()
    assert np.abs(weight[np.argmin(longer * opd)]) < 1e-12


# --- the transform ---------------------------------------------------------------------------------------------------


def test_transform_is_a_zero_filled_fft_on_a_uniform_grid() -> None:
    """scipy's FFT of the zero-filled samples, turned to ZPD, at its own wavenumbers: rounding."""
    rng = np.random.default_rng(1)
    opd = STEP * (np.arange(COLS) - ZPD)
    values, window = rng.standard_normal((3, COLS)), rng.uniform(size=COLS)
    size = 1024
    weights = np.full(COLS, STEP)
    weights[[0, -1]] /= 2
    k = np.arange(1, 500)
    sigma = k / (size * STEP)
    want = fft(values * window * weights, size, axis=-1)[:, k] * np.exp(2j * np.pi * sigma * ZPD * STEP)
    got = fourier.transform(values, opd, window, sigma)
    np.testing.assert_allclose(got, want, atol=1e-12 * np.abs(want).max())
    every = fourier.transform(values, np.tile(opd, (3, 1)), np.tile(window, (3, 1)), sigma)
    np.testing.assert_allclose(every, want, atol=1e-12 * np.abs(want).max())


def test_parseval() -> None:
    """∫|S|² dσ over one period of the sampling = Σ |w·I·dx|²/dx: exact for any signal on a uniform grid."""
    rng = np.random.default_rng(2)
    opd, signal, size = STEP * (np.arange(COLS) - ZPD), rng.standard_normal(COLS), 400
    sigma = np.arange(size) / (size * STEP)
    spectrum = fourier.transform(signal, opd, np.ones(COLS), sigma)
    weighted = signal * fourier.quadrature(opd)
    assert (np.abs(spectrum) ** 2).sum() / (size * STEP) == pytest.approx((weighted**2).sum() / STEP, rel=1e-12)


def test_constant_and_drift_go_and_nothing_else_does() -> None:
    rng = np.random.default_rng(3)
    opd = np.sort(rng.uniform(-1e-5, 3e-5, COLS))
    signal = rng.standard_normal((4, COLS))
    drifted = signal + 5000.0 + 1e8 * opd
    clean = fourier.remove_constant(drifted, opd, 1)
    np.testing.assert_allclose(clean, fourier.remove_constant(signal, opd, 1), atol=1e-9)
    np.testing.assert_allclose(clean, fourier.remove_constant(drifted, np.tile(opd, (4, 1)), 1), atol=1e-9)
    residual = [s - np.polynomial.Polynomial.fit(opd, s, 1)(opd) for s in signal]
    np.testing.assert_allclose(clean, residual, atol=1e-9)


# --- radiance --------------------------------------------------------------------------------------------------------


def test_phase_of_the_short_side_is_found() -> None:
    """φ of a smooth spectrum from ±28 columns at low resolution: 30 mrad (measured 22; the window
    stands on the nominal ZPD, half a column beside the fringes' centre; centred on it 2)."""
    ifm = instrument()
    opd, sigma = ifm.opd(47.5, np.arange(COLS)), ifm.scored_wavenumbers()
    low = fourier.transform(
        recorded(opd, smooth_radiance(TABLE)), opd, fourier.apodization("connes", opd / ifm.shortest_side), sigma
    )
    found = fourier.smooth_phase(fourier.phase_polynomial(low, sigma, 2), sigma)
    strong = np.interp(sigma, TABLE, RESPONSE) > 0.1 * RESPONSE.max()
    wrong = np.angle(np.exp(1j * (found - smooth_phi(sigma))))[strong]
    print("phase error", np.abs(wrong).max())
    assert np.abs(wrong).max() < 3e-2


@pytest.mark.parametrize(("quadratic", "zpd"), [(0.0, 28.0), (2e-11, 28.0), (0.0, 163.4)])
def test_radiance_recovers_the_spectrum(quadratic: float, zpd: float) -> None:
    """One-sided, with phase, uniform and stretched OPD, long side left or right: B at the instrument's line shape.

    The phase's slope moves the centre of the fringes to x₀ = −φ'/2π, half a column here, and the ramp must rise about it:
    w(x₀ + x) + w(x₀ − x) = 1. Then 0.5 % RQE is left for φ's curvature and the ramp's corners (measured 0.2 %); a ramp
    about the nominal ZPD errs by x₀ over the short side, 1.8 %.
    """
    ifm = instrument(quadratic, zpd)
    opd, sigma = ifm.opd(47.5, np.arange(COLS)), ifm.scored_wavenumbers()
    spectrum = smooth_radiance(TABLE) * (1 + 0.3 * np.sin(TABLE / 1.5e4))
    response = np.interp(sigma, TABLE, RESPONSE)
    want = fourier.line_shape_response(spectrum, RESPONSE, TABLE, ifm.longest_opd, "connes", sigma)
    centre = -(smooth_phi(np.array(1.65e6)) - smooth_phi(np.array(1.55e6))) / 1e5 / (2 * np.pi)

    def recovered(at: np.ndarray, middle: float) -> np.ndarray:
        side = min(-(at - middle).min(), (at - middle).max())
        window = fourier.mertz_ramp(at - middle, side) * fourier.apodization("connes", at / ifm.longest_opd)
        value, none = fourier.radiance(recorded(opd, spectrum), at, window, sigma, smooth_phi(sigma), response)
        assert (none == 0).all()
        return value

    good = fourier.rqe(recovered(opd, float(centre)), want)
    print("radiance", good, fourier.rqe(recovered(opd, 0.0), want))
    assert good < 5e-3
    if quadratic:  # and the stretch matters
        assert fourier.rqe(recovered(instrument(0.0, zpd).opd(47.5, np.arange(COLS)), float(centre)), want) > 3 * good


@pytest.mark.parametrize("per_sample_opd", [False, True])
def test_sigma_of_radiance_is_the_scatter_of_radiance(per_sample_opd: bool) -> None:
    """3 000 draws of noise with a variance of its own in each column: the standard deviation is known to 1.3 %; 5 of that."""
    ifm, rng, draws = instrument(), np.random.default_rng(5), 3000
    opd, sigma = ifm.opd(47.5, np.arange(COLS)), ifm.scored_wavenumbers(50_000.0)
    variance = 20.0 + 10.0 * np.sin(np.arange(COLS) / 9.0)
    noise = rng.standard_normal((draws, COLS)) * np.sqrt(variance)
    response = np.interp(sigma, TABLE, RESPONSE)
    window = scored_window(ifm, opd)
    value, _ = fourier.radiance(noise, opd, window, sigma, smooth_phi(sigma), response)
    at, shaped = (np.tile(a, (2, 1)) if per_sample_opd else a for a in (opd, window))
    _, sd = fourier.radiance(
        np.zeros((2, COLS)), at, shaped, sigma, smooth_phi(sigma), response, np.tile(variance, (2, 1))
    )
    assert np.abs(value.std(axis=0) / sd[1] - 1).max() < 5 / np.sqrt(2 * draws)


# --- line shape and score --------------------------------------------------------------------------------------------


def test_line_shape_response_against_adaptive_quadrature() -> None:
    """A Gaussian line: its interferogram in closed form, the transform by scipy.quad; 1e-4 of the peak (tables, steps)."""
    length, width, line = 3.4e-5, 2e4, 1.65e6
    spectrum = np.exp(-0.5 * ((TABLE - line) / width) ** 2)
    sigma = np.array([1.6e6, 1.64e6, 1.65e6, 1.67e6])
    got = fourier.line_shape_response(spectrum, np.ones_like(TABLE), TABLE, length, "connes", sigma)

    def damped(x: float) -> float:
        return float(width * np.sqrt(2 * np.pi) * np.exp(-2 * (np.pi * width * x) ** 2) * (1 - (x / length) ** 2) ** 2)

    want = [
        2 * quad(lambda x, s=s: damped(x) * np.cos(2 * np.pi * (s - line) * x), 0, length)[0] for s in sigma
    ]  # the sum frequency adds nothing
    np.testing.assert_allclose(got, want, atol=1e-4)


def test_line_shape_response_is_check_runs() -> None:
    """The checker's own formula (0.1 µm steps, rectangle rule), written out: 2e-4 of the peak between the two quadratures."""
    ifm = instrument(1.5e-11)
    sigma, length = ifm.scored_wavenumbers(), ifm.longest_opd
    spectrum = smooth_radiance(TABLE) * (1 + 0.3 * np.sin(TABLE / 2e4))
    d = np.arange(COLS) - ZPD
    assert length == pytest.approx(np.abs(STEP * d + 1.5e-11 * d * d).max(), rel=1e-12)
    x = np.arange(-int(length / 1e-7), int(length / 1e-7) + 1) * 1e-7
    fringe = (RESPONSE * spectrum * np.gradient(TABLE)) @ np.cos(2 * np.pi * np.outer(TABLE, x))
    window = (1 - (x / length) ** 2).clip(0) ** 2
    want = 2e-7 * (fringe * window) @ np.cos(2 * np.pi * np.outer(x, sigma)) / np.interp(sigma, TABLE, RESPONSE)
    got = fourier.line_shape_response(spectrum, RESPONSE, TABLE, length, "connes", sigma)
    np.testing.assert_allclose(got, want, atol=2e-4 * want.max())


def test_rqe_with_a_fitted_scale_is_the_sine_of_the_spectral_angle() -> None:
    rng = np.random.default_rng(6)
    b = rng.uniform(0.5, 1.5, (20, 60))
    reference = rng.uniform(0.5, 1.5, (20, 60))
    scale = (b * reference).sum(1) / (b * b).sum(1)
    cosine = (b * reference).sum(1) / np.linalg.norm(b, axis=1) / np.linalg.norm(reference, axis=1)
    np.testing.assert_allclose(fourier.rqe(scale[:, None] * b, reference), np.sin(np.arccos(cosine)), rtol=1e-12)
    assert np.isnan(fourier.rqe(b * np.nan, reference)).all() and (fourier.rqe(reference, reference) == 0).all()


def test_opd_and_grid_of_the_contract() -> None:
    """OPD(row, col) = step·d + quadratic·d² + tilt·(row − (rows−1)/2), d = col − zpd; 1/λ_high, +5000 … up to 1/λ_low."""
    ifm = Interferometer(96, COLS, STEP, ZPD, 450e-9, 900e-9, 1e-11, 3e-9)
    d = np.arange(COLS) - ZPD
    np.testing.assert_allclose(ifm.opd(90.0, np.arange(COLS)), STEP * d + 1e-11 * d**2 + 3e-9 * 42.5, rtol=1e-13)
    grid = ifm.scored_wavenumbers()
    assert grid[0] == 1 / 900e-9 and grid[-1] <= 1 / 450e-9 < grid[-1] + 5000.0
    np.testing.assert_allclose(np.diff(grid), 5000.0, rtol=1e-9)
