"""What errors of the POS, bounded by its own sigmas, do to residuals, and residuals whitened for them.

    C = D·(1 + U·U')·D,      r → (1 + U·U')^(−1/2)·D⁻¹·r

D holds the noise of each residual, a column of D·U what one standard deviation of one error that many of them share makes of
them. The root is the symmetric one, so that a row stays what it was as nearly as can be: a boresight error loses its strength
in every row alike, not in all rows but the first, as it would with a triangular root.

Functions
---------
constant     errors that stay the same over a line: attitude, position, velocity
wander       what the gyros' noise adds to the attitude from one moment on
stretch      what the gyros' scale factors make of the changes of attitude
whitener     rows (n, k) → rows whitened for U
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Trajectory
from tsmftis.geodesy import radii_of_curvature

Array = NDArray[np.float64]

NEGLIGIBLE = 1e-6  # squared singular value of U below which it changes nothing
STEPS = 100  # at most, of a wandering attitude over a line ...
LEAST_STEP_S = 0.1  # ... and no shorter


@dataclass(frozen=True)
class Offset:
    """One error: attitude (3,) [rad] of roll, pitch, yaw from the time `since` [s] on; position (3,) [m] and velocity (3,) [m/s]
    NED, the latter about the middle of the poses; stretch (3,): share of its changes that attitude gains."""

    attitude: Array = field(default_factory=lambda: np.zeros(3))
    position: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    stretch: Array = field(default_factory=lambda: np.zeros(3))
    since: float = -np.inf

    def applied(self, events: Trajectory) -> Trajectory:
        """The poses `events` with this error."""
        away = events.time - 0.5 * (events.time.min() + events.time.max())
        move = self.position + away[:, None] * self.velocity
        turn = self.attitude * (events.time >= self.since)[:, None]
        turn = turn + self.stretch * (events.rpy - np.nanmean(events.rpy, axis=0))
        north, east = radii_of_curvature(events.latitude)
        return replace(
            events,
            latitude=events.latitude + move[:, 0] / (north + events.height),
            longitude=events.longitude + move[:, 1] / ((east + events.height) * np.cos(events.latitude)),
            height=events.height - move[:, 2],
            rpy=events.rpy + turn,
        )


def constant(attitude: Array, position: Array, velocity: Array) -> list[Offset]:
    """Nine errors, each one standard deviation of one component, from the sigmas (3,) of each."""
    axes = np.eye(3)
    turned = [Offset(attitude=a * attitude) for a in axes]
    return [*turned, *(Offset(position=a * position) for a in axes), *(Offset(velocity=a * velocity) for a in axes)]


def wander(start: float, stop: float, white_noise: float) -> list[Offset]:
    """Of each axis, from moments evenly spread between two times: what noise [rad/s/√Hz] gathers from one to the next."""
    count = int(np.clip((stop - start) / LEAST_STEP_S, 1, STEPS))
    step = (stop - start) / count
    moments = start + step * np.arange(1, count)
    return [Offset(attitude=a * white_noise * np.sqrt(step), since=m) for m in moments for a in np.eye(3)]


def stretch(scale_factor: float) -> list[Offset]:
    """Of each axis: attitude changed by the share `scale_factor` more than it did."""
    return [Offset(stretch=a * scale_factor) for a in np.eye(3)]


def whitener(u: Array) -> Callable[[Array], Array]:
    """(1 + U·U')^(−1/2) as a function of rows (n,) or (n, k), for U (n, m)."""
    if u.shape[1] == 0:
        return lambda rows: rows
    values, vectors = np.linalg.eigh(u.T @ u)
    used = values > NEGLIGIBLE
    v = u @ vectors[:, used] / np.sqrt(values[used])
    less = 1.0 - 1.0 / np.sqrt(1.0 + values[used])
    return lambda rows: np.asarray(rows - (v * less) @ (v.T @ rows))
