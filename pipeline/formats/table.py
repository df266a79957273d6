"""Trajectories as text: CSV for spreadsheets and KML for globes.

Functions
---------
write_csv       one line a sample, with sigmas
write_kml       the path as a line in WGS-84
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Trajectory

Array = NDArray[np.float64]


def columns(t: Trajectory) -> dict[str, tuple[Array, str]]:
    """Column name (unit in it) → values and format, of position, velocity, attitude and their sigmas."""
    deg = np.rad2deg
    out: dict[str, tuple[Array, str]] = {
        "time_s": (t.time, "%.6f"),
        "latitude_deg": (deg(t.latitude), "%.10f"),
        "longitude_deg": ((deg(t.longitude) + 180.0) % 360.0 - 180.0, "%.10f"),
        "height_m": (t.height, "%.4f"),
    }
    rpy = ("roll", "pitch", "yaw")
    for i, axis in enumerate(("north", "east", "down")):
        out[f"velocity_{axis}_m_per_s"] = (t.velocity[:, i], "%.5f")
    for i, angle in enumerate(rpy):
        out[f"{angle}_deg"] = (deg(t.rpy[:, i]) % 360.0 if angle == "yaw" else deg(t.rpy[:, i]), "%.6f")
    for i, axis in enumerate(("north", "east", "down")):
        out[f"sigma_{axis}_m"] = (t.sigma_position[:, i], "%.4f")
    for i, axis in enumerate(("north", "east", "down")):
        out[f"sigma_velocity_{axis}_m_per_s"] = (t.sigma_velocity[:, i], "%.5f")
    for i, angle in enumerate(rpy):
        out[f"sigma_{angle}_deg"] = (deg(t.sigma_attitude[:, i]), "%.6f")
    return out


def write_csv(trajectory: Trajectory, path: Path, index: tuple[str, NDArray[np.int64]] | None = None) -> None:
    """Write a trajectory as CSV, one line a sample; `index` names a first column. What is not known (NaN) is left empty."""
    table = columns(trajectory)
    header = [*([index[0]] if index else []), *table]
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(header) + "\n")
        for k in range(trajectory.time.size):
            row = [str(int(index[1][k]))] if index else []
            row += [fmt % values[k] if np.isfinite(values[k]) else "" for values, fmt in table.values()]
            stream.write(",".join(row) + "\n")


def write_kml(trajectory: Trajectory, path: Path, name: str) -> None:
    """Write the path as KML. Its heights are ellipsoidal, where a globe takes them for heights above the geoid."""
    at = zip(
        (np.rad2deg(trajectory.longitude) + 180.0) % 360.0 - 180.0,
        np.rad2deg(trajectory.latitude),
        trajectory.height,
        strict=True,
    )
    coordinates = "\n".join(f"{lon:.9f},{lat:.9f},{h:.3f}" for lon, lat, h in at)
    said = (
        f"From {trajectory.time[0]:.3f} to {trajectory.time[-1]:.3f} s. Heights are above the WGS-84 ellipsoid; globes show "
        "them as if above the geoid."
    )
    path.write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>{escape(name)}</name>
<Style id="path"><LineStyle><color>ff0b63b0</color><width>2</width></LineStyle></Style>
<Placemark>
<name>{escape(name)}</name>
<description>{escape(said)}</description>
<styleUrl>#path</styleUrl>
<LineString>
<altitudeMode>absolute</altitudeMode>
<coordinates>
{coordinates}
</coordinates>
</LineString>
</Placemark>
</Document>
</kml>
""",
        encoding="utf-8",
    )
