"""What a unit remembers of its temperatures: effects of a model update that no function of the present readings has.

    bias gains A·(play(T; h) − T)/h,   T and Ṫ of a gyro are those of y with τ·ẏ = T − y

with T the mean of an axis' thermometers. play is the backlash operator [1]_: it follows T at a distance of at most h and
begins at T; y begins at T too.

Classes and functions
---------------------
Memory      h, A and τ of a unit
means       mean temperatures that the play follows
behind      how far the play is behind them, in half widths
play        backlash operator
lagged      first-order lag

References
----------
.. [1] M. A. Krasnosel'skii, A. V. Pokrovskii, Systems with Hysteresis, Springer 1989.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pipeline.records import Temperatures
from stages.thermal.features import STEPS_PER_TIME_CONSTANT, smoothed
from tsmftis.effects import refuse_others

Array = NDArray[np.float64]
Three = tuple[float, float, float]

NOTHING: Three = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Memory:
    """half_width h [K], amplitudes A of gyro [rad/s] and accelerometer [m/s²], lag τ [s]; all zero: no memory."""

    half_width: float = 0.0
    gyro: Three = NOTHING
    accel: Three = NOTHING
    lag: float = 0.0

    @classmethod
    def of(cls, effects: Mapping[str, Mapping[str, Any]]) -> Memory:
        """That of thermal_hysteresis and thermal_lag; ValueError on other effects, or amplitudes without a half width."""
        refuse_others(effects, "thermal")
        play_of, lag = effects.get("thermal_hysteresis", {}), float(effects.get("thermal_lag", {}).get("lag", 0.0))
        gyro, accel = (_three(play_of.get(key, NOTHING)) for key in ("gyro", "accel"))
        memory = cls(float(play_of.get("half_width", 0.0)), gyro, accel, lag)
        if memory.lag < 0.0 or (memory.plays and memory.half_width <= 0.0):
            raise ValueError(f"{dict(effects)}: half_width must be positive, lag not negative")
        return memory

    @property
    def plays(self) -> bool:
        return any((*self.gyro, *self.accel))

    def felt(self, temperatures: Temperatures) -> Array:
        """Mean temperature (m, 6) that the features of gyros and accelerometers are made of, at the readings."""
        gyro = temperatures.gyro.mean(axis=2)
        if self.lag > 0.0:
            gyro = lagged(temperatures.time, gyro, self.lag)
        return np.column_stack([gyro, temperatures.accel])

    def bias(self, temperatures: Temperatures, at: Array, smoothing_s: float, causal: bool = False) -> Array:
        """What the play adds to the biases of the six channels (n, 6) at times (n,) [s], of smoothed readings."""
        if not self.plays:
            return np.zeros((len(at), 6))
        time, mean = means(temperatures, smoothing_s, causal)
        return behind(time, mean, self.half_width, at) * [*self.gyro, *self.accel]


def means(temperatures: Temperatures, smoothing_s: float, causal: bool = False) -> tuple[Array, Array]:
    """Times (m,) and smoothed mean temperature of the six channels' thermometers (m, 6) there, which the play follows."""
    time = temperatures.time
    step = smoothing_s / STEPS_PER_TIME_CONSTANT
    if float(np.median(np.diff(time))) < 0.5 * step:
        time = np.linspace(time[0], time[-1], int(np.ceil((time[-1] - time[0]) / step)) + 1)
    return time, smoothed(temperatures.time, Memory().felt(temperatures), time, smoothing_s, causal)[0]


def behind(time: Array, mean: Array, half_width: float, at: Array) -> Array:
    """(play(T; h) − T)/h of temperatures (m, q) at times (m,), at times (n,): (n, q)."""
    values = (play(mean, half_width) - mean) / half_width
    return np.stack([np.interp(at, time, column) for column in values.T], -1)


def _three(values: Any) -> Three:
    x, y, z = (float(v) for v in values)
    return x, y, z


def play(values: Array, half_width: float) -> Array:
    """p_i = min(max(p_{i−1}, T_i − h), T_i + h), p_0 = T_0; (n, q) → (n, q)."""
    return np.asarray(_play(np.ascontiguousarray(values, np.float64), half_width))


def lagged(time: Array, values: Array, time_constant: float) -> Array:
    """y of τ·ẏ = T − y with y_0 = T_0, exact for T straight between readings at times (n,) [s]; (n, q) → (n, q).

    After a step Δ with the slope r: y = T_i − rτ + (y_{i−1} − T_{i−1} + rτ)·exp(−Δ/τ).
    """
    return np.asarray(_lagged(time, np.ascontiguousarray(values, np.float64), time_constant))


@numba.njit(cache=True)
def _play(values: Any, half_width: float) -> Any:
    out = values.copy()
    for i in range(1, out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = min(max(out[i - 1, j], values[i, j] - half_width), values[i, j] + half_width)
    return out


@numba.njit(cache=True)
def _lagged(time: Any, values: Any, time_constant: float) -> Any:
    out = values.copy()
    for i in range(1, out.shape[0]):
        step = time[i] - time[i - 1]
        decay = np.exp(-step / time_constant)
        for j in range(out.shape[1]):
            ramp = (values[i, j] - values[i - 1, j]) / step * time_constant
            out[i, j] = values[i, j] - ramp + (out[i - 1, j] - values[i - 1, j] + ramp) * decay
    return out
