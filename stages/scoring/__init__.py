"""Scoring: spectra against their references, per target and method."""

from stages.scoring.score import ScoringResult, campaign_means, run

__all__ = ["ScoringResult", "campaign_means", "run"]
