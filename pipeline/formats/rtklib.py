"""RTKLIB .pos solutions → fixes of the campaign format.

Read are solutions of latitude, longitude and ellipsoidal height with their standard deviations, with or without velocity,
time-tagged by calendar date or by GPS week and seconds. UTC tags are turned into GPS time by the leap seconds. The
covariances between axes are not kept: the campaign format has sigmas.

References
----------
.. [1] T. Takasu, RTKLIB ver. 2.4.2 manual, appendix B.1 (positioning solution file).
.. [2] IERS Bulletin C (leap seconds).
"""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Gnss

GPS_EPOCH = dt.datetime(1980, 1, 6)
WEEK = 604800.0
# GPS − UTC [s] from these UTC dates on.
LEAP_SECONDS = (
    (dt.datetime(2017, 1, 1), 18),
    (dt.datetime(2015, 7, 1), 17),
    (dt.datetime(2012, 7, 1), 16),
    (dt.datetime(2009, 1, 1), 15),
)
# RTKLIB's quality flag → the format's: SBAS and DGPS are code solutions, PPP is a float one.
QUALITY = {1: 1, 2: 2, 3: 5, 4: 5, 5: 5, 6: 2}


def read_pos(path: Path, epoch: dt.datetime | None = None) -> tuple[Gnss, dt.datetime]:
    """Fixes with time in seconds after `epoch` (GPS time), and that epoch; default: the start of the first fix's GPS week.

    Raises InputError, naming the line, for what the reader does not understand: other coordinates, geodetic heights,
    records that are cut or not numbers, times that do not increase.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(
            path, "file", f"cannot be read ({error.strerror})", "correct the name or its permissions"
        ) from error
    utc, with_velocity = _header(path, [line for line in lines if line.startswith("%")])
    times: list[float] = []
    values: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("%"):
            continue
        fields = line.replace(",", " ").split()
        needed = 10 if not with_velocity else 21
        try:
            times.append(_gps_seconds(fields[0], fields[1], utc))
            row = [float(f) for f in fields[2:]]
        except (ValueError, IndexError):
            raise InputError(
                path,
                f"line {number}",
                f"'{line[:60].strip()}' is no solution record",
                "the file is damaged there or no .pos file",
            ) from None
        if len(row) < needed - 2:
            raise InputError(
                path, f"line {number}", f"has {len(fields)} fields", "the record is cut: write the solution again"
            )
        values.append(row)
        if len(times) > 1 and times[-1] <= times[-2]:
            raise InputError(
                path,
                f"line {number}",
                "its time is not after the one before it",
                "sort the records and drop repeated ones",
            )
    if len(times) < 2:
        raise InputError(path, "file", f"holds {len(times)} solutions", "at least two are needed")
    table = np.array([row[: 19 if with_velocity else 8] for row in values])
    quality = table[:, 3].astype(int)
    if unknown := sorted(set(quality.tolist()) - set(QUALITY)):
        raise InputError(path, "column Q", f"has values {unknown}", "RTKLIB's are 1 to 6")
    start = epoch or GPS_EPOCH + dt.timedelta(seconds=times[0] // WEEK * WEEK)
    offset = (start - GPS_EPOCH).total_seconds()
    velocity = table[:, 13:16] * [1.0, 1.0, -1.0] if with_velocity else None
    return Gnss(
        np.array(times) - offset,
        np.deg2rad(table[:, 0]),
        np.deg2rad(table[:, 1]),
        table[:, 2],
        np.maximum(table[:, 5:8], 1e-4),
        velocity,
        np.maximum(table[:, 16:19], 1e-4) if with_velocity else None,
        np.array([QUALITY[q] for q in quality.tolist()]),
    ), start


def _header(path: Path, header: list[str]) -> tuple[bool, bool]:
    """(times are UTC, records have velocity) by the header's column line."""
    columns = next(
        (line for line in reversed(header) if "latitude" in line or "ecef" in line or "baseline" in line), None
    )
    if columns is None:
        raise InputError(
            path,
            "header",
            "has no line of column names",
            "it is no .pos file, or write it with the header on (out-outhead=on)",
        )
    if "latitude" not in columns:
        raise InputError(
            path, "header", "does not hold latitude, longitude and height", "write the solution with out-solformat=llh"
        )
    if any("height=" in line and "geodetic" in line.lower() for line in header) or any(
        "WGS84/geodetic" in line for line in header
    ):
        raise InputError(path, "header", "has heights above a geoid", "write the solution with out-height=ellipsoidal")
    if "'" in columns:
        raise InputError(
            path, "header", "has angles in degrees, minutes and seconds", "write the solution with out-degform=deg"
        )
    if "JST" in columns:
        raise InputError(path, "header", "has times in JST", "write the solution with out-timesys=gpst")
    return "UTC" in columns, "vn(m/s)" in columns


def _gps_seconds(first: str, second: str, utc: bool) -> float:
    """Seconds after the GPS epoch of 'yyyy/mm/dd hh:mm:ss.sss' or 'week seconds'."""
    if "/" not in first:
        return int(first) * WEEK + float(second)
    year, month, day = (int(f) for f in first.split("/"))
    hour, minute, second_of_minute = second.split(":")
    moment = dt.datetime(year, month, day, int(hour), int(minute))
    seconds = (moment - GPS_EPOCH).total_seconds() + float(second_of_minute)
    if utc:
        seconds += next((leap for since, leap in LEAP_SECONDS if moment >= since), 14)
    return seconds


def seconds_of_week(time: NDArray[np.float64], epoch: str | None, where: Path) -> NDArray[np.float64]:
    """Seconds after an epoch (ISO date, GPS time) as seconds of the GPS week in which the first of them lies; they run on past
    its end. Raises InputError where the file at `where` tells no epoch."""
    if not epoch:
        raise InputError(where, "attribute 'epoch'", "is missing", "leave --seconds-of-week out: its times are its own")
    start = (dt.datetime.fromisoformat(epoch.replace("Z", "")).replace(tzinfo=None) - GPS_EPOCH).total_seconds()
    first = start + float(time[0])
    return np.asarray(time + start - first // WEEK * WEEK)
