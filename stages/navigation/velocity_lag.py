"""Velocities of a receiver that belong to an earlier instant than the positions that they come with: its filter makes them late.

    v(t) = v(t as recorded) + ∫ a dt over the lag that ends at t

Functions
---------
taken_off    fixes with their velocities at their positions' instants
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gnss
from stages.navigation.solve import Solution


def taken_off(gnss: Gnss, solution: Solution, lag: float) -> Gnss:
    """`gnss` with velocities moved by how the unit's own, in `solution`, changes over the lag [s] that ends at each fix."""
    if gnss.velocity is None or lag == 0.0:
        return gnss
    store, at = solution.store, solution.problem.imu.time
    count = min(at.size, store.velocity.shape[0], store.epoch.size)
    time = solution.gathered.measurements.time[solution.gathered.of_fix]

    def velocity(when: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.interp(when, at[:count], axis) for axis in store.velocity[:count].T], -1)

    return replace(gnss, velocity=gnss.velocity + velocity(time) - velocity(time - lag))
