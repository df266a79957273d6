"""Frame-to-frame motion by corner tracking to key frames (KLT, RANSAC similarity) on flattened frames.

The fringes of a static interferometer are fixed on the detector while the scene moves beneath them, so raw frames pull
every matcher towards zero motion. Dividing each frame by the temporal median of its pixels takes fringes, flat and dark
out and leaves the scene.

References
----------
.. [1] B. D. Lucas, T. Kanade, An iterative image registration technique, IJCAI 1981; J. Shi, C. Tomasi, CVPR 1994.
.. [2] M. A. Fischler, R. C. Bolles, Random sample consensus, Comm. ACM 24 (1981) 381.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pipeline.records import Frames, Tracks
from tsmftis.camera import Camera

Array = NDArray[np.float64]

BLOCK = 100  # frames read at a time


class RegistrationSettings(BaseModel):
    """Corner tracking; lengths in pixels of the detector."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    corners: int = Field(400, ge=20, description="most corners followed from a key frame")
    corner_quality: float = Field(0.01, gt=0, lt=1, description="least corner response over the best one")
    corner_distance_px: float = Field(4.0, gt=0, description="least distance between corners")
    window_px: int = Field(15, ge=5, le=63, description="side of the KLT window")
    pyramid_levels: int = Field(3, ge=0, le=6, description="halvings of the image for large motions")
    ransac_threshold_px: float = Field(0.7, gt=0, description="a corner farther from the common motion is left out")
    least_inliers: int = Field(12, ge=4, description="fewer inliers than this start a new key frame")
    kept_fraction: float = Field(
        0.5, gt=0, lt=1, description="a new key frame when fewer of the corners are still followed"
    )
    median_frames: int = Field(200, ge=10, description="frames that the temporal median is taken over, evenly spread")


def run(frames: Frames, anchored: Tracks, camera: Camera, settings: RegistrationSettings) -> Tracks:
    """Tracks of method `registration`: each target's points placed where `anchored` has them in its anchor frame (the one
    in which the target is nearest to mid-detector), then carried by the images.

    anchored: tracks by POS, one method (1, target, point, frame). Frames that the images cannot follow end a track (NaN)
    and are counted in the notes.
    """
    anchor = camera.central_frame(anchored.row[0, :, Tracks.CENTRE], anchored.col[0, :, Tracks.CENTRE])
    motion, lost, keys = image_motion(frames, settings)
    row, col = np.full_like(anchored.row, np.nan), np.full_like(anchored.col, np.nan)
    for target, frame in enumerate(anchor):
        start = np.linalg.inv(motion[frame])
        here = np.stack(
            [anchored.col[0, target, :, frame], anchored.row[0, target, :, frame], np.ones(anchored.row.shape[2])]
        )
        there = (motion @ start) @ here
        # A target is followed from its anchor to the first lost frame on either side.
        broken = np.flatnonzero(lost)
        first = broken[broken <= frame].max(initial=0)
        last = broken[broken > frame].min(initial=len(motion))
        col[0, target, :, first:last] = there[first:last, 0].T
        row[0, target, :, first:last] = there[first:last, 1].T
    note = f"{keys} key frames, {int(lost.sum())} breaks in {len(motion)} frames"
    return Tracks(("registration",), anchored.targets, row, col, {"registration": note})


def image_motion(frames: Frames, settings: RegistrationSettings) -> tuple[Array, NDArray[np.bool_], int]:
    """Homogeneous similarity (frame, 3, 3) from the first frame's (col, row) to each frame's, `lost` and the key frame count.

    `lost[i]` means that frame i could not be tied to the frames before it: the motion starts anew there.
    """
    count = frames.time.size
    images = _flattened(frames, settings)
    motion = np.empty((count, 3, 3))
    lost = np.zeros(count, bool)
    motion[0] = np.eye(3)
    previous = next(images)
    key, key_index, keys = previous, 0, 1
    corners = _corners(key, settings)
    to_previous = np.eye(3)
    for i, image in enumerate(images, start=1):
        found = _similarity(key, image, corners, to_previous, settings)
        if found is None and key_index != i - 1:
            key, key_index, keys = previous, i - 1, keys + 1
            corners, to_previous = _corners(key, settings), np.eye(3)
            found = _similarity(key, image, corners, to_previous, settings)
        if found is None:
            lost[i] = True
            key, key_index, keys = image, i, keys + 1
            corners, to_previous = _corners(key, settings), np.eye(3)
            motion[i] = motion[i - 1]
        else:
            to_previous = found
            motion[i] = found @ motion[key_index]
        previous = image
    return motion, lost, keys


def _flattened(frames: Frames, settings: RegistrationSettings) -> Iterator[NDArray[np.uint8]]:
    """8-bit images of the scene, frame by frame: counts over their temporal median, the bulk of the ratios over the range."""
    count = frames.time.size
    step = max(1, count // settings.median_frames)
    sample = np.concatenate([frames.block(i, i + BLOCK)[(-i) % step :: step] for i in range(0, count, BLOCK)])
    profile = np.maximum(np.median(sample, axis=0), 1.0).astype(np.float32)
    low, high = np.percentile(sample[:: max(1, len(sample) // 20)] / profile, [0.5, 99.5])
    scale = np.float32(255.0 / max(high - low, 1e-6))
    for start in range(0, count, BLOCK):
        for counts in frames.block(start, start + BLOCK):
            yield np.clip((counts / profile - np.float32(low)) * scale, 0, 255).astype(np.uint8)


def _corners(image: NDArray[np.uint8], settings: RegistrationSettings) -> NDArray[np.float32]:
    found = cv2.goodFeaturesToTrack(
        image, settings.corners, settings.corner_quality, settings.corner_distance_px, blockSize=5
    )
    return np.empty((0, 1, 2), np.float32) if found is None else found.astype(np.float32)


def _similarity(
    key: NDArray[np.uint8],
    image: NDArray[np.uint8],
    corners: NDArray[np.float32],
    guess: Array,
    settings: RegistrationSettings,
) -> Array | None:
    """Similarity (3, 3) from key to image, or None where too few corners agree on one."""
    if len(corners) < settings.least_inliers:
        return None
    start = (corners.reshape(-1, 2) @ guess[:2, :2].T + guess[:2, 2]).astype(np.float32).reshape(-1, 1, 2)
    size = (settings.window_px, settings.window_px)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        key,
        image,
        corners,
        start.copy(),
        winSize=size,
        maxLevel=settings.pyramid_levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005),
    )
    height, width = image.shape
    at = moved.reshape(-1, 2)
    good = (status.ravel() == 1) & (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height)
    if good.sum() < max(settings.least_inliers, settings.kept_fraction * len(corners)):
        return None
    matrix, inliers = cv2.estimateAffinePartial2D(
        corners[good],
        moved[good],
        method=cv2.RANSAC,
        ransacReprojThreshold=settings.ransac_threshold_px,
        maxIters=500,
        confidence=0.999,
        refineIters=10,
    )
    if matrix is None or int(inliers.sum()) < settings.least_inliers:
        return None
    return np.vstack([matrix, [0.0, 0.0, 1.0]])
