"""The closed loop on whole simulated campaigns: what it adds to clean ones, and whether it finds an undeclared effect.

    python benchmarks/loop_campaigns.py [--trials 20] [--seed 1] [--effect camera_latency latency=0.01]

Campaigns of `tiny_campaign.py`, one a seed, made by the simulator, which shares no model with the stages; all four parts are
looked at, in the order of processing and with what was found so far, as `tsmftis close-loop` does. Printed: verdicts and
additions a part, the share of campaigns and of parts with a false addition with its one-sided 95 % binomial bound, and for an
effect the found value over its sigma.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta
from tiny_campaign import tiny_campaign

from flows.loop.examine import examine_step
from flows.loop.problems import lines_of, parts_of
from flows.steps import Plan, navigation_step, thermal_step, tracking_step
from pipeline.errors import TsmftisError
from pipeline.model_update import ModelUpdate


def answers(campaign: Path, out: Path) -> dict[str, dict[str, Any]]:
    """Part → what examine says; effects found go into the models of what follows."""
    plan = Plan(campaign, out)
    found: dict[str, dict[str, Any]] = {}
    for part in parts_of(plan)[0]:
        if part.stage == "navigation":
            thermal_step(plan)
        if part.stage == "geometry":
            navigation_step(plan, "F1")
        if part.stage == "spectral":
            for flight, line in lines_of(plan):
                tracking_step(plan, flight, line)
        try:
            answer = examine_step(out, plan, part, 1).summary
        except TsmftisError as error:
            answer = {"verdict": f"failed: {error}", "steps": [], "effects": {}}
        found[part.name] = answer
        effects = {
            n: {k: tuple(v) if isinstance(v, list) else v for k, v in e.items()} for n, e in answer["effects"].items()
        }
        plan = replace(plan, update=ModelUpdate({**plan.update.effects, **effects}))
    return found


def bound(hits: int, trials: int) -> float:
    """One-sided 95 % upper bound of a share (Clopper–Pearson)."""
    return 1.0 if hits >= trials else float(beta.ppf(0.95, hits + 1, trials - hits))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--effect", nargs="+", metavar="NAME KEY=VALUE", help="an undeclared effect with its parameters"
    )
    a = parser.parse_args()
    effects: dict[str, dict[str, float]] = {}
    if a.effect:
        effects[a.effect[0]] = {k: float(v) for k, v in (pair.split("=") for pair in a.effect[1:])}
    verdicts: dict[str, Counter[str]] = {}
    false_parts = false_campaigns = parts = 0
    for seed in range(a.seed, a.seed + a.trials):
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            found = answers(tiny_campaign(Path(folder) / "tiny", seed, effects), Path(folder) / "out")
        said, wrong = [], 0
        for name, answer in found.items():
            steps = [s["effect"] for s in answer["steps"]]
            verdicts.setdefault(name, Counter())[" + ".join(steps) or answer["verdict"]] += 1
            wrong += any(s not in effects for s in steps)
            for step in answer["steps"]:
                values = [
                    f"{k} {np.round(v['value'], 8)} ± {np.round(v['sigma'], 8)}" for k, v in step["parameters"].items()
                ]
                said.append(f"{step['effect']} ({', '.join(values)})")
        parts, false_parts, false_campaigns = parts + len(found), false_parts + wrong, false_campaigns + (wrong > 0)
        print(f"seed {seed}: {'; '.join(said) or 'nothing added'}   ({time.perf_counter() - begun:.0f} s)", flush=True)
    for name, counted in verdicts.items():
        print(f"{name:<12}" + ", ".join(f"{n} {c}" for n, c in counted.most_common()))
    for what, hits, of in (("parts", false_parts, parts), ("campaigns", false_campaigns, a.trials)):
        print(f"{what} with a false addition: {hits} of {of} (at most {bound(hits, of):.1%} with 95 % confidence)")


if __name__ == "__main__":
    main()
