"""SMRMSG: the error estimates that go with an SBET, 10 little-endian float64 a record, no header.

Fields: time [s], RMS of position north, east, down [m], of velocity north, east, down [m/s], and of roll, pitch, heading
[arc minutes].

Functions
---------
read_smrmsg, write_smrmsg       bit for bit
from_trajectory                 a trajectory's sigmas as records
with_sigmas                     a trajectory with the sigmas of records

References
----------
.. [1] Applanix, POSPac MMS: SMRMSG format.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.formats.binary import read_records, write_records
from pipeline.records import Trajectory

FIELDS = (
    "time",
    *(f"{quantity}_{axis}" for quantity in ("position", "velocity") for axis in ("north", "east", "down")),
    "roll", "pitch", "heading",
)  # fmt: skip
DTYPE = np.dtype([(name, "<f8") for name in FIELDS])
ARC_MINUTES = 60.0 * 180.0 / np.pi  # of one radian


def read_smrmsg(path: Path) -> NDArray[Any]:
    """Records (n,) of an SMRMSG file; raises InputError where it cannot be one."""
    records = read_records(path, DTYPE, "SMRMSG")
    for name in FIELDS:
        bad = ~np.isfinite(records[name]) | ((records[name] < 0) if name != "time" else False)
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(
                path, f"record {i}, {name}", f"is {records[name][i]:g}", "the file is no SMRMSG, or damaged there"
            )
    return records


def write_smrmsg(records: NDArray[Any], path: Path) -> None:
    """Write records of `DTYPE`; what `read_smrmsg` gave comes out bit for bit."""
    write_records(records, DTYPE, path, "SMRMSG")


def from_trajectory(trajectory: Trajectory) -> NDArray[Any]:
    """A trajectory's sigmas (n samples) as records (n,)."""
    t = trajectory
    records = np.empty(t.time.size, DTYPE)
    columns = (t.time, *t.sigma_position.T, *t.sigma_velocity.T, *(t.sigma_attitude.T * ARC_MINUTES))
    for name, column in zip(FIELDS, columns, strict=True):
        records[name] = column
    return records


def with_sigmas(trajectory: Trajectory, records: NDArray[Any], path: Path) -> Trajectory:
    """The trajectory with sigmas from records (n,), which usually come once a second, linearly between them.

    Raises InputError where the records do not span the trajectory (but for a second at its ends).
    """
    time = records["time"]
    if (np.diff(time) <= 0).any():
        i = int(np.argmax(np.diff(time) <= 0)) + 1
        raise InputError(path, f"record {i}, time", "is not after the one before it", "sort the records")
    if time[0] > trajectory.time[0] + 1.0 or time[-1] < trajectory.time[-1] - 1.0:
        raise InputError(
            path,
            "time",
            f"spans {time[0]:.1f} to {time[-1]:.1f} s but the SBET {trajectory.time[0]:.1f} to {trajectory.time[-1]:.1f} s",
            "give the SMRMSG of the same flight",
        )

    def at(*names: str) -> NDArray[np.float64]:
        return np.stack([np.interp(trajectory.time, time, records[name]) for name in names], -1)

    axes = ("north", "east", "down")
    return replace(
        trajectory,
        sigma_position=at(*(f"position_{a}" for a in axes)),
        sigma_velocity=at(*(f"velocity_{a}" for a in axes)),
        sigma_attitude=at("roll", "pitch", "heading") / ARC_MINUTES,
    )
