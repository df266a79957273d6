"""Interferograms along tracks and their spectra as scored (Connes window, Mertz ramp, one phase for the line)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pipeline.errors import StageError
from pipeline.records import Calibration, Frames, Interferograms, Products, References, Spectra, Targets, Tracks
from pipeline.usable_pixels import unusable
from stages.reconstruction.interferograms import Extracted, Extraction, extract, gain_of
from stages.reconstruction.panel import (
    PanelPoints,
    fitted_blur,
    ground_less_panel,
    pair_noise,
    panel_points,
    read_outside,
    variance_of_outside,
)
from stages.reconstruction.products import PhaseCorrection, imaginary_residue, panel_levels, panel_mean, spectra_by
from tsmftis import detector, fourier
from tsmftis.camera import Camera
from tsmftis.effects import refuse_others
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]

LEAST_POINTS = 5  # of the 25, for an area to count
LEAST_PAIRS = 6  # of points inside panels, for a noise model


class ReconstructionSettings(BaseModel):
    """What of the reconstruction is a choice and not the score's definition."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    drift_order: int = Field(
        1, ge=0, le=4, description="polynomial in OPD taken off each interferogram: 0 is the mean alone"
    )
    phase_order: int = Field(2, ge=1, le=6, description="polynomial order of the instrument's phase over wavenumber")
    extraction: Extraction = Field(
        "between-frames", description="or nearest-pixel: in each frame the pixel that a point lies in"
    )
    block_frames: int = Field(256, ge=2, description="frames held in memory at a time")
    product_apodization: str = Field(
        "connes", description=f"window of products.nc, never scored: {', '.join(fourier.APODIZATIONS)}"
    )
    product_phase_correction: PhaseCorrection = Field("mertz", description="of products.nc: mertz or forman")
    product_wavenumber_step_per_m: float = Field(5000.0, gt=0, description="of products.nc (zero filling, if fine)")

    @field_validator("product_apodization")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in fourier.APODIZATIONS:
            raise ValueError(f"unknown apodization '{value}': use one of {', '.join(fourier.APODIZATIONS)}")
        return value


@dataclass(frozen=True)
class ReconstructionResult:
    """Spectra as scored, products, the interferograms behind them, phase coefficients, noise model (read² [DN²], gain [DN]).

    bad_pixels: how many of the detector's were left out.
    """

    spectra: Spectra
    products: Products
    interferograms: Interferograms
    phase: Array
    read_variance: float
    gain: float
    bad_pixels: int


@dataclass(frozen=True)
class _Line:
    """What all spectra of a line share."""

    calibration: Calibration
    interferometer: Interferometer
    settings: ReconstructionSettings
    phase: Array  # coefficients
    noise: tuple[float, float]  # read² [DN²], gain [DN]
    scored: Array  # wavenumbers
    rows: int
    breaks: list[int]  # frames before which frames are missing
    blur: float  # of the panels' edges [px]

    def phase_at(self, wavenumber: Array) -> Array:
        return fourier.smooth_phase(self.phase, wavenumber, (self.scored[0], self.scored[-1]))

    @property
    def centre(self) -> float:
        """OPD [m] about which the fringes lie."""
        return fourier.fringe_centre(self.phase_at(self.scored), self.scored)

    def response_at(self, wavenumber: Array) -> Array:
        return np.interp(wavenumber, self.calibration.wavenumber, self.calibration.response)

    def variance(self, signal: Array) -> Array:
        return self.noise[0] + self.noise[1] * np.maximum(signal, 0.0)


def run(
    frames: Frames,
    tracks: Tracks,
    targets: Targets,
    calibration: Calibration,
    references: References | None,
    camera: Camera,
    interferometer: Interferometer,
    settings: ReconstructionSettings,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> ReconstructionResult:
    """Spectra of every target under every method, and the products under the leading one: `tracking`, or the last.

    The phase is the instrument's: it is estimated once, from the points of the leading method, and used for all, so that the
    methods differ by geometry alone. `effects` of the stage spectral are what a model update adds to interferometer and
    calibration. Raises StageError where no point is seen well enough.
    """
    refuse_others(effects or {}, "spectral")
    interferometer, calibration = interferometer.with_effects(effects or {}), calibration.with_effects(effects or {})
    bad = unusable(calibration, frames)
    calibration = calibration.without(bad)
    leading = tracks.methods.index("tracking") if "tracking" in tracks.methods else len(tracks.methods) - 1
    panels = [panel_points(r, c) for r, c in zip(tracks.row[leading], tracks.col[leading], strict=True)]
    ifg, of_panels = _extract_all(frames, tracks, panels, calibration, camera, interferometer, settings)
    wavenumber = interferometer.scored_wavenumbers()
    counted = ifg.seen >= fourier.LEAST_SEEN
    if not counted[leading].any():
        raise StageError(_why_none(tracks.only(tracks.methods[leading]), camera))
    opd = ifg.opd(interferometer)
    ac = fourier.remove_constant(ifg.value, opd, settings.drift_order)
    phase = instrument_phase(
        ac[leading][counted[leading]], _of(opd, leading, counted), interferometer, wavenumber, settings.phase_order
    )
    blur = fitted_blur(panels, [panel_levels(extracted) for extracted in of_panels])
    noise = noise_by_pairs(panels, of_panels, blur) or noise_model(
        ifg, ac, leading, counted, interferometer, calibration
    )
    breaks = [start for start, _ in frames.segments()[1:]]
    line = _Line(calibration, interferometer, settings, phase, noise, wavenumber, camera.rows, breaks, blur)
    grounds = [ground_less_panel(p, extracted, blur) for p, extracted in zip(panels, of_panels, strict=True)]
    spectra = _scored(ifg, ac, opd, tracks, counted, grounds, references, targets, line)
    products = _products(ifg, ac, opd, spectra, leading, panels, of_panels, references, targets, line)
    return ReconstructionResult(spectra, products, ifg, phase, *noise, int(bad.sum()))


def _why_none(tracks: Tracks, camera: Camera) -> str:
    """Why no target was seen on enough columns: none crosses the detector, or their pixels are of no use."""
    row, col = tracks.row[0, :, Tracks.CENTRE], tracks.col[0, :, Tracks.CENTRE]
    inside = (row >= 0) & (row <= camera.rows - 1)
    crossed = [np.ptp(np.clip(c[i], 0, camera.cols - 1)) if i.any() else 0.0 for c, i in zip(col, inside, strict=True)]
    share = max(crossed) / (camera.cols - 1)
    if share >= fourier.LEAST_SEEN:
        return (
            "targets cross the detector, but on more than 3 % of the columns their pixels are saturated or bad, or frames are "
            "missing: no spectrum can be made of them"
        )
    return (
        f"no target crosses enough columns of the detector (the best one {share:.0%}): the line is too short or the targets "
        "lie off its track"
    )


def _extract_all(
    frames: Frames,
    tracks: Tracks,
    panels: list[PanelPoints],
    calibration: Calibration,
    camera: Camera,
    interferometer: Interferometer,
    settings: ReconstructionSettings,
) -> tuple[Interferograms, list[Extracted]]:
    """Interferograms of the tracks' points and of the panels' in one pass over the frames."""
    shape = tracks.row.shape[:3]
    sizes = [int(np.prod(shape)), *(len(panel.row) for panel in panels)]
    row, col = (
        np.concatenate([getattr(tracks, n).reshape(sizes[0], -1), *(getattr(panel, n) for panel in panels)])
        for n in ("row", "col")
    )
    every = extract(frames, row, col, calibration, camera, interferometer, settings.extraction, settings.block_frames)
    edges = np.cumsum([0, *sizes])
    parts = [every.part(start, stop) for start, stop in itertools.pairwise(edges)]
    of_tracks = (getattr(parts[0], n).reshape(*shape, -1) for n in ("value", "gain", "row", "crossings"))
    return Interferograms(tracks.methods, tracks.targets, *of_tracks), parts[1:]


def _scored(
    ifg: Interferograms,
    ac: Array,
    opd: Array,
    tracks: Tracks,
    counted: NDArray[np.bool_],
    grounds: list[Array],
    references: References | None,
    targets: Targets,
    line: _Line,
) -> Spectra:
    """The spectra that are scored: Connes window, Mertz ramp, of the centre and of the area."""
    wavenumber, interferometer = line.scored, line.interferometer
    phi, response = line.phase_at(wavenumber), line.response_at(wavenumber)
    window = fourier.scored_window(opd, interferometer.longest_opd, interferometer.shortest_side, line.centre)
    variance = line.variance(ifg.value)
    value, sigma = fourier.radiance(ac, opd, window, wavenumber, phi, response, variance * ifg.gain)
    value[~counted], sigma[~counted] = np.nan, np.nan
    area, sigma_area = _area(ifg, tracks, value, variance, opd, window, phi, response, grounds, line)
    centre = Tracks.CENTRE
    return Spectra(
        tracks.methods,
        tracks.targets,
        wavenumber,
        value[:, :, centre],
        sigma[:, :, centre],
        area,
        sigma_area,
        references_as_seen(targets, references, line, fourier.SCORED_APODIZATION, wavenumber),
        counted.sum(axis=2),
        line.phase,
        {
            "apodization": fourier.SCORED_APODIZATION,
            "phase_method": "Mertz, one polynomial for the line",
            "drift_order": line.settings.drift_order,
            "extraction": line.settings.extraction,
            "read_variance_dn2": line.noise[0],
            "gain_dn": line.noise[1],
        },
    )


def _products(
    ifg: Interferograms,
    ac: Array,
    opd: Array,
    spectra: Spectra,
    leading: int,
    panels: list[PanelPoints],
    of_panels: list[Extracted],
    references: References | None,
    targets: Targets,
    line: _Line,
) -> Products:
    """Under the leading method: the centre with the window and phase correction asked for, and the panel's best mean."""
    settings, interferometer = line.settings, line.interferometer
    wavenumber = interferometer.scored_wavenumbers(settings.product_wavenumber_step_per_m)
    table = line.calibration.wavenumber
    step = min(
        settings.product_wavenumber_step_per_m, 0.2 / float(np.ptp(interferometer.opd(0, [0, interferometer.cols - 1])))
    )
    band = np.arange(table[0], table[-1], step)

    def transform(ac: Array, variance: Array, opd: Array) -> tuple[Array, Array]:
        return spectra_by(
            ac,
            variance,
            opd,
            interferometer,
            wavenumber,
            line.phase_at(wavenumber),
            line.centre,
            line.response_at(wavenumber),
            settings.product_apodization,
            settings.product_phase_correction,
            band,
            line.phase_at(band),
        )

    centre = Tracks.CENTRE
    at = opd if opd.ndim == 1 else opd[leading, :, centre]
    variance = line.variance(ifg.value[leading, :, centre]) * ifg.gain[leading, :, centre]
    value, sigma = transform(ac[leading, :, centre], variance, at)
    seen = np.isfinite(spectra.radiance[leading, :, 0])
    imaginary = imaginary_residue(
        ac[leading, :, centre], variance, at, interferometer, line.scored, line.phase_at(line.scored)
    )
    value[~seen], sigma[~seen], imaginary[~seen] = np.nan, np.nan, np.nan
    panel, sigma_panel = np.full((2, len(targets.ids), wavenumber.size), np.nan)
    counts, contrast = np.zeros(len(targets.ids), np.int64), np.full(len(targets.ids), np.nan)
    for t, (points, extracted) in enumerate(zip(panels, of_panels, strict=True)):
        best = panel_mean(points, line.blur, extracted, line.noise, line.rows, line.breaks, settings.extraction)
        if best is not None:
            mean, spread, row, counts[t], contrast[t] = best
            here = opd if opd.ndim == 1 else interferometer.opd(row, np.arange(interferometer.cols))[None]
            panel_ac = fourier.remove_constant(mean[None], here, settings.drift_order)
            panel[t], sigma_panel[t] = (a[0] for a in transform(panel_ac, spread[None], here))
    return Products(
        spectra.methods[leading],
        targets.ids,
        wavenumber,
        value,
        sigma,
        panel,
        sigma_panel,
        references_as_seen(targets, references, line, settings.product_apodization, wavenumber),
        counts,
        imaginary,
        contrast,
        {
            "apodization": settings.product_apodization,
            "phase_correction": settings.product_phase_correction,
            "extraction": settings.extraction,
            "blur_px": line.blur,
        },
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


def noise_by_pairs(panels: list[PanelPoints], of_panels: list[Extracted], blur: float) -> tuple[float, float] | None:
    """read² and gain from pairs of points inside the panels; None where there are hardly any."""
    pairs = [pair_noise(panel, extracted, blur) for panel, extracted in zip(panels, of_panels, strict=True)]
    signal, variance = (np.concatenate(values) for values in zip(*pairs, strict=True))
    return detector.photon_transfer(signal, variance) if signal.size >= LEAST_PAIRS else None


def noise_model(
    ifg: Interferograms,
    ac: Array,
    leading: int,
    counted: NDArray[np.bool_],
    interferometer: Interferometer,
    calibration: Calibration,
) -> tuple[float, float]:
    """read² and gain from the out-of-band power of the leading method's points against their mean signal: where there is no
    panel to speak of. Texture of the scene that reaches out of band counts as noise.

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
    value: Array,
    variance: Array,
    opd: Array,
    window: Array,
    phi: Array,
    response: Array,
    grounds: list[Array],
    line: _Line,
) -> tuple[Array, Array]:
    """Mean spectrum of each area's counted points (those whose `value` is finite) and its sigma: noise, that of pixels which
    several points share counted once, and what is read beyond the panel's edge, of the ground (point, col) around each."""
    counted = np.isfinite(value[..., 0])
    area, sigma = np.full_like(value[:, :, 0], np.nan), np.full_like(value[:, :, 0], np.nan)
    for m, t in zip(*np.nonzero(counted.sum(axis=2) >= LEAST_POINTS), strict=True):
        chosen = counted[m, t]
        area[m, t] = value[m, t, chosen].mean(axis=0)
        share = chosen / chosen.sum()
        how = line.settings.extraction
        gain = gain_of(tracks.row[m, t], tracks.col[m, t], share, ifg.crossings[m, t], line.rows, line.breaks, how)
        at, w = (opd, window) if opd.ndim == 1 else (opd[m, t, chosen].mean(axis=0), window[m, t, chosen].mean(axis=0))
        mean_variance = variance[m, t, chosen].mean(axis=0) * gain
        if how == "between-frames":
            row, col = (np.insert(track[m, t], line.breaks, np.nan, axis=1) for track in (tracks.row, tracks.col))
            outside = read_outside(row, col, share, gain.size)
            mean_variance += variance_of_outside(outside, grounds[t])
        _, sigma[m, t] = fourier.radiance(mean_variance, at, w, line.scored, phi, response, mean_variance)
    return area, sigma


def references_as_seen(
    targets: Targets, references: References | None, line: _Line, apodization: str, wavenumber: Array
) -> Array:
    """Each target's reference at the line shape of a window (target, wavenumber); NaN where it has none."""
    out = np.full((len(targets.ids), wavenumber.size), np.nan)
    if references is None:
        return out
    calibration = line.calibration
    for i, name in enumerate(targets.reference):
        if name:
            table = np.interp(
                calibration.wavenumber, references.wavenumber, references.radiance[references.names.index(name)]
            )
            out[i] = fourier.line_shape_response(
                table,
                calibration.response,
                calibration.wavenumber,
                line.interferometer.longest_opd,
                apodization,
                wavenumber,
            )
    return out
