"""The smoothed trajectory at every inertial stamp, from what filter and smoother left."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Trajectory
from stages.navigation import states
from stages.navigation.solve import Solution
from tsmftis.geodesy import radii_of_curvature
from tsmftis.rotation import dcm_to_rpy, exp_so3, quaternion_to_dcm, rpy_jacobian

Array = NDArray[np.float64]

BLOCK = 50_000  # samples at a time: what is in between for a whole flight would be the peak of memory


Doubts = list[tuple[float, float, float, float]]


def trajectory(solution: Solution, doubts: Doubts, least_heading_sigma: float = 0.0) -> Trajectory:
    """Position, velocity, attitude with sigmas, and the compensated inertial data.

    `doubts`: stretches (start, stop [s]; distance [m], velocity [m/s]) by which the sigmas of position and velocity grow, since
    fixes that were rejected there turned out to be the ones that the path went on with; `least_heading_sigma` [rad]: below which
    no heading is known.
    """
    imu = solution.problem.imu
    n = imu.time.size
    dcm = solution.store.epoch_dcm[solution.epochs]
    sigma = sigmas(solution.smoothed.covariance, dcm)
    theta = solution.theta()
    arrays = [np.empty(n), np.empty(n), np.empty(n), *(np.empty((n, 3)) for _ in range(7))]
    for block in (slice(i, i + BLOCK) for i in range(0, n, BLOCK)):
        for whole, part in zip(arrays, _block(solution, sigma, theta, block), strict=True):
            whole[block] = part
    out = Trajectory(imu.time, *arrays)
    for start, stop, distance, velocity in doubts:
        inside = slice(*np.searchsorted(imu.time, [start, stop]))
        out.sigma_position[inside] = np.hypot(out.sigma_position[inside], distance)
        out.sigma_velocity[inside] = np.hypot(out.sigma_velocity[inside], velocity)
    np.maximum(out.sigma_attitude[:, 2], least_heading_sigma, out=out.sigma_attitude[:, 2])
    return out


def _shift(s: Solution, block: slice) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Epochs before and after each stamp, how far it is between them (n, 1), and smoothed minus filtered navigation (n, 9).

    Between two epochs the correction runs from the one after the first to the one before the second's update.
    """
    store, correction, nav = s.store, s.smoothed.correction, slice(0, states.NAVIGATION)
    epoch, time = store.epoch[block], s.problem.imu.time[block]
    following = np.minimum(epoch + 1, s.count - 1)
    span = store.epoch_time[following] - store.epoch_time[epoch]
    part = np.divide(time - store.epoch_time[epoch], span, out=np.zeros(time.size), where=span > 0)[:, None]
    arriving = correction[following, nav] + store.epoch_dx[following, nav] * (following > epoch)[:, None]
    return epoch, following, part, (1.0 - part) * correction[epoch, nav] + part * arriving


def smoothed_velocity(s: Solution) -> Array:
    """Smoothed, at every inertial sample (n, 3)."""
    whole = slice(0, s.store.epoch.size)
    return np.asarray(s.store.velocity[whole] + _shift(s, whole)[3][:, states.VELOCITY])


def _block(s: Solution, sigmas_at: Array, theta: Array, block: slice) -> tuple[Array, ...]:
    """The trajectory's arrays, in its order after time, for some of the stamps."""
    imu, store = s.problem.imu, s.store
    epoch, following, part, shift = _shift(s, block)
    latitude, longitude, height = store.position[block].T
    north, east = radii_of_curvature(latitude)
    rpy = np.stack(dcm_to_rpy(exp_so3(shift[:, states.ATTITUDE]) @ quaternion_to_dcm(store.q[block])), 1)
    sigma = (1.0 - part) * sigmas_at[epoch] + part * sigmas_at[following]
    at = (1.0 - part) * theta[epoch] + part * theta[following]
    value = {name: at[:, states.parameter(name)] for name in states.GROUPS}
    force = (imu.accel[block] - value["accel_bias"]) / (1.0 + value["accel_scale_factor"])
    rate = imu.gyro[block] - value["gyro_bias"] - value["gyro_g_sensitivity"] * force
    return (
        latitude + shift[:, 0] / (north + height),
        longitude + shift[:, 1] / ((east + height) * np.cos(latitude)),
        height - shift[:, 2],
        store.velocity[block] + shift[:, states.VELOCITY],
        rpy,
        sigma[:, 0:3],
        sigma[:, 3:6],
        sigma[:, 6:9],
        rate / (1.0 + value["gyro_scale_factor"]),
        force,
    )


def sigmas(covariance: Array, dcm: Array) -> Array:
    """Sigmas (n, 9) of position [m], velocity [m/s], roll, pitch, yaw [rad] from covariances (n, 9, 9) in NED; dcm (n, 3, 3)."""
    J = rpy_jacobian(np.stack(dcm_to_rpy(dcm), 1))
    attitude = np.einsum("nij,njk,nik->ni", J, covariance[:, states.ATTITUDE, states.ATTITUDE], J)
    return np.sqrt(np.maximum(np.concatenate([np.einsum("nii->ni", covariance)[:, :6], attitude], axis=1), 0.0))
