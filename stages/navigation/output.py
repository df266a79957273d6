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

BLOCK = 200_000  # samples turned at a time: matrices of a whole flight would be the peak of memory


@dataclass(frozen=True)
class NavigationResult:
    """The trajectory at IMU rate and what a person must know to trust it (`quality`: plain data for run.json and the report)."""

    trajectory: Trajectory
    quality: dict[str, Any]
    figures: dict[str, list[float]]


def assemble(imu: Imu, gnss: Gnss, s: dict[str, Any], start: Start, passes: int) -> NavigationResult:
    """The smoothed trajectory at every IMU stamp with its sigmas, from what filter and smoother left (`s`)."""
    count, epoch, time = s["count"], s["epoch"], imu.time
    epoch_time, correction = s["epoch_time"][:count], s["correction"]
    following = np.minimum(epoch + 1, count - 1)
    span = epoch_time[following] - epoch_time[epoch]
    part = np.divide(time - epoch_time[epoch], span, out=np.zeros(time.size), where=span > 0)[:, None]
    # Between two epochs the correction runs from the one after the first to the one before the second's update.
    arriving = correction[following] + s["epoch_dx"][following] * (following > epoch)[:, None]
    shift = (1.0 - part) * correction[epoch] + part * arriving

    north, east = radii_of_curvature(s["position"][:, 0])
    height = s["position"][:, 2]
    rpy = np.empty((time.size, 3))
    for first in range(0, time.size, BLOCK):
        block = slice(first, first + BLOCK)
        rpy[block] = np.stack(dcm_to_rpy(exp_so3(shift[block, kalman.ATTITUDE]) @ quaternion_to_dcm(s["q"][block])), 1)
    latitude = s["position"][:, 0] + shift[:, 0] / (north + height)
    longitude = s["position"][:, 1] + shift[:, 1] / ((east + height) * np.cos(s["position"][:, 0]))
    bias = s["bias"] + shift[:, 9:]

    P = s["smoothed_P"]
    epoch_rpy = np.stack(dcm_to_rpy(s["epoch_dcm"][:count]), 1)
    J = rpy_jacobian(epoch_rpy)
    variance = np.concatenate(
        [np.einsum("nii->ni", P)[:, :6], np.einsum("nij,njk,nik->ni", J, P[:, 6:9, 6:9], J)], axis=1
    )
    sigma = np.sqrt(np.maximum(variance, 0.0))
    sigmas = np.stack([np.interp(time, epoch_time, sigma[:, i]) for i in range(9)], 1)

    rate = (imu.gyro - bias[:, 0:3]) / (1.0 + bias[:, 6:9])
    force = (imu.accel - bias[:, 3:6]) / (1.0 + bias[:, 9:12])
    trajectory = Trajectory(
        time,
        latitude,
        longitude,
        height - shift[:, 2],
        s["velocity"] + shift[:, 3:6],
        rpy,
        sigmas[:, 0:3],
        sigmas[:, 3:6],
        sigmas[:, 6:9],
        rate,
        force,
    )
    quality, figures = _quality(imu, gnss, s, trajectory, bias, start, passes)
    return NavigationResult(trajectory, quality, figures)


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
