"""Residual problems: what they refuse, and several as one."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.residual_problem import Basis, Candidate, Parameter, Parameters, ResidualProblem, joined

CANDIDATE = Candidate("offset", {"k": Parameter("m", 1.0)})


def problem(n: int, slope: float, **changes: object) -> ResidualProblem:
    def residual(parameters: Parameters) -> np.ndarray:
        return slope * np.arange(n) - parameters.get("offset", {}).get("k", 0.0)

    given: dict[str, object] = {
        "stage": "made-up",
        "residual": residual,
        "candidates": (CANDIDATE,),
        "group": np.repeat([4, 7], n // 2),
        "series": np.zeros(n, int),
        "time": np.arange(n) * 1.0,
        "nuisance": np.ones((n, 1)),
        "covariates": {"time": np.arange(n) * 1.0, f"only {n}": np.ones(n)},
        "group_names": {4: "first", 7: "second"},
    }
    return ResidualProblem(**(given | changes))  # type: ignore[arg-type]


def test_problems_of_one_instrument_are_joined_under_one_set_of_parameters() -> None:
    parts = {"F1": problem(6, 1.0), "F2": problem(10, 2.0, channel=np.repeat([0, 1], 5))}
    both = joined(parts)
    for k in (0.0, 0.25):
        given = {"offset": {"k": k}}
        np.testing.assert_array_equal(both.residual(given), np.concatenate([p.residual(given) for p in parts.values()]))
    assert both.group.tolist() == [0] * 3 + [1] * 3 + [2] * 5 + [3] * 5
    assert both.series.tolist() == [0] * 6 + [1] * 10 and both.channel is not None
    assert both.channel.tolist() == [0] * 6 + [1] * 5 + [2] * 5
    assert both.group_names == {0: "F1 first", 1: "F1 second", 2: "F2 first", 3: "F2 second"}
    np.testing.assert_array_equal(both.nuisance, np.repeat(np.eye(2), [6, 10], axis=0))
    assert list(both.covariates) == ["time"] and joined({"F1": parts["F1"]}) is parts["F1"]


def test_bases_are_joined_where_a_coefficient_means_the_same_everywhere() -> None:
    def with_bases(n: int, count: int) -> ResidualProblem:
        columns = np.arange(n * 2.0).reshape(n, 2)
        at, curves = np.arange(1.0 * n), {"b": np.full((n, 2), 1.0 * n)}
        named = {
            "common": Basis(columns, np.ones(n), at, curves, common=True),
            "own": Basis(columns, np.ones(n), at, curves),
        }
        more = Basis(np.ones((n, count)), np.ones(n), at, curves, common=True)
        return problem(n, 1.0, covariates={**named, "unlike": more})

    parts = {"F1": with_bases(6, 1), "F2": with_bases(10, 2)}
    both = joined(parts)
    assert list(both.covariates) == ["common"]
    basis = both.covariates["common"]
    assert isinstance(basis, Basis) and basis.at.size == 10 and basis.curves["b"].tolist() == [[10.0, 10.0]] * 10
    assert basis.values.size == 16
    np.testing.assert_array_equal(
        basis.columns,
        np.vstack([p.covariates["common"].columns for p in parts.values()]),  # type: ignore[union-attr]
    )


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"time": np.zeros(6)}, "time does not grow"),
        ({"series": np.array([0, 1, 0, 1, 0, 1])}, "one stretch"),
        ({"nuisance": np.ones((5, 1))}, "nuisance has 5"),
        ({"covariates": {"x": np.ones(5)}}, "covariate x"),
        ({"candidates": (CANDIDATE, CANDIDATE)}, "named twice"),
    ],
)
def test_a_problem_that_is_none_is_refused(changes: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        problem(6, 1.0, **changes)
