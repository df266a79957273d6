"""What a person must know to trust a trajectory: plain numbers for run.json and navigation.json, and the figures' data.

Functions
---------
doubted             where the path is doubtful although its sigmas do not know
refuse_nonsense     no trajectory from fixes that contradict it
histories           forward sigmas, forward/backward separation and parameters along the flight, while the matrices are there
assess              all of it, in plain data
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pipeline.errors import StageError
from pipeline.records import DATA_GAP, GNSS_QUALITIES, Gnss, Trajectory
from stages.navigation import calibration, kalman, states
from stages.navigation.measurements import withheld
from stages.navigation.output import Doubts, sigmas
from stages.navigation.solve import Solution
from tsmftis.geodesy import local_metres
from tsmftis.inertial import DEG_PER_H, MICRO_G
from tsmftis.rotation import rpy_to_dcm

Array = NDArray[np.float64]

NAUTICAL_MILE = 1852.0  # m
AXES = ("north", "east", "down")
MOST_REJECTED = 0.5  # of the fixes: beyond it there is no trajectory
SEEN_BACKWARDS = (
    1e-3  # a direction of which the backward filter knows less than this, beside the forward one, has no separation
)


@dataclass(frozen=True)
class Histories:
    """Along the flight, at epochs (h,): time [s]; forward sigmas (h, 9) as of the trajectory; backward minus forward position,
    velocity, attitude in NED (h, 9), its sigma, NaN where there is none; Σχ² over its degrees of freedom; parameters θ and their
    smoothed sigmas (h, 19), zero where not estimated; covariance of the parameters (p, p) at the end."""

    time: Array
    forward_sigma: Array
    separation: Array
    separation_sigma: Array
    separation_chi2: float
    theta: Array
    theta_sigma: Array
    covariance: Array


def histories(solution: Solution) -> Histories:
    """Histories at the epochs that the smoother kept its adjoint of.

    x_b − x_f = −Λ⁻¹λ with covariance Λ⁻¹ = P_f + P_b [1]_: with P_f = LLᵀ and LᵀΛL = V·diag(w)·Vᵀ, directions of small w are
    those of which the backward filter knows nothing.

    .. [1] G. J. Bierman, Fixed Interval Smoothing with Discrete Measurements, Int. J. Control 18 (1973) 65–75.
    """
    store, smoothed, n = solution.store, solution.smoothed, solution.problem.active.size
    chosen = smoothed.chosen
    h = chosen.size
    nav = slice(0, states.NAVIGATION)
    forward, separation, sigma = np.empty((h, 9, 9)), np.full((h, 9), np.nan), np.full((h, 9), np.nan)
    P = np.empty((n, n))
    total, degrees = 0.0, 0
    for i, e in enumerate(chosen):
        kalman.unpack(store.epoch_P[e], P)
        forward[i] = P[nav, nav]
        scale = np.sqrt(np.maximum(np.diag(P), 1e-300))
        # Scaled to correlations: the states' units differ by ten orders of magnitude.
        values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
        L = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        w, V = np.linalg.eigh(L.T @ smoothed.adjoint_matrix[i] @ L)
        seen = w > SEEN_BACKWARDS
        a = V.T @ (L.T @ smoothed.adjoint[i])
        total, degrees = total + float((a[seen] ** 2 / w[seen]).sum()), degrees + int(seen.sum())
        spread = L @ V
        # A state counts where all but a hundredth of its forward variance lies in directions seen backwards too.
        known = (spread[:, ~seen] ** 2).sum(axis=1)[nav] < 0.01 * np.diag(P)[nav]
        separation[i, known] = -(spread[nav][:, seen] @ (a[seen] / w[seen]))[known]
        sigma[i, known] = np.sqrt((spread[nav][:, seen] ** 2 / w[seen]).sum(axis=1))[known]
    theta_sigma = np.zeros((h, states.PARAMETERS))
    carried = solution.problem.active[states.NAVIGATION :] - states.NAVIGATION
    theta_sigma[:, carried] = np.sqrt(np.maximum(smoothed.variance, 0.0))
    theta = solution.theta()[chosen]
    theta[:, states.parameter("gnss_latency")] += solution.problem.latency
    kalman.unpack(store.epoch_P[solution.count - 1], P)
    return Histories(
        store.epoch_time[chosen],
        sigmas(forward, store.epoch_dcm[chosen]),
        separation,
        sigma,
        total / degrees if degrees else float("nan"),
        theta,
        theta_sigma,
        P[states.NAVIGATION :, states.NAVIGATION :].copy(),
    )


def without_matrices(store: kalman.Store) -> kalman.Store:
    """The store without covariances, transitions and gains."""
    none = np.empty(0)
    return store._replace(epoch_P=none, epoch_phi=none, epoch_decay=none, H=none, K=none, S_inv=none, y=none)


def doubted(solution: Solution) -> Doubts:
    """Stretches in which the path is doubtful, and by how much [m], [m/s]: from the first fix of a run of rejected ones to the
    re-entry that ends it, and on to the next run where that follows within a minute."""
    store, place, time = solution.store, solution.gathered.of_fix, solution.problem.gnss.time
    known = np.flatnonzero(np.isfinite(store.nis[place]) & ~withheld(time, solution.problem.settings))
    rejected = store.verdict[place[known], 0] == kalman.REJECTED
    spans: Doubts = []
    for at in np.flatnonzero(store.reentry[place[known]]):
        # The run's other fixes keep their verdict; the one that ended it was believed.
        first = int(at)
        while first > 0 and rejected[first - 1]:
            first -= 1
        y = store.innovation[place[known[at]]]
        size = (float(np.linalg.norm(y[:3])), float(np.linalg.norm(y[3:])))
        begin, end = float(time[known[first]]), float(time[known[at]])
        if spans and begin - spans[-1][1] < 60.0:
            begin = spans[-1][1]
        spans.append((begin, end, *size))
    return spans


def refuse_nonsense(solution: Solution) -> None:
    """Raise StageError where most fixes contradict the inertial data: one of them, or what they are read with, is wrong."""
    store, place = solution.store, solution.gathered.of_fix
    known = np.isfinite(store.nis[place]) & ~withheld(solution.problem.gnss.time, solution.problem.settings)
    share = float((store.verdict[place[known], 0] == kalman.REJECTED).mean()) if known.any() else 1.0
    if share > MOST_REJECTED:
        raise StageError(
            f"{share:.0%} of the fixes contradict the inertial data: check `initial`, mounting.imu_to_body_deg, the lever arm, "
            "the units and the clocks of both"
        )


def warnings(quality: dict[str, Any]) -> list[str]:
    """What a reader must not overlook, in sentences."""
    out = []
    unit = quality.get("sigma_of_unit_weight")
    if unit is not None and unit > 1.1 and not quality["innovation_nis_inside_band"]:
        out.append(
            f"The innovations are {unit:.2f} times as large as the declared sigmas of fixes and inertial unit allow. Either "
            "those are too small, or the model lacks an effect: every sigma of this flight is too small by at least about that "
            "factor. A run that estimates lever arm and latency (navigation.estimate) tells whether they are the cause."
        )
    for entry in quality["reentries"]:
        out.append(
            f"At {entry['time_s']:.1f} s positions had been rejected for so long that the filter took one "
            f"{entry['innovation_m']:.3g} m away ({entry['seconds_of_flight']:+.3f} s of flight along the course): a datum or a "
            "clock may have jumped, or the path before was wrong. Sigmas are widened there."
        )
    fixes = quality["fixes"]
    share = fixes["rejected"] / max(fixes["rejected"] + fixes["used"], 1)
    if share > 0.02:
        out.append(f"{share:.1%} of the fixes were rejected.")
    separation = quality["separation"]
    if separation is not None and separation["chi2_over_expected"] > 2.0:
        out.append(
            "Forward and backward solution differ by more than their sigmas allow "
            f"(χ² {separation['chi2_over_expected']:.1f} times expected)."
        )
    if quality["largest_correction_deg"] > 2.0:
        out.append(
            f"The smoother turned the filter's path by up to {quality['largest_correction_deg']:.1f}°, more than a linear model "
            "bears: sigmas there are too small."
        )
    return out


def assess(
    solution: Solution, trajectory: Trajectory, along: Histories, passes: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Plain data for run.json, and for the figures of the report."""
    problem, store = solution.problem, solution.store
    gnss, place = problem.gnss, solution.gathered.of_fix
    nis, verdict = store.nis[place], store.verdict[place]
    size = solution.gathered.measurements.size[place]
    kept = ~withheld(gnss.time, problem.settings)
    seen = np.isfinite(nis)
    residual = antenna_residuals(trajectory, gnss, along)
    rejected = seen & kept & (verdict == kalman.REJECTED).T
    used = seen & kept & ~rejected[0]  # by their positions
    chosen = residual[used]
    quality = {
        "alignment": problem.start.method,
        "passes": passes,
        "estimated": list(problem.settings.estimate),
        "fixes": {
            "used": int(used.sum()),
            "rejected": int(rejected[0].sum()),
            "velocities_rejected": int(rejected[1].sum()),
            "weighed_down": int((seen & kept & (verdict == kalman.WEIGHED_DOWN).any(axis=1)).sum()),
            "withheld": int((seen & ~kept).sum()),
            "outside_imu": int((~seen).sum()),
        },
        "rejected_times_s": [float(t) for t in gnss.time[rejected.any(axis=0)][:100]],
        "reentries": _reentries(solution),
        **_innovations(solution, used & ~rejected[1] & ~store.reentry[place], nis, size),
        "position_residual_rms_m": float(np.sqrt((chosen**2).sum(axis=1).mean())) if used.any() else None,
        "position_residual_rms_ned_m": [float(v) for v in np.sqrt((chosen**2).mean(axis=0))] if used.any() else [],
        "separation": _separation(along),
        "imu": _imu(solution),
        "gnss": _gnss(gnss),
        "largest_correction_deg": float(
            np.rad2deg(np.linalg.norm(solution.smoothed.correction[:, states.ATTITUDE], axis=1).max())
        ),
        "standstill_s": problem.still.seconds,
        "standstill_rejected": _standstill_rejected(solution),
        **_gaps(solution),
        "gyro_bias_deg_per_h": (along.theta[:, states.parameter("gyro_bias")].mean(axis=0) / DEG_PER_H).tolist(),
        "accel_bias_ug": (along.theta[:, states.parameter("accel_bias")].mean(axis=0) / MICRO_G).tolist(),
        "sigma_position_m_median": [float(v) for v in np.median(trajectory.sigma_position, axis=0)],
        "sigma_attitude_deg_median": [float(v) for v in np.rad2deg(np.median(trajectory.sigma_attitude, axis=0))],
        "calibration": calibration.calibrated(
            problem.settings, problem.declared, along.theta[-1], along.covariance, trajectory
        ),
    }
    settings = problem.settings
    if settings.withhold_s or settings.withhold_every_s is not None or settings.free_inertial_after_s is not None:
        quality["withheld"] = _misses(solution, trajectory, residual, seen & ~kept)
    if problem.settings.free_inertial_after_s is not None:
        quality["free_inertial"] = _free_inertial(solution, problem.settings.free_inertial_after_s)
    quality["warnings"] = warnings(quality)
    return quality, _figures(solution, along, residual, used, seen, kept)


def _innovations(solution: Solution, used: NDArray[np.bool_], nis: Array, size: NDArray[np.int64]) -> dict[str, Any]:
    """NIS of the used fixes against its band, by quality, and each component's mean and scatter in its own sigma.

    Were all innovations white and of their declared size, ΣNIS would be χ² with Σm degrees of freedom.
    """
    if not used.any():
        return {"innovation_nis_mean": None, "innovation_nis_expected": None}
    store, place = solution.store, solution.gathered.of_fix
    degrees, count = float(size[used].sum()), int(used.sum())
    low, high = chi2.ppf([0.025, 0.975], degrees) / count
    mean = float(nis[used].mean())
    z = store.innovation[place][used] / store.innovation_sigma[place][used]
    names = [f"position_{a}" for a in AXES] + [f"velocity_{a}" for a in AXES]
    by_quality = {
        name: {
            "used": int(mine.sum()),
            "nis_over_expected": float(nis[mine].sum() / size[mine].sum()),
        }
        for code, name in GNSS_QUALITIES.items()
        if (mine := used & (solution.problem.gnss.quality == code)).any()
    }
    return {
        "innovation_nis_mean": mean,
        "innovation_nis_expected": degrees / count,
        "innovation_nis_band95": [float(low), float(high)],
        "innovation_nis_inside_band": bool(low <= mean <= high),
        "sigma_of_unit_weight": float(np.sqrt(np.median(nis[used] / chi2.median(size[used])))),
        "innovation_nis_by_quality": by_quality,
        "innovation_over_sigma": {
            name: {"mean": float(np.nanmean(z[:, i])), "std": float(np.nanstd(z[:, i]))}
            for i, name in enumerate(names)
            if np.isfinite(z[:, i]).any()
        },
    }


def _reentries(solution: Solution) -> list[dict[str, float]]:
    """Where the filter doubted itself: when, and how far the fix was from the path."""
    store, place, gnss = solution.store, solution.gathered.of_fix, solution.problem.gnss
    at = np.flatnonzero(store.reentry[place])
    distance = np.linalg.norm(store.innovation[place][:, :3], axis=1)
    k = np.searchsorted(solution.problem.imu.time, solution.gathered.fix_time[at]).clip(0, store.epoch.size - 1)
    v = store.velocity[k]
    along = (store.innovation[place][at, :3] * v).sum(axis=1) / np.maximum((v**2).sum(axis=1), 1e-6)
    return [
        {"time_s": float(gnss.time[i]), "innovation_m": float(distance[i]), "seconds_of_flight": float(a)}
        for i, a in zip(at[:100], along, strict=False)
    ]


def _separation(along: Histories) -> dict[str, Any] | None:
    """RMS of backward minus forward, where both know the state, and χ² over its degrees (1 where sigmas are honest)."""
    known = np.isfinite(along.separation).all(axis=1)
    if not known.any():
        return None
    rms = np.sqrt((along.separation[known] ** 2).mean(axis=0))
    sigma = np.sqrt((along.separation_sigma[known] ** 2).mean(axis=0))
    return {
        "epochs": int(known.sum()),
        "position_rms_m": rms[:3].tolist(),
        "position_sigma_m": sigma[:3].tolist(),
        "attitude_ned_rms_deg": np.rad2deg(rms[6:]).tolist(),
        "attitude_ned_sigma_deg": np.rad2deg(sigma[6:]).tolist(),
        "chi2_over_expected": along.separation_chi2,
    }


def _standstill_rejected(solution: Solution) -> int:
    """Standstill windows whose zero velocity or rotation the filter could not believe."""
    mine = solution.gathered.measurements.kind == kalman.STANDSTILL
    return int((solution.store.verdict[mine] == kalman.REJECTED).any(axis=1).sum())


def _imu(solution: Solution) -> dict[str, float]:
    time = solution.problem.imu.time
    steps = np.diff(time)
    return {
        "rate_hz": float(steps.size / (time[-1] - time[0])),
        "nominal_rate_hz": float(solution.problem.model.rate),
        "longest_step_s": float(steps.max()),
    }


def _gnss(gnss: Gnss) -> dict[str, Any]:
    steps = np.diff(gnss.time)
    return {
        "rate_hz": float(1.0 / np.median(steps)),
        "longest_outage_s": float(steps.max()),
        "outages": int((steps > DATA_GAP * np.median(steps)).sum()),
        "quality_share": {
            name: float((gnss.quality == code).mean())
            for code, name in GNSS_QUALITIES.items()
            if (gnss.quality == code).any()
        },
    }


def _gaps(solution: Solution) -> dict[str, Any]:
    time = solution.problem.imu.time
    steps = np.diff(time)
    found = [{"start_s": float(time[i]), "length_s": float(steps[i])} for i in np.flatnonzero(solution.gap[1:])]
    return {"imu_gaps": found[:100], "imu_gap_count": len(found)}


def _misses(solution: Solution, trajectory: Trajectory, residual: Array, chosen: NDArray[np.bool_]) -> dict[str, float]:
    """How far withheld fixes are missed by the smoothed path and by the forward filter, and both in sigmas of the smoothed."""
    store, place = solution.store, solution.gathered.of_fix
    if not chosen.any():
        return {"fixes": 0}
    ahead = store.innovation[place][chosen, :3]
    miss = residual[chosen]
    time = solution.gathered.fix_time[chosen]
    sigma = np.stack([np.interp(time, trajectory.time, trajectory.sigma_position[:, i]) for i in range(3)], 1)
    declared = np.hypot(sigma, solution.problem.gnss.sigma_position[chosen])
    return {
        "fixes": int(chosen.sum()),
        "horizontal_rms_m": _rms(np.hypot(miss[:, 0], miss[:, 1])),
        "horizontal_max_m": float(np.hypot(miss[:, 0], miss[:, 1]).max()),
        "vertical_rms_m": _rms(miss[:, 2]),
        "forward_horizontal_rms_m": _rms(np.hypot(ahead[:, 0], ahead[:, 1])),
        "forward_vertical_rms_m": _rms(ahead[:, 2]),
        "miss_over_sigma_rms": _rms(miss / declared),
    }


def _free_inertial(solution: Solution, after: float) -> dict[str, Any]:
    """Horizontal distance of the fixes from the path after 1 h without them, and at the end, in metres and nautical miles."""
    store, place, time = solution.store, solution.gathered.of_fix, solution.problem.gnss.time
    seen = np.flatnonzero(np.isfinite(store.nis[place]) & (time > after))
    out: dict[str, Any] = {"after_s": after}
    if not seen.size:
        return out
    distance = np.hypot(*store.innovation[place][seen, :2].T)
    hour = np.flatnonzero(time[seen] >= after + 3600.0)
    for name, i in (("1h", int(hour[0]) if hour.size else None), ("end", seen.size - 1)):
        if i is not None:
            out[name] = {
                "elapsed_s": float(time[seen[i]] - after),
                "error_m": float(distance[i]),
                "error_nmi": float(distance[i] / NAUTICAL_MILE),
            }
    return out


def antenna_residuals(trajectory: Trajectory, gnss: Gnss, along: Histories) -> Array:
    """Fix minus smoothed antenna position, NED [m] (n, 3), with lever arm and latency as finally estimated."""
    lever = along.theta[-1, states.parameter("antenna_lever_arm")]
    time = gnss.time - along.theta[-1, states.parameter("gnss_latency")][0]
    at = [np.interp(time, trajectory.time, v) for v in (trajectory.latitude, trajectory.longitude, trajectory.height)]
    rpy = [np.interp(time, trajectory.time, np.unwrap(trajectory.rpy[:, i])) for i in range(3)]
    arm = rpy_to_dcm(*rpy) @ lever
    origin = float(at[0].mean()), float(at[1].mean()), float(at[2].mean())
    fix = local_metres(gnss.latitude, gnss.longitude, gnss.height, *origin)
    return np.asarray(fix - local_metres(at[0], at[1], at[2], *origin) - arm)


def _blocks(time: Array, nis: Array, size: NDArray[np.int64]) -> dict[str, list[float]]:
    """NIS over its degrees of freedom, means of up to 100 blocks of at least 20 fixes, with the 95 % band of such a mean."""
    count = int(np.clip(time.size // 20, 1, 100))
    out: dict[str, list[float]] = {"time": [], "mean": [], "low": [], "high": []}
    if not time.size:
        return out
    for part in np.array_split(np.arange(time.size), count):
        degrees = float(size[part].sum())
        low, high = chi2.ppf([0.025, 0.975], degrees) / degrees
        values = (float(time[part].mean()), float(nis[part].sum() / degrees), float(low), float(high))
        for name, value in zip(out, values, strict=True):
            out[name].append(value)
    return out


def _figures(
    solution: Solution,
    along: Histories,
    residual: Array,
    used: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    kept: NDArray[np.bool_],
) -> dict[str, Any]:
    gnss, nis = solution.problem.gnss, solution.store.nis[solution.gathered.of_fix]
    size = solution.gathered.measurements.size[solution.gathered.of_fix]
    shown = seen & kept
    watched = seen & ~kept

    def columns(prefix: str, values: Array, scale: float, names: tuple[str, ...]) -> dict[str, list[float | None]]:
        return {
            f"{prefix}_{name}": [None if not np.isfinite(v) else float(v * scale) for v in values[:, i]]
            for i, name in enumerate(names)
        }

    theta, sigma = along.theta, along.theta_sigma
    parameters: dict[str, Any] = {}
    for group in solution.problem.settings.estimate:
        at = states.parameter(group)
        parameters[group] = {
            "unit": states.UNITS[group],
            "value": theta[:, at].T.tolist(),
            "sigma": sigma[:, at].T.tolist(),
        }
    return {
        "fix_time": gnss.time[shown].tolist(),
        "fix_nis_over_expected": (nis[shown] / size[shown]).tolist(),
        "nis_blocks": _blocks(gnss.time[used], nis[used], size[used]),
        "fix_used": used[shown].astype(float).tolist(),
        "residual_time": gnss.time[used].tolist(),
        **{f"residual_{n}": residual[used][:, i].tolist() for i, n in enumerate(AXES)},
        "withheld_time": gnss.time[watched].tolist(),
        **{f"withheld_{n}": residual[watched][:, i].tolist() for i, n in enumerate(AXES)},
        "history_time": along.time.tolist(),
        **columns("separation", along.separation[:, :3], 1.0, AXES),
        **columns("separation_sigma", along.separation_sigma[:, :3], 1.0, AXES),
        **columns("separation_deg", along.separation[:, 6:], 180.0 / np.pi, AXES),
        **columns("separation_sigma_deg", along.separation_sigma[:, 6:], 180.0 / np.pi, AXES),
        **columns("forward_sigma_position", along.forward_sigma[:, :3], 1.0, AXES),
        **columns("forward_sigma_deg", along.forward_sigma[:, 6:], 180.0 / np.pi, ("roll", "pitch", "yaw")),
        "parameters": parameters,
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
