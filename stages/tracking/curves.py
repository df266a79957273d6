"""What displacements in the image may be curves of, where no declared effect accounts for them.

COVARIATES: name → values (n, 2) for displacements in row and in column; UNITS of the values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Place:
    """What a displacement may depend on, at points (n,) of images: time [s], temperature [degC] (NaN if not known), pixel [px],
    rpy [rad], rate [rad/s] and acceleration [rad/s²] (n, 3) of the body, ground speed [m/s]."""

    time: Array
    temperature: Array
    row: Array
    col: Array
    rpy: Array
    rate: Array
    acceleration: Array
    speed: Array


def _both(value: Array) -> Array:
    return np.stack([value, value], -1)


UNITS = {
    "time": "s",
    "temperature": "degC",
    "row": "px",
    "column": "px",
    "attitude": "rad",
    "angular rate": "rad s-1",
    "angular acceleration": "rad s-2",
    "ground speed": "m s-1",
    "image radius": "px",
}
# Of displacements in row and in column, each: roll moves rows, pitch columns.
COVARIATES: Mapping[str, Callable[[Place], Array]] = {
    "time": lambda p: _both(p.time),
    "temperature": lambda p: _both(p.temperature),
    "row": lambda p: _both(p.row),
    "column": lambda p: _both(p.col),
    "attitude": lambda p: p.rpy[:, :2],
    "angular rate": lambda p: p.rate[:, :2],
    "angular acceleration": lambda p: p.acceleration[:, :2],
    "ground speed": lambda p: _both(p.speed),
}
