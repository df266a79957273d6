"""What a simulation makes: the campaign's data as the campaign holds it, and the truth beside it.

SI units and radians; temperatures in °C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.simulation.settings import SimulationSettings
from tsmftis.simulator.gnss import Fixes
from tsmftis.simulator.world import Panels, Terrain

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InertialRun:
    """time (n,), gyro (n, 3) [rad/s], accel (n, 3) [m/s²]; time_temperature (m,), temperatures (m, 3, 3), (m, 3)."""

    time: Array
    gyro: Array
    accel: Array
    time_temperature: Array
    temperature_gyro: Array
    temperature_accel: Array


@dataclass(frozen=True)
class ChamberRun:
    """An inertial run in the chamber with the air's temperature (n,) [°C], and the true thermal biases (n, 3)."""

    inertial: InertialRun
    temperature_chamber: Array
    gyro_bias: Array
    accel_bias: Array


@dataclass(frozen=True)
class Gcp:
    """A picked point: frame, row, col as picked; latitude, longitude [rad], height [m]."""

    frame: int
    row: float
    col: float
    geodetic: Array


@dataclass(frozen=True)
class SimulatedLine:
    """frames (n, row, col) with their stamps (n,); panels and their reference names; picked points; true IMU pose.

    true_time (n,) [s], position (n, 3) ECEF [m], body_to_ecef (n, 3, 3).
    """

    id: str
    frames: NDArray[np.uint16]
    stamp: Array
    panels: Panels
    references: tuple[str, ...]
    gcps: tuple[Gcp, ...]
    true_time: Array
    position: Array
    body_to_ecef: Array


@dataclass(frozen=True)
class Calibration:
    """dark, flat (row, col); wavenumber (k,) [1/m]; response (k,); references: name → radiance (k,)."""

    dark: Array
    flat: Array
    wavenumber: Array
    response: Array
    references: Mapping[str, Array]


@dataclass(frozen=True)
class SimulatedCampaign:
    """Everything that `write` puts on disk. `terrain` is the declared one; `truth` goes to truth.json as it stands.

    true_time (n,), true_geodetic (n, 3), true_attitude (n, 3) roll, pitch, yaw: the trajectory of the IMU.
    """

    settings: SimulationSettings
    seed: int
    imu: InertialRun
    gnss: Fixes
    initial: Mapping[str, float] | None
    chamber: Mapping[str, ChamberRun]
    lines: tuple[SimulatedLine, ...]
    calibration: Calibration
    terrain: Terrain
    true_time: Array
    true_geodetic: Array
    true_attitude: Array
    truth: Mapping[str, Any]
