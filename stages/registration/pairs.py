"""Motion of the scene between frames some way apart, from images alone: what the POS' motion can be held against.

    shift = corner followed by KLT in the second frame − corner in the first

Corners are followed between flattened images, from a guess by phase correlation, so that no pose enters; those that agree on
one similarity (RANSAC) and stay clear of the detector's edge count. Within a window's half of the edge shifts are biased outwards
(measured on campaigns without any effect: .03 px at the first row, .2 px at the last column; beyond 10 px less than .01).

Functions
---------
image_motion     pairs of frames over a line, and how their points moved
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.records import Frames, ImageMotion
from stages.registration.flattening import temporal_median, texture
from stages.registration.keyframes import Link, corners_of, link_of
from stages.registration.phase import correlate
from stages.registration.settings import RegistrationSettings
from tsmftis.camera import Camera
from tsmftis.effects import Effects, refuse_others

Array = NDArray[np.float64]

PROBES = 15  # short pairs that tell how fast the scene moves
PROBE_FRAMES = 4
SHARE = 0.25  # of the detector that the scene crosses between the frames of a pair: far enough for angles, with much in common
PAIRS = 60  # at most, a line
OVERLAP = 0.27  # step from pair to pair over their length: no two pairs share a frame


def image_motion(
    frames: Frames, camera: Camera, settings: RegistrationSettings, effects: Effects | None = None
) -> ImageMotion:
    """Up to 60 pairs of frames, evenly spread; a pair with too few corners that agree is left out.

    `effects` of the stage geometry are what a model update adds to the camera (its distortion: a similarity holds between
    pixels that are free of it).
    """
    refuse_others(effects or {}, "geometry")
    camera = camera.with_effects(effects or {})
    profile = temporal_median(frames, settings.median_frames)

    def image(index: int) -> NDArray[np.uint8]:
        return texture(frames.block(index, index + 1), profile, settings)[0]

    window = cv2.createHanningWindow((camera.cols, camera.rows), cv2.CV_32F)
    count = frames.time.size
    apart = _apart(image, count, window, camera)
    step = max(1.0, OVERLAP * apart, (count - apart) / PAIRS)
    found: list[tuple[int, int, Array, Array, float]] = []
    for first in np.unique(np.arange(0.0, max(count - apart, 0), step).astype(int)):
        second = int(first) + apart
        both = np.stack([image(int(first)), image(second)])
        shift, _ = correlate(both[0], both[1], window)
        guess = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])
        link = link_of(both, 0, 1, corners_of(both[0], settings), guess, camera, settings)
        if link is not None and (points := _inside(link, camera, settings)) is not None:
            found.append((int(first), second, *points))
    sizes = [len(f[2]) for f in found]
    at, moved = (np.concatenate([f[i] for f in found]) if found else np.zeros((0, 2)) for i in (2, 3))
    return ImageMotion(
        np.array([f[0] for f in found], int),
        np.array([f[1] for f in found], int),
        np.repeat(np.arange(len(found)), sizes),
        at[:, 1],
        at[:, 0],
        moved[:, 1],
        moved[:, 0],
        np.array([f[4] for f in found], float),
    )


def _apart(image: Callable[[int], NDArray[np.uint8]], count: int, window: NDArray[Any], camera: Camera) -> int:
    """Frames between the members of a pair."""
    probe = min(PROBE_FRAMES, count - 1)
    starts = np.unique(np.linspace(0, count - 1 - probe, PROBES).astype(int))
    speed = np.median([np.hypot(*correlate(image(int(i)), image(int(i) + probe), window)[0]) for i in starts]) / probe
    return int(np.clip(round(SHARE * camera.cols / max(float(speed), 1e-3)), 1, max(1, count // 3)))


def _inside(link: Link, camera: Camera, settings: RegistrationSettings) -> tuple[Array, Array, float] | None:
    """Corners clear of the edge in both frames (corner, 2), their shifts, and their scatter; None where too few are left."""
    edge = min(settings.window_px, min(camera.rows, camera.cols) // 5)
    last = np.array([camera.cols, camera.rows]) - 1 - edge
    clear = np.all([((p >= edge) & (p <= last)).all(axis=1) for p in (link.at_key, link.at_frame)], axis=0)
    at, moved = link.at_key[clear], (link.at_frame - link.at_key)[clear]
    if len(at) < settings.least_inliers:
        return None
    x = (at - at.mean(axis=0)) / np.array([camera.cols, camera.rows])
    smooth = np.column_stack([np.ones(len(x)), x, x**2, x[:, 0] * x[:, 1]])
    left = moved - smooth @ np.linalg.lstsq(smooth, moved, rcond=None)[0]
    return at, moved, float(1.4826 * np.median(np.abs(left)))
