"""Static chamber data → what the thermal model has to learn: the bias of each channel.

Functions
---------
bias_samples      gyro and accelerometer bias at every sample of a chamber run
expected_reading  what an ideal unit at rest reads
thinned           a chamber run at a rate that suits temperatures
refuse_motion     a chamber run must stand still and stand as its attitude says
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Chamber
from stages.thermal.binning import binned_means, block_means
from tsmftis.geodesy import earth_rate_ned, normal_gravity
from tsmftis.rotation import rpy_to_dcm

Array = NDArray[np.float64]

CHANNELS = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")

# Far above what any thermal bias does over a run (a consumer gyro measured over 90 K: 0.02 rad/s) and far below what a hand
# that moves the unit does.
MOTION_RATE = 0.1  # rad/s
MOTION_FORCE = 0.5  # m/s²


def bias_samples(chamber: Chamber) -> Array:
    """Bias (n, 6) of gyro [rad/s] and accelerometer [m/s²] triad of a static run.

    b_g = ω̃ − Cᵀ·ω_ie,  b_a = f̃ + Cᵀ·g  with C = C_imu→NED of the run's attitude (a body at rest feels f = −g).
    Without an attitude the run's own mean stands for ω_ie and g: then only the change with temperature is learnt.
    """
    measured = np.hstack([chamber.gyro, chamber.accel])
    if chamber.attitude is None:
        return measured - measured.mean(axis=0)
    return measured - expected_reading(chamber)


def expected_reading(chamber: Chamber) -> Array:
    """What an ideal IMU at rest reads (6,): Cᵀ·ω_ie [rad/s] and −Cᵀ·g [m/s²]."""
    a = chamber.attitude
    if a is None:
        return np.median(np.hstack([chamber.gyro, chamber.accel]), axis=0)
    ned_to_imu = rpy_to_dcm(a.roll, a.pitch, a.yaw).T
    gravity = np.array([0.0, 0.0, float(normal_gravity(a.latitude, a.height))])
    return np.concatenate([ned_to_imu @ earth_rate_ned(a.latitude), -ned_to_imu @ gravity])


def thinned(chamber: Chamber, seconds: float, step: float) -> Chamber:
    """The run averaged into bins of about `step` that fill blocks of `seconds` evenly; as it is where it is no faster.

    A bias follows temperature, not the IMU's 200 Hz: everything later costs what the bins cost.
    """
    step = seconds / np.ceil(seconds / step)
    if float(np.median(np.diff(chamber.time))) > 0.5 * step:
        return chamber
    t = chamber.temperatures
    time, gyro, accel, of_gyro, of_accel = (
        binned_means(chamber.time, values, step)[0]
        for values in (chamber.time, chamber.gyro, chamber.accel, t.gyro, t.accel)
    )
    temperatures = replace(t, time=time, gyro=of_gyro, accel=of_accel)
    return replace(chamber, time=time, gyro=gyro, accel=accel, temperatures=temperatures, temperature_chamber=None)


def refuse_motion(chamber: Chamber, seconds: float) -> None:
    """Raise InputError where the unit moved, or does not stand as its attitude says."""
    where = f"chamber run {chamber.name}"
    means = block_means(chamber.time, np.hstack([chamber.gyro, chamber.accel]), seconds)
    middle = np.median(means, axis=0)
    limit = np.repeat([MOTION_RATE, MOTION_FORCE], 3)
    moved = np.argwhere(np.abs(means - middle) > limit)
    if moved.size:
        block, channel = moved[0]
        raise InputError(
            where,
            f"channel {CHANNELS[channel]}",
            f"changes by {abs(means[block, channel] - middle[channel]):.3g} {'rad/s' if channel < 3 else 'm/s²'} "
            f"near second {chamber.time[0] + block * seconds:.0f}: the unit was moved",
            "give only the static part of the run",
        )
    off = np.abs(middle - expected_reading(chamber))[3:]
    if (off > MOTION_FORCE).any():
        raise InputError(
            where,
            "attributes roll_deg, pitch_deg, yaw_deg",
            f"gravity misses the accelerometers' median by {off.max():.3g} m/s²",
            "give the attitude of the sensor triad (NED, roll and pitch zero with z down), or leave the attitude out",
        )
