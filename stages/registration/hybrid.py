"""Motion with the camera's rotation by POS and the translation by images.

Seen from a camera that does not turn and looks straight down, level ground moves by a translation. The POS turns every frame
into the view of such a camera; what is left of the displacement of corners between key frame and frame is the translation,
their median.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.records import CameraPoses
from stages.registration.keyframes import Link, count_keys
from stages.registration.motion import Motion, to_plane
from tsmftis.camera import Camera
from tsmftis.geodesy import ecef_to_geodetic, ned_to_ecef_dcm

Array = NDArray[np.float64]


def hybrid_motion(links: list[Link | None], poses: CameraPoses, camera: Camera) -> Motion:
    """Motion by the links' corners in the view of a level camera; a frame without pose is lost."""
    count = len(links)
    rotation = level_axes(poses).T @ poses.dcm
    offset, lost = np.zeros((count, 2)), np.zeros(count, bool)
    for i, link in enumerate(links[1:], start=1):
        if link is not None:
            left = to_plane(camera, rotation[i], link.at_frame) - to_plane(camera, rotation[link.key], link.at_key)
            offset[i] = offset[link.key] + np.median(left, axis=0)
        lost[i] = link is None or not np.isfinite(offset[i]).all()
        if lost[i]:
            offset[i] = offset[i - 1]
    matrix = np.tile(np.eye(3), (count, 1, 1))
    matrix[:, :2, 2] = offset
    return Motion(matrix, rotation, lost, count_keys(links))


def level_axes(poses: CameraPoses) -> Array:
    """Axes (3, 3) in ECEF, by column: down at the middle of the line's known poses, and forward as the camera there points."""
    known = np.flatnonzero(np.isfinite(poses.centre[:, 0]))
    middle = known[known.size // 2]
    latitude, longitude, _ = ecef_to_geodetic(poses.centre[middle])
    down = ned_to_ecef_dcm(latitude, longitude)[:, 2]
    right = np.cross(down, poses.dcm[middle][:, 0])
    right /= np.linalg.norm(right)
    return np.column_stack([np.cross(right, down), right, down])
