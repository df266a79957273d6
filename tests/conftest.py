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


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny campaign (benchmarks/tiny_campaign.py) without undeclared effects; tests must not change it."""
    from tiny_campaign import tiny_campaign

    return tiny_campaign(tmp_path_factory.mktemp("demo") / "tiny", 1, {})


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
