"""Tracking: where each target is in each frame, by the POS (and by uniform straight motion, the nominal track)."""

from stages.tracking.collinearity import TrackingResult, TrackingSettings, run

__all__ = ["TrackingResult", "TrackingSettings", "run"]
