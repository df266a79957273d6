"""The paper's Table 3: free-inertial error over 3 h 20 min after thermal compensation, traditional against Bayesian RBF.

    python benchmarks/free_inertial.py [INSTRUMENTS]        (20)

Each instrument is drawn from a seed: thermal laws, thermometers' nodes, scale factors. It runs through both chamber profiles
of the preset `survey` (the paper's), its network is trained on the first, and it flies for 3 h 20 min: outside air from 34 to
19 °C in a climb of 15 minutes, then lines to and fro at 2800 m. Fixes end with the climb; from there the path is inertial alone
but for its height. The flight is one of four, at 100 Hz; the error is the horizontal distance from the fixes. Each unit flies
twice: with biases that wander by 0.01 °/h and 50 µg beside the thermal law, as its data sheet declares, and without, so that
one sees what the thermal model alone decides.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import simulated
from numpy.typing import NDArray

from pipeline.records import Imu, Temperatures, ThermalCorrection
from stages import thermal
from stages.navigation import NavigationSettings, run
from stages.simulation import SimulationSettings, sensors
from tsmftis.camera import Mounting
from tsmftis.simulator import effects
from tsmftis.simulator import thermal as warmth
from tsmftis.simulator.streams import stream

Array = NDArray[np.float64]

WORKERS = 2
SECONDS, RATE = 12000.0, 100.0
ALIGNED = 900.0  # s: fixes end here
METHODS = ("none", "rbf", "bayesian_rbf", "true bias")
SETTINGS = SimulationSettings.preset("survey")
WANDERING = simulated.RLG.model
STEADY = replace(
    WANDERING, gyro=replace(WANDERING.gyro, bias_sigma=0.0), accel=replace(WANDERING.accel, bias_sigma=0.0)
)
UNITS = {"biases wander as declared": WANDERING, "thermal bias and noise alone": STEADY}


@cache
def flown(number: int) -> tuple[Any, Imu, Any]:
    """A flight, perfect inertial data, and fixes with their errors."""
    craft = simulated.racetrack(number, SECONDS)
    perfect = simulated.ideal(craft, RATE)
    stop = int(np.searchsorted(perfect.time, SECONDS))
    perfect = Imu(perfect.time[:stop], perfect.gyro[:stop], perfect.accel[:stop])
    gnss = simulated.fixes(craft, SECONDS - 1.0, np.random.default_rng([11, number]), interval=1.0)
    return craft, perfect, gnss


def one(seed: int) -> dict[tuple[str, str], tuple[float, float]]:
    """Errors after 1 h without fixes and at the end [nmi], by unit and method."""
    craft, perfect, gnss = flown(seed % 4)
    none = effects.complete({})
    unit = sensors.draw_sensors(SETTINGS, none, seed)
    chambers = [
        simulated.chamber(
            sensors.record_chamber(SETTINGS, profile, unit, stream(seed, "chamber", name)), SETTINGS, name
        )
        for name, profile in (("train", SETTINGS.chamber.train), ("verify", SETTINGS.chamber.verify))
    ]
    fitted = thermal.run(chambers[:1], chambers[1:], thermal.ThermalSettings())

    step = 1.0
    warm_time = np.arange(0.0, SECONDS + 2.0, step)
    air = warmth.piecewise(34.0, ((900.0, 19.0), (SECONDS, 19.0)), warm_time)
    true = warmth.settle(air, step, unit.nodes)
    biases = unit.biases(true)
    at = perfect.time - 0.5 / RATE
    gyro_bias, accel_bias = (np.stack([np.interp(at, warm_time, b) for b in bias.T], -1) for bias in biases)
    out: dict[tuple[str, str], tuple[float, float]] = {}
    for kind, model in UNITS.items():
        rng = np.random.default_rng([12, seed])
        noisy = simulated.measured(perfect, model, rng, unit.errors)
        imu = Imu(noisy.time, noisy.gyro + gyro_bias, noisy.accel + accel_bias)
        read = [warmth.thermometers(t, 0.02, 0.01, rng) for t in (true.gyro, true.accel)]
        temperatures = Temperatures(warm_time, *read)
        initial = simulated.attitude_known_to(craft, simulated.RLG.sigma_rpy, rng)
        settings = NavigationSettings(free_inertial_after_s=ALIGNED)
        for method in METHODS:
            correction = None
            if method == "true bias":
                zero = np.zeros_like(biases[0])
                correction = ThermalCorrection(warm_time, *biases, zero, zero, np.zeros((warm_time.size, 6)))
            elif method != "none":
                correction = fitted.model.correction(temperatures, method)
            quality = run(
                imu,
                gnss,
                simulated.RLG.model,
                Mounting(simulated.LEVER),
                settings,
                initial=initial,
                correction=correction,
            ).quality["free_inertial"]
            out[kind, method] = (quality["1h"]["error_nmi"], quality["end"]["error_nmi"])
    return out


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    with ProcessPoolExecutor(WORKERS) as pool:
        found = list(pool.map(one, range(count)))
    print(f"{count} instruments, free-inertial horizontal error [nmi]: RMS, median (10th, 90th percentile)")
    draws = np.random.default_rng(1).integers(0, count, (2000, count))
    for kind in UNITS:
        for k, when in enumerate(("after 1 h", f"at the end, {(SECONDS - ALIGNED) / 3600.0:.2f} h")):
            print(f"{kind}, {when}")
            by = {method: np.array([f[kind, method][k] for f in found]) for method in METHODS}
            for method, e in by.items():
                low, high = np.percentile(e, [10, 90])
                print(f"  {method:<14}{simulated.rms(e):7.3f} {np.median(e):7.3f} ({low:.3f}, {high:.3f})")
            old, new = by["rbf"] ** 2, by["bayesian_rbf"] ** 2
            whole = 1.0 - np.sqrt(new.mean() / old.mean())
            low, high = np.percentile(1.0 - np.sqrt(new[draws].mean(axis=1) / old[draws].mean(axis=1)), [2.5, 97.5])
            print(
                f"  Bayesian under traditional RBF, of the RMS: {whole:+.1%} (95 % by bootstrap {low:+.1%} to {high:+.1%})"
            )


if __name__ == "__main__":
    main()
