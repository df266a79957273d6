"""Bench: closed forms of lines, two ways to measure the same, measured files against their vendor's spectra."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.formats.opus import read_opus
from pipeline.records import Bench
from stages.bench import BenchResult, BenchSettings, run
from stages.bench.bench import transform
from tsmftis import fourier

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "data" / "opus"
real_data = pytest.mark.skipif(not SHARED.is_dir(), reason=f"measured OPUS files are not in {SHARED}")

STEP, CENTRE, WIDTH = 0.5e-6, 4e5, 3e4  # m, m-1, m-1
DENSITY = BenchSettings(normalisation_per_m=1.0, apodization="boxcar", phase_correction="mertz")


def axis(short: float = 400e-6, long: float = 400e-6) -> np.ndarray:
    return np.arange(-round(short / STEP), round(long / STEP) + 1) * STEP


def gaussian(x: np.ndarray, phase: float = 0.0) -> np.ndarray:
    """I(x) of B(σ) = exp(−(σ−σ0)²/2s²)/(s√2π): exp(−2π²s²x²)·cos(2πσ0x + φ), on a pedestal that must not matter."""
    return 7.0 + np.exp(-2.0 * (np.pi * WIDTH * x) ** 2) * np.cos(2.0 * np.pi * CENTRE * x + phase)


def gaussian_line(wavenumber: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((wavenumber - CENTRE) / WIDTH) ** 2) / (WIDTH * np.sqrt(2.0 * np.pi))


def bench(interferogram: np.ndarray, opd: np.ndarray, **more: object) -> Bench:
    return Bench(np.atleast_2d(interferogram), opd, None, None, **more)  # type: ignore[arg-type]


def error(result: BenchResult, truth: np.ndarray) -> float:
    return float(np.linalg.norm(result.spectrum - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("correction", ["mertz", "power"])
@pytest.mark.parametrize("phase", [0.0, 0.7])
def test_gaussian_line_is_found_as_it_is(correction: str, phase: float) -> None:
    x = axis()
    settings = DENSITY.model_copy(update={"phase_correction": correction})
    result = run(bench(gaussian(x, phase), x), settings)
    # what is left: the mean of the burst itself, taken off with the pedestal
    assert error(result, gaussian_line(result.wavenumber)) < 2e-3
    assert result.wavenumber[0] == 0.0 and result.wavenumber[-1] == pytest.approx(0.5 / STEP)


@pytest.mark.parametrize("a", [0.04, -0.05])
@pytest.mark.parametrize("phase", [0.0, 2.9])
def test_detector_nonlinearity_is_taken_out(a: float, phase: float) -> None:
    """s' = s·(1 − a·s), s relative to its own largest deviation, whichever sign that has; any gain and offset in counts."""
    x = axis()
    s = gaussian(x, phase) - 7.0
    s = (s - s.mean()) / np.abs(s - s.mean()).max()
    settings = DENSITY.model_copy(update={"apodization": "connes"})
    true = run(bench(300.0 * s, x), settings).spectrum
    recorded = bench(300.0 * s * (1.0 - a * s) + 1234.0, x)
    update = {"detector_nonlinearity": {"a": a}}
    assert fourier.rqe(run(recorded, settings, update).spectrum, true) < 1e-6
    assert fourier.rqe(run(recorded, settings).spectrum, true) > 1e-3


def test_opd_effects_stretch_the_axis() -> None:
    """A scan on a stretched and bent OPD that its file does not know: the line is back where it is."""
    x = axis()
    middle = np.arange(x.size) - x.size // 2
    true = 1.01 * x + 2e-10 * middle**2
    update = {"opd_scale": {"scale": 0.01}, "opd_quadratic": {"quadratic": 2e-10}}
    wavenumber = np.linspace(2.5e5, 5.5e5, 301)
    told = Bench(gaussian(true)[None], x, wavenumber, gaussian_line(wavenumber))
    assert run(told, DENSITY, update).relative_rms < 1e-2  # type: ignore[operator]
    assert run(told, DENSITY).relative_rms > 0.05  # type: ignore[operator]
    with pytest.raises(InputError, match="opd_quadratic"):
        run(told, DENSITY, {"opd_quadratic": {"quadratic": 1e-8}})
    with pytest.raises(ValueError, match="camera_latency"):
        run(told, DENSITY, {"camera_latency": {"latency": 0.1}})


def test_lorentzian_line() -> None:
    """B(σ) = (γ/π)/((σ−σ0)² + γ²): exp(−2πγ|x|)·cos(2πσ0x), cut where it has fallen to 5e-4."""
    x, gamma = axis(), 3e3
    result = run(bench(np.exp(-2 * np.pi * gamma * np.abs(x)) * np.cos(2 * np.pi * CENTRE * x), x), DENSITY)
    truth = gamma / np.pi / ((result.wavenumber - CENTRE) ** 2 + gamma**2)
    near = np.abs(result.wavenumber - CENTRE) < 10 * gamma
    assert np.abs(result.spectrum - truth)[near].max() < 2e-3 * truth.max()


@pytest.mark.parametrize(("phase", "tolerance"), [(0.1, 1e-3), (0.4, 2e-2)])
def test_one_sided_agrees_with_two_sided(phase: float, tolerance: float) -> None:
    """With φ = 0.4 the largest deviation is a fringe off the burst's centre: the slope of the phase's window there
    turns φ a little, which a one-sided scan feels to first order."""
    both, one = axis(), axis(short=60e-6)
    settings = DENSITY.model_copy(update={"apodization": "connes", "resolution_per_m": 0.9 / 390e-6})
    a, b = (run(bench(gaussian(x, phase), x), settings) for x in (both, one))
    assert a.parameters.ramp is None and b.parameters.ramp == pytest.approx(60e-6, rel=0.02)
    assert any("one-sided" in note for note in b.notes)
    assert np.linalg.norm(a.spectrum - b.spectrum) < tolerance * np.linalg.norm(a.spectrum)
    other = -one[::-1]  # the long side is the negative one
    mirrored = run(bench(gaussian(other, -phase), other), settings)
    assert np.linalg.norm(a.spectrum - mirrored.spectrum) < tolerance * np.linalg.norm(a.spectrum)


def test_power_of_a_one_sided_scan_is_cut_to_its_short_side() -> None:
    x = axis(short=60e-6)
    result = run(bench(gaussian(x), x), DENSITY.model_copy(update={"phase_correction": "power"}))
    assert result.parameters.half_length == pytest.approx(60e-6) and result.parameters.ramp is None
    assert error(result, gaussian_line(result.wavenumber)) < 5e-3


def test_each_scan_has_its_own_zpd() -> None:
    x = axis()
    scans = np.stack([gaussian(x), gaussian(x - 12 * STEP), 14.0 - gaussian(x + 9.3 * STEP)])  # the last one inverted
    result = run(bench(scans, x), DENSITY.model_copy(update={"resolution_per_m": 0.9 / 380e-6}))
    assert error(result, gaussian_line(result.wavenumber)) < 2e-3
    np.testing.assert_allclose(result.scans, np.tile(result.scans[0], (3, 1)), atol=2e-3 * result.spectrum.max())


def test_uneven_opd() -> None:
    """A drive whose speed swings by 6 %: the transform takes each sample where it is."""
    x = axis()
    x = x + 3e-6 * np.sin(2.0 * np.pi * x / 300e-6)
    result = run(bench(gaussian(x), x), DENSITY)
    assert error(result, gaussian_line(result.wavenumber)) < 2e-3
    assert result.wavenumber[-1] < 0.5 / STEP


def test_transform_in_pieces_is_the_transform() -> None:
    rng = np.random.default_rng(2)
    x = np.sort(rng.uniform(-1e-4, 1e-4, 300))
    windowed = rng.normal(size=(2, 300))
    windowed[:, [0, -1]] = 0.0
    for wavenumber in (np.linspace(1e5, 9e5, 517), np.sort(rng.uniform(1e5, 9e5, 150)), np.array([3e5])):
        direct = fourier.transform(windowed, x, np.ones(300), wavenumber)
        np.testing.assert_allclose(transform(windowed, x, wavenumber), direct, atol=1e-10 * np.abs(direct).max())


def test_bare_file_gets_defaults_and_says_so(tmp_path: Path) -> None:
    x = axis()
    write_dataset(bench(gaussian(x), x).to_dataset(), tmp_path / "bare.nc")
    result = run(Bench.from_file(tmp_path / "bare.nc"), BenchSettings())
    text = "; ".join(result.notes)
    assert all(word in text for word in ("apodization", "phase correction", "no resolution", "phase resolution"))
    assert result.reference is None and result.relative_rms is None and result.scale is None
    assert result.parameters.half_length == pytest.approx(400e-6)
    dataset = result.to_dataset()
    assert dataset.attrs["apodization"] == "blackman-harris-3" and "relative_rms" not in dataset.attrs
    write_dataset(dataset, tmp_path / "spectrum.nc")


def test_zero_filling_halves_the_step_and_keeps_the_spectrum() -> None:
    x = axis()
    coarse, fine = (run(bench(gaussian(x), x, zero_filling=z), DENSITY) for z in (1, 2))
    np.testing.assert_allclose(fine.wavenumber[: 2 * coarse.wavenumber.size : 2], coarse.wavenumber)
    np.testing.assert_allclose(fine.spectrum[: 2 * coarse.spectrum.size : 2], coarse.spectrum, atol=1e-12)


def test_scale_against_a_reference() -> None:
    x = axis()
    wavenumber = np.linspace(3e5, 5e5, 301)
    record = Bench(np.atleast_2d(gaussian(x)), x, wavenumber, 1.25 * gaussian_line(wavenumber))
    result = run(record, DENSITY)
    assert result.relative_rms == pytest.approx(0.2, abs=1e-3)
    assert result.scale == pytest.approx(1.25, rel=1e-3)
    assert result.relative_rms_scaled is not None and result.relative_rms_scaled < 1e-3
    assert result.to_dataset().attrs["relative_rms_scaled"] == result.relative_rms_scaled


def test_settings_override_the_file() -> None:
    x = axis()
    record = bench(gaussian(x), x, apodization="connes", resolution=1e4, zero_filling=4, phase_correction="power")
    kept = run(record, BenchSettings()).parameters
    assert (kept.apodization, kept.phase_correction, kept.zero_filling) == ("connes", "power", 4)
    assert kept.half_length == pytest.approx(90e-6)
    other = run(record, DENSITY.model_copy(update={"resolution_per_m": 5e3})).parameters
    assert (other.apodization, other.phase_correction) == ("boxcar", "mertz")
    assert other.half_length == pytest.approx(180e-6)


def test_resolution_of_the_file_beyond_its_opd_is_cut_with_a_note() -> None:
    x = axis()
    result = run(bench(gaussian(x), x, resolution=100.0), DENSITY)
    assert result.parameters.half_length == pytest.approx(400e-6)
    assert any("cut to" in note for note in result.notes)


@pytest.mark.parametrize(
    ("record", "settings", "match"),
    [
        (bench(gaussian(axis()), axis()), BenchSettings(resolution_per_m=100.0), "resolution_per_m"),
        (bench(gaussian(axis()), axis(), apodization="opus:XX"), BenchSettings(), "opus:XX"),
        (bench(gaussian(axis()), axis(), phase_correction="forman"), BenchSettings(), "forman"),
        (bench(gaussian(axis()), axis(), zero_filling=0), BenchSettings(), "zero_filling"),
        (bench(gaussian(axis()), axis(), resolution=-1.0), BenchSettings(), "must be positive"),
        (bench(gaussian(axis(short=0.0)), axis(short=0.0)), BenchSettings(), "largest deviation"),
        (bench(np.ones(50), np.arange(50.0)), BenchSettings(), "largest deviation"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(record: Bench, settings: BenchSettings, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        run(record, settings)
    assert "\n" not in str(caught.value)


def test_settings_refuse_what_they_do_not_know() -> None:
    for wrong in ({"apodization": "hann"}, {"phase_correction": "forman"}, {"zero_filling": 0}, {"window": "boxcar"}):
        with pytest.raises(ValidationError):
            BenchSettings(**wrong)


@real_data
@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("brukeropus_file.0", "sample"),
        ("brukeropus_file.0", "reference"),
        ("opusreader2_617262_1TP_C-1_A5.0", "sample"),
        ("opusreader2_617262_1TP_C-1_A5.0", "reference"),
    ],
)
def test_vendor_spectrum_is_met(name: str, channel: str) -> None:
    """Measured 1.8e-5, 3.8e-6, 1.4e-5, 1.1e-5 without any fitted scale; the scale itself is 1 within 2e-6."""
    pytest.importorskip("brukeropus")
    result = run(read_opus(SHARED / name, channel), BenchSettings())  # type: ignore[arg-type]
    assert result.relative_rms is not None and result.relative_rms < 3e-5
    assert result.scale == pytest.approx(1.0, abs=1e-5)


@real_data
@pytest.mark.parametrize(("channel", "left", "scale"), [("sample", 4.42e-3, 1.0392), ("reference", 1.345e-2, 1.1345)])
def test_vendor_corrected_nonlinearity_is_missed_as_it_must_be(channel: str, left: float, scale: float) -> None:
    """NLI = 1: the vendor linearised the MCT's signal, which no transform does; the brighter channel shows more."""
    pytest.importorskip("brukeropus")
    result = run(read_opus(SHARED / "opusreader2_629266_1TP_A-1_C1.0", channel), BenchSettings())  # type: ignore[arg-type]
    assert result.relative_rms_scaled == pytest.approx(left, rel=0.02)
    assert result.scale == pytest.approx(scale, abs=1e-3)
