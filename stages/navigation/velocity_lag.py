"""Velocities of a receiver that belong to an earlier instant than the positions that they come with: its filter makes them late.

    v(t) = v(t as recorded) + (smoothed v(t) − smoothed v(t − lag))

Functions
---------
taken_off    fixes with their velocities at their positions' instants
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gnss
from stages.navigation.output import smoothed_velocity
from stages.navigation.solve import Solution


def taken_off(gnss: Gnss, solution: Solution, lag: float) -> Gnss:
    """`gnss` with velocities moved by how the unit's own, in `solution`, changes over the lag [s] that ends at each fix."""
    if gnss.velocity is None or lag == 0.0:
        return gnss
    path, at = smoothed_velocity(solution), solution.problem.imu.time
    time = solution.gathered.measurements.time[solution.gathered.of_fix]

    def of(when: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.interp(when, at[: len(path)], axis) for axis in path.T], -1)

    return replace(gnss, velocity=gnss.velocity + of(time) - of(time - lag))
