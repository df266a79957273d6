"""Flights whose truth is known, for the benchmarks and the tests of the POS: motion, inertial data, fixes, chamber runs, errors.

The motion is worked out by `tsmftis.simulator` (inertial frame, exact derivatives); it shares geodesy and rotations with the
POS and nothing else.

Functions
---------
aircraft, survey, drive, racetrack      motions
ideal, measured, fixes, chamber         what perfect and real sensors say of them, and in the chamber
truth, errors, consistency              the true path; truth minus estimate; NEES
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from pipeline.records import Chamber, Gnss, Imu, StaticAttitude, Temperatures, Trajectory
from stages.navigation import kalman
from stages.navigation.solve import Solution
from stages.simulation import SimulationSettings
from stages.simulation.records import ChamberRun
from stages.simulation.sensors import fly
from tsmftis import geodesy
from tsmftis.inertial import DEG_PER_H, MICRO_G, ImuModel, SensorModel
from tsmftis.rotation import log_so3, rpy_to_dcm
from tsmftis.simulator import flight, gnss, inertial
from tsmftis.simulator.harmonics import Harmonics

Array = NDArray[np.float64]

LEVER = np.array([0.45, -0.2, -1.35])
SIGMA_POSITION, SIGMA_VELOCITY = np.array([0.02, 0.02, 0.04]), np.array([0.02, 0.02, 0.02])
STILL = Harmonics(np.zeros((3, 1)), np.ones((3, 1)), np.zeros((3, 1)))


@dataclass(frozen=True, eq=False)
class Grade:
    """An inertial unit, and how well the attitude handed to the POS is known (3,) [rad]."""

    name: str
    model: ImuModel
    sigma_rpy: Array


RLG = Grade(
    "RLG",
    ImuModel(
        200.0,
        SensorModel(np.deg2rad(0.001) / 60.0, 0.01 * DEG_PER_H, 3600.0, 5e-6),
        SensorModel(12.0 * MICRO_G, 50.0 * MICRO_G, 3600.0, 20e-6),
    ),
    np.deg2rad([0.05, 0.05, 0.5]),
)
MEMS = Grade(
    "MEMS",
    ImuModel(
        200.0,
        SensorModel(np.deg2rad(0.15) / 60.0, 7.5 * DEG_PER_H, 3600.0, 300e-6),
        SensorModel(60.0 * MICRO_G, 840.0 * MICRO_G, 3600.0, 1200e-6),
    ),
    np.deg2rad([0.34, 0.34, 2.55]),
)


# --- motions ---------------------------------------------------------------------------------------------------------


def _shaken(path: flight.Path, rng: np.random.Generator, terms: int = 8) -> flight.Flight:
    """Gusts, wobble and vibration on a path."""
    shaking = flight.wobble(np.deg2rad([0.4, 0.3, 0.3]), np.array([1.0, 1.0, 0.5]), terms, rng)
    shaking += flight.vibration(np.deg2rad([0.3, 0.3, 0.1]), (8.0, 25.0), 5, rng)
    return flight.Flight(path, flight.gusts(np.full(3, 0.3), 0.05, 0.8, terms, rng).integral(), shaking)


def flown(
    legs: list[flight.Leg],
    seed: int,
    *,
    speed: float = 60.0,
    height: float = 1000.0,
    calm: bool = False,
    crab: float = 0.03,
) -> flight.Flight:
    """An aircraft along these legs, place and course drawn from the seed; `calm`: nothing shakes it; `crab`: yaw − course."""
    rng = np.random.default_rng([41, seed])
    path = flight.plan(
        legs,
        latitude=0.65 + 0.02 * (seed % 20),
        longitude=2.13,
        height=height,
        course=float(rng.uniform(0, 2 * np.pi)),
        speed=speed,
        bank_ramp=4.0,
        pitch=0.02,
        drift_angle=crab,
    )
    return flight.Flight(path, STILL, STILL) if calm else _shaken(path, rng)


def aircraft(seed: int) -> flight.Flight:
    """About 120 s: straight, a coordinated 90° turn, straight, in gusts, wobbling and vibrating."""
    return flown(
        [flight.Leg(duration=40.0, climb=5.0), flight.Leg(turn=np.pi / 2, bank=0.4), flight.Leg(duration=45.0)], seed
    )


def survey(seed: int) -> flight.Flight:
    """The preset `survey`: 450 s with six turns to both sides."""
    return fly(SimulationSettings.preset("survey"), seed)


def racetrack(seed: int, seconds: float) -> flight.Flight:
    """A climb of 15 minutes to 2800 m and lines of 10 minutes flown to and fro, as long as asked for."""
    legs = [flight.Leg(duration=900.0, climb=1800.0)]
    total, side = 900.0, 1.0
    while total < seconds:
        legs += [flight.Leg(turn=side * np.pi, bank=0.35), flight.Leg(duration=600.0)]
        total, side = total + 655.0, -side
    return flown(legs, seed, speed=60.0)


def drive(seed: int = 0, stops: bool = False, rest: float = 25.0) -> flight.Flight:
    """A car: `rest` s standing, then up to 15 m/s with bends; with `stops`, ten minutes of town with a stop a minute."""
    rng = np.random.default_rng([43, seed])
    seconds = rest + (600.0 if stops else 95.0)
    time = np.arange(0.0, seconds + 0.005, 0.01)
    speed, course = np.zeros_like(time), np.full_like(time, 0.8)

    def ramp(start: float, length: float) -> Array:
        x = np.clip((time - start) / length, 0.0, 1.0)
        return np.asarray(x - np.sin(2 * np.pi * x) / (2 * np.pi))

    if stops:
        for start in rest + np.arange(0.0, 575.0, 60.0):
            speed += rng.uniform(8.0, 16.0) * (ramp(start, 12.0) - ramp(start + 38.0, 10.0))
            for bend in (start + 14.0, start + 25.0):
                course += float(rng.choice([-1.0, 1.0])) * rng.uniform(0.3, 1.5) * ramp(bend, 8.0)
    else:
        speed = 15.0 * 0.5 * (1.0 - np.cos(np.pi * np.clip((time - rest) / 20.0, 0.0, 1.0)))
        course = course + 1.5 * ramp(rest + 25.0, 12.0) - 2.0 * ramp(rest + 50.0, 12.0)

    def integral(rate: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * 0.01])

    north, east = geodesy.radii_of_curvature(0.7)
    lat = 0.7 + integral(speed * np.cos(course)) / (north + 50.0)
    lon = -1.8 + integral(speed * np.sin(course)) / ((east + 50.0) * np.cos(0.7))
    at = slice(None, None, 50)
    height = np.full_like(lat, 50.0)
    ecef = geodesy.geodetic_to_ecef(lat, lon, height)
    attitude = np.stack([np.full_like(time, 0.03), np.full_like(time, -0.02), course], -1)
    path = flight.Path(
        seconds,
        ecef[0],
        make_interp_spline(time[at], np.stack([lat, lon, height], -1)[at], k=5),
        make_interp_spline(time[at], (ecef - ecef[0])[at], k=5),
        make_interp_spline(time[at], attitude[at], k=5),
    )
    return flight.Flight(path, STILL, STILL)


# --- sensors ---------------------------------------------------------------------------------------------------------


def ideal(craft: flight.Flight, rate: float) -> Imu:
    """What perfect sensors would record, from the start to half a second before the end."""
    time = np.arange(1, int((craft.path.duration - 0.5) * rate)) / rate
    return Imu(time, *inertial.interval_means(craft, time, 1.0 / rate))


def measured(imu: Imu, model: ImuModel, rng: np.random.Generator, constant: inertial.UnitErrors | None = None) -> Imu:
    """With the errors that the model declares: scale factors (or those of `constant`), Gauss–Markov biases, white noise."""
    interval = float(np.median(np.diff(imu.time)))
    g, a = model.gyro, model.accel
    errors = constant or inertial.UnitErrors(
        g.scale_factor_sigma * rng.standard_normal(3), a.scale_factor_sigma * rng.standard_normal(3), np.zeros(3)
    )
    biases = [
        inertial.gauss_markov(s.bias_sigma, s.bias_correlation_time, interval, imu.time.size, rng) for s in (g, a)
    ]
    white = [s.white_noise / np.sqrt(interval) for s in (g, a)]
    return Imu(imu.time, *inertial.measure(imu.gyro, imu.accel, errors, *biases, *white, rng))


def shaken(imu: Imu, craft: flight.Flight, rng: np.random.Generator) -> Imu:
    """Engine and road on top, as noise of a sample: at rest 2 mrad/s and 0.03 m/s², moving twenty times that at 15 m/s."""
    speed = np.linalg.norm(craft.velocity(imu.time), axis=1)
    size = (1.0 + 20.0 * np.clip(speed / 15.0, 0.0, 1.0))[:, None]
    return Imu(
        imu.time,
        imu.gyro + 2e-3 * size * _zero_mean(rng, imu.gyro.shape),
        imu.accel + 0.03 * size * _zero_mean(rng, imu.accel.shape),
    )


def _zero_mean(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Differences of white noise: a vibration, which integrates to nothing."""
    white = rng.standard_normal((shape[0] + 1, shape[1]))
    return np.asarray(np.diff(white, axis=0) / np.sqrt(2.0))


def fixes(
    craft: flight.Flight,
    last: float,
    rng: np.random.Generator,
    *,
    velocity: bool = True,
    lever: Array = LEVER,
    latency: float = 0.0,
    interval: float = 0.2,
) -> Gnss:
    """Fixes from 1 s to `last` [s] with white errors of their declared sigmas."""
    time = np.arange(1.0, last, interval)
    seen = gnss.observe(
        craft,
        time,
        lever,
        latency,
        SIGMA_POSITION * rng.standard_normal((time.size, 3)),
        SIGMA_VELOCITY * rng.standard_normal((time.size, 3)),
    )
    sigma_r, sigma_v = np.tile(SIGMA_POSITION, (time.size, 1)), np.tile(SIGMA_VELOCITY, (time.size, 1))
    extra = (seen.velocity, sigma_v) if velocity else (None, None)
    return Gnss(seen.time, *seen.geodetic.T, sigma_r, *extra, np.ones(time.size, np.int64))


def chamber(run: ChamberRun, settings: SimulationSettings, name: str) -> Chamber:
    """A simulated chamber run as the pipeline's record."""
    place, r = settings.chamber, run.inertial
    angles = np.deg2rad([place.latitude_deg, place.roll_deg, place.pitch_deg, place.yaw_deg])
    return Chamber(
        name,
        r.time,
        r.gyro,
        r.accel,
        Temperatures(r.time, r.temperature_gyro, r.temperature_accel),
        StaticAttitude(angles[0], place.height_m, *map(float, angles[1:])),
        run.temperature_chamber,
    )


def attitude_known_to(craft: flight.Flight, sigma: Array, rng: np.random.Generator) -> tuple[float, Array, Array]:
    """The `initial` of a flight: time, roll, pitch, yaw as drawn with these sigmas, and the sigmas."""
    return 0.5, craft.navigation(np.array([0.5]))[1][0] + sigma * rng.standard_normal(3), sigma


# --- truth -----------------------------------------------------------------------------------------------------------


def truth(craft: flight.Flight, time: Array) -> tuple[Array, Array, Array]:
    """Geodetic position, NED velocity and C_body→NED at times."""
    geodetic, rpy = craft.navigation(time)
    to_ecef = geodesy.ned_to_ecef_dcm(geodetic[:, 0], geodetic[:, 1])
    return geodetic, np.einsum("nji,nj->ni", to_ecef, craft.velocity(time)), rpy_to_dcm(*rpy.T)


def metres(geodetic: Array) -> Array:
    """∂(north, east, down)/∂(latitude, longitude, height) at (n, 3) [m/rad, m/rad, −1]."""
    north, east = geodesy.radii_of_curvature(geodetic[:, 0])
    return np.stack(
        [north + geodetic[:, 2], (east + geodetic[:, 2]) * np.cos(geodetic[:, 0]), -np.ones(len(geodetic))], -1
    )


def errors(craft: flight.Flight, trajectory: Trajectory) -> tuple[Array, Array, Array]:
    """Truth minus estimate: position NED [m], velocity NED [m/s], rotation vector in NED [rad] (n, 3) each."""
    geodetic, velocity, dcm = truth(craft, trajectory.time)
    estimate = np.stack([trajectory.latitude, trajectory.longitude, trajectory.height], -1)
    position = (geodetic - estimate) * metres(geodetic)
    turn = log_so3(dcm @ np.swapaxes(rpy_to_dcm(*trajectory.rpy.T), 1, 2))
    return position, velocity - trajectory.velocity, turn


def consistency(craft: flight.Flight, solution: Solution, times: list[float]) -> tuple[Array, Array, Array, Array]:
    """NEES of filter and smoother over position, velocity, attitude (9) at about these times, and their errors (k, 9).

    The stamps taken are those on which an epoch ends: there the estimate and the epoch's covariance belong together.
    """
    store, imu = solution.store, solution.problem.imu
    on_epoch = np.flatnonzero(np.abs(store.epoch_time[store.epoch] - imu.time) < 1e-9)
    at = on_epoch[np.searchsorted(imu.time[on_epoch], times)]
    geodetic, velocity, dcm = truth(craft, imu.time[at])
    estimated = Rotation.from_quat(store.q[at], scalar_first=True).as_matrix()
    error = np.concatenate(
        [
            (geodetic - store.position[at]) * metres(geodetic),
            velocity - store.velocity[at],
            log_so3(dcm @ np.swapaxes(estimated, 1, 2)),
        ],
        axis=1,
    )
    epochs = store.epoch[at]
    left = error - solution.shift(epochs)
    covariance = np.empty((at.size, solution.problem.active.size, solution.problem.active.size))
    for k, e in enumerate(epochs):
        kalman.unpack(store.epoch_P[e], covariance[k])
    ahead, after = (
        np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e)
        for e, P in ((error, covariance[:, :9, :9]), (left, solution.smoothed.covariance[epochs]))
    )
    return ahead, after, error, left


def thinned(t: Trajectory, step: int = 20, edge: int = 500) -> Trajectory:
    """Every `step`-th sample, `edge` samples away from the ends."""
    return Trajectory(**{n: getattr(t, n)[edge:-edge:step] for n in t.__dataclass_fields__})


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@cache
def ideal_survey(seed: int, rate: float = 200.0) -> tuple[flight.Flight, Imu]:
    """The survey of a seed with perfect data, made once a process."""
    craft = survey(seed)
    return craft, ideal(craft, rate)
