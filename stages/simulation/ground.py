"""Where the camera looks: terrain, and under each line the plane of its course with panels and background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from stages.simulation.records import Array, Calibration
from stages.simulation.sensors import DEG
from stages.simulation.settings import Line, SimulationSettings
from tsmftis import geodesy, rotation
from tsmftis.simulator import effects as effect
from tsmftis.simulator import flight, imaging, lens, world
from tsmftis.simulator.streams import stream


@dataclass(frozen=True)
class Camera:
    """Mount and lens, true or declared."""

    mount: imaging.Mount
    lens: lens.Lens


@dataclass(frozen=True)
class Truth:
    """What the lines are imaged from. `terrain` is the true one.

    warmth: times [s] and mean accelerometer temperature [°C]; signal (material, row, col) [DN] goes with `materials`.
    """

    settings: SimulationSettings
    seed: int
    effects: effect.Effects
    aircraft: flight.Flight
    camera: Camera
    warmth: tuple[Array, Array]
    acceleration: CubicSpline | None
    terrain: world.Terrain
    calibration: Calibration
    signal: Array
    materials: list[str]

    def poses(self, time: Array) -> tuple[Array, Array]:
        """Projection centre (n, 3) and C_camera→ECEF (n, 3, 3) at true times (n,)."""
        warm = np.interp(time, *self.warmth) - 25.0
        return imaging.camera_poses(self.aircraft, time, self.camera.mount, warm, self.acceleration)


def aim(settings: SimulationSettings, effects: effect.Effects) -> Camera:
    """The camera with these effects; with none, the declared one."""
    camera, mounting = settings.instrument.camera, settings.instrument.mounting
    angles = mounting.boresight_deg
    roll, pitch, yaw = effect.triple(effects, "boresight", ("roll", "pitch", "yaw"))
    return Camera(
        imaging.Mount(
            np.array(mounting.imu_to_camera_m),
            rotation.rpy_to_dcm(angles.roll * DEG + roll, angles.pitch * DEG + pitch, angles.yaw * DEG + yaw),
            np.array(effect.triple(effects, "boresight_thermal_drift", ("roll", "pitch", "yaw"))),
            np.array([effect.number(effects, "mount_flexure", axis) for axis in ("roll", "pitch")]),
        ),
        lens.Lens(
            camera.principal_point_px.row,
            camera.principal_point_px.col,
            camera.focal_length_m * (1.0 + effect.number(effects, "focal_length", "scale")) / camera.pixel_pitch_m,
            camera.radial_k1 + effect.number(effects, "radial_distortion", "k1"),
        ),
    )


def frame_times(settings: SimulationSettings, line: Line) -> Array:
    """True mid-exposure times."""
    rate = settings.instrument.camera.frame_rate_hz
    return line.start_s + np.arange(round(line.duration_s * rate)) / rate


def _flat_footprint(settings: SimulationSettings, aircraft: flight.Flight, time: Array, pixels: Array) -> Array:
    """Where the DECLARED camera sees level ground at the mean height: times (n,), pixels (m, 2) → ECEF (n, m, 3)."""
    declared = aim(settings, effect.complete({}))
    position, to_ecef = imaging.camera_poses(aircraft, time, declared.mount, np.zeros(time.size), None)
    slopes = lens.ray(declared.lens, pixels[:, 0], pixels[:, 1])
    direction = np.concatenate([slopes, np.ones((len(slopes), 1))], -1) @ np.swapaxes(to_ecef, -1, -2)
    point = np.broadcast_to(position[:, None], direction.shape)
    for _ in range(10):
        lat, lon, height = geodesy.ecef_to_geodetic(point)
        down = geodesy.ned_to_ecef_dcm(lat, lon)[..., :, 2]
        sink = (height - settings.terrain.height_m) / np.sum(direction * down, -1)
        point = point + sink[..., None] * direction
    return point


def _corners(settings: SimulationSettings) -> Array:
    camera = settings.instrument.camera
    return np.array([[r, c] for r in (-0.5, camera.rows - 0.5) for c in (-0.5, camera.cols - 0.5)])


def draw_terrain(settings: SimulationSettings, aircraft: flight.Flight, seed: int) -> world.Terrain:
    section = settings.terrain
    time = np.concatenate([frame_times(settings, line) for line in settings.lines])
    lat, lon, _ = geodesy.ecef_to_geodetic(_flat_footprint(settings, aircraft, time, _corners(settings)))
    meridian, vertical = geodesy.radii_of_curvature(lat.mean())
    d_lat = section.margin_m / float(meridian)
    d_lon = section.margin_m / float(vertical * np.cos(lat.mean()))
    return world.draw_terrain(
        (lat.min() - d_lat, lon.min() - d_lon, lat.max() + d_lat, lon.max() + d_lon),
        section.cell_m,
        section.height_m,
        section.relief_sigma_m,
        section.wavelength_m,
        section.waves,
        stream(seed, "terrain"),
    )


def _plane(settings: SimulationSettings, aircraft: flight.Flight, line: Line) -> world.Plane:
    """Tangent under the middle of the line, turned to the mean course of the aircraft over it."""
    time = frame_times(settings, line)
    principal = settings.instrument.camera.principal_point_px
    middle = _flat_footprint(settings, aircraft, time[time.size // 2][None], np.array([[principal.row, principal.col]]))
    lat, lon, height = (float(v) for v in geodesy.ecef_to_geodetic(middle[0, 0]))
    ends = aircraft.position(time[[0, -1]])
    north, east, _ = geodesy.ned_to_ecef_dcm(lat, lon).T @ (ends[1] - ends[0])
    return world.Plane.at(lat, lon, height, float(np.arctan2(east, north)))


def _panels(truth: Truth, line: Line, plane: world.Plane) -> world.Panels:
    """Panels along the middle of the track, evenly spaced where each crosses all columns."""
    settings, aircraft = truth.settings, truth.aircraft
    camera, section = settings.instrument.camera, settings.scene
    time = frame_times(settings, line)
    principal = camera.principal_point_px
    track = plane.coordinates(
        _flat_footprint(settings, aircraft, time, np.array([[principal.row, principal.col]]))[:, 0]
    )
    along_rate, along_start = np.polyfit(time - time[0], track[:, 0], 1)
    height = float(np.mean(geodesy.ecef_to_geodetic(aircraft.position(time))[2])) - settings.terrain.height_m
    pixel = height * camera.pixel_pitch_m / camera.focal_length_m
    first = along_start + pixel * (principal.col + 1.0) + section.panel_margin_m
    last = along_start + along_rate * (time[-1] - time[0]) - pixel * (camera.cols - principal.col)
    last -= section.panel_margin_m
    count = len(line.panels)
    spacing = (last - first) / max(count - 1, 1)
    if last < first or (count > 1 and spacing < 1.2 * section.panel_size_m):
        raise ValueError(
            f"lines.{line.id}: {line.duration_s} s leave {last - first:.0f} m for {count} panels of "
            f"{section.panel_size_m} m that cross all columns; fly longer or lay fewer"
        )
    along = np.linspace(first, last, count) if count > 1 else np.array([0.5 * (first + last)])
    crossing = camera.cols * pixel / along_rate
    middle_time = (along - along_start) / along_rate + time[0]
    across = np.array([track[np.abs(time - t) <= 0.5 * crossing, 1].mean() for t in middle_time])
    scatter = stream(truth.seed, "panels", line.id)
    across += scatter.uniform(-section.panel_scatter_m, section.panel_scatter_m, count)
    centre = np.stack([along, across], -1)
    return world.Panels(
        centre,
        world.on_terrain(plane, truth.terrain, centre),
        np.full(count, section.panel_size_m),
        np.array([truth.materials.index(name) for name in line.panels]),
    )


def lay_scene(truth: Truth, line: Line) -> imaging.Scene:
    settings, section = truth.settings, truth.settings.scene
    plane = _plane(settings, truth.aircraft, line)
    seen = plane.coordinates(
        _flat_footprint(settings, truth.aircraft, frame_times(settings, line), _corners(settings))
    ).reshape(-1, 2)
    corner = seen.min(axis=0) - settings.terrain.margin_m
    texture = world.draw_texture(
        corner,
        seen.max(axis=0) + settings.terrain.margin_m - corner,
        section.cell_m,
        np.array(list(section.background.values())),
        section.contrast,
        section.patch_m,
        stream(truth.seed, "texture", line.id),
    )
    return imaging.Scene(
        truth.terrain,
        plane,
        _panels(truth, line, plane),
        texture,
        np.array([truth.materials.index(name) for name in section.background]),
    )
