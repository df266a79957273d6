"""The position and orientation system: alignment, forward filter, smoother, quality figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Gnss, Imu, ThermalCorrection, Trajectory
from stages.navigation import output, quality, states
from stages.navigation.alignment import Start, align, heading_at_rest, starting_at
from stages.navigation.clocks import refuse_jumps
from stages.navigation.measurements import withheld
from stages.navigation.settings import NavigationSettings
from stages.navigation.solve import Problem, Solution, filled, likelihood, solve
from stages.navigation.standstill import Standstill, find
from stages.navigation.velocity import moves
from stages.navigation.velocity_lag import taken_off
from tsmftis.camera import Mounting
from tsmftis.effects import EFFECTS
from tsmftis.geodesy import radii_of_curvature
from tsmftis.inertial import ImuModel
from tsmftis.rotation import dcm_to_rpy, exp_so3, quaternion_to_dcm, rpy_to_dcm

Array = NDArray[np.float64]

UNSURE_HEADING = np.deg2rad(9.0)  # a start that knows its heading worse than this is tried on several
HEADINGS = np.deg2rad([0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0])
HEADING_SIGMA = np.deg2rad(20.0)  # of each of them
TRIAL_S = 120.0  # of flight that a heading is tried on
COURSE_SIGMA = np.deg2rad(40.0)  # how far a vehicle's heading may be from its course, where nothing else tells
SETTLED = np.deg2rad(0.5)  # a smoothed correction of the first attitude below this needs no further pass
BRIDGES = 3  # passes after which a gap is bridged anew
LOOSE = np.deg2rad(1.0)  # a heading's sigma at the start above which a last pass is made with what is known by then
SETTLED_LATENCY = 1e-4  # s: 2 % of the period of a 50 Hz vibration, which swings the antenna


@dataclass(frozen=True)
class NavigationResult:
    """The trajectory at IMU rate and what a person must know to trust it (`quality`: plain data for run.json and the report)."""

    trajectory: Trajectory
    quality: dict[str, Any]
    figures: dict[str, Any]


def run(
    imu: Imu,
    gnss: Gnss,
    model: ImuModel,
    mounting: Mounting,
    settings: NavigationSettings,
    *,
    initial: tuple[float, Array, Array] | None = None,
    correction: ThermalCorrection | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    velocity_lag: float = 0.0,
) -> NavigationResult:
    """Integrate one flight.

    `initial` is (time [s], rpy [rad], sigma_rpy [rad]) or None (self-alignment); `correction` is taken off the inertial
    data in the IMU's own axes before they are turned into the body. `effects` are what a model update adds to the declared
    model, by the contract's names ({"gnss_latency": {"latency": 0.04}}). Raises InputError where IMU and GNSS do not overlap,
    where the inertial data have a gap that nothing can bridge, or where the two clocks part.
    velocity_lag [s]: of the receiver's velocities against its positions, taken off along the path of a run without it.
    """
    if velocity_lag:
        gnss = taken_off(
            gnss, smooth(imu, gnss, model, mounting, settings, initial, correction, effects)[0], velocity_lag
        )
    solution, passes = smooth(imu, gnss, model, mounting, settings, initial, correction, effects or {})
    histories = quality.histories(solution)
    # What is left needs none of the matrices, which are most of a long flight's memory.
    solution = replace(solution, store=quality.without_matrices(solution.store))
    quality.refuse_nonsense(solution)
    problem = solution.problem
    inside = (gnss.time >= problem.imu.time[0]) & (gnss.time <= problem.imu.time[-1])
    compass = heading_at_rest(_unless(problem.gnss, ~inside), model.gyro, settings.course_speed_m_per_s)
    known = float(problem.start.sigma_rpy[2])
    floor = compass * known / np.hypot(compass, known)
    trajectory = output.trajectory(solution, quality.doubted(solution), floor)
    figures_of_merit, figures = quality.assess(solution, trajectory, histories, passes)
    return NavigationResult(trajectory, figures_of_merit, figures)


def smooth(
    imu: Imu,
    gnss: Gnss,
    model: ImuModel,
    mounting: Mounting,
    settings: NavigationSettings,
    initial: tuple[float, Array, Array] | None = None,
    correction: ThermalCorrection | None = None,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> tuple[Solution, int]:
    """Filter and smoother as `run` has them, with all their matrices, and the number of passes."""
    imu = in_body_axes(imu, mounting, correction)
    as_declared, theta = declared(mounting, {}), declared(mounting, effects or {})
    _overlap(imu, gnss)
    _bridgeable(imu, settings)
    late = float(theta[states.parameter("gnss_latency")][0])
    if not settings.use_gnss_velocity:
        gnss = replace(gnss, velocity=None, sigma_velocity=None)
    kept = _unless(gnss, withheld(gnss.time, settings))
    kept = replace(kept, time=kept.time - late)
    if kept.time.size < 2:
        raise InputError(
            "settings",
            "navigation.withhold_s, withhold_every_s, free_inertial_after_s",
            f"leave {kept.time.size} of the fixes from {gnss.time[0]:.1f} to {gnss.time[-1]:.1f} s",
            "withhold fewer; times are seconds after the epoch",
        )
    still = find(imu, kept, model.gyro) if settings.standstill_updates else Standstill.none()
    lever = theta[states.parameter("antenna_lever_arm")]

    def start_at(offset: float) -> Start:
        return _start(imu, kept, lever, model, still, settings, initial, offset)

    start = start_at(0.0)
    later = int(((kept.time > start.time) & (kept.time <= imu.time[-1])).sum())
    if later < 5:
        raise InputError(
            "gnss",
            "variable 'time'",
            f"has {later} fixes that are not withheld between the start at {start.time:.1f} s and the end of the inertial data",
            "start earlier, or withhold fewer",
        )
    used = _from(filled(imu), start.time)
    problem = Problem(used, gnss, model, settings, still.after(start.time), start, as_declared, theta, late)
    return _repeated(_surest_heading(problem, kept, start_at, initial is None))


def in_body_axes(imu: Imu, mounting: Mounting, correction: ThermalCorrection | None) -> Imu:
    """Compensated inertial data turned from the IMU's axes into the body's."""
    if correction is not None:
        imu = correction.taken_off(imu)
    gyro, accel = (np.ascontiguousarray(values) for values in (imu.gyro, imu.accel))
    if mounting.imu_to_body.any():
        turn = mounting.dcm_imu_to_body
        gyro, accel = np.ascontiguousarray(gyro @ turn.T), np.ascontiguousarray(accel @ turn.T)
    return Imu(imu.time, gyro, accel)


def declared(mounting: Mounting, effects: Mapping[str, Mapping[str, float]]) -> Array:
    """The parameters θ (19,) as declared: the lever arm, and what a model update adds to it, to the stamps and to the sensors."""
    theta = np.zeros(states.PARAMETERS)
    theta[states.parameter("antenna_lever_arm")] = mounting.imu_to_antenna
    for name, values in effects.items():
        order = list(EFFECTS[name].units) if name in EFFECTS and name in states.GROUPS else []
        if not order or set(values) - set(order):
            raise ValueError(f"{name}: {dict(values)} is no effect on navigation with parameters {order}")
        theta[states.parameter(name)] += [values.get(key, 0.0) for key in order]
    return theta


def _overlap(imu: Imu, gnss: Gnss) -> None:
    inside = int(((gnss.time >= imu.time[0]) & (gnss.time <= imu.time[-1])).sum())
    if inside < 5:
        raise InputError(
            "gnss",
            "variable 'time'",
            f"spans {gnss.time[0]:.1f} to {gnss.time[-1]:.1f} s and the IMU {imu.time[0]:.1f} to {imu.time[-1]:.1f} s, "
            f"so {inside} fixes overlap",
            "both must be seconds on the campaign's one clock",
        )


def _bridgeable(imu: Imu, settings: NavigationSettings) -> None:
    steps = np.diff(imu.time)
    longest = int(np.argmax(steps))
    if steps[longest] > settings.longest_imu_gap_s:
        raise InputError(
            "imu",
            "variable 'time'",
            f"has a gap of {steps[longest]:.2f} s after {imu.time[longest]:.2f} s, in which nothing tells how the body moved",
            "make two flights of it, or raise navigation.longest_imu_gap_s",
        )


def _unless(gnss: Gnss, without: NDArray[np.bool_]) -> Gnss:
    """The fixes that are not `without`; alignment must not see what is withheld from the filter."""
    kept = ~without
    columns = (getattr(gnss, name) for name in gnss.__dataclass_fields__)
    return Gnss(*(None if c is None else c[kept] for c in columns))  # type: ignore[arg-type]


def _start(
    imu: Imu,
    gnss: Gnss,
    lever: Array,
    model: ImuModel,
    still: Standstill,
    settings: NavigationSettings,
    initial: tuple[float, Array, Array] | None,
    offset: float,
) -> Start:
    """The start, its heading turned by `offset` [rad] from what the course or `initial` says."""
    if initial is None:
        return align(imu, gnss, lever, model.gyro, still, settings.course_speed_m_per_s, offset)
    time, rpy, sigma = initial
    if not imu.time[0] - 1.0 <= time < imu.time[-1]:
        raise InputError(
            "campaign.yaml",
            "flights[].initial.time_s",
            f"{time:g} s lies outside the IMU's {imu.time[0]:.2f} to {imu.time[-1]:.2f} s",
            "give a time inside the flight, or leave `initial` out",
        )
    rpy = rpy + np.array([0.0, 0.0, offset])
    return starting_at(max(time, float(imu.time[0])), rpy, sigma, gnss, lever, "given")


def _surest_heading(problem: Problem, gnss: Gnss, start_at: Callable[[float], Start], aligned: bool) -> Problem:
    """The problem with the start whose heading explains the first fixes best, where the heading is not known to 9°.

    The filter alone is run from eight headings over the first two minutes in motion; the likelihood of the fixes decides, with
    what is known beforehand (`initial`, or that vehicles mostly head where they go).
    """
    start = problem.start
    if start.sigma_rpy[2] < UNSURE_HEADING:
        return problem
    known = COURSE_SIGMA if aligned else float(start.sigma_rpy[2])
    fast = moves(gnss, problem.settings.course_speed_m_per_s) & (gnss.time >= start.time)
    until = float(gnss.time[np.argmax(fast)] if fast.any() else start.time) + TRIAL_S
    best, highest = problem, -np.inf
    for offset in HEADINGS:
        candidate = start_at(float(offset))
        candidate = replace(candidate, sigma_rpy=np.array([*candidate.sigma_rpy[:2], HEADING_SIGMA]))
        trial = replace(problem, start=candidate)
        value = likelihood(trial, until) - 0.5 * (offset / known) ** 2
        if value > highest:
            best, highest = trial, value
    turned = np.rad2deg((best.start.rpy[2] - start.rpy[2] + np.pi) % (2 * np.pi) - np.pi)
    if abs(turned) > 1.0:
        said = f"{start.method}; turned by {turned:.0f}° to the heading that explains the fixes best"
        return replace(best, start=replace(best.start, method=said))
    return best if aligned else problem


def _repeated(problem: Problem) -> tuple[Solution, int]:
    """Passes until the path that the filter linearises about is the smoothed one: attitude, latency, and what a gap hides."""
    settings = problem.settings
    estimates_latency = "gnss_latency" in settings.estimate
    number = 1
    while True:
        solution = solve(problem)
        if number == 1:
            refuse_jumps(solution)
        attitude = np.linalg.norm(solution.shift(slice(0, 1))[0, states.ATTITUDE])
        late = float(solution.theta()[-1, states.parameter("gnss_latency")][0]) if estimates_latency else 0.0
        shifted, before = _shifted(problem.start, solution), problem.start.sigma_rpy[2]
        if _heading_is_unknown(problem.start, solution):
            # Another pass about the smoothed heading would take its own noise for news. One about the smoothed tilt is needed all
            # the same: a tilt that is corrected on the way makes the heading look observable.
            roll, pitch, _ = shifted.rpy
            shifted = replace(
                shifted,
                rpy=np.array([roll, pitch, problem.start.rpy[2]]),
                sigma_rpy=np.array([*shifted.sigma_rpy[:2], before]),
            )
            loose, attitude = number == 1 and before > LOOSE, np.float64(0.0)
        else:
            loose = before > LOOSE and shifted.sigma_rpy[2] < 0.5 * before
        rough = attitude >= SETTLED or loose or abs(late) > SETTLED_LATENCY
        bridging = solution.gap.any() and number <= BRIDGES
        if number == settings.passes or not (rough or bridging):
            return solution, number
        # The prior of position, velocity and attitude moves with the start and keeps its width, which is nothing beside the
        # flight's own information; that of the parameters stays where it was, since it does count.
        start = shifted if attitude >= SETTLED or loose else problem.start
        problem = replace(problem, start=start, latency=problem.latency + late)
        if solution.gap.any():
            imu, variance = _bridged(solution)
            problem = replace(problem, imu=imu, gap_variance=variance)
        if estimates_latency and _sigma(solution, "gnss_latency") < 0.2 * settings.gnss_latency_sigma_s:
            # Well known by now, so that a prior about the new value counts for nothing; one about the old would have the filter
            # begin 40 ms off, in a body that vibrates at 20 Hz.
            theta = problem.theta.copy()
            theta[states.parameter("gnss_latency")] = problem.latency
            problem = replace(problem, theta=theta)
        del solution  # its matrices make room for the next pass'
        number += 1


def _sigma(solution: Solution, group: str) -> float:
    """Sigma of a group's first parameter at the end of the flight."""
    variance = solution.smoothed.variance[-1]
    place = np.searchsorted(solution.problem.active, states.GROUPS[group].start) - states.NAVIGATION
    return float(np.sqrt(variance[place]))


def _from(imu: Imu, time: float) -> Imu:
    """The samples after `time`, with a first stamp exactly there: sample 0 is only the start, its rates are not used."""
    first = max(int(np.searchsorted(imu.time, time, side="right")), 1)
    stamps = imu.time[first - 1 :].copy()
    stamps[0] = time
    return Imu(stamps, imu.gyro[first - 1 :], imu.accel[first - 1 :])


def _shifted(start: Start, solution: Solution) -> Start:
    """The start moved by the smoothed correction of its position, velocity and attitude.

    Its attitude's sigma comes down to seven of the smoothed ones: with the old one the filter would wander again by degrees
    before it knows better, and be linearised about that; so tight a prior counts the flight's own information twice by 2 %. A
    start that has just moved far is not trusted so far: then the sigma stays at least as large as the move.
    """
    shift = solution.shift(slice(0, 1))[0]
    smoothed = output.sigmas(solution.smoothed.covariance[:1], solution.store.epoch_dcm[:1])[0, states.ATTITUDE]
    north, east = radii_of_curvature(start.position[0])
    scale = np.array([north + start.position[2], (east + start.position[2]) * np.cos(start.position[0]), -1.0])
    return replace(
        start,
        position=start.position + shift[states.POSITION] / scale,
        velocity=start.velocity + shift[states.VELOCITY],
        rpy=np.array(dcm_to_rpy(exp_so3(shift[states.ATTITUDE]) @ rpy_to_dcm(*start.rpy))),
        sigma_rpy=np.minimum(start.sigma_rpy, np.maximum(7.0 * smoothed, np.linalg.norm(shift[states.ATTITUDE]))),
    )


def settled_start(solution: Solution) -> Start:
    """The start of a further pass: moved to where the smoother has it, unless the flight says nothing of its heading."""
    start = solution.problem.start
    return start if _heading_is_unknown(start, solution) else _shifted(start, solution)


def _heading_is_unknown(start: Start, solution: Solution) -> bool:
    """Whether the flight tells the start's heading no better than to half of what was known of it before."""
    smoothed = output.sigmas(solution.smoothed.covariance[:1], solution.store.epoch_dcm[:1])[0, 8]
    return bool(smoothed > 0.5 * start.sigma_rpy[2])


def _bridged(solution: Solution) -> tuple[Imu, Array]:
    """The inertial data with what a gap hid put in, the constant rate and force that join the smoothed path before and after, and
    what is left unknown of each gap's rotation: variances per second (g,), from seven of the smoothed sigmas behind it.

    With all the noise of the gap the filter would wander by degrees behind it and be linearised about that. Velocity keeps its
    noise: how the force was spread over the gap, and so the way made, stays unknown.
    """
    imu, store = solution.problem.imu, solution.store
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    places = np.flatnonzero(solution.gap)
    variance = np.empty(places.size)
    for g, k in enumerate(places):
        before, after = int(store.epoch[k - 1]), int(store.epoch[k])
        length = imu.time[k] - imu.time[k - 1]
        # Epochs end at both sides of a gap; between them lie the updates of fixes inside it.
        inside = np.arange(before + 1, after + 1)
        jump = solution.shift(np.array([after]))[0] - solution.shift(np.array([before]))[0]
        jump = jump + store.epoch_dx[inside, : states.NAVIGATION].sum(axis=0)
        to_body = quaternion_to_dcm(store.q[k]).T
        gyro[k] += to_body @ jump[states.ATTITUDE] / length
        accel[k] += to_body @ jump[states.VELOCITY] / length
        # No less than it has just turned: what was bridged badly is not yet known so well.
        left = float(np.diag(solution.smoothed.covariance[after])[states.ATTITUDE].max())
        variance[g] = max(49.0 * left, float((jump[states.ATTITUDE] ** 2).sum())) / length
    return replace(imu, gyro=gyro, accel=accel), variance
