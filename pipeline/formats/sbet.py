"""SBET: the smoothed best estimate of trajectory, 17 little-endian float64 a record, no header.

    vN = vx·cos w − vy·sin w,   vE = −(vx·sin w + vy·cos w),   vD = −vz,   true heading = platform heading − w

with w the wander angle. All is SI and radians; height is above the ellipsoid. What the field's own files do, measured
on an aircraft's (`leeward_sbet_200rec.out`):

- acceleration and rate of a record are means over the interval that ends at its stamp;
- the rate is that of the body against the local-level frame of the record's heading, in body axes: Earth rate and
  transport rate are taken off. It integrates to roll, pitch and platform heading within 1e-7 rad/s over a second, where
  leaving either rate in would show as 7e-5 or 2e-5 rad/s (so, with w = 0 as written here, the frame is NED and all of
  its transport rate comes off);
- the acceleration is specific force plus gravity, Coriolis left in: that fits v̇ within 3e-3 m/s².

Functions
---------
read_sbet, write_sbet       bit for bit
from_trajectory             records of a Trajectory
to_trajectory               and back, without sigmas
velocity_ned, heading       as above

References
----------
.. [1] Applanix, POSPac MMS: SBET format, as described by PDAL (readers.sbet) and gadomski/sbet.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.formats.binary import read_records, write_records
from pipeline.records import Trajectory
from tsmftis.geodesy import earth_rate_ned, normal_gravity, radii_of_curvature
from tsmftis.rotation import rpy_to_dcm

Array = NDArray[np.float64]
Records = NDArray[Any]

# Field and the largest magnitude that is believed: far outside any aircraft, far inside what other bytes look like.
LIMITS = {
    "time": 1e10,  # s
    "latitude": np.pi / 2,
    "longitude": 2 * np.pi,
    "height": 1e6,  # rad, rad, m
    "velocity_x": 1e4,
    "velocity_y": 1e4,
    "velocity_z": 1e4,  # m/s
    "roll": 2 * np.pi,
    "pitch": np.pi,
    "platform_heading": 4 * np.pi,
    "wander": 4 * np.pi,  # rad
    "acceleration_x": 1e4,
    "acceleration_y": 1e4,
    "acceleration_z": 1e4,  # m/s²
    "rate_x": 1e3,
    "rate_y": 1e3,
    "rate_z": 1e3,  # rad/s
}
DTYPE = np.dtype([(name, "<f8") for name in LIMITS])


def read_sbet(path: Path) -> Records:
    """The records (n,) of an SBET file as a structured array of `DTYPE`; raises InputError where it cannot be one."""
    records = read_records(path, DTYPE, "SBET")
    for name, limit in LIMITS.items():
        bad = ~(np.abs(records[name]) <= limit)  # catches NaN as well
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(
                path,
                f"record {i}, {name}",
                f"is {records[name][i]:.6g}, beyond ±{limit:.6g}",
                "the file is no little-endian SBET of 17 doubles, or damaged there",
            )
    backwards = np.diff(records["time"]) <= 0
    if backwards.any():
        i = int(np.argmax(backwards)) + 1
        raise InputError(
            path,
            f"record {i}, time",
            f"is {records['time'][i]:.6f} s after {records['time'][i - 1]:.6f} s",
            "time must increase: sort the records, and unwrap seconds of week",
        )
    return records


def write_sbet(records: Records, path: Path) -> None:
    """Write records of `DTYPE`; what `read_sbet` gave comes out bit for bit."""
    write_records(records, DTYPE, path, "SBET")


def from_trajectory(trajectory: Trajectory) -> Records:
    """a = f + Cᵀg,  ω = ω_ib − Cᵀ(ω_ie + ω_en),  wander angle 0; time stays in seconds after the campaign's epoch.

    C body→NED; f specific force, ω_ib measured rate (both compensated, body axes); g normal gravity, down; ω_ie Earth
    rate, ω_en transport rate of NED. Trajectory of n samples → (n,) of `DTYPE`.
    """
    t = trajectory
    north, east, down = t.velocity.T
    roll, pitch, yaw = t.rpy.T
    gravity, turning = _frame(t.latitude, t.height, t.velocity, np.zeros(t.time.size))
    to_ned = rpy_to_dcm(roll, pitch, yaw)
    acceleration = t.specific_force + np.einsum("nji,nj->ni", to_ned, gravity)
    rate = t.rate - np.einsum("nji,nj->ni", to_ned, turning)
    columns = (
        t.time,
        t.latitude,
        (t.longitude + np.pi) % (2.0 * np.pi) - np.pi,
        t.height,
        north,
        -east,
        -down,
        roll,
        pitch,
        yaw,
        np.zeros_like(yaw),
        *acceleration.T,
        *rate.T,
    )
    records = np.empty(t.time.size, DTYPE)
    for name, column in zip(LIMITS, columns, strict=True):
        records[name] = column
    return records


def to_trajectory(records: Records) -> Trajectory:
    """The inverse of `from_trajectory`: f = a − Cᵀg,  ω_ib = ω + Cᵀω_in, ω_in with the frame's own turning by ẇ.

    (n,) of `DTYPE` → Trajectory of n samples; an SBET holds no sigmas, so they are NaN. Times are the file's own.
    """
    r = records
    velocity = velocity_ned(r)
    wander = np.unwrap(r["wander"])
    wander_rate = np.gradient(wander, r["time"]) if r.size > 1 else np.zeros(r.size)
    gravity, turning = _frame(r["latitude"], r["height"], velocity, wander_rate)
    rpy = np.stack([r["roll"], r["pitch"], heading(r)], -1)
    to_ned = rpy_to_dcm(*rpy.T)
    unknown = np.full((r.size, 3), np.nan)
    acceleration, rate = (np.stack([r[f"{name}_{axis}"] for axis in "xyz"], -1) for name in ("acceleration", "rate"))
    return Trajectory(
        r["time"].copy(),
        r["latitude"].copy(),
        np.unwrap(r["longitude"]),
        r["height"].copy(),
        velocity,
        rpy,
        unknown,
        unknown.copy(),
        unknown.copy(),
        rate + np.einsum("nji,nj->ni", to_ned, turning),
        acceleration - np.einsum("nji,nj->ni", to_ned, gravity),
    )


def _frame(latitude: Array, height: Array, velocity: Array, wander_rate: Array) -> tuple[Array, Array]:
    """Gravity [m/s²] and the turning of the record's frame against the inertial one [rad/s], both in NED (n, 3).

    ω_in = ω_ie + (vE/(R_E+h), −vN/(R_N+h), −vE·tan L/(R_E+h) − ẇ): the frame's axes lie at azimuth −w.
    """
    north, east, _ = velocity.T
    meridian, prime = radii_of_curvature(latitude)
    down = -east * np.tan(latitude) / (prime + height) - wander_rate
    transport = np.stack([east / (prime + height), -north / (meridian + height), down], -1)
    gravity = np.zeros_like(velocity)
    gravity[:, 2] = normal_gravity(latitude, height)
    return gravity, earth_rate_ned(latitude) + transport


def velocity_ned(records: Records) -> Array:
    """vN = vx·cos w − vy·sin w, vE = −(vx·sin w + vy·cos w), vD = −vz; (n,) → (n, 3) [m/s]."""
    vx, vy, vz, wander = (records[name] for name in ("velocity_x", "velocity_y", "velocity_z", "wander"))
    return np.stack([vx * np.cos(wander) - vy * np.sin(wander), -(vx * np.sin(wander) + vy * np.cos(wander)), -vz], -1)


def heading(records: Records) -> Array:
    """True heading = platform heading − wander angle, in [−π, π); (n,) → (n,) [rad]."""
    return (records["platform_heading"] - records["wander"] + np.pi) % (2.0 * np.pi) - np.pi
