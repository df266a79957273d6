"""Raw pixels that lie wholly inside a panel: independent samples of one spectrum, read without any interpolation.

A pixel whose centre lies at (a, x) from a panel's centre, in half sides along and across, sees the panel alone if

    max(|a|, |x|) ≤ reach,      reach ≤ 1 − EDGE_PX/half side in pixels

with an edge that its own extent and the optics' and the frame's blur do not cross. It sees one path difference, that of its own
row and column, and no noise is shared between pixels, which interpolated points never have. Tracks that err bring an edge in:
the reach of each target is the largest at which none of the four outermost strips differs from the middle, column by column.

Functions
---------
panel_pixels    of a line's targets, block by block out of the frames
pixel_noise     read² and gain from the same detector pixel in successive frames
reaches         how far from each target's centre its pixels see the panel alone
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline.records import Calibration, Frames, Tracks
from tsmftis import detector
from tsmftis.camera import Camera

Array = NDArray[np.float64]
Index = NDArray[np.int64]

REACHES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # half sides; the first is taken in any case
EDGE_PX = 1.5
STRIP = 0.15  # half sides, width of an outermost strip
CHANCE = 1e-3  # of calling a clean strip different
MOST_PIXELS = 64.0  # a sample, on average: more frames are thinned out
FEWEST_PAIRS = 200  # for a variance


@dataclass(frozen=True)
class PanelPixels:
    """(m,) each, ordered by target, column, row, frame: signal after dark [DN], flat, where they lie; `target` an index;
    along, across: from the target's centre [half sides].

    A column of a target in which a pixel is saturated is left out as a whole: the pixels that are not are its darker ones.
    """

    signal: Array
    flat: Array
    target: Index
    frame: Index
    row: Index
    col: Index
    along: Array
    across: Array

    @property
    def distance(self) -> Array:
        """The larger of |along| and |across|."""
        return np.maximum(np.abs(self.along), np.abs(self.across))

    def part(self, which: NDArray[Any]) -> PanelPixels:
        return PanelPixels(*(getattr(self, f.name)[which] for f in fields(self)))


def panel_pixels(
    frames: Frames, tracks: Tracks, calibration: Calibration, camera: Camera, block_frames: int
) -> PanelPixels:
    """Pixels inside each target of `tracks` (one method); bad pixels are NaN in the calibration's dark."""
    target, frame, row, col, along, across = (np.concatenate(p) for p in zip(*_places(tracks, camera), strict=True))
    good = np.isfinite(calibration.dark) & np.isfinite(calibration.flat) & (calibration.flat > 0.0)
    kept = good[row, col]
    target, frame, row, col, along, across = (a[kept] for a in (target, frame, row, col, along, across))
    counts = np.zeros(target.size, np.uint16)
    by_frame = np.argsort(frame, kind="stable")
    for first in range(0, frames.time.size, block_frames):
        last = min(first + block_frames, frames.time.size)
        part = by_frame[slice(*np.searchsorted(frame[by_frame], [first, last]))]
        if part.size:
            counts[part] = frames.block(first, last)[frame[part] - first, row[part], col[part]]
    sample = target * camera.cols + col
    spoilt = np.bincount(sample, counts >= camera.saturation, len(tracks.targets) * camera.cols) > 0
    order = np.lexsort((frame, row, sample))
    order = order[~spoilt[sample[order]]]
    target, frame, row, col, along, across = (a[order] for a in (target, frame, row, col, along, across))
    signal = counts[order].astype(float) - calibration.dark[row, col]
    return PanelPixels(signal, calibration.flat[row, col], target, frame, row, col, along, across)


def _places(tracks: Tracks, camera: Camera) -> list[tuple[NDArray[Any], ...]]:
    """Target, frame, row, column, along and across of the pixels inside each target, from the affine map of its 25 points in
    each frame."""
    unit = np.linspace(-0.5, 0.5, Tracks.GRID)  # 1 at the panel's edge
    along, across = (g.ravel() for g in np.meshgrid(unit, unit, indexing="ij"))
    fit = np.linalg.pinv(np.stack([np.ones_like(along), along, across], -1))
    none, nowhere = np.zeros(0, np.int64), np.zeros(0)
    found: list[tuple[NDArray[Any], ...]] = [(none, none, none, none, nowhere, nowhere)]
    for t in range(len(tracks.targets)):
        where = np.stack([tracks.row[0, t], tracks.col[0, t]])  # (2, point, frame)
        seen = np.flatnonzero(np.isfinite(where).all(axis=(0, 1)))
        if not seen.size:
            continue
        centre, slope = _affine(fit, where[:, :, seen])
        half = float(np.median(np.linalg.norm(slope, axis=1)))
        reach = min(REACHES[-1], 1.0 - EDGE_PX / half)
        near = (centre > -half).all(axis=1) & (centre < [camera.rows + half, camera.cols + half]).all(axis=1)
        if reach <= 0.0 or not near.any():
            continue
        step = float(np.median(np.linalg.norm(np.diff(centre[near], axis=0), axis=1))) if near.sum() > 1 else 1.0
        thin = max(int((2.0 * reach * half) ** 2 / max(step, 1e-3) / MOST_PIXELS), 1)
        seen, centre, slope = seen[near][::thin], centre[near][::thin], slope[near][::thin]
        width = int(np.ceil(1.5 * reach * half)) + 1
        offset = np.arange(-width, width + 1)
        row = np.rint(centre[:, 0]).astype(np.int64)[:, None, None] + offset[:, None]
        col = np.rint(centre[:, 1]).astype(np.int64)[:, None, None] + offset[None, :]
        row, col = np.broadcast_arrays(row, col)
        off = np.stack([row - centre[:, 0, None, None], col - centre[:, 1, None, None]], -1)
        place = np.einsum("fij,frcj->frci", np.linalg.inv(slope), off)
        inside = (
            (np.abs(place).max(axis=-1) <= reach) & (row >= 0) & (row < camera.rows) & (col >= 0) & (col < camera.cols)
        )
        i, r, c = np.nonzero(inside)
        found.append((np.full(i.size, t), seen[i], row[i, r, c], col[i, r, c], *place[i, r, c].T))
    return found


def _affine(fit: Array, where: Array) -> tuple[Array, Array]:
    """Centre (frame, 2) and slope (frame, 2, 2), d(row, col)/d(along, across), of points `where` (2, point, frame) [px]."""
    c = np.einsum("kp,ipf->fik", fit, where)
    return c[..., 0], c[..., 1:]


def pixel_noise(pixels: PanelPixels) -> tuple[float, float]:
    """read² [DN²] and gain [DN] of var = read² + gain·signal, from differences of the same pixel in successive frames.

    Both see the same panel at the same path difference, so that neither flat nor fringes count in. Where hardly a pixel sees a
    panel twice, of pixels of one column (whose flat must then be right). Pooled by level: a variance of few samples is skewed.
    """
    apart = (np.diff(pixels.col) == 0) & (np.diff(pixels.target) == 0)
    same = np.flatnonzero(apart & (np.diff(pixels.row) == 0))
    if same.size < FEWEST_PAIRS:
        same = np.flatnonzero(apart)
    if same.size < FEWEST_PAIRS:
        return float(np.var(pixels.signal)), 0.0
    one, other = pixels.signal[same], pixels.signal[same + 1] * pixels.flat[same] / pixels.flat[same + 1]
    order = np.argsort(one + other)
    parts = np.array_split(order, max(same.size // FEWEST_PAIRS, 1))
    level = np.array([0.5 * (one[i] + other[i]).mean() for i in parts])
    variance = np.array([0.5 * np.mean((one[i] - other[i]) ** 2) for i in parts])
    return detector.photon_transfer(level, variance)


def reaches(pixels: PanelPixels, noise: tuple[float, float], targets: int) -> Array:
    """For each target (target,) how far out [half sides] its pixels see the panel alone; noise: read² and gain [DN]."""
    return np.array([_reach(pixels.part(pixels.target == t), noise) for t in range(targets)])


def _reach(one: PanelPixels, noise: tuple[float, float]) -> float:
    """Of one target: the largest of REACHES within which no strip differs from the middle."""
    value = one.signal / one.flat
    variance = (noise[0] + noise[1] * np.maximum(one.signal, 0.0)) / one.flat**2
    middle = one.distance <= REACHES[0]
    reached = REACHES[0]
    for reach in REACHES[1:]:
        inside = one.distance <= reach
        if not (one.distance > reached)[inside].any():
            break
        for side in (one.along, -one.along, one.across, -one.across):
            strip = inside & (side > max(reach - STRIP, REACHES[0]))
            if strip.any() and _differ(one.col, value, variance, strip, middle):
                return reached
        reached = reach
    return reached


def _differ(col: Index, value: Array, variance: Array, strip: NDArray[np.bool_], middle: NDArray[np.bool_]) -> bool:
    """χ² of the difference of the two means over all columns that have both."""
    total = []
    for chosen in (strip, middle):
        count = np.bincount(col[chosen], minlength=int(col.max()) + 1)
        sums = [np.bincount(col[chosen], a[chosen], count.size) for a in (value, variance)]
        total.append((count, sums[0] / np.maximum(count, 1), sums[1] / np.maximum(count, 1) ** 2))
    (n, mean, spread), (m, other, beside) = total
    both = (n > 0) & (m > 0)
    chi2 = float(np.sum((mean - other)[both] ** 2 / (spread + beside)[both]))
    return bool(both.any() and chdtrc(int(both.sum()), chi2) < CHANCE)
