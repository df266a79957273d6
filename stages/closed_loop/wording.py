"""What the loop says of its evidence.

Functions
---------
why_not, held_out_text    of groups held out
p_text, noise_text        of a test, and of the noise that it was made in
controls_text             of shifted copies
"""

from __future__ import annotations

from pipeline.residual_problem import ResidualProblem
from stages.closed_loop import confirmation
from stages.closed_loop.confirmation import Confirmation
from stages.closed_loop.noise import Noise


def why_not(checked: Confirmation) -> str:
    if 2 * checked.chosen <= checked.folds:
        return f"only {checked.chosen} of {checked.folds} training parts choose it"
    if not checked.same_sign:
        return "its sign changes from fold to fold"
    return (
        f"held-out RMS changes by {-100.0 * checked.gain:+.1f} % only, log-likelihood by {checked.log_likelihood:+.1f}"
    )


def held_out_text(problem: ResidualProblem, c: Confirmation) -> str:
    return (
        f"held-out RMS {c.before:.4g} → {c.after:.4g} {problem.unit} ({-100.0 * c.gain:+.1f} %), log-likelihood"
        f" {c.log_likelihood:+.1f}, chosen in {c.chosen} of {c.folds} folds"
    )


def p_text(p: float) -> str:
    return "< 1e-300" if p < 1e-300 else f"= {p:.2g}"


def controls_text(reached: int, valid: int) -> str:
    if valid < confirmation.FEWEST_CONTROLS:
        return "its signature has no shifted copy that could serve as a control"
    return f"{reached} of {valid} shifted copies of its signature do as well"


def noise_text(problem: ResidualProblem, noise: Noise) -> str:
    coloured = sum(c.kappa > 1e-7 for c in noise)
    if coloured == 0:
        return "white noise"
    return (
        "white and Gauss–Markov noise" if len(noise) == 1 else f"noise coloured in {coloured} of {len(noise)} channels"
    )
