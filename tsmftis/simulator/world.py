"""Terrain and scene: heights, a patchwork of natural materials, and panels laid on it.

Functions
---------
draw_terrain        smooth random heights on a geodetic grid
draw_texture        random mixture of materials on a plane
Terrain, Plane, Panels, Texture
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from tsmftis import geodesy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Terrain:
    """Ellipsoidal heights (row, col) [m] at cell centres, rows from north to south.

    north, west [rad] are the outer edges of the first cell; d_latitude, d_longitude [rad] its size, both positive.
    Between centres the surface is bilinear.
    """

    height: NDArray[np.float32]
    north: float
    west: float
    d_latitude: float
    d_longitude: float

    def at(self, latitude: Array, longitude: Array) -> Array:
        """Height [m] at points (...) [rad]; raises ValueError outside the cell centres."""
        rows, cols = self.height.shape
        lookup = RegularGridInterpolator((np.arange(rows), np.arange(cols)), self.height.astype(float))
        row = (self.north - latitude) / self.d_latitude - 0.5
        col = (longitude - self.west) / self.d_longitude - 0.5
        return np.asarray(lookup(np.stack(np.broadcast_arrays(row, col), -1)))

    def raised(self, height: float) -> Terrain:
        """The same terrain, `height` [m] higher."""
        return Terrain(
            (self.height + np.float32(height)).astype(np.float32),
            self.north,
            self.west,
            self.d_latitude,
            self.d_longitude,
        )


def draw_terrain(
    bounds: tuple[float, float, float, float],
    cell: float,
    height: float,
    relief: float,
    wavelength: tuple[float, float],
    waves: int,
    rng: np.random.Generator,
) -> Terrain:
    """Random heights over bounds (south, west, north, east) [rad], cells of `cell` [m].

    h = height + Σ a·cos(k·x + φ): wavelengths [m] spread evenly over the logarithm, amplitudes ∝ wavelength, standard
    deviation `relief` [m]; directions and phases random.
    """
    south, west, north, east = bounds
    meridian, vertical = geodesy.radii_of_curvature(0.5 * (south + north))
    d_lat = cell / float(meridian)
    d_lon = cell / float(vertical * np.cos(0.5 * (south + north)))
    rows, cols = int(np.ceil((north - south) / d_lat)), int(np.ceil((east - west) / d_lon))
    x = cell * (np.arange(cols) + 0.5)
    y = -cell * (np.arange(rows) + 0.5)
    lengths = np.exp(rng.uniform(np.log(wavelength[0]), np.log(wavelength[1]), waves))
    amplitude = lengths * (relief / np.sqrt(0.5 * np.sum(lengths**2)))
    direction, phase = rng.uniform(0.0, 2.0 * np.pi, (2, waves))
    surface = np.full((rows, cols), height)
    for a, k, d, p in zip(amplitude, 2.0 * np.pi / lengths, direction, phase, strict=True):
        # cos(u + v) of separable arguments: two outer products instead of a cosine a cell
        u, v = k * np.sin(d) * y + p, k * np.cos(d) * x
        surface += a * (np.outer(np.cos(u), np.cos(v)) - np.outer(np.sin(u), np.sin(v)))
    return Terrain(surface.astype(np.float32), north, west, d_lat, d_lon)


@dataclass(frozen=True)
class Plane:
    """Tangent plane of a line: an ECEF origin [m] and unit vectors along and across (to the right of) its course."""

    origin: Array
    along: Array
    across: Array

    @classmethod
    def at(cls, latitude: float, longitude: float, height: float, course: float) -> Plane:
        """Tangent at a point, turned to a course [rad]."""
        north, east, _ = geodesy.ned_to_ecef_dcm(latitude, longitude).T
        return cls(
            geodesy.geodetic_to_ecef(latitude, longitude, height),
            np.cos(course) * north + np.sin(course) * east,
            -np.sin(course) * north + np.cos(course) * east,
        )

    def coordinates(self, point: Array) -> Array:
        """Along and across [m] of ECEF points (..., 3) → (..., 2)."""
        return (point - self.origin) @ np.stack([self.along, self.across], -1)


def on_terrain(plane: Plane, terrain: Terrain, coordinates: Array) -> Array:
    """Latitude, longitude [rad], height [m] of the surface at plane coordinates (n, 2) [m] → (n, 3)."""
    normal = np.cross(plane.across, plane.along)
    point = plane.origin + coordinates @ np.stack([plane.along, plane.across])
    for _ in range(20):
        lat, lon, height = geodesy.ecef_to_geodetic(point)
        # Up along the plane's normal: along and across stay as they are.
        point = point + (terrain.at(lat, lon) - height)[:, None] * normal
    return np.stack(geodesy.ecef_to_geodetic(point), -1)


@dataclass(frozen=True)
class Panels:
    """Squares painted on the ground, sides along the plane's axes.

    centre (n, 2) [m] on the plane, geodetic (n, 3) [rad, rad, m], side (n,) [m], material (n,) index.
    """

    centre: Array
    geodetic: Array
    side: Array
    material: NDArray[np.int64]


@dataclass(frozen=True)
class Texture:
    """Abundances (along, across, material) [1], adding to one in each cell of `cell` [m]; repeats beyond its edges.

    corner (2,) [m] is the plane coordinate of the first cell's outer corner.
    """

    abundance: NDArray[np.float32]
    corner: Array
    cell: float


def draw_texture(
    corner: Array,
    extent: Array,
    cell: float,
    share: Array,
    contrast: float,
    patch: tuple[float, float],
    rng: np.random.Generator,
) -> Texture:
    """A random mixture over extent (2,) [m]: a_m = softmax(log share_m + contrast·g_m).

    g are independent unit Gaussian fields whose spectrum falls as the fourth power of frequency between the patch
    sizes [m] (large patches, sharper grain inside them).
    """
    shape = np.maximum(np.ceil(extent / cell).astype(int), 8)
    frequency = np.hypot(np.fft.fftfreq(shape[0], cell)[:, None], np.fft.rfftfreq(shape[1], cell))
    small, large = patch
    gain = 1.0 / (1.0 + (frequency * large) ** 2) ** 0.75 / (1.0 + (frequency * small) ** 4)
    gain[0, 0] = 0.0
    logits = np.empty((*shape, len(share)))
    for m, part in enumerate(share):
        field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * gain, s=shape)
        logits[..., m] = np.log(part) + contrast * field / field.std()
    weight = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return Texture((weight / weight.sum(axis=-1, keepdims=True)).astype(np.float32), np.asarray(corner, float), cell)
