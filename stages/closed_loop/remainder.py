"""What is left: curves of covariates, for structure that no declared effect accounts for.

Functions
---------
learned_step   adds the curve that explains what is left, if groups held out agree
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.residual_problem import Basis, ResidualProblem
from stages.closed_loop import confirmation, learned
from stages.closed_loop.confirmation import Model
from stages.closed_loop.noise import Layout, gram
from stages.closed_loop.result import Step, Value
from stages.closed_loop.score_test import search
from stages.closed_loop.settings import LoopSettings
from stages.closed_loop.state import CERTAIN, State
from stages.closed_loop.wording import held_out_text, noise_text, p_text, why_not

Array = NDArray[np.float64]

LEARNED_TRIES = 6  # covariates looked at, the most significant first


def learned_step(
    problem: ResidualProblem, layout: Layout, state: State, settings: LoopSettings, rng: np.random.Generator
) -> bool:
    """Add the spline of a covariate that explains what is left, if held-out error falls; False where none does. One that stands
    out and does not help leaves the next its turn."""
    done = {s.effect.removeprefix("learned:") for s in state.steps if s.table is not None}
    splines = learned.splines_of(problem, layout, settings.spline_columns)
    splines = {name: s for name, s in splines.items() if name not in done}
    if np.unique(problem.group[layout.rows]).size < 2:
        return False
    for _ in range(min(len(splines), LEARNED_TRIES)):
        answer = _try_learned(problem, layout, state, splines, settings, rng)
        if not isinstance(answer, str):
            return answer
        del splines[answer]
    return False


def _try_learned(
    problem: ResidualProblem,
    layout: Layout,
    state: State,
    splines: Mapping[str, Array],
    settings: LoopSettings,
    rng: np.random.Generator,
) -> bool | str:
    """Whether the most significant spline was added; its name where it stands out and is refused."""
    rows, columns, data = layout.rows, state.columns, state.residual
    p = columns.shape[1]
    names = list(splines)
    of_time = [k for k, n in enumerate(names) if problem.drifts and _is_time(problem, n)]
    finding, state.noise = search(
        layout,
        columns[rows],
        [splines[n][rows] for n in names],
        data[rows],
        state.noise,
        settings.draws,
        rng,
        of_time=of_time,
        drifts=problem.drifts,
    )
    if finding is None or finding.p > settings.learned_p_value:
        return False
    name = names[finding.index]
    spline = splines[name]
    own = tuple(range(p, p + spline.shape[1]))
    reached, valid = confirmation.controls(
        problem, layout, finding.noise, columns[rows], spline[rows], data[rows], settings.controls, rng
    )
    both = np.column_stack([columns, spline])
    model = Model(data, both, smooth=own if _is_smooth(problem, name) else (), added=own)
    m = gram(layout, finding.noise, np.column_stack([both, data])[rows])
    beta = confirmation.coefficients(m, both.shape[1], model)
    term = spline @ beta[list(own)]
    library = [
        Model(
            data,
            np.column_stack([columns, s]),
            smooth=tuple(range(p, p + s.shape[1])) if _is_smooth(problem, one) else (),
        )
        for one, s in splines.items()
    ]
    checked = confirmation.confirm(
        problem, rows, Model(data, columns), library, names, names, finding.index, model, finding.noise, settings.snr
    )
    if not confirmation.controls_fail(reached, valid):
        problem_text = f"{reached} of {valid} shifted copies of it do as well"
    elif not checked.passes(settings.gain, settings.decisive):
        problem_text = why_not(checked)
    else:
        size = float(np.sqrt(np.mean((term[rows] - term[rows].mean()) ** 2)))
        sigma = size / float(np.sqrt(max(finding.chi2, 1e-300)))
        tests = f"largest of {len(names)} covariates, {noise_text(problem, finding.noise)}"
        share = f"permutation p = {(1 + reached) / (1 + valid):.2g}" if valid else "no permutation possible"
        state.steps.append(
            Step(
                problem.stage,
                f"learned:{name}",
                {"rms": Value(size, sigma, problem.unit)},
                f"p {p_text(finding.p)} ({tests}); {held_out_text(problem, checked)}; {share} of {valid} shifts within series",
                (),
                checked.before,
                checked.after,
                finding.p,
                table=_table(problem.covariates[name], term, beta[list(own)]),
            )
        )
        state.nuisance = np.column_stack([state.nuisance, spline])
        # Beside a curve of time the noise is another one, and to be looked for anew.
        state.noise = None if finding.index in of_time else finding.noise
        return True
    state.notes.append(f"{name} stands out among covariates (p {p_text(finding.p)}) but is not used: {problem_text}")
    if finding.p < CERTAIN and checked.repeats and confirmation.controls_fail(reached, valid):
        state.certain.append(f"learned:{name}")
    return name


def _is_smooth(problem: ResidualProblem, covariate: str) -> bool:
    values = problem.covariates[covariate]
    return values.smooth if isinstance(values, Basis) else True


def _is_time(problem: ResidualProblem, covariate: str) -> bool:
    values = problem.covariates[covariate]
    values = values.values if isinstance(values, Basis) else values
    known = np.isfinite(values)
    return bool(known.any() and np.array_equal(values[known], problem.time[known]))


def _table(covariate: Array | Basis, term: Array, beta: Array) -> dict[str, list[float]]:
    """The learned curve on values of its covariate."""
    if isinstance(covariate, Basis):
        curves = {name: (curve @ beta).tolist() for name, curve in covariate.curves.items()}
        return {"covariate": covariate.at.tolist(), **curves}
    return learned.curve(covariate, term)
