"""Where the loop stands.

Classes and functions
---------------------
State    what was added, refused, told so far
left     what the model's columns leave
rms      its size
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stages.closed_loop.estimation import Estimate
from stages.closed_loop.noise import Layout, Noise
from stages.closed_loop.result import Step
from stages.closed_loop.signatures import Values

Array = NDArray[np.float64]

CERTAIN = 1e-3  # family-wise p of structure that is there, though nothing accounts for it
UNNEEDED = 0.05  # p of an effect beside others, or of sensors that differ in what they were taken to share


@dataclass
class State:
    """Where the loop stands: nuisance with learned columns (n, p); effects' values, r (n,) and S (n, q) there; the steps."""

    nuisance: Array
    residual: Array
    estimate: Estimate | None = None
    steps: list[Step] = field(default_factory=list)
    blocked: set[tuple[str, tuple[str, ...]]] = field(default_factory=set)
    dropped: set[str] = field(default_factory=set)
    narrowed: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    certain: list[str] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    enough: bool = False
    noise: Noise | None = None

    @property
    def values(self) -> Values:
        return {} if self.estimate is None else self.estimate.values

    @property
    def columns(self) -> Array:
        """Nuisance and the signatures of what was added."""
        return self.nuisance if self.estimate is None else np.column_stack([self.nuisance, self.estimate.signatures])


def left(layout: Layout, state: State) -> Array:
    """What the model's columns leave (rows,), by least squares."""
    columns, data = state.columns[layout.rows], state.residual[layout.rows]
    if columns.shape[1]:
        data = data - columns @ np.linalg.lstsq(columns, data, rcond=None)[0]
    return np.asarray(data)


def rms(layout: Layout, state: State) -> float:
    return float(np.sqrt(np.mean(left(layout, state) ** 2)))
