"""Certification of the closed loop on flights whose truth is known: what it invents, finds, confuses, and says without a name.

    python benchmarks/loop_navigation.py [--trials 20] [--clean 60] [--seed 1]

Flights of two minutes and a half with turns to both sides in gusts, fixes every half second, two grades of unit. An effect acts
on one axis, at multiples of its sigma with everything else estimated (Cramér–Rao; of a scale factor it holds the declared
scatter), not beyond what it can physically be. Printed: false alarms on clean flights with the one-sided 95 % bound, detection,
whom an effect was taken for, errors in sigma, what is found of every pair of effects, and what is answered when the effect is
not in the library.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import simulated
from numpy.typing import NDArray
from scipy.stats import beta
from simulated import LEVER, MEMS, RLG, Grade

from pipeline.records import Gnss, Imu
from pipeline.residual_problem import ResidualProblem
from stages.closed_loop import LoopResult, LoopSettings, run
from stages.closed_loop.signatures import derivatives
from stages.navigation import NavigationSettings, residual_problem
from tsmftis.camera import Mounting
from tsmftis.effects import EFFECTS, amounts
from tsmftis.simulator import flight, inertial

Array = NDArray[np.float64]
Effects = Mapping[str, Mapping[str, float]]

NAMES = ("antenna_lever_arm", "gnss_latency", "gyro_scale_factor", "accel_scale_factor", "gyro_g_sensitivity")
SIZES = (4.0, 8.0)
PAIR = 8.0  # sigma of each of two effects
WITHOUT = 15.0  # sigma of an effect that is not in the library
PATHS = 4
SPAN = 0.5  # s between fixes


@cache
def manoeuvres(seed: int, calm: bool = False) -> tuple[flight.Flight, Imu]:
    """About 150 s: straight, a right turn, straight, a left turn, straight; with perfect data."""
    legs = [
        flight.Leg(duration=30.0, climb=5.0),
        flight.Leg(turn=1.6, bank=0.4),
        flight.Leg(duration=25.0),
        flight.Leg(turn=-2.0, bank=0.45),
        flight.Leg(duration=25.0),
    ]
    craft = simulated.flown(legs, seed, calm=calm)
    return craft, simulated.ideal(craft, 200.0)


def recorded(
    grade: Grade, path: int, seed: int, effects: Effects, calm: bool = False
) -> tuple[Imu, Gnss, tuple[float, Array, Array]]:
    """What a unit of the grade with these effects and a receiver record, and the attitude that is handed over."""
    craft, perfect = manoeuvres(path, calm)
    rng = np.random.default_rng([47, seed])
    g, a = grade.model.gyro, grade.model.accel
    errors = inertial.UnitErrors(
        g.scale_factor_sigma * rng.standard_normal(3) + amounts(effects, "gyro_scale_factor"),
        a.scale_factor_sigma * rng.standard_normal(3) + amounts(effects, "accel_scale_factor"),
        np.array(amounts(effects, "gyro_g_sensitivity")),
    )
    imu = simulated.measured(perfect, grade.model, rng, errors)
    gnss = simulated.fixes(
        craft,
        float(imu.time[-1]) - 0.3,
        rng,
        lever=LEVER + amounts(effects, "antenna_lever_arm"),
        latency=amounts(effects, "gnss_latency")[0],
        interval=SPAN,
    )
    return imu, gnss, simulated.attitude_known_to(craft, grade.sigma_rpy, rng)


def problem(grade: Grade, path: int, seed: int, effects: Effects, calm: bool = False) -> ResidualProblem:
    imu, gnss, initial = recorded(grade, path, seed, effects, calm)
    return residual_problem(imu, gnss, grade.model, Mounting(LEVER), NavigationSettings(), initial=initial)


@cache
def sigmas(grade: Grade, path: int) -> dict[tuple[str, str], float]:
    """Cramér–Rao sigma of each parameter with all of them estimated, in white noise of the declared size."""
    p = problem(grade, path, 0, {})
    order = [(c.effect, name) for c in p.candidates for name in c.parameters]
    s = np.column_stack([derivatives(p, {}, c, tuple(c.parameters)) for c in p.candidates])
    scale = np.linalg.norm(s, axis=0)
    covariance = np.linalg.inv((s / scale).T @ (s / scale))
    return dict(zip(order, np.sqrt(np.diag(covariance)) / scale, strict=True))


def one_axis(grade: Grade, path: int, effect: str, trial: int, size: float) -> dict[str, dict[str, float]]:
    """The effect on one of its axes, positive or negative in turn, `size` sigma large; axes on which that is more than the effect
    can physically be are left out."""
    limits, sigma = EFFECTS[effect].largest, sigmas(grade, path)
    axes = [axis for axis in limits if max(SIZES) * sigma[effect, axis] < limits[axis]]
    axis = axes[trial % len(axes)]
    sign = 1.0 if (trial // len(axes)) % 2 == 0 else -1.0
    return {effect: {axis: sign * size * sigma[effect, axis]}}


def told(result: LoopResult, effect: str) -> bool:
    return any(effect in (s.effect, *s.indistinguishable_from) for s in result.steps)


def answer(result: LoopResult) -> str:
    return " + ".join(s.effect for s in result.steps) or result.verdict


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20, help="of each cell")
    parser.add_argument("--clean", type=int, default=60, help="clean flights of each grade")
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    settings, base = LoopSettings(), 10_000 * a.seed

    print("clean flights (allowed: 5 % additions)")
    added = count = 0
    for grade in (RLG, MEMS):
        verdicts, begun = Counter[str](), time.perf_counter()
        for i in range(a.clean):
            result = run(problem(grade, i % PATHS, base + i, {}), settings, i)
            verdicts[answer(result)] += 1
            added, count = added + bool(result.steps), count + 1
        print(f"  {grade.name:<6}{dict(verdicts)}, {(time.perf_counter() - begun) / a.clean:.1f} s each", flush=True)
    bound = 1.0 if added == count else float(beta.ppf(0.95, added + 1, count - added))
    print(f"  additions {added} of {count}: at most {bound:.1%} (one-sided 95 %)")

    print("\nfound, by its name or among indistinguishable_from (nothing else added); median |error|/sigma of the axis")
    print(f"  {'':<28}" + "".join(f"{s:>24g} sigma" for s in SIZES))
    taken: Counter[tuple[str, str]] = Counter()
    for grade in (RLG, MEMS):
        for effect in NAMES:
            cells = []
            for size in SIZES:
                hits = alone = 0
                off = []
                for i in range(a.trials):
                    path, seed = i % PATHS, base + 1000 + i
                    truth = one_axis(grade, path, effect, i, size)
                    result = run(problem(grade, path, seed, truth), settings, i)
                    hit = told(result, effect)
                    hits, alone = hits + hit, alone + (hit and len(result.steps) == 1)
                    taken[effect, answer(result)] += 1
                    for step in result.steps:
                        if step.effect == effect:
                            off += [
                                abs(step.parameters[n].value - v) / step.parameters[n].sigma
                                for n, v in truth[effect].items()
                            ]
                error = f"{np.median(off):.2f}" if off else "–"
                cells.append(f"{hits / a.trials:.2f} ({alone / a.trials:.2f})  {error}")
            print(f"  {grade.name:<6}{effect:<22}" + "".join(f"{c:>30}" for c in cells), flush=True)
    print("\ntaken for")
    for effect in NAMES:
        counted = sorted(((n, c) for (e, n), c in taken.items() if e == effect), key=lambda x: -x[1])
        print(f"  {effect:<22}" + ", ".join(f"{n} {c}" for n, c in counted))

    print(f"\ntwo at once, {PAIR:g} sigma each")
    pairs = list(combinations(NAMES, 2))
    both = one = more = 0
    for grade in (RLG, MEMS):
        for i, pair in enumerate(pairs * max(a.trials // 6, 1)):
            path = i % PATHS
            joint = one_axis(grade, path, pair[0], i, PAIR) | one_axis(grade, path, pair[1], i + 1, PAIR)
            result = run(problem(grade, path, base + 2000 + i, joint), settings, i)
            hits = sum(told(result, effect) for effect in pair)
            both, one, more = both + (hits == 2), one + (hits == 1), more + (len(result.steps) > 2)
            if hits < 2 or len(result.steps) > 2:
                print(f"  {grade.name:<6}{' and '.join(pair)}: {answer(result)}", flush=True)
    total = 2 * len(pairs) * max(a.trials // 6, 1)
    print(f"  both in {both} of {total}, one in {one}, something beside them in {more}", flush=True)

    print(f"\nnot in the library, {WITHOUT:g} sigma")
    for grade in (RLG, MEMS):
        for effect in NAMES:
            answers: Counter[str] = Counter()
            for i in range(max(a.trials // 2, 3)):
                path = i % PATHS
                p = problem(grade, path, base + 3000 + i, one_axis(grade, path, effect, i, WITHOUT))
                p = replace(p, candidates=tuple(c for c in p.candidates if c.effect != effect))
                answers[answer(run(p, settings, i))] += 1
            print(
                f"  {grade.name:<6}{effect:<22}" + ", ".join(f"{n} {c}" for n, c in answers.most_common()), flush=True
            )


if __name__ == "__main__":
    main()
