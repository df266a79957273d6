"""Navigation in the closed loop: whiteness and derivatives of the residual, what is found, and what must not be."""

from __future__ import annotations

import os
import re
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_navigation import manoeuvres, problem, recorded
from simulated import LEVER, MEMS, RLG, SIGMA_VELOCITY

from pipeline.campaign import read_campaign
from pipeline.errors import InputError
from pipeline.records import Gnss, ThermalCorrection
from pipeline.residual_problem import Basis, ResidualProblem
from stages.closed_loop import LoopResult, LoopSettings, run
from stages.closed_loop.signatures import derivatives
from stages.navigation import NavigationSettings, residual_problem
from stages.navigation import run as navigate
from stages.navigation.covariates import (
    ACCELEROMETERS,
    ATTITUDE,
    ENTRIES,
    G_SENSITIVITY,
    GYROS,
    REFERENCE_SPEED,
    VELOCITY,
)
from stages.navigation.residual import VELOCITY_LAG, Innovations
from tsmftis.camera import Mounting
from tsmftis.effects import Effects
from tsmftis.simulator.gnss import observe

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "campaigns"
QUICK = LoopSettings(draws=1000)


def needs(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not (SHARED / name).is_dir(), reason=f"the campaign {name} is not in {SHARED}")


def at(p: ResidualProblem, **effects: dict[str, float]) -> np.ndarray:
    """The residual of an exact pass there."""
    p.residual.kept.clear()  # type: ignore[attr-defined]
    return p.residual(effects)


def found(result: LoopResult) -> list[str]:
    return [step.effect for step in result.steps]


def within(result: LoopResult, truth: Effects, sigmas: float = 3.0) -> None:
    """Every parameter of the effects that are there, zeros too."""
    for step in result.steps:
        for name, value in step.parameters.items():
            assert abs(value.value - truth[step.effect].get(name, 0.0)) < sigmas * value.sigma, (step.effect, name)


# --- the residual ----------------------------------------------------------------------------------------------------


def test_clean_innovations_are_white() -> None:
    """Of unit variance to 5 % (six components of 290 fixes each), uncorrelated from fix to fix and with every covariate."""
    for grade in (RLG, MEMS):
        p = problem(grade, 0, 1, {})
        r = p.residual({})
        assert abs(np.sqrt(np.mean(r**2)) - 1.0) < 0.05
        z = r.reshape(6, -1)
        assert abs(np.mean(z[:, 1:] * z[:, :-1])) < 4.0 / np.sqrt(r.size)
        for covariate in p.covariates.values():
            columns = covariate.columns if isinstance(covariate, Basis) else covariate[:, None]
            for column in columns.T:
                assert abs(np.corrcoef(r, column)[0, 1]) < 4.0 / np.sqrt(r.size)


def test_derivatives_are_those_of_exact_passes() -> None:
    """To 1 % of their norm, measured 0.02 to 0.4 %; the latency's, of which velocities that lag are taken off anew at every point
    of a vibrating body, to 3 %, measured 1.8 %.

    (With a MEMS up to 11 % for g-sensitivity: the filter linearises elsewhere then, the further the larger its innovations.)
    """
    p = problem(RLG, 0, 1, {})
    for candidate in p.candidates:
        at(p)  # the pass that the differences are answered from
        told = derivatives(p, {}, candidate, tuple(candidate.parameters))
        for column, (name, parameter) in zip(told.T, candidate.parameters.items(), strict=True):
            step = (
                2.0 if name == "latency" else 100.0
            ) * parameter.difference  # latency bends within a vibration's phase
            up, down = (at(p, **{candidate.effect: {name: sign * step}}) for sign in (1.0, -1.0))
            least = 0.03 if name == "latency" else 0.01
            assert np.linalg.norm((down - up) / (2.0 * step) - column) < least * np.linalg.norm(column), name


@pytest.mark.parametrize("positions_alone", [False, True])
def test_errors_that_the_filter_carries_on_are_those_of_exact_passes(positions_alone: bool) -> None:
    """An entry of each sensor's matrix put into the data, on and off the diagonal, and fixes behind by a time that grows with
    speed: innovations change by the basis' column, to 3 % of its norm (measured 0.1 to 1.5 %)."""
    imu, gnss, initial = recorded(RLG, 0, 1, {})
    gnss = replace(gnss, velocity=None, sigma_velocity=None) if positions_alone else gnss
    p = residual_problem(imu, gnss, RLG.model, Mounting(LEVER), NavigationSettings(), initial=initial)
    innovations = p.residual
    assert isinstance(innovations, Innovations)
    null = innovations.null
    for name, sensor in {GYROS: "gyro", ACCELEROMETERS: "accel", G_SENSITIVITY: "gyro"}.items():
        basis = p.covariates[name]
        assert isinstance(basis, Basis)
        source = null.imu.gyro if name == GYROS else null.imu.accel
        for entry in (1, 4, 8):
            i, j = ENTRIES[entry]
            shown = []
            for sign in (1.0, -1.0):
                values = getattr(null.imu, sensor).copy()
                values[:, i] += sign * 1e-6 * source[:, j]
                changed = replace(null, imu=replace(null.imu, **{sensor: values}))
                other = replace(innovations, null=changed, kept=OrderedDict())
                shown.append(other.at(np.zeros(len(other.order))).residual)
            column = basis.columns[:, entry]
            assert np.linalg.norm((shown[0] - shown[1]) / 2e-6 - column) < 0.03 * np.linalg.norm(column), (name, i, j)
    attitude, velocity = p.covariates[ATTITUDE], p.covariates[VELOCITY]
    assert isinstance(attitude, Basis) and isinstance(velocity, Basis)
    null_pass = innovations.at(np.zeros(len(innovations.order)))
    arm = [innovations.order.index(("antenna_lever_arm", axis)) for axis in "xyz"]
    np.testing.assert_allclose(attitude.columns, null_pass.signatures[:, arm], rtol=1e-9)
    v = recorded(RLG, 0, 1, {})[1].velocity
    assert v is not None
    speed = np.linalg.norm(v, axis=1)
    if positions_alone:
        shown = []
        for sign in (1.0, -1.0):
            away = -sign * 1e-3 * (speed / REFERENCE_SPEED)[:, None] * v
            changed = replace(
                null.gnss,
                latitude=null.gnss.latitude + away[:, 0] / 6.36e6,
                longitude=null.gnss.longitude + away[:, 1] / (6.39e6 * np.cos(null.gnss.latitude)),
                height=null.gnss.height - away[:, 2],
            )
            other = replace(innovations, null=replace(null, gnss=changed), kept=OrderedDict())
            shown.append(other.at(np.zeros(len(other.order))).residual)
        column = velocity.columns[:, 1]
        assert np.linalg.norm((shown[0] - shown[1]) / 2e-3 - column) < 0.03 * np.linalg.norm(column)
    else:  # at a steady speed the two lags are one
        want = velocity.columns[:, 0] * np.mean(speed) / REFERENCE_SPEED
        assert np.linalg.norm(velocity.columns[:, 1] - want) < 0.05 * np.linalg.norm(want)


def test_biases_beyond_those_declared_are_left_free_and_told() -> None:
    """Twenty times the declared sigma, in one accelerometer; a third of it is no matter. A compensated unit should have none."""
    imu, gnss, initial = recorded(RLG, 0, 3, {})
    knots, three = imu.time[[0, -1]], np.zeros((2, 3))
    nothing = ThermalCorrection(knots, three, three, three, three, np.zeros((2, 6)))
    for times, correction in ((0.3, nothing), (20.0, None), (20.0, nothing)):
        shifted = replace(imu, accel=imu.accel + times * RLG.model.accel.bias_sigma * np.array([1.0, 0.0, 0.0]))
        p = residual_problem(
            shifted, gnss, RLG.model, Mounting(LEVER), NavigationSettings(), initial=initial, correction=correction
        )
        far = times > 1.0
        assert p.nuisance.shape[1] == (7 if far else 1) and any("left free" in n for n in (*p.notes, *p.unnamed)) == far
        assert run(p, QUICK, 1).verdict == ("unexplained" if far and correction else "no_effect")


@pytest.mark.parametrize(
    ("effect", "axis", "size", "covariate"),
    [
        ("antenna_lever_arm", "y", 0.1, "attitude"),
        ("gnss_latency", "latency", 0.05, "velocity"),
        ("accel_scale_factor", "z", 2e-3, "specific force"),
    ],
)
def test_without_its_name_an_error_is_a_curve_of_what_it_acts_through(
    effect: str, axis: str, size: float, covariate: str
) -> None:
    p = problem(RLG, 1, 8, {effect: {axis: size}})
    p = replace(p, candidates=tuple(c for c in p.candidates if c.effect != effect))
    assert found(run(p, QUICK, 1)) == [f"learned:{covariate}"]


def test_the_residual_with_the_effect_in_the_model_is_the_clean_one() -> None:
    """Innovations of a flight with an arm and a latency, at their values, are white again; at the null they are not."""
    truth = {"antenna_lever_arm": {"x": 0.5, "y": -0.3}, "gnss_latency": {"latency": 0.08}}
    p = problem(RLG, 0, 2, truth)
    assert np.sqrt(np.mean(at(p) ** 2)) > 3.0
    assert abs(np.sqrt(np.mean(at(p, **truth) ** 2)) - 1.0) < 0.05


def test_what_is_in_the_model_already_is_not_looked_for() -> None:
    """`effects` shift the null: the candidates are what is missing beside them."""
    truth = {"gnss_latency": {"latency": 0.08}}
    imu, gnss, initial = recorded(RLG, 0, 2, truth)
    p = residual_problem(
        imu, gnss, RLG.model, Mounting(LEVER), NavigationSettings(), initial=initial, effects=truth
    )  # fmt: skip
    assert abs(np.sqrt(np.mean(p.residual({}) ** 2)) - 1.0) < 0.05


def test_what_the_settings_estimate_is_left_to_the_loop() -> None:
    """An arm that the filter would estimate as a state is a candidate all the same."""
    truth = {"antenna_lever_arm": {"z": 0.5}}
    imu, gnss, initial = recorded(MEMS, 0, 2, truth)
    settings = NavigationSettings(estimate=("gyro_bias", "accel_bias", "antenna_lever_arm", "gnss_latency"))
    p = residual_problem(imu, gnss, MEMS.model, Mounting(LEVER), settings, initial=initial)
    assert np.sqrt(np.mean(p.residual({}) ** 2)) > 1.05
    assert abs(np.sqrt(np.mean(at(p, **truth) ** 2)) - 1.0) < 0.05


def test_fixes_around_a_gap() -> None:
    """A gap of a second: fixes in it say nothing, with and without a latency; the rest stays white."""
    imu, gnss, initial = recorded(MEMS, 0, 1, {})
    whole = (imu.time < 60.1) | (imu.time > 61.1)
    broken = replace(imu, time=imu.time[whole], gyro=imu.gyro[whole], accel=imu.accel[whole])
    p = residual_problem(broken, gnss, MEMS.model, Mounting(LEVER), NavigationSettings(), initial=initial)
    assert abs(np.sqrt(np.mean(p.residual({}) ** 2)) - 1.0) < 0.06
    assert np.isfinite(p.residual({"gnss_latency": {"latency": 0.7}})).all()


def test_outliers_and_withheld_fixes_are_left_out() -> None:
    imu, gnss, initial = recorded(RLG, 0, 1, {})
    height = gnss.height.copy()
    height[100:103] += 300.0
    settings = NavigationSettings(withhold_s=((80.0, 90.0),))
    p = residual_problem(
        imu, replace(gnss, height=height), RLG.model, Mounting(LEVER), settings, initial=initial
    )  # fmt: skip
    assert not np.isin(gnss.time[100:103], p.time).any()
    assert not ((p.time >= 80.0) & (p.time <= 90.0)).any()
    assert abs(np.sqrt(np.mean(p.residual({}) ** 2)) - 1.0) < 0.05


def test_positions_alone() -> None:
    imu, gnss, initial = recorded(RLG, 0, 1, {})
    settings = NavigationSettings(use_gnss_velocity=False)
    p = residual_problem(imu, gnss, RLG.model, Mounting(LEVER), settings, initial=initial)
    assert np.unique(p.series).size == 3
    assert abs(np.sqrt(np.mean(p.residual({}) ** 2)) - 1.0) < 0.06


def test_too_few_fixes_are_a_users_mistake() -> None:
    imu, gnss, initial = recorded(RLG, 0, 1, {})
    few = Gnss(*(None if c is None else c[:25] for c in (getattr(gnss, n) for n in gnss.__dataclass_fields__)))
    with pytest.raises(InputError, match="usable fixes"):
        residual_problem(imu, few, RLG.model, Mounting(LEVER), NavigationSettings(), initial=initial)


# --- what the loop makes of it ---------------------------------------------------------------------------------------


def test_nothing_is_found_on_clean_flights() -> None:
    assert run(problem(RLG, 1, 1, {}), QUICK, 1).verdict == "no_effect"
    result = run(problem(MEMS, 0, 1, {}), QUICK, 1)
    assert result.verdict == "no_effect"
    unseen = {one.effects for one in result.not_identifiable}
    assert {
        ("gyro_scale_factor",),
        ("accel_scale_factor",),
    } <= unseen  # within their declared sigmas they are no effects


@pytest.mark.parametrize(
    ("grade", "truth"),
    [
        (MEMS, {"gnss_latency": {"latency": -0.1}}),
        (RLG, {"antenna_lever_arm": {"x": 0.3}}),
        (MEMS, {"gyro_scale_factor": {"z": 5e-3}}),
        (MEMS, {"accel_scale_factor": {"z": 0.03}}),
        (RLG, {"gyro_g_sensitivity": {"z": 3e-6}}),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_each_effect_is_found(grade: Any, truth: Effects) -> None:
    result = run(problem(grade, 0, 5, truth), QUICK, 1)
    assert found(result) == list(truth)
    within(result, truth)


def test_arm_and_latency_at_once() -> None:
    """Of turns in gusts at 60 m/s, where a metre of forward arm is 17 ms of latency."""
    truth = {"gnss_latency": {"latency": 0.2}, "antenna_lever_arm": {"x": 1.0}}
    result = run(problem(RLG, 1, 4, truth), QUICK, 1)
    assert set(found(result)) == set(truth)
    within(result, truth)


def test_arm_and_latency_at_a_steady_speed_are_one_family() -> None:
    """In smooth air at one speed nobody can tell 0.3 m of forward arm from −5 ms: both names, and the manoeuvre that would."""
    result = run(problem(MEMS, 1, 5, {"antenna_lever_arm": {"x": 0.3}}, True), QUICK, 1)
    assert len(result.steps) == 1
    step = result.steps[0]
    assert {step.effect, *step.indistinguishable_from} == {"antenna_lever_arm", "gnss_latency"}
    family = next(one for one in result.not_identifiable if len(one.effects) > 1)
    assert "several speeds" in family.would_separate


def test_velocities_that_lag_are_no_latency() -> None:
    """A receiver's filter makes velocities late by 40 ms: nothing is added; the clock's own latency beside it is found."""
    imu, gnss, initial = recorded(MEMS, 0, 5, {})
    craft, _ = manoeuvres(0)
    noise = np.random.default_rng(8).standard_normal((gnss.time.size, 3))
    velocity = observe(craft, gnss.time - 0.04, LEVER, 0.0, 0.0 * noise, SIGMA_VELOCITY * noise).velocity
    for clock in (0.0, 0.03):
        given = replace(gnss, velocity=velocity, time=gnss.time + clock)
        p = residual_problem(imu, given, MEMS.model, Mounting(LEVER), NavigationSettings(), initial=initial)
        result = run(p, QUICK, 1)
        assert found(result) == (["gnss_latency"] if clock else [])
        within(result, {"gnss_latency": {"latency": clock}})
        if not clock:
            told = re.search(r"velocities are ([\d.]+) ± ([\d.]+) ms late", result.notes[0])
            assert told and abs(float(told[1]) - 40.0) < 4.0 * float(told[2])
            assert p.beside == {VELOCITY_LAG: pytest.approx(0.04, abs=0.002)}
            late = given
    model = {"model": MEMS.model, "mounting": Mounting(LEVER), "settings": NavigationSettings(), "initial": initial}
    nis = [navigate(imu, late, **model, velocity_lag=lag).quality["innovation_nis_mean"] for lag in (0.0, 0.04)]
    assert nis[1] < 0.6 * nis[0]


# --- measured and shared data ----------------------------------------------------------------------------------------


def campaign(name: str) -> dict[str, Any]:
    """Of a shared campaign, what the stage takes."""
    opened = read_campaign(SHARED / name)
    keys, instrument = opened.flight("F1").initial, opened.instrument
    initial = None
    if keys is not None:
        angles = np.deg2rad([[getattr(keys, f"{s}{n}_deg") for n in ("roll", "pitch", "yaw")] for s in ("", "sigma_")])
        initial = (keys.time_s, angles[0], angles[1])
    return {
        "imu": opened.imu("F1"),
        "gnss": opened.gnss("F1"),
        "model": instrument.imu,
        "mounting": instrument.mounting,
        "settings": NavigationSettings(),
        "initial": initial,
    }


@needs("mems")
def test_mems_campaign_has_no_effect() -> None:
    """A simulated campaign of another program."""
    assert run(residual_problem(**campaign("mems")), QUICK, 1).verdict == "no_effect"


@needs("walk")
def test_walk_has_its_arm_on_the_other_side() -> None:
    """A real walk: the arm is not the declared 5 cm to the left but to the right, its length the 5 cm that are known; velocities
    are late. Innovations fall with both. 30 cm that are put on top come out on top of that.
    """
    given = campaign("walk")
    mounting = given["mounting"]
    less = {**given, "mounting": replace(mounting, imu_to_antenna=mounting.imu_to_antenna - [0.3, 0.0, 0.0])}
    p = residual_problem(**less)
    result = run(p, QUICK, 1)
    assert "antenna_lever_arm" in found(result)
    arm = result.values["antenna_lever_arm"]
    assert abs(arm["x"] - 0.3) < 0.02
    assert abs(arm["y"] - 0.09) < 0.02
    length = np.linalg.norm(mounting.imu_to_antenna + np.array([arm["x"] - 0.3, arm["y"], arm["z"]]))
    assert 0.03 < length < 0.07
    assert "ms late against the positions" in result.notes[0]
    lag = p.beside[VELOCITY_LAG]
    before = navigate(**given).quality["innovation_nis_mean"]
    after = navigate(**less, effects={"antenna_lever_arm": arm}).quality["innovation_nis_mean"]
    timed = navigate(**less, effects={"antenna_lever_arm": arm}, velocity_lag=lag).quality["innovation_nis_mean"]
    assert after < 0.9 * before and timed < 0.6 * after
