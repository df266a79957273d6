"""The receiver's velocity, or what its positions say of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gnss
from tsmftis.geodesy import radii_of_curvature

Array = NDArray[np.float64]


SURE = 0.3  # m/s: differences of positions are taken over as long as it takes to know the speed so well …
LONGEST = 4.0  # … but over no more than so many seconds, in which a vehicle turns


def gnss_velocity(gnss: Gnss) -> tuple[Array, Array]:
    """The receiver's velocity NED and its sigmas (n, 3) [m/s]; differences of positions where it gives none.

    v_i = (r_j − r_k)/(t_j − t_k) with j, k as many fixes after and before i as make σ = √(σ_j² + σ_k²)/(t_j − t_k) small.
    """
    if gnss.velocity is not None and gnss.sigma_velocity is not None:
        return gnss.velocity, gnss.sigma_velocity
    n = gnss.time.size
    north, east = radii_of_curvature(gnss.latitude)
    scale = np.stack([north + gnss.height, (east + gnss.height) * np.cos(gnss.latitude), -np.ones(n)], 1)
    place = np.stack([gnss.latitude, gnss.longitude, gnss.height], 1)
    step = float(np.median(np.diff(gnss.time))) if n > 1 else 1.0
    needed = min(np.sqrt(2.0) * float(np.median(gnss.sigma_position[:, :2])) / SURE, LONGEST)
    reach = max(1, int(np.ceil(needed / (2.0 * step) - 1e-9)))
    k, j = np.maximum(np.arange(n) - reach, 0), np.minimum(np.arange(n) + reach, n - 1)
    span = np.maximum(gnss.time[j] - gnss.time[k], 1e-9)[:, None]
    sigma = np.sqrt(gnss.sigma_position[j] ** 2 + gnss.sigma_position[k] ** 2) / span
    return (place[j] - place[k]) / span * scale, sigma


def moves(gnss: Gnss, course_speed: float) -> NDArray[np.bool_]:
    """Fixes whose horizontal speed exceeds `course_speed` [m/s] and five of its sigmas, or a parked receiver had a course."""
    velocity, sigma = gnss_velocity(gnss)
    speed, doubt = np.hypot(velocity[:, 0], velocity[:, 1]), 5.0 * np.hypot(sigma[:, 0], sigma[:, 1])
    return np.asarray(speed > np.maximum(course_speed, doubt))
