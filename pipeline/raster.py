"""Rasters by rasterio: the terrain's heights in, georeferenced cubes out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.warp import transform as warp
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from pipeline.errors import InputError

Array = NDArray[np.float64]
WGS84 = "EPSG:4326"
TILE = 128  # side of a GeoTIFF's tiles
OVERVIEWS = (2, 4, 8, 16)
GDAL_CACHE_MB = 128
LATTICE_STEP = 32  # cells between points that are transformed exactly
LATTICE_CELLS = 4096  # a grid as large as this is not transformed point by point


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
        x, y = _warped(WGS84, self.crs, np.rad2deg(longitude), np.rad2deg(latitude))
        col, row = self._cell(x, y)
        # Pixel centres lie half a pixel inside the corner that the transform refers to.
        return map_coordinates(self.heights, [row - 0.5, col - 0.5], order=1, mode="nearest")

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
    return _warped(WGS84, crs, np.rad2deg(longitude), np.rad2deg(latitude))


def from_crs(crs: str, x: Array, y: Array) -> tuple[Array, Array]:
    """Easting, northing [m] → geodetic latitude, longitude [rad]."""
    lon, lat = _warped(crs, WGS84, x, y)
    return np.deg2rad(lat), np.deg2rad(lon)


def _warped(source: str, target: str, x: Array, y: Array) -> tuple[Array, Array]:
    """Coordinates in another CRS. Of a large grid every 32nd point in each direction is transformed, and bilinear between:
    over 32 cells of a metre the Earth bends by 0.02 mm, and point by point would take as long as all spectra together."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if CRS.from_user_input(source) == CRS.from_user_input(target):
        return x, y
    if x.ndim == 2 and min(x.shape) > 1 and x.size > LATTICE_CELLS:
        rows, cols = (np.unique(np.append(np.arange(0, n, LATTICE_STEP), n - 1)) for n in x.shape)
        some = warp(source, target, x[np.ix_(rows, cols)].ravel(), y[np.ix_(rows, cols)].ravel())
        at = (
            np.interp(np.arange(x.shape[0]), rows, np.arange(rows.size)),
            np.interp(np.arange(x.shape[1]), cols, np.arange(cols.size)),
        )
        both = [np.reshape(s, (rows.size, cols.size)) for s in some]
        return _bilinear(both[0], *at), _bilinear(both[1], *at)
    out = warp(source, target, x.ravel(), y.ravel())
    return np.reshape(out[0], x.shape), np.reshape(out[1], x.shape)


def _bilinear(values: Array, row: Array, col: Array) -> Array:
    """values (r, c) at the fractional rows (m,) and columns (n,) → (m, n)."""
    i, j = np.minimum(row.astype(int), len(values) - 2), np.minimum(col.astype(int), values.shape[1] - 2)
    u, v = (row - i)[:, None], col - j
    down = values[i] * (1.0 - u) + values[i + 1] * u
    return np.asarray(down[:, j] * (1.0 - v) + down[:, j + 1] * v)


@dataclass(frozen=True)
class CubeGrid:
    """Where a cube's cells lie: CRS, GDAL-style affine (a, b, c, d, e, f), rows and columns; wavenumbers [m-1] of its bands,
    and the width [m-1] of the instrument's line shape at half its height."""

    crs: str
    affine: tuple[float, float, float, float, float, float]
    shape: tuple[int, int]
    wavenumber: Array
    line_width: float

    @property
    def wavelength_nm(self) -> Array:
        return 1e9 / self.wavenumber

    @property
    def fwhm_nm(self) -> Array:
        """dλ = λ²·dσ."""
        return 1e9 * self.line_width / self.wavenumber**2


Strips = Iterable[tuple[int, NDArray[np.float32]]]
Places = Callable[[int, int], tuple[Array, Array, Array]]


def write_cube(grid: CubeGrid, strips: Strips, places: Places, to: Mapping[str, Path]) -> float:
    """Write strips (first row, radiance (row, col, wavenumber)) as they come; return the fraction of cells seen.

    to: `cube`, a GeoTIFF (float32, tiled, one band a wavenumber, NaN where unseen, overviews of means); `quicklook`, a PNG;
    `location`, a GeoTIFF of the cells' latitude, longitude [deg] and height [m], places(start, stop) [rad, rad, m]; and, if
    asked for, `envi` and `envi_header`, the same cube band-interleaved by line. Memory does not grow with the line.
    """
    quicklook = _Quicklook(grid)
    with ExitStack() as stack:
        stack.enter_context(rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB, GDAL_TIFF_OVR_BLOCKSIZE=TILE // 2))
        cube = stack.enter_context(
            rasterio.open(to["cube"], "w", count=grid.wavenumber.size, dtype="float32", **_tiff(grid))
        )
        _describe(cube, grid)
        location = stack.enter_context(rasterio.open(to["location"], "w", count=3, dtype="float64", **_tiff(grid)))
        for band, (name, unit) in enumerate((("latitude", "deg"), ("longitude", "deg"), ("height", "m")), start=1):
            location.set_band_description(band, name)
            location.set_band_unit(band, unit)
        raw = stack.enter_context(to["envi"].open("wb")) if "envi" in to else None
        for start, strip in strips:
            window = Window(0, start, strip.shape[1], strip.shape[0])
            cube.write(np.moveaxis(strip, 2, 0), window=window)
            latitude, longitude, height = places(start, start + strip.shape[0])
            location.write(np.stack([np.rad2deg(latitude), np.rad2deg(longitude), height]), window=window)
            if raw is not None:
                raw.write(np.ascontiguousarray(np.moveaxis(strip, 2, 1), "<f4").tobytes())
            quicklook.add(start, strip)
        if factors := [f for f in OVERVIEWS if max(grid.shape) >= TILE * f]:
            cube.build_overviews(factors, Resampling.average)
    if "envi_header" in to:
        to["envi_header"].write_text(envi_header(grid), encoding="ascii")
    quicklook.write(to["quicklook"])
    return quicklook.seen_fraction


def _tiff(grid: CubeGrid) -> dict[str, Any]:
    return {
        "driver": "GTiff",
        "crs": grid.crs,
        "transform": Affine(*grid.affine),
        "height": grid.shape[0],
        "width": grid.shape[1],
        "nodata": np.nan,
        "tiled": True,
        # Tiles that fill the width: a last one mostly empty would be written all the same.
        "blockxsize": 16 * int(np.ceil(grid.shape[1] / np.ceil(grid.shape[1] / (2 * TILE)) / 16)),
        "blockysize": TILE,
        "interleave": "band",
        "BIGTIFF": "IF_SAFER",
    }


def _describe(cube: rasterio.io.DatasetWriter, grid: CubeGrid) -> None:
    for band, (wavelength, width) in enumerate(zip(grid.wavelength_nm, grid.fwhm_nm, strict=True), start=1):
        cube.set_band_description(band, f"{wavelength:.3f} nm")
        cube.update_tags(band, wavelength=f"{wavelength:.6f}", wavelength_units="nm", fwhm=f"{width:.6f}")
    cube.update_tags(wavelength_units="nm", quantity="spectral radiance, reference radiance unit")


def envi_header(grid: CubeGrid) -> str:
    """The header of a raw float32 cube, band-interleaved by line, with all that ENVI and its readers ask for.

    `map info` names the corner of the first cell and, for a grid turned to the line, the rotation that ENVI has: the angle
    from the map's x axis to the image's rows, clockwise; the image's rows must then run downwards, which those of a
    line's grid do not, so the cell size down is negative.
    """
    a, _, c, d, _, f = grid.affine
    cell = float(np.hypot(a, d))
    crs = CRS.from_user_input(grid.crs)
    code = crs.to_epsg() or 0
    zone, south = (code % 100, code // 100 == 327) if code // 100 in (326, 327) else (0, False)
    projection = f"UTM, 1, 1, {c:.4f}, {f:.4f}, {cell:.6f}, {-cell:.6f}, {zone}, {'South' if south else 'North'}"
    if not zone:
        projection = f"Arbitrary, 1, 1, {c:.4f}, {f:.4f}, {cell:.6f}, {-cell:.6f}"
    rotation = np.rad2deg(np.arctan2(-d, a))
    lines = {
        "description": "{spectral radiance, reference radiance unit}",
        "samples": grid.shape[1],
        "lines": grid.shape[0],
        "bands": grid.wavenumber.size,
        "header offset": 0,
        "file type": "ENVI Standard",
        "data type": 4,
        "interleave": "bil",
        "byte order": 0,
        "data ignore value": "nan",
        "map info": f"{{{projection}, WGS-84, units=Meters, rotation={rotation:.8f}}}",
        "coordinate system string": f"{{{crs.to_wkt(version='WKT1_ESRI')}}}",
        "wavelength units": "Nanometers",
        "wavelength": _listed(f"{w:.4f}" for w in grid.wavelength_nm),
        "fwhm": _listed(f"{w:.4f}" for w in grid.fwhm_nm),
        "band names": _listed(f"{w:.3f} nm" for w in grid.wavelength_nm),
    }
    return "ENVI\n" + "".join(f"{name} = {value}\n" for name, value in lines.items())


def _listed(items: Iterable[str]) -> str:
    return "{" + ", ".join(items) + "}"


def colour_bands(wavelength_nm: Array) -> list[int]:
    """Bands for blue, green and red: 460, 550, 640 nm or what the range has nearest to them."""
    spread = np.clip([460.0, 550.0, 640.0], wavelength_nm.min(), wavelength_nm.max())
    return [int(np.argmin(np.abs(wavelength_nm - w))) for w in spread]


def stretched(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """8 bit of radiances (row, col, 3), each colour from its 1st to its 99th percentile, by square root; 0 where unseen."""
    seen = np.isfinite(image).all(axis=2)
    scaled = np.zeros_like(image)
    if seen.any():
        low, high = np.percentile(image[seen], [1, 99], axis=0)
        scaled[seen] = np.clip((image[seen] - low) / np.maximum(high - low, 1e-12), 0.0, 1.0)
    return np.asarray((255 * np.sqrt(scaled)).astype(np.uint8))


class _Quicklook:
    """An RGB picture of the cube, gathered strip by strip: 640, 550, 460 nm or what the range has nearest to them."""

    def __init__(self, grid: CubeGrid) -> None:
        self.bands = colour_bands(grid.wavelength_nm)
        self.image = np.full((*grid.shape, 3), np.nan, np.float32)

    def add(self, start: int, strip: NDArray[np.float32]) -> None:
        self.image[start : start + strip.shape[0]] = strip[:, :, self.bands]

    @property
    def seen_fraction(self) -> float:
        return float(np.isfinite(self.image[..., 0]).mean())

    def write(self, path: Path) -> None:
        """8 bit, each colour stretched to its 1st to 99th percentile; unseen cells are transparent. Flown upwards."""
        seen = np.isfinite(self.image).all(axis=2)
        picture = np.dstack([stretched(self.image), (255 * seen).astype(np.uint8)])
        cv2.imwrite(str(path), picture[::-1])
