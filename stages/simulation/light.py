"""What the instrument makes of light: its calibration, and the signal of every material at every pixel."""

from __future__ import annotations

import numpy as np

from stages.simulation.records import Array, Calibration
from stages.simulation.settings import SimulationSettings
from tsmftis.simulator import effects as effect
from tsmftis.simulator import interferometer, materials
from tsmftis.simulator.streams import stream


def calibrate(settings: SimulationSettings, seed: int) -> Calibration:
    camera, section, light = settings.instrument.camera, settings.detector, settings.light
    rng = stream(seed, "detector")
    rows, cols = np.indices((camera.rows, camera.cols))
    radius = np.hypot(rows / (camera.rows - 1) - 0.5, cols / (camera.cols - 1) - 0.5) / np.hypot(0.5, 0.5)
    shape = (camera.rows, camera.cols)
    flat = (1.0 - section.vignetting * radius**2) * (1.0 + section.pixel_gain_sigma * rng.standard_normal(shape))
    dark = section.dark_dn + section.dark_sigma_dn * rng.standard_normal(shape)
    count = round((light.wavenumber_stop_per_m - light.wavenumber_start_per_m) / light.wavenumber_step_per_m)
    wavenumber = light.wavenumber_start_per_m + light.wavenumber_step_per_m * np.arange(count, dtype=np.float64)
    sun = light.radiance_scale * materials.illumination(wavenumber)
    names = dict.fromkeys(name for line in settings.lines for name in line.panels)
    return Calibration(
        # What single precision holds is the truth, so that the file and the frames agree to the last bit.
        np.maximum(dark, 0.0).astype(np.float32).astype(float),
        flat.astype(np.float32).astype(float),
        wavenumber,
        materials.response(
            wavenumber,
            section.response_peak_dn_per_radiance_per_m,
            section.response_centre_nm,
            section.response_width_nm,
            settings.instrument.interferometer.wavelength_range_nm,
            section.response_edge_per_m,
        ),
        {name: sun * materials.reflectance(name, wavenumber) for name in names},
    )


def detect(settings: SimulationSettings, effects: effect.Effects, calibration: Calibration) -> tuple[Array, list[str]]:
    """Signal of every material at every pixel (material, row, col) [DN], and the materials' names in order."""
    camera, declared = settings.instrument.camera, settings.instrument.interferometer
    order = list(dict.fromkeys([*calibration.references, *settings.scene.background]))
    sun = settings.light.radiance_scale * materials.illumination(calibration.wavenumber)
    radiance = np.stack([sun * materials.reflectance(name, calibration.wavenumber) for name in order])
    response = (
        calibration.response
        * (1.0 + effect.number(effects, "response_scale", "scale"))
        * interferometer.channel_fringe(
            calibration.wavenumber,
            *effect.triple(effects, "channel_fringe", ("amplitude", "thickness", "phase")),
        )
    )
    opd = interferometer.path_difference(
        camera.rows,
        camera.cols,
        declared.opd_step_m * (1.0 + effect.number(effects, "opd_scale", "scale")),
        declared.zpd_col,
        declared.opd_quadratic_m + effect.number(effects, "opd_quadratic", "quadratic"),
        declared.fringe_tilt_m_per_row + effect.number(effects, "fringe_tilt", "tilt"),
    )
    phase = materials.phase(calibration.wavenumber, np.array(settings.detector.phase_rad))
    signal = interferometer.interferogram(
        opd, calibration.wavenumber, response, radiance, phase, settings.detector.visibility
    )
    return signal, order
