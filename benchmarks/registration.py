"""How far the tracks of each method are from the true ones, and what registration costs.

    python benchmarks/registration.py CAMPAIGN [CAMPAIGN ...]

A campaign's truth lies beside it in CAMPAIGN-truth. For every line and method: RMS of row and column [px] of the targets'
centres while they are on the detector, the same within 10 columns of its ends, and how many targets are followed over
97 % of the columns that they cross.
"""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.steps import Plan, navigation_step, thermal_step, tracking_step
from pipeline.records import CameraPoses, Tracks
from stages import registration
from tsmftis.camera import Camera

Array = NDArray[np.float64]

METHODS = ("nominal", "phase", "registration", "hybrid", "tracking")
ENDS = 10  # columns at either end of the detector
WHOLE = 0.97  # of the columns that a target crosses


def method(tracks: Tracks, name: str) -> Tracks:
    i = tracks.methods.index(name)
    return Tracks((name,), tracks.targets, tracks.row[[i]], tracks.col[[i]])


def crossed(col: Array, seen: NDArray[np.bool_]) -> int:
    """Columns that a centre crosses in the frames in which it is seen."""
    tenths = np.interp(np.arange(0, col.size - 1, 0.1), np.arange(col.size), col)
    return np.unique(np.rint(tenths[np.repeat(seen[1:] & seen[:-1], 10)])).size


def figures(found: Tracks, true: Tracks, camera: Camera) -> tuple[list[float], int]:
    """RMS [px] of row and column, on the detector and at its ends; how many targets are followed all over it."""
    (row, col), (true_row, true_col) = ((t.row[0, :, Tracks.CENTRE], t.col[0, :, Tracks.CENTRE]) for t in (found, true))
    on = (np.abs(true_row - (camera.rows - 1) / 2) < camera.rows / 2) & (
        np.abs(true_col - (camera.cols - 1) / 2) < camera.cols / 2
    )
    seen = on & np.isfinite(col)
    end = seen & (np.abs(true_col - (camera.cols - 1) / 2) > camera.cols / 2 - ENDS)
    errors = [float(np.sqrt(np.mean(e[where] ** 2))) for where in (seen, end) for e in (row - true_row, col - true_col)]
    whole = sum(crossed(c, s) >= WHOLE * crossed(c, o) for c, s, o in zip(true_col, seen, on, strict=True))
    return errors, whole


def main() -> None:
    print(f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}")
    for campaign in map(Path, sys.argv[1:]):
        with tempfile.TemporaryDirectory() as folder:
            plan = Plan(campaign, Path(folder), truth=campaign.with_name(campaign.name + "-truth"))
            keys, camera = plan.opened.keys, plan.opened.instrument.camera
            assert camera is not None
            if keys.thermal is not None:
                thermal_step(plan)
            for flight in keys.flights:
                navigation_step(plan, flight.id)
                for line in flight.lines:
                    tracking_step(plan, flight.id, line.id)
                    made = plan.out / flight.id / line.id
                    tracks = Tracks.from_file(made / "pos_tracks.nc")
                    frames = plan.opened.frames(flight.id, line.id)
                    start = time.perf_counter()
                    found = registration.run(
                        frames,
                        method(tracks, "tracking"),
                        method(tracks, "nominal"),
                        CameraPoses.from_file(made / "poses.nc"),
                        camera,
                        plan.settings.registration,
                    )
                    cost = (time.perf_counter() - start) / frames.time.size * 1e3
                    print(f"\n{campaign.name} {line.id}: {cost:.1f} ms a frame of {camera.rows} x {camera.cols}")
                    print("                row px  col px | ends row  col | followed")
                    everything = tracks.joined(found)
                    for name in METHODS:
                        errors, whole = figures(method(everything, name), method(tracks, "true"), camera)
                        row, col, end_row, end_col = (f"{e:6.3f}" for e in errors)
                        print(
                            f"  {name:12s}  {row}  {col} | {end_row} {end_col} | {whole} of {len(tracks.targets)}"
                            f"  {everything.notes.get(name, '')}"
                        )


if __name__ == "__main__":
    main()
