"""What a flight says of its antenna lever arm and GNSS latency, and whether it can tell them apart.

Functions
---------
calibrated      values, sigmas, correlations and one plain sentence
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Trajectory
from stages.navigation import states
from stages.navigation.settings import NavigationSettings

Array = NDArray[np.float64]

UNSEEN = 0.5  # a sigma above this part of the prior's: the flight says nothing of the parameter
CONFOUNDED = 3.0  # a sigma that would be smaller by this factor if the others were known: it is told by them alone
NAMES = ("lever arm x", "lever arm y", "lever arm z", "latency")


def calibrated(
    settings: NavigationSettings, declared: Array, theta: Array, covariance: Array, trajectory: Trajectory
) -> dict[str, Any] | None:
    """`declared`, `theta` (19,); covariance of the estimated parameters (p, p), in the order of the states. None if neither group
    is estimated."""
    groups = [name for name in ("antenna_lever_arm", "gnss_latency") if name in settings.estimate]
    if not groups:
        return None
    carried = states.estimated(settings.estimate)[states.NAVIGATION :]
    wanted = np.concatenate([np.arange(states.STATES)[states.GROUPS[name]] for name in groups])
    at = np.searchsorted(carried, wanted)
    part = covariance[np.ix_(at, at)]
    sigma = np.sqrt(np.diag(part))
    correlation = part / np.outer(sigma, sigma)
    prior = np.where(
        wanted < states.GROUPS["gnss_latency"].start, settings.lever_arm_sigma_m, settings.gnss_latency_sigma_s
    )
    alone = 1.0 / np.sqrt(np.diag(np.linalg.inv(part)))
    labels = [NAMES[i - states.GROUPS["antenna_lever_arm"].start] for i in wanted]
    out: dict[str, Any] = {
        "parameters": labels,
        "correlation": correlation.tolist(),
        "sentence": _sentence(labels, sigma, prior, alone, correlation, trajectory),
    }
    for name in groups:
        where = states.parameter(name)
        out[name] = {
            "value": theta[where].tolist(),
            "added_to_declared": (theta[where] - declared[where]).tolist(),
            "sigma": sigma[
                [i for i, w in enumerate(wanted) if w in range(*states.GROUPS[name].indices(states.STATES))]
            ].tolist(),
            "unit": states.UNITS[name],
        }
    return out


def _sentence(
    labels: list[str], sigma: Array, prior: Array, alone: Array, correlation: Array, trajectory: Trajectory
) -> str:
    """Which of the parameters this flight tells, and which it cannot, and what flight would."""
    speed = float(np.median(np.hypot(trajectory.velocity[:, 0], trajectory.velocity[:, 1])))
    unseen = sigma > UNSEEN * prior
    parts = []
    if not unseen.all():
        told = [
            f"{label} to {1e3 * s:.2g} {'mm' if label != 'latency' else 'ms'}"
            for label, s, no in zip(labels, sigma, unseen, strict=True)
            if not no
        ]
        parts.append(f"This flight tells {_listed(told)} (1 σ).")
    silent = []
    for i in range(len(labels)):
        others = np.abs(correlation[i]).copy()
        others[i] = 0.0
        rival = int(np.argmax(others))
        tied = sigma[i] > CONFOUNDED * alone[i] and others[rival] > 0.5
        pair = f"{labels[i]} from {labels[rival]} (correlation {correlation[i, rival]:+.3f})"
        if unseen[i] and tied:
            parts.append(
                f"It cannot separate {pair}: at a steady {speed:.0f} m/s only their sum along the course shows."
            )
        elif unseen[i]:
            silent.append(labels[i])
        elif tied and i < rival:
            parts.append(f"It barely separates {pair}.")
    if silent:
        parts.append(
            f"It says nothing of {_listed(silent)} beyond what was assumed: on a steady straight line they only shift the path."
        )
    if unseen.any() or len(parts) > 1:
        parts.append("Turns to both sides and changes of speed would tell.")
    return " ".join(parts)


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
