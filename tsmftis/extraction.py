"""Extraction: the interferogram of a ground point, column by column, out of the frames.

A column sees one OPD, so the value at a column is interpolated in time, between the two frames between which the point
crosses that column, and never along OPD, where fringes near Nyquist cannot be interpolated:

    I(c) = (1 − τ)·F_i(row_i, c) + τ·F_{i+1}(row_{i+1}, c),   τ = (c − col_i)/(col_{i+1} − col_i),

each frame read at the point's own row in it (roll moves it by several pixels a frame), linearly between rows. Such a value
has g = (1 − τ)²·((1 − u)² + u²) + τ²·((1 − v)² + v²) times a pixel's variance, u and v the fractions of the two rows.
Jitter takes a point over a column more than once: the crossings are averaged with the weights 1/g.

Frames are corrected counts (row, frame, col), NaN in bad and saturated pixels: with the frames of a row side by side a
point's way through them lies close together in memory (a sixth faster than frame by frame).

Functions
---------
along_tracks        sums over crossings for points whose tracks are given
over_cells          the same for many ground points, projected on the way
means               mean interferograms out of many cells' sums
nearest_pixels      the other way: in each frame the pixel that the point lies in
gain_of_mean, gain_of_nearest   noise of a mean over crossings and points, pixels that they share counted once
band_precision, fill_gaps   columns not seen, by what a band-limited interferogram must be there
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Channels of the sums: Σ value/g, Σ 1/g and, where they are asked for, Σ row/g and the number of crossings.
CHANNELS = 4
_FAST = {"contract", "nsz", "arcp", "reassoc"}  # NaN stays NaN
_ONE = np.float32(1.0)


@numba.njit(inline="always")
def _gain(t: Any, u: Any, v: Any) -> Any:
    """g of a crossing at the fraction t between frames read at the fractions u and v between rows."""
    q = _ONE - t
    return q * q * ((_ONE - u) * (_ONE - u) + u * u) + t * t * ((_ONE - v) * (_ONE - v) + v * v)


@numba.njit(inline="always")
def _within(row: Any, col: Any, rows: int) -> Any:
    """The column, NaN where the row is not on the detector."""
    return col if (row >= 0.0) & (row <= rows - 1.0) else np.nan


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _cross(
    frames: Any, k: int, r0: Any, c0: Any, r1: Any, c1: Any, crossed: Any, place: Any, share: Any, sums: Any
) -> None:
    """Add the columns that points (n,) cross between frames k−1 and k to their sums (n, cols, channels).

    r0, c0, r1, c1 (n,): where they are in the two frames, columns NaN where the row is off the detector (`_within`). crossed
    (n,), place (3, n), share (5, n) are workspace: all that is arithmetic is done first, without branches, so that the compiler
    makes vector instructions of it.
    """
    rows, count, cols = frames.shape
    channels = sums.shape[2]
    plane = count * cols
    top = rows - 1.0
    some = 0
    for i in range(c0.size):
        a0, a1 = c0[i], c1[i]
        # The columns in the half-open (low, high]: one met exactly at a frame counts once.
        low = np.floor(max(min(a0, a1), -1.0))
        high = np.floor(min(max(a0, a1), cols - 1.0))
        crossed[i] = np.int32(max(high - low, 0.0)) if abs(a1 - a0) < cols else np.int32(0)
        some += crossed[i]
    if some == 0:  # the frames in which no point is on the detector end here
        return
    for i in range(c0.size):
        a0, a1, ra, rb = c0[i], c1[i], r0[i], r1[i]
        column = np.floor(max(min(a0, a1), -1.0)) + 1.0
        fa, fb = min(max(np.floor(ra), 0.0), top - 1.0), min(max(np.floor(rb), 0.0), top - 1.0)
        step = 1.0 / (a1 - a0)
        share[0, i], share[1, i] = np.float32(ra - fa), np.float32(rb - fb)
        share[2, i], share[3, i] = np.float32((column - a0) * step), np.float32(step)
        place[0, i] = np.int32(fa * plane + ((k - 1) * cols + column))
        place[1, i] = np.int32(fb * plane + (k * cols + column))
        place[2, i] = np.int32(column)
    for i in range(c0.size):  # alone, so that all of a vector's lanes are float32
        share[4, i] = _ONE / _gain(share[2, i], share[0, i], share[1, i])
    pixel, out = frames.reshape(-1), sums.reshape(-1)
    for i in range(c0.size):
        u, v, t, step, weight = share[0, i], share[1, i], share[2, i], share[3, i], share[4, i]
        # Unsigned: a negative index would be looked for at every access.
        a, b = np.uint64(place[0, i]), np.uint64(place[1, i])
        o = np.uint64((i * cols + place[2, i]) * channels)
        for m in range(crossed[i]):
            if m > 0:
                t += step
                weight = _ONE / _gain(t, u, v)
                a += np.uint64(1)
                b += np.uint64(1)
                o += np.uint64(channels)
            before = pixel[a] + u * (pixel[a + np.uint64(plane)] - pixel[a])
            after = pixel[b] + v * (pixel[b + np.uint64(plane)] - pixel[b])
            value = before + t * (after - before)
            if value == value:
                out[o] += weight * value
                out[o + np.uint64(1)] += weight
                if channels > 2:
                    out[o + np.uint64(2)] += weight * (r0[i] + t * (r1[i] - r0[i]))
                    out[o + np.uint64(3)] += 1.0


@numba.njit(cache=True, nogil=True)
def along_tracks(frames: Any, first: int, row: Any, col: Any, sums: Any) -> None:
    """Add the crossings between consecutive frames of a block to the sums (point, cols, `CHANNELS`), in place.

    frames (rows, f, cols): the frames first … first+f−1; row, col (point, frame): the whole tracks [px], NaN where unknown.
    """
    points = row.shape[0]
    crossed, place, share = (
        np.empty(points, np.int32),
        np.empty((3, points), np.int32),
        np.empty((5, points), np.float32),
    )
    r0, c0, r1, c1 = np.empty(points), np.empty(points), np.empty(points), np.empty(points)
    for k in range(frames.shape[1]):
        r0, r1 = r1, r0
        c0, c1 = c1, c0
        for i in range(points):
            r1[i] = row[i, first + k]
            c1[i] = _within(r1[i], col[i, first + k], frames.shape[0])
        if k > 0:
            _cross(frames, k, r0, c0, r1, c1, crossed, place, share, sums)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def over_cells(
    frames: Any, points: Any, centre: Any, dcm: Any, scale: float, row0: float, col0: float, k1: float, sums: Any
) -> None:
    """`along_tracks` for ground points (3, across, along) in ECEF [m], projected frame by frame instead of stored tracks.

    centre (f, 3), dcm (f, 3, 3): camera poses (C_camera→ECEF) of the block's frames; scale = f/p [px]; sums (across, along,
    cols, channels). Points along the flight direction side by side fall on neighbouring pixels of one row.
    """
    across, along = points.shape[1:]
    crossed, place, share = np.empty(along, np.int32), np.empty((3, along), np.int32), np.empty((5, along), np.float32)
    r0, c0, r1, c1 = np.empty(along), np.empty(along), np.empty(along), np.empty(along)
    for j in range(across):
        px, py, pz = points[0, j], points[1, j], points[2, j]
        for k in range(frames.shape[1]):
            r0, r1 = r1, r0
            c0, c1 = c1, c0
            ox, oy, oz = centre[k, 0], centre[k, 1], centre[k, 2]
            m = dcm[k]
            xx, xy, xz, yx, yy, yz = m[0, 0], m[1, 0], m[2, 0], m[0, 1], m[1, 1], m[2, 1]
            zx, zy, zz = m[0, 2], m[1, 2], m[2, 2]
            for i in range(along):
                dx, dy, dz = px[i] - ox, py[i] - oy, pz[i] - oz
                z = zx * dx + zy * dy + zz * dz
                x = (xx * dx + xy * dy + xz * dz) / z
                y = (yx * dx + yy * dy + yz * dz) / z
                s = (1.0 + k1 * (x * x + y * y)) * scale
                r1[i] = row0 + s * y
                c1[i] = _within(r1[i], col0 - s * x if z > 0.0 else np.nan, frames.shape[0])  # NaN behind the camera
            if k > 0:
                _cross(frames, k, r0, c0, r1, c1, crossed, place, share, sums[j])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def means(sums: Any, value: Any, row: Any, seen: Any) -> None:
    """Of sums (point, cols, channels), in place: values less each point's own mean, rows where they are summed, (point, cols)
    both and zero where a column was not seen; the number of columns seen (point,).

    The mean goes first because float32 products would see little else; it holds no light of the instrument's band.
    """
    points, cols, channels = sums.shape
    for p in range(points):
        total, count = 0.0, 0
        for c in range(cols):
            weight = sums[p, c, 1]
            if weight > 0.0:
                value[p, c] = sums[p, c, 0] / weight
                total += value[p, c]
                count += 1
                if channels > 2:
                    row[p, c] = sums[p, c, 2] / weight
        seen[p] = count
        mean = np.float32(total / max(count, 1))
        for c in range(cols):
            value[p, c] = value[p, c] - mean if sums[p, c, 1] > 0.0 else np.float32(0.0)


@numba.njit(cache=True, nogil=True)
def nearest_pixels(frames: Any, first: int, row: Any, col: Any, sums: Any) -> None:
    """Add, frame by frame, the pixel that a point lies in to the sums (point, cols, `CHANNELS`) of that pixel's column.

    frames, row, col as `along_tracks`, but each frame counts alone. The pixel's own row goes into the sums, since its OPD is
    that of the pixel that was read, never that of the point's fractional position. Columns that no frame hit stay empty.
    """
    rows, count, cols = frames.shape
    for p in range(row.shape[0]):
        for k in range(count):
            if not (np.isfinite(row[p, first + k]) and np.isfinite(col[p, first + k])):
                continue
            r, c = int(np.round(row[p, first + k])), int(np.round(col[p, first + k]))
            if not (0 <= r < rows and 0 <= c < cols):
                continue
            value = frames[r, k, c]
            if value == value:
                sums[p, c, 0] += value
                sums[p, c, 1] += 1.0
                sums[p, c, 2] += r
                sums[p, c, 3] += 1.0


@numba.njit(cache=True, nogil=True)
def gain_of_mean(row: Any, col: Any, share: Any, crossings: Any, rows: int, out: Any) -> None:
    """Noise gain (cols,) of Σ share_p·I_p over points p, in place, with the pixels that crossings and points share counted once.

    row, col (point, frame); share (point,), 0 for points left out; crossings (point, cols) as `along_tracks` counted them.
    var(mean) = out·var(pixel): the weights of each pixel are summed before they are squared, since neighbouring points read
    the same pixels, and so does a point that turns back upon a column.
    """
    points, frames = row.shape
    cols = crossings.shape[1]
    # Crossings by geometry alone: where a bad pixel took some of a column's away, the weights still share out over all.
    crossed, total = np.zeros((points, cols)), np.zeros((points, cols))
    keys, weights = np.empty((0, 0), np.int64), np.empty((0, 0))
    filled = np.zeros(cols, np.int64)
    for collect in range(2):
        if collect == 1:
            size = 4 * int(crossed.sum(axis=0).max())
            keys, weights = np.empty((cols, size), np.int64), np.empty((cols, size))
        for p in range(points):
            if share[p] == 0.0:
                continue
            for i in range(frames - 1):
                r0, c0, r1, c1 = row[p, i], col[p, i], row[p, i + 1], col[p, i + 1]
                if not (abs(c1 - c0) < cols) or c0 == c1:
                    continue
                if not (r0 >= 0.0 and r0 <= rows - 1 and r1 >= 0.0 and r1 <= rows - 1):
                    continue
                start, stop = max(int(np.floor(min(c0, c1))) + 1, 0), min(int(np.floor(max(c0, c1))), cols - 1)
                a, b = min(int(r0), rows - 2), min(int(r1), rows - 2)
                u, v = r0 - a, r1 - b
                for c in range(start, stop + 1):
                    if crossings[p, c] == 0:
                        continue
                    t = (c - c0) / (c1 - c0)
                    weight = 1.0 / _gain(t, u, v)
                    if collect == 0:
                        crossed[p, c] += 1.0
                        total[p, c] += weight
                        continue
                    n = filled[c]
                    scale = share[p] * weight / total[p, c]
                    keys[c, n], weights[c, n] = i * rows + a, scale * (1.0 - t) * (1.0 - u)
                    keys[c, n + 1], weights[c, n + 1] = i * rows + a + 1, scale * (1.0 - t) * u
                    keys[c, n + 2], weights[c, n + 2] = (i + 1) * rows + b, scale * t * (1.0 - v)
                    keys[c, n + 3], weights[c, n + 3] = (i + 1) * rows + b + 1, scale * t * v
                    filled[c] = n + 4
    _square_sums(keys, weights, filled, out)


@numba.njit(cache=True, nogil=True)
def gain_of_nearest(row: Any, col: Any, share: Any, rows: int, out: Any) -> None:
    """`gain_of_mean` for interferograms by `nearest_pixels`."""
    points, frames = row.shape
    cols = out.size
    count = np.zeros((points, cols))
    keys, weights = np.empty((0, 0), np.int64), np.empty((0, 0))
    filled = np.zeros(cols, np.int64)
    for collect in range(2):
        if collect == 1:
            size = int(count.sum(axis=0).max())
            keys, weights = np.empty((cols, size), np.int64), np.empty((cols, size))
        for p in range(points):
            for i in range(frames):
                if share[p] == 0.0 or not (np.isfinite(row[p, i]) and np.isfinite(col[p, i])):
                    continue
                r, c = int(np.round(row[p, i])), int(np.round(col[p, i]))
                if not (0 <= r < rows and 0 <= c < cols):
                    continue
                if collect == 0:
                    count[p, c] += 1.0
                    continue
                keys[c, filled[c]], weights[c, filled[c]] = i * rows + r, share[p] / count[p, c]
                filled[c] += 1
    _square_sums(keys, weights, filled, out)


@numba.njit(cache=True, nogil=True)
def _square_sums(keys: Any, weights: Any, filled: Any, out: Any) -> None:
    """For each column the sum over its different keys of (sum of the key's weights)²."""
    for c in range(filled.size):
        n = filled[c]
        order = np.argsort(keys[c, :n])
        square, run = 0.0, 0.0
        for j in range(n):
            run += weights[c, order[j]]
            if j == n - 1 or keys[c, order[j + 1]] != keys[c, order[j]]:
                square += run * run
                run = 0.0
        out[c] = square


def band_precision(opd: Array, low: float, high: float, noise: float = 1e-3) -> Array:
    """Inverse covariance (n, n) of an interferogram (n,) of unit variance whose spectrum lies in low … high [m-1].

    K(x, x′) = ∫ cos(2πσ(x − x′)) dσ/(high − low) over the band, a constant and slope of any size, `noise` the variance of white
    noise. A smooth texture of the scene, which lies below the band, counts with a hundredth. opd (n,) [m].
    """

    def band(a: float, b: float) -> Array:
        d = opd[:, None] - opd[None, :]
        return (b * np.sinc(2.0 * b * d) - a * np.sinc(2.0 * a * d)) / (b - a)

    u = (opd - opd.mean()) / np.ptp(opd) * 2.0
    covariance = band(low, high) + 0.01 * band(0.0, 0.1 * low) + 1e3 * (1.0 + np.outer(u, u))
    return np.asarray(np.linalg.inv(covariance + noise * np.eye(opd.size)), float)


def fill_gaps(value: NDArray[Any], seen: NDArray[np.bool_], precision: Array) -> NDArray[Any]:
    """Interferograms (point, cols) with their unseen columns as the seen ones predict them: E(x_m | x_s) = −Q_mm⁻¹·Q_ms·x_s.

    precision Q (cols, cols) as from `band_precision`. Against a straight line between the neighbours, which fails where
    fringes come near Nyquist, the band is kept; for the columns seen this is the least-squares spectrum of a non-uniform
    interferogram. Points that are nowhere seen stay as they are.
    """
    filled = value.copy()
    for p in np.flatnonzero(~seen.all(axis=1) & seen.any(axis=1)):
        missing = ~seen[p]
        q = precision[missing]
        filled[p, missing] = np.linalg.solve(q[:, missing], -q[:, ~missing] @ value[p, ~missing])
    return filled
