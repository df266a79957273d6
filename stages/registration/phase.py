"""Motion by phase correlation to key frames: translation alone.

With spectra F of the key frame and G of the frame, both under one Hanning window, the inverse transform of F*·G/|F*·G| peaks at
the displacement; the centroid of the 5 × 5 cells about the peak gives it to a fraction of a pixel, and its share of the
energy is the response, of the order of 1/√pixels where the images have nothing in common.

References
----------
.. [1] C. D. Kuglin, D. C. Hines, The phase correlation image alignment method, Proc. IEEE Int. Conf. Cybernetics and Society
   (1975) 163.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.registration.flattening import MIDDLE
from stages.registration.motion import Motion
from stages.registration.settings import RegistrationSettings

Array = NDArray[np.float64]


def phase_motion(images: NDArray[np.uint8], settings: RegistrationSettings) -> Motion:
    """Motion (a translation a frame) of flattened images (frame, row, col).

    A key frame serves until the overlap falls below `phase_overlap` or the response below `phase_response`; then the frame before
    takes its place.
    """
    count, rows, cols = images.shape
    least = settings.phase_response / np.sqrt(rows * cols)
    window = cv2.createHanningWindow((cols, rows), cv2.CV_32F)
    offset, lost = np.zeros((count, 2)), np.zeros(count, bool)
    key, keys = 0, 1
    for i in range(1, count):
        shift, response = correlate(images[key], images[i], window)
        if key != i - 1 and not (response >= least and _overlap(shift, rows, cols) >= settings.phase_overlap):
            key, keys = i - 1, keys + 1
            shift, response = correlate(images[key], images[i], window)
        if response >= least:
            offset[i] = offset[key] + shift
        else:
            lost[i], offset[i] = True, offset[i - 1]
            key, keys = i, keys + 1
    matrix = np.tile(np.eye(3), (count, 1, 1))
    matrix[:, :2, 2] = offset
    return Motion(matrix, np.tile(np.eye(3), (count, 1, 1)), lost, keys)


def correlate(key: NDArray[np.uint8], image: NDArray[np.uint8], window: NDArray[Any]) -> tuple[Array, float]:
    """Displacement (2,) [px] from key to image, and the response."""
    # phaseCorrelate overwrites its inputs at sizes that its transform likes: these are copies. The mean is taken off because it
    # alone would make two blank images agree.
    first, second = (i.astype(np.float32) - MIDDLE for i in (key, image))
    shift, response = cv2.phaseCorrelate(first, second, window)
    return np.array(shift), response


def _overlap(shift: Array, rows: int, cols: int) -> float:
    return float(max(0.0, 1 - abs(shift[0]) / cols) * max(0.0, 1 - abs(shift[1]) / rows))
