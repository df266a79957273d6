"""The door for NetCDF-4 and Zarr: names, dimensions, units and finiteness are checked here and nowhere else.

Functions
---------
open_dataset        a NetCDF-4 file or a Zarr store as an xarray Dataset, lazily
take                one checked variable in the contract's dimension order and unit
take_time           a strictly increasing time axis
write_dataset       NetCDF-4, reproducible byte for byte
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pipeline.errors import InputError

# Spellings that mean the unit on the left. Anything else is refused, never guessed.
UNIT_SPELLINGS: Mapping[str, tuple[str, ...]] = {
    "s": ("s", "sec", "second", "seconds"),
    "rad s-1": ("rad s-1", "rad/s", "rad s^-1", "rad.s-1", "radian s-1"),
    "m s-2": ("m s-2", "m/s2", "m/s^2", "m/s**2", "m s^-2", "m.s-2"),
    "m s-1": ("m s-1", "m/s", "m s^-1", "m.s-1"),
    "m": ("m", "metre", "meter", "metres", "meters"),
    "m-1": ("m-1", "1/m", "m^-1"),
    "degC": ("degC", "deg C", "°C", "celsius", "Celsius", "degree_Celsius", "degrees_Celsius"),
    "degrees_north": ("degrees_north", "degree_north"),
    "degrees_east": ("degrees_east", "degree_east"),
    "degrees": ("degrees", "degree", "deg"),
    "DN": ("DN", "dn", "counts", "count"),
    "1": ("1", "", "dimensionless"),
}

# Labels of the contract's small dimensions; a file may carry them in another order and is then put right.
LABELS: Mapping[str, tuple[str, ...]] = {
    "axis": ("x", "y", "z"),
    "ned": ("north", "east", "down"),
    "thermometer": ("anode", "cathode", "shell"),
}


def open_dataset(path: Path) -> xr.Dataset:
    """Open a NetCDF-4 file or Zarr store; raises InputError where it is absent or unreadable."""
    if not path.exists():
        raise InputError(path, "file", "does not exist", "put it there or correct its name")
    try:
        if path.is_dir():
            return xr.open_zarr(path, chunks=None, decode_times=False, consolidated=False)
        return xr.open_dataset(path, engine="h5netcdf", decode_times=False)
    except (OSError, ValueError, KeyError, RuntimeError, EOFError) as error:
        raise InputError(
            path,
            "file",
            f"is not a readable NetCDF-4 file or Zarr store ({_one_line(error)})",
            "it may be truncated: copy it again",
        ) from error


def take(
    dataset: xr.Dataset,
    path: Path,
    name: str,
    dims: Sequence[str],
    unit: str | None,
    *,
    shape: Sequence[int | None] | None = None,
    finite: bool = True,
) -> NDArray[np.float64]:
    """Variable `name` as float64 in dimension order `dims`, its unit and (unless `finite` is False) its values checked."""
    variable = checked(dataset, path, name, dims, unit, shape=shape)
    try:
        values = np.asarray(variable.values, dtype=np.float64)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            path,
            f"variable '{name}'",
            f"cannot be read ({_one_line(error)})",
            "the file may be truncated or the variable not numeric: write it again",
        ) from error
    if finite and not np.isfinite(values).all():
        bad = np.argwhere(~np.isfinite(values))
        first = ", ".join(f"{d} {i}" for d, i in zip(dims, bad[0], strict=True))
        raise InputError(
            path,
            f"variable '{name}'",
            f"{len(bad)} of {values.size} values are not finite, the first at {first}",
            "remove these records or fill them before processing",
        )
    return values


def checked(
    dataset: xr.Dataset,
    path: Path,
    name: str,
    dims: Sequence[str],
    unit: str | None,
    *,
    shape: Sequence[int | None] | None = None,
) -> xr.DataArray:
    """The variable itself, not yet read, after its dimensions, labels, unit and shape passed."""
    if name not in dataset.variables:
        raise InputError(
            path,
            f"variable '{name}'",
            f"is missing (the file has {', '.join(map(str, dataset.variables)) or 'none'})",
            f"add {name}({', '.join(dims)})" + (f" in {unit}" if unit else ""),
        )
    variable = dataset[name]
    if set(variable.dims) != set(dims):
        raise InputError(
            path,
            f"variable '{name}'",
            f"has dimensions ({', '.join(map(str, variable.dims))})",
            f"it must be {name}({', '.join(dims)})",
        )
    variable = variable.transpose(*dims)
    for dim in dims:
        variable = _in_label_order(variable, path, name, dim)
    if shape is not None:
        for dim, size, wanted in zip(dims, variable.shape, shape, strict=True):
            if wanted is not None and size != wanted:
                raise InputError(
                    path,
                    f"variable '{name}'",
                    f"has {size} along '{dim}' where {wanted} are expected",
                    "write it again with that length or correct instrument.yaml",
                )
    if unit is not None:
        given = variable.attrs.get("units")
        if given is None:
            raise InputError(path, f"variable '{name}'", "has no attribute 'units'", f"set it to '{unit}'")
        if str(given).strip() not in UNIT_SPELLINGS[unit]:
            raise InputError(
                path,
                f"variable '{name}'",
                f"is in '{given}'",
                f"the unit must be '{unit}': convert the values and the attribute",
            )
    return variable


def _in_label_order(variable: xr.DataArray, path: Path, name: str, dim: str) -> xr.DataArray:
    labels = LABELS.get(dim)
    if labels is None or dim not in variable.coords:
        return variable
    found = [str(v) for v in variable.coords[dim].values]
    if found == list(labels):
        return variable
    if sorted(found) != sorted(labels):
        raise InputError(
            path,
            f"variable '{name}'",
            f"has labels {found} along '{dim}'",
            f"they must be {list(labels)}",
        )
    return variable.isel({dim: [found.index(label) for label in labels]})


def take_time(
    dataset: xr.Dataset, path: Path, name: str = "time", dim: str | None = None, *, minimum: int = 2
) -> NDArray[np.float64]:
    """A strictly increasing time axis name(dim or name) [s] of at least `minimum` samples."""
    time = take(dataset, path, name, (dim or name,), "s")
    if time.size < minimum:
        raise InputError(path, f"variable '{name}'", f"has {time.size} samples", f"at least {minimum} are needed")
    step = np.diff(time)
    if (step <= 0).any():
        i = int(np.argmax(step <= 0))
        raise InputError(
            path,
            f"variable '{name}'",
            f"does not increase at sample {i + 1} ({time[i]:.6f} s then {time[i + 1]:.6f} s)",
            "sort the records and drop repeated stamps",
        )
    return time


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write NetCDF-4 without compression or creation times, so that the same data give the same bytes."""
    encoding = {str(n): {"_FillValue": None} for n, v in dataset.variables.items() if v.dtype.kind == "f"}
    dataset.to_netcdf(path, engine="h5netcdf", format="NETCDF4", encoding=encoding)


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:120]}"
