"""Strapdown mechanisation in NED on WGS-84, compiled.

Functions
---------
increments      mean rates → rotation and velocity increments with two-sample coning and sculling
step            one strapdown step of position, velocity and attitude
quaternion_to_dcm, rotate_ned

Attitude is the quaternion (w, x, y, z) body → NED. All functions are numba-compiled and take plain arrays, since they
run once a sample.

References
----------
.. [1] P. G. Savage, Strapdown Inertial Navigation Integration Algorithm Design, J. Guidance 21 (1998) 19–28, 208–221.
.. [2] P. D. Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., ch. 5.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from tsmftis import geodesy

OMEGA = geodesy.EARTH_RATE

# One ellipsoid and one gravity for the whole project, compiled for single points.
gravity = numba.njit(cache=True, nogil=True)(geodesy.normal_gravity)
radii = numba.njit(cache=True, nogil=True)(geodesy.radii_of_curvature)


@numba.njit(cache=True, nogil=True)
def quaternion_to_dcm(q: Any, out: Any) -> None:
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@numba.njit(cache=True, nogil=True)
def _multiply(p: Any, q: Any, out: Any) -> None:
    a, b, c, d = p[0], p[1], p[2], p[3]
    e, f, g, h = q[0], q[1], q[2], q[3]
    out[0] = a * e - b * f - c * g - d * h
    out[1] = a * f + b * e + c * h - d * g
    out[2] = a * g - b * h + c * e + d * f
    out[3] = a * h + b * g - c * f + d * e


@numba.njit(cache=True, nogil=True)
def _from_vector(v: Any, out: Any) -> None:
    half2 = 0.25 * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if half2 < 1e-8:
        scale = 0.5 * (1.0 - half2 / 6.0 + half2 * half2 / 120.0)
        out[0] = 1.0 - half2 / 2.0 + half2 * half2 / 24.0
    else:
        half = math.sqrt(half2)
        scale = 0.5 * math.sin(half) / half
        out[0] = math.cos(half)
    out[1] = scale * v[0]
    out[2] = scale * v[1]
    out[3] = scale * v[2]


@numba.njit(cache=True, nogil=True)
def turn(q: Any, theta: Any) -> Any:
    """Attitudes (n, 4) after each of the body's rotation vectors theta (n, 3) [rad], from q, in a fixed frame."""
    out = np.empty((theta.shape[0], 4))
    step_q, now = np.empty(4), q.copy()
    for i in range(theta.shape[0]):
        _from_vector(theta[i], step_q)
        _multiply(now, step_q, out[i])
        now = out[i]
    return out


@numba.njit(cache=True, nogil=True)
def rotate_ned(q: Any, phi: Any) -> None:
    """q ← exp(φ)·q with φ [rad] resolved in NED, in place, renormalised."""
    left = np.empty(4)
    _from_vector(phi, left)
    result = np.empty(4)
    _multiply(left, q, result)
    norm = math.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2 + result[3] ** 2)
    for i in range(4):
        q[i] = result[i] / norm


@numba.njit(cache=True, nogil=True)
def increments(
    gyro: Any, accel: Any, gyro_before: Any, accel_before: Any, dt: float, dt_before: float, theta: Any, dv: Any
) -> None:
    """Rotation vector and velocity increment of one interval from mean rates, Savage's two-sample form [1]_.

    Δθ = α + (1/12) α₋×α, Δv = υ + ½ α×υ + (1/12)(α₋×υ + υ₋×α), α = ω·dt, υ = f·dt, and α₋, υ₋ the preceding interval's
    increments. The preceding sample is scaled to this interval's length, so unequal stamps stay correct to second order.
    """
    ax, ay, az = gyro[0] * dt, gyro[1] * dt, gyro[2] * dt
    ux, uy, uz = accel[0] * dt, accel[1] * dt, accel[2] * dt
    # The rate's slope is (ω − ω₋)/((dt + dt₋)/2); the classical 1/12 holds for dt₋ = dt.
    scale = dt * 2.0 * dt / (dt + dt_before) / 12.0
    bx, by, bz = gyro_before[0] * scale, gyro_before[1] * scale, gyro_before[2] * scale
    cx, cy, cz = accel_before[0] * scale, accel_before[1] * scale, accel_before[2] * scale
    theta[0] = ax + by * az - bz * ay
    theta[1] = ay + bz * ax - bx * az
    theta[2] = az + bx * ay - by * ax
    dv[0] = ux + 0.5 * (ay * uz - az * uy) + (by * uz - bz * uy) + (cy * az - cz * ay)
    dv[1] = uy + 0.5 * (az * ux - ax * uz) + (bz * ux - bx * uz) + (cz * ax - cx * az)
    dv[2] = uz + 0.5 * (ax * uy - ay * ux) + (bx * uy - by * ux) + (cx * ay - cy * ax)


@numba.njit(cache=True, nogil=True)
def step(position: Any, velocity: Any, q: Any, dcm: Any, theta: Any, dv: Any, dt: float) -> None:
    """Advance latitude, longitude, height, NED velocity and attitude by one interval, in place; `dcm` follows q.

    v̇ = C f + g − (2ω_ie + ω_en)×v with C at the interval's start turned back by half the NED frame's rotation; position
    by the trapezoid of velocity; q by the body and the NED rotation.
    """
    lat, h = position[0], position[2]
    rn, re = radii(lat)
    vn, ve, vd = velocity[0], velocity[1], velocity[2]
    g = gravity(lat, h)
    # Velocity half an interval ahead, for the Coriolis and transport terms.
    ax = dcm[0, 0] * dv[0] + dcm[0, 1] * dv[1] + dcm[0, 2] * dv[2]
    ay = dcm[1, 0] * dv[0] + dcm[1, 1] * dv[1] + dcm[1, 2] * dv[2]
    az = dcm[2, 0] * dv[0] + dcm[2, 1] * dv[1] + dcm[2, 2] * dv[2]
    mn, me, md = vn + 0.5 * ax, ve + 0.5 * ay, vd + 0.5 * (az + g * dt)
    ien, ied = OMEGA * math.cos(lat), -OMEGA * math.sin(lat)
    enn, ene, end = me / (re + h), -mn / (rn + h), -me * math.tan(lat) / (re + h)
    rx, ry, rz = (ien + enn) * dt, ene * dt, (ied + end) * dt
    # Half of the frame's rotation.
    bx = ax - 0.5 * (ry * az - rz * ay)
    by = ay - 0.5 * (rz * ax - rx * az)
    bz = az - 0.5 * (rx * ay - ry * ax)
    cx, cy, cz = 2.0 * ien + enn, ene, 2.0 * ied + end
    nn = vn + bx - (cy * md - cz * me) * dt
    ne = ve + by - (cz * mn - cx * md) * dt
    nd = vd + bz + (g - (cx * me - cy * mn)) * dt
    height = h - 0.5 * (vd + nd) * dt
    hm = 0.5 * (h + height)
    latitude = lat + 0.5 * (vn + nn) / (rn + hm) * dt
    _, rem = radii(0.5 * (lat + latitude))
    position[1] += 0.5 * (ve + ne) / ((rem + hm) * math.cos(0.5 * (lat + latitude))) * dt
    position[0], position[2] = latitude, height
    velocity[0], velocity[1], velocity[2] = nn, ne, nd
    body, frame, half, result = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    turn = np.empty(3)
    turn[0], turn[1], turn[2] = -rx, -ry, -rz
    _from_vector(theta, body)
    _from_vector(turn, frame)
    _multiply(q, body, half)
    _multiply(frame, half, result)
    norm = math.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2 + result[3] ** 2)
    for i in range(4):
        q[i] = result[i] / norm
    quaternion_to_dcm(q, dcm)
