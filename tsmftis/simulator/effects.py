"""Effects that the truth may hold and the declared instrument does not.

Names, parameters, units and signs are those of the table "Effect names" in docs/campaign-format.md: a value is what
must be ADDED to the declared model to match the data. How each arises stands where the physics is: `inertial`,
`thermal`, `gnss`, `lens`, `interferometer`, `imaging`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Value = float | tuple[float, ...]
Effects = Mapping[str, Mapping[str, Value]]

NULL: dict[str, dict[str, Value]] = {
    "antenna_lever_arm": {"x": 0.0, "y": 0.0, "z": 0.0},
    "gnss_latency": {"latency": 0.0},
    "gyro_scale_factor": {"x": 0.0, "y": 0.0, "z": 0.0},
    "accel_scale_factor": {"x": 0.0, "y": 0.0, "z": 0.0},
    "gyro_g_sensitivity": {"x": 0.0, "y": 0.0, "z": 0.0},
    "thermal_hysteresis": {"half_width": 1.0, "gyro": (0.0, 0.0, 0.0), "accel": (0.0, 0.0, 0.0)},
    "thermal_lag": {"lag": 0.0},
    "camera_latency": {"latency": 0.0},
    "boresight": {"roll": 0.0, "pitch": 0.0, "yaw": 0.0},
    "boresight_thermal_drift": {"roll": 0.0, "pitch": 0.0, "yaw": 0.0},
    "mount_flexure": {"roll": 0.0, "pitch": 0.0},
    "focal_length": {"scale": 0.0},
    "radial_distortion": {"k1": 0.0},
    "dem_bias": {"height": 0.0},
    "opd_scale": {"scale": 0.0},
    "opd_quadratic": {"quadratic": 0.0},
    "fringe_tilt": {"tilt": 0.0},
    "detector_nonlinearity": {"a": 0.0},
    "channel_fringe": {"amplitude": 0.0, "thickness": 0.0, "phase": 0.0},
    "response_scale": {"scale": 0.0},
}


def complete(effects: Mapping[str, Mapping[str, float | Sequence[float]]]) -> dict[str, dict[str, Value]]:
    """Every effect with every parameter: the given values, the null elsewhere.

    Raises ValueError on a name or parameter that the simulator does not know, or a wrong number of values.
    """
    filled = {name: dict(null) for name, null in NULL.items()}
    for name, parameters in effects.items():
        if name not in NULL:
            raise ValueError(f"effects.{name}: the simulator knows no such effect; it knows {', '.join(NULL)}")
        for key, value in parameters.items():
            if key not in NULL[name]:
                raise ValueError(f"effects.{name}.{key}: no such parameter; {name} has {', '.join(NULL[name])}")
            null = NULL[name][key]
            if isinstance(value, Sequence) != isinstance(null, tuple):
                raise ValueError(f"effects.{name}.{key}: a number or a list of three, as in the campaign format")
            if isinstance(value, Sequence):
                if len(value) != 3:
                    raise ValueError(f"effects.{name}.{key}: three values, not {len(value)}")
                filled[name][key] = tuple(float(v) for v in value)
            else:
                filled[name][key] = float(value)
    half_width = filled["thermal_hysteresis"]["half_width"]
    if not isinstance(half_width, float) or half_width <= 0.0:
        raise ValueError("effects.thermal_hysteresis.half_width: must be positive")
    lag = filled["thermal_lag"]["lag"]
    if not isinstance(lag, float) or lag < 0.0:
        raise ValueError("effects.thermal_lag.lag: must not be negative")
    return filled


def number(effects: Effects, name: str, parameter: str) -> float:
    """One scalar parameter of a completed mapping."""
    value = effects[name][parameter]
    assert isinstance(value, float)
    return value


def triple(effects: Effects, name: str, parameters: Sequence[str] = ("x", "y", "z")) -> tuple[float, float, float]:
    """Three scalar parameters of a completed mapping."""
    x, y, z = (number(effects, name, p) for p in parameters)
    return x, y, z


def values(effects: Effects, name: str, parameter: str) -> tuple[float, ...]:
    """One parameter of a completed mapping that is a list of three."""
    value = effects[name][parameter]
    assert isinstance(value, tuple)
    return value
