"""What the closed loop is offered of the flight's spectra: panels' pixels minus the interferogram of their reference.

    r = [d − s·(1 − a·flat·s/12000)]/sigma,    s = level + Re ∫ R(σ)·B_ref(σ)·exp(i(2πσ·OPD(row, col) + φ(σ))) dσ

d is the mean over the pixels inside a panel (`panel_pixels`) in one detector column, each after dark and divided by its flat;
level a polynomial in the column, one for each interferogram; φ one polynomial in σ for the whole campaign. Level and φ are
estimated anew at every set of parameters, so that what is linearised about is always near. The non-linearity acts on the model:
data made linear would carry their own noise into the signature (measured: a spline of the signal beat the name in 1 of 2 runs).

A scale that panels have one by one (dirt, a panel lit askew) is none of the candidates: it makes `response_scale` change from
group to group, which the loop reports as structure without a name. One that all references share is `response_scale` itself.

Functions
---------
residual_problem    of all lines of a campaign
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Calibration, Frames, References, Targets, Tracks
from pipeline.residual_problem import Candidate, Parameter, Parameters, ResidualProblem
from pipeline.usable_pixels import unusable
from stages.reconstruction.covariates import covariates_of
from stages.reconstruction.panel_model import Model, PanelSamples
from stages.reconstruction.panel_pixels import REACHES, PanelPixels, panel_pixels, pixel_noise, reaches
from stages.reconstruction.spectra import ReconstructionSettings
from tsmftis.camera import Camera
from tsmftis.effects import EFFECTS
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]

FEWEST_COLUMNS = 48  # of an interferogram that says something
REMEMBERED = 1024  # residuals
WAVE = 0.1  # an error of the path difference at the end of the scan that is worth a name
PLAUSIBLE = {"detector_nonlinearity": 0.02, "channel_fringe": 0.02, "response_scale": 0.02}
PHASES = (0.0, np.pi / 3.0, 2.0 * np.pi / 3.0)  # of a fringe of either sign: at least 87 % of any


@dataclass(frozen=True)
class SpectralLine:
    """A flight line with the tracks of its targets (`tracking` is read of several methods)."""

    frames: Frames
    tracks: Tracks
    targets: Targets
    name: str = ""


def residual_problem(
    lines: Sequence[SpectralLine],
    calibration: Calibration,
    references: References | None,
    camera: Camera,
    interferometer: Interferometer,
    settings: ReconstructionSettings | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> ResidualProblem:
    """r (n,) over all panels with a reference; `effects` of the stage spectral belong to the null and are no candidates.

    InputError where no panel with a reference is seen.
    """
    settings = settings or ReconstructionSettings()
    known = {name: values for name, values in (effects or {}).items() if EFFECTS[name].stage == "spectral"}
    interferometer, calibration = interferometer.with_effects(known), calibration.with_effects(known)
    samples, radiance = _collect(lines, calibration, references, camera, settings)
    return problem_of(samples, radiance, calibration, interferometer, settings, tuple(known))


def problem_of(
    samples: PanelSamples,
    radiance: Array,
    calibration: Calibration,
    interferometer: Interferometer,
    settings: ReconstructionSettings,
    known: Sequence[str] = (),
) -> ResidualProblem:
    """The problem of samples that are there; radiance (b, k) on the calibration's wavenumbers."""
    model = Model.of(samples, radiance, calibration, interferometer, settings)
    labels = samples.interferogram
    return ResidualProblem(
        stage="spectral",
        residual=_remembering(model.residual),
        candidates=tuple(c for c in _candidates(model) if c.effect not in known),
        group=labels,
        series=labels,
        time=samples.col,
        nuisance=np.column_stack([model.levels, model.phase_columns()]),
        covariates=covariates_of(model),
        drifts=False,
        sigma=1.0,
        unit="sigma",
        group_names=dict(enumerate(samples.names)),
    )


def _remembering(residual: Callable[[Parameters], Array]) -> Callable[[Parameters], Array]:
    """The same function, which looks up what it was asked before: the loop asks for the signatures at the null twice."""

    @lru_cache(REMEMBERED)
    def of(key: tuple[tuple[str, tuple[tuple[str, float], ...]], ...]) -> Array:
        value = residual({effect: dict(values) for effect, values in key})
        value.flags.writeable = False
        return value

    return lambda parameters: of(tuple(sorted((e, tuple(sorted(v.items()))) for e, v in parameters.items())))


def _candidates(model: Model) -> list[Candidate]:
    instrument, end = model.interferometer, WAVE / float(model.forward.wavenumber.mean())
    farthest = float(np.abs(model.samples.col - instrument.zpd_col).max())
    plausible = PLAUSIBLE | {
        "opd_scale": end / (instrument.opd_step * farthest),
        "opd_quadratic": end / farthest**2,
        "fringe_tilt": end / (0.5 * instrument.rows),
    }
    out = []
    for name, effect in EFFECTS.items():
        if effect.stage != "spectral":
            continue
        parameters = {
            key: Parameter(unit, effect.largest[key], effect.least.get(key), plausible[name])
            for key, unit in effect.units.items()
        }
        grid: tuple[Mapping[str, float], ...] = ()
        if name == "channel_fringe":
            parameters |= {
                "thickness": Parameter("m", effect.largest["thickness"], 0.0, 1e-6, 1e-9),
                "phase": Parameter("rad", effect.largest["phase"], None, 1.0, 1e-3),
            }
            grid = tuple({"thickness": float(t), "phase": p} for t in thicknesses(model) for p in PHASES)
        out.append(Candidate(name, parameters, grid))
    return out


def thicknesses(model: Model) -> Array:
    """Optical thicknesses whose ghost of the centre burst falls among the samples, half a coherence length apart."""
    forward, response = model.forward, model.calibration.response
    power = (forward.radiance * response).mean(axis=0) ** 2
    mean = np.average(forward.wavenumber, weights=power)
    width = np.sqrt(np.average((forward.wavenumber - mean) ** 2, weights=power))
    opd = model.interferometer.opd(model.samples.row, model.samples.col)
    step = 1.0 / (2.0 * np.pi * width)
    return np.arange(2.0 * step, float(np.abs(opd).max()), step)


def _collect(
    lines: Sequence[SpectralLine],
    calibration: Calibration,
    references: References | None,
    camera: Camera,
    settings: ReconstructionSettings,
) -> tuple[PanelSamples, Array]:
    if references is None:
        raise InputError(
            "references", "file", "is missing", "spectra can be held against nothing: name one in campaign.yaml"
        )
    radiance = np.stack([np.interp(calibration.wavenumber, references.wavenumber, b) for b in references.radiance])
    every = []
    for line in lines:
        tracks = line.tracks
        leading = tracks.only("tracking" if "tracking" in tracks.methods else tracks.methods[-1])
        usable = calibration.without(unusable(calibration, line.frames))
        every.append(panel_pixels(line.frames, leading, usable, camera, settings.block_frames))
    noise = pixel_noise(_joined([p.part(p.distance <= REACHES[0]) for p in every]))
    parts: list[tuple[PanelPixels, Array, list[str], list[int]]] = []
    for line, pixels in zip(lines, every, strict=True):
        reach = reaches(pixels, noise, len(line.targets.ids))
        spectra = [references.names.index(r) if r in references.names else -1 for r in line.targets.reference]
        names = [f"{line.name} {t}".strip() for t in line.targets.ids]
        inside = pixels.part(pixels.distance <= reach[pixels.target])
        parts.append((inside, line.frames.time, names, spectra))
    return _samples(parts, radiance, noise)


def _joined(parts: Sequence[PanelPixels]) -> PanelPixels:
    """All lines' pixels, the targets numbered on."""
    shift = np.cumsum([0, *(int(p.target.max(initial=-1)) + 1 for p in parts)])
    every = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(PanelPixels)}
    numbered = np.concatenate([p.target + s for p, s in zip(parts, shift, strict=False)])
    return PanelPixels(**{**every, "target": numbered})


def _samples(
    parts: Sequence[tuple[PanelPixels, Array, list[str], list[int]]], radiance: Array, noise: tuple[float, float]
) -> tuple[PanelSamples, Array]:
    """The samples of targets with a reference and enough columns, and the spectra that occur (b, k); noise: read², gain [DN]."""
    of_samples = [f.name for f in fields(PanelSamples) if f.name != "names"]
    chunks: dict[str, list[NDArray[Any]]] = {n: [] for n in of_samples}
    names: list[str] = []
    for pixels, time, labels, spectra in parts:
        for t, label in enumerate(labels):
            mine = np.flatnonzero(pixels.target == t)
            seen, start, count = np.unique(pixels.col[mine], return_index=True, return_counts=True)
            if spectra[t] < 0 or seen.size < FEWEST_COLUMNS:
                continue
            row, signal, flat = pixels.row[mine].astype(float), pixels.signal[mine], pixels.flat[mine]
            mean = np.add.reduceat(row, start) / count
            variance = (noise[0] + noise[1] * np.maximum(signal, 0.0)) / flat**2
            for key, value in (
                ("value", np.add.reduceat(signal / flat, start) / count),
                ("sigma", np.sqrt(np.add.reduceat(variance, start)) / count),
                ("flat", np.add.reduceat(flat, start) / count),
                ("row", mean),
                ("row_variance", np.maximum(np.add.reduceat(row**2, start) / count - mean**2, 0.0)),
                ("col", seen.astype(float)),
                ("time", np.add.reduceat(time[pixels.frame[mine]], start) / count),
                ("interferogram", np.full(seen.size, len(names))),
                ("spectrum", np.full(seen.size, spectra[t])),
            ):
                chunks[key].append(value)
            names.append(label)
    if not names:
        raise InputError(
            "targets",
            "column reference",
            f"no target with a reference is seen whole on {FEWEST_COLUMNS} columns",
            "the panels must be over three pixels wide, cross the detector, and have spectra in references.nc",
        )
    joined = {n: np.concatenate(values) for n, values in chunks.items()}
    used, spectrum = np.unique(joined.pop("spectrum"), return_inverse=True)
    return PanelSamples(spectrum=spectrum, names=tuple(names), **joined), radiance[used]
