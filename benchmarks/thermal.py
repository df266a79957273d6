"""The thermal compensation measured on many simulated instruments that run through the paper's two chamber profiles.

    python benchmarks/thermal.py [COUNT] [PRESET]   residuals over the noise floor, coverage, seconds, by method (20, survey)
    python benchmarks/thermal.py runs CAMPAIGN ...  one chamber run, and the same cut into two that differ (truth beside it)

An instrument is drawn from a seed: thermometers' nodes, laws of the biases, scale factors. It is trained on the first profile and
judged on the second, and on a third that goes 20 °C beyond the first. The floor of a channel is the standard deviation of 100 s
means of its noise alone. Gaussian process and BayesianRidge are scikit-learn's on the same blocks and features. Seconds are those
of one instrument by itself, after the others.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import simulated
from numpy.typing import NDArray

from pipeline.records import Chamber, Temperatures
from stages import thermal
from stages.simulation import SimulationSettings, sensors
from stages.simulation.settings import AirProfile
from stages.thermal.binning import block_means
from stages.thermal.targets import bias_samples
from tsmftis.inertial import DEG_PER_H, MICRO_G
from tsmftis.simulator import effects
from tsmftis.simulator.streams import stream

Array = NDArray[np.float64]

WORKERS = 2
BLOCK = 100.0
UNITS = np.repeat([1.0 / DEG_PER_H, 1.0 / MICRO_G], 3)
BASELINES = ("polynomial", "multi_polynomial", "rbf", "gaussian_process", "bayesian_ridge")
# 20 °C beyond the training profile's −30 and 50 °C, both ways.
BEYOND = AirProfile.model_validate(
    {
        "start_degc": 20.0,
        "stages": [
            {"hold_min": 40.0},
            {"to_degc": 70.0, "rate_k_per_min": 2.0},
            {"hold_min": 60.0},
            {"to_degc": -50.0, "rate_k_per_min": 2.0},
            {"hold_min": 60.0},
        ],
    }
)


def instrument(seed: int, settings: SimulationSettings) -> dict[str, tuple[Chamber, Array]]:
    """Three runs of one instrument, each with its true bias (n, 6)."""
    unit = sensors.draw_sensors(settings, effects.complete({}), seed)
    profiles = {"train": settings.chamber.train, "verify": settings.chamber.verify, "beyond": BEYOND}
    out = {}
    for name, profile in profiles.items():
        run = sensors.record_chamber(settings, profile, unit, stream(seed, "chamber", name))
        out[name] = simulated.chamber(run, settings, name), np.hstack([run.gyro_bias, run.accel_bias])
    return out


def judge(seed: int, preset: str) -> dict[str, Any]:
    """By method and channel on `verify` and `beyond`: residual [°/h, µg] and its floor; coverage of 95 % intervals."""
    settings = SimulationSettings.preset(preset)
    runs = instrument(seed, settings)
    model = thermal.run([runs["train"][0]], [], thermal.ThermalSettings(baselines=BASELINES)).model
    out: dict[str, Any] = {}
    for name in ("verify", "beyond"):
        run, true = runs[name]
        shown = thermal.verify_run(model, run, BLOCK)
        left = {"raw": shown["raw"], **shown["left"]}
        covered = (np.abs(left["bayesian_rbf"]) < 1.96 * shown["sigma"]).mean(axis=0)
        floor = block_means(run.time, bias_samples(run) - true, BLOCK).std(axis=0)
        out[name] = {
            "left": {method: values.std(axis=0) * UNITS for method, values in left.items()},
            "floor": floor * UNITS,
            "covered": covered,
        }
    return out


def seconds(preset: str) -> dict[str, float]:
    """Median seconds of three fits of six channels, and of applying the model to 3 h 20 min, with nothing else running here."""
    train = instrument(0, SimulationSettings.preset(preset))["train"][0]
    flight = np.linspace(0.0, 12000.0, 12001)
    warm = 20.0 + 10.0 * np.sin(flight / 2000.0)
    readings = Temperatures(flight, np.tile(warm[:, None, None], (1, 3, 3)), np.tile(warm[:, None], (1, 3)))

    def fit(*baselines: str) -> thermal.ThermalModel:
        return thermal.run([train], [], thermal.ThermalSettings.model_validate({"baselines": baselines})).model

    model = fit()
    work: dict[str, Callable[[], Any]] = {
        "network": fit,
        "with the Gaussian process": lambda: fit("gaussian_process"),
        "apply": lambda: model.correction(readings),
    }
    found = {}
    for name, call in work.items():
        taken = []
        for _ in range(3):
            started = time.perf_counter()
            call()
            taken.append(time.perf_counter() - started)
        found[name] = float(np.median(taken))
    return found


def cut_runs(campaign: Path) -> None:
    """What the verification run keeps over its noise floor after training on one run, and on it cut into two that differ."""
    truth = campaign.with_name(campaign.name + "-truth") / "thermal.npz"
    train, verify = (Chamber.from_file(campaign / "chamber" / f"{n}.nc", n) for n in ("train", "verify"))
    with np.load(truth) as known:
        noise = np.hstack([verify.gyro - known["verify_gyro"], verify.accel - known["verify_accel"]])
    floor = block_means(verify.time, noise, BLOCK).std(axis=0)
    half = len(train.time) // 2
    step = np.array([0.05, -0.05, 0.025, 50.0, -50.0, 50.0]) / UNITS

    def part(of: slice, attitude: bool, off: float) -> Chamber:
        t = train.temperatures
        return replace(
            train,
            time=train.time[of],
            gyro=train.gyro[of] + off * step[:3],
            accel=train.accel[of] + off * step[3:],
            temperatures=Temperatures(t.time[of], t.gyro[of], t.accel[of]),
            attitude=train.attitude if attitude else None,
            temperature_chamber=None,
        )

    halves = (slice(0, half), slice(half, None))
    cases = {
        "one run": [train],
        "two halves": [part(of, True, 0.0) for of in halves],
        "the second off by 0.05 °/h, 50 µg": [part(of, True, float(i)) for i, of in enumerate(halves)],
        "two halves without attitude": [part(of, False, 0.0) for of in halves],
    }
    print(
        f"{campaign.name}: gyro x, y, z, accelerometer x, y, z over the floor; 95 % intervals about the run's mean hold"
    )
    for name, runs in cases.items():
        shown = thermal.run(runs, [verify], thermal.ThermalSettings(baselines=())).figures["verify"][0]
        left = shown["left"]["bayesian_rbf"]
        held = (np.abs(left - left.mean(axis=0)) < 1.96 * shown["sigma"]).mean()
        ratios = " ".join(f"{r:.2f}" for r in left.std(axis=0) / floor)
        print(f"  {name:<36}{ratios}  {held:.3f}")


def instruments(count: int, preset: str) -> None:
    with ProcessPoolExecutor(WORKERS) as pool:
        found = list(pool.map(partial(judge, preset=preset), range(count)))
    methods = list(found[0]["verify"]["left"])
    floor = np.array([f["verify"]["floor"] for f in found])
    by = {m: np.array([f["verify"]["left"][m] for f in found]) for m in methods}
    print(f"{count} instruments of the preset {preset}; what is left of 100 s means on the verification profile")
    print(
        f"  {'mean ± spread':<18}" + "".join(f"{n:>17}" for n in ("gyro x [°/h]", "y", "z", "accel x [µg]", "y", "z"))
    )
    for name, values in (("noise floor", floor), *by.items()):
        print(
            f"  {name:<18}"
            + "".join(f"{m:10.4g} ±{s:5.2g}" for m, s in zip(values.mean(0), values.std(0), strict=True))
        )
    print(f"  {'over the floor':<18}{'gyro: median':>14}{'95th':>8}{'accel: median':>16}{'95th':>8}")
    for method in methods:
        g, a = (by[method][:, part] / floor[:, part] for part in (slice(0, 3), slice(3, 6)))
        row = (np.median(g), np.percentile(g, 95), np.median(a), np.percentile(a, 95))
        print(f"  {method:<18}{row[0]:14.3f}{row[1]:8.3f}{row[2]:16.3f}{row[3]:8.3f}")
    for name, part in (("gyros", slice(0, 3)), ("accelerometers", slice(3, 6))):
        new, old, gp = (by[m][:, part].ravel() for m in ("bayesian_rbf", "rbf", "gaussian_process"))
        reduction, over = 1.0 - new / old, new / gp - 1.0
        low, high = np.percentile(reduction, [25, 75])
        print(
            f"  {name}: under the traditional RBF by {np.median(reduction):+.1%} (quartiles {low:+.1%}, {high:+.1%}),"
        )
        print(
            f"    over the Gaussian process by {np.median(over):+.1%} (95th percentile {np.percentile(over, 95):+.1%})"
        )
    for name in ("verify", "beyond"):
        covered = np.array([f[name]["covered"] for f in found])
        print(
            f"  95 % intervals hold on {name}: gyros {covered[:, :3].mean():.3f}, accelerometers {covered[:, 3:].mean():.3f}"
        )
    for name, value in seconds(preset).items():
        print(f"  seconds by itself, {name}: {value:.2f}")


def main() -> None:
    if sys.argv[1:2] == ["runs"]:
        for campaign in map(Path, sys.argv[2:]):
            cut_runs(campaign)
        return
    count, preset = (sys.argv[1:] + ["20", "survey"][len(sys.argv) - 1 :])[:2]
    instruments(int(count), preset)


if __name__ == "__main__":
    main()
