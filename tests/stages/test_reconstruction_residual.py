"""Spectral residual: white on clean data, the simulator's effects undone by the model's, and the loop's answer with them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import loop_spectral as made_up
import numpy as np
import pytest

from pipeline.campaign import read_campaign
from pipeline.errors import InputError
from pipeline.records import Tracks
from pipeline.residual_problem import Basis, ResidualProblem
from pipeline.truth import read_true_poses
from stages.closed_loop import LoopSettings, run
from stages.reconstruction import SpectralLine, residual_problem
from stages.reconstruction.forward import Forward
from stages.reconstruction.panel_pixels import REACHES, panel_pixels, pixel_noise, reaches
from stages.tracking.collinearity import project, target_points, true_camera
from tsmftis.fourier import quadrature

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "campaigns"
GIVEN: Mapping[str, Mapping[str, float]] = {
    "opd_scale": {"scale": 0.004},
    "opd_quadratic": {"quadratic": 5e-11},
    "fringe_tilt": {"tilt": 1.5e-9},
    "detector_nonlinearity": {"a": 0.08},
    "channel_fringe": {"amplitude": 0.03, "thickness": 8.3e-6, "phase": 0.7},
    "response_scale": {"scale": -0.03},
}


@cache
def clean() -> ResidualProblem:
    return made_up.problem({}, 7)


def per_degree(problem: ResidualProblem, parameters: Mapping[str, Mapping[str, float]]) -> float:
    """χ² per degree of freedom."""
    r = problem.residual(parameters)
    return float(r @ r / (r.size - problem.nuisance.shape[1]))


def correlation(problem: ResidualProblem, lag: int) -> float:
    """Of the residual's neighbours, mean over the series."""
    r = problem.residual({})
    parts = [r[problem.series == s] for s in np.unique(problem.series)]
    return float(np.mean([(p[lag:] @ p[:-lag]) / (p @ p) for p in parts]))


def test_residual_of_clean_data_is_white_and_of_the_noises_size() -> None:
    problem = clean()
    assert problem.group.size == 14 * made_up.COLS
    # 1750 degrees of freedom: 0.034 is one standard deviation of their χ², 0.024 one of a correlation
    assert per_degree(problem, {}) == pytest.approx(1.0, abs=0.12)
    assert all(abs(correlation(problem, lag)) < 0.09 for lag in (1, 2, 3, 10))
    r = problem.residual({})
    for name, covariate in problem.covariates.items():
        x = covariate.values if isinstance(covariate, Basis) else covariate
        if not np.isfinite(x).all():
            continue
        eighth = np.argsort(np.argsort(x)) * 8 // x.size
        means = [r[eighth == i].mean() * np.sqrt((eighth == i).sum()) for i in range(8)]
        assert np.abs(means).max() < 3.7, name


@pytest.mark.parametrize("name", GIVEN)
def test_an_effect_of_the_simulator_is_undone_by_the_model_at_the_same_parameters(name: str) -> None:
    given = {name: GIVEN[name]}
    problem = made_up.problem(given, 7)
    assert per_degree(problem, {}) > 1.5
    assert per_degree(problem, given) == pytest.approx(1.0, abs=0.12)


def test_effects_that_are_known_already_belong_to_the_null() -> None:
    given = {"detector_nonlinearity": GIVEN["detector_nonlinearity"]}
    other = {"camera_latency": {"latency": 0.007}}
    problem = residual_problem(**made_up.made(given, 7), effects=given | other)  # type: ignore[arg-type]
    assert "detector_nonlinearity" not in {c.effect for c in problem.candidates}
    assert len(problem.candidates) == len(GIVEN) - 1
    assert per_degree(problem, {}) == pytest.approx(1.0, abs=0.12)


def test_loop_adds_nothing_to_clean_data() -> None:
    result = run(clean(), LoopSettings(), 1)
    assert result.verdict == "no_effect"


@pytest.mark.parametrize(
    ("covariate", "curve", "effect", "size", "expected"),
    [
        ("path by OPD", "path", "opd_scale", 1e-5, lambda x: 1e-5 * x),
        ("path by row", "path", "fringe_tilt", 1e-12, lambda x: 1e-12 * (x - 31.5)),
        ("wavenumber", "response", "response_scale", 1e-3, lambda x: 1e-3 + 0.0 * x),
        ("signal level", "signal", "response_scale", 1e-3, lambda x: 1e-3 * x),
        ("signal level", "signal", "detector_nonlinearity", 1e-4, lambda x: -1e-4 * x**2 / 12000.0),
    ],
)
def test_curves_are_those_of_effects_where_an_effect_is_one(
    covariate: str, curve: str, effect: str, size: float, expected: Callable[[np.ndarray], np.ndarray]
) -> None:
    """The residual that an effect leaves is met by the covariate's columns; the curve is the effect's, but for a constant."""
    problem = clean()
    basis = problem.covariates[covariate]
    assert isinstance(basis, Basis)
    key = made_up.STRENGTH[effect]
    left = problem.residual({effect: {key: -size}}) - problem.residual({effect: {key: size}})
    left -= problem.nuisance @ np.linalg.lstsq(problem.nuisance, left, rcond=None)[0]
    both = np.column_stack([basis.columns, problem.nuisance])
    both /= np.linalg.norm(both, axis=0)
    fit = np.linalg.lstsq(both, left, rcond=1e-9)[0]
    assert np.linalg.norm(left - both @ fit) < 0.05 * np.linalg.norm(left)
    found = basis.curves[curve] @ (fit[: basis.columns.shape[1]] / np.linalg.norm(basis.columns, axis=0)) / 2.0
    told = expected(basis.at)
    difference = found - told
    if covariate != "wavenumber":
        difference -= np.polyval(np.polyfit(basis.at, difference, int(effect == "detector_nonlinearity")), basis.at)
    assert np.abs(difference).max() < 0.1 * np.abs(told).max()


@pytest.mark.parametrize(
    ("effect", "size", "covariate", "start"),
    [("opd_scale", 1e-3, "path by OPD", 0.0), ("fringe_tilt", 1e-10, "path by row", 31.5)],
)
def test_an_effect_outside_the_library_is_learnt_with_its_covariate(
    effect: str, size: float, covariate: str, start: float
) -> None:
    given = {effect: {made_up.STRENGTH[effect]: size}}
    result = run(made_up.problem(given, 8, effect), LoopSettings(), 1)
    assert [s.effect for s in result.steps] == [f"learned:{covariate}"]
    table = result.steps[0].table
    assert table is not None
    slope = np.polyfit(np.subtract(table["covariate"], start), table["path"], 1)[0]
    assert slope == pytest.approx(size, rel=0.15)


def test_a_response_that_is_wrong_by_a_slope_is_learnt_over_wavenumber() -> None:
    made = made_up.made({}, 9)
    calibration = made["calibration"]
    share = np.linspace(-0.025, 0.025, calibration.wavenumber.size)  # type: ignore[attr-defined]
    bent = replace(calibration, response=calibration.response * (1.0 + share))  # type: ignore[attr-defined,type-var]
    result = run(residual_problem(**{**made, "calibration": bent}), LoopSettings(), 1)  # type: ignore[arg-type]
    assert [s.effect for s in result.steps] == ["learned:wavenumber"]
    table = result.steps[0].table
    assert table is not None
    slope = np.polyfit(table["covariate"], table["response"], 1)[0]
    assert slope * np.ptp(calibration.wavenumber) == pytest.approx(-0.05, rel=0.3)  # type: ignore[attr-defined]


def test_loop_names_a_non_linearity_and_nothing_else() -> None:
    result = run(made_up.problem({"detector_nonlinearity": {"a": 0.02}}, 8), LoopSettings(), 1)
    assert [s.effect for s in result.steps] == ["detector_nonlinearity"]
    found = result.steps[0].parameters["a"]
    assert abs(found.value - 0.02) < 3.0 * found.sigma
    assert found.sigma < 0.001


def test_noise_comes_from_pixels_that_see_a_panel_twice() -> None:
    line, made = made_up.made({}, 3)["lines"][0], made_up.made({}, 3)  # type: ignore[index]
    pixels = panel_pixels(line.frames, line.tracks, made["calibration"], made["camera"], 100)  # type: ignore[arg-type]
    read, gain = pixel_noise(pixels.part(pixels.distance <= 0.5))
    # 4 electrons a DN, 6 DN and rounding
    assert gain == pytest.approx(0.25, rel=0.08)
    assert read == pytest.approx(36.0 + 1.0 / 12.0, rel=0.25)


def test_tracks_that_err_bring_the_reach_in_and_leave_the_residual_white() -> None:
    made = made_up.made({}, 7)
    lines = [
        replace(one, tracks=replace(one.tracks, row=one.tracks.row + 1.8))
        for one in made["lines"]  # type: ignore[attr-defined]
    ]
    line = lines[0]
    pixels = panel_pixels(line.frames, line.tracks, made["calibration"], made["camera"], 256)  # type: ignore[arg-type]
    noise = pixel_noise(pixels.part(pixels.distance <= REACHES[0]))
    assert np.median(reaches(pixels, noise, 7)) <= 0.5
    problem = residual_problem(**{**made, "lines": lines})  # type: ignore[arg-type]
    assert per_degree(problem, {}) == pytest.approx(1.0, abs=0.2)


def test_targets_without_reference_or_partly_seen_are_handled() -> None:
    made = made_up.made({}, 7, lines=1)
    (line,) = made["lines"]  # type: ignore[misc]
    row, col = line.tracks.row.copy(), line.tracks.col.copy()
    half, little = col[0, 1, Tracks.CENTRE] > 70.0, col[0, 2, Tracks.CENTRE] > 20.0
    row[0, 1][:, half], col[0, 1][:, half] = np.nan, np.nan
    row[0, 2][:, little], col[0, 2][:, little] = np.nan, np.nan
    targets = replace(line.targets, reference=("", *line.targets.reference[1:]))
    partly = SpectralLine(line.frames, replace(line.tracks, row=row, col=col), targets, "L1")
    problem = residual_problem(**{**made, "lines": [partly]})  # type: ignore[arg-type]
    assert list(problem.group_names.values()) == ["L1 T2", "L1 T4", "L1 T5", "L1 T6", "L1 T7"]
    assert 48 <= np.count_nonzero(problem.group == 0) <= 75
    assert per_degree(problem, {}) == pytest.approx(1.0, abs=0.2)
    nothing = replace(targets, reference=("",) * 7)
    with pytest.raises(InputError, match="no target with a reference"):
        residual_problem(**{**made, "lines": [replace(line, targets=nothing)]})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="references"):
        residual_problem(**{**made, "references": None})  # type: ignore[arg-type]


def test_tabulated_interferogram_is_the_integral() -> None:
    wavenumber = np.linspace(1.0e6, 2.35e6, 541)
    radiance = np.stack([1.0 + np.cos((wavenumber - 1.6e6) / 1e5), np.ones(541)])
    phase, response = np.array([0.3, 0.2, -0.1]), np.exp(-(((wavenumber - 1.7e6) / 3e5) ** 2))
    forward = Forward(wavenumber, radiance, -5e-6, 2e-5, 2)
    x = np.random.default_rng(1).uniform(-5e-6, 2e-5, 50)
    argument = 2.0 * np.pi * np.outer(x, wavenumber) + phase @ forward.powers
    strength = radiance * response * quadrature(wavenumber)
    expected = np.cos(argument) @ strength.T
    table, *slopes = forward.tables(response, phase, True)
    assert np.abs(table(x) - expected).max() < 5e-5 * np.abs(expected).max()
    for k, slope in enumerate(slopes):
        along = -(np.sin(argument) * forward.powers[k]) @ strength.T
        assert np.abs(slope(x) - along).max() < 5e-5 * np.abs(along).max()


def shared(name: str) -> ResidualProblem:
    """The problem of a shared campaign, tracks by its true poses."""
    root, truth = SHARED / name, SHARED / f"{name}-truth"
    if not (root.is_dir() and truth.is_dir()):
        pytest.skip(f"{root} and its truth are not here: set TSMFTIS_SHARED to the folder that holds campaigns/")
    campaign = read_campaign(root)
    camera, mounting = campaign.instrument.camera, campaign.instrument.mounting
    assert camera is not None and mounting is not None and campaign.instrument.interferometer is not None
    lines = []
    for entry in campaign.flight("F1").lines:
        frames, targets = campaign.frames("F1", entry.id), campaign.targets("F1", entry.id)
        poses = true_camera(frames.time, read_true_poses(truth / f"{entry.id}.npz", frames.time.size), mounting)
        (lat0, lat1), (lon0, lon1) = targets.latitude[[0, -1]], targets.longitude[[0, -1]]
        course = float(np.arctan2((lon1 - lon0) * np.cos(lat0), lat1 - lat0))
        row, col = project(target_points(targets, course), poses, camera)
        lines.append(SpectralLine(frames, Tracks(("true",), targets.ids, row[None], col[None]), targets, entry.id))
    return residual_problem(
        lines, campaign.calibration(), campaign.references(), camera, campaign.instrument.interferometer
    )


@pytest.mark.parametrize("name", ["clean", "hysu"])
def test_residual_of_shared_clean_campaigns_is_white(name: str) -> None:
    problem = shared(name)
    assert per_degree(problem, {}) == pytest.approx(1.0, abs=0.1)
    assert all(abs(correlation(problem, lag)) < 0.08 for lag in (1, 2, 3))


def test_undeclared_b_has_its_non_linearity_named_and_nothing_else() -> None:
    result = run(shared("undeclared-b"), LoopSettings(), 1)
    assert [s.effect for s in result.steps] == ["detector_nonlinearity"]
    found = result.steps[0].parameters["a"]
    assert abs(found.value - 0.08) < 2.0 * found.sigma
    assert found.sigma < 0.001
