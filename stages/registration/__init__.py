"""Registration: target tracks by images, alone or with the POS's rotation: the ladder that POS tracking is held against."""

from stages.registration.ladder import run
from stages.registration.pairs import image_motion
from stages.registration.settings import RegistrationSettings

__all__ = ["RegistrationSettings", "image_motion", "run"]
