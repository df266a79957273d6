"""What a GNSS receiver reports: position and velocity of its antenna, with error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsmftis import geodesy
from tsmftis.simulator.flight import Flight

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fixes:
    """time (n,) [s]; geodetic (n, 3): latitude, longitude [rad], height [m]; velocity (n, 3) NED [m/s]."""

    time: Array
    geodetic: Array
    velocity: Array


def antenna(flight: Flight, time: Array, lever_arm: Array) -> tuple[Array, Array]:
    """ECEF position r + C·l [m], velocity v + C·(ω×l) [m/s] (n, 3) of the antenna at l (3,) [m, body], times (n,)."""
    attitude = flight.attitude(time)
    swing = np.cross(flight.angular_rate(time), lever_arm)
    return (
        flight.position(time) + attitude @ lever_arm,
        flight.velocity(time) + np.einsum("nij,nj->ni", attitude, swing),
    )


def observe(
    flight: Flight,
    time: Array,
    lever_arm: Array,
    latency: float,
    position_error: Array,
    velocity_error: Array,
) -> Fixes:
    """Fixes at true times (n,), stamped true time + latency; errors (n, 3) along NED [m], [m/s] are added."""
    position, velocity = antenna(flight, time, lever_arm)
    lat, lon, _ = geodesy.ecef_to_geodetic(position)
    to_ecef = geodesy.ned_to_ecef_dcm(lat, lon)
    wrong = position + np.einsum("nij,nj->ni", to_ecef, position_error)
    return Fixes(
        time + latency,
        np.stack(geodesy.ecef_to_geodetic(wrong), -1),
        np.einsum("nji,nj->ni", to_ecef, velocity) + velocity_error,
    )
