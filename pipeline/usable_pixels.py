"""Which pixels of the detector a line can be trusted to: the same answer for a target's spectrum and for the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Calibration, Frames
from tsmftis import detector

FRAMES = 64  # spread over a line, to see what follows the scene


def unusable(calibration: Calibration, frames: Frames) -> NDArray[np.bool_]:
    """Pixels (row, col) that dark, flat or the frames give away as bad."""
    bad = detector.bad_pixels(calibration.dark, calibration.flat)
    return np.asarray(bad | detector.stuck_pixels(frames.sample(FRAMES)))
