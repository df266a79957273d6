"""Motion between frames against the POS: shifts seen minus shifts predicted, and a pair's as coefficients of a polynomial.

    predicted: ray of the pixel through the first pose → terrain → second pose → pixel
    modes c = Q'·W^(1/2)·(seen − predicted),    Q orthonormal of 1, y, x, x², xy, y² over the pair's points

The noise of registration is alike all over a frame, and rows of single points would count it many times. A mode is in pixels: the
RMS over the image that it adds.

Functions
---------
grounded     where rays meet the terrain
missed       seen minus predicted, of points
modes_of     pairs' points averaged over cells of the detector, with the maps to their modes
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.records import ImageMotion
from tsmftis.camera import Camera
from tsmftis.geodesy import ecef_to_geodetic, ned_to_ecef_dcm, radii_of_curvature

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
Height = Callable[[Array, Array], Array]

CELLS = (5, 10)  # of the detector, rows and columns: in each the points of a pair are averaged
DEGREES = ((0, 0), (1, 0), (0, 1), (0, 2), (1, 1), (2, 0))  # of row and column in the modes
OUTLIER = 4.0  # scatters of a pair beyond which a point is left out
MOST_CONDITION = 30.0  # of a pair's polynomial: fewer terms where the points do not carry them
ROUNDS = 8  # of ray and terrain
SLOPE_M = 10.0  # over which the terrain's slope is taken


@dataclass(frozen=True)
class Points:
    """Points (n,) of pairs: places of the pair's frames among the poses, pixel in the first [px], shift to the second [px].

    ground, normal, up (n, 3): where the first frame's ray meets the terrain, and the terrain's normal and the vertical there: a
    plane is near enough for any small change of the model.
    """

    first: Labels
    second: Labels
    row: Array
    col: Array
    row_shift: Array
    col_shift: Array
    ground: Array
    normal: Array
    up: Array


@dataclass(frozen=True)
class Modes:
    """Averaged points; for each pair their slice and the map (mode, point) to its modes, and the modes' sigma [px]."""

    points: Points
    pairs: tuple[tuple[slice, Array], ...]
    sigma: tuple[Array, ...]


@dataclass(frozen=True)
class Poses:
    """Projection centre (frame, 3) and C_camera→ECEF (frame, 3, 3)."""

    centre: Array
    dcm: Array

    def rays(self, frame: Labels, camera: Camera, row: Array, col: Array) -> tuple[Array, Array]:
        """Starts and unit directions (n, 3) of pixels (n,)."""
        ray = np.einsum("pij,pj->pi", self.dcm[frame], camera.directions(row, col))
        return self.centre[frame], ray

    def pixels(self, frame: Labels, camera: Camera, point: Array) -> tuple[Array, Array]:
        """Row and column (n,) of points (n, 3)."""
        return camera.project(np.einsum("pij,pi->pj", self.dcm[frame], point - self.centre[frame]))


def grounded(
    first: Labels, second: Labels, pixel: tuple[Array, Array], poses: Poses, camera: Camera, height: Height
) -> Points:
    """Points at rest: pixels (n,) of the first frames, their ground by the terrain's height at latitude and longitude."""
    start, ray = poses.rays(first, camera, *pixel)
    latitude, longitude, at = ecef_to_geodetic(start)
    sink = np.einsum("pi,pi->p", ray, ned_to_ecef_dcm(latitude, longitude)[:, :, 2])
    along = (at - height(latitude, longitude)) / sink
    for _ in range(ROUNDS):
        latitude, longitude, at = ecef_to_geodetic(start + along[:, None] * ray)
        along = along + (at - height(latitude, longitude)) / sink
    ground = start + along[:, None] * ray
    latitude, longitude, _ = ecef_to_geodetic(ground)
    north, east = radii_of_curvature(latitude)
    slope = []
    for step in ((SLOPE_M / north, 0.0), (0.0, SLOPE_M / (east * np.cos(latitude)))):
        ends = [height(latitude + sign * step[0], longitude + sign * step[1]) for sign in (1.0, -1.0)]
        slope.append((ends[0] - ends[1]) / (2.0 * SLOPE_M))
    axes = ned_to_ecef_dcm(latitude, longitude)
    normal = np.einsum("pij,pj->pi", axes, np.stack([-slope[0], -slope[1], -np.ones(latitude.size)], -1))
    rest = np.zeros(first.size)
    return Points(first, second, *pixel, rest, rest, ground, normal, -axes[:, :, 2])


def missed(points: Points, poses: Poses, camera: Camera, raised: Array | float = 0.0) -> tuple[Array, Array]:
    """Shift seen minus shift predicted (n,) of row and column, over terrain that lies `raised` [m] (n,) higher."""
    start, ray = poses.rays(points.first, camera, points.row, points.col)
    away = points.ground + np.asarray(raised)[..., None] * points.up - start
    along = np.einsum("pi,pi->p", points.normal, away) / np.einsum("pi,pi->p", points.normal, ray)
    row, col = poses.pixels(points.second, camera, start + along[:, None] * ray)
    return points.row + points.row_shift - row, points.col + points.col_shift - col


def modes_of(
    motion: ImageMotion,
    places: tuple[Labels, Labels],
    known: NDArray[np.bool_],
    poses: Poses,
    camera: Camera,
    height: Height,
    mean_sigma: float,
    scatter_share: float,
) -> Modes | None:
    """Of pairs between poses `known` (frame,); `places` (pair,): their frames among the poses; None where none is left.

    mean_sigma [px]: noise that only the first mode has; scatter_share: noise of every mode over the scatter of its points.
    """
    good = (known[places[0]] & known[places[1]])[motion.pair]
    pair = motion.pair[good]
    first, second = (p[pair] for p in places)
    every = grounded(first, second, (motion.row[good], motion.col[good]), poses, camera, height)
    every = replace(every, row_shift=motion.row_shift[good], col_shift=motion.col_shift[good])
    left = np.stack(missed(every, poses, camera), -1)
    half = np.array([camera.rows, camera.cols]) / 2.0
    size, pairs, sigmas, cells = 0, [], [], []
    for p in np.unique(pair):
        mine = np.flatnonzero(pair == p)
        away = np.abs(left[mine] - np.median(left[mine], axis=0))
        scatter = np.maximum(1.4826 * np.median(away, axis=0), motion.sigma[p])
        mine = mine[(away < OUTLIER * scatter).all(axis=1)]
        if mine.size == 0:
            continue
        at = np.stack([every.row[mine], every.col[mine]], -1)
        cell = np.minimum(at / (2.0 * half) * CELLS, np.array(CELLS) - 1).astype(int) @ [CELLS[1], 1]
        labels, index, number = np.unique(cell, return_inverse=True, return_counts=True)
        mean = np.stack([np.bincount(index, v) / number for v in (*at.T, *left[mine].T)])
        y, x = (mean[:2] - half[:, None]) / half[:, None]
        weight = np.sqrt(number / mine.size)
        columns = np.stack([y**a * x**b for a, b in DEGREES], -1) * weight[:, None]
        columns = columns[:, : _independent(columns)]
        q = np.linalg.qr(columns)[0]
        q *= np.sign(np.einsum("ij,ij->j", q, columns))
        pairs.append((slice(size, size + labels.size), q.T * weight))
        own = max(scatter_share * motion.sigma[p], motion.sigma[p] / np.sqrt(mine.size))
        sigmas.append(np.where(np.arange(columns.shape[1]) == 0, np.hypot(own, mean_sigma), own))
        cells.append(np.vstack([np.full(labels.size, p), mean]))
        size += labels.size
    if not pairs:
        return None
    table = np.concatenate(cells, axis=1)
    p = table[0].astype(int)
    made = grounded(places[0][p], places[1][p], (table[1], table[2]), poses, camera, height)
    # What a cell's points miss on average is what its one point is made to miss.
    row, col = missed(made, poses, camera)
    return Modes(replace(made, row_shift=table[3] - row, col_shift=table[4] - col), tuple(pairs), tuple(sigmas))


def _independent(columns: Array) -> int:
    """How many of the first columns are safely independent."""
    for count in (columns.shape[1], 3):
        if len(columns) >= count and np.linalg.cond(columns[:, :count]) < MOST_CONDITION:
            return count
    return 1
