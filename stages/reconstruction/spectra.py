"""Interferograms along tracks and their spectra as scored (Connes window, Mertz ramp, one phase for the line)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pipeline.errors import StageError
from pipeline.records import Calibration, Frames, Interferograms, References, Spectra, Targets, Tracks
from tsmftis import detector, extraction, fourier
from tsmftis.camera import Camera
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]

LEAST_POINTS = 5  # of the 25, for an area to count


class ReconstructionSettings(BaseModel):
    """What of the reconstruction is a choice and not the score's definition."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    drift_order: int = Field(
        1, ge=0, le=4, description="polynomial in OPD taken off each interferogram: 0 is the mean alone"
    )
    phase_order: int = Field(2, ge=1, le=6, description="polynomial order of the instrument's phase over wavenumber")
    block_frames: int = Field(256, ge=2, description="frames held in memory at a time")


@dataclass(frozen=True)
class ReconstructionResult:
    """Spectra as scored, the interferograms behind them, phase coefficients and the noise model (read² [DN²], gain [DN])."""

    spectra: Spectra
    interferograms: Interferograms
    phase: Array
    read_variance: float
    gain: float


def run(
    frames: Frames,
    tracks: Tracks,
    targets: Targets,
    calibration: Calibration,
    references: References | None,
    camera: Camera,
    interferometer: Interferometer,
    settings: ReconstructionSettings,
) -> ReconstructionResult:
    """Spectra of every target under every method.

    The phase is the instrument's: it is estimated once, from the points of `tracking` (or the last method), and used for
    all methods, so that the methods differ by geometry alone. Raises StageError where no point is seen well enough.
    """
    ifg = extract(frames, tracks, calibration, camera, interferometer, settings)
    wavenumber = interferometer.scored_wavenumbers()
    response = np.interp(wavenumber, calibration.wavenumber, calibration.response)
    leading = tracks.methods.index("tracking") if "tracking" in tracks.methods else len(tracks.methods) - 1
    counted = ifg.seen >= fourier.LEAST_SEEN
    if not counted[leading].any():
        raise StageError(
            "no target crosses enough columns of the detector: the line is too short or the targets lie off its track"
        )
    opd = ifg.opd(interferometer)
    ac = fourier.remove_constant(ifg.value, opd, settings.drift_order)
    phase = instrument_phase(
        ac[leading][counted[leading]], _of(opd, leading, counted), interferometer, wavenumber, settings.phase_order
    )
    read_variance, gain = noise_model(ifg, ac, leading, counted, interferometer, calibration)
    variance = read_variance + gain * np.maximum(ifg.value, 0.0)

    phi = fourier.smooth_phase(phase, wavenumber)
    centre_opd = fourier.fringe_centre(phi, wavenumber)
    window = fourier.scored_window(opd, interferometer.longest_opd, interferometer.shortest_side, centre_opd)
    value, sigma = fourier.radiance(ac, opd, window, wavenumber, phi, response, variance * ifg.gain)
    value[~counted], sigma[~counted] = np.nan, np.nan
    breaks = [start for start, _ in frames.segments()[1:]]
    area, sigma_area = _area(ifg, tracks, breaks, value, variance, opd, window, wavenumber, phi, response)
    centre = Tracks.CENTRE
    spectra = Spectra(
        tracks.methods,
        tracks.targets,
        wavenumber,
        value[:, :, centre],
        sigma[:, :, centre],
        area,
        sigma_area,
        scored_references(targets, references, calibration, interferometer, wavenumber),
        counted.sum(axis=2),
        phase,
        {
            "apodization": fourier.SCORED_APODIZATION,
            "phase_method": "Mertz, one polynomial for the line",
            "drift_order": settings.drift_order,
            "read_variance_dn2": read_variance,
            "gain_dn": gain,
        },
    )
    return ReconstructionResult(spectra, ifg, phase, read_variance, gain)


def extract(
    frames: Frames,
    tracks: Tracks,
    calibration: Calibration,
    camera: Camera,
    interferometer: Interferometer,
    settings: ReconstructionSettings,
) -> Interferograms:
    """Interferograms of all points (method, target, point, col), frames read in blocks that overlap by one within a run."""
    shape = tracks.row.shape[:3]
    row, col = (np.ascontiguousarray(a.reshape(-1, a.shape[-1])) for a in (tracks.row, tracks.col))
    value, gain, weight, mean_row = (np.zeros((row.shape[0], camera.cols)) for _ in range(4))
    blocks = [
        (first, min(first + settings.block_frames + 1, stop))
        for start, stop in frames.segments()
        for first in range(start, stop - 1, settings.block_frames)
    ]
    for first, last in blocks:
        counts = frames.block(first, last)
        block = detector.correct(
            counts, calibration.dark, calibration.flat, camera.saturation, interferometer.detector_nonlinearity
        )
        extraction.along_tracks(block, first, row, col, value, gain, weight, mean_row)
    seen = weight > 0
    once = np.maximum(weight, 1.0)
    filled = extraction.fill_gaps(value / once, seen)
    return Interferograms(
        tracks.methods,
        tracks.targets,
        filled.reshape(*shape, -1),
        extraction.fill_gaps(gain / once**2, seen).reshape(*shape, -1),
        extraction.fill_gaps(mean_row / once, seen).reshape(*shape, -1),
        weight.reshape(*shape, -1),
    )


def instrument_phase(ac: Array, opd: Array, interferometer: Interferometer, wavenumber: Array, order: int) -> Array:
    """Phase coefficients from the two-sided part of interferograms (point, cols): the spectra share one phase and have
    positive amplitudes, so their complex sum has that phase with the least noise."""
    short = interferometer.shortest_side
    coefficients, centre = np.zeros(order + 1), 0.0
    # The window must lie about the fringes' centre, which the phase itself tells: twice more is enough.
    for _ in range(3):
        window = fourier.apodization(fourier.SCORED_APODIZATION, (opd - centre) / (short - abs(centre)))
        mean = fourier.transform(ac, opd, window, wavenumber).sum(axis=0)
        coefficients = fourier.phase_polynomial(mean, wavenumber, order)
        centre = fourier.fringe_centre(fourier.smooth_phase(coefficients, wavenumber), wavenumber)
        centre = float(np.clip(centre, -0.5 * short, 0.5 * short))
    return coefficients


def noise_model(
    ifg: Interferograms,
    ac: Array,
    leading: int,
    counted: NDArray[np.bool_],
    interferometer: Interferometer,
    calibration: Calibration,
) -> tuple[float, float]:
    """read² and gain from the out-of-band power of the leading method's points against their mean signal.

    Out of band is where the response table ends, not where the declared range does: light goes on between the two.
    """
    chosen = counted[leading]
    opd = interferometer.opd((interferometer.rows - 1) / 2, np.arange(interferometer.cols))
    variance = detector.noise_out_of_band(
        ac[leading][chosen],
        ifg.gain[leading][chosen],
        opd,
        float(calibration.wavenumber[0]),
        float(calibration.wavenumber[-1]),
    )
    return detector.photon_transfer(ifg.value[leading][chosen].mean(axis=-1), variance)


def _of(opd: Array, leading: int, counted: NDArray[np.bool_]) -> Array:
    return opd if opd.ndim == 1 else opd[leading][counted[leading]]


def _area(
    ifg: Interferograms,
    tracks: Tracks,
    breaks: list[int],
    value: Array,
    variance: Array,
    opd: Array,
    window: Array,
    wavenumber: Array,
    phi: Array,
    response: Array,
) -> tuple[Array, Array]:
    """Mean spectrum of each area's counted points (those whose `value` is finite) and its sigma, in which the noise of pixels
    that several points share is counted once. breaks: frames before which frames are missing."""
    counted = np.isfinite(value[..., 0])
    area, sigma = np.full_like(value[:, :, 0], np.nan), np.full_like(value[:, :, 0], np.nan)
    rows = int(np.nanmax(tracks.row, initial=0.0)) + 2
    for m, t in zip(*np.nonzero(counted.sum(axis=2) >= LEAST_POINTS), strict=True):
        chosen = counted[m, t]
        area[m, t] = value[m, t, chosen].mean(axis=0)
        gain = np.zeros(ifg.value.shape[-1])
        row, col = (np.insert(track[m, t], breaks, np.nan, axis=1) for track in (tracks.row, tracks.col))
        extraction.shared_gain(row, col, chosen, ifg.crossings[m, t], rows, gain)
        at, w = (opd, window) if opd.ndim == 1 else (opd[m, t, chosen].mean(axis=0), window[m, t, chosen].mean(axis=0))
        mean_variance = variance[m, t, chosen].mean(axis=0) * gain
        _, sigma[m, t] = fourier.radiance(mean_variance, at, w, wavenumber, phi, response, mean_variance)
    return area, sigma


def scored_references(
    targets: Targets,
    references: References | None,
    calibration: Calibration,
    interferometer: Interferometer,
    wavenumber: Array,
) -> Array:
    """Each target's reference at the scored line shape (target, wavenumber); NaN where it has none."""
    out = np.full((len(targets.ids), wavenumber.size), np.nan)
    if references is None:
        return out
    for i, name in enumerate(targets.reference):
        if name:
            table = np.interp(
                calibration.wavenumber, references.wavenumber, references.radiance[references.names.index(name)]
            )
            out[i] = fourier.line_shape_response(
                table,
                calibration.response,
                calibration.wavenumber,
                interferometer.longest_opd,
                fourier.SCORED_APODIZATION,
                wavenumber,
            )
    return out
