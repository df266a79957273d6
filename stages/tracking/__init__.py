"""Tracking: where each target is in each frame, by the POS (and by uniform straight motion, the nominal track)."""

from stages.tracking.collinearity import TrackingResult, TrackingSettings, run
from stages.tracking.line_rows import Line, ResidualSettings
from stages.tracking.residual import geometry_residual_px, residual_problem

__all__ = [
    "Line",
    "ResidualSettings",
    "TrackingResult",
    "TrackingSettings",
    "geometry_residual_px",
    "residual_problem",
    "run",
]
