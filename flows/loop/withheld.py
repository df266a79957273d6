"""What effects of navigation's model are worth on fixes that neither path nor effects have seen.

Functions
---------
withheld_m    misses of withheld fixes without the effects and with them
size          a single figure of them
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flows.loop.problems import Part, flight_of, problem_of, receivers_of
from flows.steps import Plan
from pipeline.errors import TsmftisError
from pipeline.model_update import ModelUpdate
from pipeline.residual_problem import Parameters
from stages import closed_loop, navigation

WITHHELD_S = (30.0, 5.0)
Misses = tuple[list[float], list[float]]


def withheld_m(plan: Plan, effects: Parameters) -> Misses | None:
    """RMS of the smoothed antenna's misses [m] before and after (then with what is known of the receivers, too), horizontal and
    vertical, over the fixes of all flights; None where none could be withheld, or too few are left for the effects.

    `effects` by their scalar names, none of them in the update of `plan`.
    """
    settings = plan.settings.navigation.model_copy(update={"withhold_every_s": WITHHELD_S})
    plan = replace(plan, settings=plan.settings.model_copy(update={"navigation": settings}))
    try:
        problem = problem_of(plan, Part("navigation"))
    except TsmftisError:
        return None
    found = closed_loop.refit(problem, {n: dict(v) for n, v in effects.items()}) if effects else {}
    lag = ModelUpdate(receiver=receivers_of(problem)).velocity_lag
    missed = []
    for model, late in (({}, False), (found, True)):
        squares, fixes = np.zeros(2), 0
        for flight in plan.opened.keys.flights:
            try:
                given = flight_of(plan, flight.id) | {"velocity_lag": lag(flight.id) if late else 0.0}
                one = navigation.run(**given, effects=model).quality["withheld"]
            except TsmftisError:  # a flight that the problem leaves out, and says so
                continue
            if one["fixes"]:
                fixes += one["fixes"]
                squares += one["fixes"] * np.array([one["horizontal_rms_m"], one["vertical_rms_m"]]) ** 2
        if not fixes:
            return None
        missed.append(np.sqrt(squares / fixes).tolist())
    return missed[0], missed[1]


def size(missed: Sequence[float]) -> float:
    """Geometric mean of horizontal and vertical misses [m]: neither hides the other."""
    return math.sqrt(math.prod(missed))
