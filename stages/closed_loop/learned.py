"""Learned terms: an additive spline of a covariate, for structure that no declared effect accounts for.

    r = N·β + Σ_j c_j·b_j(x) + e,        −2·l(λ) with c ~ N(0, λ·I)

b are natural cubic spline columns of the covariate x on its quantiles, turned so that their penalty ∫(b'')² is diagonal and one
(Demmler–Reinsch) [1]_; the straight line has none. λ comes from the restricted likelihood of the mixed model.

Functions
---------
spline_columns   the columns: the straight line first, then by growing roughness
splines_of       those of every covariate of a problem
ridge            the penalties that the data ask for
curve            the term on a few values of the covariate, for a table

References
----------
.. [1] D. Ruppert, M. P. Wand, R. J. Carroll, Semiparametric Regression, Cambridge 2003, chapters 3 and 4.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pipeline.residual_problem import Basis, ResidualProblem
from stages.closed_loop.noise import Layout
from stages.closed_loop.score_test import project

Array = NDArray[np.float64]

STRENGTHS = 10.0 ** np.arange(-6.0, 4.5, 0.5)  # λ over the mean information of a column, inverted
TABLE = 25


def knots(covariate: Array, count: int) -> Array:
    """Quantiles of the covariate where it is known, each once."""
    known = covariate[np.isfinite(covariate)]
    return np.unique(np.quantile(known, np.linspace(0.0, 1.0, count + 1))) if known.size else known


def spline_columns(covariate: Array, at: Array) -> Array:
    """Columns (n, k − 1) of a natural cubic spline on the knots `at` (k,) without the constant, each of unit RMS.

    Beyond the knots it goes on as a straight line. Fewer than three knots: the line alone. Zero where the covariate is NaN.
    """
    known = np.isfinite(covariate)
    if not known.all():
        part = spline_columns(covariate[known], at) if known.any() else np.zeros((0, 0))
        columns = np.zeros((covariate.size, part.shape[1]))
        columns[known] = part
        return columns
    centre, spread = float(covariate.mean()), float(covariate.std())
    if spread == 0.0 or at.size < 2:
        return np.zeros((covariate.size, 0))
    line = (covariate - centre) / spread
    if at.size < 3:
        return line[:, None]
    inside = np.clip(covariate, at[0], at[-1])
    spline = CubicSpline(at, np.eye(at.size), bc_type="natural")
    slope = spline(inside, 1)
    values = spline(inside) + slope * (covariate - inside)[:, None]
    # ∫(b'')² over the knots: b'' is piecewise linear
    bend, width = spline(at, 2), np.diff(at)
    penalty = np.zeros((at.size, at.size))
    for i, w in enumerate(width):
        a, b = bend[i], bend[i + 1]
        penalty += w / 6.0 * (2.0 * np.outer(a, a) + 2.0 * np.outer(b, b) + np.outer(a, b) + np.outer(b, a))
    strength, vectors = np.linalg.eigh(penalty)
    rough = strength > 1e-9 * strength[-1]
    columns = values @ (vectors[:, rough] / np.sqrt(strength[rough]))
    flat = np.column_stack([np.ones(covariate.size), line])
    columns = columns - flat @ np.linalg.lstsq(flat, columns, rcond=None)[0]
    return np.column_stack([line, columns[:, ::-1] / np.sqrt(np.mean(columns**2))])


def splines_of(problem: ResidualProblem, layout: Layout, count: int) -> dict[str, Array]:
    """Columns (n, k) of every covariate that varies, by its name: a basis' own, or splines on `count` + 1 quantiles of `layout`'s
    samples."""
    out = {}
    for name, covariate in problem.covariates.items():
        if isinstance(covariate, Basis):
            columns = covariate.columns
        else:
            columns = spline_columns(covariate, knots(covariate[layout.rows], count))
        if columns.shape[1]:
            out[name] = columns
    return out


def ridge(m: Array, off: Sequence[int], columns: Sequence[int], target: int = -1) -> Array:
    """Penalty (q,) of the columns, zero for the first: the λ of the largest restricted likelihood of Gram matrix `m`."""
    q = len(columns)
    if q < 2:
        return np.zeros(q)
    left = project(m, [*off, columns[0]])
    rest = list(columns[1:])
    information, u = left[np.ix_(rest, rest)], left[rest, target]
    mean = max(float(np.trace(information)) / (q - 1), 1e-300)
    values, vectors = np.linalg.eigh(information)
    rotated = (vectors.T @ u) ** 2
    best = min(
        STRENGTHS * mean,
        key=lambda s: float(
            np.sum(np.log1p(np.maximum(values, 0.0) / s)) - np.sum(rotated / (np.maximum(values, 0.0) + s))
        ),
    )
    return np.append(0.0, np.full(q - 1, best))


def curve(covariate: Array, term: Array) -> dict[str, list[float]]:
    """The term (n,) on values of its covariate (n,): {"covariate": […], "value": […]}, ordered."""
    known = np.isfinite(covariate)
    covariate, term = covariate[known], term[known]
    order = np.argsort(covariate, kind="stable")
    x, y = covariate[order], term[order]
    at = np.unique(np.quantile(x, np.linspace(0.0, 1.0, TABLE)))
    distinct, first = np.unique(x, return_index=True)
    return {"covariate": at.tolist(), "value": np.interp(at, distinct, y[first]).tolist()}
