"""Frames: each pixel's footprint on the ground, what lies there, and what the detector makes of its light.

The corners of every pixel are cast to the terrain along exact rays; points inside the pixel lie bilinearly between them
(the terrain is smooth over a pixel). At each point stands a panel or a mixture of materials, and each material has its
own signal at every pixel (`interferometer.interferogram`); the pixel's is the mean.

Functions
---------
camera_poses    flight → pose of the camera
flexure         vibration of the mount
cast            rays → ground
expose          poses, scene, signals → ideal signal
digitise        ideal signal → counts
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

from tsmftis import geodesy, rotation
from tsmftis.simulator.flight import Flight
from tsmftis.simulator.lens import Lens, ray
from tsmftis.simulator.world import Panels, Plane, Terrain, Texture

Array = NDArray[np.float64]

FLEXURE_CUTOFF = 12.0  # Hz


@dataclass(frozen=True)
class Mount:
    """How the camera sits on the body: lever arm (3,) [m], C_camera→body (3, 3), and its two weaknesses.

    drift (3,) [rad/K]: rotation vector × (mean accelerometer temperature − 25 °C), in the body frame after boresight.
    flexure (2,) [rad per rad/s²]: rotation about x and y by angular acceleration.
    """

    lever_arm: Array
    boresight: Array
    drift: Array
    flexure: Array


def angular_acceleration(end: Array, gyro: Array, rate: float) -> CubicSpline:
    """dω/dt (3,) [rad/s²] as a function of time, from mean rates (n, 3) over intervals ending at (n,); rate in Hz.

    Zero-phase second-order Butterworth low pass at 12 Hz, then the derivative of a spline.
    """
    b, a = butter(2, FLEXURE_CUTOFF, fs=rate)
    return CubicSpline(end - 0.5 / rate, filtfilt(b, a, gyro, axis=0)).derivative()


def camera_poses(
    flight: Flight, time: Array, mount: Mount, warmth: Array, acceleration: CubicSpline | None
) -> tuple[Array, Array]:
    """Projection centre (n, 3) [m] and C_camera→ECEF (n, 3, 3) at times (n,).

    warmth (n,) [K] is the mean accelerometer temperature above 25 °C; `acceleration` is needed where the mount flexes.
    """
    body = flight.attitude(time)
    to_body = rotation.exp_so3(warmth[:, None] * mount.drift) @ mount.boresight
    if mount.flexure.any():
        if acceleration is None:
            raise ValueError("a mount that flexes needs the angular acceleration")
        bend = np.zeros((time.size, 3))
        bend[:, :2] = mount.flexure * acceleration(time)[:, :2]
        to_body = rotation.exp_so3(bend) @ to_body
    return flight.position(time) + body @ mount.lever_arm, body @ to_body


@numba.njit(cache=True, inline="always")
def _distance(px, py, pz, dx, dy, dz, height, north, west, d_lat, d_lon, guess):  # type: ignore[no-untyped-def]
    """Distance along a ray to the terrain, by fixed point on height; NaN where it leaves the terrain."""
    a, e2 = geodesy.SEMI_MAJOR_AXIS, geodesy.ECCENTRICITY_SQUARED
    b = a * np.sqrt(1.0 - e2)
    ep2 = e2 / (1.0 - e2)
    rows, cols = height.shape
    t = guess
    for _ in range(30):
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        p = np.sqrt(x * x + y * y)
        # Bowring's latitude: exact to 1e-11 rad near the ground
        beta_s, beta_c = z * a, p * b
        norm = np.sqrt(beta_s * beta_s + beta_c * beta_c)
        beta_s, beta_c = beta_s / norm, beta_c / norm
        lat_s, lat_c = z + ep2 * b * beta_s**3, p - e2 * a * beta_c**3
        lat = np.arctan2(lat_s, lat_c)
        norm = np.sqrt(lat_s * lat_s + lat_c * lat_c)
        lat_s, lat_c = lat_s / norm, lat_c / norm
        h = p * lat_c + z * lat_s - a * np.sqrt(1.0 - e2 * lat_s * lat_s)
        row = (north - lat) / d_lat - 0.5
        col = (np.arctan2(y, x) - west) / d_lon - 0.5
        i, j = int(np.floor(row)), int(np.floor(col))
        if i < 0 or j < 0 or i >= rows - 1 or j >= cols - 1:
            return np.nan
        fr, fc = row - i, col - j
        ground = (1.0 - fr) * ((1.0 - fc) * height[i, j] + fc * height[i, j + 1]) + fr * (
            (1.0 - fc) * height[i + 1, j] + fc * height[i + 1, j + 1]
        )
        up = (dx * x + dy * y) / p * lat_c + dz * lat_s  # climb of the ray per metre, negative
        if up >= -0.1:
            return np.nan
        change = (ground - h) / up
        t += change
        if abs(change) < 1e-5:
            return t
    return np.nan


@numba.njit(parallel=True, cache=True)
def _cast(position, direction, height, north, west, d_lat, d_lon, guess):  # type: ignore[no-untyped-def]
    out = np.empty(len(position))
    for i in numba.prange(len(position)):
        out[i] = _distance(
            position[i, 0],
            position[i, 1],
            position[i, 2],
            direction[i, 0],
            direction[i, 1],
            direction[i, 2],
            height,
            north,
            west,
            d_lat,
            d_lon,
            guess[i],
        )
    return out


def cast(position: Array, direction: Array, terrain: Terrain) -> Array:
    """ECEF points (n, 3) where rays from position (n, 3) along unit directions (n, 3) meet the terrain, or NaN."""
    _, _, height = geodesy.ecef_to_geodetic(position)
    distance = _cast(
        np.ascontiguousarray(position),
        np.ascontiguousarray(direction),
        terrain.height,
        terrain.north,
        terrain.west,
        terrain.d_latitude,
        terrain.d_longitude,
        height - float(terrain.height.mean()),
    )
    return position + distance[:, None] * direction


@dataclass(frozen=True)
class Scene:
    """What lies under a line. Materials are indices into the signals; `background` (m,) names those of the texture."""

    terrain: Terrain
    plane: Plane
    panels: Panels
    texture: Texture
    background: NDArray[np.int64]


def expose(
    position: Array, to_ecef: Array, lens: Lens, scene: Scene, signal: Array, samples: int
) -> NDArray[np.float32]:
    """Ideal signal [DN, before flat and dark] of frames: the mean over samples × samples points of every pixel.

    position (frame, instant, 3) [m], to_ecef (frame, instant, 3, 3): the camera at instants spread evenly over the
    exposure (one instant freezes it); signal (material, row, col) → (frame, row, col).

    Raises ValueError where a ray leaves the terrain.
    """
    _, rows, cols = signal.shape
    corner = ray(lens, np.arange(rows + 1)[:, None] - 0.5, np.arange(cols + 1)[None, :] - 0.5)
    _, _, height = geodesy.ecef_to_geodetic(position)
    terrain, panels, texture = scene.terrain, scene.panels, scene.texture
    frames = _expose(
        np.ascontiguousarray(position),
        np.ascontiguousarray(to_ecef),
        corner,
        terrain.height,
        terrain.north,
        terrain.west,
        terrain.d_latitude,
        terrain.d_longitude,
        np.ascontiguousarray(height - float(terrain.height.mean())),
        scene.plane.origin,
        np.stack([scene.plane.along, scene.plane.across]),
        panels.centre,
        0.5 * panels.side,
        panels.material,
        texture.abundance,
        texture.corner,
        texture.cell,
        scene.background,
        signal,
        samples,
    )
    if np.isnan(frames).any():
        raise ValueError("a ray leaves the terrain: the line is not flown level, or terrain.margin_m is too small")
    return np.asarray(frames)


@numba.njit(parallel=True, cache=True)
def _expose(  # type: ignore[no-untyped-def]
    position,
    to_ecef,
    corner,
    height,
    north,
    west,
    d_lat,
    d_lon,
    guess,
    origin,
    axes,
    centre,
    half,
    material,
    abundance,
    texture_corner,
    cell,
    background,
    signal,
    samples,
):
    frames, instants = position.shape[:2]
    rows, cols = corner.shape[0] - 1, corner.shape[1] - 1
    na, nc, nb = abundance.shape
    out = np.zeros((frames, rows, cols), np.float32)
    for f in numba.prange(frames):
        ground = np.empty((rows + 1, cols + 1, 2))
        for k in range(instants):
            p, c = position[f, k], to_ecef[f, k]
            for i in range(rows + 1):
                t = guess[f, k]
                for j in range(cols + 1):
                    x, y = corner[i, j, 0], corner[i, j, 1]
                    norm = 1.0 / np.sqrt(x * x + y * y + 1.0)
                    dx = (c[0, 0] * x + c[0, 1] * y + c[0, 2]) * norm
                    dy = (c[1, 0] * x + c[1, 1] * y + c[1, 2]) * norm
                    dz = (c[2, 0] * x + c[2, 1] * y + c[2, 2]) * norm
                    t = _distance(p[0], p[1], p[2], dx, dy, dz, height, north, west, d_lat, d_lon, t)
                    gx, gy, gz = p[0] + t * dx - origin[0], p[1] + t * dy - origin[1], p[2] + t * dz - origin[2]
                    ground[i, j, 0] = axes[0, 0] * gx + axes[0, 1] * gy + axes[0, 2] * gz
                    ground[i, j, 1] = axes[1, 0] * gx + axes[1, 1] * gy + axes[1, 2] * gz
            for i in range(rows):
                for j in range(cols):
                    a00, b00 = ground[i, j]
                    a01, b01 = ground[i, j + 1]
                    a10, b10 = ground[i + 1, j]
                    a11, b11 = ground[i + 1, j + 1]
                    if np.isnan(a00 + a01 + a10 + a11):
                        out[f, i, j] = np.nan
                        continue
                    low_a, high_a = min(a00, a01, a10, a11), max(a00, a01, a10, a11)
                    low_b, high_b = min(b00, b01, b10, b11), max(b00, b01, b10, b11)
                    near = -1
                    for q in range(centre.shape[0]):
                        if (
                            low_a <= centre[q, 0] + half[q]
                            and high_a >= centre[q, 0] - half[q]
                            and low_b <= centre[q, 1] + half[q]
                            and high_b >= centre[q, 1] - half[q]
                        ):
                            near = q
                    total = 0.0
                    for u in range(samples):
                        fr = (u + 0.5) / samples
                        for v in range(samples):
                            fc = (v + 0.5) / samples
                            a = (1 - fr) * ((1 - fc) * a00 + fc * a01) + fr * ((1 - fc) * a10 + fc * a11)
                            b = (1 - fr) * ((1 - fc) * b00 + fc * b01) + fr * ((1 - fc) * b10 + fc * b11)
                            inside = near >= 0
                            if inside:
                                off = max(abs(a - centre[near, 0]), abs(b - centre[near, 1]))
                                inside = off <= half[near]
                            if inside:
                                total += signal[material[near], i, j]
                            else:
                                ia = int(np.floor((a - texture_corner[0]) / cell)) % na
                                ib = int(np.floor((b - texture_corner[1]) / cell)) % nc
                                for m in range(nb):
                                    total += abundance[ia, ib, m] * signal[background[m], i, j]
                    out[f, i, j] += total / (samples * samples * instants)
    return out


def digitise(
    signal: Array, dark: Array, electrons_per_dn: float, read_noise: float, saturation: int, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Counts of the signal after dark (frame, row, col) [DN].

    Dark, shot noise of variance s/electrons_per_dn, read noise [DN] are added; then rounded and clipped at saturation.
    """
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    sigma = np.sqrt(np.maximum(signal, 0.0) / electrons_per_dn + read_noise**2)
    return np.clip(np.rint(signal + dark + sigma * noise), 0, saturation).astype(np.uint16)
