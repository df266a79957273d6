"""Settings and a seed → a simulated campaign. Effects change the truth and never what is declared."""

from __future__ import annotations

from typing import Any

import numpy as np

from stages.simulation.ground import Camera, Truth, aim, draw_terrain
from stages.simulation.light import calibrate, detect
from stages.simulation.line import image_line
from stages.simulation.records import Array, SimulatedCampaign
from stages.simulation.sensors import (
    DEG,
    Sensors,
    draw_sensors,
    fly,
    hand_over,
    record_chamber,
    record_fixes,
    record_flight,
)
from stages.simulation.settings import SimulationSettings
from tsmftis.simulator import effects as effect
from tsmftis.simulator import imaging
from tsmftis.simulator.streams import stream


def run(settings: SimulationSettings, seed: int) -> SimulatedCampaign:
    """The campaign of these settings; the same seed gives the same arrays.

    Raises ValueError where the settings cannot be flown: a line outside the flight, too short for its panels, or
    looking beyond the terrain.
    """
    effects = effect.complete(settings.effects)
    aircraft = fly(settings, seed)
    sensors = draw_sensors(settings, effects, seed)
    imu, ideal_gyro, warmth = record_flight(settings, aircraft, sensors, seed)
    terrain = draw_terrain(settings, aircraft, seed)
    calibration = calibrate(settings, seed)
    camera = aim(settings, effects)
    flexes = bool(camera.mount.flexure.any())
    truth = Truth(
        settings,
        seed,
        effects,
        aircraft,
        camera,
        warmth,
        imaging.angular_acceleration(imu.time, ideal_gyro, settings.instrument.imu.rate_hz) if flexes else None,
        terrain.raised(effect.number(effects, "dem_bias", "height")),
        calibration,
        *detect(settings, effects, calibration),
    )
    true_time = _times(settings, aircraft.path.duration)
    geodetic, attitude = aircraft.navigation(true_time)
    return SimulatedCampaign(
        settings,
        seed,
        imu,
        record_fixes(settings, effects, aircraft, seed),
        hand_over(settings, aircraft, seed),
        {
            "train": record_chamber(settings, settings.chamber.train, sensors, stream(seed, "chamber", "train")),
            "verify": record_chamber(settings, settings.chamber.verify, sensors, stream(seed, "chamber", "verify")),
        },
        tuple(image_line(truth, line) for line in settings.lines),
        calibration,
        terrain,
        true_time,
        geodetic,
        attitude,
        _record(settings, effects, camera, sensors, seed),
    )


def _times(settings: SimulationSettings, duration: float) -> Array:
    """Ten a second, and every IMU stamp inside the lines."""
    rate = settings.instrument.imu.rate_hz
    inside = [
        np.arange(np.ceil(line.start_s * rate), np.floor((line.start_s + line.duration_s) * rate) + 1) / rate
        for line in settings.lines
    ]
    coarse = np.arange(int(duration * 10.0)) / 10.0
    return np.unique(np.round(np.concatenate([coarse, *inside]), 9))


def _record(
    settings: SimulationSettings, effects: effect.Effects, camera: Camera, sensors: Sensors, seed: int
) -> dict[str, Any]:
    """What truth.json says."""
    declared = settings.instrument
    fringes, mounting = declared.interferometer, declared.mounting
    boresight = np.array(mounting.boresight_deg.triple()) * DEG
    boresight = boresight + effect.triple(effects, "boresight", ("roll", "pitch", "yaw"))
    lever = np.array(mounting.imu_to_antenna_m) + effect.triple(effects, "antenna_lever_arm")
    return {
        "seed": seed,
        "effects": settings.effects,
        "undeclared": settings.effects,
        "lines": {line.id: {"t0": line.start_s, "t1": line.start_s + line.duration_s} for line in settings.lines},
        "camera": {
            "boresight": boresight.tolist(),
            "focal": camera.lens.focal * declared.camera.pixel_pitch_m,
            "k1": camera.lens.k1,
            "r0": camera.lens.row0,
            "c0": camera.lens.col0,
        },
        "lever": lever.tolist(),
        "imu": {
            "gyro_scale_factor": sensors.errors.gyro_scale.tolist(),
            "accel_scale_factor": sensors.errors.accel_scale.tolist(),
        },
        "interferometer": {
            "opd_step": fringes.opd_step_m * (1.0 + effect.number(effects, "opd_scale", "scale")),
            "zpd_col": fringes.zpd_col,
            "opd_quad": fringes.opd_quadratic_m + effect.number(effects, "opd_quadratic", "quadratic"),
            "tilt": fringes.fringe_tilt_m_per_row + effect.number(effects, "fringe_tilt", "tilt"),
            "visibility": settings.detector.visibility,
            "phase": settings.detector.phase_rad,
            "nonlin": fringes.detector_nonlinearity + effect.number(effects, "detector_nonlinearity", "a"),
        },
    }
