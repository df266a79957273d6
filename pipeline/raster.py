"""Rasters by rasterio: the terrain's heights in, georeferenced cubes out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.warp import transform as warp
from scipy.ndimage import map_coordinates

from pipeline.errors import InputError

Array = NDArray[np.float64]
WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class Dem:
    """Ellipsoidal heights (row, col) [m] on a raster of any CRS."""

    heights: Array
    inverse: Affine
    crs: str

    @classmethod
    def from_file(cls, path: Path) -> Dem:
        """Raises InputError for an unreadable raster, one without CRS, or one with holes."""
        try:
            with rasterio.open(path) as source:
                if source.crs is None:
                    raise InputError(path, "CRS", "is missing", "write the DEM with its coordinate reference system")
                heights = source.read(1, masked=True)
                inverse, crs = ~source.transform, source.crs.to_wkt()
        except RasterioError as error:
            raise InputError(
                path,
                "file",
                f"is no readable raster ({type(error).__name__})",
                "write it as GeoTIFF; it may be truncated",
            ) from error
        values = np.asarray(heights.filled(np.nan), float)
        if not np.isfinite(values).all():
            raise InputError(
                path,
                "band 1",
                f"has {int((~np.isfinite(values)).sum())} cells without height",
                "fill the holes of the DEM",
            )
        return cls(values, inverse, crs)

    def height(self, latitude: Array, longitude: Array) -> Array:
        """Bilinear height [m] at geodetic positions [rad]; beyond the edge the edge's height holds on."""
        lon, lat = np.rad2deg(longitude).ravel(), np.rad2deg(latitude).ravel()
        x, y = (
            (lon, lat)
            if rasterio.crs.CRS.from_user_input(self.crs) == rasterio.crs.CRS.from_epsg(4326)
            else map(np.array, warp(WGS84, self.crs, lon, lat))
        )
        col, row = self._cell(x, y)
        # Pixel centres lie half a pixel inside the corner that the transform refers to.
        at = map_coordinates(self.heights, [np.asarray(row) - 0.5, np.asarray(col) - 0.5], order=1, mode="nearest")
        return at.reshape(np.shape(latitude))

    def covers(self, latitude: Array, longitude: Array) -> NDArray[np.bool_]:
        """Whether geodetic positions (n,) [rad] lie on the raster."""
        x, y = warp(WGS84, self.crs, np.rad2deg(longitude), np.rad2deg(latitude))
        col, row = self._cell(np.array(x), np.array(y))
        return (col >= 0) & (col <= self.heights.shape[1]) & (row >= 0) & (row <= self.heights.shape[0])

    def _cell(self, x: Array, y: Array) -> tuple[Array, Array]:
        t = self.inverse
        return t.a * x + t.b * y + t.c, t.d * x + t.e * y + t.f


def utm_crs(latitude: float, longitude: float) -> str:
    """EPSG code of the WGS-84 UTM zone of a position [rad]."""
    zone = int((np.rad2deg(longitude) + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def is_metric(crs: str) -> bool:
    """Whether a CRS is known, projected, and in metres."""
    try:
        known = rasterio.crs.CRS.from_user_input(crs)
    except rasterio.errors.CRSError:
        return False
    return bool(known.is_projected and known.linear_units in ("metre", "meter"))


def to_crs(crs: str, latitude: Array, longitude: Array) -> tuple[Array, Array]:
    """Geodetic [rad] → easting, northing [m]."""
    x, y = warp(WGS84, crs, np.rad2deg(longitude).ravel(), np.rad2deg(latitude).ravel())
    return np.reshape(x, np.shape(latitude)), np.reshape(y, np.shape(latitude))


def from_crs(crs: str, x: Array, y: Array) -> tuple[Array, Array]:
    """Easting, northing [m] → geodetic latitude, longitude [rad]."""
    lon, lat = warp(crs, WGS84, x.ravel(), y.ravel())
    return np.deg2rad(np.reshape(lat, x.shape)), np.deg2rad(np.reshape(lon, x.shape))


def open_cube(
    path: Path, crs: str, transform: Affine, shape: tuple[int, int], wavelengths_nm: Array
) -> rasterio.io.DatasetWriter:
    """A GeoTIFF opened for writing: float32, tiled, one band a wavenumber, NaN where unseen, wavelengths as descriptions."""
    target = rasterio.open(
        path,
        "w",
        driver="GTiff",
        crs=crs,
        transform=transform,
        height=shape[0],
        width=shape[1],
        count=len(wavelengths_nm),
        dtype="float32",
        nodata=np.nan,
        tiled=True,
        blockxsize=128,
        blockysize=128,
        interleave="band",
        BIGTIFF="IF_SAFER",
    )
    for band, wavelength in enumerate(wavelengths_nm, start=1):
        target.set_band_description(band, f"{wavelength:.3f} nm")
        target.update_tags(band, wavelength=f"{wavelength:.6f}", wavelength_units="nm")
    target.update_tags(wavelength_units="nm", quantity="spectral radiance, reference radiance unit")
    return target


class Quicklook:
    """An RGB picture of the cube, gathered strip by strip: 640, 550, 460 nm or what the range has nearest to them."""

    def __init__(self, shape: tuple[int, int], wavenumber: Array) -> None:
        wavelength = 1e9 / wavenumber
        spread = np.clip([460.0, 550.0, 640.0], wavelength.min(), wavelength.max())
        self.bands = [int(np.argmin(np.abs(wavelength - w))) for w in spread]
        self.image = np.full((*shape, 3), np.nan, np.float32)

    def add(self, start: int, strip: NDArray[np.float32]) -> None:
        self.image[start : start + strip.shape[0]] = strip[:, :, self.bands]

    @property
    def seen_fraction(self) -> float:
        return float(np.isfinite(self.image[..., 0]).mean())

    def write(self, path: Path) -> None:
        """8 bit, each colour stretched to its 1st to 99th percentile; unseen cells are transparent. Flown upwards."""
        seen = np.isfinite(self.image).all(axis=2)
        scaled = np.zeros_like(self.image)
        if seen.any():
            low, high = np.percentile(self.image[seen], [1, 99], axis=0)
            scaled[seen] = np.clip((self.image[seen] - low) / np.maximum(high - low, 1e-12), 0.0, 1.0)
        picture = np.dstack([(255 * np.sqrt(scaled)).astype(np.uint8), (255 * seen).astype(np.uint8)])
        cv2.imwrite(str(path), picture[::-1])
