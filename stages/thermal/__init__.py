"""Thermal stage: chamber runs → a model of bias against temperature, verified on runs it has never seen.

run(train, verify, settings) → ThermalResult;   result.model.correction(temperatures) → what to take off a flight
verify_run(model, chamber, seconds) → what is left of one run;   verification_table(runs) → figures of several
residual_problem(train, verify, settings) → what the closed loop is offered
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pipeline.errors import InputError
from pipeline.records import Chamber
from stages.thermal.memory import Memory
from stages.thermal.model import ThermalModel
from stages.thermal.residual import residual_problem
from stages.thermal.settings import ThermalSettings
from stages.thermal.training import fit_model
from stages.thermal.verification import verification_table, verify_run

__all__ = [
    "ThermalModel",
    "ThermalResult",
    "ThermalSettings",
    "residual_problem",
    "run",
    "verification_table",
    "verify_run",
]


@dataclass(frozen=True)
class ThermalResult:
    """The model; the verification figures (empty without such runs); data for figures; what a reader must know.

    `figures["verify"]`: one table a run (see `verify_run`); `figures["training"]`: N, M, α, β, γ, widths, constant a channel.
    """

    model: ThermalModel
    verification: dict[str, dict[str, list[float]]]
    figures: dict[str, Any]
    notes: list[str]


def run(
    train: Sequence[Chamber],
    verify: Sequence[Chamber],
    settings: ThermalSettings,
    turn_on: tuple[float, float] | None = None,
    effects: Mapping[str, Mapping[str, Any]] | None = None,
) -> ThermalResult:
    """Train on the chamber runs `train`, and see on `verify` what is left.

    `turn_on`: the declared sigmas of what gyros [rad/s] and accelerometers [m/s²] are off by from one start to the next; several
    runs may differ by it, and a level far beyond it is warned of. `effects` of the stage thermal are what a model update adds;
    the model keeps them for every flight that it is applied to.
    """
    if not train:
        raise InputError(
            "campaign.yaml",
            "thermal.train",
            "names no chamber run",
            "name at least one, or leave 'thermal' out",
        )
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise InputError("settings", "thermal.device", "is 'cuda' where torch finds no such device", "set it to 'cpu'")
    model, table, notes = fit_model(train, settings, turn_on, Memory.of(effects or {}))
    runs = [verify_run(model, chamber, settings.verification_block_s) for chamber in verify]
    return ThermalResult(model, verification_table(runs), {"training": table, "verify": runs}, notes)
