"""What the POS estimates beside the path: sensor errors, lever arm, latency; and that its sigmas are those of its errors."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import simulated
from pydantic import ValidationError
from scipy.stats import chi2
from simulated import LEVER, MEMS, RLG, Grade

from pipeline.records import Gnss, Imu
from stages.navigation import NavigationResult, NavigationSettings, kalman, pos, quality, run, states
from stages.navigation.measurements import at_instants, withheld
from tsmftis.camera import Mounting
from tsmftis.effects import EFFECTS
from tsmftis.inertial import DEG_PER_H
from tsmftis.rotation import dcm_to_quaternion, exp_so3, log_so3, quaternion_to_dcm, rpy_jacobian, rpy_to_dcm
from tsmftis.simulator import flight, inertial
from tsmftis.simulator.effects import NULL

FLIGHTS = 20
ALL = (*states.DEFAULT_GROUPS, "antenna_lever_arm", "gnss_latency")


@cache
def perfect(seed: int) -> tuple[flight.Flight, Imu]:
    """140 s with a turn to each side, in gusts."""
    turns = [flight.Leg(turn=side * 0.8, bank=0.4) for side in (1.0, -1.0)]
    craft = simulated.flown(
        [flight.Leg(duration=25.0), turns[0], flight.Leg(duration=15.0), turns[1], flight.Leg(duration=25.0)], seed
    )
    return craft, simulated.ideal(craft, 100.0)


def recorded(seed: int, grade: Grade, **how: Any) -> tuple[flight.Flight, Imu, Gnss, Any]:
    craft, imu = perfect(seed)
    rng = np.random.default_rng([61, seed])
    gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng, **how)
    initial = simulated.attitude_known_to(craft, grade.sigma_rpy, rng)
    return craft, simulated.measured(imu, grade.model, rng), gnss, initial


def solve(imu: Imu, gnss: Gnss, initial: Any, grade: Grade, effects: Any = None, **settings: Any) -> NavigationResult:
    return run(
        imu, gnss, grade.model, Mounting(LEVER), NavigationSettings(**settings), initial=initial, effects=effects
    )


# --- consistency -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grade", [RLG, MEMS], ids=lambda g: g.name)
def test_sigmas_are_those_of_the_errors_for_two_grades(grade: Grade) -> None:
    """Twenty flights: NEES of 9 states at two times, NIS of all fixes, forward/backward separation, coverage of 95 % intervals.

    Bands of 99.9 % for each number that is asserted, so that the whole test fails by chance once in a hundred; the coverage of
    correlated errors gets 0.92–0.98 over all states.
    """
    ahead, after, nis, covered, parted = [], [], [], [], []
    for seed in range(FLIGHTS):
        craft, imu, gnss, initial = recorded(seed, grade)
        solution, _ = pos.smooth(imu, gnss, grade.model, Mounting(LEVER), NavigationSettings(), initial)
        filtered, smoothed, _, _ = simulated.consistency(craft, solution, [60.0, float(imu.time[-1]) - 20.0])
        ahead.append(filtered)
        after.append(smoothed)
        nis.append(solution.store.nis[solution.store.used])
        along = quality.histories(solution)
        known = np.isfinite(along.separation).all(axis=1)
        middle = int(np.flatnonzero(known)[known.sum() // 2])
        parted.append((along.separation[middle, :3] / along.separation_sigma[middle, :3]) ** 2)
        t = simulated.thinned(pos.output.trajectory(solution, []), 50)
        r, v, rotation = simulated.errors(craft, t)
        rpy = np.einsum("nij,nj->ni", rpy_jacobian(t.rpy), rotation)
        scaled = np.concatenate([r / t.sigma_position, v / t.sigma_velocity, rpy / t.sigma_attitude], axis=1)
        covered.append((np.abs(scaled) < 1.96).mean(axis=0))
    low, high = chi2.ppf([0.0005, 0.9995], 9 * FLIGHTS) / FLIGHTS
    print(grade.name, "NEES", np.mean(ahead, axis=0), np.mean(after, axis=0), low, high)
    for name, mean in (("filter", np.mean(ahead, axis=0)), ("smoother", np.mean(after, axis=0))):
        assert ((low < mean) & (mean < high)).all(), (name, mean)
    every = np.concatenate(nis)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * every.size) / every.size
    print("NIS", every.mean(), low, high)
    assert low < every.mean() < high
    low, high = chi2.ppf([0.0005, 0.9995], FLIGHTS) / FLIGHTS
    print("separation", np.mean(parted, axis=0), low, high)
    assert (low < np.mean(parted, axis=0)).all() and (np.mean(parted, axis=0) < high).all()
    print("coverage", np.mean(covered, axis=0), np.mean(covered))
    assert 0.92 < np.mean(covered) < 0.98


# --- lever arm and latency -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grade", [RLG, MEMS], ids=lambda g: g.name)
def test_an_undeclared_lever_arm_and_latency_are_found(grade: Grade) -> None:
    """0.3 m in all and 40 ms over six flights: χ² of the errors over 24 degrees of freedom within 99.9 %, ≥ 20 within 2 σ."""
    scaled = []
    for seed in range(6):
        rng = np.random.default_rng([62, seed])
        added = rng.standard_normal(3)
        added *= 0.3 / np.linalg.norm(added)
        _, imu, gnss, initial = recorded(seed, grade, lever=LEVER + added, latency=0.04)
        found = solve(imu, gnss, initial, grade, estimate=ALL).quality["calibration"]
        arm, late = found["antenna_lever_arm"], found["gnss_latency"]
        off = np.array([*(np.array(arm["added_to_declared"]) - added), late["value"][0] - 0.04])
        scaled.append(off / np.array([*arm["sigma"], *late["sigma"]]))
        assert late["sigma"][0] < 0.002 and max(arm["sigma"]) < 0.1
        assert np.array(found["correlation"]).shape == (4, 4) and "tells" in found["sentence"]
    z = np.array(scaled)
    print(grade.name, np.round(z, 2).tolist())
    assert chi2.ppf(0.0005, 24) < (z**2).sum() < chi2.ppf(0.9995, 24)
    assert (np.abs(z) < 2.0).sum() >= 20


def test_a_steady_straight_flight_says_that_it_cannot_tell() -> None:
    """In calm air on a straight line lever arm and latency only shift the path: the prior sigmas come back, and that is said."""
    craft = simulated.flown([flight.Leg(duration=120.0)], 1, calm=True)
    rng = np.random.default_rng(1)
    imu = simulated.measured(simulated.ideal(craft, 100.0), RLG.model, rng)
    gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng, latency=0.04)
    initial = simulated.attitude_known_to(craft, RLG.sigma_rpy, rng)
    found = solve(imu, gnss, initial, RLG, estimate=ALL).quality["calibration"]
    assert min(found["antenna_lever_arm"]["sigma"]) > 0.25 and found["gnss_latency"]["sigma"][0] > 0.05
    assert found["sentence"].startswith("It says nothing of lever arm x, lever arm y, lever arm z and latency")
    assert "Turns to both sides" in found["sentence"]


def test_what_is_not_estimated_stays_as_declared_and_costs_no_state() -> None:
    """Without groups the filter has nine states, and biases come back as zero with no uncertainty."""
    _, imu, gnss, initial = recorded(0, RLG)
    result = solve(imu, gnss, initial, RLG, estimate=())
    assert result.quality["calibration"] is None and result.quality["estimated"] == []
    assert result.quality["gyro_bias_deg_per_h"] == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(result.trajectory.rate, pos._from(imu, 0.5).gyro)


# --- effects of a model update ---------------------------------------------------------------------------------------


def test_each_declared_effect_undoes_what_nature_did() -> None:
    """Lever arm, latency, scale factors and g-sensitivity put into the data by the simulator and declared: NIS as without them.

    Undeclared, each raises the mean NIS by more than 5 of its standard errors.
    """
    craft, imu = perfect(2)
    zero = np.zeros(3)
    scale, sensitivity = np.array([2e-3, -3e-3, 2.5e-3]), np.array([20.0, -30.0, 25.0]) * DEG_PER_H / 9.8
    cases = {
        "antenna_lever_arm": (
            {"x": 0.3, "y": -0.2, "z": 0.2},
            {"lever": LEVER + np.array([0.3, -0.2, 0.2])},
            (zero, zero, zero),
        ),
        "gnss_latency": ({"latency": 0.04}, {"latency": 0.04}, (zero, zero, zero)),
        "gyro_scale_factor": (dict(zip("xyz", scale, strict=True)), {}, (scale, zero, zero)),
        "accel_scale_factor": (dict(zip("xyz", scale, strict=True)), {}, (zero, scale, zero)),
        "gyro_g_sensitivity": (dict(zip("xyz", sensitivity, strict=True)), {}, (zero, zero, sensitivity)),
    }
    for name, (effect, how, constants) in cases.items():
        rng = np.random.default_rng(9)
        gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng, **how)
        initial = simulated.attitude_known_to(craft, RLG.sigma_rpy, rng)
        data = simulated.measured(imu, RLG.model, rng, inertial.UnitErrors(*constants))
        error = np.sqrt(12.0 / gnss.time.size)
        known = solve(data, gnss, initial, RLG, {name: effect}).quality["innovation_nis_mean"]
        ignored = solve(data, gnss, initial, RLG).quality["innovation_nis_mean"]
        print(name, known, ignored, error)
        assert known == pytest.approx(6.0, abs=4 * error)
        assert ignored > 6.0 + 5 * error


def test_an_effect_by_part_of_its_parameters_leaves_the_others_alone() -> None:
    """{"x": 0.3} adds to x only; what is no effect on navigation is a programmer's mistake."""
    theta = pos.declared(Mounting(LEVER), {"antenna_lever_arm": {"x": 0.3}})
    np.testing.assert_array_equal(theta[states.parameter("antenna_lever_arm")], LEVER + [0.3, 0.0, 0.0])  # noqa: RUF005
    for wrong in ({"camera_latency": {"latency": 0.1}}, {"gnss_latency": {"delay": 0.1}}):
        with pytest.raises(ValueError, match="no effect on navigation"):
            pos.declared(Mounting(LEVER), wrong)


def test_effects_are_those_of_the_simulator() -> None:
    """Declaration and simulator name the same effects with the same parameters."""
    assert {k: set(e.units) for k, e in EFFECTS.items()} == {k: set(v) for k, v in NULL.items()}


# --- derivatives -----------------------------------------------------------------------------------------------------


def moved(state: list[Any], index: int, by: float) -> list[Any]:
    """Position, velocity, C and θ with one error state put in, as the filter takes it up."""
    position, velocity, dcm, theta = (np.array(s) for s in state)
    if index < 3:
        scale = simulated.metres(position[None])[0]
        position[index] += by / scale[index]
    elif index < 6:
        velocity[index - 3] += by
    elif index < 9:
        dcm = exp_so3(by * np.eye(3)[index - 6]) @ dcm
    else:
        theta[index - 9] += by
    return [position, velocity, dcm, theta]


def test_the_derivatives_of_both_measurements_are_those_of_their_innovations() -> None:
    """−∂y/∂x by central differences over all 28 states, every parameter but the latency away from zero: 0.5 % of a column
    (scale factors of 0.1 % are left out of other columns).

    With a latency left in the stamp the rows are of first order in it: 1 % at 4 ms for the navigation states.
    """
    rng = np.random.default_rng(12)
    theta = np.concatenate([1e-4 * rng.standard_normal(3), 1e-2 * rng.standard_normal(3), 1e-3 * rng.standard_normal(6),
                            1e-6 * rng.standard_normal(3), LEVER, [0.0]])  # fmt: skip
    state: list[Any] = [np.array([0.7, 0.3, 900.0]), np.array([50.0, -20.0, 2.0]), rpy_to_dcm(0.2, -0.1, 1.1), theta]
    rate, force = np.array([[0.1, -0.05, 0.2]]), np.array([[1.0, -2.0, -9.5]])
    fix = kalman.Measurements(
        *(np.zeros(1),) * 4, np.array([[0.7, 0.3, 900.0]]), np.zeros((1, 3)), np.ones((1, 6)), rate, force
    )
    steps = np.repeat([0.1, 0.01, 1e-4, 1e-6, 1e-3, 1e-5, 1e-5, 1e-6, 1e-2, 1e-5], [3] * 9 + [1])

    def at_fix(s: list[Any]) -> tuple[np.ndarray, np.ndarray]:
        H, y = np.zeros((6, states.STATES)), np.zeros(6)
        kalman._at_fix(fix, 0, *s, H, y)
        return y, H

    def at_rest(s: list[Any]) -> tuple[np.ndarray, np.ndarray]:
        H, y = np.zeros((6, states.STATES)), np.zeros(6)
        kalman._at_rest(rate[0], force[0], s[0][0], *s[1:], H, y)
        return y, H

    late = [*state[:3], np.concatenate([theta[:-1], [0.004]])]
    for name, measure, at, count, loose in (
        ("fix", at_fix, state, states.STATES, 5e-3),
        ("rest", at_rest, state, states.STATES, 5e-3),
        ("late fix", at_fix, late, states.NAVIGATION, 1e-2),
    ):
        _, H = measure(at)
        for i, h in enumerate(steps[:count]):
            difference = -(measure(moved(at, i, h))[0] - measure(moved(at, i, -h))[0]) / (2.0 * h)
            assert np.abs(difference - H[:, i]).max() < loose * max(np.abs(H[:, i]).max(), 1e-2), (name, i)


def test_the_transition_is_the_derivative_of_the_mechanisation() -> None:
    """One epoch of 0.2 s at 100 Hz from displaced starts, by central differences, against the filter's Φ.

    Rates and forces vary inside the epoch: attitude follows the mean to 0.3 %, single and double integrals to 3 %.
    """
    time = np.arange(0, 21) / 100.0
    gyro = np.array([0.1, -0.05, 0.2]) + 0.01 * np.sin(20.0 * time[:, None] + np.arange(3))
    accel = np.array([1.0, -2.0, -9.5]) + 0.02 * np.cos(15.0 * time[:, None] + np.arange(3))
    no = np.zeros(time.size, np.bool_)
    zero = np.zeros(states.STATES)
    unit = kalman.Unit(time, gyro, accel, no, no, np.zeros((time.size, 2)), zero, zero, np.full(6, 1.0 / 3600.0))
    empty = np.zeros((0, 3))
    nothing = kalman.Measurements(
        np.zeros(0), np.zeros(0, int), np.zeros(0, int), no[:0], empty, empty, np.zeros((0, 6)), empty, empty
    )
    active = states.estimated(tuple(states.GROUPS))

    def after(state: list[Any]) -> tuple[list[Any], kalman.Store]:
        store = kalman.Store.empty(time.size, 3, 0, active.size)
        position, velocity, dcm, theta = (np.array(v) for v in state)
        q, P = dcm_to_quaternion(dcm), np.eye(active.size)
        kalman.forward(unit, nothing, active, position, velocity, q, theta, P, 0.2, np.ones(7), 20.0, store)
        return [position, velocity, quaternion_to_dcm(q)], store

    theta = np.concatenate([1e-4 * np.ones(3), 1e-2 * np.ones(3), 1e-3 * np.ones(6), 1e-7 * np.ones(3), LEVER, [0.0]])
    state: list[Any] = [np.array([0.7, 0.3, 900.0]), np.array([50.0, -20.0, 2.0]), rpy_to_dcm(0.2, -0.1, 1.1), theta]
    _, store = after(state)
    phi = store.epoch_phi[0]
    steps = np.repeat([10.0, 0.1, 1e-4, 1e-5, 1e-3, 1e-4, 1e-4, 1e-5, 1e-2, 1e-5], [3] * 9 + [1])
    for i, h in enumerate(steps):
        (r1, v1, c1), (r0, v0, c0) = after(moved(state, i, h))[0], after(moved(state, i, -h))[0]
        change = np.concatenate([(r1 - r0) * simulated.metres(r0[None])[0], v1 - v0, log_so3(c1 @ c0.T)]) / (2.0 * h)
        # Position, velocity and attitude each by its own size: they are seconds apart.
        for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
            floor, loose = {0: (1.0, 3e-2), 3: (0.1, 3e-2), 6: (3e-3, 3e-3)}[part.start]
            size = max(np.abs(phi[part, i]).max(), floor)
            assert np.abs(change[part] - phi[part, i]).max() < loose * size + 2e-8, (
                i,
                part,
                change[part],
                phi[part, i],
            )


def test_g_sensitivity_is_estimated_where_it_is_asked_for() -> None:
    """30 °/h/g on the vertical gyro in turns, a prior of 30: found within 3 σ, and σ is less than half the prior."""
    craft, imu = perfect(2)
    true = np.array([0.0, 0.0, 30.0]) * DEG_PER_H / 9.80665
    rng = np.random.default_rng(10)
    gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng)
    initial = simulated.attitude_known_to(craft, RLG.sigma_rpy, rng)
    data = simulated.measured(imu, RLG.model, rng, inertial.UnitErrors(np.zeros(3), np.zeros(3), true))
    groups = (*states.DEFAULT_GROUPS, "gyro_g_sensitivity")
    result = solve(data, gnss, initial, RLG, estimate=groups, g_sensitivity_sigma_deg_per_h_per_g=30.0)
    shown = result.figures["parameters"]["gyro_g_sensitivity"]
    value, sigma = (np.array(shown[key])[:, -1] for key in ("value", "sigma"))
    print("g-sensitivity", value / true[2], sigma / true[2])
    assert np.abs((value - true) / sigma).max() < 3.0
    assert sigma[2] < 0.5 * true[2]


# --- measurements and settings ---------------------------------------------------------------------------------------


def test_rates_at_an_instant_are_better_than_means_around_it() -> None:
    """A 25 Hz sine sampled as means at 100 Hz (half of Nyquist) is met to 6 %, where interpolated means miss it by a third."""
    time = np.arange(1, 1001) / 100.0
    wanted = np.linspace(1.0, 9.0, 777)
    for frequency, bound in ((25.0, 0.06), (2.0, 1e-4)):
        w = 2 * np.pi * frequency
        integral = -np.cos(w * np.concatenate([[0.0], time])) / w
        means = np.repeat(np.diff(integral)[:, None] * 100.0, 3, axis=1)
        found = at_instants(time, means, wanted)
        assert np.abs(found - np.sin(w * wanted)[:, None]).max() < bound


def test_which_fixes_are_withheld() -> None:
    time = np.arange(0.0, 120.0, 1.0) + 1000.0
    chosen = NavigationSettings(
        withhold_every_s=(60.0, 15.0), withhold_s=((1010.0, 1012.0),), free_inertial_after_s=1115.0
    )
    out = time[withheld(time, chosen)] - 1000.0
    assert out.tolist() == [10.0, 11.0, 12.0, *np.arange(45.0, 60.0), *np.arange(105.0, 120.0)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"estimate": ["colour"]},
        {"withhold_s": [[5.0, 4.0]]},
        {"withhold_every_s": [10.0, 20.0]},
        {"sigma_factor": [1.0, 1.0]},
        {"reentry_s": 0.0},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        NavigationSettings(**wrong)
