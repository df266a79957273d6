"""Tracks refined about each target by its look in the anchor frame (ECC): no drift, and the target's own parallax.

One motion for a whole frame is that of ground at the mean height. A target Δh above it moves by Δh/H of the displacement more: at
the ends of the detector tenths of a pixel for metres of relief. So the square about the target in its anchor frame, turned
and scaled as the frame's motion has it, is moved to where it correlates best with the frame.

References
----------
.. [1] G. D. Evangelidis, E. Z. Psarakis, Parametric image alignment using enhanced correlation coefficient maximization,
   IEEE Trans. PAMI 30 (2008) 1858.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.registration.settings import RegistrationSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Patch:
    """A target in its anchor frame: image, column and row of its first pixel, and its centre (2,) [px]."""

    image: NDArray[np.uint8]
    corner: Array
    centre: Array


def patch(image: NDArray[np.uint8], centre: Array, settings: RegistrationSettings) -> Patch | None:
    """The square about a target in an image, as far as it is on the detector; None where that is too little to go by."""
    if not np.isfinite(centre).all():
        return None
    cut, corner = _cut(image, centre, settings.ecc_half_px)
    return Patch(cut, corner, centre) if min(cut.shape) > settings.ecc_half_px else None


def refine(
    target: Patch, image: NDArray[np.uint8], centre: Array, turn: Array, settings: RegistrationSettings
) -> Array | None:
    """What `centre` (2,) [px], where a target is thought to be in an image, lacks (2,); None where ECC does not converge.

    turn (2, 2): by how much the image is turned and scaled there against the anchor frame.
    """
    cut, corner = _cut(image, centre, settings.ecc_half_px + int(np.ceil(settings.ecc_reach_px)))
    start = centre - corner + turn @ (target.corner - target.centre)
    warp = np.column_stack([turn, start]).astype(np.float32)
    everywhere = np.ones(cut.shape, np.uint8)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, settings.ecc_iterations, settings.ecc_precision)
    try:
        # MOTION_TRANSLATION keeps the warp's 2 × 2 part as it is given.
        _, found = cv2.findTransformECC(target.image, cut, warp.copy(), cv2.MOTION_TRANSLATION, criteria, everywhere, 1)
    except cv2.error:
        return None
    lacks = (found[:, 2] - warp[:, 2]).astype(float)
    return lacks if np.hypot(*lacks) <= settings.ecc_reach_px else None


def _cut(image: NDArray[np.uint8], centre: Array, half: int) -> tuple[NDArray[np.uint8], Array]:
    """The part of an image within `half` pixels of a point, and column and row of its first pixel."""
    first = np.maximum(np.rint(centre).astype(int) - half, 0)
    past = np.maximum(np.rint(centre).astype(int) + half + 1, 0)
    return np.ascontiguousarray(image[first[1] : past[1], first[0] : past[0]]), first.astype(float)
