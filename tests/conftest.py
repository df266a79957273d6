"""What many tests share: a tiny simulated campaign, its run, and the command line in this process."""

from __future__ import annotations

import io
import os
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pytest


@dataclass(frozen=True)
class Answer:
    """What the command line said, and its exit code."""

    code: int
    out: str
    err: str


Command = Callable[..., Answer]


@pytest.fixture(scope="session")
def tsmftis() -> Command:
    """`tsmftis(*arguments)` runs the command in this process: Prefect's start is paid once a session."""
    from flows.cli import main

    def command(*arguments: object) -> Answer:
        out, err = io.StringIO(), io.StringIO()
        argv = ["tsmftis", *map(str, arguments)]
        with patch.object(sys, "argv", argv), redirect_stdout(out), redirect_stderr(err):
            try:
                main()
                code: object = 0
            except SystemExit as stop:
                code = stop.code or 0
        assert isinstance(code, int)
        return Answer(code, out.getvalue(), err.getvalue())

    return command


def tiny(folder: Path, **effects: dict[str, float]) -> Path:
    """The demo preset cut down: 68 s of flight with a turn, two lines of 2 s with two panels, 48 × 64 pixels; with undeclared
    effects, if any are named. Written into `folder`, its truth beside it."""
    from stages import simulation

    preset = simulation.SimulationSettings.preset("demo").model_dump()
    preset["name"] = "tiny"
    preset["effects"] = effects
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
    simulation.write(simulation.run(simulation.SimulationSettings.model_validate(preset), 1), folder)
    return folder


@pytest.fixture(scope="session")
def simulated() -> Callable[..., Path]:
    """`simulated(folder, camera_latency={"latency": …})`: a tiny campaign with undeclared effects."""
    return tiny


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny campaign without undeclared effects; tests must not change it."""
    return tiny(tmp_path_factory.mktemp("demo") / "tiny")


@pytest.fixture(scope="session")
def demo_run(demo: Path, tsmftis: Command) -> Path:
    """The folder of one complete run of the demo campaign; tests must not change it."""
    out = demo.with_name("run")
    answer = tsmftis("run", demo, "--out", out)
    assert answer.code == 0, answer.out + answer.err
    return out


@pytest.fixture
def copied(demo: Path, tmp_path: Path) -> Path:
    """A copy of the demo campaign that a test may spoil."""
    return Path(shutil.copytree(demo, tmp_path / "campaign"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of measured data and hidden campaigns, beside the repository or where TSMFTIS_SHARED says."""
    folder = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2] / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no measured data: {folder} does not exist (set TSMFTIS_SHARED)")
    return folder
