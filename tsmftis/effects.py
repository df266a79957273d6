"""Effects that a declared instrument may lack: their names, stages, parameters, units and bounds, as pure data.

A value is what must be ADDED to the declared model to match the data; every null is zero. How an effect changes a model stands
beside that model; how it arises in nature is written anew in `tsmftis.simulator`. The table is that of docs/campaign-format.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Effect:
    """The stage whose model it changes; each parameter's unit, and its largest magnitude that is believed."""

    stage: str
    units: Mapping[str, str]
    largest: Mapping[str, float]


def _effect(stage: str, unit: str, largest: float, *names: str) -> Effect:
    """An effect whose parameters share unit and bound."""
    return Effect(stage, dict.fromkeys(names, unit), dict.fromkeys(names, largest))


XYZ, RPY = ("x", "y", "z"), ("roll", "pitch", "yaw")
EFFECTS: Mapping[str, Effect] = {
    "antenna_lever_arm": _effect("navigation", "m", 100.0, *XYZ),
    "gnss_latency": _effect("navigation", "s", 5.0, "latency"),
    "gyro_scale_factor": _effect("navigation", "1", 0.1, *XYZ),
    "accel_scale_factor": _effect("navigation", "1", 0.1, *XYZ),
    "gyro_g_sensitivity": _effect("navigation", "rad s-1 per m s-2", 1e-3, *XYZ),
    "thermal_hysteresis": Effect(
        "thermal",
        {"half_width": "K", "gyro": "rad s-1", "accel": "m s-2"},
        {"half_width": 100.0, "gyro": 0.1, "accel": 1.0},
    ),
    "thermal_lag": _effect("thermal", "s", 1e4, "lag"),
    "camera_latency": _effect("geometry", "s", 5.0, "latency"),
    "boresight": _effect("geometry", "rad", 0.5, *RPY),
    "boresight_thermal_drift": _effect("geometry", "rad/K", 0.01, *RPY),
    "mount_flexure": _effect("geometry", "rad per rad s-2", 0.1, "roll", "pitch"),
    "focal_length": _effect("geometry", "1", 0.5, "scale"),
    "radial_distortion": _effect("geometry", "1", 100.0, "k1"),
    "dem_bias": _effect("geometry", "m", 1e3, "height"),
    "opd_scale": _effect("spectral", "1", 0.5, "scale"),
    "opd_quadratic": _effect("spectral", "m per column²", 1e-8, "quadratic"),
    "fringe_tilt": _effect("spectral", "m per row", 1e-6, "tilt"),
    "detector_nonlinearity": _effect("spectral", "1", 1.0, "a"),
    "channel_fringe": Effect(
        "spectral",
        {"amplitude": "1", "thickness": "m", "phase": "rad"},
        {"amplitude": 1.0, "thickness": 0.1, "phase": 10.0},
    ),
    "response_scale": _effect("spectral", "1", 1.0, "scale"),
}
