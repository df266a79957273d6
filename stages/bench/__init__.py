"""Bench: a laboratory interferogram in; its spectrum, held against the vendor's where there is one, out."""

from stages.bench.bench import BenchResult, BenchSettings, run
from stages.bench.residual import residual_problem

__all__ = ["BenchResult", "BenchSettings", "residual_problem", "run"]
