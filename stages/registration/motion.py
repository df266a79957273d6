"""How a scene moves, in the plane in which a method sees it move simply, and how a point is carried by that motion.

A pixel of frame i goes to the plane by the ray through it: p = K·R_i·ray(pixel), K the pin-hole projection without distortion,
R_i the rotation from the camera of frame i to the plane's axes. R_i = 1 only takes the radial distortion off; with R_i from
the POS the plane is that of a camera that does not turn. In the plane frame i is the first one moved by `matrix[i]`:

    p_j = matrix_j · matrix_i⁻¹ · p_i

Points are (..., 2), column first and then row [px], as OpenCV has them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tsmftis.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """matrix (frame, 3, 3), homogeneous, from the first frame's plane to each frame's; rotation (frame, 3, 3), camera to plane.

    `lost[i]`: frame i could not be tied to the frames before it, and the motion starts anew there; `keys`: key frames used.
    """

    matrix: Array
    rotation: Array
    lost: NDArray[np.bool_]
    keys: int

    @property
    def note(self) -> str:
        return f"{self.keys} key frames, {int(self.lost.sum())} breaks in {self.lost.size} frames"


def to_plane(camera: Camera, rotation: Array, points: Array) -> Array:
    """Plane coordinates of pixels (..., 2), by rotations (..., 3, 3) that broadcast against them."""
    rays = camera.directions(points[..., 1], points[..., 0])
    row, col = replace(camera, radial_k1=0.0).project(np.einsum("...ij,...j->...i", rotation, rays))
    return np.stack([col, row], -1)


def from_plane(camera: Camera, rotation: Array, points: Array) -> Array:
    """Pixels of plane coordinates (..., 2): the inverse of `to_plane`."""
    rays = replace(camera, radial_k1=0.0).directions(points[..., 1], points[..., 0])
    row, col = camera.project(np.einsum("...ji,...j->...i", rotation, rays))
    return np.stack([col, row], -1)


def carry(motion: Motion, camera: Camera, points: Array, anchor: int) -> Array:
    """Points (point, 2) of frame `anchor` in every frame (frame, point, 2), NaN beyond the first break on either side."""
    here = np.column_stack([to_plane(camera, motion.rotation[anchor], points), np.ones(len(points))])
    there = here @ np.swapaxes(motion.matrix @ np.linalg.inv(motion.matrix[anchor]), 1, 2)
    carried = np.full((motion.lost.size, len(points), 2), np.nan)
    breaks = np.flatnonzero(motion.lost)
    seen = slice(breaks[breaks <= anchor].max(initial=0), breaks[breaks > anchor].min(initial=motion.lost.size))
    carried[seen] = from_plane(camera, motion.rotation[seen, None], there[seen, :, :2])
    return carried
