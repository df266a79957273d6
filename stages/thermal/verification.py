"""What is left of the bias in chamber runs the model has never seen: standard deviations and means of 100 s means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Chamber
from stages.thermal.binning import block_means
from stages.thermal.features import STEPS_PER_TIME_CONSTANT, stuck_thermometers
from stages.thermal.model import ThermalModel
from stages.thermal.network import BayesianRbf
from stages.thermal.targets import CHANNELS, bias_samples, refuse_motion, thinned
from tsmftis.inertial import DEG_PER_H, MICRO_G

Array = NDArray[np.float64]

FEWEST_BLOCKS = 10  # of which a standard deviation is still one


def verify_run(model: ThermalModel, chamber: Chamber, seconds: float) -> dict[str, Any]:
    """Means over `seconds` of one run (b blocks, six channels), SI: raw, left by each method, its sigma, temperature.

    `sigma` is that of a mean left by bayesian_rbf: of the function and of the noise the mean still has. `uncompensated` names the
    channels that are left as they are, and why: the chamber taught them nothing, or their thermometer stands still here.
    InputError where the run is too short for ten blocks, or of other thermometers than the model's.
    """
    where = f"chamber run {chamber.name}"
    stuck = stuck_thermometers(chamber.temperatures, model.minimum_span_k)
    chamber = thinned(chamber, seconds, model.smoothing_s / STEPS_PER_TIME_CONSTANT)
    refuse_motion(chamber, seconds)
    bias = bias_samples(chamber)
    features = model.features(chamber.temperatures, chamber.time, where)

    def means(values: Array) -> Array:
        return block_means(chamber.time, values, seconds)

    raw = means(bias)
    if len(raw) < FEWEST_BLOCKS:
        raise InputError(
            where,
            "duration",
            f"gives {len(raw)} blocks of {seconds:g} s where {FEWEST_BLOCKS} are needed for a standard deviation",
            "give a longer run, or a smaller thermal.verification_block_s",
        )
    why = {
        name: channel.refused or f"the {label} thermometer does not move in {where}"
        for name, channel, label in zip(CHANNELS, model.channels, stuck, strict=True)
        if channel.refused or label
    }
    remembered = model.remembered(chamber.temperatures, chamber.time) * [name not in why for name in CHANNELS]
    left, sigma, noise = {}, np.empty_like(raw), np.zeros(6)
    for method in model.methods or ("bayesian_rbf",):
        predicted = [
            c.untouched(len(f)) if name in why else c.predict(f, method)
            for name, c, f in zip(CHANNELS, model.channels, features, strict=True)
        ]
        left[method] = raw - means(remembered + np.column_stack([mean for mean, _ in predicted]))
        if method == "bayesian_rbf":
            for i, channel in enumerate(model.channels):
                network = channel.predictors.get(method)
                if CHANNELS[i] not in why and isinstance(network, BayesianRbf):
                    noise[i] = network.noise_of_mean(seconds / model.block_s)
            sigma = np.hypot(means(np.column_stack([s for _, s in predicted])), noise)
    distance = np.column_stack(
        [
            np.zeros(len(f)) if name in why else c.distance(f)
            for name, c, f in zip(CHANNELS, model.channels, features, strict=True)
        ]
    )
    temperature = np.column_stack([chamber.temperatures.gyro.mean(axis=2), chamber.temperatures.accel])
    on_time = np.column_stack([np.interp(chamber.time, chamber.temperatures.time, t) for t in temperature.T])
    return {
        "name": chamber.name,
        "time_s": means(chamber.time),
        "temperature_degc": means(on_time),
        "raw": raw,
        "left": left,
        "sigma": sigma,
        "distance": means(distance),
        "uncompensated": why,
    }


def verification_table(runs: Sequence[dict[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """Standard deviation and mean over all runs' means: gyro [deg/h], accelerometer [µg], for raw and each method.

    Standard deviations are about each run's own mean: what a unit is off by from one start to the next is no thermal error.
    """
    if not runs:
        return {}
    pooled: dict[str, Callable[[list[Array]], Array]] = {
        "std": lambda parts: np.vstack([p - p.mean(axis=0) for p in parts]).std(axis=0),
        "mean": lambda parts: np.vstack(parts).mean(axis=0),
    }
    table: dict[str, dict[str, list[float]]] = {}
    for kind, figure in pooled.items():
        gyro, accel = table.setdefault(f"gyro_{kind}_deg_per_h", {}), table.setdefault(f"accel_{kind}_ug", {})
        for method in ("raw", *runs[0]["left"]):
            values = figure([run["raw"] if method == "raw" else run["left"][method] for run in runs])
            gyro[method] = (values[:3] / DEG_PER_H).tolist()
            accel[method] = (values[3:] / MICRO_G).tolist()
    return table
