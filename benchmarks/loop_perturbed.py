"""The closed loop on campaigns whose declaration or data were changed by a known amount: is the answer true?

    python benchmarks/loop_perturbed.py CAMPAIGN --out DIR [--only NAME[&NAME] ...] [--list]

An undeclared effect is a difference between data and declaration. So a copy of a campaign with one declared number changed, or
with its data changed exactly, is a campaign whose undeclared effect is known and made by no model of this project. CAMPAIGN is
best one that a program from elsewhere made, or a measured one. The changes are in `perturbations.py`. Each copy goes through
`tsmftis close-loop`, starting from what the loop left of the campaign as it is: what an unchanged input made is not made again.

Measured, one block a copy: the verdict; each parameter found, its sigma, and how many sigmas it is off the truth; names that are
neither the truth's nor the campaign's own; truths that were not named; what they cannot be told from; figures on held-out data.
With a truth of nothing `learned:` and `unexplained` are right and a name is wrong. docs/closed-loop.md has the figures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from perturbations import (
    HYSTERESIS,
    Change,
    added,
    arm,
    campaign,
    dem_changed,
    east,
    edit,
    frames_changed,
    g_sensitive,
    halved,
    hysteretic,
    misaligned,
    no_velocity,
    one_reference,
    outlier_track,
    rows_moved,
    scaled,
    shifted,
    tilted_response,
    times,
    velocity_lag,
    warmer,
    without,
)

Truth = dict[str, dict[str, float]]

IMU, GNSS, LINES = (partial(edit, f"*/{name}.nc") for name in ("imu", "gnss", "L0?"))
NONLINEAR = partial(frames_changed, lambda s, _: s * (1 - 0.03 * s / 12000), False)
CUTS = {
    "no-lines": "lines", "chamber-only": "flights", "no-references": "references", "one-line": "second line",
    "no-dem": "dem",
}  # fmt: skip
DEG = 180 / np.pi
CASES: dict[str, tuple[list[Change], Truth]] = {
    "unperturbed": ([], {}),
    # effects that have a name
    **{f"arm-{axis}": ([arm(i, 0.15)], {"antenna_lever_arm": {axis: -0.15}}) for i, axis in enumerate("xyz")},
    **{
        f"gnss{ms:+d}ms": ([partial(GNSS, partial(shifted, ms / 1000))], {"gnss_latency": {"latency": ms / 1000}})
        for ms in (-200, -100, -60, -50, -20, 20, 50, 60, 100, 200)
    },
    "gyro-scale": ([partial(IMU, partial(scaled, "gyro", (0, 0, 2e-4)))], {"gyro_scale_factor": {"z": 2e-4}}),
    "accel-scale": ([partial(IMU, partial(scaled, "accel", (0, 0, 1e-3)))], {"accel_scale_factor": {"z": 1e-3}}),
    "gyro-g": ([partial(IMU, partial(g_sensitive, (0, 0, 5e-7)))], {"gyro_g_sensitivity": {"z": 5e-7}}),
    "gyro-g-chamber": (
        [partial(edit, glob, partial(g_sensitive, (0, 0, 5e-6))) for glob in ("*/imu.nc", "chamber/*.nc")],
        {"gyro_g_sensitivity": {"z": 5e-6}},
    ),
    "hysteresis": (
        [partial(edit, glob, hysteretic) for glob in ("*/imu.nc", "chamber/*.nc")],
        {"thermal_hysteresis": {"half_width": HYSTERESIS[1]} | {f"gyro.{a}": HYSTERESIS[0] for a in "xyz"}},
    ),
    "camera+4ms": ([partial(LINES, partial(shifted, 0.004))], {"camera_latency": {"latency": 0.004}}),
    **{
        f"boresight-{a}": ([added(f"mounting.boresight_deg.{a}", 5e-4 * DEG)], {"boresight": {a: -5e-4}})
        for a in ("roll", "pitch", "yaw")
    },
    "focal": ([times("camera.focal_length_m", 1.002)], {"focal_length": {"scale": 1 / 1.002 - 1}}),
    "k1": ([added("camera.radial_k1", 10.0)], {"radial_distortion": {"k1": -10.0}}),
    "dem+2m": ([partial(dem_changed, lambda h: h + 2, 0.0)], {"dem_bias": {"height": -2.0}}),
    "opd-scale": ([times("interferometer.opd_step_m", 1.0005)], {"opd_scale": {"scale": 1 / 1.0005 - 1}}),
    "opd-quadratic": ([added("interferometer.opd_quadratic_m", 1e-12)], {"opd_quadratic": {"quadratic": -1e-12}}),
    "tilt": ([added("interferometer.fringe_tilt_m_per_row", 3e-10)], {"fringe_tilt": {"tilt": -3e-10}}),
    "nonlinear": ([NONLINEAR], {"detector_nonlinearity": {"a": 0.03}}),
    "response": (
        [partial(edit, "calibration.nc", lambda d: d.assign(response=d.response * 1.05))],
        {"response_scale": {"scale": 1 / 1.05 - 1}},
    ),
    # too small for the declared sensors
    "gyro-scale-small": ([partial(IMU, partial(scaled, "gyro", (0, 0, 4e-6)))], {}),
    "accel-scale-small": ([partial(IMU, partial(scaled, "accel", (0, 0, 1.5e-5)))], {}),
    # effects that have no name
    "roll-drifts": ([partial(rows_moved, lambda t: np.floor((t - t[0]) / 1.5).astype(int), "L0?")], {}),
    "roll-differs": ([partial(rows_moved, lambda t: np.full(t.size, 2), "L02")], {}),
    "response-tilt": ([partial(edit, "calibration.nc", partial(tilted_response, 0.08))], {}),
    "one-panel": ([partial(edit, "references.nc", partial(one_reference, 1.1))], {}),
    "gyro-misaligned": ([partial(IMU, partial(misaligned, "gyro", 0, 2, 3e-4))], {}),
    "accel-misaligned": ([partial(IMU, partial(misaligned, "accel", 0, 1, 3e-3))], {}),
    "velocities-lag": ([partial(GNSS, partial(velocity_lag, 0.05))], {}),
    "datum-east": ([partial(GNSS, partial(east, 1.0))], {}),
    "dem-east": ([partial(dem_changed, None, 5.0)], {}),
    "gyro-noise": ([times("imu.gyro.angle_random_walk_deg_per_sqrt_h", 0.5)], {}),
    "outliers": ([outlier_track], {}),
    "thermometer": ([partial(IMU, partial(warmer, 3.0))], {}),
    # cut down
    "no-velocities": ([partial(GNSS, no_velocity)], {}),
    **{name: ([partial(campaign, partial(without, what))], {}) for name, what in CUTS.items()},
    **{f"gnss-{h}-half": ([partial(GNSS, partial(halved, h == "first"))], {}) for h in ("first", "second")},
}  # fmt: skip
COMBINED = (
    "arm-x&camera+4ms", "boresight-pitch&camera+4ms", "opd-scale&nonlinear", "gnss+60ms&opd-scale", "focal&k1", "arm-z&gnss-20ms",
    "hysteresis&boresight-roll", "gnss+100ms&gnss-first-half", "gnss+100ms&no-velocities",
)  # fmt: skip


def case(name: str) -> tuple[list[Change], Truth]:
    """The changes of one case, or of several with & between their names, and the truth."""
    cases = [CASES[one] for one in name.split("&")]
    return [change for changes, _ in cases for change in changes], {
        k: v for _, truth in cases for k, v in truth.items()
    }


def perturbed(source: Path, folder: Path, changes: list[Change]) -> None:
    """A copy of the campaign with the changes made to it."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    for path in folder.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    for change in changes:
        change(folder)


def against(step: dict[str, Any], known: dict[str, float] | None) -> list[str]:
    """The parameters of an effect, one a line, and how far off they are where the truth is known."""
    lines = []
    for key, found in step["parameters"].items():
        values, sigmas = np.atleast_1d(found["value"]), np.atleast_1d(found["sigma"])
        for i, (value, sigma) in enumerate(zip(values, sigmas, strict=True)):
            name = key if values.size == 1 else f"{key}.{'xyz'[i]}"
            line = f"    {name:<10} {value:+.4e} ± {sigma:.1e} {found['unit']}"
            if known is not None:
                true = known.get(name, 0.0)
                line += f"   truth {true:.4g}, {(value - true) / sigma:+.1f} sigma"
            lines.append(line)
    return lines


def said(loop: dict[str, Any], truth: Truth, own: set[str]) -> list[str]:
    """The answer, line by line, against the truth; `own` is what is found in the campaign as it is."""
    lines = [f"  {loop['verdict']}"]
    lines += [f"  not examined: {part} ({why})" for part, why in loop["not_examined"].items()]
    for step in loop["steps"]:
        name, rivals = step["effect"], step["indistinguishable_from"]
        wrong = name not in truth | dict.fromkeys(own) and not name.startswith("learned:")
        lines.append(f"  {'NOT TRUE: ' * wrong}{name}" + f", not told from {', '.join(rivals)}" * bool(rivals))
        lines += against(step, truth.get(name))
    named = {step["effect"] for step in loop["steps"]}
    lines += [f"  NOT NAMED: {name} {values}" for name, values in truth.items() if name not in named]
    for family in loop["not_identifiable"]:
        if set(family["effects"]) & set(truth):
            lines.append(f"  not identifiable in {family['part']}: {', '.join(family['effects'])}")
    for key, first in loop["before"].items():
        last = loop["after"].get(key, first)
        lines.append(f"  {key}: {np.round(first, 5)}" + f" -> {np.round(last, 5)}" * (last != first))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path)
    parser.add_argument("--out", type=Path, required="--list" not in sys.argv)
    parser.add_argument("--only", nargs="+", metavar="NAME[&NAME]", default=[*CASES, *COMBINED])
    parser.add_argument("--list", action="store_true")
    a = parser.parse_args()
    if unknown := [one for name in a.only for one in name.split("&") if one not in CASES]:
        parser.error(f"no such change: {', '.join(unknown)}; --list names them all")
    if a.list:
        print("\n".join(f"{name:<30} {case(name)[1] or 'no name'}" for name in a.only))
        return
    own: set[str] = set()
    for name in dict.fromkeys(["unperturbed", *a.only]):
        changes, truth = case(name)
        copy, out = a.out / "campaigns" / name, a.out / name
        perturbed(a.campaign, copy, changes)
        if not out.exists() and (a.out / "unperturbed").exists():
            shutil.copytree(a.out / "unperturbed", out)
        (out / "loop.json").unlink(missing_ok=True)
        begun = time.perf_counter()
        done = subprocess.run(
            ["tsmftis", "close-loop", copy, "--out", out], capture_output=True, text=True, check=False
        )
        print(f"{name}: truth {truth or 'no name'}   ({time.perf_counter() - begun:.0f} s)")
        if done.returncode:
            print("  " + (done.stdout + done.stderr)[-1500:])
        if (out / "loop.json").exists():
            loop = json.loads((out / "loop.json").read_text())
            own = own or {step["effect"] for step in loop["steps"] if name == "unperturbed"}
            print("\n".join(said(loop, truth, own)), flush=True)
        shutil.rmtree(copy)


if __name__ == "__main__":
    main()
