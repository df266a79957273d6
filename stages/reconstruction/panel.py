"""The best mean over a whole panel: every point of it, weighted by its noise and by what it sees of the surroundings.

A sample is a pixel (a box one pixel wide) interpolated linearly over one more on either side, a response of variance ¼ px²
(the quadratic B-spline of width 3 px) widened by the optics' and the frame's blur w: taken as a Gaussian of variance ¼ + w².
w is fitted to the line's own panels, to the step of the mean signal across their edges.

With f the fraction of a point's response outside the panel, c the contrast of the surroundings and s² the noise variance, the
mean Σ w·I with Σ w = 1 that has the least variance plus squared bias, s²·Σ w² + c²·(Σ w·f)², is

    w ∝ 1 − f·c²·Σf/(s² + c²·Σf²),   points of negative weight left out in turn.

The mean of the scored area takes its 25 points as they are; what of it jitter lets be read beyond the edge goes into its sigma
(`read_outside`, `variance_of_outside`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pipeline.records import Tracks
from stages.reconstruction.interferograms import Extracted

Array = NDArray[Any]

MARGIN_PX = 3.5  # around the panel: farther out, a point sees nothing of it
MOST_A_SIDE = 41
BLURS_PX = np.arange(0.0, 2.01, 0.125)


@dataclass(frozen=True)
class PanelPoints:
    """Tracks row, col (point, frame) [px] of points over a panel and around it; place (point, 2): where they lie from its
    centre along and across [px]; half (2,): its half sides [px]."""

    row: Array
    col: Array
    place: Array
    half: Array

    def inside(self, blur: float) -> Array:
        """Fraction of each point's response within the panel, for a blur w [px]."""
        s = np.sqrt(0.25 + blur**2)
        return np.prod(ndtr((self.place + self.half) / s) - ndtr((self.place - self.half) / s), axis=1)


def panel_points(row: Array, col: Array) -> PanelPoints:
    """A grid of points about one pixel apart, from the tracks (25, frame) of the area's 5 × 5 points.

    A quadratic in the two coordinates on the ground through the 25 carries the tracks on to the edges, at twice their
    distance (what projection adds beyond is below 1e-3 px).
    """
    unit = np.linspace(-0.5, 0.5, Tracks.GRID)  # 1 at the panel's edge
    along, across = (g.ravel() for g in np.meshgrid(unit, unit, indexing="ij"))
    fit = np.linalg.pinv(_quadratic(along, across))
    # Half the panel's sides [px]: how far a unit carries in each direction.
    seen = np.isfinite(row).all(axis=0) & np.isfinite(col).all(axis=0)
    if not seen.any():
        empty = np.empty((0, row.shape[1]))
        return PanelPoints(empty, empty, np.empty((0, 2)), np.ones(2))
    slope = np.stack([(fit @ row[:, seen])[1:3].mean(axis=1), (fit @ col[:, seen])[1:3].mean(axis=1)])
    half = np.maximum(np.linalg.norm(slope, axis=0), 0.1)
    sides = [np.linspace(-1.0, 1.0, n) * (h + MARGIN_PX) for h, n in zip(half, _counts(half), strict=True)]
    a, x = (g.ravel() for g in np.meshgrid(*sides, indexing="ij"))
    carry = _quadratic(a / half[0], x / half[1]) @ fit
    return PanelPoints(carry @ row, carry @ col, np.stack([a, x], -1), half)


def read_outside(row: Array, col: Array, share: Array, cols: int) -> Array:
    """Fraction (cols,) of the mean Σ share_p·I_p of an area's points that is read outside its panel.

    row, col (25, frame): tracks, NaN where nothing may be interpolated across. A sample lies between two frames, and in each its
    pixel lies (column − col) beside the point: where jitter carries a point several pixels in one frame, that is beyond the
    edge for points half-way to it. A pixel is a box; the blur fitted to the edges holds these very steps and would count them
    twice. Crossings of one column weigh the same.
    """
    seen = np.isfinite(row).all(axis=0) & np.isfinite(col).all(axis=0)
    if not seen.any():
        return np.zeros(cols)
    unit = np.linspace(-0.5, 0.5, Tracks.GRID)
    along, across = (g.ravel() for g in np.meshgrid(unit, unit, indexing="ij"))
    fit = np.linalg.pinv(np.stack([np.ones_like(along), along, across], -1))[1:]
    slope = np.stack([(fit @ row[:, seen]).mean(axis=1), (fit @ col[:, seen]).mean(axis=1)])
    beside = np.linalg.pinv(slope)[:, 1]  # half sides a column
    h = 0.5 / np.maximum(np.linalg.norm(slope, axis=0), 0.1)  # half a pixel

    def inside(point: Array, shift: Array) -> Array:
        at = np.stack([along[point], across[point]], -1) + shift[:, None] * beside
        return np.prod(np.clip(np.minimum(at + h, 1.0) - np.maximum(at - h, -1.0), 0.0, None) / (2.0 * h), axis=1)

    before, after = col[:, :-1], col[:, 1:]
    low = np.floor(np.maximum(np.fmin(before, after), -1.0))
    number = np.floor(np.minimum(np.fmax(before, after), cols - 1.0)) - low
    crossed = (number > 0) & (np.abs(after - before) < cols) & (share[:, None] > 0.0)
    point, frame = np.nonzero(crossed)
    times = number[crossed].astype(int)
    point, frame = np.repeat(point, times), np.repeat(frame, times)
    first = np.repeat(np.cumsum(times) - times, times)
    column = low[point, frame] + 1.0 + np.arange(point.size) - first
    start, end = before[point, frame], after[point, frame]
    t = (column - start) / (end - start)
    outside = 1.0 - (1.0 - t) * inside(point, column - start) - t * inside(point, column - end)
    sample = point * cols + column.astype(int)
    sums, counts = (np.bincount(sample, w, row.shape[0] * cols).reshape(-1, cols) for w in (outside, np.ones_like(t)))
    return np.asarray(share @ (sums / np.maximum(counts, 1.0)))


def ground_less_panel(points: PanelPoints, extracted: Extracted, blur: float) -> Array:
    """Interferograms (point, col) [DN] of the points around a panel, less the panel's own; none where either was not seen."""
    inside = points.inside(blur)
    panel, ground = (extracted.counted & which for which in (inside > 0.98, inside < 0.02))
    if not (panel.any() and ground.any()):
        return np.empty((0, extracted.value.shape[1]))
    return np.asarray(extracted.value[ground] - extracted.value[panel].mean(axis=0))


def variance_of_outside(outside: Array, ground: Array) -> Array:
    """Variance (col,) [DN²] of what a mean reads outside its panel: of outside·ground over the points of `ground` (point, col).

    A constant, which the spectrum does not see, is left out; without ground, none."""
    if not len(ground):
        return np.zeros_like(outside)
    error = outside * ground
    return np.asarray(((error - error.mean(axis=1, keepdims=True)) ** 2).mean(axis=0))


def _quadratic(a: Array, x: Array) -> Array:
    return np.stack([np.ones_like(a), a, x, a * a, a * x, x * x], -1)


def _counts(half: Array) -> list[int]:
    return [min(int(np.ceil(2.0 * (h + MARGIN_PX))) + 1, MOST_A_SIDE) for h in half]


def fitted_blur(panels: list[PanelPoints], levels: list[Array]) -> float:
    """The blur w [px] with which level = ground + contrast·inside fits best, over all panels of a line.

    levels: mean signal of each panel's points (point,), NaN where not seen. A panel's misfit counts relative to its least, so
    that one among a rough ground says little; without any panel that tells, half a pixel.
    """
    total = np.zeros(BLURS_PX.size)
    for panel, level in zip(panels, levels, strict=True):
        seen = np.isfinite(level)
        if seen.sum() < 25:
            continue
        misfit = np.empty(BLURS_PX.size)
        for i, blur in enumerate(BLURS_PX):
            design = np.stack([np.ones(int(seen.sum())), panel.inside(float(blur))[seen]], -1)
            misfit[i] = np.sum((level[seen] - design @ np.linalg.lstsq(design, level[seen])[0]) ** 2)
        if misfit.min() > 0.0:
            total += seen.sum() * np.log(misfit / misfit.min())
    return float(BLURS_PX[total.argmin()]) if total.any() else 0.5


def pair_noise(panel: PanelPoints, extracted: Extracted, blur: float) -> tuple[Array, Array]:
    """Signal [DN] and pixel variance [DN²] (pair,) by pairs of points inside a flat panel that share no pixel.

    Two such points in one column see the same light: the variance of their difference, less its regression on a constant and
    their mean (a panel lit unevenly), is (g₁ + g₂)·var, whatever the scene around them does. Empty where a panel has no pair.
    """
    inside = np.flatnonzero(extracted.counted & (panel.inside(blur) > 0.99))
    signal, variance = [], []
    for i in inside:
        apart = panel.place[inside] - panel.place[i]
        near = (np.abs(apart[:, 0]) < 0.5) & (apart[:, 1] > 2.0) & (apart[:, 1] < 3.5)
        for j in inside[near]:
            difference = extracted.value[i] - extracted.value[j]
            mean = 0.5 * (extracted.value[i] + extracted.value[j])
            design = np.stack([np.ones_like(mean), mean], -1)
            left = difference - design @ np.linalg.lstsq(design, difference)[0]
            signal.append(float(mean.mean()))
            variance.append(float(left @ left / (left.size - 2) / (extracted.gain[i] + extracted.gain[j]).mean()))
    return np.array(signal), np.array(variance)


def best_weights(inside: Array, contrast: float, variance: float) -> Array:
    """Weights (point,) of the best mean; contrast [DN, root mean square], variance of one point's samples [DN²]."""
    outside = 1.0 - inside
    used = inside > 0.5
    if not used.any():
        used = inside >= inside.max()
    weight = np.zeros_like(inside)
    while True:
        f = outside[used]
        w = 1.0 - f * contrast**2 * f.sum() / (variance + contrast**2 * (f @ f))
        if (w > 0.0).all():
            weight[used] = w / w.sum()
            return weight
        used[np.flatnonzero(used)[w <= 0.0]] = False
