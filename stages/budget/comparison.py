"""One line's variants against its base: displacement of the tracks, change of the spectra, and the noise in that change.

A track that is displaced reads other pixels, so two spectra differ by the noise of these pixels even where the ground is
alike. What noise alone does to the difference follows from the pixels' weights in both,

    E‖B′ − B‖² = Σ_σ Σ_c (4·w·dx·cos(2πσx_c + φ)/R)²·g_c·var_c,   g_c = Σ_pixels (w′_pixel − w_pixel)²,

and is taken off; what is left is the part's own. By chance ‖B′ − B‖² scatters about that by √(2·tr C²), C the covariance of
B′ − B over wavenumber. The variance of a pixel is the detector's, one for all lines: a line's own estimate comes from out of the
band, where texture of its scene may count as noise, so the least noisy line's is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Calibration, CameraPoses, Interferograms, Spectra, Tracks
from tsmftis import extraction, fourier
from tsmftis.camera import Camera
from tsmftis.geodesy import geodetic_to_ecef
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]

KINDS = ("point", "area")
DISPLACEMENT = ("row", "col", "row_varying", "col_varying")


@dataclass(frozen=True)
class Variant:
    """One perturbed set of tracks of a part: its `direction` (independent ones add) and `sample` (these are averaged over)."""

    part: str
    direction: int = 0
    sample: int = 0


@dataclass(frozen=True)
class Comparison:
    """What one line's targets say of its variants.

    displacement (variant, target, 4) [px²]: mean squares of row and column, then of both less their own mean over the pass.
    The rest (1 + variant, target, kind), first the base's own, then B′ − B: `change` ‖B′ − B‖/‖B_ref‖, for the base its RQE;
    `noise` √E of its square by noise alone, `scatter` the standard deviation of that square; `rqe` of B′. rqe_sigma (target,
    kind): √Σσ²/‖B_ref‖ with the σ that the spectra have of their own line. NaN where a target is not seen, or has no reference;
    `change` and the noises are relative to the base's own spectrum where a target has no reference.
    """

    line: str
    targets: tuple[str, ...]
    variants: tuple[Variant, ...]
    displacement: Array
    change: Array
    noise: Array
    scatter: Array
    rqe: Array
    rqe_sigma: Array

    def joined(self, other: Comparison) -> Comparison:
        """The variants of both, for the same line and base."""
        return Comparison(
            self.line,
            self.targets,
            self.variants + other.variants,
            np.concatenate([self.displacement, other.displacement]),
            np.concatenate([self.change, other.change[1:]]),
            np.concatenate([self.noise, other.noise[1:]]),
            np.concatenate([self.scatter, other.scatter[1:]]),
            np.concatenate([self.rqe, other.rqe[1:]]),
            self.rqe_sigma,
        )


def compare(
    line: str,
    variants: tuple[Variant, ...],
    tracks: Tracks,
    spectra: Spectra,
    interferograms: Interferograms | None,
    pixel: tuple[float, float],
    breaks: list[int],
    calibration: Calibration,
    camera: Camera,
    interferometer: Interferometer,
) -> Comparison:
    """Compare methods 1 … n of tracks and spectra with method 0, the base; variants (n,) name them.

    interferograms: those behind the spectra, whose crossings say which pixels were read; None where the methods differ in how
    pixels are read: then the noise of a difference is taken as if they shared none. pixel: read² [DN²] and gain [DN] of a
    pixel's variance (see `least_noise`). breaks: frames before which frames are missing.
    """
    area, point = spectra.radiance_area, spectra.radiance
    values = np.stack([point, area], axis=2)
    has_reference = np.asarray(np.isfinite(spectra.reference).all(axis=1))
    reference = np.where(has_reference[:, None, None], spectra.reference[:, None], values[0])
    size = np.linalg.norm(reference, axis=-1)
    rqe = np.stack([fourier.rqe(point, spectra.reference), fourier.rqe(area, spectra.reference)], axis=-1)
    change = np.concatenate([rqe[:1], np.linalg.norm(values[1:] - values[0], axis=-1) / size])
    sigma = np.linalg.norm(np.stack([spectra.sigma_radiance, spectra.sigma_radiance_area], axis=2), axis=-1)
    if interferograms is None:
        noise, scatter = np.concatenate([sigma[:1], np.hypot(sigma[0], sigma[1:])]), np.zeros_like(sigma)
    else:
        gain = noise_gain(tracks, interferograms, breaks, camera.rows)
        noise, scatter = _noise(gain, spectra, interferograms, pixel, calibration, interferometer)
    noise, scatter = noise / size, scatter / size**2
    return Comparison(
        line,
        tracks.targets,
        variants,
        displacement(tracks, camera),
        change,
        noise,
        scatter,
        rqe,
        sigma[0] / size,
    )


def least_noise(models: Sequence[tuple[float, float]], signal: Array) -> int:
    """Which of the lines' noise models, read² [DN²] and gain [DN], has the least mean variance read² + gain·signal [DN²]."""
    return int(np.argmin([(read + gain * np.maximum(signal, 0.0)).mean() for read, gain in models]))


def displacement(tracks: Tracks, camera: Camera) -> Array:
    """Mean squares (method − 1, target, 4) [px²] of the centres' rows and columns against method 0 while that is on the detector;
    the last two less their mean."""
    row, col = tracks.row[:, :, Tracks.CENTRE], tracks.col[:, :, Tracks.CENTRE]
    return _mean_squares(row[1:] - row[0], col[1:] - col[0], _inside(row[0], col[0], camera))


def terrain_displacement(
    poses: CameraPoses, camera: Camera, latitude: Array, longitude: Array, height: Array, flat: float
) -> Array:
    """Mean squares (4,) [px²], as `displacement`, of ground cells that stand at `flat` [m] instead of their height.

    latitude, longitude [rad], height [m] (cell,); NaN where no cell is on the detector.
    """
    where = []
    for level in (height, np.full_like(height, flat)):
        sight = geodetic_to_ecef(latitude, longitude, level)[:, None, :] - poses.centre
        where.append(camera.project(np.einsum("fij,cfi->cfj", poses.dcm, sight)))
    (row, col), (flat_row, flat_col) = where
    each = _mean_squares(flat_row - row, flat_col - col, _inside(row, col, camera))
    seen = np.isfinite(each[:, 0])
    return np.asarray(each[seen].mean(axis=0)) if seen.any() else np.full(4, np.nan)


def _inside(row: Array, col: Array, camera: Camera) -> NDArray[np.bool_]:
    return (row >= 0) & (row <= camera.rows - 1) & (col >= 0) & (col <= camera.cols - 1)


def _mean_squares(row: Array, col: Array, inside: NDArray[np.bool_]) -> Array:
    """(…, 4) from displacements (…, frame) where `inside`, a mask that broadcasts; NaN where no frame is."""
    inside = inside & np.isfinite(row) & np.isfinite(col)
    count = inside.sum(axis=-1)
    n = np.where(count > 0, count, np.nan)
    out = []
    for values in (row, col):
        kept = np.where(inside, values, 0.0)
        out.append((kept.sum(axis=-1) / n, (kept**2).sum(axis=-1) / n))
    (r, r2), (c, c2) = out
    return np.stack([r2, c2, np.maximum(r2 - r * r, 0.0), np.maximum(c2 - c * c, 0.0)], axis=-1)


def _noise(
    gain: Array,
    spectra: Spectra,
    ifg: Interferograms,
    pixel: tuple[float, float],
    calibration: Calibration,
    interferometer: Interferometer,
) -> tuple[Array, Array]:
    """√E‖B‖² by noise alone and the standard deviation of ‖B‖², both (method, target, kind) in radiance: of the base, then of
    each difference; `gain` as `noise_gain`."""
    value = np.stack([ifg.value[0, :, Tracks.CENTRE], np.nanmean(ifg.value[0], axis=1)], axis=1)
    variance = gain * (pixel[0] + pixel[1] * np.maximum(value, 0.0))
    opd = interferometer.opd((interferometer.rows - 1) / 2, np.arange(interferometer.cols))
    phase = fourier.smooth_phase(spectra.phase, spectra.wavenumber)
    centre = fourier.fringe_centre(phase, spectra.wavenumber)
    window = fourier.scored_window(opd, interferometer.longest_opd, interferometer.shortest_side, centre)
    response = np.interp(spectra.wavenumber, calibration.wavenumber, calibration.response)
    fringes = np.cos(2.0 * np.pi * np.outer(opd, spectra.wavenumber) + phase) / response
    to_radiance = 4.0 * (window * fourier.quadrature(opd))[:, None] * fringes
    square, scatter = np.full(variance.shape[:3], np.nan), np.full(variance.shape[:3], np.nan)
    for at in zip(*np.nonzero(np.isfinite(variance[..., 0])), strict=True):
        covariance = to_radiance.T @ (variance[at][:, None] * to_radiance)
        square[at], scatter[at] = np.trace(covariance), np.sqrt(2.0 * (covariance**2).sum())
    return np.sqrt(square), scatter


def noise_gain(tracks: Tracks, ifg: Interferograms, breaks: list[int], rows: int) -> Array:
    """var/var(pixel) (method, target, kind, col) of the centre and of the area's mean: of I₀ itself, then of I_m − I₀.

    NaN where either is not seen well enough to be scored.
    """
    methods, targets, _, cols = ifg.value.shape
    counted = ifg.seen >= fourier.LEAST_SEEN
    out = np.full((methods, targets, len(KINDS), cols), np.nan)
    centre = np.zeros(tracks.row.shape[2], bool)
    centre[Tracks.CENTRE] = True
    for t in range(targets):
        row, col = (np.insert(a[:, t], breaks, np.nan, axis=2) for a in (tracks.row, tracks.col))
        for k, chosen in enumerate((counted[:, t] & centre, counted[:, t])):
            weights = chosen / np.maximum(chosen.sum(axis=1, keepdims=True), 1)
            for m in range(methods):
                if not (chosen[m].any() and chosen[0].any()):
                    continue
                both = [0] if m == 0 else [m, 0]
                share = np.concatenate([weights[i] * (-1.0 if i == 0 < m else 1.0) for i in both])
                track = [np.concatenate([a[i] for i in both]) for a in (row, col, ifg.crossings[:, t])]
                extraction.gain_of_mean(track[0], track[1], share, track[2], rows, out[m, t, k])
    return out
