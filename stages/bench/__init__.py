"""Bench: a laboratory interferogram in; its spectrum, held against the vendor's where there is one, out."""

from stages.bench.bench import BenchResult, BenchSettings, run

__all__ = ["BenchResult", "BenchSettings", "run"]
