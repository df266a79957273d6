"""The thermal stage's residual problem: what the loop finds in chamber runs, and what it leaves alone."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import loop_chamber
import numpy as np
import pytest

from pipeline.records import Chamber, Temperatures
from pipeline.residual_problem import ResidualProblem
from stages.closed_loop import LoopSettings, run
from stages.thermal import ThermalSettings, residual_problem
from stages.thermal.branches import branches, pieces
from stages.thermal.smooth import Curve, Kernel, Smooth
from stages.thermal.targets import CHANNELS
from tsmftis.inertial import DEG_PER_H

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "campaigns"
LOG = SHARED.parent / "data" / "imu_thermal" / "tofupilot_imu_raw_data.csv"


def chamber(seed: int, play: float = 0.0, cycles: float = 1.5, hours: float = 2.0) -> Chamber:
    """A unit with one thermometer: bias a curve of T, on all gyros `play` times its backlash of 5 K; a reading in 4 s."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 3600.0 * hours, 4.0)
    warm = 20.0 - 35.0 * np.sin(2.0 * np.pi * cycles * time / time[-1])
    behind, at = np.empty_like(warm), warm[0]
    for i, t in enumerate(warm):
        at = min(max(at, t - 5.0), t + 5.0)
        behind[i] = (at - t) / 5.0
    curve = 1e-6 * np.tanh((warm - 10.0) / 40.0)
    gyro = curve[:, None] + play * behind[:, None] + 3e-7 * rng.standard_normal((time.size, 3))
    accel = 1e3 * curve[:, None] + [0.0, 0.0, -9.8] + 1e-4 * rng.standard_normal((time.size, 3))
    readings = Temperatures(time, np.tile(warm[:, None, None], (1, 3, 1)), np.tile(warm[:, None], (1, 3)))
    return Chamber(f"run{seed}", time, gyro, accel, readings, None, None)


@cache
def campaign(name: str) -> ResidualProblem:
    folder = SHARED / name / "chamber"
    if not folder.is_dir():
        pytest.skip(f"the campaign {name} is not in {SHARED}")
    train, verify = (Chamber.from_file(folder / f"{n}.nc", n) for n in ("train", "verify"))
    return residual_problem([train], [verify], ThermalSettings())


def test_the_play_of_the_shared_campaign_is_named_with_its_size() -> None:
    result = run(campaign("undeclared-b"), LoopSettings(), 1)
    assert [s.effect for s in result.steps] == ["thermal_hysteresis"]
    found = result.steps[0].parameters
    assert abs(found["half_width"].value - 6.0) < 2.0 * found["half_width"].sigma
    for axis in "xyz":
        one = found[f"gyro.{axis}"]
        assert abs(one.value - 0.03 * DEG_PER_H) < 2.0 * one.sigma


def test_a_clean_campaign_lacks_nothing() -> None:
    result = run(campaign("clean"), LoopSettings(), 1)
    assert result.verdict == "no_effect" and not result.values


def test_a_play_is_found_in_a_run_of_one_thermometer_and_not_invented() -> None:
    assert not run(residual_problem([chamber(1)], [], ThermalSettings()), LoopSettings(), 1).steps
    result = run(residual_problem([chamber(2, 2e-7)], [], ThermalSettings()), LoopSettings(), 1)
    assert [s.effect for s in result.steps] == ["thermal_hysteresis"]
    found = result.steps[0].parameters
    assert abs(found["half_width"].value - 5.0) < 4.0 * found["half_width"].sigma


@pytest.mark.parametrize("rate", [2e-7, 1e-6])
def test_a_rate_that_belongs_to_a_single_thermometer_is_no_memory(rate: float) -> None:
    """Bias in proportion to dT/dt, which the stage's own network learns: no branch is predicted better by a history."""
    plain = chamber(12)
    slope = np.gradient(plain.temperatures.gyro[:, 0, 0], plain.time)
    with_rate = replace(plain, gyro=plain.gyro + rate * (slope / np.abs(slope).max())[:, None])
    assert not run(residual_problem([with_rate], [], ThermalSettings()), LoopSettings(), 1).steps


@pytest.mark.skipif(not LOG.is_file(), reason=f"the measured log {LOG.name} is not there")
def test_memory_halves_what_is_held_out_of_a_real_log() -> None:
    """A consumer unit, one thermometer, three branches: gyro x and accelerometer z have a history, gyro z none."""
    problem = residual_problem([loop_chamber.chamber(LOG)], [], ThermalSettings())
    result = run(problem, LoopSettings(), 1)
    assert result.steps[0].effect == "thermal_hysteresis"
    before, after = loop_chamber.by_channel(problem, {}), loop_chamber.by_channel(problem, result.values)
    ratio = dict(zip(CHANNELS, np.divide(after, before).tolist(), strict=True))
    assert ratio["gyro_x"] < 0.65 and ratio["accel_z"] < 0.5
    assert max(ratio.values()) < 1.01 and ratio["gyro_z"] > 0.95


def test_gyros_of_one_make_are_one_number() -> None:
    problem = residual_problem([chamber(13)], [], ThermalSettings())
    both = {"half_width": 5.0, "gyro": 1e-7}
    each = {"half_width": 5.0} | {f"gyro.{a}": 1e-7 for a in "xyz"}
    apart = problem.residual({"thermal_hysteresis": each})
    np.testing.assert_allclose(problem.residual({"thermal_hysteresis": both}), apart, rtol=1e-12)


def test_a_single_cooling_tells_no_memory() -> None:
    result = run(residual_problem([chamber(3, 2e-7, cycles=0.25, hours=0.6)], [], ThermalSettings()), LoopSettings(), 1)
    assert not result.steps
    limited = {name for one in result.not_identifiable for name in one.effects}
    assert {"thermal_hysteresis", "thermal_lag"} <= limited


def test_known_effects_belong_to_the_model() -> None:
    known = {
        "thermal_hysteresis": {"half_width": 5.0, "gyro": (2e-7,) * 3, "accel": (0.0,) * 3},
        "opd_scale": {"scale": 1e-4},
    }
    left = residual_problem([chamber(4, 2e-7)], [], ThermalSettings(), effects=known)
    assert [c.effect for c in left.candidates] == ["thermal_lag"]
    with_it = residual_problem([chamber(4, 2e-7)], [], ThermalSettings())
    gyros = left.channel < 3
    assert np.std(left.residual({})[gyros]) < np.std(with_it.residual({})[gyros])


def test_the_plays_of_a_residual_are_linear_in_their_sizes() -> None:
    problem = residual_problem([chamber(5)], [], ThermalSettings())
    null = problem.residual({})
    one = problem.residual({"thermal_hysteresis": {"half_width": 4.0, "gyro.y": 1e-7}}) - null
    two = problem.residual({"thermal_hysteresis": {"half_width": 4.0, "gyro.y": 2e-7}}) - null
    np.testing.assert_allclose(two, 2.0 * one, atol=1e-9)
    assert set(np.unique(problem.channel[one != 0.0])) == {1}


def test_a_temperature_that_stands_still_says_nothing() -> None:
    still = chamber(6)
    t = still.temperatures
    still = replace(still, temperatures=Temperatures(t.time, np.full_like(t.gyro, 20.0), np.full_like(t.accel, 20.0)))
    result = run(residual_problem([still], [], ThermalSettings()), LoopSettings(), 1)
    # What the unit's temperature did shows in time, which alone is left to tell it by.
    assert all(step.effect.startswith("learned:time") for step in result.steps)
    assert "thermal_hysteresis" in {name for one in result.not_identifiable for name in one.effects}


def test_branches_turn_at_extrema() -> None:
    label, rising = branches(
        np.concatenate([np.linspace(20, 50, 31), np.linspace(49, -10, 60), np.linspace(-9, 20, 30)])
    )
    assert rising == [True, False, True]
    assert np.flatnonzero(np.diff(label)).tolist() == [29, 89]
    assert np.unique(pieces(np.zeros(400, int))).size == 8


def test_functions_reproduce_what_was_fitted() -> None:
    rng = np.random.default_rng(7)
    x, levels = rng.standard_normal((120, 2)), np.ones((120, 1))
    y = 3.0 + x[:, 0] + 0.3 * x[:, 0] ** 2
    curve = Curve.of(3, x, y, levels, 1.0)
    np.testing.assert_allclose(np.ptp(y - curve(x)), 0.0, atol=1e-9)
    smooth = Smooth.of(Kernel(np.log([2.0, 2.0, 300.0, 0.1, 10.0, 0.01])), x, y, levels)
    assert np.std(y - smooth(x)) < 0.05
