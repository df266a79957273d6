"""Thermal stage: chamber runs → a model of bias against temperature, verified on runs it has never seen.

run(train, verify, settings) → ThermalResult;   result.model.correction(temperatures) → what to take off a flight
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pipeline.errors import InputError
from pipeline.records import Chamber
from stages.thermal.model import ThermalModel
from stages.thermal.settings import ThermalSettings
from stages.thermal.training import fit_model
from stages.thermal.verification import verification_table, verify_run
from tsmftis.inertial import DEG_PER_H, MICRO_G

__all__ = ["DEG_PER_H", "MICRO_G", "ThermalModel", "ThermalResult", "ThermalSettings", "run", "verify", "verify_run"]


@dataclass(frozen=True)
class ThermalResult:
    """The model; the verification figures (empty without such runs); data for figures; what a reader must know.

    `figures["verify"]`: one table a run (see `verify_run`); `figures["training"]`: N, M, α, β, γ, widths a channel.
    """

    model: ThermalModel
    verification: dict[str, dict[str, list[float]]]
    figures: dict[str, Any]
    notes: list[str]


def run(train: Sequence[Chamber], verify: Sequence[Chamber], settings: ThermalSettings) -> ThermalResult:
    """Train on the chamber runs `train`, and see on `verify` what is left."""
    if not train:
        raise InputError(
            "campaign.yaml",
            "thermal.train",
            "names no chamber run",
            "name at least one, or leave 'thermal' out",
        )
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise InputError("settings", "thermal.device", "is 'cuda' where torch finds no such device", "set it to 'cpu'")
    model, table, notes = fit_model(train, settings)
    runs = [verify_run(model, chamber, settings.verification_block_s) for chamber in verify]
    return ThermalResult(model, verification_table(runs), {"training": table, "verify": runs}, notes)


def verify(model: ThermalModel, runs: Sequence[Chamber], block_s: float) -> dict[str, dict[str, list[float]]]:
    """Standard deviations of means over `block_s` [s] of what raw data and each method leave of runs: gyro [°/h], accel [µg]."""
    return verification_table([verify_run(model, chamber, block_s) for chamber in runs])
