"""Effects that a declared instrument may lack: their names, stages, parameters and units, as pure data.

A value is what must be ADDED to the declared model to match the data; every null is zero. How an effect changes a model stands
beside that model; how it arises in nature is written anew in `tsmftis.simulator`. The table is that of docs/campaign-format.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Effect:
    """The stage whose model it changes, and the unit of each parameter."""

    stage: str
    units: Mapping[str, str]


def _axes(unit: str) -> dict[str, str]:
    return {"x": unit, "y": unit, "z": unit}


EFFECTS: Mapping[str, Effect] = {
    "antenna_lever_arm": Effect("navigation", _axes("m")),
    "gnss_latency": Effect("navigation", {"latency": "s"}),
    "gyro_scale_factor": Effect("navigation", _axes("1")),
    "accel_scale_factor": Effect("navigation", _axes("1")),
    "gyro_g_sensitivity": Effect("navigation", _axes("rad s-1 per m s-2")),
    "thermal_hysteresis": Effect("thermal", {"half_width": "K", "gyro": "rad s-1", "accel": "m s-2"}),
    "thermal_lag": Effect("thermal", {"lag": "s"}),
    "camera_latency": Effect("geometry", {"latency": "s"}),
    "boresight": Effect("geometry", {"roll": "rad", "pitch": "rad", "yaw": "rad"}),
    "boresight_thermal_drift": Effect("geometry", {"roll": "rad/K", "pitch": "rad/K", "yaw": "rad/K"}),
    "mount_flexure": Effect("geometry", {"roll": "rad per rad s-2", "pitch": "rad per rad s-2"}),
    "focal_length": Effect("geometry", {"scale": "1"}),
    "radial_distortion": Effect("geometry", {"k1": "1"}),
    "dem_bias": Effect("geometry", {"height": "m"}),
    "opd_scale": Effect("spectral", {"scale": "1"}),
    "opd_quadratic": Effect("spectral", {"quadratic": "m per column²"}),
    "fringe_tilt": Effect("spectral", {"tilt": "m per row"}),
    "detector_nonlinearity": Effect("spectral", {"a": "1"}),
    "channel_fringe": Effect("spectral", {"amplitude": "1", "thickness": "m", "phase": "rad"}),
    "response_scale": Effect("spectral", {"scale": "1"}),
}
