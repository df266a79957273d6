"""True poses beside a campaign: where a simulated flight really was, so that every method can be held against it.

A truth folder holds `<line>.npz` for lines, with `t` (n,) [s], true mid-exposure times; `pos` (n, 3) [m], the inertial unit in
ECEF; `quat` (n, 4), body → ECEF, scalar last. `tsmftis simulate` writes one.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TruePoses:
    """The inertial unit at each frame of a line: position (frame, 3) [m, ECEF], C_body→ECEF (frame, 3, 3)."""

    position: Array
    dcm: Array


def true_poses_file(folder: Path, line: str) -> Path | None:
    """The file of a line in a truth folder; None where it has none."""
    path = folder / f"{line}.npz"
    return path if path.is_file() else None


def read_true_poses(path: Path, frames: int) -> TruePoses:
    """Read the true poses of a line of so many frames; InputError where they do not fit."""
    shapes = {"pos": (frames, 3), "quat": (frames, 4)}
    try:
        with np.load(path) as content:
            found = {name: np.asarray(content[name], np.float64) for name in shapes}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(path, "file", "is no NumPy archive", "give the truth folder of the campaign") from error
    except KeyError as error:
        raise InputError(
            path, f"array {error.args[0]}", "is missing", "give the truth folder of the campaign"
        ) from error
    for name, shape in shapes.items():
        if found[name].shape != shape or not np.isfinite(found[name]).all():
            raise InputError(
                path,
                f"array '{name}'",
                f"is of shape {found[name].shape} or not finite, where the line's frames ask for {shape}",
                "give the truth folder of this campaign",
            )
    return TruePoses(found["pos"], Rotation.from_quat(found["quat"]).as_matrix())
