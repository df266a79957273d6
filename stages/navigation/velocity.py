"""The receiver's velocity, or what its positions say of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Gnss
from tsmftis.geodesy import radii_of_curvature

Array = NDArray[np.float64]


def gnss_velocity(gnss: Gnss) -> tuple[Array, Array]:
    """The receiver's velocity NED and its sigmas (n, 3) [m/s]; differences of positions where it gives none.

    A central difference over 2Δt of fixes with sigma σ has sigma σ·√2/(2Δt).
    """
    if gnss.velocity is not None and gnss.sigma_velocity is not None:
        return gnss.velocity, gnss.sigma_velocity
    north, east = radii_of_curvature(gnss.latitude)
    rate = np.stack([np.gradient(v, gnss.time) for v in (gnss.latitude, gnss.longitude, gnss.height)], 1)
    scale = np.stack([north + gnss.height, (east + gnss.height) * np.cos(gnss.latitude), -np.ones(gnss.time.size)], 1)
    return rate * scale, gnss.sigma_position / np.sqrt(2.0) / np.gradient(gnss.time)[:, None]
