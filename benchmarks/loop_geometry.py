"""Certification of the loop's geometry stage on simulated lines: what it invents, what it finds, what it takes it for.

    python benchmarks/loop_geometry.py [--trials 40] [--lines 2] [--seed 1]

Two lines of 4 s at 22 and 38 °C, 24 control points and 40 pairs of frames each, 30 surveyed heights (`simulated_lines`). Sizes
are in sigma: the Cramér–Rao bound of the effect in that data set with all other candidates estimated, in the declared noise;
effects of several parameters get a random direction of that size. Printed: false alarms of clean lines, with the one-sided
95 % bound; at 4 and 8 sigma how often an effect is found, by its name or in its family, and how far off in sigma (RMS; the
estimated sigma over the bound); what is found of every pair of effects; with the effect out of the library (at 8 and 30 sigma),
how often a wrong name is forced, and what is answered. Figures: docs/closed-loop.md.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta
from simulated_lines import Flown, flown, settings_of

from pipeline.residual_problem import ResidualProblem
from stages import tracking
from stages.closed_loop import LoopResult, LoopSettings, run
from stages.closed_loop.signatures import derivatives
from stages.simulation import SimulationSettings

Array = NDArray[np.float64]
Names = list[tuple[str, str]]


def problem_of(made: Flown) -> ResidualProblem:
    problem = tracking.residual_problem(made.lines, made.camera, made.mounting, made.dem)  # type: ignore[arg-type]
    assert problem is not None
    return problem


def bound(problem: ResidualProblem) -> tuple[Names, Array]:
    """Parameters and their Cramér–Rao covariance."""
    names = [(c.effect, key) for c in problem.candidates for key in c.parameters]
    s = np.column_stack([derivatives(problem, {}, c, list(c.parameters)) for c in problem.candidates])
    length = np.linalg.norm(s, axis=0)
    return names, np.linalg.inv((s / length).T @ (s / length)) / np.outer(length, length)


def amount(effect: str, sigmas: float, names: Names, covariance: Array, rng: np.random.Generator) -> dict[str, float]:
    """A random direction of this size."""
    own = [i for i, (name, _) in enumerate(names) if name == effect]
    direction = rng.standard_normal(len(own))
    value = sigmas * np.linalg.cholesky(covariance[np.ix_(own, own)]) @ (direction / np.linalg.norm(direction))
    return {names[i][1]: float(v) for i, v in zip(own, value, strict=True)}


def answered(result: LoopResult) -> str:
    return ", ".join(s.effect for s in result.steps) or result.verdict


def upper(count: int, trials: int) -> float:
    """One-sided 95 % bound of a share."""
    return 1.0 if count == trials else float(beta.ppf(0.95, count + 1, trials - count))


def false_alarms(settings: SimulationSettings, trials: int, seed: int) -> None:
    said, started = Counter[str](), time.perf_counter()
    for trial in range(trials):
        problem = problem_of(flown(settings, seed + trial, {}))
        said[answered(run(problem, LoopSettings(), trial))] += 1
    wrong = trials - said["no_effect"] - said["unexplained"]
    print(
        f"clean: {wrong} of {trials} name something (≤ {upper(wrong, trials):.3f}), {said['unexplained']} unexplained; "
        f"{(time.perf_counter() - started) / trials:.2f} s a trial; {dict(said)}"
    )


def power(settings: SimulationSettings, effects: list[str], trials: int, seed: int, sizes: tuple[float, ...]) -> None:
    print(f"{'effect':26s} sigma | found  named family | error  sigma/bound | answers")
    own = [bound(problem_of(flown(settings, seed + trial, {}))) for trial in range(trials)]
    for effect in effects:
        for size in sizes:
            found, named, family, errors, ratios, said = 0, 0, 0, [], [], Counter[str]()
            for trial in range(trials):
                rng = np.random.default_rng([seed, trial])
                names, covariance = own[trial]
                true = amount(effect, size, names, covariance, rng)
                result = run(problem_of(flown(settings, seed + trial, {effect: true})), LoopSettings(), trial)
                said[answered(result)] += 1
                found += bool(result.steps)
                told = [s for s in result.steps if s.effect == effect]
                named += bool(told) and len(result.steps) == 1
                family += any(effect in (s.effect, *s.indistinguishable_from) for s in result.steps)
                for step in told:
                    for key, value in step.parameters.items():
                        errors.append((value.value - true[key]) / value.sigma)
                        i = names.index((effect, key))
                        ratios.append(value.sigma / float(np.sqrt(covariance[i, i])))
            off = f"{np.sqrt(np.mean(np.square(errors))):5.2f}  {np.median(ratios):11.2f}" if errors else " " * 18
            print(f"{effect:26s} {size:5.0f} | {found:5d} {named:6d} {family:6d} | {off} | {dict(said)}", flush=True)


def together(settings: SimulationSettings, effects: list[str], seed: int, size: float) -> None:
    """Every pair of effects, each of this size."""
    both = one = more = 0
    pairs = list(combinations(effects, 2))
    for trial, pair in enumerate(pairs):
        rng = np.random.default_rng([seed, trial])
        names, covariance = bound(problem_of(flown(settings, seed + trial, {})))
        true = {effect: amount(effect, size, names, covariance, rng) for effect in pair}
        result = run(problem_of(flown(settings, seed + trial, true)), LoopSettings(), trial)
        hits = sum(any(e in (s.effect, *s.indistinguishable_from) for s in result.steps) for e in pair)
        both, one, more = both + (hits == 2), one + (hits == 1), more + (len(result.steps) > 2)
        if hits < 2 or len(result.steps) > 2:
            print(f"  {' and '.join(pair)}: {answered(result)}", flush=True)
    print(
        f"two at once, {size:g} sigma each: both in {both} of {len(pairs)}, one in {one}, something beside them in {more}"
    )


def left_out(
    settings: SimulationSettings, effects: list[str], trials: int, seed: int, sizes: tuple[float, ...]
) -> None:
    print(f"{'out of the library':26s} sigma | wrong name | answers")
    own = [bound(problem_of(flown(settings, seed + trial, {}))) for trial in range(trials)]
    for effect in effects:
        for size in sizes:
            said: Counter[str] = Counter()
            wrong = 0
            for trial in range(trials):
                rng = np.random.default_rng([seed, trial])
                effects_of: Mapping[str, Mapping[str, float]] = {effect: amount(effect, size, *own[trial], rng)}
                problem = problem_of(flown(settings, seed + trial, effects_of))
                problem = replace(problem, candidates=tuple(c for c in problem.candidates if c.effect != effect))
                result = run(problem, LoopSettings(), trial)
                wrong += any(not s.effect.startswith("learned:") for s in result.steps)
                said[answered(result)] += 1
            print(f"{effect:26s} {size:5.0f} | {wrong:10d} | {dict(said)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--lines", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    settings = settings_of(given.lines, 4.0)
    effects = [c.effect for c in problem_of(flown(settings, given.seed, {})).candidates]
    some = max(given.trials // 4, 4)
    false_alarms(settings, given.trials, given.seed)
    power(settings, effects, some, given.seed, (4.0, 8.0))
    together(settings, effects, given.seed, 8.0)
    left_out(settings, effects, some, given.seed, (8.0, 30.0))


if __name__ == "__main__":
    main()
