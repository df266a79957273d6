"""The spectrum of a laboratory interferogram, with the file's own parameters.

    B(σ) = c·2·Re(S(σ)·exp(−iφ(σ)))  (mertz),   B(σ) = c·2·|S(σ)|  (power),   S(σ) = ∫ w(x)·I(x)·exp(−2πiσx) dx

For each scan alone: the mean comes off, zero path difference (ZPD) is the sample of largest deviation, w is the
apodization of half-length L = 0.9/resolution about it, φ the phase of a transform with a narrower one, 0.9/(phase
resolution) [1]_. The spectra of the scans are averaged. I(x) = ∫ B(σ)·cos(2πσx + φ(σ)) dσ gives back B for c = 1, in
counts per m-1. Where the short side is shorter than L, a Mertz ramp counts the doubly measured part once.

c is by default the unit of Bruker's OPUS, B in its numbers: c = 1 579 800 m-1 / 8 (the nominal helium-neon line over
eight). Neither that nor the 0.9 was found documented; they hold within 2e-6 and 2e-5 on four measured spectra of two
instruments, all of them at 400 m-1 resolution and zero filling 2.

A model update comes before all that: OPD·(1 + opd_scale) + opd_quadratic·(sample − ZPD)², and s of s' = s·(1 − a·s/D) by
detector_nonlinearity, s the scan less its mean and D the largest deviation of s itself, not of s'. It is inverted exactly or,
as vendors do, by s = s'·(1 + a·s'/D'), D' that of s': the same to first order in a, so that the choice stands for the unknown
third order. Where there is a reference, the inverse that meets it better after one scale is taken.

References
----------
.. [1] L. Mertz, Auxiliary computation for Fourier spectrometry, Infrared Physics 7 (1967) 17–23.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pipeline.errors import InputError
from pipeline.records import Bench
from tsmftis import detector, fourier
from tsmftis.effects import amounts, refuse_others

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

PhaseCorrection = Literal["mertz", "power"]

OPUS_UNIT = 1_579_800.0 / 8.0  # m-1, see above
WINDOW_REACH = 0.9  # L·resolution
TWO_SIDED = 0.9  # without a resolution, sides that differ less than this are cut to the shorter
PHASE_SHARE = 1.0 / 8.0  # L of the phase over that of the spectrum where no phase resolution is known
# Whatever the spectrum's window: one with strong side lobes (boxcar) turns the phase by π where they are negative.
PHASE_WINDOW = "blackman-harris-3"
SHORTEST_SIDE = 8  # samples about ZPD, below which there is no phase to speak of
BLOCK = 64  # wavenumbers transformed at once
VENDORS_INVERSE = (
    "the non-linearity is taken out as s'·(1 + a·s'/D'): it meets the reference better than the exact inverse"
)
ELEMENTS = 2_000_000  # of a table in memory at once


class BenchSettings(BaseModel):
    """What overrides the file's own parameters; None leaves them."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    apodization: str | None = None
    """Default: what the file states, else Blackman–Harris 3; one of those of tsmftis.fourier.APODIZATIONS."""
    phase_correction: PhaseCorrection | None = None
    """Default: what the file states, else mertz; mertz or power."""
    zero_filling: int | None = Field(None, ge=1, le=64)
    """Factor of the zero filling, which sets the spacing of the wavenumbers; default: what the file states, else 2."""
    resolution_per_m: float | None = Field(None, gt=0)
    """Default: what the file states, else all that the scan holds."""
    phase_resolution_per_m: float | None = Field(None, gt=0)
    """Resolution of the phase's low-resolution spectrum; default: what the file states."""
    normalisation_per_m: float = Field(OPUS_UNIT, gt=0)
    """Width that the spectrum's density is multiplied by: the default gives OPUS's unit, 1 gives counts per m-1."""

    @field_validator("apodization")
    @classmethod
    def _known(cls, value: str | None) -> str | None:
        if value is not None and value not in fourier.APODIZATIONS:
            raise ValueError(f"unknown apodization '{value}': use one of {', '.join(fourier.APODIZATIONS)}")
        return value


@dataclass(frozen=True)
class Parameters:
    """What was used: half-lengths of the window and of the phase's window [m]; short side of the Mertz ramp or None."""

    apodization: str
    phase_correction: PhaseCorrection
    zero_filling: int
    half_length: float
    phase_half_length: float
    ramp: float | None


@dataclass(frozen=True)
class BenchResult:
    """spectrum (k,) on wavenumber (k,) [m-1], scans averaged; `scans` (scan, k) are those of each scan.

    Against the reference r: relative_rms = ‖s − r‖/‖r‖; scale = s·r/s·s, relative_rms_scaled = ‖scale·s − r‖/‖r‖.
    They are None without a reference.
    """

    wavenumber: Array
    spectrum: Array
    scans: Array
    reference: Array | None
    relative_rms: float | None
    relative_rms_scaled: float | None
    scale: float | None
    parameters: Parameters
    notes: tuple[str, ...]

    def to_dataset(self) -> xr.Dataset:
        """The spectra with the options they were made with."""
        p = self.parameters
        variables = {
            "spectrum": (("wavenumber",), self.spectrum, {"long_name": "mean of the scans"}),
            "spectrum_scan": (("scan", "wavenumber"), self.scans, {"long_name": "each scan alone"}),
        }
        if self.reference is not None:
            variables["reference"] = (("wavenumber",), self.reference, {"long_name": "the spectrum in the bench file"})
        attributes: dict[str, str | float | int] = {
            "apodization": p.apodization,
            "phase_correction": p.phase_correction,
            "zero_filling": p.zero_filling,
            "half_length_m": p.half_length,
            "phase_half_length_m": p.phase_half_length,
            "notes": "; ".join(self.notes),
        }
        if p.ramp is not None:
            attributes["mertz_ramp_m"] = p.ramp
        for name in ("relative_rms", "relative_rms_scaled", "scale"):
            if (value := getattr(self, name)) is not None:
                attributes[name] = value
        return xr.Dataset(variables, {"wavenumber": (("wavenumber",), self.wavenumber, {"units": "m-1"})}, attributes)


def run(bench: Bench, settings: BenchSettings, effects: Mapping[str, Mapping[str, float]] | None = None) -> BenchResult:
    """The spectrum of `bench` on the reference's wavenumbers or, without one, from 0 to the Nyquist wavenumber.

    Of the `effects` of the stage spectral detector_nonlinearity, opd_scale and opd_quadratic concern a bench instrument.
    Raises InputError where the interferogram has no burst with two sides, or is asked for what it cannot give.
    """
    effects = effects or {}
    if bench.reference is None or not amounts(effects, "detector_nonlinearity")[0]:
        return _run(with_effects(bench, effects), settings)
    exact, vendors = (_run(with_effects(bench, effects, exact), settings) for exact in (True, False))
    assert exact.relative_rms_scaled is not None and vendors.relative_rms_scaled is not None
    if exact.relative_rms_scaled <= vendors.relative_rms_scaled:
        return exact
    return replace(vendors, notes=(*vendors.notes, VENDORS_INVERSE))


def _run(bench: Bench, settings: BenchSettings) -> BenchResult:
    """The spectrum, effects taken out already."""
    scans = fourier.remove_constant(bench.interferogram, bench.opd, 0)
    zpd = find_zpd(scans, bench.opd)
    parameters, notes = choose(bench, settings, zpd)
    if bench.wavenumber is None or bench.reference is None:
        reference, wavenumber = None, grid(bench.opd, parameters)
    else:
        reference, wavenumber = bench.reference, bench.wavenumber
        notes.append("on the reference's own wavenumbers; zero filling has no part in it")
    spectra = settings.normalisation_per_m * corrected(scans, bench.opd, zpd, wavenumber, parameters)
    spectrum = spectra.mean(axis=0)
    result = BenchResult(wavenumber, spectrum, spectra, reference, None, None, None, parameters, tuple(notes))
    if reference is None:
        return result
    scale = float(spectrum @ reference / (spectrum @ spectrum))
    return replace(
        result,
        scale=scale,
        relative_rms=float(fourier.rqe(spectrum, reference)),
        relative_rms_scaled=float(fourier.rqe(scale * spectrum, reference)),
    )


def with_effects(bench: Bench, effects: Mapping[str, Mapping[str, float]], exact: bool = True) -> Bench:
    """The interferogram as it would be had the instrument been the declared one: linear, on its true OPD."""
    refuse_others(effects, "spectral")
    (a,), (scale,), (quadratic,) = (
        amounts(effects, name) for name in ("detector_nonlinearity", "opd_scale", "opd_quadratic")
    )
    scans = fourier.remove_constant(bench.interferogram, bench.opd, 0)
    if scale or quadratic:
        zpd = float(np.abs(scans).argmax(axis=1).mean())
        opd = bench.opd * (1.0 + scale) + quadratic * (np.arange(bench.opd.size) - zpd) ** 2
        if (np.diff(opd) <= 0.0).any():
            raise InputError(
                "bench",
                "opd",
                f"does not increase any more with an opd_quadratic of {quadratic:g} m per column²",
                "correct the model update",
            )
        bench = replace(bench, opd=opd)
    if a:
        bench = replace(bench, interferogram=linear(scans, a, exact))
    return bench


def linear(scans: Array, a: float, exact: bool, rounds: int = 4) -> Array:
    """s, free of its mean, of recorded s' = s·(1 − a·s/D) + constant (scan, n); D = max|s| of each scan.

    Not `exact`: s = s'·(1 + a·s'/D'), D' the largest deviation of s'.

    The largest of s' is D·(1 − a), its least −D·(1 + a): whichever makes D larger is the largest deviation. The mean of s' is
    −a·⟨s²⟩/D off, a thousandth of a burst, which a few rounds settle.
    """
    signal = scans = scans - scans.mean(axis=1, keepdims=True)
    largest = np.abs(scans).max(axis=1, keepdims=True)
    if not exact:
        signal = scans * (1.0 + a * scans / largest)
        return signal - signal.mean(axis=1, keepdims=True)
    for _ in range(rounds):
        recorded = scans - a * (signal**2).mean(axis=1, keepdims=True) / largest
        high, low = recorded.max(axis=1, keepdims=True), recorded.min(axis=1, keepdims=True)
        largest = np.maximum(high / (1.0 - a), -low / (1.0 + a))
        signal = detector.undo_nonlinearity(recorded, a, largest)
    return signal


def find_zpd(scans: Array, opd: Array) -> Array:
    """OPD [m] of the largest deviation of each scan (scan, n), mean taken off → (scan,)."""
    index = np.argmax(np.abs(scans), axis=1)
    nearest = np.minimum(index, opd.size - 1 - index)
    if nearest.min() < SHORTEST_SIDE:
        worst = int(np.argmin(nearest))
        raise InputError(
            "bench",
            f"interferogram, scan {worst}",
            f"its largest deviation is sample {index[worst]} of {opd.size}: nothing of the burst's other side is there",
            "record at least some samples on both sides of zero path difference",
        )
    return opd[index]


def choose(bench: Bench, settings: BenchSettings, zpd: Array) -> tuple[Parameters, list[str]]:
    """The parameters: the settings, else the file's, else a default; with a note on each that was not plainly given."""
    notes: list[str] = []
    apodization = settings.apodization or bench.apodization
    if apodization is None:
        apodization = "blackman-harris-3"
        notes.append(f"no apodization is given: {apodization}")
    elif apodization not in fourier.APODIZATIONS:
        raise InputError(
            "bench",
            "attribute 'apodization'",
            f"'{apodization}' is not known",
            f"override bench.apodization with one of {', '.join(fourier.APODIZATIONS)}",
        )
    zero_filling = settings.zero_filling or bench.zero_filling
    if zero_filling is None:
        zero_filling = 2
    elif zero_filling < 1:
        raise InputError("bench", "attribute 'zero_filling'", f"is {zero_filling}", "it must be 1 or more")
    correction = _phase_correction(settings.phase_correction or bench.phase_correction, notes)

    short = float(min(zpd.min() - bench.opd[0], bench.opd[-1] - zpd.max()))
    long = float(min(max(z - bench.opd[0], bench.opd[-1] - z) for z in zpd))
    half = _half_length(bench.resolution, settings.resolution_per_m, long, "resolution", notes)
    if half is None:
        half = short if short >= TWO_SIDED * long else long
        notes.append(f"no resolution is given: all of the OPD is used, {half:.4g} m")
    ramp = short if short < half else None
    if ramp is not None and correction == "power":
        half, ramp = short, None
        notes.append(f"a power spectrum needs both sides alike: the OPD is cut to the short side, {short:.4g} m")
    if ramp is not None:
        notes.append(f"one-sided: Mertz ramp over {ramp:.4g} m")
    phase_half = _half_length(bench.phase_resolution, settings.phase_resolution_per_m, short, "phase_resolution", notes)
    if phase_half is None:
        phase_half = short if ramp is not None else min(short, PHASE_SHARE * half)
        if correction == "mertz":
            notes.append(f"no phase resolution is given: phase from {phase_half:.4g} m about ZPD")
    return Parameters(apodization, correction, zero_filling, half, phase_half, ramp), notes


def _phase_correction(name: str | None, notes: list[str]) -> PhaseCorrection:
    for known in get_args(PhaseCorrection):
        if name == known:
            return known
    if name is None:
        notes.append("no phase correction is given: mertz")
        return "mertz"
    raise InputError(
        "bench",
        "attribute 'phase_correction'",
        f"'{name}' is not known",
        "override bench.phase_correction with mertz or power",
    )


def _half_length(
    given: float | None, wanted: float | None, longest: float, name: str, notes: list[str]
) -> float | None:
    """0.9/resolution [m], at most `longest`: beyond it a setting is refused, a file's own parameter cut with a note."""
    resolution = given if wanted is None else wanted
    if resolution is None:
        return None
    if not resolution > 0.0:
        raise InputError(
            "bench", f"attribute '{name}_m-1'", f"is {resolution:g}", f"must be positive: override bench.{name}_per_m"
        )
    half = WINDOW_REACH / resolution
    if half <= longest * (1.0 + 1e-9):
        return half
    if wanted is not None:
        raise InputError(
            "bench",
            f"setting bench.{name}_per_m",
            f"{wanted:g} m-1 needs {half:.4g} m of OPD, the interferogram has {longest:.4g} m",
            f"use {1.00001 * WINDOW_REACH / longest:.6g} m-1 or more",
        )
    notes.append(f"the file's {name} of {resolution:g} m-1 needs {half:.4g} m of OPD: cut to {longest:.4g} m")
    return longest


def grid(opd: Array, parameters: Parameters) -> Array:
    """Wavenumbers [m-1], 0 to 1/(2·dx) by 1/(N·dx); N = zero filling × the power of two that holds L/dx."""
    step = float(np.diff(opd).mean())
    samples = parameters.zero_filling * 2 ** int(np.ceil(np.log2(parameters.half_length / step)))
    nyquist = 0.5 / float(np.diff(opd).max())  # of the widest interval: beyond it the spectrum folds
    return np.arange(int(nyquist * samples * step * (1.0 + 1e-9)) + 1) / (samples * step)


def corrected(scans: Array, opd: Array, zpd: Array, wavenumber: Array, parameters: Parameters) -> Array:
    """2·Re(S·exp(−iφ)) or 2·|S| of each scan (scan, n), free of its mean, about its ZPD (scan,) [m] → (scan, k)."""
    p = parameters
    x = opd - zpd[:, None]
    window = fourier.apodization(p.apodization, x / p.half_length)
    if p.ramp is not None:
        ramp = p.ramp  # w(x) + w(−x) = 2, as without a ramp
        window = window * np.stack([2.0 * fourier.mertz_ramp(one, ramp) for one in x])
    spectrum = transform(scans * window, opd, wavenumber)
    if p.phase_correction == "power":
        return 2.0 * np.abs(spectrum)
    near = transform(scans * fourier.apodization(PHASE_WINDOW, x / p.phase_half_length), opd, wavenumber)
    return 2.0 * np.real(spectrum * np.exp(-1j * np.angle(near)))


def transform(windowed: Array, opd: Array, wavenumber: Array) -> Complex:
    """`fourier.transform` of (scan, n) onto many wavenumbers (k,), piece by piece so that memory stays bounded.

    On evenly spaced wavenumbers σ = σ_b + jΔ the blocks share one table, exp(−2πiσx) = exp(−2πiσ_b·x)·exp(−2πijΔx), and
    only the shifts σ_b are computed anew: a twentieth of the time for a vendor's file, and the same to rounding. OPD
    need not be even.
    """
    used = np.flatnonzero(np.any(windowed != 0.0, axis=0))
    if used.size == 0:
        return np.zeros((len(windowed), wavenumber.size), complex)
    inside = slice(max(int(used[0]) - 1, 0), int(used[-1]) + 2)  # a zero more each side keeps the ends' dx whole
    x, y = opd[inside], windowed[:, inside]
    ones = np.ones(x.size)
    even = np.linspace(wavenumber[0], wavenumber[-1], wavenumber.size)
    if wavenumber.size <= BLOCK or 2.0 * np.pi * np.abs(wavenumber - even).max() * np.abs(x).max() > 1e-9:
        blocks = (wavenumber[b : b + BLOCK] for b in range(0, wavenumber.size, BLOCK))
        return np.concatenate([fourier.transform(y, x, ones, block) for block in blocks], axis=-1)
    offset, starts = wavenumber[:BLOCK] - wavenumber[0], wavenumber[::BLOCK]
    at_once = max(1, ELEMENTS // x.size)
    out = np.empty((len(y), starts.size, BLOCK), complex)
    for b in range(0, starts.size, at_once):
        shift = np.exp(-2j * np.pi * np.outer(starts[b : b + at_once], x))
        for i, one in enumerate(y):
            shifted = one * shift
            real, imaginary = (fourier.transform(part, x, ones, offset) for part in (shifted.real, shifted.imag))
            out[i, b : b + at_once] = real + 1j * imaginary
    return out.reshape(len(y), -1)[:, : wavenumber.size]
