"""The line's quicklook where it lies: over the shaded terrain, north up, with the targets."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import plotly.graph_objects as go
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.transform import Affine, array_bounds
from rasterio.vrt import WarpedVRT
from rasterio.warp import calculate_default_transform, reproject

from pipeline.raster import colour_bands, stretched, to_crs
from pipeline.records import Targets
from pipeline.report.figures import layout, png

MOST_PIXELS = 900  # of the picture's longer side
MARGIN = 0.12  # of terrain around the line, of its longer side


def over_terrain(cube: Path, dem: Path | None, targets: Targets) -> go.Figure:
    """Cells of the cube in three bands over the hillshade of the terrain (light from the north-west, 45° high)."""
    with rasterio.open(cube) as source:
        crs = source.crs
        transform, width, height = calculate_default_transform(crs, crs, source.width, source.height, *source.bounds)
        west, south, east, north = array_bounds(height, width, transform)
        margin = MARGIN * max(east - west, north - south)
        west, south, east, north = west - margin, south - margin, east + margin, north + margin
        cell = max(east - west, north - south) / MOST_PIXELS
        shape = int((north - south) / cell), int((east - west) / cell)
        grid = Affine(cell, 0.0, west, 0.0, -cell, north)
        wavelength = np.array([float(source.tags(band)["wavelength"]) for band in source.indexes])
        bands = [b + 1 for b in colour_bands(wavelength)]
        with WarpedVRT(
            source,
            crs=crs,
            transform=grid,
            height=shape[0],
            width=shape[1],
            resampling=Resampling.average,
            nodata=np.nan,
        ) as turned:
            colours = np.moveaxis(turned.read(bands), 0, -1)
    picture = np.repeat(_hillshade(dem, crs.to_wkt(), grid, shape)[..., None], 3, axis=2)
    seen = np.isfinite(colours).all(axis=2)
    picture[seen] = stretched(colours)[seen]
    figure = go.Figure()
    figure.add_layout_image(
        source=png(np.ascontiguousarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))),
        xref="x",
        yref="y",
        x=west,
        y=north,
        sizex=east - west,
        sizey=north - south,
        sizing="stretch",
        layer="below",
    )
    x, y = to_crs(crs.to_wkt(), targets.latitude, targets.longitude)
    marker = {"symbol": "circle-open", "size": 14, "color": "#d81b60", "line": {"width": 2}}
    figure.add_scatter(
        x=x.tolist(), y=y.tolist(), mode="markers", marker=marker, showlegend=False, hovertext=targets.ids
    )
    for name, east_of, north_of in zip(targets.ids, x, y, strict=True):
        # Beside the line on its right, led to the circle: on the picture itself nobody could read them.
        figure.add_annotation(
            x=float(east_of), y=float(north_of), text=name, ax=70, ay=0, arrowcolor="#d81b60", arrowwidth=1, standoff=8,
            arrowhead=0, font={"color": "#d81b60", "size": 12}, bgcolor="rgba(255,255,255,0.8)",
        )  # fmt: skip
    figure.update_xaxes(title="easting [m]", range=[west, east], tickformat=".0f", showgrid=False, constrain="domain")
    figure.update_yaxes(title="northing [m]", range=[south, north], tickformat=".0f", showgrid=False, scaleanchor="x")
    return layout(figure, 720)


def _hillshade(dem: Path | None, crs: str, grid: Affine, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Grey of a slope lit from the north-west, 45° high; flat grey without terrain."""
    if dem is None:
        return np.full(shape, 200, np.uint8)
    heights = np.full(shape, np.nan)
    with rasterio.open(dem) as source:
        reproject(
            rasterio.band(source, 1),
            heights,
            dst_transform=grid,
            dst_crs=crs,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    south, east = np.gradient(heights, grid.a)
    normal = np.stack([-east, south, np.ones(shape)])
    light = np.array([-0.5, 0.5, np.sqrt(0.5)])
    shade = np.tensordot(light, normal / np.linalg.norm(normal, axis=0), 1)
    grey = np.nan_to_num(110.0 + 145.0 * np.clip(shade, 0.0, 1.0), nan=255.0)
    return np.asarray(grey.astype(np.uint8))
