"""What the filter is told besides the inertial data, as one list in order of time.

Functions
---------
withheld        fixes that the settings keep from the filter
at_instants     rate and force at the instant of a fix
gather          fixes, standstill windows and, in free-inertial mode, heights → `kalman.Measurements`
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pipeline.records import DATA_GAP, GNSS_QUALITIES, Gnss, Imu
from stages.navigation import kalman
from stages.navigation.settings import NavigationSettings
from stages.navigation.standstill import Standstill

Array = NDArray[np.float64]

STANDSTILL_STEP = 2  # windows: every second one is used, so that sway is not counted as often as it is sampled
BLOCK, EDGE = 50_000, 32  # samples at a time, and beyond either side: a spline forgets its ends in a dozen
BAROMETER_STEP = 1.0  # s between heights in free-inertial mode


@dataclass(frozen=True)
class Gathered:
    """The measurements, the true time that each fix stands for, and for each fix its place among the measurements (m,)."""

    measurements: kalman.Measurements
    fix_time: Array
    of_fix: NDArray[np.int64]


def withheld(time: Array, settings: NavigationSettings) -> NDArray[np.bool_]:
    """Which fixes at `time` (n,) [s] the settings keep from the filter."""
    out = np.zeros(time.size, np.bool_)
    for start, stop in settings.withhold_s:
        out |= (time >= start) & (time <= stop)
    if settings.withhold_every_s is not None and time.size:
        period, length = settings.withhold_every_s
        out |= (time - time[0]) % period >= period - length
    if settings.free_inertial_after_s is not None:
        out |= time > settings.free_inertial_after_s
    return out


def _in_gap(time: Array, wanted: Array) -> NDArray[np.bool_]:
    """Which times lie inside a gap of the stamps: how the body moved there is not known, so a fix says nothing of it."""
    after = np.clip(np.searchsorted(time, wanted), 1, time.size - 1)
    return np.asarray(time[after] - time[after - 1] > DATA_GAP * np.median(np.diff(time)))


def at_instants(time: Array, means: Array, wanted: Array, derivative: int = 0) -> Array:
    """Instantaneous values (m, 3) at `wanted` [s] (sorted), or their first `derivative`, of what was recorded as
    means over the intervals that end at `time`.

    The derivative of a cubic spline through the running integral: at half the Nyquist frequency it is 5 % short, where
    interpolating the means is 36 % short, which would take a lever arm in a vibrating body for longer than it is.
    """
    out = np.empty((wanted.size, 3))
    step = np.diff(time)
    place = np.clip(np.searchsorted(time, wanted), 0, time.size - 1)
    for start in range(0, time.size, BLOCK):
        chosen = slice(*np.searchsorted(place, [start, start + BLOCK]))
        if chosen.start == chosen.stop:
            continue
        part = slice(max(start - EDGE, 0), min(start + BLOCK + EDGE, time.size))
        increments = means[part][1:] * step[part.start : part.stop - 1, None]
        integral = np.concatenate([np.zeros((1, 3)), np.cumsum(increments, axis=0)])
        spline = CubicSpline(time[part], integral, axis=0)
        out[chosen] = spline(np.clip(wanted[chosen], time[part][0], time[part][-1]), 1 + derivative)
    return out


def gather(imu: Imu, gnss: Gnss, still: Standstill, latency: float, settings: NavigationSettings) -> Gathered:
    """Measurements of a flight; a fix stands for its stamp − latency, with its own sigmas times the factor of its quality."""
    fix_time = gnss.time - latency
    with_velocity = gnss.velocity is not None and gnss.sigma_velocity is not None and settings.use_gnss_velocity
    factor = np.ones(gnss.time.size)
    for quality, value in zip(GNSS_QUALITIES, settings.sigma_factor, strict=True):
        factor[gnss.quality == quality] = value
    nfix = gnss.time.size
    velocity = gnss.velocity if with_velocity and gnss.velocity is not None else np.zeros((nfix, 3))
    sigma_velocity = gnss.sigma_velocity if with_velocity and gnss.sigma_velocity is not None else np.ones((nfix, 3))
    rate, force = (at_instants(imu.time, values, fix_time) for values in (imu.gyro, imu.accel))
    kept = ~withheld(gnss.time, settings) & ~_in_gap(imu.time, fix_time)
    parts = [
        (
            fix_time,
            np.full(nfix, kalman.FIX),
            np.full(nfix, 6 if with_velocity else 3),
            kept,
            np.stack([gnss.latitude, gnss.longitude, gnss.height], 1),
            velocity,
            np.concatenate([gnss.sigma_position, sigma_velocity], 1) ** 2 * factor[:, None] ** 2,
            rate,
            force,
        )
    ]
    every = slice(None, None, STANDSTILL_STEP)
    count = still.start[every].size
    parts.append(
        (
            still.stop[every],
            np.full(count, kalman.STANDSTILL),
            np.full(count, 6),
            np.ones(count, np.bool_),
            np.zeros((count, 3)),
            np.zeros((count, 3)),
            np.concatenate([np.full((count, 3), settings.standstill_sigma_m_per_s**2), still.variance[every]], 1),
            still.rate[every],
            still.force[every],
        )
    )
    if settings.free_inertial_after_s is not None:
        chosen = np.flatnonzero(gnss.time > settings.free_inertial_after_s)
        chosen = chosen[np.unique((gnss.time[chosen] / BAROMETER_STEP).astype(np.int64), return_index=True)[1]]
        size = chosen.size
        variance = np.ones((size, 6))
        variance[:, 0] = settings.free_inertial_height_sigma_m**2
        parts.append(
            (
                fix_time[chosen],
                np.full(size, kalman.HEIGHT),
                np.ones(size, np.int64),
                np.ones(size, np.bool_),
                np.stack([gnss.latitude, gnss.longitude, gnss.height], 1)[chosen],
                np.zeros((size, 3)),
                variance,
                rate[chosen],
                force[chosen],
            )
        )
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    place = np.empty(order.size, np.int64)
    place[order] = np.arange(order.size)
    sorted_columns = [np.ascontiguousarray(column[order]) for column in joined]
    measurements = kalman.Measurements(*sorted_columns)
    return Gathered(measurements, fix_time, place[:nfix])
