"""Changes to a campaign's declaration or data whose effect is known, for loop_perturbed.py.

Each is made to a writable copy of a campaign, by a function of its folder. What is declared too large has a negative effect (a
value is what must be added to the declared model, docs/campaign-format.md), what is done to the data a positive one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import rasterio
import xarray as xr
import yaml

Change = Callable[[Path], None]
HYSTERESIS = 2e-7, 5.0  # rad/s, K


def declare(key: str, value: Any, folder: Path) -> None:
    """Set `section.name[.name]` of instrument.yaml; a function is applied to what stands there."""
    path = folder / "instrument.yaml"
    whole = yaml.safe_load(path.read_text())
    *sections, name = key.split(".")
    table = whole
    for section in sections:
        table = table[section]
    table[name] = value(table.get(name, 0.0)) if callable(value) else value
    path.write_text(yaml.safe_dump(whole))


def edit(pattern: str, change: Callable[[xr.Dataset], Any], folder: Path) -> None:
    """Change the variables of the NetCDF files that match, in place; `change` may return another dataset."""
    for path in sorted(folder.glob(pattern)):
        with xr.open_dataset(path, decode_times=False) as file:
            data = file.load()
        new = change(data)
        (data if new is None else new).to_netcdf(path)


def shifted(seconds: float, d: xr.Dataset) -> xr.Dataset:
    """Every stamp later: stamp = true time + seconds."""
    return d.assign_coords(time=(d.time.dims, d.time.values + seconds, d.time.attrs))


def scaled(sensor: str, factors: tuple[float, float, float], d: xr.Dataset) -> None:
    """Measured = (1 + factor) × true."""
    d[sensor].values[:] *= 1 + np.array(factors)


def g_sensitive(factors: tuple[float, float, float], d: xr.Dataset) -> None:
    """Each gyro gains factor × the specific force along it."""
    d.gyro.values[:] += np.array(factors) * d.accel.values


def play(temperature: np.ndarray, half_width: float) -> np.ndarray:
    """The backlash operator, started at the first temperature."""
    out, at = np.empty_like(temperature), temperature[0]
    for i, value in enumerate(temperature):
        out[i] = at = min(max(at, value - half_width), value + half_width)
    return out


def hysteretic(d: xr.Dataset) -> None:
    """Each gyro gains amount × (play(T; h) − T)/h, T the mean of its thermometers."""
    amount, half_width = HYSTERESIS
    stamps = d.time_temperature.values if "time_temperature" in d.variables else d.time.values
    for axis in range(3):
        t = d.temperature_gyro.values[:, axis].astype(float).mean(axis=-1)
        d.gyro.values[:, axis] += amount * np.interp(d.time.values, stamps, (play(t, half_width) - t) / half_width)


def frames_changed(
    change: Callable[[np.ndarray, np.ndarray], np.ndarray], flat: bool, folder: Path, lines: str = "L0?"
) -> None:
    """Signal after dark (and over flat) → another signal by change(signal, time), back into counts."""
    with xr.open_dataset(folder / "calibration.nc") as c:
        dark, gain = c.dark.values, c.flat.values if flat else 1.0
    for path in sorted(folder.glob(f"*/{lines}.nc")):
        with xr.open_dataset(path, decode_times=False) as file:
            d = file.load()
        signal = change((d.frames.values - dark) / gain, d.time.values) * gain + dark
        d["frames"] = (d.frames.dims, np.clip(np.round(signal), 0, 65535).astype(np.uint16), d.frames.attrs)
        d.to_netcdf(path, encoding={"frames": {"zlib": True, "complevel": 1}})


def rows_moved(rows: Callable[[np.ndarray], np.ndarray], lines: str, folder: Path) -> None:
    """The scene, and the control points in it, move by whole rows, so many in each frame: a camera turned about its course."""

    def move(signal: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        count = signal.shape[1]
        return np.stack(
            [s[np.clip(np.arange(count) - r, 0, count - 1)] for s, r in zip(signal, rows(time_s), strict=True)]
        )

    frames_changed(move, True, folder, lines)
    for path in sorted(folder.glob(f"*/{lines}_gcps.csv")):
        with xr.open_dataset(path.with_name(path.name.replace("_gcps.csv", ".nc")), decode_times=False) as d:
            by_frame = rows(d.time.values)
        points = pd.read_csv(path, dtype=str)
        points["row"] = points.row.astype(float) + by_frame[points.frame.astype(int)]
        points.to_csv(path, index=False)


def dem_changed(change: Callable[[np.ndarray], np.ndarray] | None, shift_m: float, folder: Path) -> None:
    """Heights changed, or the whole model moved eastward."""
    path = folder / "dem.tif"
    with rasterio.open(path) as file:
        profile, heights = file.profile, file.read(1)
    east = shift_m if profile["crs"].is_projected else shift_m / (111.3e3 * np.cos(np.deg2rad(profile["transform"].f)))
    profile["transform"] = rasterio.Affine.translation(east, 0) * profile["transform"]
    path.unlink()
    with rasterio.open(path, "w", **profile) as file:
        file.write((change(heights) if change else heights).astype(heights.dtype), 1)


def misaligned(name: str, axis: int, other: int, angle: float, d: xr.Dataset) -> None:
    """A sensor shows a part of what another axis turns or feels."""
    d[name].values[:, axis] += angle * d[name].values[:, other]


def velocity_lag(seconds: float, d: xr.Dataset) -> None:
    """Velocities as they were some time before their stamp."""
    for axis in range(3):
        d.velocity.values[:, axis] = np.interp(d.time.values - seconds, d.time.values, d.velocity.values[:, axis])


def no_velocity(d: xr.Dataset) -> xr.Dataset:
    """Positions alone."""
    return d.drop_vars(["velocity", "sigma_velocity"])


def east(metres: float, d: xr.Dataset) -> None:
    """Every fix to the east."""
    d.longitude.values[:] += metres / (111.32e3 * np.cos(np.deg2rad(d.latitude.values)))


def warmer(kelvin: float, d: xr.Dataset) -> None:
    """Every thermometer reads too much."""
    for name in ("temperature_gyro", "temperature_accel"):
        d[name].values[:] += kelvin


def tilted_response(slope: float, d: xr.Dataset) -> None:
    """Response × (1 + slope·u), u from −1 to 1 over the range."""
    d.response.values[:] *= 1 + slope * np.linspace(-1, 1, d.response.size)


def one_reference(factor: float, d: xr.Dataset) -> None:
    """The third panel's radiance is declared too large."""
    d.radiance.values[2] *= factor


def outlier_track(folder: Path) -> None:
    """Every sixth control point is 9 rows towards the middle from where it was."""
    for path in sorted(folder.glob("*/*_gcps.csv")):
        points = pd.read_csv(path, dtype=str)
        row = points.row.astype(float)
        points["row"] = row + np.where(np.arange(len(points)) % 6 == 0, np.where(row > 40, -9.0, 9.0), 0.0)
        points.to_csv(path, index=False)


def halved(first: bool, d: xr.Dataset) -> xr.Dataset:
    """One half of the epochs."""
    middle = d.time.size // 2
    return d.isel(time=slice(0, middle) if first else slice(middle, None))


def campaign(change: Callable[[dict[str, Any]], Any], folder: Path) -> None:
    """Change campaign.yaml."""
    path = folder / "campaign.yaml"
    keys = yaml.safe_load(path.read_text())
    change(keys)
    path.write_text(yaml.safe_dump(keys))


def without(what: str, keys: dict[str, Any]) -> None:
    """Cut a campaign down: no lines, chamber runs only, no references, one line, no surface."""
    flight = keys["flights"][0]
    match what:
        case "lines":
            flight["lines"] = []
        case "flights":
            del keys["flights"]
        case "second line":
            flight["lines"] = flight["lines"][:1]
        case key:
            del keys[key]


def added(key: str, value: float) -> partial[None]:
    return partial(declare, key, lambda old: old + value)


def times(key: str, value: float) -> partial[None]:
    return partial(declare, key, lambda old: old * value)


def arm(axis: int, metres: float) -> partial[None]:
    return partial(
        declare, "mounting.imu_to_antenna_m", lambda old: [v + metres * (i == axis) for i, v in enumerate(old)]
    )
