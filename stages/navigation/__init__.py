"""Navigation: inertial data and GNSS fixes in, smoothed trajectory with sigmas out (the POS)."""

from stages.navigation.pos import NavigationResult, run
from stages.navigation.settings import NavigationSettings

__all__ = ["NavigationResult", "NavigationSettings", "run"]
