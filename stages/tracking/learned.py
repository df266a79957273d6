"""Displacements in the image that the closed loop has learnt without a name, as turns of the camera from frame to frame.

    a point that was predicted at the principal point is predicted d(x) away:    p' = R(d)·p,   C'_camera→ECEF = C·R(d)ᵀ

d = (row, column) [px] are curves of what the mount is under in a frame: x is the frame's time, temperature, attitude, …
Curves of the place in the image are no turns; no model applies them.

Functions
---------
applied    those learned terms of a model update that turn the camera
turned     poses with them
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import CameraPoses, Trajectory
from stages.tracking.curves import COVARIATES, Place
from tsmftis.camera import Camera
from tsmftis.rotation import exp_so3

Array = NDArray[np.float64]
Learned = Mapping[str, Any]

IN_THE_IMAGE = ("row", "column")  # covariates that are places
AXES = ("row_px", "column_px")


def applied(learned: Iterable[Learned]) -> tuple[Learned, ...]:
    """Those of the stage geometry that are curves of a frame's circumstances. InputError where a table lacks a curve."""
    out = []
    for one in learned:
        if one["stage"] != "geometry" or one["covariate"] not in COVARIATES or one["covariate"] in IN_THE_IMAGE:
            continue
        if lacking := [axis for axis in AXES if axis not in one["table"]]:
            raise InputError(
                "model update",
                f"learned term of {one['covariate']}",
                f"has no {lacking[0]}",
                f"give covariate, {' and '.join(AXES)}",
            )
        out.append(one)
    return tuple(out)


def displacement(learned: Sequence[Learned], place: Place) -> Array:
    """d (n, 2) [px] at places (n,); beyond the ends of a table as at its end."""
    out = np.zeros((place.time.size, 2))
    for one in learned:
        table, x = one["table"], COVARIATES[one["covariate"]](place)
        for axis, name in enumerate(AXES):
            out[:, axis] += np.interp(x[:, axis], table["covariate"], table[name])
    return out


def turned(
    poses: CameraPoses,
    events: Trajectory,
    temperature: Array | None,
    acceleration: Array | None,
    camera: Camera,
    learned: Sequence[Learned],
) -> CameraPoses:
    """The camera's poses (n,) where the unit is at `events` (n,); temperature (n,) [degC], acceleration (n, 3) [rad/s²], which a
    curve of them needs."""
    if not learned:
        return poses
    n = events.time.size
    row, col = np.full(n, camera.principal_row), np.full(n, camera.principal_col)
    place = Place(
        events.time,
        np.full(n, np.nan) if temperature is None else temperature,
        row,
        col,
        events.rpy,
        events.rate,
        np.full((n, 3), np.nan) if acceleration is None else acceleration,
        np.hypot(events.velocity[:, 0], events.velocity[:, 1]),
    )
    away = displacement(learned, place)
    known = np.isfinite(away).all(axis=1) & np.isfinite(poses.centre[:, 0])
    dcm = np.full_like(poses.dcm, np.nan)
    straight = camera.directions(row[known], col[known])
    moved = camera.directions(row[known] + away[known, 0], col[known] + away[known, 1])
    axis = np.cross(straight, moved)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    turn = exp_so3(axis * np.divide(np.arcsin(sine), sine, out=np.ones_like(sine), where=sine > 0.0))
    dcm[known] = poses.dcm[known] @ np.swapaxes(turn, -1, -2)
    return replace(poses, dcm=dcm, centre=np.where(known[:, None], poses.centre, np.nan))
