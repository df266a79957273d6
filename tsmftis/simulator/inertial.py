"""What an inertial measurement unit senses, worked out in the inertial frame, and how it errs.

With r_i = Rz(Ωt)·r_e and C_body→i = Rz(Ωt)·C_body→e,

    ω_ib = ω_eb + C_e→body·Ω,        f = C_i→body·(d²r_i/dt² − G(r)),

G the gravitation: normal gravity without its centrifugal part. No navigation-frame mechanisation is inverted.

Functions
---------
gravitation         gravity of mass alone
sensed              angular rate and specific force of a flight at given times
interval_means      their means over the sampling intervals, by Gauss-Legendre quadrature
static              the same for a body at rest on the Earth
measure             means + errors of the unit → samples
gauss_markov        first-order process

References
----------
.. [1] P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., 2.4 and 5.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from tsmftis import geodesy
from tsmftis.simulator.flight import Flight

Array = NDArray[np.float64]

EARTH_ROTATION = np.array([0.0, 0.0, geodesy.EARTH_RATE])
_NODES = 4  # exact to degree 7 in an interval: a 50 Hz vibration sampled at 200 Hz to 1e-7 of itself
_BLOCK = 16384  # intervals worked on at a time


def gravitation(position: Array) -> Array:
    """G(r) = γ(r) − Ω×(r×Ω) … gravity minus centrifugal acceleration, ECEF (..., 3) [m] → (..., 3) [m/s²]."""
    lat, lon, height = geodesy.ecef_to_geodetic(position)
    down = geodesy.ned_to_ecef_dcm(lat, lon)[..., :, 2]
    centrifugal = -np.cross(EARTH_ROTATION, np.cross(EARTH_ROTATION, position))
    return geodesy.normal_gravity(lat, height)[..., None] * down - centrifugal


def specific_force(position: Array, velocity: Array, acceleration: Array) -> Array:
    """d²r_i/dt² − G along ECEF axes, from r, dr/dt, d²r/dt² of the ECEF frame (..., 3).

    Differentiating r_i = Rz(Ωt)·r_e twice: Rz(−Ωt)·d²r_i/dt² = r̈ + 2Ω×ṙ + Ω×(Ω×r).
    """
    inertial = (
        acceleration
        + 2.0 * np.cross(EARTH_ROTATION, velocity)
        + np.cross(EARTH_ROTATION, np.cross(EARTH_ROTATION, position))
    )
    return inertial - gravitation(position)


def sensed(flight: Flight, time: Array) -> tuple[Array, Array]:
    """Rate against the inertial frame [rad/s] and specific force [m/s²] (n, 3) along body axes, at times (n,)."""
    attitude = flight.attitude(time)
    force = specific_force(flight.position(time), flight.velocity(time), flight.acceleration(time))
    rate = flight.angular_rate(time) + np.einsum("nji,j->ni", attitude, EARTH_ROTATION)
    return rate, np.einsum("nji,nj->ni", attitude, force)


def interval_means(flight: Flight, end: Array, interval: float) -> tuple[Array, Array]:
    """Means of rate and specific force over [end − interval, end]; end (n,) [s] → (n, 3), (n, 3) along body axes."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    offset = interval * 0.5 * (nodes - 1.0)
    gyro, accel = np.empty((end.size, 3)), np.empty((end.size, 3))
    for start in range(0, end.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        rate, force = sensed(flight, (end[block, None] + offset).ravel())
        gyro[block] = 0.5 * np.einsum("k,nkc->nc", weights, rate.reshape(-1, _NODES, 3))
        accel[block] = 0.5 * np.einsum("k,nkc->nc", weights, force.reshape(-1, _NODES, 3))
    return gyro, accel


def static(latitude: float, height: float, body_to_ned: Array) -> tuple[Array, Array]:
    """Rate [rad/s] and specific force [m/s²] (3,) of a body at rest at latitude [rad], height [m], C_body→NED."""
    to_body = body_to_ned.T @ geodesy.ned_to_ecef_dcm(latitude, 0.0).T
    position = geodesy.geodetic_to_ecef(latitude, 0.0, height)
    return to_body @ EARTH_ROTATION, to_body @ specific_force(position, np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class UnitErrors:
    """The constant errors of one unit: measured = (1 + scale)·true, and g-sensitivity [rad/s per m/s²] of the gyros."""

    gyro_scale: Array
    accel_scale: Array
    gyro_g_sensitivity: Array


def measure(
    gyro: Array,
    accel: Array,
    errors: UnitErrors,
    gyro_bias: Array,
    accel_bias: Array,
    gyro_noise: float,
    accel_noise: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Samples (n, 3) along the unit's axes: (1 + s)·true + g-sensitivity·force + bias + white noise.

    gyro_noise [rad/s] and accel_noise [m/s²] are the standard deviations of one sample.
    """
    return (
        gyro * (1.0 + errors.gyro_scale)
        + accel * errors.gyro_g_sensitivity
        + gyro_bias
        + gyro_noise * rng.standard_normal(gyro.shape),
        accel * (1.0 + errors.accel_scale) + accel_bias + accel_noise * rng.standard_normal(accel.shape),
    )


def gauss_markov(
    sigma: float, correlation_time: float, interval: float, samples: int, rng: np.random.Generator
) -> Array:
    """x_{k+1} = e^(−Δ/τ)·x_k + w_k, stationary with standard deviation sigma from the first sample; (samples, 3)."""
    decay = np.exp(-interval / correlation_time)
    drive = sigma * np.sqrt(1.0 - decay**2) * rng.standard_normal((samples, 3))
    drive[0] = sigma * rng.standard_normal(3)
    return np.asarray(lfilter([1.0], [1.0, -decay], drive, axis=0))
