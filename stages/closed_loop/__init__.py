"""Closed loop: a stage's residual in; which effects its model lacks, with sigmas and evidence, or that none is missing, out.

run(problem, settings, seed) → LoopResult;   refit(problem, values, without) → the same effects from fewer groups.
It knows no stage: a `ResidualProblem` comes in (pipeline/residual_problem.py).
"""

from stages.closed_loop.engine import refit, run
from stages.closed_loop.result import LoopResult, Step, Value, taken_back
from stages.closed_loop.settings import LoopSettings

__all__ = ["LoopResult", "LoopSettings", "Step", "Value", "refit", "run", "taken_back"]
