"""Temperatures in and around inertial sensors, and the biases they cause.

The air drives each sensor's shell through a first-order lag; the shell drives the inside through another; each node is
warmer than the air by its self-heating:

    τ_s ẏ_s = u − y_s,    τ_n ẏ_n = y_s − y_n,    T_n = y_n + offset_n.

A gyro has the nodes anode, cathode, shell; an accelerometer has one. The bias of an axis is a smooth law of T, dT/dt
and (gyro) the gradients anode − shell and cathode − shell, T the mean of the axis' nodes; laws are drawn from a seed.

Functions
---------
piecewise           air temperature along a profile
settle              node temperatures
draw_nodes, draw_law
bias                laws, play and lag → bias
thermometers        what is read

References
----------
.. [1] The paper's thermal model; M. A. Krasnosel'skii and A. V. Pokrovskii, Systems with Hysteresis (play operator).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]


def piecewise(start: float, stages: Sequence[tuple[float, float]], time: Array) -> Array:
    """Air temperature [°C] at times (n,) [s]: straight lines from start through stages (duration [s], target [°C])."""
    at = np.concatenate([[0.0], np.cumsum([duration for duration, _ in stages])])
    return np.interp(time, at, [start, *(target for _, target in stages)])


def lag(u: Array, time_constant: Array | float, step: float) -> Array:
    """y of τẏ = u − y along the first axis, settled at the start, exact for u straight between samples."""
    tau = np.broadcast_to(np.asarray(time_constant, float), u.shape[1:])
    y = np.empty(u.shape)
    for index in np.ndindex(tau.shape):
        x = u[(slice(None), *index)]
        ratio = tau[index] / step
        if ratio == 0.0:
            y[(slice(None), *index)] = x
            continue
        decay = np.exp(-1.0 / ratio)
        new, old = 1.0 - ratio * (1.0 - decay), ratio * (1.0 - decay) - decay
        y[(slice(None), *index)], _ = lfilter([new, old], [1.0, -decay], x, zi=[(1.0 - new) * x[0]])
    return y


@dataclass(frozen=True)
class Nodes:
    """Time constants [s] and self-heating [K]; gyro (axis, anode cathode shell), accelerometer (axis,).

    The inner nodes' constants are against the shell, the shell's and the accelerometer's against the air.
    """

    gyro_time_constant: Array
    gyro_self_heating: Array
    accel_time_constant: Array
    accel_self_heating: Array


def draw_nodes(
    time_constant: Array,
    self_heating: Array,
    accel_time_constant: float,
    accel_self_heating: float,
    spread: float,
    rng: np.random.Generator,
) -> Nodes:
    """Three axes around nominal values (anode, cathode, shell; accelerometer); the constants scatter by `spread`."""
    return Nodes(
        np.asarray(time_constant) * (1.0 + spread * rng.uniform(-1.0, 1.0, (3, 3))),
        np.tile(np.asarray(self_heating, float), (3, 1)),
        accel_time_constant * (1.0 + spread * rng.uniform(-1.0, 1.0, 3)),
        np.full(3, accel_self_heating),
    )


@dataclass(frozen=True)
class Temperatures:
    """step [s] between samples; gyro (n, axis, anode cathode shell) [°C], accel (n, axis) [°C]."""

    step: float
    gyro: Array
    accel: Array


def settle(air: Array, step: float, nodes: Nodes) -> Temperatures:
    """Node temperatures (n, ...) under the air's (n,) [°C], sampled each `step` [s], settled at the start."""
    driven = np.repeat(air[:, None], 3, axis=1)
    shell = lag(driven, nodes.gyro_time_constant[:, 2], step)
    inside = lag(np.repeat(shell[:, :, None], 2, axis=2), nodes.gyro_time_constant[:, :2], step)
    return Temperatures(
        step,
        np.concatenate([inside, shell[:, :, None]], axis=2) + nodes.gyro_self_heating,
        lag(driven, nodes.accel_time_constant, step) + nodes.accel_self_heating,
    )


@dataclass(frozen=True)
class Law:
    """A smooth random function of normalised features (.., k): bounded waves of random directions, and products.

    f(x) = scale·(Σ_m a_m tanh(w_m·x + c_m) + Σ_m b_m sin(v_m·x + d_m) + x'Qx).
    """

    tanh: tuple[Array, Array, Array]
    sine: tuple[Array, Array, Array]
    product: Array
    scale: float

    def __call__(self, features: Array) -> Array:
        """(..., k) → (...)."""
        a, w, c = self.tanh
        b, v, d = self.sine
        return np.asarray(
            self.scale
            * (
                np.tanh(features @ w.T + c) @ a
                + np.sin(features @ v.T + d) @ b
                + np.einsum("...i,ij,...j->...", features, self.product, features)
            )
        )


# Centre and half range of T [°C], dT/dt [K/s] and gradients [K] over the chamber's profiles.
_CENTRE = np.array([15.0, 0.0, 7.0, 5.0])
_HALF_RANGE = np.array([45.0, 0.025, 12.0, 12.0])
# How strongly laws bend along each: more along T, for a chamber run visits few mixtures of the others.
_BEND = np.array([0.8, 0.35, 0.35, 0.35])


def draw_law(features: int, amplitude: float, rng: np.random.Generator) -> Law:
    """A law of the first `features` of (T, dT/dt, ∇T1, ∇T2); its standard deviation over their range is `amplitude`."""
    terms = 3
    bend = _BEND[:features]
    drawn = Law(
        (rng.normal(0.0, 1.0, terms), bend * rng.normal(0.0, 1.0, (terms, features)), rng.normal(0.0, 0.5, terms)),
        (
            rng.normal(0.0, 0.5, terms),
            bend * rng.normal(0.0, 1.0, (terms, features)),
            rng.uniform(0.0, 2.0 * np.pi, terms),
        ),
        rng.normal(0.0, 0.3, (features, features)) * np.outer(bend, bend),
        1.0,
    )
    spread = drawn(rng.uniform(-1.0, 1.0, (2000, features))).std()
    return Law(drawn.tanh, drawn.sine, drawn.product, amplitude / float(spread))


def play(temperature: Array, half_width: float) -> Array:
    """Backlash operator along the first axis, started at the temperature itself; (n, axis) [°C] → (n, axis)."""
    return np.asarray(_play(np.ascontiguousarray(temperature), half_width))


@numba.njit(cache=True)
def _play(temperature, half_width):  # type: ignore[no-untyped-def]
    out = temperature.copy()
    for i in range(1, out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = min(max(out[i - 1, j], temperature[i, j] - half_width), temperature[i, j] + half_width)
    return out


@dataclass(frozen=True)
class Biases:
    """Thermal laws of the three gyros and the three accelerometers, with what may be missing from a declared model.

    half_width [K] and the amplitudes (3,) [rad/s], [m/s²] of hysteresis; lag [s] of the gyros' T and dT/dt.
    """

    gyro: Sequence[Law]
    accel: Sequence[Law]
    half_width: float
    gyro_hysteresis: Array
    accel_hysteresis: Array
    lag: float

    def __call__(self, temperatures: Temperatures) -> tuple[Array, Array]:
        """Bias of gyros (n, 3) [rad/s] and accelerometers (n, 3) [m/s²] under true node temperatures."""
        step = temperatures.step
        mean = temperatures.gyro.mean(axis=2)
        felt = lag(mean, self.lag, step)
        gyro_features = np.stack(
            [
                felt,
                np.gradient(felt, step, axis=0),
                temperatures.gyro[:, :, 0] - temperatures.gyro[:, :, 2],
                temperatures.gyro[:, :, 1] - temperatures.gyro[:, :, 2],
            ],
            -1,
        )
        accel_features = np.stack([temperatures.accel, np.gradient(temperatures.accel, step, axis=0)], -1)
        gyro_x = (gyro_features - _CENTRE) / _HALF_RANGE
        accel_x = (accel_features - _CENTRE[:2]) / _HALF_RANGE[:2]
        gyro = np.stack([law(gyro_x[:, i]) for i, law in enumerate(self.gyro)], -1)
        accel = np.stack([law(accel_x[:, i]) for i, law in enumerate(self.accel)], -1)
        h = self.half_width
        return (
            gyro + self.gyro_hysteresis * (play(mean, h) - mean) / h,
            accel + self.accel_hysteresis * (play(temperatures.accel, h) - temperatures.accel) / h,
        )


def thermometers(true: Array, noise: float, resolution: float, rng: np.random.Generator) -> Array:
    """Readings [°C]: noise [K] added, then rounded to the resolution [K]."""
    return np.asarray(np.round((true + noise * rng.standard_normal(true.shape)) / resolution) * resolution)
