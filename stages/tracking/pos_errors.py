"""What errors of the POS, bounded by its own sigmas, do to residuals, and residuals whitened for them.

    C = D·(1 + U·U')·D,      r → (1 + U·U')^(−1/2)·D⁻¹·r

D holds the noise of each residual, a column of D·U what one standard deviation of one error that many of them share makes of
them. The root is the symmetric one, so that a row stays what it was as nearly as can be: a boresight error loses its strength
in every row alike, not in all rows but the first, as it would with a triangular root.

Functions
---------
Offsets      errors of the POS that stay the same over a line: attitude, position, velocity
whitener     rows (n, k) → rows whitened for U
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Trajectory
from tsmftis.geodesy import radii_of_curvature

Array = NDArray[np.float64]

NEGLIGIBLE = 1e-6  # squared singular value of U below which it changes nothing


@dataclass(frozen=True)
class Offsets:
    """attitude (3,) [rad] of roll, pitch, yaw; position (3,) [m] and velocity (3,) [m/s] NED, about the middle of the line."""

    attitude: Array
    position: Array
    velocity: Array

    def applied(self, events: Trajectory) -> Trajectory:
        """The poses `events` with these errors."""
        away = events.time - 0.5 * (np.nanmin(events.time) + np.nanmax(events.time))
        move = self.position + away[:, None] * self.velocity
        north, east = radii_of_curvature(events.latitude)
        return replace(
            events,
            latitude=events.latitude + move[:, 0] / (north + events.height),
            longitude=events.longitude + move[:, 1] / ((east + events.height) * np.cos(events.latitude)),
            height=events.height - move[:, 2],
            rpy=events.rpy + self.attitude,
        )


def offsets(attitude: Array, position: Array, velocity: Array) -> list[Offsets]:
    """Nine errors, each one standard deviation of one component, from the sigmas (3,) of each."""
    sizes = np.concatenate([attitude, position, velocity])
    return [Offsets(*np.split(sizes * unit, 3)) for unit in np.eye(sizes.size)]


def whitener(u: Array) -> Callable[[Array], Array]:
    """(1 + U·U')^(−1/2) as a function of rows (n,) or (n, k), for U (n, m)."""
    if u.shape[1] == 0:
        return lambda rows: rows
    values, vectors = np.linalg.eigh(u.T @ u)
    used = values > NEGLIGIBLE
    v = u @ vectors[:, used] / np.sqrt(values[used])
    less = 1.0 - 1.0 / np.sqrt(1.0 + values[used])
    return lambda rows: np.asarray(rows - (v * less) @ (v.T @ rows))
