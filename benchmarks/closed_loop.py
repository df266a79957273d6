"""Certification of the closed loop on data whose truth is known: what it invents, what it finds, what it confuses.

    python benchmarks/closed_loop.py [--trials 100] [--samples 80] [--seed 1] [--part clean power missing gap]

A made-up instrument: six runs, attitude, rate, acceleration, temperature (up and down), row and column; a dozen candidate
effects, three of them not linear. Sizes are in sigma: of the parameter with everything else estimated, nuisance and all
candidates, in the true noise. Printed: false alarms a noise, power over size, whom an effect was taken for, what is answered if
the effect is not in the library, and the oracle gap (before − after)/(before − error with the true effect declared).
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.residual_problem import Candidate, Parameter, Parameters, ResidualProblem
from stages.closed_loop import LoopResult, LoopSettings, run

Array = NDArray[np.float64]

RUNS = 6
NOISES = ("white", "gauss-markov", "random-walk")
TAU, WALK = 15.0, 0.15  # samples; per sample, in white sigmas
SIZES = (2.0, 3.0, 4.0, 6.0, 8.0)


def play(temperature: Array, half_width: float) -> Array:
    """Backlash of the given half width, started at the first value."""
    out = np.empty_like(temperature)
    at = temperature[0]
    for i, t in enumerate(temperature):
        at = min(max(at, t - half_width), t + half_width)
        out[i] = at
    return out


def low_pass(x: Array, samples: float) -> Array:
    """First-order lag, started at the first value."""
    if samples <= 0.0:
        return x.copy()
    out, a = np.empty_like(x), np.exp(-1.0 / samples)
    out[0] = x[0]
    for i in range(1, x.size):
        out[i] = a * out[i - 1] + (1.0 - a) * x[i]
    return out


def wander(rng: np.random.Generator, n: int, tau: float) -> Array:
    """A smooth random curve of unit variance."""
    pad = int(6 * tau)
    kernel = np.exp(-0.5 * (np.arange(-pad, pad + 1) / tau) ** 2)
    x = np.convolve(rng.standard_normal(n + 2 * pad), kernel, "valid")
    return x / np.sqrt(np.sum(kernel**2))


@dataclass(frozen=True)
class World:
    """The made-up instrument's inputs, one array (n,) each, and its effects: name → (parameters → contribution (n,))."""

    inputs: Mapping[str, Array]
    series: NDArray[np.int64]
    clock: Array
    effects: Mapping[str, Callable[[Mapping[str, float]], Array]]
    candidates: Mapping[str, Candidate]
    nuisance: Array

    @property
    def size(self) -> int:
        return self.series.size


def make_world(seed: int, samples: int = 80) -> World:
    rng = np.random.default_rng(seed)
    inputs: dict[str, list[Array]] = {
        k: [] for k in ("attitude", "attitude_rate", "jerk", "speed", "acceleration", "temperature", "row", "column")
    }
    fine: list[Array] = []
    for run_number in range(RUNS):
        t = np.arange(samples)
        attitude = 6.0 * wander(rng, 10 * samples, 40.0)  # ten times as fine, so that a latency can shift it
        fine.append(attitude)
        slope = np.gradient(attitude) * 10.0
        inputs["attitude"].append(attitude[::10])
        inputs["attitude_rate"].append(slope[::10])
        inputs["jerk"].append((np.gradient(slope) * 10.0)[::10])
        inputs["speed"].append(1.0 + 0.5 * wander(rng, samples, 6.0))
        inputs["acceleration"].append(wander(rng, samples, 2.0))
        swing = 1.0 if run_number % 2 else -1.0
        inputs["temperature"].append(
            swing * np.sin(np.pi * (t / samples * 1.6 - 0.3)) + 0.1 * wander(rng, samples, 8.0)
        )
        inputs["row"].append(rng.uniform(-1.0, 1.0, samples))
        inputs["column"].append(rng.uniform(-1.0, 1.0, samples))
    x = {k: np.concatenate(v) for k, v in inputs.items()}
    temperatures = inputs["temperature"]
    grid = np.arange(10 * samples) / 10.0

    def shifted(p: Mapping[str, float]) -> Array:
        late = np.concatenate([np.interp(np.arange(samples) - p.get("latency", 0.0), grid, a) for a in fine])
        return late - x["attitude"]

    def hysteresis(p: Mapping[str, float]) -> Array:
        h = max(p.get("half_width", 0.0), 1e-6)
        return p.get("amplitude", 0.0) * np.concatenate([(play(t, h) - t) / h for t in temperatures])

    def lag(p: Mapping[str, float]) -> Array:
        return 8.0 * np.concatenate([low_pass(t, p.get("lag", 0.0)) - t for t in temperatures])

    def fringe(p: Mapping[str, float]) -> Array:
        return p.get("amplitude", 0.0) * np.sin(p.get("frequency", 0.0) * x["column"])

    def linear(**columns: Array) -> Callable[[Mapping[str, float]], Array]:
        return lambda p: sum((p.get(k, 0.0) * c for k, c in columns.items()), np.zeros(x["row"].size))

    effects: dict[str, Callable[[Mapping[str, float]], Array]] = {
        "latency": shifted,
        "hysteresis": hysteresis,
        "lag": lag,
        "fringe": fringe,
        "boresight": linear(a=x["attitude"], b=x["attitude"] * x["column"]),
        "flexure": linear(b=x["jerk"]),
        "scale": linear(k=x["speed"] * x["row"]),
        "g_sensitivity": linear(k=x["acceleration"]),
        "distortion": linear(k=x["column"] * (x["row"] ** 2 + x["column"] ** 2)),
        "tilt": linear(k=x["row"]),
        "quadratic": linear(k=x["column"] ** 2),
        "drift": linear(k=x["temperature"]),
    }
    one = {"unit": "1", "largest": 50.0, "plausible": 2.0}
    p = {k: Parameter(**one) for k in ("a", "b", "k", "amplitude")}  # type: ignore[arg-type]
    candidates = {
        "latency": Candidate("latency", {"latency": Parameter("sample", 10.0, plausible=1.0)}),
        "hysteresis": Candidate(
            "hysteresis",
            {"half_width": Parameter("K", 2.0, smallest=0.01, plausible=0.5), "amplitude": p["amplitude"]},
            tuple({"half_width": h} for h in (0.1, 0.2, 0.4, 0.8)),
        ),
        "lag": Candidate(
            "lag",
            {"lag": Parameter("sample", 60.0, smallest=0.0, plausible=5.0)},
            tuple({"lag": v} for v in (1.0, 4.0, 16.0)),
        ),
        "fringe": Candidate(
            "fringe",
            {"frequency": Parameter("rad", 40.0, smallest=3.0, step=1e-3), "amplitude": p["amplitude"]},
            tuple({"frequency": f} for f in np.arange(6.0, 20.0, 1.5)),
        ),
        "boresight": Candidate("boresight", {"a": p["a"], "b": p["b"]}),
        "flexure": Candidate("flexure", {"b": p["b"]}),
    }
    for name in ("scale", "g_sensitivity", "distortion", "tilt", "quadratic", "drift"):
        candidates[name] = Candidate(name, {"k": p["k"]})
    series = np.repeat(np.arange(RUNS), samples)
    nuisance = np.column_stack([np.ones(series.size), x["column"]])
    return World(x, series, np.tile(np.arange(samples) * 1.0, RUNS), effects, candidates, nuisance)


def covariance(world: World, noise: str) -> Array:
    """Dense K (n, n) of the noise; a random walk starts anywhere (variance 9) in every run."""
    t, same = world.clock, world.series[:, None] == world.series[None, :]
    k = np.eye(world.size)
    if noise == "gauss-markov":
        k += same * np.exp(-np.abs(t[:, None] - t[None, :]) / TAU)
    elif noise == "random-walk":
        k += same * (9.0 + WALK**2 * np.minimum(t[:, None], t[None, :]))
    return k


TYPICAL: Mapping[str, Mapping[str, float]] = {
    "latency": {"latency": 0.3},
    "hysteresis": {"half_width": 0.3, "amplitude": 0.5},
    "lag": {"lag": 3.0},
    "fringe": {"frequency": 11.3, "amplitude": 0.3},
    "boresight": {"a": 0.3, "b": 0.3},
}
STRENGTH = {"latency": "latency", "hysteresis": "amplitude", "lag": "lag", "fringe": "amplitude", "boresight": "a"}


def at_size(world: World, k: Array, effect: str, size: float) -> dict[str, float]:
    """Parameters at which the effect stands `size` sigma above the noise with nuisance and all others estimated."""
    typical = dict(TYPICAL.get(effect, {"k": 0.3, "b": 0.3}))
    typical = {n: v for n, v in typical.items() if n in world.candidates[effect].parameters}
    others = [world.nuisance]
    for name in world.candidates:
        if name != effect:
            given = {
                n: v
                for n, v in TYPICAL.get(name, {"k": 0.3, "b": 0.3}).items()
                if n in world.candidates[name].parameters
            }
            others.append(world.effects[name](given)[:, None])
    x = np.column_stack(others)
    inverse = np.linalg.inv(k)
    scaled = [n for n in typical if n not in ("half_width", "frequency")]
    for _ in range(6):  # a lag is not linear in its strength
        c = world.effects[effect](typical)
        left = c - x @ np.linalg.solve(x.T @ inverse @ x, x.T @ inverse @ c)
        now = float(np.sqrt(left @ inverse @ left))
        typical |= {n: typical[n] * size / now for n in scaled}
    return typical


def problem(
    world: World,
    truth: Mapping[str, Mapping[str, float]],
    k: Array,
    seed: int,
    without: Iterable[str] = (),
    covariates: Iterable[str] | None = None,
    **more: object,
) -> ResidualProblem:
    """Data of the world with the effects `truth` and noise of covariance K; the library lacks those of `without`."""
    rng = np.random.default_rng(seed)
    data = np.linalg.cholesky(k) @ rng.standard_normal(world.size)
    data = data + world.nuisance @ rng.normal(0.0, 2.0, world.nuisance.shape[1])
    for name, values in truth.items():
        data = data + world.effects[name](values)

    def residual(parameters: Parameters) -> Array:
        model = np.zeros(world.size)
        for name, values in parameters.items():
            model = model + world.effects[name](values)
        return data - model

    names = world.inputs if covariates is None else covariates
    return ResidualProblem(
        stage="made-up",
        residual=residual,
        candidates=tuple(c for name, c in world.candidates.items() if name not in set(without)),
        group=world.series,
        series=world.series,
        time=world.clock,
        nuisance=world.nuisance,
        covariates={name: world.inputs[name] for name in names},
        **more,  # type: ignore[arg-type]
    )


def names(result: LoopResult) -> list[str]:
    return [step.effect for step in result.steps]


def distance(world: World, truth: Mapping[str, Mapping[str, float]], found: Parameters) -> float:
    """RMS (n,) of the true contributions less those of the found parameters, nuisance taken out."""
    d = np.zeros(world.size)
    for name, values in truth.items():
        d += world.effects[name](values)
    for name, values in found.items():
        d -= world.effects[name](values)
    d -= world.nuisance @ np.linalg.lstsq(world.nuisance, d, rcond=None)[0]
    return float(np.sqrt(np.mean(d**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--samples", type=int, default=80, help="of each of six runs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise", nargs="*", default=list(NOISES))
    parser.add_argument("--part", nargs="*", default=["clean", "power", "missing", "gap"])
    a = parser.parse_args()
    settings = LoopSettings()
    worlds = [make_world(a.seed + i, a.samples) for i in range(8)]
    covariances = {n: [covariance(w, n) for w in worlds] for n in a.noise}
    all_effects = list(worlds[0].candidates)

    print(f"false alarms, {a.trials} clean data sets of {worlds[0].size} samples (allowed: 5 %)")
    for noise in a.noise if "clean" in a.part else ():
        begun, verdicts, wrong = time.perf_counter(), Counter[str](), Counter[str]()
        for i in range(a.trials):
            w = i % 8
            result = run(problem(worlds[w], {}, covariances[noise][w], 1000 + i), settings, i)
            verdicts[result.verdict] += 1
            wrong.update(names(result))
        spent = (time.perf_counter() - begun) / a.trials
        print(f"  {noise:<14}{dict(verdicts)}  {dict(wrong)}  {spent:.2f} s each", flush=True)

    print(f"\npower: the effect is named, and nothing else (its size in sigma); {a.trials} data sets a cell")
    print(f"  {'':<14}" + "".join(f"{s:>14g}" for s in SIZES))
    confusion: dict[str, Counter[str]] = {e: Counter() for e in all_effects}
    for noise in a.noise if "power" in a.part else ():
        cells = []
        for size in SIZES:
            hits = alone = 0
            for i in range(a.trials):
                w, effect = i % 8, all_effects[i % len(all_effects)]
                truth = {effect: at_size(worlds[w], covariances[noise][w], effect, size)}
                result = run(problem(worlds[w], truth, covariances[noise][w], 2000 + i), settings, i)
                found = names(result)
                told = [effect in (s.effect, *s.indistinguishable_from) for s in result.steps]
                hits += any(told)
                alone += any(told) and len(found) == 1
                if size >= 6.0:
                    confusion[effect].update(found or [f"({result.verdict})"])
            cells.append(f"{hits / a.trials:.2f} ({alone / a.trials:.2f})")
        print(f"  {noise:<14}" + "".join(f"{c:>14}" for c in cells), flush=True)

    print("\ntaken for (6 and 8 sigma, all noises)")
    for effect, counted in confusion.items():
        print(f"  {effect:<14}" + ", ".join(f"{n} {c}" for n, c in counted.most_common()))

    print(f"\nnot in the library, 15 sigma, {max(a.trials // 4, 12)} data sets a noise")
    for noise in a.noise if "missing" in a.part else ():
        answers: dict[str, Counter[str]] = {e: Counter() for e in all_effects}
        for i in range(max(a.trials // 4, 12)):
            w, effect = i % 8, all_effects[i % len(all_effects)]
            truth = {effect: at_size(worlds[w], covariances[noise][w], effect, 15.0)}
            result = run(problem(worlds[w], truth, covariances[noise][w], 3000 + i, without=[effect]), settings, i)
            answers[effect].update([" + ".join(names(result)) or result.verdict])
        for effect, counted in answers.items():
            print(f"  {noise:<14}{effect:<14}" + ", ".join(f"{n} {c}" for n, c in counted.most_common()), flush=True)

    print("\noracle gap, 8 sigma: (before − after)/(before − with the truth declared), median over trials")
    for noise in a.noise if "gap" in a.part else ():
        gaps = []
        for i in range(max(a.trials // 4, 12)):
            w, effect = i % 8, all_effects[i % len(all_effects)]
            truth = {effect: at_size(worlds[w], covariances[noise][w], effect, 8.0)}
            result = run(problem(worlds[w], truth, covariances[noise][w], 4000 + i), settings, i)
            gaps.append(1.0 - distance(worlds[w], truth, result.values) / distance(worlds[w], truth, {}))
        print(f"  {noise:<14}{np.median(gaps):.2f} (10 % of them under {np.quantile(gaps, 0.1):.2f})", flush=True)


if __name__ == "__main__":
    main()
