"""Named parameters of the inertial unit's random errors, in SI."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tsmftis.geodesy import STANDARD_GRAVITY

DEG_PER_H = np.deg2rad(1.0) / 3600.0  # rad/s
MICRO_G = 1e-6 * STANDARD_GRAVITY  # m/s²


@dataclass(frozen=True)
class SensorModel:
    """A triad: white noise [unit/√Hz], Gauss–Markov bias sigma [unit] and correlation time [s], scale factor sigma [1]."""

    white_noise: float
    bias_sigma: float
    bias_correlation_time: float
    scale_factor_sigma: float


@dataclass(frozen=True)
class ImuModel:
    """Nominal rate [Hz], gyro triad (rad/s) and accelerometer triad (m/s²)."""

    rate: float
    gyro: SensorModel
    accel: SensorModel
