"""Two or more flight lines with their geometry alone, by the simulator's flight, terrain, mount and lens: no image is made.

Control points are rays of random pixels cast to the true terrain; the motion of pairs of frames is that of such points, with
the noise that was measured on real pairs (`stages.registration.image_motion` on campaigns without effects): .05 px a point,
.02 px alike over the frame, .01 px of slopes and curves. The POS is the true flight with errors of its own sigmas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gcps, ImageMotion, Targets, Temperatures, Trajectory
from stages.simulation import SimulationSettings
from stages.simulation.ground import aim, draw_terrain
from stages.simulation.sensors import fly
from stages.tracking import Line
from tsmftis.camera import Camera, Mounting
from tsmftis.geodesy import ecef_to_geodetic, radii_of_curvature
from tsmftis.simulator import effects as effect
from tsmftis.simulator import imaging, inertial, lens
from tsmftis.simulator.world import Terrain

Array = NDArray[np.float64]

RATE, MARGIN_S = 200.0, 4.0
POINT_PX, MEAN_PX, SHAPE_PX = 0.05, 0.02, 0.01
SURVEY_M = 0.05
SIGMA_ATTITUDE = np.array([3e-6, 3e-6, 8e-6])
SIGMA_POSITION = np.array([0.003, 0.003, 0.005])
SIGMA_VELOCITY = np.full(3, 3e-4)


@dataclass(frozen=True)
class Heights:
    """The declared terrain as the stage asks a DEM."""

    terrain: Terrain

    def height(self, latitude: Array, longitude: Array) -> Array:
        return self.terrain.at(latitude, longitude)

    def covers(self, latitude: Array, longitude: Array) -> NDArray[np.bool_]:
        return np.ones(latitude.shape, bool)


@dataclass(frozen=True)
class Flown:
    """Lines with what is declared about them."""

    lines: list[Line]
    camera: Camera
    mounting: Mounting
    dem: Heights


def settings_of(lines: int, seconds: float) -> SimulationSettings:
    """Lines in opposite directions by turns, after the preset `demo`, on 96 × 192 pixels."""
    preset = SimulationSettings.preset("demo").model_dump()
    straight = seconds + 16.0
    legs: list[dict[str, float]] = []
    for _ in range(lines):
        legs += [{"straight_s": straight}, {"turn_deg": 180.0, "bank_deg": 26.0}]
    preset["flight"]["legs"] = legs[:-1]
    preset["instrument"]["camera"] |= {
        "rows": 96, "cols": 192, "principal_point_px": {"row": 47.8, "col": 95.1}
    }  # fmt: skip
    preset["lines"] = []
    settings = preset | {"lines": [{"id": "L00", "start_s": 8.0, "duration_s": seconds, "panels": ["white"]}]}
    first = SimulationSettings.model_validate(settings)
    period = (fly(first, 0).path.duration - straight) / max(lines - 1, 1)
    settings["lines"] = [
        {"id": f"L{i + 1:02d}", "start_s": 8.0 + i * period, "duration_s": seconds, "panels": ["white"]}
        for i in range(lines)
    ]
    return SimulationSettings.model_validate(settings)


def flown(
    settings: SimulationSettings,
    seed: int,
    effects: Mapping[str, Mapping[str, float]],
    per_line: int = 24,
    pairs: int = 40,
    warm: tuple[float, float] = (22.0, 38.0),
    sigma_px: float = 0.3,
    pos_errors: float = 1.0,
    noise: float = 1.0,
) -> Flown:
    """The lines of `settings` with `effects` that nobody declares; `warm`: temperatures of the first and the last line;
    `pos_errors` and `noise`: in units of what is usual."""
    rng = np.random.default_rng(seed)
    everything = effect.complete(effects)
    aircraft = fly(settings, seed)
    true, declared = aim(settings, everything), settings.instrument.camera
    terrain = draw_terrain(settings, aircraft, seed)
    real = terrain.raised(effect.number(everything, "dem_bias", "height"))
    latency = effect.number(everything, "camera_latency", "latency")
    ends = [(one.start_s, one.start_s + one.duration_s) for one in settings.lines]
    time_warm = np.array([0.0, ends[-1][1] + 10.0])
    slope = (warm[1] - warm[0]) / max(ends[-1][0] - ends[0][0], 1.0)
    warmth = warm[0] + slope * (time_warm - ends[0][0])
    temperatures = Temperatures(time_warm, np.tile(warmth[:, None, None], (1, 3, 3)), np.tile(warmth[:, None], (1, 3)))
    common = rng.standard_normal(6)
    lines = []
    for one, (start, stop) in zip(settings.lines, ends, strict=True):
        stamp = np.arange(int((start - MARGIN_S) * RATE), int((stop + MARGIN_S) * RATE)) / RATE
        gyro, accel = inertial.interval_means(aircraft, stamp, 1.0 / RATE)
        bend = imaging.angular_acceleration(stamp, gyro, RATE) if true.mount.flexure.any() else None
        frames = start + np.arange(round(one.duration_s * declared.frame_rate_hz)) / declared.frame_rate_hz
        pose = imaging.camera_poses(aircraft, frames, true.mount, np.interp(frames, time_warm, warmth) - 25.0, bend)
        errors = pos_errors * np.sqrt(0.5) * (common + rng.standard_normal(6))
        path = _pos(aircraft, stamp, gyro, accel, errors, pos_errors * rng.standard_normal(3))
        where = rng.integers(0, frames.size, per_line)
        pixel = rng.uniform(3.0, [declared.rows - 4.0, declared.cols - 4.0], (per_line, 2))
        ground = _ground(true.lens, pose, where, pixel, real)
        place = np.stack(ecef_to_geodetic(ground), -1)
        place[:, 2] += noise * SURVEY_M * rng.standard_normal(per_line)
        picked = pixel + noise * sigma_px * rng.standard_normal(pixel.shape)
        gcps = Gcps(where, *picked.T, *place.T, np.full(per_line, sigma_px)) if per_line else None
        spots = _ground(true.lens, pose, rng.integers(0, frames.size, 6), rng.uniform(20.0, 70.0, (6, 2)), real)
        survey = np.stack(ecef_to_geodetic(spots), -1)
        survey[:, 2] += noise * SURVEY_M * rng.standard_normal(len(survey))
        targets = Targets(tuple(f"T{i}" for i in range(6)), *survey.T, ("",) * 6, np.full(6, 5.0))
        motion = _motion(true.lens, pose, real, pairs, (declared.rows, declared.cols), noise, rng) if pairs else None
        lines.append(Line(one.id, path, frames + latency, gcps, targets, motion, temperatures, "F1"))
    camera = Camera(
        declared.rows, declared.cols, declared.pixel_pitch_m, declared.focal_length_m,
        declared.principal_point_px.row, declared.principal_point_px.col, declared.frame_rate_hz, declared.saturation_dn,
    )  # fmt: skip
    mount = settings.instrument.mounting
    mounting = Mounting(
        np.array(mount.imu_to_antenna_m), np.array(mount.imu_to_camera_m), np.deg2rad(mount.boresight_deg.triple())
    )
    return Flown(lines, camera, mounting, Heights(terrain))


def _pos(aircraft, stamp: Array, gyro: Array, accel: Array, errors: Array, drift: Array) -> Trajectory:  # type: ignore[no-untyped-def]
    """True poses with constant errors of attitude and position (6,), and of velocity (3,), in their sigmas."""
    place, attitude = aircraft.navigation(stamp)
    before, after = (aircraft.navigation(stamp + s)[0] for s in (-1e-3, 1e-3))
    north, east = radii_of_curvature(place[:, 0])
    metres = np.stack([north + place[:, 2], (east + place[:, 2]) * np.cos(place[:, 0]), -np.ones(stamp.size)], -1)
    velocity = (after - before) / 2e-3 * metres
    move = SIGMA_POSITION * errors[3:] + (stamp - stamp.mean())[:, None] * SIGMA_VELOCITY * drift
    place = place + move / metres
    n = (stamp.size, 1)
    return Trajectory(
        stamp, *place.T, velocity, attitude + SIGMA_ATTITUDE * errors[:3],
        np.tile(SIGMA_POSITION, n), np.tile(SIGMA_VELOCITY, n), np.tile(SIGMA_ATTITUDE, n), gyro, accel,
    )  # fmt: skip


def _ground(optics: lens.Lens, pose: tuple[Array, Array], frame: Array, pixel: Array, terrain: Terrain) -> Array:
    """Where the rays of pixels (n, 2) of frames (n,) meet the terrain, in ECEF (n, 3)."""
    if not len(pixel):
        return np.zeros((0, 3))
    slopes = lens.ray(optics, pixel[:, 0], pixel[:, 1])
    ray = np.einsum("nij,nj->ni", pose[1][frame], np.column_stack([slopes, np.ones(len(slopes))]))
    return imaging.cast(pose[0][frame], ray / np.linalg.norm(ray, axis=1, keepdims=True), terrain)


def _motion(
    optics: lens.Lens,
    pose: tuple[Array, Array],
    terrain: Terrain,
    pairs: int,
    shape: tuple[int, int],
    size: float,
    rng: np.random.Generator,
) -> ImageMotion:
    """Pairs 40 frames apart with 40 points each."""
    count, apart, points = len(pose[0]), 40, 40
    first = np.unique(np.linspace(0, count - 1 - apart, pairs).astype(int))
    pair = np.repeat(np.arange(first.size), points)
    pixel = rng.uniform(15.0, np.array(shape) - 16.0, (pair.size, 2))
    ground = _ground(optics, pose, first[pair], pixel, terrain)
    second = first[pair] + apart
    sight = np.einsum("nij,ni->nj", pose[1][second], ground - pose[0][second])
    x, y = sight[:, 0] / sight[:, 2], sight[:, 1] / sight[:, 2]
    scale = optics.focal * (1.0 + optics.k1 * (x**2 + y**2))
    moved = np.stack([optics.row0 + scale * y, optics.col0 - scale * x], -1)
    inside = ((moved > 15.0) & (moved < np.array(shape) - 16.0)).all(axis=1)
    at = 2.0 * pixel / np.array(shape) - 1.0
    modes = np.stack([at[:, 0], at[:, 1], at[:, 1] ** 2, at[:, 0] * at[:, 1]], -1)
    noise = POINT_PX * rng.standard_normal((pair.size, 2)) + MEAN_PX * rng.standard_normal((first.size, 2))[pair]
    noise += SHAPE_PX * np.einsum("nk,nkc->nc", modes, rng.standard_normal((first.size, 4, 2))[pair])
    shift = moved - pixel + size * noise
    i = inside
    return ImageMotion(first, first + apart, pair[i], *pixel[i].T, *shift[i].T, np.full(first.size, POINT_PX))
