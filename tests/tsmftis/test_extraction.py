"""Extraction against a slow reference that walks every crossing in plain Python, and its noise against Monte Carlo."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tsmftis import extraction

ROWS, COLS, FRAMES = 24, 40, 120


def jittered(points: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Tracks that run over the detector, forwards and back, some beyond the rows, one with a hole, one standing still."""
    rng = np.random.default_rng(seed)
    frame = np.arange(FRAMES)
    col = -6.0 + 0.45 * frame + rng.uniform(-4, 4, (points, 1)) + 0.9 * rng.standard_normal((points, FRAMES))
    row = rng.uniform(2, 20, (points, 1)) + 2.0 * np.sin(frame / 7.0) + 0.7 * rng.standard_normal((points, FRAMES))
    row[1] += 12.0  # leaves the rows
    row[2, 50:58], col[2, 50:58] = np.nan, np.nan
    col[3, 60:64] = 17.0  # stands exactly on a column
    row[4] = np.round(row[4])
    row[4] = np.clip(row[4], 0, ROWS - 1)  # the very last row counts
    return row, col


def images(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    frames = rng.uniform(100, 9000, (FRAMES, ROWS, COLS)).astype(np.float32)
    frames[rng.random(frames.shape) < 0.003] = np.nan
    return frames


def slowly(frames: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """For every pair of frames and every column c with min < c ≤ max: the linear mixture over its squared weights' sum, …"""
    out = np.zeros((len(row), COLS, 4))
    for p in range(len(row)):
        for i in range(len(frames) - 1):
            (c0, c1), (r0, r1) = col[p, i : i + 2], row[p, i : i + 2]
            if math.isnan(c0) or math.isnan(c1) or c0 == c1:
                continue
            if not (0 <= r0 <= ROWS - 1 and 0 <= r1 <= ROWS - 1):
                continue
            for c in range(COLS):
                if not min(c0, c1) < c <= max(c0, c1):
                    continue
                tau = (c - c0) / (c1 - c0)
                weights: dict[tuple[int, int], float] = {}
                for k, r, share in ((i, r0, 1 - tau), (i + 1, r1, tau)):
                    low = min(math.floor(r), ROWS - 2)
                    weights[k, low] = share * (1 - (r - low))
                    weights[k, low + 1] = share * (r - low)
                value = sum(w * float(frames[k, r, c]) for (k, r), w in weights.items())
                if not math.isnan(value):
                    share = 1 / sum(w * w for w in weights.values())
                    out[p, c] += share * value, share, share * ((1 - tau) * r0 + tau * r1), 1
    return out


def by_row(frames: np.ndarray) -> np.ndarray:
    """(row, frame, col), as extraction reads them."""
    return np.ascontiguousarray(frames.swapaxes(0, 1))


def quickly(frames: np.ndarray, row: np.ndarray, col: np.ndarray, block: int = FRAMES) -> np.ndarray:
    out = np.zeros((len(row), COLS, extraction.CHANNELS))
    for first in range(0, FRAMES - 1, block):
        extraction.along_tracks(by_row(frames[first : first + block + 1]), first, row, col, out)
    return out


def test_extraction_is_the_plain_reference() -> None:
    """Float32 arithmetic: 5e-6 relative. NaN pixels, holes, exact columns, the last row included."""
    row, col = jittered(12, 1)
    frames = images(2)
    fast, slow = quickly(frames, row, col), slowly(frames, row, col)
    np.testing.assert_array_equal(fast[..., 3], slow[..., 3])
    np.testing.assert_allclose(fast, slow, rtol=5e-6, atol=1e-9)
    assert slow[..., 3].max() >= 3  # jitter did take points over a column again and again
    assert (slow[1, :, 3] == 0).any()  # and one did leave the rows


def test_blocks_that_overlap_by_one_frame_give_the_whole() -> None:
    row, col = jittered(8, 3)
    frames = images(4)
    np.testing.assert_allclose(quickly(frames, row, col, 17), quickly(frames, row, col), rtol=1e-12)


def test_ground_points_projected_on_the_way_give_the_same() -> None:
    """Poses of a wobbling camera over a plane: tracks by Camera.project, then both ways (rounding of 6 400 km: 1e-6)."""
    from scipy.spatial.transform import Rotation

    from tsmftis.camera import Camera

    rng = np.random.default_rng(5)
    camera = Camera(ROWS, COLS, 15e-6, 0.05, 11.3, 19.8, 100.0, 16383.0, 0.4)
    centre = np.stack([0.13 * np.arange(FRAMES), np.zeros(FRAMES), np.full(FRAMES, -1000.0)], -1)
    angles = 1e-4 * rng.standard_normal((FRAMES, 3))
    dcm = Rotation.from_rotvec(angles).as_matrix()
    points = np.stack([rng.uniform(3, 14, (5, 6)), rng.uniform(-2, 2, (5, 6)), np.zeros((5, 6))])
    sight = np.moveaxis(points.reshape(3, 30), 0, 1)[:, None, :] - centre
    row, col = camera.project(np.einsum("fij,pfi->pfj", dcm, sight))
    frames = images(6)
    want = quickly(frames, row, col)
    got = np.zeros((5, 6, COLS, 4))
    extraction.over_cells(by_row(frames), points, centre, dcm, 0.05 / 15e-6, 11.3, 19.8, 0.4, got)
    assert want[..., 3].sum() > 300
    np.testing.assert_allclose(got.reshape(30, COLS, 4), want, rtol=1e-5, atol=1e-6)
    short = np.zeros((5, 6, COLS, 2), np.float32)
    extraction.over_cells(by_row(frames), points, centre, dcm, 0.05 / 15e-6, 11.3, 19.8, 0.4, short)
    np.testing.assert_allclose(short, got[..., :2], rtol=1e-5)


def test_points_behind_the_camera_are_not_seen() -> None:
    """Above a camera that looks down, straight over it: the projection alone would put it at mid-detector."""
    centre, dcm = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
    centre[:, 0] = 0.1 * np.arange(3)
    sums = np.zeros((1, 1, COLS, 4))
    for depth, seen in ((1.0, True), (-1.0, False)):
        points = np.array([0.05, 0.0, depth]).reshape(3, 1, 1)
        extraction.over_cells(by_row(images(1)[:3]), points, centre, dcm, 60.0, 11.3, 19.8, 0.0, sums)
        assert (sums[..., 3].sum() > 0) == seen
        sums[:] = 0.0


def area_tracks() -> tuple[np.ndarray, np.ndarray]:
    """Six neighbouring points on one jittering track: they share pixels."""
    rng = np.random.default_rng(7)
    frame = np.arange(FRAMES)
    col = -4.0 + 0.4 * frame + 0.5 * rng.standard_normal(FRAMES) + 0.3 * np.arange(6)[:, None]
    row = 10.0 + 0.8 * np.sin(frame / 5.0) + 0.25 * np.arange(6)[:, None]
    return row, col


def mean_interferogram(
    frames: np.ndarray, row: np.ndarray, col: np.ndarray, nearest: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over points of their means over crossings, and the number of crossings."""
    sums = quickly(frames, row, col)
    if nearest:
        sums[:] = 0.0
        extraction.nearest_pixels(by_row(frames), 0, row, col, sums)
    return (sums[..., 0] / np.maximum(sums[..., 1], 1e-9)).mean(axis=0), sums[..., 3]


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("points", [1, 6])
def test_gain_is_the_variance_of_the_mean(points: int, nearest: bool) -> None:
    """The same by linearity: the mean's weight on each pixel, found by reading unit frames, squared and summed (rounding).

    And 400 frames of white noise: a variance known to 7 % a column, 0.2 × that over all: 5 %.
    """
    row, col = (a[:points] for a in area_tracks())
    rng = np.random.default_rng(8)
    blank = np.zeros((FRAMES, ROWS, COLS), np.float32)
    _, crossings = mean_interferogram(blank, row, col, nearest)
    gain, share = np.zeros(COLS), np.full(points, 1.0 / points)
    if nearest:
        extraction.gain_of_nearest(row, col, share, ROWS, gain)
    else:
        extraction.gain_of_mean(row, col, share, crossings, ROWS, gain)
    exact = np.zeros(COLS)
    for f in range(FRAMES):
        for r in range(7, 15):
            unit = blank.copy()
            unit[f, r] = 1.0
            exact += mean_interferogram(unit, row, col, nearest)[0] ** 2
    full = (crossings > 0).all(axis=0)
    assert full.sum() > 25
    np.testing.assert_allclose(gain[full], exact[full], rtol=1e-5)
    noise = (rng.standard_normal(blank.shape).astype(np.float32) for _ in range(400))
    draws = [mean_interferogram(frames, row, col, nearest)[0] for frames in noise]
    ratio = np.var(draws, axis=0)[full] / gain[full]
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)


def test_crossings_are_weighed_for_the_least_noise() -> None:
    """Against equal weights: var(Σ w·x)/var(mean of x) for crossings of independent frames is Σ w² over 1/n, never above it."""
    row, col = jittered(8, 3)
    sums = quickly(images(4), row, col)
    flat = quickly(np.full((FRAMES, ROWS, COLS), 7.0, np.float32), row, col)
    seen = flat[..., 3] > 0
    np.testing.assert_allclose(flat[seen][:, 0] / flat[seen][:, 1], 7.0, rtol=1e-6)  # weights sum to one
    once = sums[..., 3] == 1
    assert (1 / sums[once][:, 1]).min() >= 0.25 - 1e-6 and (
        1 / sums[once][:, 1]
    ).max() <= 1.0 + 1e-6  # g of four pixels


def test_nearest_pixel_is_the_pixel_the_point_lies_in() -> None:
    row, col = np.array([[3.4, 3.6, 3.0, np.nan, 5.0]]), np.array([[7.4, 8.49, 7.6, 9.0, 60.0]])
    frames = np.zeros((5, ROWS, COLS), np.float32)
    frames[0, 3, 7], frames[1, 4, 8], frames[2, 3, 8] = 10.0, 20.0, 40.0
    sums = np.zeros((1, COLS, 4))
    extraction.nearest_pixels(by_row(frames), 0, row, col, sums)
    np.testing.assert_array_equal(sums[0, 7], [10.0, 1.0, 3.0, 1.0])
    np.testing.assert_array_equal(sums[0, 8], [60.0, 2.0, 7.0, 2.0])
    assert sums[..., 3].sum() == 3


@pytest.mark.parametrize("missing", [5, 30])
def test_gaps_are_filled_from_the_band(missing: int) -> None:
    """Light between 430 and 950 nm, 28 columns before ZPD; random columns lost: a tenth of the lost fringes' size at most, up to
    a sixth of all columns; a straight line between neighbours misses by more than the fringes themselves."""
    opd = 2.05e-7 * (np.arange(192) - 28.3)
    table = np.linspace(1 / 950e-9, 1 / 430e-9, 900)
    light = np.exp(-(((table - 1.6e6) / 3e5) ** 2)) * (1 + 0.5 * np.sin(table / 3e4))
    one = 2000.0 + 800.0 * np.cos(2 * np.pi * np.outer(opd, table) + 0.4) @ light / light.sum()
    rng = np.random.default_rng(missing)
    value, seen = np.tile(one, (20, 1)), np.ones((20, 192), bool)
    for p in range(20):
        seen[p, rng.choice(192, missing, replace=False)] = False
    precision = extraction.band_precision(opd, table[0], table[-1])
    filled = extraction.fill_gaps(np.where(seen, value, 99.0), seen, precision)
    np.testing.assert_array_equal(filled[seen], value[seen])
    columns = np.arange(192)
    straight = np.stack([np.interp(columns, columns[s], v[s]) for v, s in zip(value, seen, strict=True)])

    def rms(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(x[~seen] ** 2)))

    print("filled", rms(filled - value), "straight", rms(straight - value), "of", rms(value - 2000.0))
    assert rms(filled - value) < 0.1 * rms(value - 2000.0) < 0.1 * rms(straight - value) * 1.2


def test_a_point_never_seen_stays_as_it_is() -> None:
    precision = extraction.band_precision(2e-7 * np.arange(5.0), 1e6, 2e6)
    value = np.array([[5.0] * 5])
    np.testing.assert_array_equal(extraction.fill_gaps(value, np.zeros((1, 5), bool), precision), value)
