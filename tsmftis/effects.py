"""Effects that a declared instrument may lack: their names, stages, parameters, units and bounds, as pure data.

A value is what must be ADDED to the declared model to match the data; every null is zero. How an effect changes a model stands
beside that model; how it arises in nature is written anew in `tsmftis.simulator`. The table is that of docs/campaign-format.md.

Functions
---------
amounts         an effect's parameters out of a set of effects, zero where they are not given
scalars         names of an effect's parameters one by one: a list of three as gyro.x, gyro.y, gyro.z
nested          values by such names → lists of three where an effect has them
refuse_others   ValueError on what is no effect on the models of certain stages
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Effects = Mapping[
    str, Mapping[str, float]
]  # by name and parameter; those that are lists of three are in EFFECTS[…].lists


@dataclass(frozen=True)
class Effect:
    """The stage whose model it changes; each parameter's unit, and its largest magnitude that is believed.

    least: where not every value of that magnitude makes sense; lists: parameters of three values, one an axis.
    """

    stage: str
    units: Mapping[str, str]
    largest: Mapping[str, float]
    least: Mapping[str, float] = field(default_factory=dict)
    lists: frozenset[str] = frozenset()


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
        {"half_width": 0.01},
        frozenset({"gyro", "accel"}),
    ),
    "thermal_lag": Effect("thermal", {"lag": "s"}, {"lag": 1e4}, {"lag": 0.0}),
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
    "detector_nonlinearity": _effect("spectral", "1", 0.9, "a"),
    "channel_fringe": Effect(
        "spectral",
        {"amplitude": "1", "thickness": "m", "phase": "rad"},
        {"amplitude": 0.9, "thickness": 0.1, "phase": 10.0},
    ),
    "response_scale": Effect("spectral", {"scale": "1"}, {"scale": 1.0}, {"scale": -0.9}),
}


def amounts(effects: Effects, name: str) -> tuple[float, ...]:
    """The values of an effect's parameters, in the table's order; zero where the effect or a parameter is not given."""
    given = effects.get(name, {})
    return tuple(given.get(key, 0.0) for key in EFFECTS[name].units)


def scalars(name: str) -> dict[str, str]:
    """Scalar parameter → key in `EFFECTS[name].units`: {"half_width": "half_width", "gyro.x": "gyro", …}."""
    effect = EFFECTS[name]
    return {
        scalar: key
        for key in effect.units
        for scalar in ([f"{key}.{axis}" for axis in XYZ] if key in effect.lists else [key])
    }


def nested(values: Effects) -> dict[str, dict[str, Any]]:
    """Every parameter of the named effects, those of `scalars` gathered into tuples of three; zero where not given."""
    out: dict[str, dict[str, Any]] = {}
    for name, given in values.items():
        effect = EFFECTS[name]
        out[name] = {
            key: tuple(given.get(f"{key}.{axis}", 0.0) for axis in XYZ) if key in effect.lists else given.get(key, 0.0)
            for key in effect.units
        }
    return out


def refuse_others(effects: Mapping[str, Mapping[str, Any]], *stages: str) -> None:
    """Raise ValueError where a name is no effect on these stages' models, or has no such parameter."""
    for name, values in effects.items():
        known = EFFECTS.get(name)
        if known is None or known.stage not in stages or set(values) - set(known.units):
            raise ValueError(f"{name}: {dict(values)} is no effect on a model of {', '.join(stages)}")
