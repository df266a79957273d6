"""The thermal compensation measured on many simulated instruments that run through the paper's two chamber profiles.

    python benchmarks/thermal.py [COUNT] [PRESET]   residuals over the noise floor, coverage, seconds, by method (20, survey)

An instrument is drawn from a seed: thermometers' nodes, laws of the biases, scale factors. It is trained on the first profile and
judged on the second, and on a third that goes 20 °C beyond the first. The floor of a channel is the standard deviation of 100 s
means of its noise alone. The Gaussian process is scikit-learn's, with a width for each feature, on the same blocks and features.
"""

from __future__ import annotations

import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from pipeline.records import Chamber, StaticAttitude, Temperatures
from stages import thermal
from stages.simulation import SimulationSettings, sensors
from stages.simulation.records import ChamberRun
from stages.simulation.settings import AirProfile
from stages.thermal.features import STEPS_PER_TIME_CONSTANT
from stages.thermal.network import BayesianRbf
from stages.thermal.targets import bias_samples, block_means, thinned
from stages.thermal.training import training_set
from tsmftis.simulator import effects
from tsmftis.simulator.streams import stream

Array = NDArray[np.float64]

WORKERS = 2
BLOCK = 100.0
METHODS = ("raw", "polynomial", "rbf", "bayesian_rbf", "gaussian_process")
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


def chamber(run: ChamberRun, settings: SimulationSettings, name: str) -> Chamber:
    """A simulated run as the pipeline's record."""
    place, r = settings.chamber, run.inertial
    angles = np.deg2rad([place.latitude_deg, place.roll_deg, place.pitch_deg, place.yaw_deg])
    return Chamber(
        name,
        r.time,
        r.gyro,
        r.accel,
        Temperatures(r.time, r.temperature_gyro, r.temperature_accel),
        StaticAttitude(angles[0], place.height_m, *map(float, angles[1:])),
        run.temperature_chamber,
    )


def instrument(seed: int, settings: SimulationSettings) -> dict[str, tuple[Chamber, Array]]:
    """Three runs of one instrument, each with its true bias (n, 6)."""
    unit = sensors.draw_sensors(settings, effects.complete({}), seed)
    profiles = {"train": settings.chamber.train, "verify": settings.chamber.verify, "beyond": BEYOND}
    out = {}
    for name, profile in profiles.items():
        run = sensors.record_chamber(settings, profile, unit, stream(seed, "chamber", name))
        out[name] = chamber(run, settings, name), np.hstack([run.gyro_bias, run.accel_bias])
    return out


def gaussian_process(features: Array, bias: Array) -> Any:
    """scikit-learn's, one width a feature, signal and noise by marginal likelihood, two restarts."""
    scale = float(bias.std())
    kernel = ConstantKernel(1.0, (1e-3, 1e4)) * RBF(np.ones(features.shape[1]), (0.05, 100.0)) + WhiteKernel(
        0.1, (1e-7, 10.0)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        gp = GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=0)
        return gp.fit(features, (bias - bias.mean()) / scale), float(bias.mean()), scale


def judge(seed: int, preset: str) -> dict[str, Any]:
    """Residual over floor by method and channel on `verify`, coverage of 95 % intervals on both, and seconds of fitting."""
    settings = SimulationSettings.preset(preset)
    runs = instrument(seed, settings)
    chosen = thermal.ThermalSettings()
    started = time.perf_counter()
    model = thermal.run([runs["train"][0]], [], chosen).model
    seconds = time.perf_counter() - started
    data = training_set([runs["train"][0]], chosen)
    started = time.perf_counter()
    processes = []
    for channel, features, bias in zip(model.channels, data.features, data.bias.T, strict=True):
        scaled = ((features - channel.mean) / channel.scale)[:, channel.used]
        processes.append(gaussian_process(scaled, bias))
    gp_seconds = time.perf_counter() - started
    out: dict[str, Any] = {"seconds": seconds, "gp_seconds": gp_seconds}
    for name in ("verify", "beyond"):
        run, true = runs[name]
        thin = thinned(run, BLOCK, chosen.smoothing_s / STEPS_PER_TIME_CONSTANT)
        # The run as it is, without noise: what each method leaves of it is its own error.
        clean = replace(run, gyro=run.gyro - bias_samples(run)[:, :3] + true[:, :3],
                        accel=run.accel - bias_samples(run)[:, 3:] + true[:, 3:])  # fmt: skip
        bias, exact = (
            bias_samples(thin),
            bias_samples(thinned(clean, BLOCK, chosen.smoothing_s / STEPS_PER_TIME_CONSTANT)),
        )
        features = model.features(thin.temperatures, thin.time)

        def means(values: Array, time_s: Array = thin.time) -> Array:
            return block_means(time_s, values, BLOCK)

        floor = means(bias - exact).std(axis=0)
        ratios, covered = {}, []
        for method in METHODS:
            predicted = np.zeros_like(bias)
            for i, (channel, f) in enumerate(zip(model.channels, features, strict=True)):
                if method == "gaussian_process":
                    gp, centre, scale = processes[i]
                    predicted[:, i] = centre + scale * gp.predict(((f - channel.mean) / channel.scale)[:, channel.used])
                elif method != "raw":
                    predicted[:, i], sigma = channel.predict(f, method)
                    if method == "bayesian_rbf":
                        network = channel.predictors[method]
                        assert isinstance(network, BayesianRbf)
                        noise = network.noise_of_mean(BLOCK / model.block_s)
                        total = np.hypot(means(sigma[:, None])[:, 0], noise)
                        left = means((bias[:, i] - predicted[:, i])[:, None])[:, 0]
                        covered.append(float((np.abs(left) < 1.96 * total).mean()))
            ratios[method] = means(bias - predicted).std(axis=0) / floor
        out[name] = {"ratios": ratios, "covered": covered, "floor": floor}
    return out


def instruments(count: int, preset: str) -> None:
    with ProcessPoolExecutor(WORKERS) as pool:
        found = list(pool.map(partial(judge, preset=preset), range(count)))
    print(f"{count} instruments of the preset {preset}: residual over noise floor on the verification profile")
    print(f"  {'':<18}{'gyro: median':>14}{'95th':>8}{'accel: median':>16}{'95th':>8}")
    by = {m: np.array([f["verify"]["ratios"][m] for f in found]) for m in METHODS}
    for method, ratio in by.items():
        g, a = ratio[:, :3].ravel(), ratio[:, 3:].ravel()
        print(
            f"  {method:<18}{np.median(g):14.3f}{np.percentile(g, 95):8.3f}{np.median(a):16.3f}{np.percentile(a, 95):8.3f}"
        )
    for name, part in (("gyros", slice(0, 3)), ("accelerometers", slice(3, 6))):
        new, old, gp = (by[m][:, part].ravel() for m in ("bayesian_rbf", "rbf", "gaussian_process"))
        reduction = 1.0 - new / old
        low, high = np.percentile(reduction, [25, 75])
        middle = np.median(reduction)
        print(
            f"  {name}: under the traditional RBF by {middle:+.1%} in the median (quartiles {low:+.1%}, {high:+.1%}),"
        )
        over = new / gp - 1.0
        print(
            f"    over the Gaussian process by {np.median(over):+.1%} (95th percentile {np.percentile(over, 95):+.1%})"
        )
    for name in ("verify", "beyond"):
        covered = np.array([f[name]["covered"] for f in found])
        print(
            f"  95 % intervals hold on {name}: gyros {covered[:, :3].mean():.3f}, accelerometers {covered[:, 3:].mean():.3f}"
        )
    print(
        f"  fitting six channels: {np.median([f['seconds'] for f in found]):.1f} s, six Gaussian processes "
        f"{np.median([f['gp_seconds'] for f in found]):.1f} s (two instruments at a time)"
    )


def main() -> None:
    count, preset = (sys.argv[1:] + ["20", "survey"][len(sys.argv) - 1 :])[:2]
    instruments(int(count), preset)


if __name__ == "__main__":
    main()
