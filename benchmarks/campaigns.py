"""Run campaigns with a known truth from scratch and print what the README states: scores, trajectory errors, time, memory.

    python benchmarks/campaigns.py CAMPAIGN [CAMPAIGN ...]

A campaign's truth lies beside it in CAMPAIGN-truth (`tsmftis simulate` writes one; so do the measured-data folders).
"""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr


def trajectory_errors(truth: Path, run: Path) -> dict[str, float]:
    """RMS inside the lines: north, east, height [m], roll, pitch, yaw [°]."""
    known = np.load(truth / "trajectory.npz")
    lines = json.loads((truth / "truth.json").read_text())["lines"]
    inside = np.zeros(known["t"].size, bool)
    for line in lines.values():
        inside |= (known["t"] >= line["t0"]) & (known["t"] <= line["t1"])
    t, llh, ypr = known["t"][inside], known["llh"][inside], known["ypr"][inside]
    with xr.open_dataset(next(run.glob("*/trajectory.nc"))) as d:
        at = {n: np.interp(t, d.time.values, d[n].values) for n in ("latitude", "longitude", "height", "roll", "pitch")}
        yaw = np.interp(t, d.time.values, np.unwrap(np.deg2rad(d.yaw.values)))
    errors = {
        "north m": (np.deg2rad(at["latitude"]) - llh[:, 0]) * 6.36e6,
        "east m": (np.deg2rad(at["longitude"]) - llh[:, 1]) * 6.38e6 * np.cos(llh[:, 0]),
        "height m": at["height"] - llh[:, 2],
        "roll °": at["roll"] - np.rad2deg(ypr[:, 2]),
        "pitch °": at["pitch"] - np.rad2deg(ypr[:, 1]),
        "yaw °": np.rad2deg((yaw - ypr[:, 0] + np.pi) % (2 * np.pi) - np.pi),
    }
    return {name: float(np.sqrt(np.mean(e**2))) for name, e in errors.items()}


def main() -> None:
    print(f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}")
    for campaign in map(Path, sys.argv[1:]):
        truth = campaign.with_name(campaign.name + "-truth")
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            command = [Path(sys.executable).with_name("tsmftis"), "run", campaign, "--out", folder]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            seconds = time.perf_counter() - started
            # The largest of the runs so far: campaigns are best given from small to large.
            memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
            run = json.loads((Path(folder) / "run.json").read_text())
            print(f"\n{campaign.name}: {seconds:.0f} s from nothing, peak memory {memory:.2f} GB")
            for kind in ("rqe", "rqe_area"):
                print(f"  {kind}: " + ", ".join(f"{m} {v:.4f}" for m, v in run[kind].items()))
            if (truth / "yardstick.json").exists():
                yard = json.loads((truth / "yardstick.json").read_text())
                means = ", ".join(f"{kind} {yard[kind]['mean']:.4f}" for kind in ("rqe", "rqe_area"))
                print(f"  true pose (independent program): {means}")
            if (truth / "trajectory.npz").exists():
                errors = trajectory_errors(truth, Path(folder))
                print("  trajectory inside the lines, RMS: " + ", ".join(f"{n} {v:.5f}" for n, v in errors.items()))


if __name__ == "__main__":
    main()
