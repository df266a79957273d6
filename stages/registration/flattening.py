"""Images of the scene without fringes, flat and shading.

The fringes of a static interferometer are fixed on the detector while the scene moves beneath them, so raw frames pull
every matcher towards zero motion. With counts N(frame, row, col) and their temporal median M(row, col),

    x = ln(N / M),   z = (x − mean x) / (std x + floor),

mean and standard deviation over a square about the pixel. The division takes fringes, flat and dark out and leaves the
scene; the logarithm weighs dark and bright ground alike; z gives weak texture as many corners as a bright target, and evens
out what the median leaves (its fringes are those of the mean ground, not of each target).
"""

from __future__ import annotations

import tempfile

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.records import Frames
from stages.registration.settings import RegistrationSettings

BLOCK = 100  # frames read at a time
DARKEST = 0.02  # of the median: less light than this is noise, whatever its logarithm
MIDDLE = 128  # what z = 0 is in eight bits
RANGE = 3.0  # local standard deviations that eight bits hold on either side


def flattened(frames: Frames, settings: RegistrationSettings) -> NDArray[np.uint8]:
    """z of every frame (frame, row, col) in 8 bits, 1 … 255 for −3 … 3.

    They lie in a temporary file that is mapped into memory, so that a long line's can be put out of it: key frames and anchors
    are looked at again and again, in no order that a stream would have.
    """
    profile = temporal_median(frames, settings.median_frames)
    with tempfile.TemporaryFile() as store:
        images = np.asarray(np.memmap(store, np.uint8, "w+", shape=(frames.time.size, *profile.shape)))
    for start in range(0, len(images), BLOCK):
        images[start : start + BLOCK] = texture(frames.block(start, start + BLOCK), profile, settings)
    return images


def texture(
    counts: NDArray[np.uint16], profile: NDArray[np.float32], settings: RegistrationSettings
) -> NDArray[np.uint8]:
    """z of counts (frame, row, col) over their temporal median `profile` (row, col), in 8 bits."""
    side = (settings.contrast_px, settings.contrast_px)
    scale = np.float32((255 - MIDDLE) / RANGE)
    images = np.empty(counts.shape, np.uint8)
    for image, frame in zip(images, counts, strict=True):
        z = cv2.log(np.maximum(frame / profile, np.float32(DARKEST)))
        z -= cv2.blur(z, side)
        z /= np.sqrt(cv2.blur(z * z, side)) + np.float32(settings.contrast_floor)
        image[:] = np.clip(np.rint(z * scale) + MIDDLE, 0, 255)
    return images


def temporal_median(frames: Frames, most: int) -> NDArray[np.float32]:
    """Median count of each pixel (row, col) [DN] over at least `most` frames (all, where there are fewer), evenly spread."""
    count = frames.time.size
    step = max(1, count // most)
    sample = np.concatenate([frames.block(i, i + BLOCK)[(-i) % step :: step] for i in range(0, count, BLOCK)])
    return np.maximum(np.median(sample, axis=0), 1.0).astype(np.float32)
