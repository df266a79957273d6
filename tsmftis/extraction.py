"""Extraction: the interferogram of a ground point, column by column, out of the frames.

A column sees one OPD, so the value at a column is interpolated in time, between the two frames between which the point
crosses that column, and never along OPD, where fringes near Nyquist cannot be interpolated:

    I(c) = (1 − τ)·F_i(row_i, c) + τ·F_{i+1}(row_{i+1}, c),   τ = (c − col_i)/(col_{i+1} − col_i),

each frame read at the point's own row in it (roll moves it by several pixels a frame), linearly between rows. Jitter takes
a point over a column more than once: the crossings are averaged.

Functions
---------
along_tracks        interferograms of points whose tracks are given
over_cells          the same for many ground points, projected on the way
shared_gain         noise of a mean over points that read the same pixels
fill_gaps           the few unseen columns
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, inline="always")
def _columns(c0: float, c1: float, cols: int) -> Any:
    """First and last whole column in the half-open (low, high]: a column met exactly at a frame counts once."""
    low, high = (c0, c1) if c0 < c1 else (c1, c0)
    return max(int(np.floor(low)) + 1, 0), min(int(np.floor(high)), cols - 1)


@numba.njit(cache=True, nogil=True)
def _cross(
    frames: Any, k: int, r0: float, c0: float, r1: float, c1: float, value: Any, gain: Any, weight: Any, mean_row: Any
) -> None:
    """Add the columns crossed between frames k and k+1 of the block to one point's sums."""
    _, rows, cols = frames.shape
    if not (np.isfinite(c0) and np.isfinite(c1)) or c0 == c1:
        return
    if not (r0 >= 0.0 and r0 <= rows - 1 and r1 >= 0.0 and r1 <= rows - 1):
        return
    start, stop = _columns(c0, c1, cols)
    if start > stop:
        return
    a, b = min(int(r0), rows - 2), min(int(r1), rows - 2)
    u, v = r0 - a, r1 - b
    before = (1.0 - u) ** 2 + u * u
    after = (1.0 - v) ** 2 + v * v
    for c in range(start, stop + 1):
        tau = (c - c0) / (c1 - c0)
        total = (1.0 - tau) * ((1.0 - u) * frames[k, a, c] + u * frames[k, a + 1, c]) + tau * (
            (1.0 - v) * frames[k + 1, b, c] + v * frames[k + 1, b + 1, c]
        )
        if np.isfinite(total):
            value[c] += total
            gain[c] += (1.0 - tau) ** 2 * before + tau * tau * after
            weight[c] += 1.0
            mean_row[c] += (1.0 - tau) * r0 + tau * r1


@numba.njit(cache=True, nogil=True)
def along_tracks(
    frames: Any, first: int, row: Any, col: Any, value: Any, gain: Any, weight: Any, mean_row: Any
) -> None:
    """Add the crossings between consecutive frames of a block to the sums of points with known tracks.

    frames (f, rows, cols): corrected counts of frames first … first+f−1, NaN in bad or saturated pixels; row, col
    (point, frame): the whole tracks. In place, (point, cols) each: Σ value, Σ squared pixel weights, crossings, Σ row.
    """
    for p in range(row.shape[0]):
        for k in range(frames.shape[0] - 1):
            i = first + k
            _cross(
                frames, k, row[p, i], col[p, i], row[p, i + 1], col[p, i + 1], value[p], gain[p], weight[p], mean_row[p]
            )


@numba.njit(cache=True, nogil=True)
def over_cells(
    frames: Any,
    points: Any,
    centre: Any,
    dcm: Any,
    scale: float,
    row0: float,
    col0: float,
    k1: float,
    value: Any,
    gain: Any,
    weight: Any,
    mean_row: Any,
) -> None:
    """`along_tracks` for ground points (cell, 3) in ECEF, projected frame by frame instead of stored tracks.

    centre (f, 3), dcm (f, 3, 3): camera poses of the block's frames; scale = f/p [px].
    """
    for p in range(points.shape[0]):
        r0, c0 = np.nan, np.nan
        for k in range(frames.shape[0]):
            dx, dy, dz = points[p, 0] - centre[k, 0], points[p, 1] - centre[k, 1], points[p, 2] - centre[k, 2]
            z = dcm[k, 0, 2] * dx + dcm[k, 1, 2] * dy + dcm[k, 2, 2] * dz
            x = (dcm[k, 0, 0] * dx + dcm[k, 1, 0] * dy + dcm[k, 2, 0] * dz) / z
            y = (dcm[k, 0, 1] * dx + dcm[k, 1, 1] * dy + dcm[k, 2, 1] * dz) / z
            s = (1.0 + k1 * (x * x + y * y)) * scale
            r1, c1 = row0 + s * y, col0 - s * x
            if z <= 0.0:  # behind the camera
                c1 = np.nan
            if k > 0:
                _cross(frames, k - 1, r0, c0, r1, c1, value[p], gain[p], weight[p], mean_row[p])
            r0, c0 = r1, c1


@numba.njit(cache=True, nogil=True)
def shared_gain(row: Any, col: Any, chosen: Any, crossings: Any, rows: int, out: Any) -> None:
    """Noise gain (cols,) of the mean over the chosen points of one target, with the pixels they share counted once.

    row, col (point, frame); crossings (point, cols) as `along_tracks` counted them. var(mean) = out·var(pixel): the weights
    of each pixel are summed before they are squared, since neighbouring points read the same pixels.
    """
    points, frames = row.shape
    cols = crossings.shape[1]
    # Crossings by geometry alone: where a bad pixel took some of a column's away, the weights still share out over all.
    crossed = np.zeros((points, cols))
    for collect in range(2):
        if collect == 1:
            size = 4 * int(crossed.sum(axis=0).max())
            keys, weights = np.empty((cols, size), np.int64), np.empty((cols, size))
            filled = np.zeros(cols, np.int64)
        for p in range(points):
            if not chosen[p]:
                continue
            for i in range(frames - 1):
                r0, c0, r1, c1 = row[p, i], col[p, i], row[p, i + 1], col[p, i + 1]
                if not (np.isfinite(c0) and np.isfinite(c1)) or c0 == c1:
                    continue
                if not (r0 >= 0.0 and r0 <= rows - 1 and r1 >= 0.0 and r1 <= rows - 1):
                    continue
                start, stop = _columns(c0, c1, cols)
                a, b = min(int(r0), rows - 2), min(int(r1), rows - 2)
                u, v = r0 - a, r1 - b
                for c in range(start, stop + 1):
                    if crossings[p, c] == 0:
                        continue
                    if collect == 0:
                        crossed[p, c] += 1.0
                        continue
                    n = filled[c]
                    tau = (c - c0) / (c1 - c0)
                    scale = 1.0 / (crossed[p, c] * chosen.sum())
                    keys[c, n], weights[c, n] = i * rows + a, scale * (1.0 - tau) * (1.0 - u)
                    keys[c, n + 1], weights[c, n + 1] = i * rows + a + 1, scale * (1.0 - tau) * u
                    keys[c, n + 2], weights[c, n + 2] = (i + 1) * rows + b, scale * tau * (1.0 - v)
                    keys[c, n + 3], weights[c, n + 3] = (i + 1) * rows + b + 1, scale * tau * v
                    filled[c] = n + 4
    for c in range(cols):
        n = filled[c]
        order = np.argsort(keys[c, :n])
        total, run = 0.0, 0.0
        for j in range(n):
            run += weights[c, order[j]]
            if j == n - 1 or keys[c, order[j + 1]] != keys[c, order[j]]:
                total += run * run
                run = 0.0
        out[c] = total


def fill_gaps(value: Array, seen: NDArray[np.bool_]) -> Array:
    """Interferograms (point, cols) with the few unseen columns interpolated linearly from their neighbours."""
    filled = value.copy()
    columns = np.arange(value.shape[1])
    for p in np.flatnonzero(~seen.all(axis=1) & seen.any(axis=1)):
        filled[p, ~seen[p]] = np.interp(columns[~seen[p]], columns[seen[p]], value[p, seen[p]])
    return filled
