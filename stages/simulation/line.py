"""A flight line: its frames and the points picked in them."""

from __future__ import annotations

import numpy as np

from stages.simulation.ground import Truth, frame_times, lay_scene
from stages.simulation.records import Array, Gcp, SimulatedLine
from stages.simulation.settings import Line, SimulationSettings
from tsmftis import geodesy
from tsmftis.simulator import effects as effect
from tsmftis.simulator import imaging, interferometer, lens, world
from tsmftis.simulator.streams import stream

_FRAME_BLOCK = 64  # frames in floating point at a time


def image_line(truth: Truth, line: Line) -> SimulatedLine:
    settings, camera = truth.settings, truth.camera
    section, declared = settings.detector, settings.instrument.camera
    scene = lay_scene(truth, line)
    time = frame_times(settings, line)
    if section.exposure_s > 0.0:
        instants = section.exposure_s * ((np.arange(section.exposure_instants) + 0.5) / section.exposure_instants - 0.5)
    else:
        instants = np.zeros(1)
    position, to_ecef = truth.poses((time[:, None] + instants).ravel())
    position = position.reshape(time.size, instants.size, 3)
    to_ecef = to_ecef.reshape(time.size, instants.size, 3, 3)

    nonlinearity = settings.instrument.interferometer.detector_nonlinearity
    nonlinearity += effect.number(truth.effects, "detector_nonlinearity", "a")
    noise = stream(truth.seed, "frames", line.id)
    frames = np.empty((time.size, declared.rows, declared.cols), np.uint16)
    for start in range(0, time.size, _FRAME_BLOCK):
        block = slice(start, start + _FRAME_BLOCK)
        ideal = imaging.expose(
            position[block], to_ecef[block], camera.lens, scene, truth.signal, settings.scene.samples_per_pixel_side
        )
        frames[block] = imaging.digitise(
            interferometer.saturate(truth.calibration.flat * ideal, nonlinearity),
            truth.calibration.dark,
            section.electrons_per_dn,
            section.read_noise_dn,
            declared.saturation_dn,
            noise,
        )
    latency = declared.latency_s + effect.number(truth.effects, "camera_latency", "latency")
    return SimulatedLine(
        line.id,
        frames,
        time + latency,
        scene.panels,
        tuple(line.panels),
        _gcps(settings, scene, camera.lens, *truth.poses(time), stream(truth.seed, "gcps", line.id)),
        time,
        truth.aircraft.position(time),
        truth.aircraft.attitude(time),
    )


def _gcps(
    settings: SimulationSettings,
    scene: imaging.Scene,
    optics: lens.Lens,
    position: Array,
    to_ecef: Array,
    rng: np.random.Generator,
) -> tuple[Gcp, ...]:
    """Corners of panels and points of the ground by turns, each picked in a random frame that shows it."""
    declared, section = settings.instrument.camera, settings.gcps
    shape = np.array([declared.rows, declared.cols])
    picked: list[Gcp] = []
    for _ in range(200 * section.per_line):
        if len(picked) == section.per_line:
            break
        frame = int(rng.integers(len(position)))
        if len(picked) % 2 == 0:
            panel = int(rng.integers(len(scene.panels.side)))
            corner = scene.panels.centre[panel] + 0.5 * scene.panels.side[panel] * rng.choice([-1.0, 1.0], 2)
        else:
            pixel = rng.uniform(3.0, shape - 4.0)
            slope = lens.ray(optics, pixel[0], pixel[1])
            direction = to_ecef[frame] @ np.append(slope, 1.0)
            hit = imaging.cast(position[frame][None], (direction / np.linalg.norm(direction))[None], scene.terrain)
            corner = scene.plane.coordinates(hit[0])
        geodetic = world.on_terrain(scene.plane, scene.terrain, corner[None])[0]
        true = lens.find(optics, position[frame], to_ecef[frame], geodesy.geodetic_to_ecef(*geodetic))
        if (true < 2.0).any() or (true > shape - 3.0).any():
            continue
        row, col = true + section.sigma_px * rng.standard_normal(2)
        picked.append(Gcp(frame, float(row), float(col), geodetic))
    return tuple(picked)
