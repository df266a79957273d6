"""Every ground cell of a line goes the way of one target: projected by the pose of each frame, column kept, transformed.

The grid is worked off in strips along the track, each with the blocks of frames that can see it, so memory does not grow with
the line: blocks are corrected once and kept while strips need them. Pieces of a strip go through threads (compiled code and
matrix products let go of the interpreter) while the next strip's frames are read.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Calibration, CameraPoses, Frames
from pipeline.usable_pixels import unusable
from stages.mapping.grid import Heights, MapGrid
from tsmftis import detector, extraction, fourier
from tsmftis.camera import Camera
from tsmftis.effects import refuse_others
from tsmftis.geodesy import geodetic_to_ecef
from tsmftis.interferometer import Interferometer

Array = NDArray[np.float64]

STRIP_CELLS = 128  # along the track: whole tiles of the GeoTIFF
PIECE_CELLS = 2  # across the track, given to a thread at a time: their sums stay in its cache
BLOCK_FRAMES = 128  # corrected at a time


@dataclass(frozen=True)
class _Instrument:
    """What every cell's interferogram and spectrum go through."""

    camera: Camera
    interferometer: Interferometer
    calibration: Calibration
    wavenumber: Array
    phase: Array
    response: Array
    drift_order: int
    precision: Array  # for gaps
    matrix: NDArray[np.float32] | None  # interferogram → radiance, where all cells share their OPDs

    @classmethod
    def of(
        cls,
        camera: Camera,
        interferometer: Interferometer,
        calibration: Calibration,
        wavenumber: Array,
        phase: Array,
        drift_order: int,
    ) -> _Instrument:
        response = np.interp(wavenumber, calibration.wavenumber, calibration.response)
        opd = interferometer.opd((interferometer.rows - 1) / 2, np.arange(interferometer.cols))
        matrix = None
        if interferometer.fringe_tilt == 0.0:
            window = _window(opd, interferometer, wavenumber, phase)
            # The drift's removal is linear too: its transpose acts on the operator once instead of on every cell.
            whole = fourier.operator(opd, window, wavenumber, phase, response)
            matrix = fourier.remove_constant(whole.T, opd, drift_order).T.astype(np.float32)
        table = calibration.wavenumber
        precision = extraction.band_precision(opd, float(table[0]), float(table[-1]))
        return cls(camera, interferometer, calibration, wavenumber, phase, response, drift_order, precision, matrix)

    def radiance(self, value: NDArray[np.float32], row: NDArray[np.float32]) -> NDArray[np.float32]:
        """(cell, wavenumber) from interferograms and mean rows (cell, col)."""
        if self.matrix is not None:
            return value @ self.matrix
        opd = self.interferometer.opd(row, np.arange(self.interferometer.cols))
        window = _window(opd, self.interferometer, self.wavenumber, self.phase)
        ac = fourier.remove_constant(value.astype(np.float64), opd, self.drift_order)
        result = fourier.radiance(ac, opd, window, self.wavenumber, self.phase, self.response)[0]
        return result.astype(np.float32)


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
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield (first row of cells, radiance (rows, across, wavenumber)) strip by strip; NaN where a cell is not seen.

    heights(latitude, longitude) [rad] → [m]; phase (k,) [rad] on wavenumber (k,) [m-1] and
    drift_order as the line's spectra have them. `effects` of the stages geometry and spectral are what a model update adds to
    camera, interferometer and calibration (poses and heights have theirs already). The same whatever the number of threads.
    """
    effects = effects or {}
    refuse_others(effects, "geometry", "spectral")
    camera, interferometer = camera.with_effects(effects), interferometer.with_effects(effects)
    usable = calibration.without(unusable(calibration, frames)).with_effects(effects)
    instrument = _Instrument.of(camera, interferometer, usable, wavenumber, phase, drift_order)
    blocks = _Blocks(frames, instrument)
    memory = threading.local()
    workers = len(os.sched_getaffinity(0))
    with ThreadPoolExecutor(workers) as pool:
        waiting: tuple[int, list[Future[NDArray[np.float32]]]] | None = None
        for start in range(0, grid.shape[0], STRIP_CELLS):
            stop = min(start + STRIP_CELLS, grid.shape[0])
            points = geodetic_to_ecef(*grid.places(start, stop, heights))
            seeing = blocks.that_see(points, poses)
            # Side by side along the track, piece by piece across it.
            cells = np.moveaxis(points, (0, 1, 2), (2, 1, 0))
            pieces = [
                pool.submit(
                    _piece, np.ascontiguousarray(cells[:, j : j + PIECE_CELLS]), seeing, poses, instrument, memory
                )
                for j in range(0, grid.shape[1], PIECE_CELLS)
            ]
            if waiting is not None:
                yield waiting[0], _gathered(waiting[1])
            waiting = start, pieces
        if waiting is not None:
            yield waiting[0], _gathered(waiting[1])


def _gathered(pieces: list[Future[NDArray[np.float32]]]) -> NDArray[np.float32]:
    """Pieces (across, along, wavenumber) as one strip (along, across, wavenumber)."""
    return np.concatenate([piece.result() for piece in pieces]).swapaxes(0, 1)


def _piece(
    points: Array, blocks: list[_Block], poses: CameraPoses, instrument: _Instrument, memory: threading.local
) -> NDArray[np.float32]:
    """Radiance (across, along, wavenumber) of cells at points (3, across, along) through blocks of frames in their order."""
    across, along = points.shape[1:]
    camera, tilted = instrument.camera, instrument.matrix is None
    sums, value, row = _workspace(memory, across * along, camera.cols, extraction.CHANNELS if tilted else 2)
    cells = sums.reshape(across, along, camera.cols, -1)
    for block in blocks:
        extraction.over_cells(
            block.counts,
            points,
            poses.centre[block.first : block.last],
            poses.dcm[block.first : block.last],
            camera.focal_length / camera.pixel_pitch,
            camera.principal_row,
            camera.principal_col,
            camera.radial_k1,
            cells,
        )
    seen = np.empty(across * along, np.int64)
    extraction.means(sums, value, row, seen)
    good = seen >= fourier.LEAST_SEEN * camera.cols
    if gaps := np.flatnonzero(good & (seen < camera.cols)).tolist():
        read = sums[gaps, :, 1] > 0.0
        value[gaps] = extraction.fill_gaps(value[gaps], read, instrument.precision)
        if tilted:
            row[gaps] = np.where(read, row[gaps], row[gaps].mean(axis=1, where=read, keepdims=True))
    if good.any():
        radiance = instrument.radiance(value, row)
        radiance[~good] = np.nan
    else:
        radiance = np.full((across * along, instrument.wavenumber.size), np.nan, np.float32)
    return radiance.reshape(across, along, -1)


def _workspace(memory: threading.local, cells: int, cols: int, channels: int) -> tuple[NDArray[np.float32], ...]:
    """A thread's sums (cell, col, channel), zeroed, values and rows (cell, col): fresh pages would cost as much as their use."""
    if not hasattr(memory, "arrays") or memory.arrays[0].shape[0] < cells:
        shapes = ((cells, cols, channels), (cells, cols), (cells, cols if channels > 2 else 0))
        memory.arrays = tuple(np.zeros(shape, np.float32) for shape in shapes)
    sums, value, row = (a[:cells] for a in memory.arrays)
    sums[:] = 0.0
    return sums, value, row


def _window(opd: Array, interferometer: Interferometer, wavenumber: Array, phase: Array) -> Array:
    centre = fourier.fringe_centre(phase, wavenumber)
    return fourier.scored_window(opd, interferometer.longest_opd, interferometer.shortest_side, centre)


@dataclass(frozen=True)
class _Block:
    """Corrected frames first … last−1 (row, frame, col)."""

    first: int
    last: int
    counts: NDArray[np.float32]


class _Blocks:
    """The line's frames in blocks, corrected when a strip first needs them and let go when one no longer does."""

    def __init__(self, frames: Frames, instrument: _Instrument) -> None:
        self._frames, self._instrument = frames, instrument
        self._spans = frames.blocks(BLOCK_FRAMES)
        self._held: dict[tuple[int, int], _Block] = {}

    def that_see(self, points: Array, poses: CameraPoses) -> list[_Block]:
        """The blocks with frames in which any of a strip's points (along, across, 3) falls on the detector or near it."""
        camera = self._instrument.camera
        outline = points[_spread(points.shape[0], 5)][:, _spread(points.shape[1], 9)].reshape(-1, 3)
        sight = outline[None] - poses.centre[:, None]
        row, col = camera.project(sight @ poses.dcm)
        # Terrain and jitter between the outline's points and frames stay far below a quarter of the detector.
        margin = 0.25 * max(camera.rows, camera.cols)
        near = np.ones(row.shape, bool)
        for at, size in ((row, camera.rows), (col, camera.cols)):
            near &= np.abs(at - size / 2) < size / 2 + margin
        seeing: NDArray[np.bool_] = np.asarray(near.any(axis=1))
        spans = [span for span in self._spans if seeing[span[0] : span[1]].any()]
        self._held = {span: self._held.get(span) or self._load(*span) for span in spans}
        return list(self._held.values())

    def _load(self, first: int, last: int) -> _Block:
        i = self._instrument
        counts = detector.correct(
            self._frames.block(first, last),
            i.calibration.dark,
            i.calibration.flat,
            i.camera.saturation,
            i.interferometer.detector_nonlinearity,
        )
        return _Block(first, last, counts)


def _spread(count: int, number: int) -> NDArray[np.int64]:
    """So many indices from the first to the last of `count`."""
    return np.unique(np.linspace(0, count - 1, number).round().astype(np.int64))
