"""WGS-84: ellipsoid, normal gravity, Earth rotation, and conversions.

Functions
---------
radii_of_curvature      meridian and prime-vertical radii
normal_gravity          Somigliana gravity with its height term
earth_rate_ned          Earth rotation in NED
geodetic_to_ecef, ecef_to_geodetic, ned_to_ecef_dcm, local_metres

References
----------
.. [1] NIMA TR8350.2, Department of Defense World Geodetic System 1984, 3rd ed.
.. [2] H. Moritz, Geodetic Reference System 1980, J. Geodesy 74 (2000) 128.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEMI_MAJOR_AXIS = 6378137.0  # m
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
EARTH_RATE = 7.292115e-5  # rad/s
GM = 3.986004418e14  # m³/s²
GRAVITY_EQUATOR = 9.7803253359  # m/s²
SOMIGLIANA_K = 0.00193185265241
STANDARD_GRAVITY = 9.80665  # m/s², defines the µg


def radii_of_curvature(latitude: Any) -> tuple[Any, Any]:
    """Meridian R_N = a(1−e²)/(1−e²sin²L)^1.5 and prime-vertical R_E = a/√(1−e²sin²L) [m] at latitude L [rad]."""
    s = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    return (
        SEMI_MAJOR_AXIS * (1.0 - ECCENTRICITY_SQUARED) / s**1.5,
        SEMI_MAJOR_AXIS / np.sqrt(s),
    )


def normal_gravity(latitude: Any, height: Any) -> Any:
    """Normal gravity, positive down [m/s²], at latitude [rad] and ellipsoidal height [m].

    γ = γ₀(L)·(1 − 2(1 + f + m − 2f sin²L)·h/a + 3h²/a²), γ₀ by Somigliana [1]_.
    """
    s2 = np.sin(latitude) ** 2
    surface = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA_K * s2) / np.sqrt(1.0 - ECCENTRICITY_SQUARED * s2)
    m = EARTH_RATE**2 * SEMI_MAJOR_AXIS**3 * (1.0 - FLATTENING) / GM
    height_term = (
        1.0
        - 2.0 / SEMI_MAJOR_AXIS * (1.0 + FLATTENING + m - 2.0 * FLATTENING * s2) * height
        + 3.0 * (height / SEMI_MAJOR_AXIS) ** 2
    )
    return surface * height_term


def earth_rate_ned(latitude: Array | float) -> Array:
    """Earth rotation Ω(cos L, 0, −sin L) [rad/s] in NED; latitude (...) → (..., 3)."""
    latitude = np.asarray(latitude, float)
    return EARTH_RATE * np.stack([np.cos(latitude), np.zeros_like(latitude), -np.sin(latitude)], -1)


def geodetic_to_ecef(latitude: Array | float, longitude: Array | float, height: Array | float) -> Array:
    """Latitude, longitude [rad] and height [m] (...) → ECEF (..., 3) [m]."""
    latitude, longitude = np.asarray(latitude, float), np.asarray(longitude, float)
    _, east = radii_of_curvature(latitude)
    horizontal = (east + height) * np.cos(latitude)
    return np.stack(
        [
            horizontal * np.cos(longitude),
            horizontal * np.sin(longitude),
            (east * (1.0 - ECCENTRICITY_SQUARED) + height) * np.sin(latitude),
        ],
        -1,
    )


def ecef_to_geodetic(position: Array) -> tuple[Array, Array, Array]:
    """ECEF (..., 3) [m] → latitude, longitude [rad], height [m]; fixed-point, exact to 1e-9 m below 100 km."""
    x, y, z = np.moveaxis(np.asarray(position, float), -1, 0)
    horizontal = np.hypot(x, y)
    latitude = np.arctan2(z, horizontal * (1.0 - ECCENTRICITY_SQUARED))
    for _ in range(6):
        _, east = radii_of_curvature(latitude)
        latitude = np.arctan2(z + ECCENTRICITY_SQUARED * east * np.sin(latitude), horizontal)
    _, east = radii_of_curvature(latitude)
    # Projected on the local normal: well conditioned at every latitude.
    height = horizontal * np.cos(latitude) + z * np.sin(latitude) - SEMI_MAJOR_AXIS**2 / east
    return latitude, np.arctan2(y, x), height


def ned_to_ecef_dcm(latitude: Array | float, longitude: Array | float) -> Array:
    """C_NED→ECEF (..., 3, 3); its columns are north, east and down."""
    latitude, longitude = np.broadcast_arrays(np.asarray(latitude, float), np.asarray(longitude, float))
    sl, cl, so, co = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(sl)
    return np.stack(
        [
            np.stack([-sl * co, -so, -cl * co], -1),
            np.stack([-sl * so, co, -cl * so], -1),
            np.stack([cl, zero, -sl], -1),
        ],
        -2,
    )


def local_metres(
    latitude: Array, longitude: Array, height: Array, latitude0: float, longitude0: float, height0: float
) -> Array:
    """Curvilinear north, east, down [m] from a near-by origin: (R_N+h)ΔL, (R_E+h)cos L·Δλ, −Δh; (...) → (..., 3)."""
    north, east = radii_of_curvature(latitude0)
    return np.stack(
        [
            (latitude - latitude0) * (north + height0),
            ((longitude - longitude0 + np.pi) % (2.0 * np.pi) - np.pi) * (east + height0) * np.cos(latitude0),
            -(height - height0),
        ],
        -1,
    )
