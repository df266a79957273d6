"""Collinearity against an independent few-line projection; latency, boresight, grid and nominal track by the contract."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.records import Targets, Tracks, Trajectory
from stages.tracking import TrackingSettings, run
from tsmftis.camera import Camera, Mounting

LAT, LON, H, SPEED, COURSE = np.deg2rad(37.0), np.deg2rad(126.5), 1000.0, 60.0, 0.7
CAMERA = Camera(96, 192, 15e-6, 0.07, 47.8, 95.1, 100.0, 16383.0, 0.3, 0.004)
MOUNTING = Mounting(np.zeros(3), np.array([0.15, -0.1, 0.25]), np.deg2rad([0.18, -0.31, 0.45]))


def ecef(lat: float, lon: float, h: float) -> np.ndarray:
    """Its own code: the ellipsoid's equation."""
    a, b = 6378137.0, 6378137.0 * (1 - 1 / 298.257223563)
    n = a * a / np.hypot(a * np.cos(lat), b * np.sin(lat))
    return np.array(
        [
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (b * b / a / a * n + h) * np.sin(lat),
        ]
    )


def ned(lat: float, lon: float) -> Rotation:
    """NED → ECEF."""
    return Rotation.from_euler("zy", [-lon, lat + np.pi / 2]).inv()


def rpy(time: np.ndarray) -> np.ndarray:
    return np.stack(
        [
            0.01 * np.sin(2 * np.pi * 1.3 * time),
            0.02 + 0.008 * np.cos(2 * np.pi * 0.9 * time),
            COURSE + 0.01 * np.sin(3 * time),
        ],
        -1,
    )


def geodetic(time: np.ndarray) -> np.ndarray:
    """Uniform in latitude, longitude; height in slow waves."""
    return np.stack(
        [
            LAT + SPEED * np.cos(COURSE) * time / 6.36e6,
            LON + SPEED * np.sin(COURSE) * time / 6.39e6 / np.cos(LAT),
            H + 2.0 * np.sin(time),
        ],
        -1,
    )


def trajectory() -> Trajectory:
    time = np.arange(-1.0, 6.0, 0.005)
    place = geodetic(time)
    a, e2 = 6378137.0, 0.00669437999014
    s = 1 - e2 * np.sin(place[:, 0]) ** 2
    north, east = a * (1 - e2) / s**1.5 + place[:, 2], (a / s**0.5 + place[:, 2]) * np.cos(place[:, 0])
    rate = SPEED * np.cos(COURSE) / 6.36e6, SPEED * np.sin(COURSE) / 6.39e6 / np.cos(LAT)
    velocity = np.stack([rate[0] * north, rate[1] * east, -2.0 * np.cos(time)], -1)
    blank = np.zeros((time.size, 3))
    return Trajectory(time, *place.T, velocity, rpy(time), blank, blank, blank, blank, blank)


def targets() -> Targets:
    at = geodetic(np.array([2.0, 2.5, 3.0]))
    ids, height, size = ("a", "b", "c"), np.array([30.0, 35.0, 28.0]), np.array([8.0, 6.0, 4.0])
    return Targets(ids, at[:, 0] + [0, 1e-6, 0], at[:, 1] + [1e-6, 0, 0], height, ("", "", ""), size)


STAMPS = np.arange(1.0, 4.0, 0.01)


def tracked(**changes: object) -> tuple[np.ndarray, np.ndarray]:
    result = run(
        trajectory(),
        STAMPS,
        targets(),
        replace(CAMERA, **{k: v for k, v in changes.items() if k != "mounting"}),  # type: ignore[arg-type]
        changes.get("mounting", MOUNTING),  # type: ignore[arg-type]
        TrackingSettings(),
    )
    return result.tracks.row[1], result.tracks.col[1]


def projected(target: int, north: float, east: float, time: float) -> tuple[float, float]:
    """A ground point in the frame of true time `time`, from the contract alone."""
    t = targets()
    place = t.latitude[target], t.longitude[target], t.height[target]
    point = ecef(*place) + ned(*place[:2]).apply([north, east, 0.0])
    lat, lon, h = geodetic(np.array([time]))[0]
    body = ned(lat, lon) * Rotation.from_euler("ZYX", rpy(np.array([time]))[0, ::-1])
    camera = body * Rotation.from_euler("ZYX", np.deg2rad([0.45, -0.31, 0.18]))
    x, y, z = camera.inv().apply(point - ecef(lat, lon, h) - body.apply([0.15, -0.1, 0.25]))
    s = 1 + 0.3 * ((x / z) ** 2 + (y / z) ** 2)
    return 47.8 + s * y / z * 0.07 / 15e-6, 95.1 - s * x / z * 0.07 / 15e-6


def test_tracks_are_the_collinearity_equations() -> None:
    """Every point kind, over the line, at stamp − latency, between the trajectory's 5 ms samples: 1e-4 px.

    The splines leave 2e-9 rad (1e-5 px) and 1e-8 m at these motions; the grid is 5 × 5 within ±size/4 along the mean course.
    """
    row, col = tracked()
    result = run(trajectory(), STAMPS, targets(), CAMERA, MOUNTING, TrackingSettings())
    course = result.course
    for target in range(3):
        size = targets().size[target]
        for point in (Tracks.CENTRE, 0, 4, 20, 23):
            along, across = (np.array(divmod(point, 5)) - 2) * size / 8
            north = along * np.cos(course) - across * np.sin(course)
            east = along * np.sin(course) + across * np.cos(course)
            for frame in (0, 77, 151, 299):
                want = projected(target, north, east, STAMPS[frame] - 0.004)
                np.testing.assert_allclose((row[target, point, frame], col[target, point, frame]), want, atol=1e-4)
    assert course == pytest.approx(COURSE, abs=1e-2) and result.ground_speed == pytest.approx(SPEED, rel=0.01)


def test_latency_is_taken_off_the_stamp() -> None:
    """One frame interval of latency shows each frame what the frame before shows without: exactly (1e-6 px)."""
    late, prompt = tracked(latency=0.01), tracked(latency=0.0)
    np.testing.assert_allclose(late[1][..., 1:], prompt[1][..., :-1], atol=1e-4)
    np.testing.assert_allclose(late[0][..., 1:], prompt[0][..., :-1], atol=1e-4)


def test_boresight_moves_the_image_as_the_contract_says() -> None:
    """Small angles at mid-detector: roll → row + f/p·δ, pitch → column + f/p·δ; 2 % for the view's 2° half angle."""
    centre = 47, Tracks.CENTRE
    base = tracked()
    pixels = 1e-3 * 0.07 / 15e-6
    for axis, (drow, dcol) in enumerate(((pixels, 0.0), (0.0, pixels))):
        angles = MOUNTING.boresight.copy()
        angles[axis] += 1e-3
        row, col = tracked(mounting=replace(MOUNTING, boresight=angles))
        frame = int(np.argmin(np.abs(base[1][0, centre[1]] - 95.1)))
        moved = row[0, 12, frame] - base[0][0, 12, frame], col[0, 12, frame] - base[1][0, 12, frame]
        np.testing.assert_allclose(moved, (drow, dcol), atol=0.02 * pixels)


def test_nominal_track_is_straight_and_uniform_from_the_anchor() -> None:
    """Row constant, column v·f/(p·H) a second (H: mean height over the targets), equal to the tracking at the anchor."""
    result = run(trajectory(), STAMPS, targets(), CAMERA, MOUNTING, TrackingSettings())
    (nominal_row, row), (nominal_col, col) = result.tracks.row, result.tracks.col
    assert (nominal_row == nominal_row[..., :1]).all()
    step = np.diff(nominal_col, axis=-1)
    np.testing.assert_allclose(step, step[0, 0, 0], rtol=1e-9)
    assert step[0, 0, 0] == pytest.approx(SPEED * 0.07 / 15e-6 / (H - 31.0) * 0.01, rel=0.01)
    anchor = CAMERA.central_frame(row[:, 12], col[:, 12])
    for target, frame in enumerate(anchor):
        np.testing.assert_allclose(nominal_col[target, :, frame], col[target, :, frame], atol=1e-9)
        np.testing.assert_allclose(nominal_row[target, :, frame], row[target, :, frame], atol=1e-9)


def test_frames_beyond_the_trajectory_have_no_pose_and_none_at_all_is_an_error() -> None:
    stamps = np.arange(5.5, 6.5, 0.01)
    result = run(trajectory(), stamps, targets(), CAMERA, MOUNTING, TrackingSettings())
    late = stamps - 0.004 > trajectory().time[-1]
    assert np.isnan(result.tracks.col[1][..., late]).all() and np.isfinite(result.tracks.col[1][..., ~late]).all()
    with pytest.raises(InputError, match="trajectory"):
        run(trajectory(), stamps + 100.0, targets(), CAMERA, MOUNTING, TrackingSettings())
    swapped = replace(targets(), latitude=targets().longitude - 1.0, longitude=targets().latitude)
    with pytest.raises(InputError, match="km from the line"):
        run(trajectory(), STAMPS, swapped, CAMERA, MOUNTING, TrackingSettings())


def test_frames_in_a_gap_of_the_inertial_data_have_no_pose() -> None:
    """Nothing tells how the camera moved there; beside the gap the tracks are as without it, to what a spline's end costs."""
    whole = trajectory()
    kept = (whole.time < 2.0025) | (whole.time > 2.3025)
    cut = Trajectory(**{f.name: getattr(whole, f.name)[kept] for f in fields(Trajectory)})
    col = run(cut, STAMPS, targets(), CAMERA, MOUNTING, TrackingSettings()).tracks.col[1]
    want = run(whole, STAMPS, targets(), CAMERA, MOUNTING, TrackingSettings()).tracks.col[1]
    true = STAMPS - CAMERA.latency
    lost = (true > 2.001) & (true < 2.299)
    assert np.isnan(col[..., lost]).all() and np.isfinite(col[..., (true < 1.999) | (true > 2.306)]).all()
    beside = (true < 1.9) | (true > 2.4)
    np.testing.assert_allclose(col[..., beside], want[..., beside], atol=1e-3)
