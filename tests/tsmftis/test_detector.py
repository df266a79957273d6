"""Counts to signal and back, and the noise model, against forward models and statistics."""

from __future__ import annotations

import numpy as np
import pytest

from tsmftis import detector

ROWS, COLS = 8, 16


@pytest.mark.parametrize("a", [0.0, 0.03, -0.03, 1e-9])
def test_correct_inverts_what_the_detector_did(a: float) -> None:
    """s' = s·(1 − a·s/12000) on s = flat·signal, dark added: back to half a count's rounding and float32 (1e-3 DN)."""
    rng = np.random.default_rng(1)
    signal = rng.uniform(0.0, 11_000.0, (5, ROWS, COLS))
    flat, dark = rng.uniform(0.9, 1.1, (ROWS, COLS)), rng.uniform(100.0, 130.0, (ROWS, COLS))
    s = signal * flat
    counts = np.round(s * (1 - a * s / 12000.0) + dark).astype(np.uint16)
    back = detector.correct(counts, dark, flat, 16383.0, a).swapaxes(0, 1)
    slope = np.abs(1 - 2 * a * s / 12000.0) * flat
    assert back.dtype == np.float32
    assert (np.abs(back - signal) < 0.5 / slope + 5e-3).all()


def test_saturated_pixels_become_nan_and_no_others() -> None:
    counts = np.full((2, ROWS, COLS), 500, np.uint16)
    counts[0, 1, 2], counts[1, 3, 4], counts[1, 5, 6] = 16383, 16384, 16382
    out = detector.correct(counts, np.zeros((ROWS, COLS)), np.ones((ROWS, COLS)), 16383.0, 0.02)
    assert sorted(map(tuple, np.argwhere(np.isnan(out)).tolist())) == [(1, 0, 2), (3, 1, 4)]  # row, frame, col


def test_bad_pixels_are_found_and_left_out() -> None:
    """Hot, dead, not a number, four times too sensitive; among smooth patterns and 3 % of fixed-pattern noise; no others."""
    rng = np.random.default_rng(4)
    row, col = np.mgrid[:40, :60]
    dark = 200.0 + 0.5 * row + 5.0 * rng.standard_normal((40, 60))
    flat = (1.0 - 1e-4 * ((row - 20) ** 2 + (col - 30) ** 2)) * (1 + 0.03 * rng.standard_normal((40, 60)))
    assert not detector.bad_pixels(dark, flat).any()
    dark[3, 4], flat[10, 11], dark[20, 59], flat[39, 0], flat[30, 30] = 900.0, 0.0, np.nan, np.nan, 4.0
    bad = detector.bad_pixels(dark, flat)
    assert sorted(map(tuple, np.argwhere(bad).tolist())) == [(3, 4), (10, 11), (20, 59), (30, 30), (39, 0)]
    out = detector.correct(np.full((2, 40, 60), 1000, np.uint16), np.where(bad, np.nan, dark), flat, 16383.0)
    np.testing.assert_array_equal(np.isnan(out).all(axis=1), bad)


def test_stuck_pixels_do_not_follow_the_scene() -> None:
    """Fringes of different contrast in each column; one pixel that stands still, one that only has read noise."""
    rng = np.random.default_rng(5)
    scene = rng.uniform(500.0, 5000.0, (64, 30, 40)) * (0.2 + 0.8 * np.abs(np.sin(np.arange(40.0))))
    scene[:, 7, 8], scene[:, 21, 3] = 3000.0, 3000.0 + 3.0 * rng.standard_normal(64)
    stuck = detector.stuck_pixels(scene.astype(np.uint16))
    assert sorted(map(tuple, np.argwhere(stuck).tolist())) == [(7, 8), (21, 3)]
    assert not detector.stuck_pixels(np.full((64, 30, 40), 900, np.uint16)).any()  # a scene without anything in it


def test_photon_transfer_finds_read_noise_and_gain() -> None:
    """χ² variances with 40 degrees of freedom at 400 levels: 3 sigma of the weighted fit's own covariance."""
    rng = np.random.default_rng(2)
    read, gain, freedom = 30.0, 0.25, 40
    signal = rng.uniform(100.0, 9000.0, 400)
    true = read + gain * signal
    variance = true * rng.chisquare(freedom, signal.size) / freedom
    found = np.array(detector.photon_transfer(signal, variance))
    design = np.stack([np.ones_like(signal), signal], 1) / true[:, None]
    sigma = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * 2 / freedom)
    assert (np.abs(found - [read, gain]) < 3 * sigma).all()
    assert detector.photon_transfer(signal, np.full(400, 7.0)) == pytest.approx((7.0, 0.0), abs=1e-6)


def test_photon_transfer_never_goes_negative() -> None:
    falling = detector.photon_transfer(np.linspace(0, 100, 50), np.linspace(10.0, 1.0, 50))
    assert min(falling) >= 0.0


@pytest.mark.parametrize("step", [2.05e-7, 1.5e-7])
def test_noise_out_of_band_is_the_noise(step: float) -> None:
    """White noise of variance 9·gain under a bright in-band interferogram: the mean of 400 estimates to 3 standard errors.

    Both bands: above the light (a step of 1.5e-7 m leaves room to Nyquist) and below it.
    """
    rng = np.random.default_rng(3)
    opd = step * (np.arange(192) - 28.0)
    sigma = np.linspace(1.25e6, 2.05e6, 400)
    light = np.cos(2 * np.pi * np.outer(opd, sigma)) @ np.exp(-(((sigma - 1.65e6) / 1e5) ** 2))
    gain = rng.uniform(0.3, 0.7, (400, 192))
    noisy = light + 3.0 * np.sqrt(gain) * rng.standard_normal((400, 192))
    found = detector.noise_out_of_band(noisy, gain, opd, 1 / 900e-9, 1 / 450e-9)
    print("noise", found.mean(), found.std() / 20)
    assert found.mean() == pytest.approx(9.0, abs=3 * found.std() / np.sqrt(400) + 0.05)
