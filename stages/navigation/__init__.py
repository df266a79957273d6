"""Navigation: inertial data and GNSS fixes in, smoothed trajectory with sigmas out (the POS)."""

from stages.navigation.pos import NavigationResult, run
from stages.navigation.residual import residual_problem
from stages.navigation.settings import NavigationSettings

__all__ = ["NavigationResult", "NavigationSettings", "residual_problem", "run"]
