"""A real chamber log of a consumer unit: each branch (cooling, heating, cooling) predicted from the other two.

    python benchmarks/chamber_log.py FILE        tofupilot_imu_raw_data.csv (tab-separated, µs, gyro, accelerometer, temperature)

Printed is the RMS of what a method leaves of the held-out branch, 10 s means, over the three branches: gyros [rad/s],
accelerometers [m/s²], about the training branches' own level, so that nothing is fitted to what is held out.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.thermal import ThermalSettings
from stages.thermal.features import smoothed
from stages.thermal.targets import CHANNELS, block_means
from stages.thermal.training import fit_channel

Array = NDArray[np.float64]

USED = (150.0, 4180.0)  # s: before and after it the unit is handled
BLOCK, SMOOTHING = 10.0, 30.0
METHODS = ("polynomial", "rbf", "gaussian_process", "bayesian_rbf")
FEATURES = {"T": 1, "T, dT/dt": 2}


def read(path: Path) -> tuple[Array, Array, Array]:
    """Time (n,) [s], the six channels (n, 6), temperature (n,)."""
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream, delimiter="\t"))
    names = [f"imu.{sensor}.{axis}" for sensor in ("gyro", "acc") for axis in "xyz"]
    time = np.array([float(r["timestamp"]) for r in rows]) * 1e-6
    channels = np.array([[float(r[n]) for n in names] for r in rows])
    temperature = np.array([float(r["imu.temperature"]) for r in rows])
    time = time - time[0]
    inside = (time > USED[0]) & (time < USED[1])
    return time[inside], channels[inside], temperature[inside]


def branches(time: Array, temperature: Array) -> NDArray[np.int64]:
    """0, 1, 2: before the coldest, between the coldest and the hottest after it, and after that."""
    slow, _ = smoothed(time, temperature[:, None], time, 60.0)
    coldest = int(np.argmin(slow[:, 0]))
    hottest = coldest + int(np.argmax(slow[coldest:, 0]))
    return np.digitize(np.arange(time.size), [coldest, hottest])


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    time, channels, temperature = read(Path(sys.argv[1]))
    value, rate = smoothed(time, temperature[:, None], time, SMOOTHING)
    branch = branches(time, temperature)
    means = block_means(time, np.column_stack([channels, value, rate, branch]), BLOCK)
    targets, features, part = means[:, :6], means[:, 6:8], np.round(means[:, 8]).astype(int)
    spans = ", ".join(f"{value[branch == b][0, 0]:.0f} → {value[branch == b][-1, 0]:.0f} °C" for b in range(3))
    print(
        f"{len(targets)} means of {BLOCK:g} s; branches {spans}; held-out RMS (inside the training branches in brackets)"
    )
    print(f"  {'':<30}" + "".join(f"{name:>18}" for name in CHANNELS))
    level = []
    for b in range(3):
        level.append(targets[part == b] - targets[part != b].mean(axis=0))
    print(f"  {'no model':<30}" + "".join(f"{v:>18.4f}" for v in np.sqrt(np.mean(np.square(np.vstack(level)), axis=0))))
    for label, count in FEATURES.items():
        for method in METHODS:
            if method == "polynomial" and count > 1:
                continue
            left: list[list[Array]] = [[] for _ in CHANNELS]
            seen: list[list[Array]] = [[] for _ in CHANNELS]
            for b in range(3):
                train, held = part != b, part == b
                starts = np.diff(np.flatnonzero(train), prepend=-2) > 1
                settings = ThermalSettings(baselines=() if method == "bayesian_rbf" else (method,))
                for i in range(6):
                    model = fit_channel(features[train, :count], targets[train, i], starts, settings, True)
                    left[i].append(targets[held, i] - model.predict(features[held, :count], method)[0])
                    seen[i].append(targets[train, i] - model.predict(features[train, :count], method)[0])
            cells = [
                f"{np.sqrt(np.mean(np.square(np.concatenate(o)))):.4f} ({np.sqrt(np.mean(np.square(np.concatenate(s)))):.4f})"
                for o, s in zip(left, seen, strict=True)
            ]
            print(f"  {method + ' of ' + label:<30}" + "".join(f"{c:>18}" for c in cells))


if __name__ == "__main__":
    main()
