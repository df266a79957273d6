"""Thermometer readings → what the bias depends on: T, Ṫ and, in a gyro with three thermometers, ∇T1 and ∇T2.

Functions
---------
smoothed            value and rate of a series by local straight lines of a given time constant
channel_features    the features of the six channels
refuse_endless      a record that a wrong stamp has made endless
stuck_thermometers  channels of which a thermometer does not move while the unit's others do

References
----------
.. [1] W. S. Cleveland, Robust locally weighted regression, J. Am. Stat. Assoc. 74 (1979) 829.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from pipeline.errors import InputError
from pipeline.records import Temperatures
from stages.thermal.binning import binned_means

Array = NDArray[np.float64]

NAMES = ("T", "dT/dt", "Ta-Ts", "Tc-Ts")
STEPS_PER_TIME_CONSTANT = 20
CAUSAL_RIDGE = 0.02
# A month in steps of 1.5 s: a longer record of few readings has a wrong stamp, and would ask for the memory of every step.
MOST_STEPS = 2_000_000


def smoothed(time: Array, values: Array, at: Array, smoothing_s: float, causal: bool = False) -> tuple[Array, Array]:
    """Local straight line a + b·(t' − t) by weighted least squares: value a and rate b of values (m, q) at times (n,).

    Weights exp(−(t'−t)²/2s²), or exp((t'−t)/s) over the past alone. A straight line, unlike a weighted mean, does not
    lag on a ramp, and at the ends of the record it needs no invented readings. Readings come at any rate, even or not:
    they are first averaged into steps of s/20 (or their own median step, if longer).
    """
    step = max(smoothing_s / STEPS_PER_TIME_CONSTANT, float(np.median(np.diff(time))))
    grid, even = _evenly(time, values, step)
    # No more of the kernel than the record can fill.
    reach = min(int(np.ceil((8.0 if causal else 4.0) * smoothing_s / step)), len(grid) - 1)
    lag = step * np.arange(-reach, reach + 1)
    weight = np.exp(-0.5 * (lag / smoothing_s) ** 2)
    if causal:
        weight = np.where(lag <= 0.0, np.exp(lag / smoothing_s), 0.0)
    # Temperatures are taken from their mean, so that the transform's rounding is relative to their spread.
    centre = even.mean(axis=0)
    ones = np.ones((len(grid), 1))
    s0, s1, s2 = (_correlate(ones, weight * lag**p) for p in (0, 1, 2))
    y0, y1 = (_correlate(even - centre, weight * lag**p) for p in (0, 1))
    determinant = s0 * s2 - s1 * s1
    # Two readings give a slope that is all noise. Looking back, a record begins with such slopes: they are shrunk to
    # zero until there is a past of about one time constant, and later by nothing. (A lone reading has no slope.)
    full = float(np.sum(weight) * np.sum(weight * lag**2) - np.sum(weight * lag) ** 2)
    ridge = CAUSAL_RIDGE * full if causal else 0.0
    line = determinant > 1e-9 * s0 * s0 * step * step
    rate = np.where(line, (1.0 + ridge / max(full, 1e-300)) * (s0 * y1 - s1 * y0) / (determinant + ridge + ~line), 0.0)
    value = (y0 - rate * s1) / s0 + centre
    rate_at = _interpolate(at, grid, rate)
    # The first and last readings lie up to half a step outside the bins' means: the line goes on.
    beyond = at - np.clip(at, grid[0], grid[-1])
    return _interpolate(at, grid, value) + rate_at * beyond[:, None], rate_at


def refuse_endless(time: Array, smoothing_s: float, where: str) -> None:
    """Raise InputError, about `where`, if the steps of the smoothing over times (m,) [s] are more than any record can need."""
    step = max(smoothing_s / STEPS_PER_TIME_CONSTANT, float(np.median(np.diff(time))))
    if time[-1] - time[0] > step * max(MOST_STEPS, 20 * len(time)):
        before = int(np.argmax(np.diff(time)))
        raise InputError(
            where,
            "times of the thermometers",
            f"go from {time[before]:.6g} to {time[before + 1]:.6g} s from one reading to the next",
            "remove readings with a wrong stamp, or make several runs of it",
        )


def _evenly(time: Array, values: Array, step: float) -> tuple[Array, Array]:
    """The series on even steps: bin means, set at the mean time of what fell into the bin, joined by straight lines."""
    binned, _ = binned_means(time - time[0], np.column_stack([time - time[0], values]), step)
    mean_time, means = time[0] + binned[:, 0], binned[:, 1:]
    grid = mean_time[0] + step * np.arange(int((mean_time[-1] - mean_time[0]) / step + 1e-9) + 1)
    return grid, _interpolate(grid, mean_time, means)


def _correlate(x: Array, kernel: Array) -> Array:
    """Σ_j kernel_j·x_{i+j} for x (n, q) and kernel (2r+1,), zero outside the record."""
    reach = len(kernel) // 2
    return fftconvolve(x, kernel[::-1, None], mode="full", axes=0)[reach : reach + len(x)]


def _interpolate(at: Array, time: Array, values: Array) -> Array:
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def channel_features(
    temperatures: Temperatures,
    at: Array,
    smoothing_s: float,
    causal: bool = False,
    where: str = "readings",
    felt: Array | None = None,
) -> tuple[Array, ...]:
    """Features of the six channels at times (n,): gyro axes (n, 4) or (n, 2), accelerometer axes (n, 2).

    Gyro: T = mean of its thermometers, Ṫ, ∇T1 = Ta − Ts, ∇T2 = Tc − Ts (no gradients with one thermometer).
    Accelerometer: T, Ṫ. [degC, K/s, K, K]  `felt` (m, 6) stands for T at the readings where it is not their own mean.
    InputError, about `where`, if a wrong stamp makes the record endless.
    """
    refuse_endless(temperatures.time, smoothing_s, where)
    gyro, accel = temperatures.gyro, temperatures.accel
    mean = np.column_stack([gyro.mean(axis=2), accel]) if felt is None else felt
    value, rate = smoothed(temperatures.time, mean, at, smoothing_s, causal)
    features = [np.column_stack([value[:, i], rate[:, i]]) for i in range(6)]
    if gyro.shape[2] == 3:
        gradients = (gyro[:, :, :2] - gyro[:, :, 2:]).reshape(len(gyro), 6)
        smooth, _ = smoothed(temperatures.time, gradients, at, smoothing_s, causal)
        for i in range(3):
            features[i] = np.column_stack([features[i], smooth[:, 2 * i : 2 * i + 2]])
    return tuple(features)


def stuck_thermometers(temperatures: Temperatures, minimum_span_k: float) -> tuple[str | None, ...]:
    """For each of six channels, the name of a thermometer that stands still while the unit moves, or None.

    Still: the reading spans under 2 % of what the median thermometer of the unit spans, and that one spans at least
    `minimum_span_k`.
    """
    labels = ("anode", "cathode", "shell") if temperatures.gyro.shape[2] == 3 else ("thermometer",)
    span_gyro, span_accel = np.ptp(temperatures.gyro, axis=0), np.ptp(temperatures.accel, axis=0)
    typical = float(np.median(np.concatenate([span_gyro.ravel(), span_accel])))
    if typical < minimum_span_k:
        return (None,) * 6
    gyro = [[label for label, s in zip(labels, span, strict=True) if s < 0.02 * typical] for span in span_gyro]
    accel = [["thermometer"] if s < 0.02 * typical else [] for s in span_accel]
    return tuple(names[0] if names else None for names in gyro + accel)
