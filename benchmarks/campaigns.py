"""Run campaigns with a known truth from scratch and print what the README states: scores, trajectory errors, time, memory.

    python benchmarks/campaigns.py CAMPAIGN [CAMPAIGN ...]

A campaign's truth lies beside it in CAMPAIGN-truth (`tsmftis simulate` writes one; so do the measured-data folders).
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import yaml

from pipeline.records import LADDER
from tsmftis.inertial import DEG_PER_H, MICRO_G
from tsmftis.rotation import rpy_to_dcm


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


def thermal_ratios(campaign: Path, truth: Path, run: dict[str, Any]) -> dict[str, list[float]]:
    """What each method leaves on the verification run over the sensors' noise floor (raw minus truth), 100 s means, six axes."""
    known = np.load(truth / "thermal.npz")
    ratios: dict[str, list[float]] = {}
    with xr.open_dataset(campaign / "chamber" / "verify.nc") as d:
        for sensor, key, unit in (("gyro", "gyro_std_deg_per_h", DEG_PER_H), ("accel", "accel_std_ug", MICRO_G)):
            noise = d[sensor].values - known[f"verify_{sensor}"]
            count = len(noise) // 100 * 100
            floor = noise[:count].reshape(-1, 100, 3).mean(axis=1).std(axis=0) / unit
            for method, left in run["thermal"]["verify"][key].items():
                ratios.setdefault(method, []).extend((np.array(left) / floor).tolist())
    return ratios


def withheld(campaign: Path, truth: Path, run: Path) -> str:
    """Misses of fixes that the campaign does not hold [m], at the antenna and instants where the run's model update has them."""
    lever = np.array(yaml.safe_load((campaign / "instrument.yaml").read_text())["mounting"]["imu_to_antenna_m"])
    update = json.loads((run / "run.json").read_text())["provenance"]["model_update"].get("effects", {})
    lever += [update.get("antenna_lever_arm", {}).get(axis, 0.0) for axis in "xyz"]
    fixes = np.load(truth / "withheld.npz")["gnss"]
    late = update.get("gnss_latency", {}).get("latency", 0.0)
    with xr.open_dataset(next(run.glob("*/trajectory.nc"))) as d:
        time = fixes[:, 0] - late
        north = np.deg2rad(fixes[:, 1] - np.interp(time, d.time, d.latitude)) * 6.36e6
        east = np.deg2rad(fixes[:, 2] - np.interp(time, d.time, d.longitude)) * 6.38e6 * np.cos(np.deg2rad(fixes[0, 1]))
        up = fixes[:, 3] - np.interp(time, d.time, d.height)
        at = np.searchsorted(d.time, time)
        arm = rpy_to_dcm(*(np.deg2rad(d[name].values[at]) for name in ("roll", "pitch", "yaw"))) @ lever
    north, east, up = north - arm[:, 0], east - arm[:, 1], up + arm[:, 2]
    horizontal = np.hypot(north, east)
    return (
        f"{time.size} withheld fixes: horizontal RMS {np.sqrt(np.mean(horizontal**2)):.3f} m (largest {horizontal.max():.3f}), "
        f"vertical {np.sqrt(np.mean(up**2)):.3f} m"
    )


def timed(command: list[str]) -> tuple[float, float]:
    """Seconds and peak memory [GB] of one process."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - started, usage.ru_maxrss / 1e6


def main() -> None:
    print(f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}")
    for campaign in map(Path, sys.argv[1:]):
        truth = campaign.with_name(campaign.name + "-truth")
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder)
            command = [str(Path(sys.executable).with_name("tsmftis")), "run", str(campaign), "--out", folder]
            if any(truth.glob("L*.npz")):
                command += ["--truth", str(truth)]
            seconds, memory = timed(command)
            run = json.loads((out / "run.json").read_text())
            print(f"\n{campaign.name}: {seconds:.0f} s from nothing, peak memory {memory:.2f} GB")
            for kind in ("rqe", "rqe_area"):
                for said, scores in (
                    (kind, run[kind]),
                    (f"{kind} by noise alone", run["noise_limit"][kind]),
                    (
                        f"{kind} of {len(run['high_gradient']['targets'])} high-gradient targets",
                        run["high_gradient"][kind],
                    ),
                ):
                    if scores:
                        print(f"  {said}: " + ", ".join(f"{m} {scores[m]:.4f}" for m in LADDER if m in scores))
            if (truth / "yardstick.json").exists():
                yard = json.loads((truth / "yardstick.json").read_text())
                means = ", ".join(f"{kind} {yard[kind]['mean']:.4f}" for kind in ("rqe", "rqe_area"))
                print(f"  true pose (independent program): {means}")
            if (truth / "trajectory.npz").exists():
                errors = trajectory_errors(truth, out)
                print("  trajectory inside the lines, RMS: " + ", ".join(f"{n} {v:.5f}" for n, v in errors.items()))
            if (truth / "thermal.npz").exists() and "thermal" in run:
                for method, ratios in thermal_ratios(campaign, truth, run).items():
                    print(f"  thermal, {method}: {', '.join(f'{r:.2f}' for r in ratios)} times the noise floor")
            if (truth / "withheld.npz").exists():
                print(f"  {withheld(campaign, truth, out)}")


if __name__ == "__main__":
    main()
