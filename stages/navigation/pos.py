"""The position and orientation system: alignment, forward filter, smoother, quality figures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.stats import chi2

from pipeline.errors import InputError
from pipeline.records import DATA_GAP, Gnss, Imu, ThermalCorrection
from stages.navigation import kalman
from stages.navigation.alignment import Start, align, starting_at
from stages.navigation.output import NavigationResult, assemble, sigmas
from tsmftis.camera import Mounting
from tsmftis.geodesy import radii_of_curvature
from tsmftis.inertial import ImuModel
from tsmftis.rotation import dcm_to_quaternion, dcm_to_rpy, exp_so3, rpy_jacobian, rpy_to_dcm

Array = NDArray[np.float64]


class NavigationSettings(BaseModel):
    """How the filter is run; the sensors' own figures come from instrument.yaml."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    epoch_s: float = Field(0.2, gt=0, le=1.0, description="longest step of the covariance")
    gate_probability: float = Field(1e-6, gt=0, lt=0.1, description="chance that a good fix is rejected")
    reentry_s: float = Field(
        5.0, gt=0, description="without an accepted fix for so long, fixes are weighed down instead of rejected"
    )
    course_speed_m_per_s: float = Field(
        1.0, gt=0, description="least speed whose course is taken for the heading when the pipeline aligns itself"
    )
    use_gnss_velocity: bool = Field(True, description="use the fixes' velocities besides their positions")
    passes: int = Field(3, ge=1, le=6, description="most filter passes when the first attitude was poor")


def run(
    imu: Imu,
    gnss: Gnss,
    model: ImuModel,
    mounting: Mounting,
    settings: NavigationSettings,
    *,
    initial: tuple[float, Array, Array] | None = None,
    correction: ThermalCorrection | None = None,
) -> NavigationResult:
    """Integrate one flight.

    `initial` is (time [s], rpy [rad], sigma_rpy [rad]) or None (self-alignment); `correction` is taken off the inertial
    data in the IMU's own axes before they are turned into the body. Raises InputError where IMU and GNSS do not overlap.
    """
    imu = in_body_axes(imu, mounting, correction)
    lever = mounting.imu_to_antenna
    overlap = (gnss.time >= imu.time[0]) & (gnss.time <= imu.time[-1])
    if overlap.sum() < 5:
        raise InputError(
            "gnss",
            "variable 'time'",
            f"spans {gnss.time[0]:.1f} to {gnss.time[-1]:.1f} s and the IMU {imu.time[0]:.1f} to {imu.time[-1]:.1f} s, "
            f"so {int(overlap.sum())} fixes overlap",
            "both must be seconds on the campaign's one clock",
        )
    start = _start(imu, gnss, lever, settings, initial)
    used_imu = _from(imu, start.time)
    solution: dict[str, Any] = {}
    for number in range(settings.passes):
        solution.clear()  # the last pass's matrices make room for this one's
        solution = _filter_and_smooth(used_imu, gnss, model, lever, settings, start)
        shift = solution["correction"][0]
        if np.linalg.norm(shift[kalman.ATTITUDE]) < np.deg2rad(0.5) or number == settings.passes - 1:
            break
        # The first attitude was poor, so the filter linearised about a poor path: start again from the smoothed one. The
        # prior of position, velocity and attitude moves with it and keeps its width, which is nothing beside the flight's own
        # information; that of the sensors' errors stays where it was, since it does count.
        start = _shifted(start, shift)
    for finished in ("epoch_P", "epoch_phi", "H", "K", "S_inv"):
        del solution[finished]
    return assemble(used_imu, gnss, solution, start, number + 1)


def in_body_axes(imu: Imu, mounting: Mounting, correction: ThermalCorrection | None) -> Imu:
    """Compensated inertial data turned from the IMU's axes into the body's."""
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    if correction is not None:
        for i in range(3):
            gyro[:, i] -= np.interp(imu.time, correction.time, correction.gyro[:, i])
            accel[:, i] -= np.interp(imu.time, correction.time, correction.accel[:, i])
    if mounting.imu_to_body.any():
        turn = mounting.dcm_imu_to_body
        gyro, accel = np.ascontiguousarray(gyro @ turn.T), np.ascontiguousarray(accel @ turn.T)
    return Imu(imu.time, gyro, accel)


def _start(
    imu: Imu, gnss: Gnss, lever: Array, settings: NavigationSettings, initial: tuple[float, Array, Array] | None
) -> Start:
    if initial is None:
        return align(imu, gnss, lever, settings.course_speed_m_per_s)
    time, rpy, sigma = initial
    if not imu.time[0] - 1.0 <= time < imu.time[-1]:
        raise InputError(
            "campaign.yaml",
            "flights[].initial.time_s",
            f"{time:g} s lies outside the IMU's {imu.time[0]:.2f} to {imu.time[-1]:.2f} s",
            "give a time inside the flight, or leave `initial` out",
        )
    return starting_at(max(time, float(imu.time[0])), rpy, sigma, gnss, lever, "given")


def _from(imu: Imu, time: float) -> Imu:
    """The samples after `time`, with a first stamp exactly there: sample 0 is only the start, its rates are not used."""
    first = int(np.searchsorted(imu.time, time, side="right"))
    if first == 0:
        stamps, gyro, accel = (np.concatenate([values[:1], values]) for values in (imu.time, imu.gyro, imu.accel))
        imu = Imu(stamps, gyro, accel)
        first = 1
    stamps = imu.time[first - 1 :].copy()
    stamps[0] = time
    return Imu(stamps, imu.gyro[first - 1 :], imu.accel[first - 1 :])


def _shifted(start: Start, shift: Array) -> Start:
    """The start moved by a smoothed correction of its position, velocity and attitude."""
    north, east = radii_of_curvature(start.position[0])
    scale = np.array([north + start.position[2], (east + start.position[2]) * np.cos(start.position[0]), -1.0])
    return replace(
        start,
        position=start.position + shift[kalman.POSITION] / scale,
        velocity=start.velocity + shift[kalman.VELOCITY],
        rpy=np.array(dcm_to_rpy(exp_so3(shift[kalman.ATTITUDE]) @ rpy_to_dcm(*start.rpy))),
    )


def _initial_covariance(start: Start, model: ImuModel) -> Array:
    variance = np.zeros(kalman.NSTATE)
    variance[kalman.POSITION], variance[kalman.VELOCITY] = start.sigma_position**2, start.sigma_velocity**2
    variance[kalman.GYRO_BIAS], variance[kalman.ACCEL_BIAS] = model.gyro.bias_sigma**2, model.accel.bias_sigma**2
    variance[kalman.GYRO_SCALE], variance[kalman.ACCEL_SCALE] = (
        model.gyro.scale_factor_sigma**2,
        model.accel.scale_factor_sigma**2,
    )
    P = np.diag(variance)
    # Sigmas of roll, pitch, yaw into the NED rotation vector: φ = M·δrpy, the inverse of `rpy_jacobian`.
    to_ned = np.linalg.inv(rpy_jacobian(start.rpy[None])[0])
    P[kalman.ATTITUDE, kalman.ATTITUDE] = to_ned @ np.diag(start.sigma_rpy**2) @ to_ned.T
    return P


def _process_noise(model: ImuModel) -> Array:
    """Spectral densities [unit²/s] of the 21 states: white noise into v and φ, 2σ²/τ into the Gauss–Markov biases."""
    noise = np.zeros(kalman.NSTATE)
    noise[kalman.VELOCITY], noise[kalman.ATTITUDE] = model.accel.white_noise**2, model.gyro.white_noise**2
    noise[kalman.GYRO_BIAS] = 2.0 * model.gyro.bias_sigma**2 / model.gyro.bias_correlation_time
    noise[kalman.ACCEL_BIAS] = 2.0 * model.accel.bias_sigma**2 / model.accel.bias_correlation_time
    return noise


def _filter_and_smooth(
    imu: Imu, gnss: Gnss, model: ImuModel, lever: Array, settings: NavigationSettings, start: Start
) -> dict[str, Any]:
    n, nfix = imu.time.size, gnss.time.size
    steps = np.diff(imu.time, prepend=imu.time[0])
    nominal = float(np.median(steps[1:]))
    gap = steps > DATA_GAP * nominal
    # Inside a gap the body moves as it does elsewhere: the data's own scatter, held over the gap, as white noise.
    longest = max(float(steps.max()), nominal)
    gap_noise = np.zeros(kalman.NSTATE)
    gap_noise[kalman.ATTITUDE] = imu.gyro.var(axis=0).max() * longest
    gap_noise[kalman.VELOCITY] = imu.accel.var(axis=0).max() * longest

    with_velocity = gnss.velocity is not None and gnss.sigma_velocity is not None and settings.use_gnss_velocity
    velocity = gnss.velocity if with_velocity else np.zeros((nfix, 3))
    variance = (
        np.concatenate([gnss.sigma_position, gnss.sigma_velocity if with_velocity else np.ones((nfix, 3))], 1) ** 2
    )
    fix_size = np.full(nfix, 6 if with_velocity else 3, np.int64)
    middle = imu.time[1:] - 0.5 * steps[1:]
    fix_rate = np.stack([np.interp(gnss.time, middle, imu.gyro[1:, i]) for i in range(3)], 1)
    gates = np.array([0.0] + [chi2.isf(settings.gate_probability, m) for m in range(1, 7)])

    size = nfix + int(np.ceil((imu.time[-1] - imu.time[0]) / settings.epoch_s)) + 2 * int(gap.sum()) + 2
    store = kalman.Store.empty(n, size, nfix)
    tau = np.repeat([model.gyro.bias_correlation_time, model.accel.bias_correlation_time], 3)
    fixes = kalman.Fixes(
        gnss.time, np.stack([gnss.latitude, gnss.longitude, gnss.height], 1), velocity, variance, fix_rate, fix_size
    )
    count = kalman.forward(
        imu.time,
        imu.gyro,
        imu.accel,
        gap,
        fixes,
        lever,
        start.position.copy(),
        start.velocity.copy(),
        dcm_to_quaternion(rpy_to_dcm(*start.rpy)),
        np.zeros(12),
        _initial_covariance(start, model),
        _process_noise(model),
        gap_noise,
        1.0 / tau,
        settings.epoch_s,
        gates,
        settings.reentry_s,
        store,
    )
    correction, smoothed = np.zeros((count, kalman.NSTATE)), np.empty((count, 9, 9))
    kalman.backward(count, fix_size, store, correction, smoothed)
    return store._asdict() | {
        "count": count,
        "correction": correction,
        "smoothed_P": smoothed,
        "sigma": sigmas(smoothed, store.epoch_dcm[:count]),
        "gap": gap,
        "fix_size": fix_size,
        "variance": variance,
        "lever": lever,
    }
