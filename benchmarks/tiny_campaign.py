"""A small simulated campaign that is made in seconds: for tests of the command line, and for trials of the closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from stages import simulation


def tiny_campaign(folder: Path, seed: int, effects: Mapping[str, Mapping[str, float]]) -> Path:
    """The demo preset cut down: 68 s of flight with a turn, two lines of 2 s with two panels, 48 × 64 pixels; with undeclared
    `effects`. Written into `folder`, its truth beside it."""
    preset = simulation.SimulationSettings.preset("demo").model_dump()
    preset["name"] = "tiny"
    preset["effects"] = dict(effects)
    preset["instrument"]["imu"]["rate_hz"] = 100.0
    preset["instrument"]["camera"] |= {"rows": 48, "cols": 64, "principal_point_px": {"row": 23.8, "col": 31.1}}
    preset["instrument"]["interferometer"]["zpd_col"] = 12.0
    preset["flight"]["legs"] = [{"straight_s": 25.0}, {"turn_deg": 60.0, "bank_deg": 26.0}, {"straight_s": 25.0}]
    preset["lines"] = [
        {"id": "L01", "start_s": 15.0, "duration_s": 2.0, "panels": ["white", "red"]},
        {"id": "L02", "start_s": 60.0, "duration_s": 2.0, "panels": ["grey", "holmium"]},
    ]
    preset["scene"] |= {"panel_margin_m": 12.0, "panel_scatter_m": 0.5, "cell_m": 0.5}
    preset["terrain"]["margin_m"] = 40.0
    preset["gcps"]["per_line"] = 6
    for name in ("train", "verify"):
        preset["chamber"][name]["stages"] = [
            {"hold_min": 5.0},
            {"to_degc": 40.0, "rate_k_per_min": 2.0},
            {"hold_min": 5.0},
            {"to_degc": 0.0, "rate_k_per_min": 3.0},
        ]
    simulation.write(simulation.run(simulation.SimulationSettings.model_validate(preset), seed), folder)
    return folder
