"""Corners followed from key frames (KLT), and their common motion: a similarity by RANSAC.

References
----------
.. [1] B. D. Lucas, T. Kanade, An iterative image registration technique, IJCAI 1981; J. Shi, C. Tomasi, CVPR 1994.
.. [2] M. A. Fischler, R. C. Bolles, Random sample consensus, Comm. ACM 24 (1981) 381.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.registration.motion import Motion, from_plane, to_plane
from stages.registration.settings import RegistrationSettings
from tsmftis.camera import Camera

Array = NDArray[np.float64]

UNTURNED = np.eye(3)


@dataclass(frozen=True)
class Link:
    """A frame tied to a key frame: the same corners, agreeing on one motion, in both (corner, 2) [px], and that motion (3, 3).

    Corners are pixels as measured; the similarity holds between pixels freed of radial distortion.
    """

    key: int
    at_key: Array
    at_frame: Array
    similarity: Array


def follow(images: NDArray[np.uint8], step: Array, camera: Camera, settings: RegistrationSettings) -> list[Link | None]:
    """For each flattened image (frame, row, col) its link to a key frame; None for the first one and after a break.

    step (frame, 2) [px]: the nominal motion since the frame before, where the search for the first motion starts. A key frame
    serves until too few of its corners are followed; then the frame before takes its place, so that keys are few.
    """
    links: list[Link | None] = [None]
    key, corners, last = 0, corners_of(images[0], settings), np.eye(3)
    for i in range(1, len(images)):
        ahead = np.array([[1.0, 0.0, step[i, 0]], [0.0, 1.0, step[i, 1]], [0.0, 0.0, 1.0]])
        link = link_of(images, key, i, corners, ahead @ last, camera, settings)
        if link is None and key != i - 1:
            key, corners = i - 1, corners_of(images[i - 1], settings)
            link = link_of(images, key, i, corners, ahead, camera, settings)
        if link is None:
            key, corners, last = i, corners_of(images[i], settings), np.eye(3)
        else:
            last = link.similarity
        links.append(link)
    return links


def similarity_motion(links: list[Link | None]) -> Motion:
    """Motion by the links' similarities, chained from key frame to key frame."""
    count = len(links)
    matrix, lost = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
    for i, link in enumerate(links[1:], start=1):
        lost[i] = link is None
        matrix[i] = matrix[i - 1] if link is None else link.similarity @ matrix[link.key]
    return Motion(matrix, np.tile(UNTURNED, (count, 1, 1)), lost, count_keys(links))


def count_keys(links: list[Link | None]) -> int:
    """Key frames that frames were tied to, and those at which a chain began."""
    starts = {i for i, link in enumerate(links) if link is None}
    return len(starts | {link.key for link in links if link is not None})


def corners_of(image: NDArray[np.uint8], settings: RegistrationSettings) -> Array:
    found = cv2.goodFeaturesToTrack(
        image, settings.corners, settings.corner_quality, settings.corner_distance_px, blockSize=5
    )
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(float)


def link_of(
    images: NDArray[np.uint8],
    key: int,
    frame: int,
    corners: Array,
    guess: Array,
    camera: Camera,
    settings: RegistrationSettings,
) -> Link | None:
    """Link of a frame to a key frame with these corners, or None where too few of them agree on a similarity."""
    if len(corners) < settings.least_inliers:
        return None
    ideal = to_plane(camera, UNTURNED, corners)
    start = from_plane(camera, UNTURNED, ideal @ guess[:2, :2].T + guess[:2, 2])
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        images[key],
        images[frame],
        corners.astype(np.float32).reshape(-1, 1, 2),
        start.astype(np.float32).reshape(-1, 1, 2),
        winSize=(settings.window_px, settings.window_px),
        maxLevel=settings.pyramid_levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005),
    )
    at = moved.reshape(-1, 2).astype(float)
    good = (status.ravel() == 1) & (at >= 0).all(axis=1) & (at < [camera.cols, camera.rows]).all(axis=1)
    if good.sum() < max(settings.least_inliers, settings.kept_fraction * len(corners)):
        return None
    matrix, inliers = cv2.estimateAffinePartial2D(
        ideal[good],
        to_plane(camera, UNTURNED, at[good]),
        method=cv2.RANSAC,
        ransacReprojThreshold=settings.ransac_threshold_px,
        maxIters=500,
        confidence=0.999,
        refineIters=10,
    )
    least = max(settings.least_inliers, settings.agreeing_fraction * good.sum())
    if matrix is None or int(inliers.sum()) < least:
        return None
    agree = inliers.ravel() == 1
    return Link(key, corners[good][agree], at[good][agree], np.vstack([matrix, [0.0, 0.0, 1.0]]))
