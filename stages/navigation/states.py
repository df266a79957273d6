"""The error states: their order, their groups, and which of them a run estimates.

True minus estimate, in this order: position NED [m], velocity NED [m/s], attitude φ in NED [rad] with C_true = exp(φ×)·C, and
the parameters θ: gyro bias [rad/s], accelerometer bias [m/s²] (both first-order Gauss–Markov), and constants: gyro and
accelerometer scale factor [1], gyro g-sensitivity [rad/s per m/s²], antenna lever arm [m, body], GNSS latency [s]. What the
sensors show is

    ω_m = (1 + s_g)·ω + g_s∘f + b_g,    f_m = (1 + s_a)·f + b_a,    fix's stamp = its true time + latency.

A run carries position, velocity, attitude and the groups that its settings switch on; the others keep their declared values.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
NAVIGATION = 9  # states before the parameters
GROUPS: dict[str, slice] = {
    "gyro_bias": slice(9, 12),
    "accel_bias": slice(12, 15),
    "gyro_scale_factor": slice(15, 18),
    "accel_scale_factor": slice(18, 21),
    "gyro_g_sensitivity": slice(21, 24),
    "antenna_lever_arm": slice(24, 27),
    "gnss_latency": slice(27, 28),
}
STATES = 28
PARAMETERS = STATES - NAVIGATION
UNITS = {
    "gyro_bias": "rad s-1",
    "accel_bias": "m s-2",
    "gyro_scale_factor": "1",
    "accel_scale_factor": "1",
    "gyro_g_sensitivity": "rad s-1 per m s-2",
    "antenna_lever_arm": "m",
    "gnss_latency": "s",
}
DEFAULT_GROUPS = ("gyro_bias", "accel_bias", "gyro_scale_factor", "accel_scale_factor")


def parameter(group: str) -> slice:
    """A group's place among the parameters θ."""
    return slice(GROUPS[group].start - NAVIGATION, GROUPS[group].stop - NAVIGATION)


def estimated(groups: Collection[str]) -> NDArray[np.int64]:
    """Indices of the states that a run with these groups carries, increasing."""
    chosen = [np.arange(NAVIGATION), *(np.arange(STATES)[where] for name, where in GROUPS.items() if name in groups)]
    return np.concatenate(chosen)
