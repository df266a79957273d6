"""The POS against the simulator's inertial-frame truth, closed forms of Savage, batch least squares, and its own sigmas."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import simulated
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import j1
from scipy.stats import chi2
from simulated import LEVER, RLG, consistency, errors, measured, rms, thinned, truth

from pipeline.campaign import read_campaign
from pipeline.errors import InputError
from pipeline.records import Gnss, Imu, ThermalCorrection, Trajectory
from stages.navigation import NavigationResult, NavigationSettings, kalman, output, pos, run, states
from stages.navigation.alignment import level
from stages.navigation.mechanisation import increments, quaternion_to_dcm, step
from tsmftis import geodesy
from tsmftis.camera import Mounting
from tsmftis.rotation import dcm_to_quaternion, log_so3, rpy_to_dcm
from tsmftis.simulator import flight

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "campaigns"
MODEL = RLG.model
SIGMA_RPY = RLG.sigma_rpy
FLIGHTS = 12


def needs(campaign: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not (SHARED / campaign).is_dir(), reason=f"shared campaign {campaign} not in {SHARED}")


# --- flights ---------------------------------------------------------------------------------------------------------


@cache
def flown(seed: int, rate: float = 100.0) -> tuple[flight.Flight, Imu]:
    craft = simulated.aircraft(seed) if seed >= 0 else simulated.drive()
    return craft, simulated.ideal(craft, rate)


def fixes(craft: flight.Flight, imu: Imu, rng: np.random.Generator) -> Gnss:
    return simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng)


@dataclass(frozen=True)
class Case:
    craft: flight.Flight
    imu: Imu
    gnss: Gnss
    initial: tuple[float, np.ndarray, np.ndarray]

    def solve(self, imu: Imu | None = None, mounting: Mounting | None = None, **changes: object) -> NavigationResult:
        options = {"initial": self.initial} | changes
        options.pop("gnss", None)
        return run(
            imu or self.imu,
            changes.get("gnss", self.gnss),  # type: ignore[arg-type]
            MODEL,
            mounting or Mounting(LEVER),
            NavigationSettings(),
            **options,  # type: ignore[arg-type]
        )


@cache
def case(seed: int) -> Case:
    craft, imu = flown(seed)
    rng = np.random.default_rng([97, abs(seed), seed < 0])
    start = simulated.attitude_known_to(craft, SIGMA_RPY, rng)
    return Case(craft, measured(imu, MODEL, rng), fixes(craft, imu, rng), start)


# --- strapdown -------------------------------------------------------------------------------------------------------


def dead_reckoning(craft: flight.Flight, imu: Imu) -> tuple[float, float, float]:
    """Errors of position [m], velocity [m/s] and attitude [rad] after the whole record, from a true start."""
    dt = float(imu.time[1] - imu.time[0])
    geodetic, velocity, dcm = truth(craft, imu.time)
    position, v, q = geodetic[0].copy(), velocity[0].copy(), dcm_to_quaternion(dcm[0])
    c, theta, dv = np.empty((3, 3)), np.empty(3), np.empty(3)
    quaternion_to_dcm(q, c)
    for k in range(1, imu.time.size):
        increments(imu.gyro[k], imu.accel[k], imu.gyro[k - 1], imu.accel[k - 1], dt, dt, theta, dv)
        step(position, v, q, c, theta, dv, dt)
    wrong = geodesy.geodetic_to_ecef(*position) - geodesy.geodetic_to_ecef(*geodetic[-1])
    turn = log_so3(dcm[-1] @ c.T)
    return tuple(float(np.linalg.norm(e)) for e in (wrong, v - velocity[-1], turn))  # type: ignore[return-value]


def test_strapdown_reproduces_a_trajectory_worked_out_in_the_inertial_frame() -> None:
    """110 s with a turn and vibration; measured at 400 and 200 Hz: 0.15 and 0.61 mm, 3 and 11 µm/s, 1e-10 and 2e-10 rad.

    The bounds are three to five times that, a tenth of a fix's sigma.
    """
    craft, imu = flown(0, 400.0)
    fine, coarse = dead_reckoning(craft, imu), dead_reckoning(craft, merged(imu, np.full(imu.time.size // 2, 2)))
    print("strapdown", fine, coarse)
    assert coarse[0] < 2e-3 and coarse[1] < 5e-5 and coarse[2] < 1e-9
    # Second order or better in the interval, above rounding (which the attitude has reached).
    assert fine[0] < coarse[0] / 3 and fine[1] < coarse[1] / 3


def test_coning_leaves_what_savage_says() -> None:
    """Cone of half-angle θ at Ω: drift (β̂ − β)/dt with β = ½sin²θ(Ω·dt − sin Ω·dt), β̂ = (1/12)(2 sin θ sin ½Ω·dt)² sin Ω·dt.

    1 % leaves room for terms of order θ⁴; the uncompensated drift is 18 times larger.
    """
    half, omega, dt, n = 0.01, 2 * np.pi * 10.0, 0.005, 4000
    t = dt * np.arange(n + 1)
    alpha = np.stack(
        [
            np.full(n, -2 * np.sin(half / 2) ** 2 * omega * dt),
            np.sin(half) * np.diff(np.cos(omega * t)),
            np.sin(half) * np.diff(np.sin(omega * t)),
        ],
        -1,
    )
    theta, dv, zero = np.empty(3), np.empty(3), np.zeros(3)
    attitude = Rotation.from_rotvec([0.0, half * np.cos(omega * dt), half * np.sin(omega * dt)])
    for k in range(1, n):
        increments(alpha[k] / dt, zero, alpha[k - 1] / dt, zero, dt, dt, theta, dv)
        attitude = attitude * Rotation.from_rotvec(theta)
    true = Rotation.from_rotvec([0.0, half * np.cos(omega * t[-1]), half * np.sin(omega * t[-1])])
    drift = (attitude * true.inv()).as_rotvec()[0] / (n - 1)
    exact = 0.5 * np.sin(half) ** 2 * (omega * dt - np.sin(omega * dt))
    algorithm = (2 * np.sin(half) * np.sin(omega * dt / 2)) ** 2 * np.sin(omega * dt) / 12
    assert drift == pytest.approx(algorithm - exact, rel=0.01)
    assert abs(drift) < 0.1 * exact


def test_sculling_leaves_what_savage_says() -> None:
    """Angle θ₀ sin Ωt about x, force a·sin Ωt along y: mean force a·J₁(θ₀) along z, of which (1/12)(α₋×υ + υ₋×α) keeps
    (θ₀a/3Ω dt)·sin²(½Ω·dt)·sin Ω·dt instead of ½θ₀a(1 − sin Ω·dt/Ω·dt). 1 %: terms of order θ₀²."""
    angle, force, omega, dt, cycles = 0.01, 5.0, 2 * np.pi * 10.0, 0.005, 200
    n = round(cycles * 2 * np.pi / omega / dt)
    t = dt * np.arange(-1, n + 1)
    alpha = np.zeros((n + 1, 3))
    speed = np.zeros((n + 1, 3))
    alpha[:, 0], speed[:, 1] = angle * np.diff(np.sin(omega * t)), -force / omega * np.diff(np.cos(omega * t))
    theta, dv, velocity = np.empty(3), np.empty(3), np.zeros(3)
    for k in range(1, n + 1):
        increments(alpha[k] / dt, speed[k] / dt, alpha[k - 1] / dt, speed[k - 1] / dt, dt, dt, theta, dv)
        velocity += Rotation.from_rotvec([angle * np.sin(omega * t[k]), 0, 0]).apply(dv)
    wrong = velocity[2] / (n * dt) - force * j1(angle)
    exact = 0.5 * angle * force * (1 - np.sin(omega * dt) / (omega * dt))
    algorithm = angle * force / (3 * omega * dt) * np.sin(omega * dt / 2) ** 2 * np.sin(omega * dt)
    assert wrong == pytest.approx(algorithm - exact, rel=0.01)
    assert abs(wrong) < 0.1 * exact


@given(*(st.floats(-a, a) for a in (0.5, 0.3, 3.1)), st.floats(-3, 3), st.floats(-3, 3))
@settings(max_examples=60, deadline=None)
def test_levelling_finds_roll_and_pitch_for_a_known_yaw(
    r: float, p: float, y: float, north: float, east: float
) -> None:
    """Exact algebra: rounding alone (1e-9)."""
    force = np.array([north, east, -9.8])
    found = level(rpy_to_dcm(r, p, y).T @ force, force, y)
    np.testing.assert_allclose(found, [r, p], atol=1e-9)


# --- filter and smoother ---------------------------------------------------------------------------------------------


def test_smoother_equals_batch_least_squares() -> None:
    """A random linear problem of 12 epochs, solved at once from prior, dynamics and fixes: equal to 1e-8 of each sigma."""
    rng = np.random.default_rng(3)
    active = states.estimated(tuple(states.GROUPS))
    n, epochs, nav = active.size, 12, states.NAVIGATION
    size = np.where(np.arange(epochs) % 3 == 0, 3, 6)
    top, decay = 0.1 * rng.standard_normal((epochs, nav, n)), rng.uniform(0.8, 1.0, (epochs, 6))
    top[:, :, :nav] += np.eye(nav)
    phi = np.zeros((epochs, n, n))
    phi[:, :nav], phi[:, nav:, nav:] = top, np.eye(n - nav)
    for i in range(6):
        phi[:, nav + i, nav + i] = decay[:, i]
    q, p0 = np.diag(rng.uniform(0.5, 1.0, n)), np.diag(rng.uniform(1.0, 4.0, n))
    H, R = rng.standard_normal((epochs, 6, n)), rng.uniform(0.1, 1.0, (epochs, 6))
    z, start = rng.standard_normal((epochs, 6)), rng.standard_normal(n)
    fix = np.where(np.arange(epochs) == 5, -1, np.arange(epochs))  # one epoch without a fix

    store = kalman.Store.empty(1, epochs, epochs, n)._replace(
        epoch_phi=top, epoch_decay=decay, epoch_measurement=fix, H=H
    )
    estimate = np.empty((epochs, n))
    x, P = start, p0
    for e in range(epochs):
        if e:
            x, P = phi[e - 1] @ x, phi[e - 1] @ P @ phi[e - 1].T + q
        if fix[e] >= 0:
            m = size[e]
            h = H[e, :m]
            S = h @ P @ h.T + np.diag(R[e, :m])
            store.rows[e] = m
            store.S_inv[e, :m, :m] = np.linalg.inv(S)
            store.K[e, :, :m] = P @ h.T @ store.S_inv[e, :m, :m]
            store.y[e, :m] = z[e, :m] - h @ x
            x, P = x + store.K[e, :, :m] @ store.y[e, :m], (np.eye(n) - store.K[e, :, :m] @ h) @ P
        kalman.pack(0.5 * (P + P.T), store.epoch_P[e])
        estimate[e] = x
    out = kalman.Smoothed.empty(epochs, n, np.arange(0, epochs, 2))
    kalman.backward(epochs, active, store, out)

    rows, right = [np.eye(epochs * n)[:n] / np.sqrt(np.diag(p0))[:, None]], [start / np.sqrt(np.diag(p0))]
    for e in range(1, epochs):
        block = np.zeros((n, epochs * n))
        block[:, e * n : (e + 1) * n], block[:, (e - 1) * n : e * n] = np.eye(n), -phi[e - 1]
        rows.append(block / np.sqrt(np.diag(q))[:, None])
        right.append(np.zeros(n))
    for e in np.flatnonzero(fix >= 0):
        m = size[e]
        block = np.zeros((m, epochs * n))
        block[:, e * n : (e + 1) * n] = H[e, :m]
        rows.append(block / np.sqrt(R[e, :m])[:, None])
        right.append(z[e, :m] / np.sqrt(R[e, :m]))
    A, b = np.concatenate(rows), np.concatenate(right)
    best = np.linalg.lstsq(A, b, rcond=None)[0].reshape(epochs, n)
    full = np.linalg.inv(A.T @ A)
    sigma = np.sqrt(np.diag(full)).reshape(epochs, n)
    assert np.abs((estimate + out.correction - best) / sigma).max() < 1e-8
    for e in range(epochs):
        np.testing.assert_allclose(out.covariance[e], full[e * n : e * n + 9, e * n : e * n + 9], rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(out.variance, sigma[::2, nav:] ** 2, rtol=1e-7)


@dataclass(frozen=True)
class Inside:
    """One flight's normalised errors: NEES of filter and smoother at a few epochs, errors over sigma, NIS."""

    nees_filter: np.ndarray
    nees_smoother: np.ndarray
    rms_filter: np.ndarray
    rms_smoother: np.ndarray
    z: np.ndarray
    nis: np.ndarray


@cache
def inside(seed: int) -> Inside:
    this = case(seed)
    s, _ = pos.smooth(this.imu, this.gnss, MODEL, Mounting(LEVER), NavigationSettings(), this.initial)
    *nees, error, left = consistency(this.craft, s, [30.0, 60.0, 90.0])
    t = thinned(output.trajectory(s, []))
    r, v, rpy = errors(this.craft, t)
    scaled = np.concatenate([r / t.sigma_position, v / t.sigma_velocity, rpy / t.sigma_attitude], axis=1)
    return Inside(*nees, np.abs(error), np.abs(left), scaled, s.store.nis[s.store.used])


def test_sigmas_of_filter_and_smoother_are_those_of_their_errors() -> None:
    """NEES of position, velocity, attitude (9): the sum over 12 independent flights is χ² with 108 degrees of freedom.

    Band of 99.9 % for each of the three times. Measured 8.7–10.4 and 9.8–10.7.
    """
    low, high = chi2.ppf([0.0005, 0.9995], 9 * FLIGHTS) / FLIGHTS
    for name in ("nees_filter", "nees_smoother"):
        mean = np.mean([getattr(inside(s), name) for s in range(FLIGHTS)], axis=0)
        print(name, mean, low, high)
        assert ((low < mean) & (mean < high)).all(), (name, mean)


def test_innovations_are_white_and_of_their_declared_size() -> None:
    """NIS has mean 6 and variance 12 a fix; 4 standard errors of the mean over some 6 700 fixes. Measured 6.11."""
    nis = np.concatenate([inside(s).nis for s in range(FLIGHTS)])
    print("NIS", nis.mean(), nis.size)
    assert nis.mean() == pytest.approx(6.0, abs=4 * np.sqrt(12.0 / nis.size))


def test_95_percent_intervals_cover_and_the_smoother_beats_the_filter() -> None:
    """Coverage over 12 flights and 9 states in 0.90–0.99: errors are correlated over tens of seconds, hence the width."""
    z = np.concatenate([inside(s).z for s in range(FLIGHTS)])
    covered = (np.abs(z) < 1.96).mean(axis=0)
    print("coverage", covered)
    assert 0.90 < (np.abs(z) < 1.96).mean() < 0.99
    assert (covered > 0.7).all()  # an attitude error lasts the whole flight: 12 draws, of which three may lie outside
    filtered = np.concatenate([inside(s).rms_filter for s in range(FLIGHTS)])
    smoothed = np.concatenate([inside(s).rms_smoother for s in range(FLIGHTS)])
    ratio = [rms(smoothed[:, a]) / rms(filtered[:, a]) for a in (slice(0, 3), slice(3, 6), slice(6, 9))]
    print("smoother/filter", ratio)
    assert max(ratio) < 0.8  # each of position, velocity, attitude gains at least a fifth


# --- what flights throw at it ----------------------------------------------------------------------------------------


def middle(trajectory: Trajectory) -> slice:
    return slice(*np.searchsorted(trajectory.time, [5.0, trajectory.time[-1] - 5.0]))


def assert_close(this: Case, result: NavigationResult, attitude_deg: float = 0.02) -> None:
    """Within 2 cm an axis (a fix's own sigma) and the attitude's bound, RMS, away from the ends."""
    inner = middle(result.trajectory)
    r, _, turn = (e[inner] for e in errors(this.craft, result.trajectory))
    assert max(rms(r[:, i]) for i in range(3)) < 0.02
    assert np.rad2deg(rms(turn)) < attitude_deg


def test_one_wild_fix_is_rejected_and_named() -> None:
    """50 m is 2 500 sigma; every other fix of the flight stays (gate 1e-6 a fix)."""
    this = case(0)
    latitude = this.gnss.latitude.copy()
    latitude[300] += 50.0 / 6.37e6
    result = this.solve(gnss=replace(this.gnss, latitude=latitude))
    assert result.quality["rejected_times_s"] == [this.gnss.time[300]]
    assert result.quality["fixes"]["rejected"] == 1
    assert_close(this, result)


def test_an_imu_gap_is_bridged_and_reported() -> None:
    """0.5 s missing in straight flight: named, sigmas widen, errors stay below 5 cm and 0.01°, and the rest is as without.

    The bound is no multiple of sigma: the half degree lost in the gap is taken up within a second of fixes, and what is
    quadratic in it (0.003°) is not in the covariance.
    """
    this = case(1)
    kept = (this.imu.time <= 30.0) | (this.imu.time > 30.5)
    result = this.solve(Imu(this.imu.time[kept], this.imu.gyro[kept], this.imu.accel[kept]))
    assert result.quality["imu_gap_count"] == 1
    assert result.quality["imu_gaps"][0] == pytest.approx({"start_s": 30.0, "length_s": 0.51}, abs=1e-6)
    t = result.trajectory
    r, _, turn = errors(this.craft, t)
    after = int(np.searchsorted(t.time, 30.4))
    print("gap", np.abs(r[after : after + 200]).max(), np.rad2deg(np.abs(turn[after : after + 200]).max()))
    assert np.abs(r[after : after + 200]).max() < 0.05
    assert np.rad2deg(np.abs(turn[after : after + 200]).max()) < 0.01
    whole = this.solve().trajectory
    at = int(np.searchsorted(whole.time, t.time[after]))
    assert (t.sigma_attitude[after] > whole.sigma_attitude[at]).all()
    assert (t.sigma_position[after] > whole.sigma_position[at]).all()
    later = slice(after + 200, middle(t).stop)
    assert max(rms(r[later, i]) for i in range(3)) < 0.02 and np.rad2deg(rms(turn[later])) < 0.02


def merged(imu: Imu, groups: np.ndarray) -> Imu:
    """Neighbouring samples as one: the mean over the longer interval, as a slower unit would give it."""
    last = np.cumsum(groups) - 1
    first = last - groups + 1
    mean = [np.add.reduceat(v[: last[-1] + 1], first) / groups[:, None] for v in (imu.gyro, imu.accel)]
    return Imu(imu.time[last], *mean)


def test_unequal_stamps_and_other_rates() -> None:
    """Samples merged at random (10 and 20 ms), in pairs (50 Hz), and 400 Hz: the same accuracy, no gap seen.

    At 50 Hz the vibration (to 25 Hz) reaches Nyquist, hence 0.05° there.
    """
    this = case(0)
    rng = np.random.default_rng(8)
    uneven = np.where(rng.random(this.imu.time.size) < 0.2, 2, 1)
    uneven = uneven[np.cumsum(uneven) <= this.imu.time.size]
    pairs = np.full(this.imu.time.size // 2, 2)
    fast = measured(flown(0, 400.0)[1], MODEL, rng)
    for imu, bound in ((merged(this.imu, uneven), 0.02), (merged(this.imu, pairs), 0.05), (fast, 0.02)):
        result = this.solve(imu)
        assert result.quality["imu_gap_count"] == 0 and result.quality["fixes"]["rejected"] == 0
        assert_close(this, result, bound)


def test_a_unit_mounted_askew_gives_the_same_trajectory() -> None:
    """Rotating data and declaring the mounting is exact algebra: rounding alone (micrometres, nanoradians)."""
    this = case(3)
    angles = np.array([np.pi, 0.1, -np.pi / 2])
    to_body = rpy_to_dcm(*angles)
    turned = Imu(this.imu.time, this.imu.gyro @ to_body, this.imu.accel @ to_body)
    a = this.solve().trajectory
    b = this.solve(turned, Mounting(LEVER, imu_to_body=angles)).trajectory
    np.testing.assert_allclose(b.latitude, a.latitude, atol=1e-13)
    np.testing.assert_allclose(b.height, a.height, atol=1e-6)
    np.testing.assert_allclose(b.rpy, a.rpy, atol=1e-9)


def test_a_thermal_correction_is_taken_off_in_the_units_own_axes() -> None:
    """A drifting bias put on the data and taken off by the correction leaves the trajectory as it was (rounding)."""
    this = case(3)
    angles = np.array([0.2, -0.1, 1.0])
    to_body = rpy_to_dcm(*angles)
    gyro, accel = this.imu.gyro @ to_body, this.imu.accel @ to_body
    knots = np.array([0.0, 60.0, 200.0])
    bias = 1e-4 * np.array([[1.0, -2.0, 3.0], [3.0, 0.0, 1.0], [-2.0, 1.0, 0.0]])
    added = np.stack([np.interp(this.imu.time, knots, bias[:, i]) for i in range(3)], 1)
    correction = ThermalCorrection(knots, bias, 10 * bias, bias, bias, np.zeros((3, 6)))
    mounting = Mounting(LEVER, imu_to_body=angles)
    a = this.solve(Imu(this.imu.time, gyro, accel), mounting).trajectory
    b = this.solve(Imu(this.imu.time, gyro + added, accel + 10 * added), mounting, correction=correction).trajectory
    np.testing.assert_allclose(b.rpy, a.rpy, atol=1e-9)
    np.testing.assert_allclose(b.height, a.height, atol=1e-6)


def test_a_lever_arm_left_out_moves_the_result_to_the_antenna() -> None:
    """Along the straight legs the estimate lies one lever arm off, towards the antenna (0.1 m: the wrong swing in the turn)."""
    this = case(4)
    t = this.solve(mounting=Mounting(np.zeros(3))).trajectory
    part = slice(*np.searchsorted(t.time, [10.0, 40.0]))
    r, _, _ = errors(this.craft, t)
    in_body = np.einsum("nji,nj->ni", rpy_to_dcm(*t.rpy.T), -r)[part].mean(axis=0)
    print("lever seen", in_body)
    np.testing.assert_allclose(in_body, LEVER, atol=0.1)
    assert_close(this, this.solve())


def test_positions_alone_suffice() -> None:
    this = case(5)
    bare = replace(this.gnss, velocity=None, sigma_velocity=None)
    result = this.solve(gnss=bare)
    assert result.quality["innovation_nis_expected"] == 3.0
    assert result.quality["innovation_nis_mean"] == pytest.approx(3.0, abs=4 * np.sqrt(6.0 / bare.time.size))
    assert_close(this, result)


def test_aligns_itself_in_motion() -> None:
    """Without `initial`: course for yaw (crab angle 0.03 rad), refined by the turn to 0.02° (sigma at 120 s: 0.002°)."""
    this = case(6)
    result = this.solve(initial=None)
    assert result.quality["alignment"].startswith("in motion")
    _, _, turn = errors(this.craft, result.trajectory)
    print("in motion", np.rad2deg(rms(turn)), result.quality["passes"])
    assert_close(this, result)


def test_aligns_itself_from_rest() -> None:
    """Car with 25 s standstill, then 15 m/s and two bends: 2 cm and 0.05° (velocity of 15 m/s levers yaw less)."""
    this = case(-1)
    result = this.solve(initial=None)
    assert result.quality["alignment"].startswith("from rest")
    _, _, turn = errors(this.craft, result.trajectory)
    print("from rest", np.rad2deg(rms(turn)), result.quality["passes"])
    assert_close(this, result, 0.05)


def test_what_cannot_be_solved_says_so_in_one_line() -> None:
    this = case(0)
    with pytest.raises(InputError, match="overlap"):
        this.solve(gnss=replace(this.gnss, time=this.gnss.time + 1e4))
    with pytest.raises(InputError, match="outside the IMU"):
        this.solve(initial=(500.0, np.zeros(3), SIGMA_RPY))
    still = replace(this.gnss, velocity=np.zeros_like(this.gnss.velocity))
    with pytest.raises(InputError, match="heading"):
        this.solve(gnss=still, initial=None)


# --- shared campaigns ------------------------------------------------------------------------------------------------


@needs("clean")
def test_clean_within_the_bounds_of_its_truth() -> None:
    """Within 0.02 m, 0.003° and 0.01°; measured 1.4 mm, 0.0001°, 0.0003° although no thermal model is applied here."""
    campaign = read_campaign(SHARED / "clean")
    keys = campaign.flight("F1").initial
    assert keys is not None
    angles = np.deg2rad([[getattr(keys, f"{s}{n}_deg") for n in ("roll", "pitch", "yaw")] for s in ("", "sigma_")])
    instrument = campaign.instrument
    assert instrument.imu is not None and instrument.mounting is not None
    t = run(
        campaign.imu("F1"),
        campaign.gnss("F1"),
        instrument.imu,
        instrument.mounting,
        NavigationSettings(),
        initial=(keys.time_s, angles[0], angles[1]),
    ).trajectory
    true = np.load(SHARED / "clean-truth" / "trajectory.npz")
    spans = json.loads((SHARED / "clean-truth" / "truth.json").read_text())["lines"].values()
    chosen = np.any([(true["t"] >= s["t0"]) & (true["t"] <= s["t1"]) for s in spans], axis=0)
    assert chosen.sum() > 1000
    time, llh, ypr = (true[k][chosen] for k in ("t", "llh", "ypr"))
    north, east = geodesy.radii_of_curvature(llh[:, 0])
    scale = np.stack([north + llh[:, 2], (east + llh[:, 2]) * np.cos(llh[:, 0]), np.ones(len(llh))], -1)
    estimate = np.stack([np.interp(time, t.time, v) for v in (t.latitude, t.longitude, t.height)], -1)
    for axis in ((estimate - llh) * scale).T:
        assert rms(axis) <= 0.02
    for i, bound in enumerate((0.003, 0.003, 0.01)):
        off = np.interp(time, t.time, np.unwrap(t.rpy[:, i])) - ypr[:, 2 - i]
        assert np.rad2deg(rms((off + np.pi) % (2 * np.pi) - np.pi)) <= bound


@needs("walk")
def test_walk_meets_the_withheld_fixes() -> None:
    """A real consumer-grade walk with outages of seconds and no `initial`: 0.2 m RMS horizontally (measured 0.039 m)."""
    campaign = read_campaign(SHARED / "walk")
    instrument = campaign.instrument
    assert instrument.imu is not None and instrument.mounting is not None
    t = run(
        campaign.imu("F1"), campaign.gnss("F1"), instrument.imu, instrument.mounting, NavigationSettings()
    ).trajectory
    withheld = np.load(SHARED / "walk-truth" / "withheld.npz")["gnss"]
    time, latitude, longitude = withheld[:, 0], np.deg2rad(withheld[:, 1]), np.deg2rad(withheld[:, 2])
    arm = rpy_to_dcm(*(np.interp(time, t.time, np.unwrap(t.rpy[:, i])) for i in range(3)))
    arm = arm @ instrument.mounting.imu_to_antenna
    north, east = geodesy.radii_of_curvature(latitude)
    off_north = (latitude - np.interp(time, t.time, t.latitude)) * (north + withheld[:, 3]) - arm[:, 0]
    off_east = (longitude - np.interp(time, t.time, t.longitude)) * (east + withheld[:, 3]) * np.cos(latitude)
    assert np.sqrt(np.mean(off_north**2 + (off_east - arm[:, 1]) ** 2)) < 0.2
