"""What thermal compensation does for a flight whose truth is known: bias left, attitude, tracks, spectra.

    python benchmarks/thermal_flight.py CAMPAIGN [CAMPAIGN ...]

Runs each campaign without compensation, with the traditional RBF and with the network. True sensor error: means over 20 s
of the readings less what the true trajectory (CAMPAIGN-truth) gives, by splines; it holds turn-on bias, scale factors and noise
beside the thermal part, so its change about the flight's mean is shown too. Tracks are held against those of the true poses.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr
from campaigns import trajectory_errors
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pipeline.campaign import read_campaign
from pipeline.records import Imu
from stages.thermal.binning import block_means
from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm, normal_gravity
from tsmftis.inertial import DEG_PER_H, MICRO_G
from tsmftis.rotation import log_so3, rpy_to_dcm

Array = NDArray[np.float64]

METHODS = ("none", "rbf", "bayesian_rbf")
WINDOW = 20.0
EARTH = np.array([0.0, 0.0, 7.292115e-5])
UNITS = np.repeat([1.0 / DEG_PER_H, 1.0 / MICRO_G], 3)


def true_readings(truth: Path, imu_to_body: Array, time: Array) -> Array:
    """What a perfect unit reads (n, 6) at times (n,): rate from the true attitude's steps, specific force from the position."""
    known = np.load(truth / "trajectory.npz")
    t = known["t"]
    position = CubicSpline(t, geodetic_to_ecef(*known["llh"].T))
    body = rpy_to_dcm(*known["ypr"][:, ::-1].T)
    dcm = ned_to_ecef_dcm(*known["llh"][:, :2].T) @ body @ imu_to_body
    steps = log_so3(np.swapaxes(dcm[:-1], -1, -2) @ dcm[1:]) / np.diff(t)[:, None]
    turned = CubicSpline(t, np.vstack([np.zeros(3), np.cumsum(steps * np.diff(t)[:, None], axis=0)]))
    at = CubicSpline(t, dcm.reshape(-1, 9))(time).reshape(-1, 3, 3)
    latitude, height = (np.interp(time, t, known["llh"][:, i]) for i in (0, 2))
    longitude = np.interp(time, t, known["llh"][:, 1])
    gravity = ned_to_ecef_dcm(latitude, longitude)[:, :, 2] * normal_gravity(latitude, height)[:, None]
    force = position(time, 2) + 2.0 * np.cross(EARTH, position(time, 1)) - gravity
    return np.hstack([turned(time, 1) + EARTH @ at, np.einsum("nji,nj->ni", at, force)])


def windows(time: Array, values: Array) -> Array:
    """Means over 20 s (b, 6)."""
    return block_means(time, values, WINDOW)


def pixels(run: Path, detector: tuple[int, int]) -> Array:
    """RMS of (row, col) of `tracking` less `true`, of centres on the detector, over all lines."""
    off = []
    for path in run.glob("*/*/tracks.nc"):
        with xr.open_dataset(path) as d:
            true, ours = (
                np.stack([d.row.sel({"method": m}), d.col.sel({"method": m})], -1) for m in ("true", "tracking")
            )
        on = ((true >= 0.0) & (true <= np.array(detector) - 1.0)).all(-1) & np.isfinite(ours).all(-1)
        off.append((ours - true)[on])
    return np.sqrt((np.vstack(off) ** 2).mean(axis=0))


def main() -> None:
    tool = str(Path(sys.executable).with_name("tsmftis"))
    for campaign in map(Path, sys.argv[1:]):
        truth = campaign.with_name(campaign.name + "-truth")
        opened = read_campaign(campaign)
        assert opened.instrument.mounting is not None
        flight, camera = opened.keys.flights[0].id, opened.instrument.camera
        assert camera is not None
        detector = (camera.rows, camera.cols)
        imu: Imu = opened.imu(flight)
        known = np.load(truth / "trajectory.npz")["t"]
        inside = (imu.time > known[0] + 1.0) & (imu.time < known[-1] - 1.0)
        # A reading is the mean over the interval that ends at its stamp.
        middle = imu.time[inside] - 0.5 * float(np.median(np.diff(imu.time)))
        error = np.hstack([imu.gyro, imu.accel])[inside] - true_readings(
            truth, rpy_to_dcm(*opened.instrument.mounting.imu_to_body), middle
        )
        print(f"\n{campaign.name}, {imu.time[-1] - imu.time[0]:.0f} s")
        for method in METHODS:
            with tempfile.TemporaryDirectory() as folder:
                command = [tool, "run", str(campaign), "--out", folder, "--truth", str(truth)]
                subprocess.run([*command, "--set", f"thermal.method={method}"], check=True, capture_output=True)
                out = Path(folder)
                left, sigma = error, np.zeros((1, 6))
                if method != "none":
                    with xr.open_dataset(out / flight / "thermal.nc") as d:
                        bias, sigma = (np.hstack([d[f"{p}gyro"].values, d[f"{p}accel"].values]) for p in ("", "sigma_"))
                        left = error - np.stack([np.interp(middle, d.time.values, b) for b in bias.T], -1)
                means = windows(middle, left) * UNITS
                run = json.loads((out / "run.json").read_text())
                errors = trajectory_errors(truth, out)
                print(f"  {method}")
                for name, part, unit in (("gyro", slice(0, 3), "°/h"), ("accelerometer", slice(3, 6), "µg")):
                    mean, change = means.mean(axis=0)[part], means.std(axis=0)[part]
                    said = np.sqrt((sigma**2).mean(axis=0))[part] * UNITS[part]
                    print(
                        f"    {name} [{unit}], x y z: mean {mean.round(3)}, change of {WINDOW:g} s means {change.round(3)}, "
                        f"sigma of the correction {said.round(3)}"
                    )
                print("    trajectory, RMS: " + ", ".join(f"{n} {v:.5f}" for n, v in errors.items()))
                print(f"    tracks off the true ones, RMS: {pixels(out, detector).round(3)} px (row, col)")
                for kind in ("rqe", "rqe_area"):
                    print(f"    {kind}: " + ", ".join(f"{m} {run[kind][m]:.5f}" for m in ("tracking", "true")))


if __name__ == "__main__":
    main()
