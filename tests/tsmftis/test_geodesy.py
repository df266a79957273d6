"""The ellipsoid against PROJ (through rasterio), published values of gravity, and differences of its own functions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.warp import transform as warp

from tsmftis import geodesy

latitude = st.floats(-np.pi / 2, np.pi / 2)
longitude = st.floats(-np.pi, np.pi)
height = st.floats(-1000.0, 20_000.0)


@given(latitude, longitude, height)
@settings(deadline=None)
def test_ecef_round_trip(lat: float, lon: float, h: float) -> None:
    """1e-8 m: a few times the rounding of 6.4e6 m (1e-9 m)."""
    point = geodesy.geodetic_to_ecef(lat, lon, h)
    again = geodesy.ecef_to_geodetic(point)
    np.testing.assert_allclose(geodesy.geodetic_to_ecef(*again), point, atol=1e-8)
    assert again[0] == pytest.approx(lat, abs=2e-15 + 1e-14)
    assert again[2] == pytest.approx(h, abs=1e-8)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (48.1, 11.5, 520.0), (-33.9, 151.2, -30.0), (89.9, -120.0, 9000.0)])
def test_ecef_is_projs(place: tuple[float, float, float]) -> None:
    """EPSG:4979 → EPSG:4978 by PROJ, the same ellipsoid: 1e-6 m."""
    lat, lon, h = place
    x, y, z = warp("EPSG:4979", "EPSG:4978", [lon], [lat], [h])
    mine = geodesy.geodetic_to_ecef(*np.deg2rad([lat, lon]), h)
    np.testing.assert_allclose(mine, [x[0], y[0], z[0]], atol=1e-6)


def test_gravity_as_published() -> None:
    """NIMA TR8350.2: 9.7803253359 (equator), 9.8321849378 (pole), mean 9.7976432222 to their digits;
    GRS80 (Moritz: 9.806199203 at 45°) lies 1.44e-6 higher."""
    assert geodesy.normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert geodesy.normal_gravity(np.pi / 2, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    assert geodesy.normal_gravity(np.deg2rad(45), 0.0) == pytest.approx(
        9.806199203 - 1.44e-6, abs=2e-8
    )  # GRS80, Moritz
    s = (np.arange(20000) + 0.5) / 10000 - 1.0
    area = (1 - geodesy.ECCENTRICITY_SQUARED * s**2) ** -2  # of the ellipsoid's zones, per dsin L
    mean = np.average(geodesy.normal_gravity(np.arcsin(s), 0.0), weights=area)
    assert mean == pytest.approx(9.7976432222, abs=1e-7)
    # Free-air gradient at 45°: 0.3086 mGal/m to the four digits that textbooks give.
    gradient = (geodesy.normal_gravity(np.pi / 4, 1.0) - geodesy.normal_gravity(np.pi / 4, 0.0)) * 1e5
    assert gradient == pytest.approx(-0.3086, abs=1e-4)


@given(st.floats(-1.5, 1.5), longitude, height)
@settings(deadline=None, max_examples=40)
def test_radii_and_ned_axes_are_derivatives_of_the_position(lat: float, lon: float, h: float) -> None:
    """Central differences over 1e-5 rad (64 m): truncation 1e-3 m, or 2e-5 of the vectors' length, at most."""
    north, east = geodesy.radii_of_curvature(lat)
    d = 1e-5
    along = [
        (geodesy.geodetic_to_ecef(lat + d, lon, h) - geodesy.geodetic_to_ecef(lat - d, lon, h)) / (2 * d * (north + h)),
        (geodesy.geodetic_to_ecef(lat, lon + d, h) - geodesy.geodetic_to_ecef(lat, lon - d, h))
        / (2 * d * (east + h) * np.cos(lat)),
        -(geodesy.geodetic_to_ecef(lat, lon, h + 1.0) - geodesy.geodetic_to_ecef(lat, lon, h)),
    ]
    frame = geodesy.ned_to_ecef_dcm(lat, lon)
    np.testing.assert_allclose(np.stack(along, -1), frame, atol=2e-8)
    np.testing.assert_allclose(frame @ geodesy.earth_rate_ned(lat), [0, 0, geodesy.EARTH_RATE], atol=1e-19)


def test_local_metres_are_metres() -> None:
    """Over 100 m against the true ECEF vector in the local frame: curvature leaves d²/2R = 1 mm."""
    lat, lon, h = 0.65, 2.13, 300.0
    point = np.array([lat + 1.2e-5, lon - 1.1e-5, h + 20.0])
    vector = geodesy.ned_to_ecef_dcm(lat, lon).T @ (
        geodesy.geodetic_to_ecef(*point) - geodesy.geodetic_to_ecef(lat, lon, h)
    )
    np.testing.assert_allclose(geodesy.local_metres(*point, lat, lon, h), vector, atol=2e-3)
