"""Certification of the thermal stage's part of the closed loop on simulated chamber runs whose truth is known.

    python benchmarks/loop_thermal.py [--trials 8] [--seed 1] [--noise white random-walk] [--size 4 8]

Units of the preset `survey` run through the paper's two chamber profiles; written by `tsmftis.simulator`, which shares
no model with the pipeline. Noise: white as the preset has it, and a random walk or a Gauss–Markov process of an hour on
top of every output. An effect's size is in its own sigma: of a gyro amplitude that all axes share, or of the lag, with
all else estimated (Cramér–Rao, in the true noise). Printed: false alarms on clean data with their one-sided 95 % bound,
what is found at each size, and what is answered if the effect is not in the library.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import simulated
from numpy.typing import NDArray
from scipy.stats import beta

from pipeline.records import Chamber
from pipeline.residual_problem import ResidualProblem
from stages.closed_loop import LoopResult, LoopSettings, run
from stages.closed_loop.noise import Layout, fit_noise, gram
from stages.closed_loop.score_test import project, solve
from stages.closed_loop.signatures import derivatives
from stages.simulation import SimulationSettings, sensors
from stages.thermal import ThermalSettings, residual_problem
from tsmftis.simulator import effects, inertial
from tsmftis.simulator.streams import stream

Array = NDArray[np.float64]

NOISES = ("white", "gauss-markov", "random-walk")
COLOUR_S = 3600.0
COLOUR = (
    0.05  # standard deviation of the coloured noise over that of the white noise of a second: half of a block's noise
)
WALK = 1.5e-3  # step of the walk in a second over the white noise of a second: an eighth of a block's noise in a block
HALF_WIDTH = 6.0
SETTINGS = SimulationSettings.preset("survey")


def unit(seed: int, lacking: Mapping[str, Any], noise: str) -> list[Chamber]:
    """Train and verify run of the unit of a seed."""
    made = sensors.draw_sensors(SETTINGS, effects.complete(lacking), seed)
    profiles = {"train": SETTINGS.chamber.train, "verify": SETTINGS.chamber.verify}
    return [
        coloured(
            simulated.chamber(
                sensors.record_chamber(SETTINGS, profile, made, stream(seed, "chamber", name)), SETTINGS, name
            ),
            noise,
            stream(seed, "colour", name),
        )
        for name, profile in profiles.items()
    ]


def coloured(run: Chamber, noise: str, rng: np.random.Generator) -> Chamber:
    """With coloured noise on top; sizes relative to the white noise, known from differences of successive samples."""
    if noise == "white":
        return run
    out = {}
    for name in ("gyro", "accel"):
        values = getattr(run, name)
        white = np.std(np.diff(values, axis=0), axis=0) / np.sqrt(2.0)
        if noise == "random-walk":
            extra = WALK * np.cumsum(rng.standard_normal(values.shape), axis=0)
        else:
            extra = inertial.gauss_markov(COLOUR, COLOUR_S, 1.0, len(values), rng)
        out[name] = values + white * extra
    return replace(run, **out)


def sigma_of(problem: ResidualProblem, effect: str) -> float:
    """Cramér–Rao sigma of the gyros' common amplitude [rad/s] with its half width, or of the lag [s]."""
    candidate = next(c for c in problem.candidates if c.effect == effect)
    names = tuple(n for n in candidate.parameters if n not in candidate.shared)
    if effect == "thermal_lag":
        s = derivatives(problem, {effect: {"lag": 0.0}}, candidate, names)
    else:
        gyros = [n for n in names if n.startswith("gyro.")]
        at = {effect: {"half_width": HALF_WIDTH, **{n: candidate.parameters[n].size for n in gyros}}}
        s = derivatives(problem, at, candidate, names)
        rest = [names.index(n) for n in names if n not in gyros]
        s = np.column_stack([sum(s[:, names.index(n)] for n in gyros), s[:, rest]])
    layout = Layout.of(problem, np.arange(problem.group.size))
    r, p = problem.residual({}), problem.nuisance.shape[1]
    noise = fit_noise(layout, problem.nuisance, r)
    m = project(gram(layout, noise, np.column_stack([problem.nuisance, s, r])), slice(0, p))
    return float(np.sqrt(solve(m, range(p, p + s.shape[1]))[1][0, 0]))


def lacking(effect: str, value: float) -> dict[str, Any]:
    if effect == "thermal_lag":
        return {effect: {"lag": value}}
    return {effect: {"half_width": HALF_WIDTH, "gyro": [value] * 3, "accel": [0.0] * 3}}


def looked_at(runs: Sequence[Chamber], seed: int, without: str = "") -> tuple[ResidualProblem, LoopResult]:
    problem = residual_problem(runs[:1], runs[1:], ThermalSettings())
    kept = replace(problem, candidates=tuple(c for c in problem.candidates if c.effect != without))
    return problem, run(kept, LoopSettings(), seed)


def answer(result: LoopResult) -> str:
    if not result.steps:
        return result.verdict
    return " + ".join("/".join((s.effect, *s.indistinguishable_from)) for s in result.steps)


def off(result: LoopResult, effect: str, value: float) -> float:
    """Worst error of the gyros' amplitudes and the half width, or of the lag, in their sigma."""
    for step in result.steps:
        if step.effect == effect:
            truth = {"lag": value, "half_width": HALF_WIDTH} | {f"gyro.{a}": value for a in "xyz"}
            return max(
                abs(v.value - truth[n]) / v.sigma for n, v in step.parameters.items() if n in truth and v.sigma > 0.0
            )
    return float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise", nargs="+", choices=NOISES, default=["white", "random-walk"])
    parser.add_argument("--size", nargs="+", type=float, default=[4.0, 8.0])
    parser.add_argument("--effect", nargs="+", default=["thermal_hysteresis", "thermal_lag"])
    parser.add_argument(
        "--only", nargs="+", choices=("clean", "power", "without"), default=["clean", "power", "without"]
    )
    a = parser.parse_args()
    seeds = range(a.seed, a.seed + a.trials)
    for noise in a.noise:
        begun, verdicts, sizes = time.perf_counter(), Counter[str](), {}
        for seed in seeds:
            problem, result = looked_at(unit(seed, {}, noise), seed)
            sizes[seed] = {e: sigma_of(problem, e) for e in a.effect}
            verdicts[answer(result)] += 1
        wrong = a.trials - verdicts["no_effect"] - verdicts["unexplained"]
        bound = float(beta.ppf(0.95, wrong + 1, a.trials - wrong)) if wrong < a.trials else 1.0
        spent = (time.perf_counter() - begun) / a.trials
        print(f"{noise}, clean: {dict(verdicts)}; {wrong} false, at most {bound:.2f}; {spent:.1f} s each", flush=True)
        for effect in a.effect:
            typical = np.median([s[effect] for s in sizes.values()])
            print(f"  {effect}: one sigma is {typical:.3g} (median)", flush=True)
            for size in a.size if "power" in a.only else ():
                counted: Counter[str] = Counter()
                named, errors = 0, []
                for seed in seeds:
                    value = size * sizes[seed][effect]
                    _, result = looked_at(unit(seed, lacking(effect, value), noise), seed)
                    counted[answer(result)] += 1
                    named += any(effect in (s.effect, *s.indistinguishable_from) for s in result.steps)
                    errors.append(off(result, effect, value))
                worst = np.nanmedian(errors) if np.isfinite(errors).any() else np.nan
                print(
                    f"    {size:g} sigma: named {named}/{a.trials}, worst parameter {worst:.1f} sigma off; {dict(counted)}",
                    flush=True,
                )
            if "without" in a.only:
                counted = Counter()
                for seed in seeds:
                    value = 15.0 * sizes[seed][effect]
                    _, result = looked_at(unit(seed, lacking(effect, value), noise), seed, without=effect)
                    counted[answer(result)] += 1
                print(f"    not in the library, 15 sigma: {dict(counted)}", flush=True)


if __name__ == "__main__":
    main()
