"""One pass of filter and smoother over a flight: from records to the compiled kernels and back.

Functions
---------
solve               filter and smoother
forward             the filter alone
likelihood, misfit  … over the first part of a flight: how well it explains the fixes
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pipeline.records import DATA_GAP, Gnss, Imu
from stages.navigation import kalman, states
from stages.navigation.alignment import Start
from stages.navigation.measurements import Gathered, gather
from stages.navigation.settings import NavigationSettings
from stages.navigation.standstill import Standstill
from tsmftis.geodesy import STANDARD_GRAVITY
from tsmftis.inertial import DEG_PER_H, ImuModel
from tsmftis.rotation import dcm_to_quaternion, rpy_jacobian, rpy_to_dcm

Array = NDArray[np.float64]

HISTORY = 400  # epochs at which a pass keeps what the quality figures are made of
LOST = 1.5  # usual steps: a longer one has lost a sample
STANDSTILL_NOISE = 0.1  # of the gyros' white noise: what may turn a body that stands


@dataclass(frozen=True)
class Problem:
    """What a pass works on. `declared` (19,) are the parameters as the campaign has them, `theta` those that the filter starts
    from; `latency` is taken off the stamps beforehand, so that what the filter still estimates of it is small."""

    imu: Imu
    gnss: Gnss
    model: ImuModel
    settings: NavigationSettings
    still: Standstill
    start: Start
    declared: Array
    theta: Array
    latency: float
    gap_variance: Array | None = None  # of each gap's rotation, per second (g,): as known after a first pass

    @property
    def active(self) -> NDArray[np.int64]:
        return states.estimated(self.settings.estimate)


@dataclass(frozen=True)
class Solution:
    """One pass: the filter's store, the smoother's output, and what they were made from."""

    problem: Problem
    gathered: Gathered
    gap: NDArray[np.bool_]
    count: int
    store: kalman.Store
    smoothed: kalman.Smoothed

    @property
    def epochs(self) -> slice:
        return slice(0, self.count)

    def theta(self) -> Array:
        """Smoothed parameters after each epoch (count, 19); the latency is that still in the stamps."""
        theta = self.store.epoch_theta[self.epochs].copy()
        active = self.problem.active[states.NAVIGATION :] - states.NAVIGATION
        theta[:, active] += self.smoothed.correction[:, states.NAVIGATION :]
        return theta

    def shift(self, epochs: NDArray[np.int64] | slice) -> Array:
        """Smoothed minus filtered position, velocity, attitude after the epochs (k, 9)."""
        return np.asarray(self.smoothed.correction[epochs, : states.NAVIGATION])


def initial_covariance(
    start: Start, model: ImuModel, settings: NavigationSettings, lever: Array, added: Array | None = None
) -> Array:
    """P at the start over all states (28, 28).

    added (19,): parameters that a model update adds. What a sensor's scale factor or g-sensitivity makes of gravity, its
    calibration at rest has taken for a bias: a bias of that size is as likely as none.
    """
    variance = np.zeros(states.STATES)
    variance[states.POSITION], variance[states.VELOCITY] = start.sigma_position**2, start.sigma_velocity**2
    g_sensitivity = settings.g_sensitivity_sigma_deg_per_h_per_g * DEG_PER_H / STANDARD_GRAVITY
    for group, sigma in {
        "gyro_bias": model.gyro.bias_sigma,
        "accel_bias": model.accel.bias_sigma,
        "gyro_scale_factor": model.gyro.scale_factor_sigma,
        "accel_scale_factor": model.accel.scale_factor_sigma,
        "gyro_g_sensitivity": g_sensitivity,
        "antenna_lever_arm": settings.lever_arm_sigma_m,
        "gnss_latency": settings.gnss_latency_sigma_s,
    }.items():
        variance[states.GROUPS[group]] = sigma**2
    if added is not None:
        for group, of in (("gyro_bias", "gyro_g_sensitivity"), ("accel_bias", "accel_scale_factor")):
            variance[states.GROUPS[group]] += (added[states.parameter(of)] * STANDARD_GRAVITY) ** 2
    P = np.diag(variance)
    # Sigmas of roll, pitch, yaw into the NED rotation vector: φ = M·δrpy, the inverse of `rpy_jacobian`.
    to_ned = np.linalg.inv(rpy_jacobian(start.rpy[None])[0])
    P[states.ATTITUDE, states.ATTITUDE] = to_ned @ np.diag(start.sigma_rpy**2) @ to_ned.T
    # The start was taken from a fix with the declared lever arm, stamp and attitude, so its error is theirs:
    # δr = v·δt − C·δl + (C·l)×φ
    from_parameters = np.zeros((3, states.STATES))
    arm = rpy_to_dcm(*start.rpy) @ lever
    from_parameters[:, states.ATTITUDE] = [[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]]
    if "antenna_lever_arm" in settings.estimate:
        from_parameters[:, states.GROUPS["antenna_lever_arm"]] = -rpy_to_dcm(*start.rpy)
    if "gnss_latency" in settings.estimate:
        from_parameters[:, states.GROUPS["gnss_latency"]] = start.velocity[:, None]
    shared = from_parameters @ P
    P[states.POSITION] += shared
    P[:, states.POSITION] += shared.T
    P[states.POSITION, states.POSITION] += shared @ from_parameters.T
    return P


def process_noise(model: ImuModel) -> Array:
    """Spectral densities [unit²/s] of the states (28,): white noise into v and φ, 2σ²/τ into the Gauss–Markov biases."""
    noise = np.zeros(states.STATES)
    noise[states.VELOCITY], noise[states.ATTITUDE] = model.accel.white_noise**2, model.gyro.white_noise**2
    for group, sensor in (("gyro_bias", model.gyro), ("accel_bias", model.accel)):
        noise[states.GROUPS[group]] = 2.0 * sensor.bias_sigma**2 / sensor.bias_correlation_time
    return noise


def gaps(time: Array) -> NDArray[np.bool_]:
    """Which samples close a gap in the data (n,)."""
    steps = np.diff(time, prepend=time[0])
    return np.asarray(steps > DATA_GAP * np.median(steps[1:]))


def unseen(imu: Imu, gap: NDArray[np.bool_]) -> Array:
    """Variances per second (n, 2) of rotation and velocity for what lacks in an interval: none, a sample, or a gap.

    In a gap the body moves as it does elsewhere: the data's own scatter, held over the gap. A sample that was lost was put in as
    the mean of its neighbours (`filled`), whose difference says how wrong that may be.
    """
    steps = np.diff(imu.time, prepend=imu.time[0])
    out = np.zeros((imu.time.size, 2))
    lost = (steps > LOST * np.median(steps[1:])) & ~gap
    for column, values in enumerate((imu.gyro, imu.accel)):
        if gap.any():
            out[gap, column] = values.var(axis=0).max() * steps[gap]
        if lost.any():
            jump = 0.5 * np.linalg.norm(values[lost] - values[np.flatnonzero(lost) - 1], axis=1)
            out[lost, column] = jump**2 * steps[lost]
    return out


def filled(imu: Imu) -> Imu:
    """Lost samples put in: a sample that follows an interval of nearly two is the mean over the last of them alone, and the
    one that is lost is put in as the mean of its neighbours. Gaps are left as they are."""
    steps = np.diff(imu.time, prepend=imu.time[0])
    usual = float(np.median(steps[1:]))
    lost = np.flatnonzero((steps > LOST * usual) & (steps <= DATA_GAP * usual))
    lost = lost[lost > 0]
    if not lost.size:
        return imu
    # Only where most stamps are even: a unit whose intervals scatter means what its stamps say.
    if lost.size > 0.1 * steps.size:
        return imu
    missing = ((steps[lost] - usual) / steps[lost])[:, None]
    whole = []
    for values in (imu.gyro, imu.accel):
        out = values.copy()
        out[lost] = (1.0 - missing) * values[lost] + missing * 0.5 * (values[lost] + values[lost - 1])
        whole.append(out)
    return replace(imu, gyro=whole[0], accel=whole[1])


def _unit(problem: Problem, gap: NDArray[np.bool_]) -> kalman.Unit:
    imu, model = problem.imu, problem.model
    noise = process_noise(model)
    lacking = unseen(imu, gap)
    if problem.gap_variance is not None:
        lacking[gap, 0] = np.minimum(lacking[gap, 0], problem.gap_variance)
    still_noise = noise.copy()
    still_noise[states.ATTITUDE] *= STANDSTILL_NOISE**2
    tau = np.repeat([model.gyro.bias_correlation_time, model.accel.bias_correlation_time], 3)
    still = problem.still.holds(imu.time)
    return kalman.Unit(imu.time, imu.gyro, imu.accel, gap, still, lacking, noise, still_noise, 1.0 / tau)


def forward(
    problem: Problem, watched: Collection[str] = (), refused: NDArray[np.bool_] | None = None
) -> tuple[Gathered, NDArray[np.bool_], int, kalman.Store]:
    """The filter: measurements, gaps, number of epochs and what it leaves behind.

    watched: groups of parameters that are carried as exactly known, so that the estimate is as if they were not, and the store
    holds their part of Φ and H too. refused: fixes (n,) that are not used; all others are believed then, whatever they say.
    """
    imu, settings, start = problem.imu, problem.settings, problem.start
    gathered = gather(imu, problem.gnss, problem.still, problem.latency, settings)
    gap = gaps(imu.time)
    unit = _unit(problem, gap)
    active = states.estimated({*settings.estimate, *watched})
    known = np.setdiff1d(active, problem.active)
    for noise in (unit.noise, unit.still_noise):
        noise[known] = 0.0
    measurements = gathered.measurements
    inside = int(((measurements.time >= imu.time[0]) & (measurements.time <= imu.time[-1])).sum())
    changes = int(np.count_nonzero(np.diff(unit.still)))
    size = inside + int(np.ceil((imu.time[-1] - imu.time[0]) / settings.epoch_s)) + 2 * int(gap.sum()) + changes + 2
    store = kalman.Store.empty(imu.time.size, size, measurements.time.size, active.size)
    gates = np.array([0.0] + [chi2.isf(settings.gate_probability, m) for m in range(1, 7)])
    if refused is not None:
        measurements.use[gathered.of_fix[refused]] = False
        gates[:] = np.inf
    theta = problem.theta.copy()
    lever = theta[states.parameter("antenna_lever_arm")]
    theta[states.parameter("gnss_latency")] -= problem.latency
    P0 = initial_covariance(start, problem.model, settings, lever, problem.theta - problem.declared)
    P0[known], P0[:, known] = 0.0, 0.0
    count = kalman.forward(
        unit,
        measurements,
        active,
        start.position.copy(),
        start.velocity.copy(),
        dcm_to_quaternion(rpy_to_dcm(*start.rpy)),
        theta,
        P0[np.ix_(active, active)],
        settings.epoch_s,
        gates,
        settings.reentry_s,
        store,
    )
    return gathered, gap, count, store


def _until(problem: Problem, until: float) -> Problem:
    time = problem.imu.time
    stop = int(np.searchsorted(time, until, side="right"))
    return replace(problem, imu=Imu(time[:stop], problem.imu.gyro[:stop], problem.imu.accel[:stop]))


def likelihood(problem: Problem, until: float) -> float:
    """Σ −½(min(NIS, gate) + ln det S) over the fixes up to `until` [s]: how well a start explains them."""
    _, _, _, store = forward(_until(problem, until))
    return float(store.loglike.sum())


def misfit(problem: Problem, until: float) -> tuple[float, float]:
    """Σ min(NIS, gate) over the fixes up to `until` [s], and its expectation Σ m."""
    gathered, _, _, store = forward(_until(problem, until))
    measurements = gathered.measurements
    counted = np.isfinite(store.nis) & measurements.use & (measurements.kind == kalman.FIX)
    gate = np.array([chi2.isf(problem.settings.gate_probability, m) for m in measurements.size[counted]])
    return float(np.minimum(store.nis[counted], gate).sum()), float(measurements.size[counted].sum())


def solve(problem: Problem) -> Solution:
    """Filter and smoother over the whole flight."""
    gathered, gap, count, store = forward(problem)
    chosen = np.unique(np.linspace(0, count - 1, min(HISTORY, count)).astype(np.int64))
    smoothed = kalman.Smoothed.empty(count, problem.active.size, chosen)
    kalman.backward(count, problem.active, store, smoothed)
    return Solution(problem, gathered, gap, count, store, smoothed)
