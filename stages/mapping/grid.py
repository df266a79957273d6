"""The map grid of a line: UTM, or a given CRS, turned to the line's course, with cells of one nominal ground sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pipeline.errors import StageError
from pipeline.raster import Dem, from_crs, is_metric, to_crs, utm_crs
from pipeline.records import CameraPoses, Targets
from tsmftis.camera import Camera
from tsmftis.effects import amounts
from tsmftis.geodesy import ecef_to_geodetic

Array = NDArray[np.float64]
Heights = Callable[[Array, Array], Array]

EDGE_CELLS = 12  # kept beyond the ends of what the plane says is seen
MOST_CELLS = 200_000_000  # a grid larger than this means poses that are wrong


class MappingSettings(BaseModel):
    """The cube's sampling; its spectra are windowed as the scored ones are."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    wavenumber_step_per_m: float = Field(10_000.0, gt=0, description="spacing of the bands")
    cell_m: float | None = Field(None, gt=0, description="side of a cell; default one nominal ground sample")
    envi: bool = Field(False, description="write the cube as ENVI file (cube.img, cube.hdr) too")
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

    def places(self, start: int, stop: int, heights: Heights) -> tuple[Array, Array, Array]:
        """Latitude, longitude [rad] and height [m] (stop − start, across) of a strip's cell centres."""
        latitude, longitude = from_crs(self.crs, *self.centres(start, stop))
        return latitude, longitude, heights(latitude, longitude)


def share_outside(grid: MapGrid, dem: Dem) -> float:
    """Which part of the grid the terrain model does not reach, by 64 × 64 of its cells."""
    rows, cols = (np.unique(np.linspace(0, n - 1, 64).astype(int)) for n in grid.shape)
    a, b, c, d, e, f = grid.affine
    row, col = (m.ravel() + 0.5 for m in np.meshgrid(rows, cols, indexing="ij"))
    latitude, longitude = from_crs(grid.crs, a * col + b * row + c, d * col + e * row + f)
    return float(1.0 - dem.covers(latitude, longitude).mean())


def surface(
    targets: Targets, dem: Dem | None, effects: Mapping[str, Mapping[str, float]] | None = None
) -> tuple[Heights, float]:
    """Heights of the ground as a function of latitude and longitude [rad] → [m], and its mean height at the targets [m];
    without a terrain model a flat one at the targets' mean height. A dem_bias among the effects raises the terrain model, and
    nothing that was surveyed."""
    if dem is not None:
        (bias,) = amounts(effects or {}, "dem_bias")

        def heights(latitude: Array, longitude: Array) -> Array:
            return dem.height(latitude, longitude) + bias

        return heights, float(heights(targets.latitude, targets.longitude).mean())
    flat = float(targets.height.mean())
    return lambda latitude, longitude: np.full(np.shape(latitude), flat), flat


def line_grid(
    poses: CameraPoses,
    camera: Camera,
    ground_height: float,
    settings: MappingSettings,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> MapGrid:
    """The grid that holds what passes over all columns, on the plane at `ground_height` [m].

    Along the track it runs from where the detector's leading edge first falls to where its trailing edge last falls: a cell
    before or behind is not seen by all columns. A line too short for any such cell is mapped over its whole footprint. `effects`
    of the stage geometry are what a model update adds to the camera. Raises StageError where that is no sensible area (camera
    below the ground, looking at the horizon).
    """
    camera = camera.with_effects(effects or {})
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
