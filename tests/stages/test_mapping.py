"""The cube: a cell is a target at its centre, and the ground lies where it was surveyed."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.warp import transform as warp
from scipy.spatial.transform import Rotation

from pipeline.errors import StageError
from pipeline.raster import CubeGrid, from_crs, utm_crs, write_cube
from pipeline.records import Calibration, CameraPoses, Frames, Targets, Tracks
from stages.mapping import MappingSettings, line_grid, run
from stages.mapping.grid import MapGrid
from stages.reconstruction import ReconstructionSettings
from stages.reconstruction import run as reconstruct
from stages.tracking.collinearity import project, target_points
from tsmftis.camera import Camera
from tsmftis.fourier import smooth_phase
from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm
from tsmftis.interferometer import Interferometer

LAT, LON, GROUND, COURSE, FRAMES = np.deg2rad(37.2), np.deg2rad(126.4), 30.0, 0.6, 270
CAMERA = Camera(24, 192, 15e-6, 0.07, 11.3, 95.1, 100.0, 16383.0, 0.2)
TABLE = np.linspace(1.0e6, 2.35e6, 601)
RESPONSE = np.full(TABLE.size, 2e-3)
HALF = 1.2  # m, half the side of the bright panel around LAT, LON


def interferometer(tilt: float) -> Interferometer:
    return Interferometer(24, 192, 2.05e-7, 28.0, 450e-9, 900e-9, 0.0, tilt)


@cache
def poses() -> CameraPoses:
    """1 000 m above the panel's plane, 20 m/s (one pixel a frame) along COURSE, wobbling by a quarter of a degree."""
    time = (np.arange(FRAMES) - FRAMES / 2) * 0.01
    frame = Rotation.from_matrix(ned_to_ecef_dcm(LAT, LON))
    along = np.array([np.cos(COURSE), np.sin(COURSE), 0.0])
    centre = geodetic_to_ecef(LAT, LON, GROUND) + frame.apply(20.0 * time[:, None] * along - [0.0, 0.0, 1000.0])
    angles = np.stack([COURSE + 0.003 * np.sin(9 * time), 0.004 * np.sin(5 * time), 0.0008 * np.cos(11 * time)], -1)
    return CameraPoses(time, centre, (frame * Rotation.from_euler("ZYX", angles)).as_matrix())


@cache
def frames(tilt: float) -> tuple[Frames, Calibration]:
    """A dim plane with a bright panel whose sides lie along and across the course; its edges soft over 0.3 m."""
    p = poses()
    row, col = np.meshgrid(np.arange(24.0), np.arange(192.0), indexing="ij")
    to_ned = ned_to_ecef_dcm(LAT, LON).T
    rays = np.einsum("ij,fjk,rck->frci", to_ned, p.dcm, CAMERA.directions(row, col))
    above = (p.centre - geodetic_to_ecef(LAT, LON, GROUND)) @ to_ned.T
    north, east = (above[:, None, None, i] - above[:, None, None, 2] * rays[..., i] / rays[..., 2] for i in (0, 1))
    along, across = north * np.cos(COURSE) + east * np.sin(COURSE), east * np.cos(COURSE) - north * np.sin(COURSE)
    inside = [0.5 * (np.tanh((HALF - d) / 0.15) + np.tanh((HALF + d) / 0.15)) for d in (along, across)]
    scene = 0.3 + 0.7 * inside[0] * inside[1]
    opd = interferometer(tilt).opd(row, col)
    fringe = np.trapezoid(RESPONSE * np.cos(2 * np.pi * opd[..., None] * TABLE + 0.2), TABLE, axis=-1)
    dark = np.full((24, 192), 100.0)
    counts = np.round(scene * (3500.0 + fringe) + dark).astype(np.uint16)
    return Frames(p.time, counts), Calibration(dark, np.ones((24, 192)), TABLE, RESPONSE)


def flat(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    return np.full(np.shape(latitude), GROUND)


def cube(tilt: float, grid: MapGrid, wavenumber: np.ndarray, phase: np.ndarray) -> np.ndarray:
    out = np.full((*grid.shape, wavenumber.size), -1.0, np.float32)
    raw, calibration = frames(tilt)
    drift_order = ReconstructionSettings().drift_order
    for start, part in run(
        raw, poses(), flat, grid, wavenumber, phase, calibration, CAMERA, interferometer(tilt), drift_order
    ):
        out[start : start + len(part)] = part
    return out


@pytest.mark.parametrize("tilt", [0.0, 2e-9])
def test_a_cell_is_a_target_at_its_centre(tilt: float) -> None:
    """The spectra of targets put on five cells' centres, by tracking and reconstruction: float32 of the cube (2e-5)."""
    grid = line_grid(poses(), CAMERA, GROUND, MappingSettings(cell_m=0.8))
    ifm, (raw, calibration) = interferometer(tilt), frames(tilt)
    x, y = grid.centres(0, grid.shape[0])
    middle = grid.shape[0] // 2
    cells = [(middle + i, grid.shape[1] // 2 + j) for i, j in ((0, 0), (1, -1), (-2, 1), (3, 0), (-3, -1))]
    lon, lat = warp(grid.crs, "EPSG:4326", [x[c] for c in cells], [y[c] for c in cells])
    ids = tuple(f"t{i}" for i in range(5))
    place = np.deg2rad(lat), np.deg2rad(lon), np.full(5, GROUND)
    targets = Targets(ids, *place, ("",) * 5, np.full(5, 0.4))
    row, col = project(target_points(targets, COURSE), poses(), CAMERA)
    tracks = Tracks(("tracking",), ids, row[None], col[None])
    scored = reconstruct(raw, tracks, targets, calibration, None, CAMERA, ifm, ReconstructionSettings())
    sigma = scored.spectra.wavenumber
    mapped = cube(tilt, grid, sigma, smooth_phase(scored.phase, sigma))
    for cell, want in zip(cells, scored.spectra.radiance[0], strict=True):
        assert np.isfinite(want).all()
        np.testing.assert_allclose(mapped[cell], want, rtol=2e-5, atol=2e-5)


def test_strips_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five rows of cells at a time or all, three columns or all to a thread: rounding of float32 products of another shape."""
    grid = line_grid(poses(), CAMERA, GROUND, MappingSettings())
    sigma = interferometer(0.0).scored_wavenumbers(100_000.0)
    phase = np.full(sigma.size, 0.2)
    whole = cube(0.0, grid, sigma, phase)
    monkeypatch.setattr("stages.mapping.cube.STRIP_CELLS", 5)
    monkeypatch.setattr("stages.mapping.cube.PIECE_CELLS", 3)
    parts = cube(0.0, grid, sigma, phase)
    np.testing.assert_array_equal(np.isnan(parts), np.isnan(whole))
    np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(cube(0.0, grid, sigma, phase), parts)  # and the same bytes when run again


def written(grid: MapGrid, radiance: np.ndarray, sigma: np.ndarray, folder: Path) -> dict[str, Path]:
    """The cube's files, in strips of 50 rows."""
    names = {
        "cube": "cube.tif",
        "quicklook": "q.png",
        "location": "location.tif",
        "envi": "cube.img",
        "envi_header": "cube.hdr",
    }
    files = {n: folder / name for n, name in names.items()}
    strips = [(i, radiance[i : i + 50]) for i in range(0, grid.shape[0], 50)]
    about = CubeGrid(grid.crs, grid.affine, grid.shape, sigma, 1.0e4)
    seen = write_cube(about, strips, lambda start, stop: grid.places(start, stop, flat), files)
    assert seen == pytest.approx(np.isfinite(radiance[..., 0]).mean())
    return files


def test_all_files_of_a_cube_say_the_same(tmp_path: Path) -> None:
    """GeoTIFF, its overviews, the ENVI file as GDAL reads it, and the location array against PROJ point by point (1 mm)."""
    grid = line_grid(poses(), CAMERA, GROUND, MappingSettings(cell_m=0.06))
    sigma = interferometer(0.0).scored_wavenumbers(200_000.0)
    rng = np.random.default_rng(3)
    radiance = rng.uniform(1.0, 2.0, (*grid.shape, sigma.size)).astype(np.float32)
    radiance[:7] = np.nan
    files = written(grid, radiance, sigma, tmp_path)
    with (
        rasterio.open(files["cube"]) as tif,
        rasterio.open(files["envi"]) as envi,
        rasterio.open(files["location"]) as where,
    ):
        np.testing.assert_array_equal(np.moveaxis(tif.read(), 0, -1), radiance)
        np.testing.assert_array_equal(envi.read(), tif.read())
        assert envi.crs == tif.crs == where.crs and np.isnan(envi.nodata)
        np.testing.assert_allclose(envi.transform, tif.transform, atol=1e-3)
        tags = tif.tags(1)
        assert float(tags["wavelength"]) == pytest.approx(1e9 / sigma[0]) and tags["wavelength_units"] == "nm"
        assert float(tags["fwhm"]) == pytest.approx(1e9 / sigma[0] ** 2 * 1e4, rel=1e-6)
        assert tif.overviews(1) and tif.profile["tiled"]
        # An overview's cell is the mean of the four that were seen; the first rows were not.
        with rasterio.open(files["cube"], overview_level=0) as overview:
            half = overview.read(1)
        np.testing.assert_allclose(
            half[20, 20], radiance[40:42, 40:42, 0].mean(), atol=0.3
        )  # GDAL's cells need not be ours
        np.testing.assert_allclose(np.nanmean(half), np.nanmean(radiance[..., 0]), atol=1e-3)
        assert np.isnan(half[1, 5])
        latitude, longitude, height = where.read()
    assert grid.shape[0] * grid.shape[1] > 4096  # large enough for the lattice
    x, y = grid.centres(0, grid.shape[0])
    some = rng.integers(0, x.size, 50)
    lon, lat = warp(grid.crs, "EPSG:4326", x.ravel()[some], y.ravel()[some])
    np.testing.assert_allclose(latitude.ravel()[some], lat, atol=1e-8)
    np.testing.assert_allclose(longitude.ravel()[some], lon, atol=1e-8)
    assert (height == GROUND).all()
    header = files["envi_header"].read_text()
    for key in (
        "samples",
        "lines",
        "bands",
        "interleave = bil",
        "data type = 4",
        "byte order = 0",
        "map info",
        "wavelength = {",
    ):
        assert key in header
    assert f"{1e9 / sigma[-1]:.4f}" in header and "fwhm = {" in header and "data ignore value = nan" in header


def test_coordinates_over_a_large_grid_are_those_point_by_point() -> None:
    """Kilometres of cells of 20 m, 5° off the zone's meridian: a fraction of 1e-4 of a cell."""
    x, y = np.meshgrid(300_000.0 + 20.0 * np.arange(300), 4_100_000.0 + 20.0 * np.arange(200))
    latitude, longitude = from_crs("EPSG:32652", x, y)
    lon, lat = warp("EPSG:32652", "EPSG:4326", x[::37, ::41].ravel(), y[::37, ::41].ravel())
    np.testing.assert_allclose(np.rad2deg(latitude)[::37, ::41].ravel(), lat, atol=2e-7)
    np.testing.assert_allclose(np.rad2deg(longitude)[::37, ::41].ravel(), lon, atol=2e-7)


def test_a_panel_lies_where_it_was_surveyed(tmp_path: Path) -> None:
    """Centre of the bright cells, read back from the GeoTIFF, against PROJ's UTM of the survey: within half a cell."""
    grid = line_grid(poses(), CAMERA, GROUND, MappingSettings())
    assert grid.cell == pytest.approx(15e-6 * 1000.0 / 0.07, rel=1e-3)
    sigma = interferometer(0.0).scored_wavenumbers(100_000.0)
    radiance = cube(0.0, grid, sigma, np.full(sigma.size, 0.2))
    files = written(grid, radiance, sigma, tmp_path)
    with rasterio.open(files["cube"]) as source:
        image = source.read().mean(axis=0)
        transform, crs = source.transform, source.crs
        assert source.descriptions[0] == f"{1e9 / sigma[0]:.3f} nm" and np.isnan(source.nodata)
    rows, cols = np.nonzero(image > 0.65)
    (x,), (y,) = warp("EPSG:4326", crs, [np.rad2deg(LON)], [np.rad2deg(LAT)])
    corners = np.array([rasterio.transform.xy(transform, r, c) for r, c in zip(rows, cols, strict=True)])
    off = corners.mean(axis=0) - (x, y)
    print("panel off by", off, "cells", len(rows), (2 * HALF / grid.cell) ** 2, grid.shape)
    assert np.hypot(*off) < 0.5 * grid.cell
    # As large as it is (UTM's scale apart), and its sides along the grid's.
    assert len(rows) == pytest.approx((2 * HALF / grid.cell) ** 2, rel=0.15)
    assert np.ptp(rows) + 1 == pytest.approx(2 * HALF / grid.cell, abs=1.5)
    assert np.ptp(cols) + 1 == pytest.approx(2 * HALF / grid.cell, abs=1.5)
    # Rows of cells run along the course: UTM's convergence here is 1.6°.
    step = np.subtract(rasterio.transform.xy(transform, 1, 0), rasterio.transform.xy(transform, 0, 0))
    assert np.arctan2(step[0], step[1]) == pytest.approx(COURSE, abs=0.04)
    # Level inside and outside: B = 1 on the panel, 0.3 beside it, at two cells from its edges (5 %: the flat band's ends).
    middle = image[int(rows.mean()), int(cols.mean())]
    beside = np.nanmedian(image[image < 0.5])
    assert middle / beside == pytest.approx(1 / 0.3, rel=0.05)


def test_zone_of_the_line() -> None:
    assert utm_crs(LAT, LON) == "EPSG:32652" and utm_crs(-0.5, np.deg2rad(-179.9)) == "EPSG:32701"


def test_impossible_geometry_is_an_error_in_words() -> None:
    with pytest.raises(StageError, match="below the terrain"):
        line_grid(poses(), CAMERA, 5000.0, MappingSettings())
    sideways = CameraPoses(poses().time, poses().centre, poses().dcm @ Rotation.from_euler("x", np.pi / 2).as_matrix())
    with pytest.raises(StageError, match="look down"):
        line_grid(sideways, CAMERA, GROUND, MappingSettings())
