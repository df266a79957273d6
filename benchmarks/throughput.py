"""How fast a line becomes a cube: every ground cell, from the file of frames to the written GeoTIFF.

    python benchmarks/throughput.py [--frames 4000] [--rows 256] [--cols 320] [--keep FOLDER]

The line: 100 frames a second, a pixel a frame, 1 000 m above flat ground, jitter of 0.1° at 2 Hz; counts of a random scene
under fringes (what they are does not change the time). Printed: seconds a part, samples (a column of a cell, interpolated
between two rows in two frames) a second of the extraction alone (and a second of
processor time, for a machine that others use), peak memory, and how many times faster than recorded.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from pipeline.raster import CubeGrid, write_cube
from pipeline.records import Calibration, CameraPoses, Frames
from stages import mapping
from stages.mapping.cube import PIECE_CELLS
from tsmftis import detector, extraction
from tsmftis.camera import Camera
from tsmftis.fourier import SCORED_APODIZATION, line_width
from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm
from tsmftis.interferometer import Interferometer

RATE, HEIGHT, COURSE = 100.0, 1000.0, 0.4
LATITUDE, LONGITUDE = np.deg2rad(37.2), np.deg2rad(126.4)
BLOCK = 128


def write_frames(path: Path, frames: int, rows: int, cols: int) -> None:
    """A random scene that moves by a pixel a frame beneath fringes along the columns."""
    rng = np.random.default_rng(1)
    scene = rng.uniform(1000.0, 6000.0, (rows, cols + BLOCK)).astype(np.float32)
    fringe = (1.0 + 0.4 * np.cos(2.4 * np.arange(cols)) * np.exp(-(((np.arange(cols) - 40) / 60) ** 2))).astype(
        np.float32
    )
    with h5py.File(path, "w") as file:
        counts = file.create_dataset("frames", (frames, rows, cols), "uint16")
        counts.attrs["units"] = "DN"
        for name, size in (("frame", frames), ("row", rows), ("col", cols)):
            file.create_dataset(name, data=np.arange(size, dtype=np.int32)).make_scale(name)
            counts.dims[("frame", "row", "col").index(name)].attach_scale(file[name])
        clock = file.create_dataset("time", data=np.arange(frames) / RATE)
        clock.attrs["units"] = "s"
        clock.dims[0].attach_scale(file["frame"])
        for start in range(0, frames, BLOCK):
            stop = min(start + BLOCK, frames)
            counts[start:stop] = np.stack(
                [scene[:, BLOCK - i : BLOCK - i + cols] * fringe for i in range(stop - start)]
            )


def flight(frames: int, pixel: float) -> CameraPoses:
    """Level flight of a pixel a frame along `COURSE`, with jitter."""
    t = np.arange(frames) / RATE
    frame = Rotation.from_matrix(ned_to_ecef_dcm(LATITUDE, LONGITUDE))
    along = np.array([np.cos(COURSE), np.sin(COURSE), 0.0]) * pixel
    centre = geodetic_to_ecef(LATITUDE, LONGITUDE, 0.0) + frame.apply(
        np.arange(frames)[:, None] * along - [0, 0, HEIGHT]
    )
    jitter = np.deg2rad(0.1) * np.stack([np.sin(11 * t), np.sin(12.6 * t), np.cos(9 * t)], -1)
    angles = np.stack([COURSE + jitter[:, 0], jitter[:, 1], jitter[:, 2]], -1)
    return CameraPoses(t, centre, (frame * Rotation.from_euler("ZYX", angles)).as_matrix())


def extraction_rate(
    frames: Frames, calibration: Calibration, poses: CameraPoses, camera: Camera
) -> tuple[float, float]:
    """Samples a second, and a second of processor time, of `extraction.over_cells` alone, in pieces and threads as the stage
    takes them, blocks in memory: 128 cells along, all across. The best of seven each, sums set to zero included."""
    along, first = 128, 200
    spans = [(s, s + BLOCK + 1) for s in range(first, first + camera.cols + along, BLOCK)]
    blocks = [
        detector.correct(frames.block(a, b), calibration.dark, calibration.flat, camera.saturation) for a, b in spans
    ]
    # The ground of the middle frame's rows, a strip of cells that crosses all columns within these blocks.
    k = first + (camera.cols + along) // 2
    north, east = np.meshgrid(np.arange(along) - along / 2, np.arange(camera.rows) - camera.rows / 2, indexing="xy")
    pixel = HEIGHT * camera.pixel_pitch / camera.focal_length
    offset = np.stack([north, east, np.full_like(north, HEIGHT / pixel)], -1) * pixel
    turn = Rotation.from_matrix(ned_to_ecef_dcm(LATITUDE, LONGITUDE)) * Rotation.from_euler("Z", COURSE)
    points = poses.centre[k] + turn.apply(offset.reshape(-1, 3)).reshape(offset.shape)
    cells = np.ascontiguousarray(np.moveaxis(points, 2, 0))
    scale = camera.focal_length / camera.pixel_pitch
    pieces = [np.ascontiguousarray(cells[:, j : j + PIECE_CELLS]) for j in range(0, camera.rows, PIECE_CELLS)]
    memory = threading.local()

    def work(piece: np.ndarray) -> np.ndarray:
        if not hasattr(memory, "sums"):
            memory.sums = np.empty((*pieces[0].shape[1:], camera.cols, 2), np.float32)
        sums = memory.sums[: piece.shape[1]]
        sums[:] = 0.0
        for (a, b), block in zip(spans, blocks, strict=True):
            extraction.over_cells(
                block, piece, poses.centre[a:b], poses.dcm[a:b], scale,
                camera.principal_row, camera.principal_col, 0.0, sums,
            )  # fmt: skip
        return sums

    samples = sum(int((work(piece)[..., 1] > 0).sum()) for piece in pieces)  # and compiled
    times = []
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for _ in range(7):
            start = time.perf_counter(), time.process_time()
            list(pool.map(work, pieces))
            times.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    wall, cpu = np.min(times, axis=0)
    return samples / wall, samples / cpu


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--rows", type=int, default=256)
    parser.add_argument("--cols", type=int, default=320)
    parser.add_argument("--keep", type=Path, help="folder for frames and cube; default: a temporary one")
    a = parser.parse_args()
    camera = Camera(a.rows, a.cols, 15e-6, 0.07, (a.rows - 1) / 2, (a.cols - 1) / 2, RATE, 16383.0)
    interferometer = Interferometer(a.rows, a.cols, 2.05e-7, 40.0, 450e-9, 900e-9)
    table = np.linspace(1.0e6, 2.35e6, 601)
    calibration = Calibration(np.full((a.rows, a.cols), 100.0), np.ones((a.rows, a.cols)), table, np.full(601, 2e-3))
    wavenumber = interferometer.scored_wavenumbers(10_000.0)
    poses = flight(a.frames, camera.ground_sample(HEIGHT))
    with tempfile.TemporaryDirectory() as temporary, threadpool_limits(1):
        folder = a.keep or Path(temporary)
        folder.mkdir(exist_ok=True)
        path = folder / "frames.nc"
        if not path.exists():
            write_frames(path, a.frames, a.rows, a.cols)
        frames = Frames.from_file(path, a.rows, a.cols)
        rate, a_core = extraction_rate(frames, calibration, poses, camera)
        print(f"extraction alone: {rate / 1e6:.0f} M samples/s, {a_core / 1e6:.0f} M a second of processor time")
        start, cpu = time.perf_counter(), time.process_time()
        heights = np.zeros_like
        grid = mapping.line_grid(poses, camera, 0.0, mapping.MappingSettings())
        strips = mapping.run(
            frames,
            poses,
            lambda latitude, _: heights(latitude),
            grid,
            wavenumber,
            np.zeros(wavenumber.size),
            calibration,
            camera,
            interferometer,
            1,
        )
        width = line_width(SCORED_APODIZATION, interferometer.longest_opd)
        files = {
            "cube": folder / "cube.tif",
            "quicklook": folder / "quicklook.png",
            "location": folder / "location.tif",
        }
        seen = write_cube(
            CubeGrid(grid.crs, grid.affine, grid.shape, wavenumber, width),
            strips,
            lambda first, last: grid.places(first, last, lambda latitude, _: heights(latitude)),
            files,
        )
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        cells = grid.shape[0] * grid.shape[1]
        size = sum(file.stat().st_size for file in files.values())
    recorded = a.frames / RATE
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    print(
        f"{a.rows} × {a.cols} × {a.frames}: {cells} cells ({seen:.0%} seen) × {wavenumber.size} bands, "
        f"{size / 1e6:.0f} MB written, in {seconds:.1f} s ({cpu:.1f} s of processor time), "
        f"{recorded / seconds:.1f} × faster than recorded; "
        f"peak memory {memory:.2f} GB"
    )


if __name__ == "__main__":
    main()
