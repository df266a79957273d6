"""How an error that the filter does not know of shows in its innovations: the filter's own recursion, run on derivatives.

    e⁻ = Φ·e + Φ_b·E·u,     shown = H·e⁻ + d,     e = e⁻ − K·shown

e (n, q) true minus estimated state, one column for each error; u (q,) what a column's sensor has too much over an epoch: one (a
bias), the mean rate (a scale factor or a misalignment) or the mean specific force (a g-sensitivity); Φ_b the columns of Φ that
belong to the biases; d what a measurement has too much by itself (an offset of the antenna, velocities that lag).

Classes
-------
Inputs       the errors: e at the start, what they feed, what they show

Functions
---------
carried      `shown` of every measurement
signals      mean rate and mean specific force of every epoch
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from pipeline.records import Imu
from stages.navigation import kalman, states
from stages.navigation.states import NAVIGATION

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NONE = -1
RATE, FORCE = np.arange(3), np.arange(3, 6)  # columns of `signals`


@dataclass(frozen=True)
class Inputs:
    """start (n, q), in the states' units; sensor (q,): which of the six biases' places a column feeds, gyros first, or NONE;
    source (q,): the signal it is multiplied by; direct (m, 6, k) [m, m/s]: what columns `shows` (k,) add to every measurement by
    themselves."""

    start: Array
    sensor: Index
    source: Index
    shows: Index
    direct: Array

    @classmethod
    def none(cls, states: int, columns: int, measurements: int, shows: Index) -> Inputs:
        """Columns that do nothing yet, `shows` of them with room for what they show."""
        nothing = np.full(columns, NONE, np.int64)
        return cls(
            np.zeros((states, columns)), nothing, np.zeros(columns, np.int64), shows,
            np.zeros((measurements, 6, shows.size)),
        )  # fmt: skip


def signals(imu: Imu, store: kalman.Store, count: int) -> Array:
    """(count − 1, 6): means of rate [rad/s] and specific force [m/s²] between the ends of epochs, in body axes."""
    summed = cumulative_trapezoid(np.hstack([imu.gyro, imu.accel]), imu.time, axis=0, initial=0.0)
    ends = store.epoch_time[:count]
    between = np.diff(np.stack([np.interp(ends, imu.time, s) for s in summed.T], -1), axis=0)
    span = np.maximum(np.diff(ends), 1e-9)
    return np.asarray(between / span[:, None])


def carried(store: kalman.Store, count: int, active: Index, inputs: Inputs, signal: Array) -> Array:
    """`shown` (m, 6, q) of every measurement that the filter used; zero elsewhere.

    signal (count − 1, s): what the columns' sources are.
    """
    out = np.zeros((store.rows.size, 6, inputs.sensor.size))
    biases = np.searchsorted(active, np.arange(states.GROUPS["gyro_bias"].start, states.GROUPS["accel_bias"].stop))
    _carry(
        count, active, store, inputs.start.copy(), biases, inputs.sensor, inputs.source, signal, inputs.shows,
        inputs.direct, out,
    )  # fmt: skip
    return out


@numba.njit(cache=True, nogil=True)
def _carry(count, active, store, error, biases, sensor, source, signal, shows, direct, out):  # type: ignore[no-untyped-def]
    """`error` (n, q) is used up."""
    n = active.size
    for e in range(1, count):
        phi, decay = store.epoch_phi[e - 1], store.epoch_decay[e - 1]
        moved = phi @ error
        for c in range(sensor.size):
            if sensor[c] >= 0:
                for i in range(NAVIGATION):
                    moved[i, c] += phi[i, biases[sensor[c]]] * signal[e - 1, source[c]]
        for j in range(NAVIGATION, n):
            s = active[j] - NAVIGATION
            if s < 6:
                error[j] *= decay[s]
        error[:NAVIGATION] = moved
        at = store.epoch_measurement[e]
        if at >= 0:
            m = store.rows[at]
            shown = np.ascontiguousarray(store.H[at, :m]) @ error
            for i in range(m):
                for c in range(sensor.size):
                    if sensor[c] >= 0:  # of the rate in ω×l, and of what a standstill shows
                        shown[i, c] += store.H[at, i, biases[sensor[c]]] * signal[e - 1, source[c]]
                for k in range(shows.size):
                    shown[i, shows[k]] += direct[at, i, k]
            out[at, :m] = shown
            error -= np.ascontiguousarray(store.K[at, :, :m]) @ shown
