"""A flight: straight legs and coordinated turns, with turbulence, at any time and with exact derivatives.

The mean path is a quintic spline in the ECEF frame; its attitude is a chain of five elementary rotations,

    C_body→ECEF = Rz(λ)·Ry(−L − π/2)·Rz(yaw)·Ry(pitch)·Rx(roll),

whose angles are splines plus sums of sinusoids. So the angular rate and acceleration are derivatives, not differences.

Functions
---------
plan            legs → mean path
turbulence      gusts and shaking
Flight          position, velocity, acceleration, attitude, angular rate
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from tsmftis import geodesy, rotation
from tsmftis.simulator import harmonics
from tsmftis.simulator.harmonics import Harmonics

Array = NDArray[np.float64]

KNOT_INTERVAL = 0.5  # s: far below a turn's time, far above where rounding of 1e-9 m shows in acceleration
_FINE = 50  # integration steps a knot interval


@dataclass(frozen=True)
class Leg:
    """A straight leg of `duration` [s], or a turn by `turn` [rad, right positive] at the steady `bank` [rad].

    The height changes by `climb` [m] over the leg.
    """

    duration: float = 0.0
    turn: float = 0.0
    bank: float = 0.0
    climb: float = 0.0


@dataclass(frozen=True)
class Path:
    """The mean path: splines of time over [0, duration] s.

    geodetic      latitude, longitude [rad], height [m]
    displacement  ECEF minus `origin` [m]
    attitude      roll, pitch, yaw [rad]
    """

    duration: float
    origin: Array
    geodetic: BSpline
    displacement: BSpline
    attitude: BSpline


def plan(
    legs: Sequence[Leg],
    *,
    latitude: float,
    longitude: float,
    height: float,
    course: float,
    speed: float,
    bank_ramp: float,
    pitch: float,
    drift_angle: float,
) -> Path:
    """The mean path of legs flown one after the other from a start (angles [rad], height [m], speed [m/s]).

    A turn is coordinated, tan(bank) = V·dχ/dt / g; the bank is taken up and given back along a raised cosine of
    `bank_ramp` [s]. yaw = course + drift_angle.
    """
    durations, rates = [], []
    for leg in legs:
        if leg.turn == 0.0:
            durations.append(leg.duration)
            rates.append(0.0)
        else:
            rate = float(geodesy.normal_gravity(latitude, height)) * np.tan(leg.bank) / speed
            durations.append(max(abs(leg.turn) / rate, bank_ramp) + bank_ramp)
            rates.append(leg.turn / (durations[-1] - bank_ramp))
    knots = int(np.ceil(sum(durations) / KNOT_INTERVAL))
    time = np.linspace(0.0, knots * KNOT_INTERVAL, knots * _FINE + 1)
    course_rate, climb_rate = np.zeros_like(time), np.zeros_like(time)
    start = 0.0
    for leg, duration, rate in zip(legs, durations, rates, strict=True):
        since, left = time - start, start + duration - time
        inside = (since >= 0.0) & (left > 0.0)
        ramp = np.clip(np.minimum(since, left) / bank_ramp, 0.0, 1.0)
        course_rate[inside] += (rate * 0.5 * (1.0 - np.cos(np.pi * ramp)))[inside]
        climb_rate[inside] += (leg.climb / duration * (1.0 - np.cos(2.0 * np.pi * since / duration)))[inside]
        start += duration

    step = time[1] - time[0]
    chi = course + _integral(course_rate, step)
    h = height + _integral(climb_rate, step)
    north, _ = geodesy.radii_of_curvature(latitude)
    lat = latitude + _integral(speed * np.cos(chi) / (north + h), step)
    _, east = geodesy.radii_of_curvature(lat)
    lon = longitude + _integral(speed * np.sin(chi) / ((east + h) * np.cos(lat)), step)
    bank = np.arctan(speed * course_rate / geodesy.normal_gravity(lat, h))
    at = slice(None, None, _FINE)
    ecef = geodesy.geodetic_to_ecef(lat[at], lon[at], h[at])
    origin = ecef[len(ecef) // 2]
    attitude = np.stack([bank, pitch + np.arctan2(climb_rate, speed), chi + drift_angle], -1)
    return Path(
        sum(durations),
        origin,
        make_interp_spline(time[at], np.stack([lat, lon, h], -1)[at], k=5),
        make_interp_spline(time[at], ecef - origin, k=5),
        make_interp_spline(time[at], attitude[at], k=5),
    )


def _integral(rate: Array, step: float) -> Array:
    """Running trapezoidal integral from zero."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * step])


def gusts(sigma: Array, corner: float, cutoff: float, terms: int, rng: np.random.Generator) -> Harmonics:
    """Velocity disturbance along north, east, down (3,) [m/s]: S ∝ 1/(1 + (f/corner)²) / (1 + (f/cutoff)⁸), f in Hz."""
    return harmonics.draw(
        lambda f: 1.0 / (1.0 + (f / corner) ** 2) / (1.0 + (f / cutoff) ** 8),
        sigma,
        (0.2 * corner, 4.0 * cutoff),
        terms,
        rng,
    )


def wobble(sigma: Array, cutoff: Array, terms: int, rng: np.random.Generator) -> Harmonics:
    """Disturbance of roll, pitch, yaw, sigma (3,) [rad]: S ∝ 1/(1 + (f/cutoff)⁸), each its own cutoff [Hz]."""

    def axis(s: float, c: float) -> Harmonics:
        return harmonics.draw(lambda f: 1.0 / (1.0 + (f / c) ** 8), np.array([s]), (0.02 * c, 5.0 * c), terms, rng)

    axes = [axis(float(s), float(c)) for s, c in zip(sigma, cutoff, strict=True)]
    return Harmonics(
        *(np.concatenate([getattr(a, n) for a in axes]) for n in ("amplitude", "angular_frequency", "phase"))
    )


def vibration(rate_sigma: Array, band: tuple[float, float], terms: int, rng: np.random.Generator) -> Harmonics:
    """Attitude vibration whose RATE is white in the band [Hz] with rate_sigma (3,) [rad/s]; as angles [rad]."""
    return harmonics.draw(np.ones_like, rate_sigma, band, terms, rng).integral()


@dataclass(frozen=True)
class Flight:
    """The mean path and what shakes it.

    displacement  north, east, down [m] in the local frame of the path's origin (one frame for the flight)
    shaking       roll, pitch, yaw [rad] added to the mean path's angles
    """

    path: Path
    displacement: Harmonics
    shaking: Harmonics

    def _local(self) -> Array:
        lat, lon, _ = geodesy.ecef_to_geodetic(self.path.origin)
        return geodesy.ned_to_ecef_dcm(lat, lon)

    def position(self, time: Array) -> Array:
        """ECEF position (n, 3) [m]."""
        return self.path.origin + self.path.displacement(time) + self.displacement(time) @ self._local().T

    def velocity(self, time: Array) -> Array:
        """dr/dt in the ECEF frame (n, 3) [m/s]."""
        return self.path.displacement(time, 1) + self.displacement(time, 1) @ self._local().T

    def acceleration(self, time: Array) -> Array:
        """d²r/dt² in the ECEF frame (n, 3) [m/s²]."""
        return self.path.displacement(time, 2) + self.displacement(time, 2) @ self._local().T

    def attitude(self, time: Array) -> Array:
        """C_body→ECEF (n, 3, 3)."""
        lat, lon, _ = self.path.geodetic(time).T
        roll, pitch, yaw = (self.path.attitude(time) + self.shaking(time)).T
        return geodesy.ned_to_ecef_dcm(lat, lon) @ rotation.rpy_to_dcm(roll, pitch, yaw)

    def angular_rate(self, time: Array) -> Array:
        """Rate of the body against the ECEF frame, along body axes (n, 3) [rad/s].

        ω = C_NED→body·(λ̇ cos L, −L̇, −λ̇ sin L) + E(roll, pitch)·(d roll, d pitch, d yaw)/dt.
        """
        lat, _, _ = self.path.geodetic(time).T
        lat_rate, lon_rate, _ = self.path.geodetic(time, 1).T
        roll, pitch, yaw = (self.path.attitude(time) + self.shaking(time)).T
        roll_rate, pitch_rate, yaw_rate = (self.path.attitude(time, 1) + self.shaking(time, 1)).T
        transport = np.stack([lon_rate * np.cos(lat), -lat_rate, -lon_rate * np.sin(lat)], -1)
        euler = np.stack(
            [
                roll_rate - yaw_rate * np.sin(pitch),
                pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
                -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
            ],
            -1,
        )
        return np.einsum("nji,nj->ni", rotation.rpy_to_dcm(roll, pitch, yaw), transport) + euler

    def navigation(self, time: Array) -> tuple[Array, Array]:
        """Latitude, longitude [rad], height [m] (n, 3) and roll, pitch, yaw [rad] (n, 3) at the position itself."""
        lat, lon, height = geodesy.ecef_to_geodetic(self.position(time))
        to_ned = np.swapaxes(geodesy.ned_to_ecef_dcm(lat, lon), -1, -2)
        return np.stack([lat, lon, height], -1), np.stack(rotation.dcm_to_rpy(to_ned @ self.attitude(time)), -1)
