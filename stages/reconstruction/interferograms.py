"""Interferograms along tracks: the frames block by block, each point's crossings summed, gaps filled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Calibration, Frames
from tsmftis import detector, extraction
from tsmftis.camera import Camera
from tsmftis.fourier import LEAST_SEEN
from tsmftis.interferometer import Interferometer

Array = NDArray[Any]
Extraction = Literal["between-frames", "nearest-pixel"]


@dataclass(frozen=True)
class Extracted:
    """(point, col) each: value [DN after dark and flat]; gain, var(sample)/var(pixel); mean row [px]; number of crossings."""

    value: Array
    gain: Array
    row: Array
    crossings: Array

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Points (point,) that were seen on enough columns."""
        return np.asarray((self.crossings > 0).mean(axis=-1) >= LEAST_SEEN)

    def part(self, start: int, stop: int) -> Extracted:
        """Those of some of the points."""
        return Extracted(*(getattr(self, n)[start:stop] for n in ("value", "gain", "row", "crossings")))


def extract(
    frames: Frames,
    row: Array,
    col: Array,
    calibration: Calibration,
    camera: Camera,
    interferometer: Interferometer,
    how: Extraction,
    block_frames: int,
) -> Extracted:
    """Interferograms of points with tracks row, col (point, frame) [px].

    between-frames keeps the column and interpolates in time (`extraction.along_tracks`); nearest-pixel takes in each frame the
    pixel that the point lies in and leaves columns without one to `extraction.fill_gaps`, that is to the least-squares
    spectrum of a non-uniform interferogram. Whether a point was seen at a column is the crossings' to say in both.
    """
    row, col = np.ascontiguousarray(row), np.ascontiguousarray(col)
    sums = np.zeros((row.shape[0], camera.cols, extraction.CHANNELS))
    nearest = np.zeros_like(sums) if how == "nearest-pixel" else sums
    starts = [start for start, _ in frames.segments()]
    for first, last in frames.blocks(block_frames):
        block = detector.correct(
            frames.block(first, last),
            calibration.dark,
            calibration.flat,
            camera.saturation,
            interferometer.detector_nonlinearity,
        )
        extraction.along_tracks(block, first, row, col, sums)
        if how == "nearest-pixel":
            new = 0 if first in starts else 1  # the frame that two blocks share counts once
            extraction.nearest_pixels(np.ascontiguousarray(block[:, new:]), first + new, row, col, nearest)
    crossings = sums[..., 3]
    gain = np.empty_like(crossings)
    for p in range(len(row)):
        one = slice(p, p + 1)
        gain[p] = gain_of(row[one], col[one], np.ones(1), crossings[one], camera.rows, starts[1:], how)
    read = nearest[..., 1] > 0
    weight = np.where(read, nearest[..., 1], 1.0)
    opd = interferometer.opd((interferometer.rows - 1) / 2, np.arange(camera.cols))
    precision = extraction.band_precision(opd, float(calibration.wavenumber[0]), float(calibration.wavenumber[-1]))
    return Extracted(
        extraction.fill_gaps(nearest[..., 0] / weight, read, precision),
        _between(gain, read),
        _between(nearest[..., 2] / weight, read),
        crossings,
    )


def gain_of(
    row: Array, col: Array, share: Array, crossings: Array, rows: int, breaks: list[int], how: Extraction
) -> Array:
    """var/var(pixel) at each column (col,) of the mean Σ share_p·I_p of points with tracks row, col (point, frame).

    breaks: frames before which frames are missing; nothing is crossed there.
    """
    out = np.zeros(crossings.shape[1])
    if how == "nearest-pixel":
        extraction.gain_of_nearest(row, col, share, rows, out)
    else:
        row, col = (np.insert(track, breaks, np.nan, axis=1) for track in (row, col))
        extraction.gain_of_mean(row, col, share, crossings, rows, out)
    return out


def _between(value: Array, seen: Array) -> Array:
    """What varies slowly (gain, row) at columns not seen: linearly from the neighbours."""
    filled, columns = value.copy(), np.arange(value.shape[1])
    for p in np.flatnonzero(~seen.all(axis=1) & seen.any(axis=1)):
        filled[p, ~seen[p]] = np.interp(columns[~seen[p]], columns[seen[p]], value[p, seen[p]])
    return filled
