"""The thermal stage: its arithmetic against independent oracles, its model against held-out profiles, its guards."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from numpy.typing import NDArray
from scipy.special import digamma, polygamma
from scipy.stats import multivariate_normal
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct
from sklearn.linear_model import BayesianRidge

from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.records import Chamber, StaticAttitude, Temperatures
from stages.thermal import ThermalModel, ThermalResult, ThermalSettings, run, training, verification_table, verify_run
from stages.thermal.baselines import fit_polynomial, fit_traditional_rbf, folds, rbf_design
from stages.thermal.binning import binned_means, block_means
from stages.thermal.evidence import log_evidence, posterior, reestimate
from stages.thermal.features import channel_features, smoothed
from stages.thermal.hyperparameters import alternatives
from stages.thermal.network import fit_network, whitened
from stages.thermal.oracles import fit_gaussian_process, fit_ridge
from stages.thermal.targets import bias_samples, expected_reading, thinned
from stages.thermal.training import fit_channel

Array = NDArray[np.float64]

DEG_PER_H = np.deg2rad(1.0) / 3600.0
MICRO_G = 9.80665e-6
GYRO_NOISE, ACCEL_NOISE = 0.006 * DEG_PER_H, 1.2 * MICRO_G  # of 100 s means
TRAIN = [(0, 20), (90, 20), (100, 50), (220, 50), (246.7, -30), (366, -30)]
VERIFY = [(0, 20), (60, 20), (110, -30), (170, -30), (200, 30), (260, 30), (280, -30), (340, -30)]


# ----------------------------------------------------------------------------------------- a chamber of the test's own


def lagged(signal: Array, dt: float, tau: float) -> Array:
    """First-order lag, started settled."""
    out, state = np.empty_like(signal), signal[0]
    keep = np.exp(-dt / tau)
    for i, value in enumerate(signal):
        state = value + (state - value) * keep
        out[i] = state
    return out


def chamber(profile: list[tuple[float, float]], seed: int, dt: float = 2.0) -> tuple[Chamber, Array]:
    """A static run through (minute, °C) corners, and the true bias (n, 6): smooth in T, Ṫ and the gradients."""
    rng = np.random.default_rng(seed)
    minutes, degrees = np.array(profile).T
    time = np.arange(0.0, minutes[-1] * 60.0, dt)
    oven = np.interp(time, minutes * 60.0, degrees)
    thermometers = np.stack([lagged(oven, dt, tau) for tau in (700.0, 620.0, 250.0)], axis=1)
    accel_t = lagged(oven, dt, 400.0)
    t, a = thermometers.mean(axis=1), (thermometers[:, 0] - thermometers[:, 2]) / 10.0
    rate, accel_rate = np.gradient(t, dt) / 0.04, np.gradient(accel_t, dt) / 0.04
    x, z = (t - 10.0) / 30.0, (accel_t - 10.0) / 30.0
    gyro = [0.02 * x**2 + 0.01 * rate, 0.015 * np.sin(2 * x) - 0.01 * a, 0.02 * x + 0.006 * x * rate]
    accel = [150 * z + 40 * z**2, 120 * np.sin(1.5 * z) + 30 * accel_rate, -200 * z + 30 * z**3 - 20 * accel_rate]
    bias = np.column_stack([g * DEG_PER_H for g in gyro] + [f * MICRO_G for f in accel])
    noise = rng.standard_normal(bias.shape) * np.repeat([GYRO_NOISE, ACCEL_NOISE], 3) * np.sqrt(100.0 / dt)
    stood = Chamber(
        "own",
        time,
        np.zeros((len(time), 3)),
        np.zeros((len(time), 3)),
        Temperatures(
            time,
            np.repeat(thermometers[:, None], 3, axis=1) + 0.02 * rng.standard_normal((len(time), 3, 3)),
            np.repeat(accel_t[:, None], 3, axis=1) + 0.02 * rng.standard_normal((len(time), 3)),
        ),
        StaticAttitude(np.deg2rad(40.0), 30.0, 0.01, -0.02, 0.6),
        None,
    )
    reading = expected_reading(stood) + bias + noise
    return replace(stood, gyro=reading[:, :3], accel=reading[:, 3:]), bias


FAST = ThermalSettings(centres=(10,), start_widths=((2.0, 2.0),), baselines=())


def part(own: Chamber, of: slice, name: str, attitude: bool = True, turn_on: Array | float = 0.0) -> Chamber:
    """A stretch of a run as a run of its own, with another turn-on bias (6,)."""
    t, off = own.temperatures, np.broadcast_to(turn_on, 6)
    return replace(
        own,
        name=name,
        time=own.time[of],
        gyro=own.gyro[of] + off[:3],
        accel=own.accel[of] + off[3:],
        temperatures=Temperatures(t.time[of], t.gyro[of], t.accel[of]),
        attitude=own.attitude if attitude else None,
    )


@pytest.fixture(scope="module")
def train() -> Chamber:
    return chamber(TRAIN, 1)[0]


@pytest.fixture(scope="module")
def result(train: Chamber) -> ThermalResult:
    return run([train], [chamber(VERIFY, 2)[0]], ThermalSettings())


# -------------------------------------------------------------------------------------------------- evidence framework


def problem(seed: int = 3, count: int = 150, units: int = 20) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((count, units)) * np.logspace(0, -2, units)
    return design, design @ rng.standard_normal(units) + 0.1 * rng.standard_normal(count)


def test_evidence_equals_bayesian_ridge() -> None:
    """scikit-learn's α is 2β (a noise precision), its λ is 2α (a weight precision); same fixed point, same model."""
    design, target = problem()
    oracle = BayesianRidge(
        alpha_1=0, alpha_2=0, lambda_1=0, lambda_2=0, fit_intercept=False, tol=1e-14, max_iter=20000
    ).fit(design, target)
    ours = reestimate(torch.tensor(design), torch.tensor(target), 1.0, 1.0, tolerance=1e-13)
    np.testing.assert_allclose([2 * ours.beta, 2 * ours.alpha], [oracle.alpha_, oracle.lambda_], rtol=1e-6)
    np.testing.assert_allclose(ours.weights.numpy(), oracle.coef_, rtol=1e-6, atol=1e-9)
    eigenvalues = np.linalg.eigvalsh(design.T @ design)
    gamma = (oracle.alpha_ * eigenvalues / (oracle.lambda_ + oracle.alpha_ * eigenvalues)).sum()
    assert ours.gamma == pytest.approx(gamma, rel=1e-6)
    new = np.random.default_rng(4).standard_normal((7, design.shape[1]))
    deviation = np.sqrt(((new @ ours.factor.numpy()) ** 2).sum(axis=1) + 0.5 / ours.beta)
    np.testing.assert_allclose(deviation, oracle.predict(new, return_std=True)[1], rtol=1e-6)


def test_means_and_sums_give_the_same_model() -> None:
    """With E_w, E_d as means, H = (2α/M)I + (2β/N)ΦᵀΦ and γ = M − (2α/M)·tr H⁻¹: α and β grow by M and N, no more."""
    design, target = problem()
    count, units = design.shape
    alpha, beta = 1.0, 1.0
    for _ in range(2000):
        hessian = 2 * alpha / units * np.eye(units) + 2 * beta / count * design.T @ design
        weights = np.linalg.solve(hessian, 2 * beta / count * design.T @ target)
        gamma = units - 2 * alpha / units * np.trace(np.linalg.inv(hessian))
        alpha = gamma / (2 * (weights**2).mean())
        beta = (count - gamma) / (2 * ((target - design @ weights) ** 2).mean())
    sums = reestimate(torch.tensor(design), torch.tensor(target), 1.0, 1.0)
    np.testing.assert_allclose([alpha / units, beta / count, gamma], [sums.alpha, sums.beta, sums.gamma], rtol=1e-6)
    np.testing.assert_allclose(weights, sums.weights.numpy(), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("count", [8, 40])
@pytest.mark.parametrize("alpha", [1e-6, 1.0, 1e6])
def test_gamma_is_bounded(count: int, alpha: float) -> None:
    """0 ≤ γ ≤ M, also with more weights than data; it goes to its ends as the regularisation does."""
    design, target = problem(count=count)
    gamma = posterior(torch.tensor(design), torch.tensor(target), alpha, 1.0).gamma
    assert 0.0 <= gamma <= min(count, design.shape[1]) * (1 + 1e-6)
    if alpha == 1e6:
        assert gamma < 0.01


def test_log_evidence_is_the_density_of_the_target() -> None:
    """ln N(y; 0, ΦΦᵀ/(2α) + I/(2β)), stationary in α and β at MacKay's fixed point."""
    design, target = problem(count=30, units=6)
    alpha, beta = 0.7, 20.0
    log_alpha, log_beta = (torch.tensor(np.log(v), requires_grad=True) for v in (alpha, beta))
    covariance = design @ design.T / (2 * alpha) + np.eye(30) / (2 * beta)
    ours = float(log_evidence(torch.tensor(design), torch.tensor(target), log_alpha, log_beta).detach())
    assert ours == pytest.approx(multivariate_normal(np.zeros(30), covariance).logpdf(target), rel=1e-9)
    fixed = reestimate(torch.tensor(design), torch.tensor(target), 1.0, 1.0)
    with torch.no_grad():
        log_alpha.fill_(np.log(fixed.alpha))
        log_beta.fill_(np.log(fixed.beta))
    log_evidence(torch.tensor(design), torch.tensor(target), log_alpha, log_beta).backward()
    assert log_alpha.grad is not None and log_beta.grad is not None
    assert max(abs(float(log_alpha.grad)), abs(float(log_beta.grad))) < 1e-6


def test_network_with_a_centre_at_every_datum_is_a_gaussian_process() -> None:
    """Same mean and standard deviation as scikit-learn's, inside and (Gaussian units faded) just outside the data."""
    rng = np.random.default_rng(5)
    x = rng.uniform(-1.5, 1.5, (60, 2))
    y = 3.0 + np.sin(2 * x[:, 0]) + 0.5 * x[:, 1] + 0.05 * rng.standard_normal(60)
    net = fit_network(x, y, centres=(60,), start_widths=((1.0, 1.0),))
    # The most probable network, without the sample of what its hyperparameters might have been.
    amplitude, ratio = 0.5 / net.alpha[0], net.ratio[0]
    kernel = ConstantKernel(amplitude) * RBF(net.widths[0]) + ConstantKernel(amplitude * ratio**2) * DotProduct(0.0)
    oracle = GaussianProcessRegressor(kernel, alpha=0.5 / net.beta[0], optimizer=None)
    with np.errstate(divide="ignore"):
        oracle.fit(x, (y - net.constant) / net.scale)
    at = rng.uniform(-2.0, 2.0, (200, 2))
    mean, sigma = net.predict(at)
    mean_gp, sigma_gp = oracle.predict(at, return_std=True)
    np.testing.assert_allclose(mean, net.constant + net.scale * mean_gp, atol=1e-4 * net.scale)
    np.testing.assert_allclose(np.sqrt(net.members(at)[1][0]), sigma_gp, rtol=1e-2)
    # Not knowing the hyperparameters, and the constant to σ/√N only, makes the whole less sure than that.
    assert np.mean(sigma / (net.scale * sigma_gp)) > 1.0


def test_alternatives_are_a_sample_of_the_density() -> None:
    """Mean and covariance of a Gaussian in three dimensions, one of them cut by a bound, and of a skewed one (ln of a gamma
    variate, whose mean is digamma(k) and variance trigamma(k)), within 4 standard errors of a sample as large as the draws'."""
    covariance = np.array([[0.5, 0.2, 0.0], [0.2, 0.3, 0.0], [0.0, 0.0, 0.1]])
    inverse, shape = np.linalg.inv(covariance), 5.0

    def loss(p: np.ndarray) -> float:
        return float(0.5 * p[:3] @ inverse @ p[:3] - shape * p[3] + np.exp(p[3]))

    def gradient(p: np.ndarray) -> np.ndarray:
        return np.r_[inverse @ p[:3], -shape + np.exp(p[3])]

    bounds = np.array([[-9.0, 9.0], [-9.0, 9.0], [0.0, 9.0], [-9.0, 9.0]])
    mode = np.array([0.0, 0.0, 0.0, np.log(shape)])
    points, share, effective = alternatives(loss, gradient, mode, bounds, 300, seed=1)
    assert 80.0 < effective <= 384.0
    assert abs(share.sum() - 1.0) < 1e-12 and (points[:, 2] >= 0.0).all()
    error = 4.0 / np.sqrt(80.0)
    mean = share @ points
    np.testing.assert_allclose(mean[:2], 0.0, atol=error * np.sqrt(covariance.diagonal()[:2]).max())
    assert abs(mean[2] - np.sqrt(0.1 * 2.0 / np.pi)) < error * np.sqrt(0.1)
    assert abs(mean[3] - digamma(shape)) < error * np.sqrt(polygamma(1, shape))
    spread = (points[:, :2] - mean[:2]).T @ (share[:, None] * (points[:, :2] - mean[:2]))
    np.testing.assert_allclose(spread, covariance[:2, :2], atol=0.5 * error * 1.5)


# ------------------------------------------------------------------------------------------------ targets and features


def test_an_ideal_imu_has_no_bias() -> None:
    own, _ = chamber(TRAIN[:2], 1)
    ideal = replace(
        own,
        gyro=np.tile(expected_reading(own)[:3], (len(own.time), 1)),
        accel=np.tile(expected_reading(own)[3:], (len(own.time), 1)),
    )
    assert np.abs(bias_samples(ideal)).max() < 1e-15
    level = replace(own, attitude=StaticAttitude(np.deg2rad(40.0), 0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(expected_reading(level)[3:], [0.0, 0.0, -9.80169], atol=1e-4)
    np.testing.assert_allclose(expected_reading(level)[:3] / 7.292115e-5, [0.766044, 0.0, -0.642788], atol=1e-6)


def test_without_attitude_the_mean_is_the_reference(train: Chamber) -> None:
    assert np.abs(bias_samples(replace(train, attitude=None)).mean(axis=0)).max() < 1e-12
    notes = run([replace(train, attitude=None)], [], ThermalSettings(centres=(10,), start_widths=((2.0, 2.0),))).notes
    assert any("no attitude" in note for note in notes)


def test_blocks_are_of_time_and_full() -> None:
    time = np.delete(np.arange(0.0, 45.0), slice(10, 15))
    np.testing.assert_allclose(block_means(time, time[:, None], 10.0)[:, 0], [4.5, 24.5, 34.5])


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("step", [0.01, 1.0, 7.0])
def test_features_are_the_same_at_any_sampling(step: float, causal: bool) -> None:
    """A ramp is followed without lag, up to its ends; a smooth curve alike at any rate."""
    time = np.arange(0.0, 1200.0, step)
    value, rate = smoothed(time, (20.0 + 0.05 * time)[:, None], time, 30.0, causal)
    late = time > (250.0 if causal else -1.0)
    np.testing.assert_allclose(value[late, 0], 20.0 + 0.05 * time[late], atol=1e-6)
    np.testing.assert_allclose(rate[late, 0], 0.05, atol=1e-8)
    curve, at = np.sin(2 * np.pi * time / 1500.0), np.array([300.0, 700.0])
    dense = np.arange(0.0, 1200.0, 0.5)
    expected = smoothed(dense, np.sin(2 * np.pi * dense / 1500.0)[:, None], at, 30.0, causal)
    for ours, theirs in zip(smoothed(time, curve[:, None], at, 30.0, causal), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=4e-3 if step > 1.5 else 1e-4)


def test_causal_features_ignore_the_future() -> None:
    time = np.arange(0.0, 600.0)
    changed = np.where(time > 400.0, 50.0, 20.0)[:, None]
    at = np.array([395.0])
    constant = smoothed(time, np.full((600, 1), 20.0), at, 30.0, True)
    for ours, theirs in zip(smoothed(time, changed, at, 30.0, True), constant, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert smoothed(time, changed, at, 30.0)[1][0, 0] > 0.1


def test_causal_features_start_quietly() -> None:
    """The first slopes, all noise, stay near zero."""
    time = np.arange(0.0, 300.0)
    noisy = (20.0 + 0.02 * np.random.default_rng(7).standard_normal(300))[:, None]
    assert np.abs(smoothed(time, noisy, time, 30.0, True)[1]).max() < 2e-3


def test_one_thermometer_means_no_gradients(train: Chamber) -> None:
    one = replace(train.temperatures, gyro=train.temperatures.gyro[:, :, :1])
    assert [f.shape[1] for f in channel_features(one, train.time[:5], 30.0)] == [2] * 6
    # A logger that writes its one thermometer three times: the gradients do not vary and are not used.
    three = replace(one, gyro=np.repeat(one.gyro, 3, axis=2))
    fast = ThermalSettings(centres=(10,), start_widths=((2.0, 2.0),))
    models = [run([replace(train, temperatures=t)], [], fast).model for t in (one, three)]
    ours, theirs = (model.correction(t).gyro for model, t in zip(models, (one, three), strict=True))
    np.testing.assert_allclose(ours, theirs, atol=1e-6 * np.ptp(ours))


def test_fast_runs_are_thinned_to_the_same_blocks() -> None:
    own, _ = chamber(TRAIN[:2], 1, dt=0.5)
    thin = thinned(own, 60.0, 1.5)
    assert len(thin.time) == len(own.time) // 3
    means = [block_means(c.time, np.hstack([c.gyro, c.temperatures.accel]), 60.0) for c in (thin, own)]
    np.testing.assert_allclose(means[0], means[1], rtol=1e-9)


# ----------------------------------------------------------------------------------------------------------- the model


def test_held_out_profile_reaches_the_noise_floor(result: ThermalResult) -> None:
    """Median over axes within 1.15 of the floor, none above 1.35; better than the baselines; 95 % intervals cover."""
    gyro = {k: np.array(v) / 0.006 for k, v in result.verification["gyro_std_deg_per_h"].items()}
    accel = {k: np.array(v) / 1.2 for k, v in result.verification["accel_std_ug"].items()}
    for figures in (gyro, accel):
        assert list(figures) == ["raw", "polynomial", "multi_polynomial", "rbf", "bayesian_rbf"]
        assert np.median(figures["bayesian_rbf"]) <= 1.15
        assert figures["bayesian_rbf"].max() <= 1.35
        for worse in ("raw", "polynomial", "rbf"):
            assert figures["bayesian_rbf"].mean() < figures[worse].mean()
    held_out = result.figures["verify"][0]
    covered = np.abs(held_out["left"]["bayesian_rbf"]) < 1.96 * held_out["sigma"]
    assert 0.91 <= covered.mean() <= 0.985


def test_training_table_states_the_evidence(result: ThermalResult) -> None:
    table = result.figures["training"]
    assert [row["channel"] for row in table] == [f"{s}_{a}" for s in ("gyro", "accel") for a in "xyz"]
    assert all(0.0 < row["gamma"] < row["m"] and row["n"] == 366 for row in table)
    noise = np.array([row["noise_sigma"] for row in table]) / np.repeat([GYRO_NOISE, ACCEL_NOISE], 3)
    np.testing.assert_allclose(noise, np.sqrt(100.0 / 60.0), rtol=0.15)
    assert any("N = 366" in note for note in result.notes)


def test_model_file_gives_the_same_correction(result: ThermalResult, train: Chamber, tmp_path: Path) -> None:
    write_dataset(result.model.to_dataset(), tmp_path / "model.nc")
    again = ThermalModel.from_file(tmp_path / "model.nc")
    ours, theirs = result.model.correction(train.temperatures), again.correction(train.temperatures)
    for name in ("time", "gyro", "accel", "sigma_gyro", "sigma_accel", "distance"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    write_dataset(ours.to_dataset(), tmp_path / "correction.nc")
    with pytest.raises(InputError, match="schema"):
        ThermalModel.from_file(tmp_path / "correction.nc")


DAMAGES: dict[str, tuple[Callable[[xr.Dataset], Any], str]] = {
    "one array lacks": (lambda d: d.drop_vars("gyro_y_polynomial_coefficients"), "gyro_y_polynomial_coefficients"),
    "all arrays of a channel lack": (lambda d: _without(d, "accel_z_bayesian_rbf"), "accel_z_bayesian_rbf"),
    "all methods of a channel lack": (lambda d: _without(d, *(f"gyro_x_{m}" for m in d.methods.split())), "gyro_x_"),
    "weights that are not finite": (
        lambda d: d.accel_x_bayesian_rbf_weights.values.__setitem__((0, 0), np.nan),
        "not finite",
    ),
    "another shape": (
        lambda d: d.assign(gyro_x_rbf_centres=(("a", "b"), d.gyro_x_rbf_centres.values[:, :1])),
        "gyro_x_rbf_centres",
    ),
    "a number for a list": (lambda d: d.assign(gyro_x_mean=((), 1.0)), "gyro_x_mean"),
    "text for a number": (lambda d: d.attrs.update(smoothing_s="half a minute"), "smoothing_s"),
    "time of nothing": (lambda d: d.attrs.update(smoothing_s=0.0), "smoothing_s"),
    "unknown method": (lambda d: d.attrs.update(methods="polynomial magic"), "magic"),
    "no methods": (lambda d: d.attrs.update(methods=""), "no method"),
    "no count of thermometers": (lambda d: d.attrs.pop("thermometers"), "thermometers"),
}


def _without(dataset: xr.Dataset, *prefixes: str) -> xr.Dataset:
    return dataset.drop_vars([n for n in dataset.variables if str(n).startswith(prefixes)])


@pytest.mark.parametrize(("damage", "named"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_model_file_is_refused(
    result: ThermalResult, tmp_path: Path, damage: Callable[[xr.Dataset], Any], named: str
) -> None:
    """No array may lack, be of another shape or hold what is no number: the error names it and the file."""
    dataset = result.model.to_dataset().copy(deep=True)
    changed = damage(dataset)
    write_dataset(changed if isinstance(changed, xr.Dataset) else dataset, tmp_path / "model.nc")
    with pytest.raises(InputError, match=r"model\.nc.*" + named):
        ThermalModel.from_file(tmp_path / "model.nc")


def test_same_input_same_bytes(train: Chamber) -> None:
    fast = ThermalSettings(centres=(20,), start_widths=((2.0, 2.0),))
    first, second = (run([train], [], fast).model.correction(train.temperatures) for _ in range(2))
    assert first.gyro.tobytes() == second.gyro.tobytes()
    assert first.sigma_accel.tobytes() == second.sigma_accel.tobytes()


def test_correction_at_the_readings_or_slower(result: ThermalResult, train: Chamber) -> None:
    """200 Hz readings do not make 200 Hz corrections; a slow log keeps its own times."""
    t = train.temperatures
    fast = np.arange(0.0, 100.0, 0.005)
    rapid = Temperatures(fast, np.full((len(fast), 3, 3), 20.0), np.full((len(fast), 3), 20.0))
    assert len(result.model.correction(rapid).time) < 100
    np.testing.assert_array_equal(result.model.correction(t).time, t.time)


def test_outside_the_chamber_sigma_grows_and_the_correction_stays_bounded(result: ThermalResult) -> None:
    def at(degrees: float) -> tuple[Array, Array, float]:
        steady = Temperatures(np.arange(100.0), np.full((100, 3, 3), degrees), np.full((100, 3), degrees))
        c = result.model.correction(steady)
        return np.r_[c.gyro[50], c.accel[50]], np.r_[c.sigma_gyro[50], c.sigma_accel[50]], float(c.distance[50].max())

    (inside, sigma_in, d_in), (_, sigma_out, d_out), (far, sigma_far, d_far) = at(20.0), at(75.0), at(500.0)
    assert d_in == 0.0 and 0.0 < d_out < 1.5 < d_far
    assert (sigma_out > 1.5 * sigma_in).all() and (sigma_far > sigma_out).all()
    raw = np.r_[result.figures["verify"][0]["raw"].std(axis=0)]
    assert (np.abs(far) < 10.0 * raw + np.abs(inside)).all()
    np.testing.assert_allclose(at(1e5)[0], at(1e6)[0])


def test_baselines_are_no_straw_men() -> None:
    """Cross-validation finds a cubic and follows a bump; folds are contiguous stretches."""
    rng = np.random.default_rng(6)
    x = np.linspace(-2, 2, 300)[:, None]
    cubic = fit_polynomial(x, x[:, 0] ** 3 - x[:, 0] + 0.1 * rng.standard_normal(300), (1, 2, 3, 4, 5))
    assert len(cubic.coefficients) >= 4
    bump = np.exp(-2 * x[:, 0] ** 2)
    rbf = fit_traditional_rbf(x, bump + 0.01 * rng.standard_normal(300), (4, 8, 12), (0.5, 1.0), 0)
    assert np.abs(rbf.predict(x)[0] - bump).max() < 0.02
    assert (np.diff(folds(300)) != 0).sum() == 14 and set(folds(300)) == set(range(5))


# -------------------------------------------------------------------------------------------------------------- guards


def test_stuck_thermometer_leaves_the_channel_uncompensated(train: Chamber) -> None:
    t = train.temperatures
    gyro, accel = t.gyro.copy(), t.accel.copy()
    gyro[:, 1, 2], accel[:, 0] = 21.0, 25.0
    stuck = replace(train, temperatures=replace(t, gyro=gyro, accel=accel))
    result = run([stuck], [stuck], ThermalSettings(centres=(10,), start_widths=((2.0, 2.0),)))
    left_out = [n.split(" is left")[0] for n in result.notes if "uncompensated" in n]
    assert left_out == ["Channel gyro_y", "Channel accel_x"]
    assert any("shell thermometer" in n for n in result.notes)
    correction = result.model.correction(t)
    assert not correction.gyro[:, 1].any() and correction.gyro[:, 0].any()
    rms = np.sqrt((block_means(train.time, bias_samples(train), 60.0)[:, 1] ** 2).mean())
    np.testing.assert_allclose(correction.sigma_gyro[:, 1], rms)
    left = result.verification["gyro_std_deg_per_h"]
    assert left["bayesian_rbf"][1] == left["raw"][1]


def test_thermometer_stuck_in_flight_leaves_that_channel_alone(result: ThermalResult, train: Chamber) -> None:
    accel = train.temperatures.accel.copy()
    accel[:, 2] = 25.0
    correction = result.model.correction(replace(train.temperatures, accel=accel))
    assert not correction.accel[:, 2].any() and correction.accel[:, 1].any()


def test_a_channel_that_takes_nothing_off_is_at_no_distance(train: Chamber, tmp_path: Path) -> None:
    """Neither one that the chamber refused nor one that is stuck in flight; why it was refused comes back from the file."""
    t = train.temperatures
    stuck = replace(train, temperatures=replace(t, accel=np.where(np.arange(3) == 0, 25.0, t.accel)))
    model = run([stuck], [], FAST).model
    write_dataset(model.to_dataset(), tmp_path / "model.nc")
    again = ThermalModel.from_file(tmp_path / "model.nc")
    assert "accelerometer" not in again.channels[3].refused and "thermometer does not move" in again.channels[3].refused
    assert not any(c.refused for i, c in enumerate(again.channels) if i != 3)
    hot = replace(t, gyro=t.gyro + 60.0, accel=t.accel + 60.0)
    for readings in (hot, replace(hot, gyro=np.where(np.arange(3)[:, None] == 1, 99.0, hot.gyro))):
        correction = again.correction(readings)
        quiet = ~np.hstack([correction.gyro, correction.accel]).any(axis=0)
        assert quiet[3] and not correction.distance[:, quiet].any()
        assert (correction.distance[:, ~quiet].max(axis=0) > 0.5).all()
    assert [n for n in correction.warnings if "gyro y" in n and "accel x" in n]


@pytest.mark.parametrize(
    "method", ["polynomial", "multi_polynomial", "rbf", "gaussian_process", "bayesian_ridge", "bayesian_rbf"]
)
def test_sigma_of_every_method_is_of_the_function_and_grows_outside(method: str) -> None:
    """Over six draws of the noise: errors of the mean are as large as sigma says where the method can follow the law (a line),
    and sigma far below the noise of 1; outside the training data it grows with the distance."""
    x = np.column_stack([np.linspace(-1.7, 1.7, 100), np.cos(9.0 * np.linspace(-1.7, 1.7, 100))])
    law = 3.0 * x[:, 0] + 1.0
    chosen = FAST.model_copy(update={"baselines": () if method == "bayesian_rbf" else (method,), "rbf_nodes": (6,)})
    ratio = []
    for seed in range(6):
        bias = law + np.random.default_rng(seed).standard_normal(100)
        channel = fit_channel(x, bias, np.arange(100) == 0, chosen, True)
        mean, sigma = channel.predict(x, method)
        ratio.append((mean - law) / sigma)
        assert np.median(sigma) < 0.6
        far = [channel.predict(np.array([[t, 0.0]]), method)[1][0] for t in (1.7, 2.5, 4.0)]
        assert far[0] < far[1] < far[2] * 1.001 and far[2] > 2.0 * far[0]
    # Of 60 draws the RMS of error over sigma is 1.0 for both polynomials, and 1.6 for scikit-learn's ridge, whose sigma is taken
    # as it is. Six draws, of about fifteen independent errors, give these within a quarter. Bumps cannot follow a line.
    bounds = {
        "rbf": (0.0, np.inf),
        "bayesian_ridge": (0.3, 2.0),
        "gaussian_process": (0.3, 1.6),
        "bayesian_rbf": (0.3, 1.6),
    }
    low, high = bounds.get(method, (0.7, 1.4))
    assert low < np.sqrt(np.mean(np.square(ratio))) < high


def test_a_small_sample_of_hyperparameters_is_told(train: Chamber, monkeypatch: pytest.MonkeyPatch) -> None:
    """A density that few draws hit: the effective size falls below five, and a note says so."""
    _, share, effective = alternatives(
        lambda p: float(1e4 * (p[0] - 0.01) ** 2), lambda p: 0.0 * p, np.zeros(1), np.array([[-9.0, 9.0]]), 12, 0
    )
    assert effective < 5.0 and share.sum() == pytest.approx(1.0)
    monkeypatch.setattr(training, "FEWEST_DRAWS", 1e3)
    result = run([train], [], FAST)
    assert any("independent draws" in note for note in result.notes)
    assert all(5.0 < row["effective_draws"] < 1e3 for row in result.figures["training"])


def test_constant_temperature_teaches_nothing(train: Chamber) -> None:
    t = train.temperatures
    still = replace(train, temperatures=replace(t, gyro=np.full_like(t.gyro, 20.0), accel=np.full_like(t.accel, 20.0)))
    result = run([still], [], ThermalSettings())
    assert sum("uncompensated" in n for n in result.notes) == 6
    assert result.verification == {} and result.figures["training"] == []
    assert not result.model.correction(t).gyro.any()


def test_users_mistakes_are_named(train: Chamber, result: ThermalResult) -> None:
    with pytest.raises(InputError, match="no chamber run"):
        run([], [], ThermalSettings())
    moved = replace(train, gyro=train.gyro + np.where(train.time > 9000, 0.1, 0.0)[:, None])
    with pytest.raises(InputError, match="moved"):
        run([moved], [], ThermalSettings())
    upside_down = replace(train, attitude=replace(train.attitude, roll=np.pi))
    with pytest.raises(InputError, match="roll_deg"):
        run([upside_down], [], ThermalSettings())
    with pytest.raises(InputError, match="block_s"):
        run([chamber([(0, 20), (10, 40)], 1)[0]], [], ThermalSettings())
    one = replace(train.temperatures, gyro=train.temperatures.gyro[:, :, :1])
    with pytest.raises(InputError, match="three thermometers"):
        result.model.correction(one)
    with pytest.raises(ValueError, match="smoothing"):
        ThermalSettings.model_validate({"smoothing": 30})


# ------------------------------------------------------------------------------------------------------- several runs

STEP = np.r_[0.05, -0.05, 0.025, 0.0, 0.0, 0.0] * DEG_PER_H + np.r_[0.0, 0.0, 0.0, 50.0, 50.0, -50.0] * MICRO_G


@pytest.mark.parametrize(
    ("attitude", "turn_on"),
    [
        ((True, True), None),
        ((True, True), (0.03 * DEG_PER_H, 50.0 * MICRO_G)),
        ((False, False), None),
        ((True, False), None),
    ],
    ids=["both", "both, turn-on declared", "none", "first"],
)
def test_runs_may_differ_by_a_turn_on_bias(train: Chamber, attitude: tuple[bool, bool], turn_on: Any) -> None:
    """The run cut at its middle, the second half off by 0.05 °/h and 50 µg, or with its mean for a reference: every method leaves
    of another profile what the whole run's does (network: 1.4 of the floor; before, 4 and 40), and 95 % intervals cover."""
    half = len(train.time) // 2
    runs = [
        part(train, slice(0, half), "first", attitude[0]),
        part(train, slice(half, None), "second", attitude[1], STEP),
    ]
    chosen = ThermalSettings(baselines=("polynomial", "multi_polynomial", "rbf", "bayesian_ridge"), centres=(20,))
    verify = chamber(VERIFY, 2)[0]
    found, whole = run(runs, [verify], chosen, turn_on), run([train], [verify], chosen)
    floor = np.repeat([0.006, 1.2], 3)
    for method in found.model.methods:
        ours, theirs = (
            np.r_[r.verification["gyro_std_deg_per_h"][method], r.verification["accel_std_ug"][method]] / floor
            for r in (found, whole)
        )
        assert (ours < (1.4 if method == "bayesian_rbf" else 1.5 * theirs + 1.0)).all(), (method, ours, theirs)
    shown = found.figures["verify"][0]
    left = shown["left"]["bayesian_rbf"]
    assert (np.abs(left - left.mean(axis=0)) < 1.96 * shown["sigma"]).mean() > 0.9
    if all(attitude):
        apart = np.array([np.diff(row["run_offsets"])[0] for row in found.figures["training"]])
        np.testing.assert_allclose(
            apart, STEP, atol=0.35 * np.abs(STEP).max(where=np.arange(6) < 3, initial=0), rtol=0.35
        )


def test_runs_that_stand_at_one_temperature_each_still_teach(train: Chamber) -> None:
    """Soaks with attitudes and no turn-on steps: offsets are found to be small, and what the levels say is learnt."""
    soaks = [chamber([(0, t), (60, t)], 20 + i)[0] for i, t in enumerate(np.linspace(-25.0, 45.0, 12))]
    found = run([replace(s, name=str(i)) for i, s in enumerate(soaks)], [], FAST).model
    steady = [
        Temperatures(np.arange(100.0), np.full((100, 3, 3), t), np.full((100, 3), t)) for t in (-20.0, 10.0, 40.0)
    ]
    accel = np.array([found.correction(s).accel[50, 0] for s in steady]) / MICRO_G
    z = (np.array([-20.0, 10.0, 40.0]) - 10.0) / 30.0
    np.testing.assert_allclose(accel, 150.0 * z + 40.0 * z**2, atol=5.0)


def test_without_any_attitude_the_mean_correction_over_the_chamber_is_zero(train: Chamber) -> None:
    half = len(train.time) // 2
    runs = [part(train, s, str(i), False) for i, s in enumerate((slice(0, half), slice(half, None)))]
    model = run(runs, [], ThermalSettings(baselines=("polynomial", "rbf"))).model
    for method in model.methods:
        correction = model.correction(train.temperatures, method)
        taken = np.hstack([correction.gyro, correction.accel])
        assert (np.abs(taken.mean(axis=0)) < 0.02 * taken.std(axis=0)).all()


def test_pooled_verification_is_about_each_runs_own_mean(result: ThermalResult) -> None:
    own = chamber(VERIFY, 2)[0]
    shown = [verify_run(result.model, part(own, slice(None), "v", turn_on=k * STEP), 100.0) for k in (0.0, 10.0)]
    one, two = verification_table(shown[:1]), verification_table(shown)
    for key in ("gyro_std_deg_per_h", "accel_std_ug"):
        np.testing.assert_allclose(two[key]["bayesian_rbf"], one[key]["bayesian_rbf"], rtol=1e-9)
    apart = np.subtract(two["accel_mean_ug"]["bayesian_rbf"], one["accel_mean_ug"]["bayesian_rbf"])
    np.testing.assert_allclose(apart, 5.0 * STEP[3:] / MICRO_G, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "suspect"),
    [
        ({}, ()),
        ({"roll": 0.01 + np.deg2rad(2.0)}, ("accel_y",)),
        ({"yaw": 0.6 + np.pi}, ("gyro_x", "gyro_y")),
        ({"latitude": np.deg2rad(-40.0)}, ("gyro_z",)),
    ],
    ids=["right", "roll", "yaw", "latitude"],
)
def test_a_wrong_attitude_is_suspected(train: Chamber, change: dict[str, float], suspect: tuple[str, ...]) -> None:
    """Roll off by 2°, yaw by 180°, the other hemisphere: a level of 34 000 µg or 19 °/h, and a warning that names the keys."""
    assert train.attitude is not None
    wrong = replace(train, attitude=replace(train.attitude, **change))
    found = run([wrong], [], FAST, (0.01 * DEG_PER_H, 50.0 * MICRO_G))
    assert any("the mean bias is" in n for n in found.notes)
    assert len(found.model.doubts) == bool(suspect)
    for word in (*suspect, *(("roll_deg", "yaw_deg", "latitude_deg") if suspect else ())):
        assert word in found.model.doubts[0]
    assert run([wrong], [], FAST).model.doubts == ()  # nothing declared: the level is told, not judged


# ---------------------------------------------------------------------------------------- thermometers and their times


def flight(of: slice = slice(None)) -> tuple[Array, Temperatures]:
    """Times of an hour's inertial data, and readings once a second for a part of it."""
    time = np.arange(0.0, 3600.0, 0.1)
    at = np.arange(0.0, 3600.0)[of]
    warm = 25.0 - 10.0 * np.exp(-at / 900.0)
    return time, Temperatures(at, np.tile(warm[:, None, None], (1, 3, 3)), np.tile(warm[:, None], (1, 3)))


def test_readings_that_cover_the_flight_are_not_warned_of(result: ThermalResult) -> None:
    """Nor are a second missing at the ends and the intervals of a slow log."""
    time, readings = flight()
    plain, told = result.model.correction(readings), result.model.correction(readings, of=time)
    np.testing.assert_array_equal(plain.gyro, told.gyro)
    assert told.uncovered_s == 0.0 and told.warnings == []
    slow = Temperatures(readings.time[::300], readings.gyro[::300], readings.accel[::300])
    assert slow.uncovered(time, "slow.nc") == []


@pytest.mark.parametrize(
    ("of", "seconds", "probe"),
    [
        (np.s_[:480], 3120.0, 2000.0),
        (np.s_[1800:], 1800.0, 900.0),
        (np.r_[0:600, 2000:3600], 1401.0, 1300.0),
    ],
    ids=["end", "begin", "gap"],
)
def test_without_readings_sigma_is_that_of_no_correction(
    result: ThermalResult, of: Any, seconds: float, probe: float
) -> None:
    time, readings = flight(of)
    correction = result.model.correction(readings, of=time)
    assert correction.uncovered_s == pytest.approx(seconds, abs=2.0)
    assert any(f"{correction.uncovered_s:.0f} s" in w for w in correction.warnings)
    assert correction.time[0] <= time[0] + 1.0 and correction.time[-1] >= time[-1] - 1.0
    prior = np.array([c.prior_sigma for c in result.model.channels])
    sigma = np.hstack([correction.sigma_gyro, correction.sigma_accel])
    at_probe = [np.interp(probe, correction.time, s) for s in sigma.T]
    assert (at_probe >= prior * (1.0 - 1e-9)).all()
    at_readings = sigma[np.isin(correction.time, readings.time)]
    assert (np.median(at_readings, axis=0) < 0.5 * prior).all()


def test_thermometers_on_another_clock_are_refused(result: ThermalResult) -> None:
    time, readings = flight()
    for late in (1e6, -3540.0):
        with pytest.raises(InputError, match=r"F1/imu\.nc.*time_temperature.*in common.*clock"):
            result.model.correction(replace(readings, time=readings.time + late), of=time, where="F1/imu.nc")


@pytest.mark.parametrize("last", [1e13, 1e300])
def test_a_wrong_stamp_costs_no_memory(train: Chamber, result: ThermalResult, last: float) -> None:
    time = np.r_[train.time[:-1], last]
    spoiled = replace(train, name="bad.nc", time=time, temperatures=replace(train.temperatures, time=time))
    for call in (lambda: run([spoiled], [], FAST), lambda: verify_run(result.model, spoiled, 100.0)):
        with pytest.raises(InputError, match=r"bad\.nc.*times of the thermometers.*wrong stamp"):
            call()
    _, readings = flight()
    for step in (1.0, 0.005):
        bad = replace(readings, time=np.r_[step * readings.time[:-1], last])
        with pytest.raises(InputError, match=r"imu\.nc.*wrong stamp"):
            result.model.correction(bad, where="imu.nc")


def test_bins_are_counted_by_what_they_hold() -> None:
    time = np.array([5.0, 5.4, 6.0, 9.9, 10.0, 1e13])
    means, count = binned_means(time, np.column_stack([time, 2.0 * time]), 1.0)
    np.testing.assert_array_equal(count, [2, 1, 1, 1, 1])
    np.testing.assert_allclose(means[:, 0], [5.2, 6.0, 9.9, 10.0, 1e13])
    np.testing.assert_allclose(means[:, 1], 2.0 * means[:, 0])


def test_runs_of_other_thermometers_are_refused_by_name(train: Chamber, result: ThermalResult) -> None:
    one = replace(
        train, name="one.nc", temperatures=replace(train.temperatures, gyro=train.temperatures.gyro[:, :, :1])
    )
    with pytest.raises(InputError, match=r"1 in one\.nc and 3 in own"):
        run([train, one], [], FAST)
    with pytest.raises(InputError, match=r"one\.nc.*one thermometer a gyro.*three thermometers"):
        verify_run(result.model, one, 100.0)
    with pytest.raises(InputError, match=r"own.*three thermometers a gyro.*one thermometer"):
        verify_run(run([one], [], FAST).model, train, 100.0)


def test_a_method_that_was_not_fitted_is_refused(result: ThermalResult, train: Chamber) -> None:
    for method in ("bayesian_rfb", "gaussian_process", "none"):
        with pytest.raises(InputError, match=rf"{method}.*polynomial, multi_polynomial, rbf, bayesian_rbf"):
            result.model.correction(train.temperatures, method)


def test_a_standard_deviation_wants_ten_blocks(result: ThermalResult) -> None:
    own = chamber(VERIFY, 2)[0]
    with pytest.raises(InputError, match=r"short.*9 blocks of 100 s where 10"):
        verify_run(result.model, part(own, slice(0, 450), "short"), 100.0)
    assert len(verify_run(result.model, part(own, slice(0, 500), "enough"), 100.0)["raw"]) == 10


# ---------------------------------------------------------------------------------------------------- shared campaigns


def test_shared_campaign_clean_reaches_its_floor() -> None:
    """Floor: standard deviation of 100 s means of raw minus truth; all gyro and accelerometer axes."""
    shared = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared"))
    folder, truth = shared / "campaigns/clean/chamber", shared / "campaigns/clean-truth/thermal.npz"
    if not (folder.is_dir() and truth.is_file()):
        pytest.skip(f"{shared}/campaigns/clean is not here: set TSMFTIS_SHARED to the folder that holds campaigns/")
    train, verify = (Chamber.from_file(folder / f"{name}.nc", name) for name in ("train", "verify"))
    result = run([train], [verify], ThermalSettings())
    with np.load(truth) as z:
        noise = np.hstack([verify.gyro - z["verify_gyro"], verify.accel - z["verify_accel"]])
    floor = noise[: len(noise) // 100 * 100].reshape(-1, 100, 6).mean(axis=1).std(axis=0)
    left = (
        np.r_[
            np.array(result.verification["gyro_std_deg_per_h"]["bayesian_rbf"]) * DEG_PER_H,
            np.array(result.verification["accel_std_ug"]["bayesian_rbf"]) * MICRO_G,
        ]
        / floor
    )
    assert np.median(left[:3]) <= 1.15 and np.median(left[3:]) <= 1.15
    assert left.max() <= 1.35


# ------------------------------------------------------------------------------------------------------ noise and oracles


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_the_colour_of_the_noise_is_found_and_intervals_still_cover(rho: float) -> None:
    """AR(1) noise on a smooth function, 12 draws of 400: ρ within 0.12 of the truth in the mean, and 95 % intervals of the
    function hold 85–99.9 % (errors are correlated over the whole curve). Narrowed to what white noise would allow, ρ = 0.8 covers
    less than 80 %."""
    covered, blind, found = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        t = np.linspace(-1.5, 1.5, 400)
        x = np.column_stack([t, 0.5 * np.cos(4.0 * t)])
        function = np.sin(2.0 * t) + 0.3 * x[:, 1]
        noise = np.empty(400)
        noise[0] = rng.standard_normal()
        for i in range(1, 400):
            noise[i] = rho * noise[i - 1] + np.sqrt(1.0 - rho**2) * rng.standard_normal()
        net = fit_network(x, function + 0.2 * noise, centres=(20,), start_widths=((1.0, 2.0),))
        mean, sigma = net.predict(x)
        found.append(net.correlation[0])
        covered.append((np.abs(mean - function) < 1.96 * sigma).mean())
        narrow = np.sqrt((1.0 - net.correlation) / (1.0 + net.correlation))
        white = replace(net, correlation=0.0 * net.correlation, factor=net.factor * narrow[:, None, None])
        blind.append((np.abs(mean - function) < 1.96 * white.predict(x)[1]).mean())
    print("colour", rho, np.mean(found), np.mean(covered), np.mean(blind))
    assert abs(np.mean(found) - rho) < 0.12
    assert 0.85 < np.mean(covered) < 0.999
    if rho == 0.8:
        assert np.mean(blind) < 0.8


def test_whitening_leaves_white_noise_of_the_same_size() -> None:
    """r_t → (r_t − ρ·r_{t−1})/√(1 − ρ²): unit variance and no correlation over 20 000 samples (4 standard errors)."""
    rng = np.random.default_rng(2)
    noise = np.empty(20000)
    noise[0] = rng.standard_normal()
    for i in range(1, noise.size):
        noise[i] = 0.7 * noise[i - 1] + np.sqrt(1.0 - 0.49) * rng.standard_normal()
    starts = torch.as_tensor(np.arange(noise.size) % 5000 == 0)
    white = whitened(torch.as_tensor(noise), 0.7, starts).numpy()
    assert white.var() == pytest.approx(1.0, abs=4 * np.sqrt(2.0 / noise.size))
    assert abs(np.mean(white[1:] * white[:-1])) < 4 / np.sqrt(noise.size)
    np.testing.assert_array_equal(white[::5000], noise[::5000])


def test_the_yardsticks_are_scikit_learns() -> None:
    """Gaussian process and BayesianRidge kept as plain arrays predict what scikit-learn itself predicts (1e-6 of the scale)."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.5, 1.5, (80, 2))
    y = 5.0 + 2.0 * np.sin(2 * x[:, 0]) + x[:, 1] + 0.1 * rng.standard_normal(80)
    at = rng.uniform(-2.0, 2.0, (50, 2))
    ours = fit_gaussian_process(x, y, 0)
    kernel = ConstantKernel(ours.amplitude) * RBF(ours.widths)
    oracle = GaussianProcessRegressor(kernel, alpha=(ours.noise_sigma / ours.scale) ** 2, optimizer=None)
    mean, sigma = oracle.fit(x, (y - ours.constant) / ours.scale).predict(at, return_std=True)
    np.testing.assert_allclose(ours.predict(at)[0], ours.constant + ours.scale * mean, atol=1e-6 * ours.scale)
    np.testing.assert_allclose(ours.predict(at)[1], ours.scale * sigma, atol=1e-5 * ours.scale)
    ridge = fit_ridge(x, y, 0)
    design = rbf_design(x, ridge.centres, ridge.width)
    oracle_ridge = BayesianRidge(
        alpha_1=0, alpha_2=0, lambda_1=0, lambda_2=0, fit_intercept=False, tol=1e-8, max_iter=3000
    ).fit(design, y)
    mean, total = oracle_ridge.predict(rbf_design(at, ridge.centres, ridge.width), return_std=True)
    np.testing.assert_allclose(ridge.predict(at)[0], mean, rtol=1e-4)
    inside = (np.abs(at) < 1.4).all(axis=1)  # outside the data `spread` comes on top
    said = np.hypot(ridge.predict(at)[1], ridge.noise_sigma)
    np.testing.assert_allclose(said[inside], total[inside], rtol=1e-3)
    assert (said >= total * (1.0 - 1e-3)).all()


def test_a_model_with_every_method_comes_back_from_its_file(train: Chamber, tmp_path: Path) -> None:
    every = ("polynomial", "multi_polynomial", "rbf", "gaussian_process", "bayesian_ridge")
    chosen = ThermalSettings(centres=(10,), start_widths=((2.0, 2.0),), block_s=200.0, baselines=every)
    model = run([train], [], chosen).model
    write_dataset(model.to_dataset(), tmp_path / "model.nc")
    again = ThermalModel.from_file(tmp_path / "model.nc")
    assert again.methods == (*every, "bayesian_rbf")
    features = model.features(train.temperatures, train.time[::200])
    for method in again.methods:
        for a, b, f in zip(model.channels, again.channels, features, strict=True):
            np.testing.assert_array_equal(a.predict(f, method)[0], b.predict(f, method)[0])
