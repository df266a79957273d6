"""Whether the clocks of the inertial unit and the receiver stay together; where one jumps, the flight is refused.

Functions
---------
refuse_jumps    both checks
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Imu
from stages.navigation import kalman, states
from stages.navigation.alignment import Start
from stages.navigation.measurements import withheld
from stages.navigation.output import sigmas
from stages.navigation.solve import Solution, misfit
from tsmftis.geodesy import radii_of_curvature
from tsmftis.rotation import dcm_to_rpy, exp_so3, quaternion_to_dcm

Array = NDArray[np.float64]

JUMP = 0.02  # s: below it a clock's jump is not told from noise
JUMP_SPEED = 3.0  # m/s
JUMP_LASTS = 5.0  # s
SHORTEST_GAP = 0.05  # s: a gap is asked whether it is a jump of the stamps
BEFORE, AFTER = 20.0, 300.0  # s of flight on which it is asked
POOR = 1.3  # times its expectation: a sum of NIS above it says that the gap does not explain the fixes
DECISIVE = 100.0  # by which the sum of NIS must fall without the gap
MOST_GAPS = 5  # the longest are asked


def refuse_jumps(solution: Solution) -> None:
    """Raise InputError where fixes part from the path as a jump makes them, or where a gap in the inertial data is none."""
    _fixes_part(solution)
    steps = np.diff(solution.problem.imu.time, prepend=solution.problem.imu.time[0])
    longest = np.argsort(steps)[::-1][:MOST_GAPS]
    for k in longest[(steps[longest] > SHORTEST_GAP) & solution.gap[longest]]:
        _gap_is_one(solution, int(k))


def _fixes_part(solution: Solution) -> None:
    """Fixes that lie off the path by v·Δt for good: one of the clocks has jumped.

    Over a run of rejected fixes that lasts five seconds or to the end of the flight, Δt is the least-squares slope of the
    innovation on the velocity; it is a jump where it explains 90 % of the innovations' squares, and four times better than a
    shift of the datum would. On a straight line the two cannot be told apart, and the re-entry that follows is reported.
    """
    store, gnss, place = solution.store, solution.problem.gnss, solution.gathered.of_fix
    kept = ~withheld(gnss.time, solution.problem.settings)
    known = np.flatnonzero(np.isfinite(store.nis[place]) & kept)
    refused = ((store.verdict[place, 0] == kalman.REJECTED) | store.reentry[place])[known]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], refused.astype(np.int8), [0]])))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        run = known[first:stop]
        last = int(run[-1])
        comes_back = stop < known.size and not store.reentry[place[last]]
        if gnss.time[last] - gnss.time[run[0]] < JUMP_LASTS or comes_back:
            continue
        y = store.innovation[place[run], :3]
        k = np.searchsorted(solution.problem.imu.time, solution.gathered.fix_time[run]).clip(0, store.epoch.size - 1)
        v = store.velocity[k]
        moving = np.linalg.norm(v, axis=1) > JUMP_SPEED
        if moving.sum() < 5:
            continue
        y, v = y[moving], v[moving]
        slope = float((y * v).sum() / (v**2).sum())
        as_jump, as_shift = float(((y - slope * v) ** 2).sum()), float(((y - y.mean(axis=0)) ** 2).sum())
        if abs(slope) > JUMP and as_jump < 0.1 * float((y**2).sum()) and as_jump < 0.25 * as_shift:
            raise InputError(
                "gnss",
                "variable 'time'",
                f"from {gnss.time[run[0]]:.2f} s on, the fixes lie {abs(slope):.2f} s of flight "
                f"{'ahead of' if slope > 0 else 'behind'} the path of the inertial data: one of the two clocks has jumped there",
                "correct the stamps of imu or gnss, or make two flights of it",
            )


def _gap_is_one(solution: Solution, k: int) -> None:
    """The stamps before sample k: do data lack there, or did the clock jump? How well the fixes around it fit decides.

    Where the flight is straight it cannot, and nothing is said.
    """
    problem = solution.problem
    time = problem.imu.time
    first = int(np.searchsorted(time, time[k - 1] - BEFORE))
    last = int(np.searchsorted(time, time[k] + AFTER))
    part = slice(first, last)
    missing = float(time[k] - time[k - 1] - np.median(np.diff(time[part])))
    as_it_is = Imu(time[part], problem.imu.gyro[part], problem.imu.accel[part])
    joined = replace(as_it_is, time=np.where(np.arange(first, last) >= k, as_it_is.time - missing, as_it_is.time))
    until = float(joined.time[-1])
    trial = replace(problem, imu=as_it_is, start=_start_at(solution, first), still=problem.still.after(np.inf))
    (lacking, expected), (jumped, _) = misfit(trial, until), misfit(replace(trial, imu=joined), until)
    # The likelihood would count against the gap that it makes the filter unsure: what counts is whether it fits.
    if lacking > POOR * expected and lacking - jumped > DECISIVE:
        raise InputError(
            "imu",
            "variable 'time'",
            f"jumps by {missing:.3f} s after {time[k - 1]:.2f} s: the fixes say that no data are lost there: the clock jumped",
            "correct the stamps of one of the two parts",
        )


def _start_at(solution: Solution, k: int) -> Start:
    """The smoothed state at a stamp, as a start."""
    store, epoch = solution.store, int(solution.store.epoch[k])
    shift = solution.shift(np.array([epoch]))[0]
    lat, lon, height = store.position[k]
    north, east = radii_of_curvature(lat)
    position = np.array(
        [lat + shift[0] / (north + height), lon + shift[1] / ((east + height) * np.cos(lat)), height - shift[2]]
    )
    dcm = exp_so3(shift[states.ATTITUDE]) @ quaternion_to_dcm(store.q[k])
    sigma = sigmas(solution.smoothed.covariance[[epoch]], store.epoch_dcm[[epoch]])[0]
    return Start(
        float(solution.problem.imu.time[k]),
        position,
        store.velocity[k] + shift[states.VELOCITY],
        np.array(dcm_to_rpy(dcm)),
        np.maximum(3.0 * sigma[:3], 0.1),
        np.maximum(3.0 * sigma[3:6], 0.1),
        np.maximum(3.0 * sigma[6:], 1e-4),
        "smoothed",
    )
