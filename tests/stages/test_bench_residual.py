"""Bench residual: what an error outside the library is learnt as, on a measured interferogram against its vendor's spectrum."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.formats.opus import read_opus
from pipeline.records import Bench
from stages.bench.residual import residual_problem
from stages.closed_loop import LoopResult, LoopSettings, run
from tsmftis import fourier

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "data" / "opus"
FILE, OTHER = SHARED / "brukeropus_file.0", SHARED / "opusreader2_617262_1TP_C-1_A5.0"
pytestmark = pytest.mark.skipif(not FILE.is_file(), reason=f"measured OPUS files are not in {SHARED}")


def measured(file: Path = FILE) -> Bench:
    pytest.importorskip("brukeropus")
    return read_opus(file, "sample")


def answer(bench: Bench, without: str = "") -> LoopResult:
    problem = residual_problem(bench)
    return run(
        replace(problem, candidates=tuple(c for c in problem.candidates if c.effect != without)), LoopSettings(), 1
    )


def slope(result: LoopResult, name: str) -> float:
    table = result.steps[0].table
    assert table is not None
    return float(np.polyfit(table["covariate"], table[name], 1)[0])


def test_nothing_is_learnt_where_nothing_is_missing() -> None:
    assert answer(measured()).verdict == "no_effect"


def test_a_stretched_scan_without_its_name_is_a_curve_of_path_by_opd() -> None:
    bench = measured()
    result = answer(replace(bench, opd=bench.opd / (1.0 + 1e-5)), "opd_scale")
    assert [s.effect for s in result.steps] == ["learned:path by OPD"]
    assert slope(result, "path") == pytest.approx(1e-5, rel=0.05)


def test_a_sloping_response_is_a_curve_of_wavenumber() -> None:
    bench = measured(OTHER)
    assert bench.wavenumber is not None and bench.reference is not None
    share = np.linspace(0.0, 0.05, bench.wavenumber.size)
    result = answer(replace(bench, reference=bench.reference / (1.0 + share)))
    assert [s.effect for s in result.steps] == ["learned:wavenumber"]
    assert slope(result, "response") * np.ptp(bench.wavenumber) == pytest.approx(0.05, rel=0.15)


def test_a_detector_s_curve_without_its_name_is_a_curve_of_the_signal() -> None:
    bench = measured()
    signal = fourier.remove_constant(bench.interferogram, bench.opd, 0)
    bent = signal * (1.0 - 0.02 * signal / np.abs(signal).max())
    result = answer(replace(bench, interferogram=bent), "detector_nonlinearity")
    assert [s.effect for s in result.steps] == ["learned:signal level"]
    table = result.steps[0].table
    assert table is not None
    assert np.polyfit(table["covariate"], table["signal"], 2)[0] == pytest.approx(-0.02, rel=0.4)
