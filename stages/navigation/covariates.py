"""What is left of a flight's innovations may be a curve of: the vehicle's state at a fix, and errors that the filter carries on.

    attitude                             the antenna's place is off by a vector fixed in the vehicle
    velocity                             fixes are late, by a time of their own and one that grows with speed
    angular rate, specific force         a gyro (accelerometer) shows a part of the rates (forces) of all three axes
    specific force on the gyros          a gyro shows a part of the forces of all three axes

These reach the innovations through the filter's recursion (see `recursion`): what an unknown error of the kind does, whether
or not it has a name. All others are of the residual as it is.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.curves import TABLE
from pipeline.records import Imu
from pipeline.residual_problem import Basis
from stages.navigation import kalman, states
from stages.navigation.recursion import FORCE, RATE, Inputs
from stages.navigation.solve import Solution
from tsmftis.geodesy import STANDARD_GRAVITY
from tsmftis.rotation import dcm_to_rpy, quaternion_to_dcm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AXES = "xyz"
REFERENCE_SPEED = 10.0  # m/s, at which the two lags of `velocity` are the same
ATTITUDE, VELOCITY = "attitude", "velocity"
GYROS, ACCELEROMETERS, G_SENSITIVITY = "angular rate", "specific force", "specific force on the gyros"
# Errors of the sensors: first place among the six biases, and the signals.
SENSORS = {GYROS: (0, RATE), ACCELEROMETERS: (3, FORCE), G_SENSITIVITY: (0, FORCE)}
# (row, column) of a sensor's 3 × 3 matrix, its own axes first.
ENTRIES = ((0, 0), (1, 1), (2, 2), *((i, j) for i in range(3) for j in range(3) if i != j))


def covariates_of(
    solution: Solution, imu: Imu, chosen: Index, count: int, bases: Mapping[str, Basis]
) -> dict[str, Array | Basis]:
    """Of the vehicle at each chosen fix (k,), for each of `count` components; acceleration is each component's own.

    imu: with its thermometers; bases: those that the filter carries on (`bases_of`).
    """
    store, gnss = solution.store, solution.problem.gnss
    fixes = solution.gathered.of_fix[chosen]
    time = gnss.time[chosen]
    k = np.searchsorted(solution.problem.imu.time, time).clip(0, store.epoch.size - 1)
    dcm, velocity = quaternion_to_dcm(store.q[k]), store.velocity[k]
    roll, pitch, yaw = dcm_to_rpy(dcm)
    rate, force = solution.gathered.measurements.rate[fixes], solution.gathered.measurements.force[fixes]
    turning = np.einsum("kij,kj->ki", dcm, rate)
    acceleration = np.einsum("kij,kj->ki", dcm, force) + np.array([0.0, 0.0, STANDARD_GRAVITY])
    common = {
        "time": time,
        "speed": np.hypot(velocity[:, 0], velocity[:, 1]),
        "heading north": np.cos(yaw),
        "heading east": np.sin(yaw),
        "roll": roll,
        "pitch": pitch,
        "turn rate": turning[:, 2],
        "height": gnss.height[chosen],
        "sigma of position": np.linalg.norm(gnss.sigma_position[chosen], axis=1),
    }
    if (temperature := _temperature(imu)) is not None:
        common["temperature"] = np.interp(time, *temperature)
    out: dict[str, Array | Basis] = {name: np.tile(v, count) for name, v in common.items() if np.ptp(v) > 0.0}
    out["acceleration"] = np.tile(acceleration.T, (count // 3, 1)).ravel()
    return out | dict(bases)


def inputs_of(active: Index, store: kalman.Store) -> Inputs:
    """The errors whose traces are the columns of `bases_of`. Velocities behind by a latency show the unit's acceleration alone:
    what vibration does to the antenna beyond it depends on the phase."""
    sizes = [3, 2, *(len(ENTRIES) for _ in SENSORS)]
    made = Inputs.none(active.size, sum(sizes), store.rows.size, np.array([4]))
    arm, late = (states.GROUPS[g] for g in ("antenna_lever_arm", "gnss_latency"))
    made.start[np.searchsorted(active, np.arange(arm.start, arm.stop)), np.arange(3)] = 1.0
    at = int(np.searchsorted(active, late.start))
    made.start[at, 3] = 1.0
    speed = np.linalg.norm(store.H[:, :3, at], axis=1)
    made.direct[:, :, 0] = store.H[:, :, at] * (speed / REFERENCE_SPEED)[:, None]  # zero but at a fix
    column = 5
    for first, source in SENSORS.values():
        for i, j in ENTRIES:
            made.sensor[column], made.source[column] = first + i, source[j]
            column += 1
    return made


def bases_of(columns: Array, speed: Array, rate: Array, force: Array) -> dict[str, Basis]:
    """columns (n, 32): what the errors of `inputs_of` show in the samples; norms (n,): speed, rate, force (SI)."""
    heading = np.linspace(-np.pi, np.pi, TABLE)
    c, s, zero = np.cos(heading), np.sin(heading), np.zeros(TABLE)
    fixed = {
        "north": np.column_stack([c, -s, zero]),
        "east": np.column_stack([s, c, zero]),
        "down": np.column_stack([zero, zero, zero + 1.0]),
    }
    v = np.linspace(0.0, float(speed.max()), TABLE)
    late = {"behind": np.column_stack([v, v**2 / REFERENCE_SPEED])}
    nowhere = np.full(speed.size, np.nan)
    out = {
        ATTITUDE: Basis(
            columns[:, :3], nowhere, heading, fixed, "rad", dict.fromkeys(fixed, "m"), common=True, smooth=False
        ),
        VELOCITY: Basis(columns[:, 3:5], speed, v, late, "m/s", {"behind": "m"}, common=True, smooth=False),
    }
    first = 5
    for (name, (kind, _)), values in zip(SENSORS.items(), (rate, force, force), strict=True):
        own = columns[:, first : first + len(ENTRIES)]
        first += len(ENTRIES)
        at = np.linspace(0.0, float(values.max()), TABLE)
        sensor = "accelerometer" if kind else "gyro"
        entries = {
            f"{sensor} {AXES[i]} by {AXES[j]}": at[:, None] * (np.arange(len(ENTRIES)) == k)
            for k, (i, j) in enumerate(ENTRIES)
        }
        unit = "m/s²" if kind else "rad/s"
        out[name] = Basis(
            own,
            values,
            at,
            entries,
            "rad/s" if name == GYROS else "m/s²",
            dict.fromkeys(entries, unit),
            common=True,
            smooth=False,
        )
    return out


def _temperature(imu: Imu) -> tuple[Array, Array] | None:
    """Times and mean of the unit's thermometers, where it has any."""
    t = imu.temperatures
    if t is None:
        return None
    read = [v.reshape(len(t.time), -1) for v in (t.gyro, t.accel) if v is not None]
    return (t.time, np.nanmean(np.hstack(read), axis=1)) if read else None
