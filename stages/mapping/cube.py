"""Every ground cell of a line goes the way of one target: projected by the pose of each frame, column kept, transformed.

The grid lies in UTM, turned to the line's course, with cells of one nominal ground sample. It is worked off in strips along
the track, each with the frames that can see it, so memory does not grow with the line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pipeline.errors import StageError
from pipeline.raster import Dem, from_crs, is_metric, to_crs, utm_crs
from pipeline.records import Calibration, CameraPoses, Frames, Targets
from tsmftis import detector, extraction, fourier
from tsmftis.camera import Camera
from tsmftis.geodesy import ecef_to_geodetic, geodetic_to_ecef
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]
Heights = Callable[[Array, Array], Array]

EDGE_CELLS = 12  # kept beyond the ends of what the plane says is seen
STRIP_VALUES = 1_500_000  # cells × columns worked off at a time
BLOCK_FRAMES = 256  # frames in memory at a time
MOST_CELLS = 200_000_000  # a grid larger than this means poses that are wrong


class MappingSettings(BaseModel):
    """The cube's sampling; its spectra are windowed as the scored ones are."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    wavenumber_step_per_m: float = Field(10_000.0, gt=0, description="spacing of the bands")
    cell_m: float | None = Field(None, gt=0, description="side of a cell; default one nominal ground sample")
    crs: str | None = Field(None, description="a projected CRS in metres; default: the UTM zone of the line")

    @field_validator("crs")
    @classmethod
    def _in_metres(cls, value: str | None) -> str | None:
        if value is not None and not is_metric(value):
            raise ValueError(f"'{value}' is no projected CRS in metres (for instance EPSG:32651)")
        return value


@dataclass(frozen=True)
class MapGrid:
    """Cells (along, across) of side `cell` [m] in `crs`: centre(i, j) = origin + (i + ½)·cell·along + (j + ½)·cell·across."""

    crs: str
    origin: tuple[float, float]
    course: float  # grid angle of `along`, from the CRS's north over east [rad]
    cell: float
    shape: tuple[int, int]
    ground_height: float

    @property
    def affine(self) -> tuple[float, float, float, float, float, float]:
        """GDAL-style (a, b, c, d, e, f): x = a·col + b·row + c, y = d·col + e·row + f; rows run along, columns across."""
        s, c = np.sin(self.course) * self.cell, np.cos(self.course) * self.cell
        return (c, s, self.origin[0], -s, c, self.origin[1])

    def centres(self, start: int, stop: int) -> tuple[Array, Array]:
        """Easting, northing (stop − start, across) of the cell centres of a strip [m]."""
        a, b, c, d, e, f = self.affine
        row, col = np.meshgrid(np.arange(start, stop) + 0.5, np.arange(self.shape[1]) + 0.5, indexing="ij")
        return a * col + b * row + c, d * col + e * row + f


def surface(targets: Targets, dem: Dem | None) -> tuple[Heights, float]:
    """Heights of the ground as a function of latitude and longitude [rad] → [m], and its mean height at the targets [m];
    without a terrain model a flat one at the targets' mean height."""
    if dem is not None:
        return dem.height, float(dem.height(targets.latitude, targets.longitude).mean())
    flat = float(targets.height.mean())
    return lambda latitude, longitude: np.full(np.shape(latitude), flat), flat


def line_grid(poses: CameraPoses, camera: Camera, ground_height: float, settings: MappingSettings) -> MapGrid:
    """The grid that holds what passes over all columns, on the plane at `ground_height` [m].

    Along the track it runs from where the detector's leading edge first falls to where its trailing edge last falls: a cell
    before or behind is not seen by all columns. A line too short for any such cell is mapped over its whole footprint.
    Raises StageError where that is no sensible area (camera below the ground, looking at the horizon).
    """
    seen = np.isfinite(poses.centre[:, 0])
    centre, dcm = poses.centre[seen], poses.dcm[seen]
    latitude, longitude, height = ecef_to_geodetic(centre)
    if (height <= ground_height).any():
        raise StageError("the camera lies below the terrain: heights of DEM or targets do not fit the trajectory")
    crs = settings.crs or utm_crs(float(latitude.mean()), float(longitude.mean()))
    rows, cols = (
        np.array([0.0, 0.0, camera.rows - 1.0, camera.rows - 1.0]),
        np.array([0.0, camera.cols - 1.0, 0.0, camera.cols - 1.0]),
    )
    rays = np.einsum("fij,pj->fpi", dcm, camera.directions(rows, cols))
    foot_lat, foot_lon = _on_plane(centre[:, None, :], rays, ground_height)
    x, y = to_crs(crs, foot_lat, foot_lon)
    east, north = to_crs(crs, latitude[[0, -1]], longitude[[0, -1]])
    course = float(np.arctan2(east[1] - east[0], north[1] - north[0]))
    cell = settings.cell_m or camera.ground_sample(float(height.mean()) - ground_height)
    along = x * np.sin(course) + y * np.cos(course)
    across = x * np.cos(course) - y * np.sin(course)
    # Columns 0 and last are the two edges; jitter and terrain may carry either a little farther than the plane says.
    edges = np.stack([along[:, cols == 0.0].mean(axis=1), along[:, cols > 0.0].mean(axis=1)])
    first, last = edges.max(axis=0).min() - EDGE_CELLS * cell, edges.min(axis=0).max() + EDGE_CELLS * cell
    if last - first < cell:
        first, last = along.min(), along.max()
    low = first, across.min()
    shape = int(np.ceil((last - first) / cell)), int(np.ceil((across.max() - low[1]) / cell))
    if not 0 < shape[0] * shape[1] < MOST_CELLS:
        raise StageError(
            f"the line's footprint would need {shape[0]} × {shape[1]} cells: the attitude is not that of a camera looking down"
        )
    origin = (
        low[0] * np.sin(course) + low[1] * np.cos(course),
        low[0] * np.cos(course) - low[1] * np.sin(course),
    )
    return MapGrid(crs, (float(origin[0]), float(origin[1])), course, float(cell), shape, ground_height)


def run(
    frames: Frames,
    poses: CameraPoses,
    heights: Heights,
    grid: MapGrid,
    wavenumber: Array,
    phase: Array,
    calibration: Calibration,
    camera: Camera,
    interferometer: Interferometer,
    drift_order: int,
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield (first row of cells, radiance (rows, across, wavenumber)) strip by strip; NaN where a cell is not seen.

    heights(latitude, longitude) [rad] → [m]; phase (k,) [rad] on wavenumber (k,) [m-1] and
    drift_order as the line's spectra have them.
    """
    response = np.interp(wavenumber, calibration.wavenumber, calibration.response)
    window_of = _windower(interferometer, fourier.fringe_centre(phase, wavenumber))
    # A strip's sums are four values a cell and column.
    height = max(1, STRIP_VALUES // (grid.shape[1] * camera.cols))
    for start in range(0, grid.shape[0], height):
        stop = min(start + height, grid.shape[0])
        x, y = grid.centres(start, stop)
        latitude, longitude = from_crs(grid.crs, x, y)
        points = geodetic_to_ecef(latitude, longitude, heights(latitude, longitude)).reshape(-1, 3)
        value, weight, row = _extract(points, frames, poses, calibration, camera, interferometer)
        seen = weight > 0
        good = np.flatnonzero(seen.mean(axis=1) >= fourier.LEAST_SEEN)
        radiance = np.full((len(points), wavenumber.size), np.nan, np.float32)
        if good.size:
            once = np.maximum(weight[good], 1.0)
            filled = extraction.fill_gaps(value[good] / once, seen[good])
            opd, window = window_of(extraction.fill_gaps(row[good] / once, seen[good]))
            ac = fourier.remove_constant(filled, opd, drift_order)
            radiance[good] = fourier.radiance(ac, opd, window, wavenumber, phase, response)[0]
        yield start, radiance.reshape(stop - start, grid.shape[1], wavenumber.size)


def _extract(
    points: Array,
    frames: Frames,
    poses: CameraPoses,
    calibration: Calibration,
    camera: Camera,
    interferometer: Interferometer,
) -> tuple[Array, Array, Array]:
    """Sums of value, crossings and rows (point, col) over the frames that see the points, block by block."""
    value, gain, weight, row = (np.zeros((len(points), camera.cols)) for _ in range(4))
    for start, stop in frames.segments(*_frames_that_see(points, poses, camera)):
        for first in range(start, stop - 1, BLOCK_FRAMES):
            last = min(first + BLOCK_FRAMES + 1, stop)
            block = detector.correct(
                frames.block(first, last),
                calibration.dark,
                calibration.flat,
                camera.saturation,
                interferometer.detector_nonlinearity,
            )
            extraction.over_cells(
                block,
                points,
                poses.centre[first:last],
                poses.dcm[first:last],
                camera.focal_length / camera.pixel_pitch,
                camera.principal_row,
                camera.principal_col,
                camera.radial_k1,
                value,
                gain,
                weight,
                row,
            )
    return value, weight, row


def _windower(interferometer: Interferometer, centre: float) -> Callable[[Array], tuple[Array, Array]]:
    """rows (cell, col) → OPD and window, one for all cells where rows do not matter."""

    def window(opd: Array) -> Array:
        return fourier.scored_window(opd, interferometer.longest_opd, interferometer.shortest_side, centre)

    columns = np.arange(interferometer.cols)
    if interferometer.fringe_tilt == 0.0:
        one = interferometer.opd((interferometer.rows - 1) / 2, columns)
        return lambda row: (one, window(one))
    return lambda row: (opd := interferometer.opd(row, columns), window(opd))


def _on_plane(centre: Array, rays: Array, height: float) -> tuple[Array, Array]:
    """Geodetic foot [rad] of rays at an ellipsoidal height: three Newton steps on the ray's length."""
    _, _, start = ecef_to_geodetic(centre)
    up = centre / np.linalg.norm(centre, axis=-1, keepdims=True)
    descent = -(rays * up).sum(axis=-1)
    if (descent < 0.1).any():
        raise StageError("the camera does not look down in some frames: check boresight and imu_to_body")
    length = (start - height) / descent
    for _ in range(3):
        latitude, longitude, h = ecef_to_geodetic(centre + length[..., None] * rays)
        length = length + (h - height) / descent
    latitude, longitude, _ = ecef_to_geodetic(centre + length[..., None] * rays)
    return latitude, longitude


def _frames_that_see(points: Array, poses: CameraPoses, camera: Camera) -> tuple[int, int]:
    """First and one past the last frame in which any of a strip's outline falls near the detector."""
    outline = points[np.unique(np.linspace(0, len(points) - 1, 256).astype(int))]
    line_of_sight = outline[None] - poses.centre[:, None]
    row, col = camera.project(np.einsum("fij,fpi->fpj", poses.dcm, line_of_sight))
    margin = 0.25 * max(camera.rows, camera.cols)
    near = (row > -margin) & (row < camera.rows + margin) & (col > -margin) & (col < camera.cols + margin)
    frames = np.flatnonzero(near.any(axis=1))
    return (int(frames[0]), int(frames[-1]) + 1) if frames.size else (0, 0)
