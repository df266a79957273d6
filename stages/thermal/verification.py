"""What is left of the bias in chamber runs the model has never seen: standard deviations of 100 s means."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Chamber
from stages.thermal.features import STEPS_PER_TIME_CONSTANT
from stages.thermal.model import ThermalModel
from stages.thermal.network import BayesianRbf
from stages.thermal.targets import bias_samples, block_means, refuse_motion, thinned
from tsmftis.inertial import DEG_PER_H, MICRO_G

Array = NDArray[np.float64]


def verify_run(model: ThermalModel, chamber: Chamber, seconds: float) -> dict[str, Any]:
    """Means over `seconds` of one run (b blocks, six channels), SI: raw, left by each method, its sigma, temperature.

    `sigma` is that of a mean left by bayesian_rbf: of the function and of the noise the mean still has.
    """
    chamber = thinned(chamber, seconds, model.smoothing_s / STEPS_PER_TIME_CONSTANT)
    refuse_motion(chamber, seconds)
    bias = bias_samples(chamber)
    features = model.features(chamber.temperatures, chamber.time)

    def means(values: Array) -> Array:
        return block_means(chamber.time, values, seconds)

    raw = means(bias)
    left = {}
    sigma = np.empty_like(raw)
    for method in model.methods:
        predicted = [c.predict(f, method) for c, f in zip(model.channels, features, strict=True)]
        left[method] = raw - means(np.column_stack([mean for mean, _ in predicted]))
        if method == "bayesian_rbf":
            function = means(np.column_stack([s for _, s in predicted]))
            networks = [c.predictors.get(method) for c in model.channels]
            blocks = seconds / model.block_s
            noise = np.array([n.noise_of_mean(blocks) if isinstance(n, BayesianRbf) else 0.0 for n in networks])
            sigma = np.hypot(function, noise)
    temperature = np.column_stack([chamber.temperatures.gyro.mean(axis=2), chamber.temperatures.accel])
    on_time = np.column_stack([np.interp(chamber.time, chamber.temperatures.time, t) for t in temperature.T])
    return {
        "name": chamber.name,
        "time_s": means(chamber.time[:, None])[:, 0],
        "temperature_degc": means(on_time),
        "raw": raw,
        "left": left,
        "sigma": sigma,
        "distance": means(np.column_stack([c.distance(f) for c, f in zip(model.channels, features, strict=True)])),
    }


def verification_table(runs: Sequence[dict[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """Standard deviations over all runs' means: gyro [deg/h], accelerometer [µg], for raw and each method."""
    if not runs:
        return {}
    table: dict[str, dict[str, list[float]]] = {"gyro_std_deg_per_h": {}, "accel_std_ug": {}}
    for method in ("raw", *runs[0]["left"]):
        left = np.vstack([run["raw"] if method == "raw" else run["left"][method] for run in runs])
        deviation = left.std(axis=0)
        table["gyro_std_deg_per_h"][method] = (deviation[:3] / DEG_PER_H).tolist()
        table["accel_std_ug"][method] = (deviation[3:] / MICRO_G).tolist()
    return table
