"""Tracking: where each target is in each frame, by the POS (and by uniform straight motion, the nominal track)."""

from stages.tracking.collinearity import TrackingResult, TrackingSettings, run
from stages.tracking.learned import applied
from stages.tracking.line_rows import GeometrySettings, Line
from stages.tracking.residual import geometry_residual_px, residual_problem

__all__ = [
    "GeometrySettings",
    "Line",
    "TrackingResult",
    "TrackingSettings",
    "applied",
    "geometry_residual_px",
    "residual_problem",
    "run",
]
