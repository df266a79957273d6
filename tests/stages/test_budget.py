"""Perturbations against closed forms, the GCP fit against a known offset, noise of differences by hand, pooling by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.records import CameraPoses, Gcps, Interferograms, Targets, Tracks, Trajectory
from stages import budget
from stages.budget import Comparison, Part, Variant
from stages.budget.comparison import displacement, noise_gain
from stages.budget.table import share
from stages.tracking import TrackingSettings, run
from tsmftis.camera import Camera, Mounting
from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm, radii_of_curvature

LAT, LON, H, SPEED = np.deg2rad(37.0), np.deg2rad(126.5), 1000.0, 60.0
CAMERA = Camera(96, 192, 15e-6, 0.07, 47.5, 95.5, 100.0, 16383.0)
MOUNTING = Mounting(np.zeros(3))
SCALE = CAMERA.focal_length / CAMERA.pixel_pitch
TIME = np.arange(0.0, 6.0, 0.005)
STAMPS = np.arange(0.5, 5.5, 0.01)
NORTH, _ = radii_of_curvature(LAT)


def flight(jitter: float = 0.0) -> Trajectory:
    """Level and north at uniform speed; jitter [rad] in roll, pitch and yaw."""
    zero = np.zeros((TIME.size, 3))
    wave = np.stack([np.sin(9.0 * TIME), np.cos(7.0 * TIME), np.sin(5.0 * TIME)], axis=1)
    return Trajectory(
        TIME,
        LAT + SPEED * (TIME - 3.0) / (NORTH + H),
        np.full(TIME.size, LON),
        np.full(TIME.size, H),
        np.broadcast_to([SPEED, 0.0, 0.0], zero.shape),
        jitter * wave,
        *(zero for _ in range(5)),
    )


def targets(east: float = 0.0) -> Targets:
    """One at height zero, below the flight's middle."""
    _, prime = radii_of_curvature(LAT)
    one = np.ones(1)
    return Targets(("T",), LAT * one, LON + east / (prime * np.cos(LAT)) * one, 0.0 * one, ("",), 4.0 * one)


def tracks(
    trajectory: Trajectory | None = None,
    where: Targets | None = None,
    camera: Camera = CAMERA,
    mounting: Mounting = MOUNTING,
) -> Tracks:
    found = run(trajectory or flight(), STAMPS, where or targets(), camera, mounting, TrackingSettings()).tracks
    i = found.methods.index("tracking")
    return Tracks(("tracking",), found.targets, found.row[[i]], found.col[[i]])


def moved(base: Tracks, other: Tracks) -> np.ndarray:
    """rms of row, col, and of what varies of them [px]."""
    row, col = np.concatenate([base.row, other.row]), np.concatenate([base.col, other.col])
    return np.sqrt(displacement(Tracks(("tracking", "other"), base.targets, row, col), CAMERA)[0, 0])


# --- closed forms -----------------------------------------------------------------------------------------------------


def test_a_boresight_roll_moves_the_rows_by_f_over_p() -> None:
    angle = 1e-4
    row, col, row_varying, _ = moved(tracks(), tracks(mounting=budget.turned(MOUNTING, np.array([angle, 0.0, 0.0]))))
    assert row == pytest.approx(SCALE * angle, rel=1e-3)
    assert col < 1e-3 * row and row_varying < 1e-3 * row


def test_a_latency_moves_the_columns_by_the_way_flown() -> None:
    late = 1e-3
    row, col, _, col_varying = moved(tracks(), tracks(camera=budget.later(CAMERA, late)))
    assert col == pytest.approx(SCALE * SPEED * late / H, rel=1e-3)
    assert row < 1e-3 * col and col_varying < 1e-3 * col


def test_a_raised_target_moves_away_from_the_nadir() -> None:
    """δcol = (col − col0)·δh/H, over all columns: its rms is δh/H times theirs, and all of it varies."""
    base, rise = tracks(), 2.0
    _, col, _, col_varying = moved(base, tracks(where=budget.raised(targets(), rise)))
    at = base.col[0, 0, Tracks.CENTRE]
    at = at[(at >= 0) & (at <= CAMERA.cols - 1)] - CAMERA.principal_col
    assert col == pytest.approx(rise / H * np.sqrt((at**2).mean()), rel=5e-3)
    assert col_varying == pytest.approx(col, rel=1e-2)


def test_a_displaced_trajectory_lies_where_it_was_put() -> None:
    here, ned = flight(), np.array([3.0, -2.0, 1.0])
    there = budget.displaced(here, ned, np.array([0.01, 0.02, 0.03]))
    way = geodetic_to_ecef(there.latitude, there.longitude, there.height) - geodetic_to_ecef(
        here.latitude, here.longitude, here.height
    )
    np.testing.assert_allclose(
        np.einsum("nij,ni->nj", ned_to_ecef_dcm(here.latitude, here.longitude), way), [ned] * TIME.size, atol=1e-5
    )
    np.testing.assert_allclose(there.rpy - here.rpy, [[0.01, 0.02, 0.03]] * TIME.size)


def test_the_random_walk_has_the_variance_of_its_density() -> None:
    density = 1e-5
    ends = [
        walk[-1] - walk[0] for s in range(400) for walk in [budget.random_walk(TIME, density, np.random.default_rng(s))]
    ]
    assert np.var(ends) == pytest.approx(density**2 * (TIME[-1] - TIME[0]), rel=0.15)
    assert budget.random_walk(TIME, density, np.random.default_rng(1)).mean(axis=0) == pytest.approx(0.0, abs=1e-12)


def test_terrain_off_moves_cells_by_the_height_over_the_distance() -> None:
    """One cell off to the right: rows by (row − row0)·δh/H."""
    here, side, rise = flight(), 6.0, 5.0
    body = ned_to_ecef_dcm(here.latitude, here.longitude)
    poses = CameraPoses(TIME, geodetic_to_ecef(here.latitude, here.longitude, here.height), body)
    t = targets(side)
    found = budget.terrain_displacement(poses, CAMERA, t.latitude, t.longitude, t.height, rise)
    assert np.sqrt(found[0]) == pytest.approx(SCALE * side / H * rise / H, rel=1e-2)
    assert np.isnan(budget.terrain_displacement(poses, CAMERA, t.latitude + 1.0, t.longitude, t.height, rise)).all()


# --- ground control ---------------------------------------------------------------------------------------------------


def control_points(count: int, truth: np.ndarray, sigma: float, jitter: float) -> tuple[Gcps, Trajectory]:
    """Points on the ground picked, with errors of sigma px, by a camera that is turned and late by `truth`."""
    rng = np.random.default_rng(3)
    trajectory = flight(jitter)
    frame = rng.integers(60, STAMPS.size - 60, count)
    _, prime = radii_of_curvature(LAT)
    along = SPEED * (STAMPS[frame] - 3.0) + rng.uniform(-15.0, 15.0, count)
    one = Gcps(
        frame,
        np.zeros(count),
        np.zeros(count),
        LAT + along / NORTH,
        LON + rng.uniform(-8.0, 8.0, count) / (prime * np.cos(LAT)),
        rng.uniform(0.0, 20.0, count),
        np.full(count, sigma),
    )
    picked = predicted(one, trajectory, truth) + sigma * rng.standard_normal((count, 2))
    return replace(one, row=picked[:, 0], col=picked[:, 1]), trajectory


def predicted(gcps: Gcps, trajectory: Trajectory, p: np.ndarray) -> np.ndarray:
    found = tracks(
        trajectory,
        budget.as_targets(gcps),
        budget.later(CAMERA, float(p[3])),
        budget.turned(MOUNTING, p[:3]),
    )
    at = np.arange(gcps.frame.size), Tracks.CENTRE, gcps.frame
    return np.stack([found.row[0][at], found.col[0][at]], axis=1)


def test_control_points_give_boresight_and_latency_back() -> None:
    truth = np.array([3e-4, -5e-4, 2e-3, 2e-3])
    gcps, trajectory = control_points(24, truth, 0.3, jitter=0.01)
    found = budget.fit_control(
        lambda p: predicted(gcps, trajectory, p), np.stack([gcps.row, gcps.col], axis=1), gcps.sigma
    )
    assert (np.abs(found.value - truth) < 2.0 * found.sigma).all()
    assert (found.sigma < [5e-5, 5e-5, 5e-3, 2e-3]).all()
    assert found.points == 24 and 0.5 < found.chi2 / found.freedom < 2.0


def test_control_points_that_tell_nothing_are_refused() -> None:
    gcps, trajectory = control_points(2, np.zeros(4), 0.3, jitter=0.0)
    picked = np.stack([gcps.row, gcps.col], axis=1)
    with pytest.raises(ValueError, match="too few"):
        budget.fit_control(lambda p: predicted(gcps, trajectory, p), picked, gcps.sigma)
    many = np.zeros((20, 2))
    with pytest.raises(ValueError, match="apart"):  # latency and pitch do the same
        budget.fit_control(lambda p: many + [p[0], p[1] + p[3]] + p[2], many, np.ones(20))


# --- noise ------------------------------------------------------------------------------------------------------------


def steady(rows: float, count: int = 40, cols: int = 16) -> tuple[Tracks, Interferograms]:
    """Two methods, the second `rows` below: a column a frame, met exactly at the frames, halfway between rows."""
    col = np.broadcast_to(np.arange(count) - 8.0, (2, 1, 25, count))
    row = np.zeros_like(col) + 10.5
    row[1] += rows
    one = np.ones((2, 1, 25, cols))
    return Tracks(("tracking", "other"), ("T",), row, col.copy()), Interferograms(
        ("tracking", "other"), ("T",), 100.0 * one, one, one, one
    )


@pytest.mark.parametrize(("rows", "expected"), [(0.0, 0.0), (5.0, 1.0), (1.0, 0.5)])
def test_noise_of_a_difference_is_that_of_the_pixels_not_shared(rows: float, expected: float) -> None:
    """Halves of two pixels each: ½ and ½ of a pixel's variance where none is shared, ¼ + ¼ where one of them is."""
    gain = noise_gain(*steady(rows), [], 96)
    np.testing.assert_allclose(gain[0], 0.5)
    np.testing.assert_allclose(gain[1], expected, atol=1e-12)


def test_the_least_noisy_model_is_taken_at_the_signals_there_are() -> None:
    models = [(10.0, 0.3), (100.0, 0.2)]
    assert budget.least_noise(models, np.array([10.0, 100.0])) == 0
    assert budget.least_noise(models, np.array([5000.0])) == 1


# --- the table --------------------------------------------------------------------------------------------------------


def comparison(change: np.ndarray, noise: float, line: str = "F1/L01") -> Comparison:
    """Part "a" with two directions of two signs each; RQE of the base 0.1, of the variants 0.11; a target unseen."""
    variants = tuple(Variant("a", d, s) for d in range(2) for s in range(2))
    full = np.empty((5, 4, 2))
    full[0], full[1:] = 0.1, change[:, None, None]
    full[:, 3] = np.nan
    rqe = np.full((5, 4, 2), 0.11)
    rqe[0], rqe[:, 3] = 0.1, np.nan
    return Comparison(
        line,
        tuple("wxyz"),
        variants,
        np.full((4, 4, 4), 0.25),
        full,
        np.full((5, 4, 2), noise),
        np.full((5, 4, 2), 1e-9),
        rqe,
        np.full((4, 2), noise),
    )


def test_directions_add_and_signs_are_averaged() -> None:
    found = comparison(np.array([0.03, 0.03, 0.04, 0.04]), 0.001)
    result = budget.run([Part("a", "", adds=True), Part("b", "", cannot_tell="why")], [found])
    row, nothing = result.rows
    assert row["pixels_rms"]["row"] == pytest.approx(np.sqrt(0.5))
    assert row["point"]["share"] == pytest.approx(np.sqrt(0.05**2 - 2e-6), rel=1e-6)
    assert row["area"]["rqe_change"] == pytest.approx(0.02) and row["area"]["rqe"] == pytest.approx(0.12)
    assert row["point"]["targets"] == 3
    total = result.total["point"]
    assert total["explained_rms"] ** 2 == pytest.approx(total["noise_rms"] ** 2 + row["point"]["share"] ** 2)
    assert total["left_rms"] == pytest.approx(np.sqrt(0.1**2 - 0.001**2))
    assert nothing["cannot_tell"] == "why" and nothing["point"]["share"] is None
    json.dumps([result.rows, result.total], allow_nan=False)


def test_batches_of_a_line_are_one() -> None:
    """As if the second direction had been compared by itself."""
    whole = comparison(np.array([0.03, 0.03, 0.04, 0.04]), 0.001)
    names = ("change", "noise", "scatter", "rqe")

    def part(keep: slice) -> Comparison:
        some = {n: np.concatenate([getattr(whole, n)[:1], getattr(whole, n)[1:][keep]]) for n in names}
        return replace(whole, variants=whole.variants[keep], displacement=whole.displacement[keep], **some)

    joined = part(slice(0, 1)).joined(part(slice(1, 4)))
    assert budget.run([Part("a", "")], [joined]) == budget.run([Part("a", "")], [whole])
    assert len(budget.run([], [whole, whole]).total["point"]["targets"]) == 3
    assert len(budget.run([], [whole, replace(whole, line="F1/L02")]).total["point"]["targets"]) == 6


def test_what_noise_makes_is_no_share() -> None:
    one = np.ones((1, 1, 5))
    alike = share(0.02 * one, 0.02 * one, 1e-5 * one)
    assert alike["share"] is None and alike["share_upper"] == pytest.approx(
        np.sqrt(2.0 * np.hypot(1e-5 / np.sqrt(5), 4e-5))
    )
    assert share(0.0 * one, 0.0 * one, 0.0 * one)["share"] == 0.0
    unknown = share(0.02 * one, np.nan * one, np.nan * one)
    assert unknown["share"] is None and unknown["share_upper"] == pytest.approx(0.02)
