"""Registration: target tracks from the images alone, the baseline that POS tracking is held against."""

from stages.registration.keyframes import RegistrationSettings, run

__all__ = ["RegistrationSettings", "run"]
