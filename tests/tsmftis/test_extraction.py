"""Extraction against a slow reference that walks every crossing in plain Python, and its noise against Monte Carlo."""

from __future__ import annotations

import math
import time

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


def slowly(frames: np.ndarray, row: np.ndarray, col: np.ndarray) -> list[np.ndarray]:
    """For every pair of frames and every column c with min < c ≤ max: the linear mixture, its squared weights, count, row."""
    out = [np.zeros((len(row), COLS)) for _ in range(4)]
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
                    out[0][p, c] += value
                    out[1][p, c] += sum(w * w for w in weights.values())
                    out[2][p, c] += 1
                    out[3][p, c] += (1 - tau) * r0 + tau * r1
    return out


def quickly(frames: np.ndarray, row: np.ndarray, col: np.ndarray, block: int = FRAMES) -> list[np.ndarray]:
    out = [np.zeros((len(row), COLS)) for _ in range(4)]
    for first in range(0, FRAMES - 1, block):
        extraction.along_tracks(frames[first : first + block + 1], first, row, col, *out)
    return out


def test_extraction_is_the_plain_reference() -> None:
    """Float32 frames summed in another order: 1e-6 relative. NaN pixels, holes, exact columns, the last row included."""
    row, col = jittered(12, 1)
    frames = images(2)
    fast, slow = quickly(frames, row, col), slowly(frames, row, col)
    for a, b in zip(fast, slow, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)
    assert slow[2].max() >= 3  # jitter did take points over a column again and again
    assert (slow[2][1] == 0).any()  # and one did leave the rows


def test_blocks_that_overlap_by_one_frame_give_the_whole() -> None:
    row, col = jittered(8, 3)
    frames = images(4)
    for a, b in zip(quickly(frames, row, col, 17), quickly(frames, row, col), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_ground_points_projected_on_the_way_give_the_same() -> None:
    """Poses of a wobbling camera over a plane: tracks by Camera.project, then both ways (rounding of 6 400 km: 1e-6)."""
    from scipy.spatial.transform import Rotation

    from tsmftis.camera import Camera

    rng = np.random.default_rng(5)
    camera = Camera(ROWS, COLS, 15e-6, 0.05, 11.3, 19.8, 100.0, 16383.0, 0.4)
    centre = np.stack([0.13 * np.arange(FRAMES), np.zeros(FRAMES), np.full(FRAMES, -1000.0)], -1)
    angles = 1e-4 * rng.standard_normal((FRAMES, 3))
    dcm = Rotation.from_rotvec(angles).as_matrix()
    points = np.stack([rng.uniform(3, 14, 30), rng.uniform(-2, 2, 30), np.zeros(30)], -1)
    sight = points[:, None, :] - centre
    row, col = camera.project(np.einsum("fij,pfi->pfj", dcm, sight))
    frames = images(6)
    want = [np.zeros((30, COLS)) for _ in range(4)]
    got = [np.zeros((30, COLS)) for _ in range(4)]
    extraction.along_tracks(frames, 0, row, col, *want)
    extraction.over_cells(frames, points, centre, dcm, 0.05 / 15e-6, 11.3, 19.8, 0.4, *got)
    assert want[2].sum() > 300
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


def area_tracks() -> tuple[np.ndarray, np.ndarray]:
    """Six neighbouring points on one jittering track: they share pixels."""
    rng = np.random.default_rng(7)
    frame = np.arange(FRAMES)
    col = -4.0 + 0.4 * frame + 0.5 * rng.standard_normal(FRAMES) + 0.3 * np.arange(6)[:, None]
    row = 10.0 + 0.8 * np.sin(frame / 5.0) + 0.25 * np.arange(6)[:, None]
    return row, col


def mean_of_noise(frames: np.ndarray, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    value, _, weight, _ = quickly(frames, row, col)
    return (value / np.maximum(weight, 1)).mean(axis=0), weight


def test_shared_gain_is_the_variance_of_the_mean() -> None:
    """The same by linearity: the mean's weight on each pixel, found by reading unit frames, squared and summed (rounding).

    And 400 frames of white noise: a variance known to 7 % a column, 0.2 × that over all: 5 %.
    """
    row, col = area_tracks()
    rng = np.random.default_rng(8)
    blank = np.zeros((FRAMES, ROWS, COLS), np.float32)
    _, weight = mean_of_noise(blank, row, col)
    gain = np.zeros(COLS)
    extraction.shared_gain(row, col, np.ones(6, bool), weight, ROWS, gain)
    exact = np.zeros(COLS)
    for f in range(FRAMES):
        for r in range(7, 15):
            unit = blank.copy()
            unit[f, r] = 1.0
            exact += mean_of_noise(unit, row, col)[0] ** 2
    full = (weight > 0).all(axis=0)
    assert full.sum() > 30
    np.testing.assert_allclose(gain[full], exact[full], rtol=1e-5)
    draws = [mean_of_noise(rng.standard_normal(blank.shape).astype(np.float32), row, col)[0] for _ in range(400)]
    ratio = np.var(draws, axis=0)[full] / gain[full]
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)


def test_fill_gaps_interpolates_only_what_was_not_seen() -> None:
    value = np.array([[1.0, 2.0, 99.0, 4.0, 99.0], [5.0, 5.0, 5.0, 5.0, 5.0]])
    seen = np.array([[True, True, False, True, False], [False] * 5])
    out = extraction.fill_gaps(value, seen)
    np.testing.assert_array_equal(out, [[1, 2, 3, 4, 4], [5] * 5])
    assert value[0, 2] == 99.0  # the input is left alone


def test_speed_is_that_of_a_compiled_loop() -> None:
    """Measured 9 M crossings (36 M samples) a second on one core; interpreted it would be 0.05 M. 1 M allows a busy machine."""
    rng = np.random.default_rng(9)
    frames = rng.uniform(0, 9000, (300, 96, 192)).astype(np.float32)
    col = np.tile(np.arange(300) * 0.9 - 40.0, (400, 1)) + rng.uniform(-5, 5, (400, 1))
    row = np.tile(rng.uniform(2, 90, (400, 1)), (1, 300))
    out = [np.zeros((400, 192)) for _ in range(4)]
    extraction.along_tracks(frames, 0, row, col, *out)
    start = time.perf_counter()
    extraction.along_tracks(frames, 0, row, col, *out)
    rate = out[2].sum() / 2 / (time.perf_counter() - start)
    print(f"extraction {rate / 1e6:.0f} M crossings/s")
    assert rate > 1e6
