"""Scoring: spectra against their references, per target and method."""

from stages.scoring.score import ScoringResult, run

__all__ = ["ScoringResult", "run"]
