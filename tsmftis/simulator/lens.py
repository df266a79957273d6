"""From a pixel to its ray, and back by search.

With x = X/Z, y = Y/Z, s = 1 + k1·(x² + y²): row = row0 + s·y·f/p, col = col0 − s·x·f/p. The simulator goes from pixel
to ray, so the radius r·(1 + k1·r²) is inverted numerically.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lens:
    """Principal point [px], focal length over pixel pitch [px], radial distortion k1 [1]."""

    row0: float
    col0: float
    focal: float
    k1: float


def ray(lens: Lens, row: Array, col: Array) -> Array:
    """Slopes (x, y) of the rays through pixels (...) → (..., 2); Newton on r·(1 + k1·r²) = distorted radius.

    Raises ValueError where the distortion folds, 1 + 3·k1·r² ≤ 0, inside the picture.
    """
    row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
    distorted = np.stack([-(col - lens.col0), row - lens.row0], -1) / lens.focal
    radius = np.linalg.norm(distorted, axis=-1)
    r = radius.copy()
    for _ in range(20):
        slope = 1.0 + 3.0 * lens.k1 * r**2
        if (slope <= 0.0).any():
            raise ValueError(f"radial distortion k1 = {lens.k1} folds the picture")
        r -= (r * (1.0 + lens.k1 * r**2) - radius) / slope
    return distorted / (1.0 + lens.k1 * r**2)[..., None]


def find(lens: Lens, camera: Array, to_ecef: Array, point: Array) -> Array:
    """The pixel (row, col) whose ray hits an ECEF point (3,), by Newton on rays; camera (3,), C_camera→ECEF (3, 3).

    Raises ValueError where the point is behind the camera.
    """
    direction = to_ecef.T @ (point - camera)
    if direction[2] <= 0.0:
        raise ValueError("the point is behind the camera")
    slopes = direction[:2] / direction[2]
    pixel = np.array([lens.row0, lens.col0])
    step = 1e-3
    for _ in range(20):
        here = ray(lens, pixel[0], pixel[1])
        jacobian = np.stack(
            [
                (ray(lens, pixel[0] + step, pixel[1]) - here) / step,
                (ray(lens, pixel[0], pixel[1] + step) - here) / step,
            ],
            -1,
        )
        change = np.linalg.solve(jacobian, slopes - here)
        pixel = pixel + change
        if np.abs(change).max() < 1e-9:
            break
    return pixel
