"""What navigation gives: the smoothed trajectory, its sigmas, and the quality figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gnss, Imu, Trajectory
from stages.navigation import kalman
from stages.navigation.alignment import Start
from tsmftis.geodesy import local_metres, radii_of_curvature
from tsmftis.inertial import DEG_PER_H, MICRO_G
from tsmftis.rotation import dcm_to_rpy, exp_so3, quaternion_to_dcm, rpy_jacobian, rpy_to_dcm

Array = NDArray[np.float64]

BLOCK = 50_000  # samples at a time: what is in between for a whole flight would be the peak of memory


@dataclass(frozen=True)
class NavigationResult:
    """The trajectory at IMU rate and what a person must know to trust it (`quality`: plain data for run.json and the report)."""

    trajectory: Trajectory
    quality: dict[str, Any]
    figures: dict[str, list[float]]


def assemble(imu: Imu, gnss: Gnss, s: dict[str, Any], start: Start, passes: int) -> NavigationResult:
    """The smoothed trajectory at every IMU stamp with its sigmas, from what filter and smoother left (`s`)."""
    n = imu.time.size
    arrays = [np.empty(n), np.empty(n), np.empty(n), *(np.empty((n, 3)) for _ in range(7))]
    for block in (slice(i, i + BLOCK) for i in range(0, n, BLOCK)):
        for whole, part in zip(arrays, _block(imu, s, block), strict=True):
            whole[block] = part
    trajectory = Trajectory(imu.time, *arrays)
    bias = s["epoch_bias"][: s["count"]] + s["correction"][:, 9:]
    quality, figures = _quality(imu, gnss, s, trajectory, bias, start, passes)
    return NavigationResult(trajectory, quality, figures)


def _block(imu: Imu, s: dict[str, Any], block: slice) -> tuple[Array, ...]:
    """The trajectory's arrays, in its order after time, for some of the stamps."""
    count, epoch, time = s["count"], s["epoch"][block], imu.time[block]
    epoch_time, correction = s["epoch_time"][:count], s["correction"]
    following = np.minimum(epoch + 1, count - 1)
    span = epoch_time[following] - epoch_time[epoch]
    part = np.divide(time - epoch_time[epoch], span, out=np.zeros(time.size), where=span > 0)[:, None]
    # Between two epochs the correction runs from the one after the first to the one before the second's update.
    arriving = correction[following] + s["epoch_dx"][following] * (following > epoch)[:, None]
    shift = (1.0 - part) * correction[epoch] + part * arriving

    latitude, longitude, height = s["position"][block].T
    north, east = radii_of_curvature(latitude)
    rpy = np.stack(dcm_to_rpy(exp_so3(shift[:, kalman.ATTITUDE]) @ quaternion_to_dcm(s["q"][block])), 1)
    bias = s["epoch_bias"][epoch] + shift[:, 9:]
    sigma = (1.0 - part) * s["sigma"][epoch] + part * s["sigma"][following]
    return (
        latitude + shift[:, 0] / (north + height),
        longitude + shift[:, 1] / ((east + height) * np.cos(latitude)),
        height - shift[:, 2],
        s["velocity"][block] + shift[:, kalman.VELOCITY],
        rpy,
        sigma[:, 0:3],
        sigma[:, 3:6],
        sigma[:, 6:9],
        (imu.gyro[block] - bias[:, 0:3]) / (1.0 + bias[:, 6:9]),
        (imu.accel[block] - bias[:, 3:6]) / (1.0 + bias[:, 9:12]),
    )


def sigmas(covariance: Array, dcm: Array) -> Array:
    """Sigmas (n, 9) of position [m], velocity [m/s], roll, pitch, yaw [rad] from covariances (n, 9, 9) in NED; dcm (n, 3, 3)."""
    J = rpy_jacobian(np.stack(dcm_to_rpy(dcm), 1))
    attitude = np.einsum("nij,njk,nik->ni", J, covariance[:, kalman.ATTITUDE, kalman.ATTITUDE], J)
    return np.sqrt(np.maximum(np.concatenate([np.einsum("nii->ni", covariance)[:, :6], attitude], axis=1), 0.0))


def _quality(
    imu: Imu, gnss: Gnss, s: dict[str, Any], trajectory: Trajectory, bias: Array, start: Start, passes: int
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """Plain data for run.json and the report: innovations, rejected fixes, residuals of the smoothed path, gaps, biases."""
    used, nis, size = s["used"], s["nis"], s["fix_size"]
    seen = np.isfinite(nis)
    residual = _antenna_residuals(trajectory, gnss, s["lever"], used)
    steps = np.diff(imu.time)
    gaps = [{"start_s": float(imu.time[i]), "length_s": float(steps[i])} for i in np.flatnonzero(s["gap"][1:])]
    quality = {
        "alignment": start.method,
        "passes": passes,
        "fixes": {"used": int(used.sum()), "rejected": int((seen & ~used).sum()), "outside_imu": int((~seen).sum())},
        "rejected_times_s": [float(t) for t in gnss.time[seen & ~used][:100]],
        "innovation_nis_mean": float(np.mean(nis[used])) if used.any() else None,
        "innovation_nis_expected": float(size[used].mean()) if used.any() else None,
        "position_residual_rms_m": float(np.sqrt((residual**2).sum(axis=1).mean())) if used.any() else None,
        "position_residual_rms_ned_m": [float(v) for v in np.sqrt((residual**2).mean(axis=0))] if used.any() else [],
        "imu_gaps": gaps[:100],
        "imu_gap_count": len(gaps),
        "gyro_bias_deg_per_h": (bias[:, 0:3].mean(axis=0) / DEG_PER_H).tolist(),
        "accel_bias_ug": (bias[:, 3:6].mean(axis=0) / MICRO_G).tolist(),
        "sigma_position_m_median": [float(v) for v in np.median(trajectory.sigma_position, axis=0)],
        "sigma_attitude_deg_median": [float(v) for v in np.rad2deg(np.median(trajectory.sigma_attitude, axis=0))],
    }
    figures = {
        "fix_time": gnss.time[seen].tolist(),
        "fix_nis": nis[seen].tolist(),
        "fix_used": used[seen].astype(float).tolist(),
        "residual_time": gnss.time[used].tolist(),
        **{f"residual_{n}": residual[:, i].tolist() for i, n in enumerate(("north", "east", "down"))},
    }
    return quality, figures


def _antenna_residuals(trajectory: Trajectory, gnss: Gnss, lever: Array, used: NDArray[np.bool_]) -> Array:
    """Fix minus smoothed antenna position, NED [m], for the used fixes (n, 3)."""
    time = gnss.time[used]
    at = [np.interp(time, trajectory.time, v) for v in (trajectory.latitude, trajectory.longitude, trajectory.height)]
    rpy = [np.interp(time, trajectory.time, np.unwrap(trajectory.rpy[:, i])) for i in range(3)]
    arm = rpy_to_dcm(*rpy) @ lever
    origin = float(at[0].mean()), float(at[1].mean()), float(at[2].mean())
    fix = local_metres(gnss.latitude[used], gnss.longitude[used], gnss.height[used], *origin)
    return fix - local_metres(at[0], at[1], at[2], *origin) - arm
