"""Records: thin frozen dataclasses over arrays, SI and radians inside, the file's units only at the door.

Each record reads itself with `from_file` (checked, see `pipeline.datasets`) and, where a stage produces it, writes
itself with `to_dataset`. Shapes: n samples in time, m temperature samples, k thermometers a gyro (3, or 1).
"""

from __future__ import annotations

import csv
import itertools
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pipeline.datasets import checked, open_dataset, take, take_time
from pipeline.errors import InputError
from tsmftis.effects import Effects
from tsmftis.interferometer import Interferometer, response_with_effects

Array = NDArray[np.float64]

DATA_GAP = 2.5  # a step longer than this many usual ones is a gap in inertial data or fixes
LADDER = ("nominal", "phase", "registration", "hybrid", "tracking", "true")  # methods that place a target, least first
MOST_BAD_PIXELS = 0.2  # of a detector
FRAME_DROP = 1.5  # an interval longer than this many usual ones means frames are missing
GNSS_QUALITIES = {1: "fixed", 2: "float", 5: "single"}
COLDEST, HOTTEST = -100.0, 150.0  # degC that a thermometer of an inertial unit can read
THERMAL_TIME_S = 30.0  # over which temperatures are smoothed where nothing else is chosen
COMPENSATED = "thermally_compensated_by"  # attribute of an imu file from which a thermal model has been taken off
FAR_FROM_CHAMBER = 0.5  # standard deviations of a feature


@dataclass(frozen=True)
class Temperatures:
    """Thermometer readings: time (m,) [s], gyro (m, axis, k) and accel (m, axis) [degC].

    k is 3 (anode, cathode, shell) or 1 where the unit has one thermometer for all: then there are no gradients.
    """

    time: Array
    gyro: Array
    accel: Array

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset, path: Path, time_name: str) -> Temperatures | None:
        if not {"temperature_gyro", "temperature_accel", "temperature"} & set(map(str, dataset.variables)):
            return None
        time = take_time(dataset, path, time_name)
        if "temperature" in dataset:
            one = _taken_warm(dataset, path, "temperature", (time_name,), (None,))
            return cls(time, np.repeat(one[:, None, None], 3, axis=1), np.repeat(one[:, None], 3, axis=1))
        gyro = _taken_warm(dataset, path, "temperature_gyro", (time_name, "axis", "thermometer"), (None, 3, 3))
        accel = _taken_warm(dataset, path, "temperature_accel", (time_name, "axis"), (None, 3))
        return cls(time, gyro, accel)

    def uncovered(
        self, time: Array, where: Path | str, smoothing_s: float = THERMAL_TIME_S
    ) -> list[tuple[float, float]]:
        """Stretches (start, stop) [s] of inertial data at times (n,) [s] for which there are no readings.

        Before the first and after the last reading half a time constant of the smoothing is no matter, between two readings
        four are not, nor are the usual intervals of a slow log. InputError, about `where`, where readings and inertial data have
        less than three time constants (of a short flight, half of it) in common.
        """
        start, stop = float(time[0]), float(time[-1])
        first, last = float(self.time[0]), float(self.time[-1])
        common = min(stop, last) - max(start, first)
        if common < min(3.0 * smoothing_s, 0.5 * (stop - start)):
            raise InputError(
                where,
                "variable 'time_temperature'",
                f"spans {first:.1f} to {last:.1f} s and the inertial data {start:.1f} to {stop:.1f} s: "
                f"{max(common, 0.0):.1f} s in common",
                "both must be seconds on the campaign's one clock, and the thermometers be read in flight",
            )
        step = np.diff(self.time)
        usual = DATA_GAP * float(np.median(step))
        gaps = [(start, first)] if first - start > max(0.5 * smoothing_s, usual) else []
        for i in np.flatnonzero(step > max(4.0 * smoothing_s, usual)):
            stretch = max(start, float(self.time[i])), min(stop, float(self.time[i + 1]))
            if stretch[0] < stretch[1]:
                gaps.append(stretch)
        if stop - last > max(0.5 * smoothing_s, usual):
            gaps.append((last, stop))
        return gaps


def _taken_warm(
    dataset: xr.Dataset, path: Path, name: str, dims: tuple[str, ...], shape: tuple[int | None, ...]
) -> Array:
    """Readings [degC] that a thermometer can give."""
    values = take(dataset, path, name, dims, "degC", shape=shape)
    outside = (values < COLDEST) | (values > HOTTEST)
    if outside.any():
        first = int(np.argwhere(outside)[0][0])
        raise InputError(
            path,
            f"variable '{name}'",
            f"is {values[outside][0]:.4g} degC at reading {first}, outside {COLDEST:g} to {HOTTEST:g}",
            "is this kelvin? Convert it; or remove the reading",
        )
    return values


def _inertial(dataset: xr.Dataset, path: Path) -> tuple[Array, Array, Array]:
    time = take_time(dataset, path, minimum=10)
    gyro = take(dataset, path, "gyro", ("time", "axis"), "rad s-1", shape=(None, 3))
    accel = take(dataset, path, "accel", ("time", "axis"), "m s-2", shape=(None, 3))
    norm = float(np.median(np.linalg.norm(accel, axis=1)))
    if not 5.0 < norm < 20.0:
        raise InputError(
            path,
            "variable 'accel'",
            f"has a median magnitude of {norm:.4g} where gravity alone is 9.8 m s-2",
            "the values are not specific force in m s-2: convert them",
        )
    if (fastest := float(np.percentile(np.abs(gyro), 99))) > 20.0:
        raise InputError(
            path,
            "variable 'gyro'",
            f"reaches {fastest:.4g} rad s-1, more than eleven hundred degrees a second",
            "the values are probably in deg s-1: convert them",
        )
    for name, values, limit, unit in (("gyro", gyro, 100.0, "rad s-1"), ("accel", accel, 1000.0, "m s-2")):
        worst = int(np.argmax(np.abs(values).max(axis=1)))
        if (peak := float(np.abs(values[worst]).max())) > limit:
            raise InputError(
                path,
                f"variable '{name}'",
                f"is {peak:.4g} {unit} at record {worst}, beyond {limit:g}",
                "no unit measures that: remove the sample, or correct it",
            )
    return time, gyro, accel


@dataclass(frozen=True)
class Imu:
    """Mean angular rate (n, 3) [rad/s] and specific force (n, 3) [m/s²] over the interval ending at time (n,) [s]."""

    time: Array
    gyro: Array
    accel: Array
    temperatures: Temperatures | None = None
    compensated_by: str | None = None  # the thermal model that has been taken off already, by its file's mark

    @classmethod
    def from_file(cls, path: Path) -> Imu:
        with open_dataset(path) as dataset:
            time_name = "time_temperature" if "time_temperature" in dataset.variables else "time"
            inertial = _inertial(dataset, path)
            mark = str(dataset.attrs.get(COMPENSATED, ""))
            return cls(*inertial, Temperatures.from_dataset(dataset, path, time_name), mark or None)


@dataclass(frozen=True)
class StaticAttitude:
    """Where and how a chamber run stood: latitude, roll, pitch, yaw [rad], height [m]."""

    latitude: float
    height: float
    roll: float
    pitch: float
    yaw: float


@dataclass(frozen=True)
class Chamber:
    """A static run in the climate chamber; `attitude` is None where the file does not tell it."""

    name: str
    time: Array
    gyro: Array
    accel: Array
    temperatures: Temperatures
    attitude: StaticAttitude | None
    temperature_chamber: Array | None

    @classmethod
    def from_file(cls, path: Path, name: str) -> Chamber:
        keys = ("latitude_deg", "height_m", "roll_deg", "pitch_deg", "yaw_deg")
        with open_dataset(path) as dataset:
            time, gyro, accel = _inertial(dataset, path)
            temperatures = Temperatures.from_dataset(dataset, path, "time")
            if temperatures is None:
                raise InputError(
                    path,
                    "temperatures",
                    "are missing",
                    "a chamber run needs temperature_gyro and temperature_accel, or temperature",
                )
            oven = None
            if "temperature_chamber" in dataset:
                oven = take(dataset, path, "temperature_chamber", ("time",), "degC")
            given = [k for k in keys if k in dataset.attrs]
            if given and len(given) < len(keys):
                missing = ", ".join(k for k in keys if k not in given)
                raise InputError(path, "attributes", f"{missing} missing", f"give all of {', '.join(keys)} or none")
            attitude = None
            if given:
                value = {k: _attribute(dataset, path, k) for k in keys}
                attitude = StaticAttitude(
                    np.deg2rad(value["latitude_deg"]),
                    value["height_m"],
                    *(float(np.deg2rad(value[k])) for k in ("roll_deg", "pitch_deg", "yaw_deg")),
                )
        return cls(name, time, gyro, accel, temperatures, attitude, oven)


def _attribute(dataset: xr.Dataset, path: Path, name: str) -> float:
    try:
        value = float(dataset.attrs[name])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InputError(path, f"attribute '{name}'", f"is {dataset.attrs[name]!r}", "give a number")
    return value


@dataclass(frozen=True)
class Gnss:
    """Antenna fixes: time (n,) [s]; latitude, longitude [rad], height [m]; velocity NED (n, 3) or None, with sigmas."""

    time: Array
    latitude: Array
    longitude: Array
    height: Array
    sigma_position: Array
    velocity: Array | None
    sigma_velocity: Array | None
    quality: NDArray[np.int64]

    @classmethod
    def from_file(cls, path: Path) -> Gnss:
        with open_dataset(path) as dataset:
            time = take_time(dataset, path)
            latitude = take(dataset, path, "latitude", ("time",), "degrees_north")
            longitude = take(dataset, path, "longitude", ("time",), "degrees_east")
            _in_range(latitude, -89.9, 89.9, path, "variable 'latitude'", "degrees_north")
            _in_range(longitude, -180.0, 360.0, path, "variable 'longitude'", "degrees_east")
            height = take(dataset, path, "height", ("time",), "m")
            sigma_position = take(dataset, path, "sigma_position", ("time", "ned"), None, shape=(None, 3))
            velocity = sigma_velocity = None
            if "velocity" in dataset:
                velocity = take(dataset, path, "velocity", ("time", "ned"), "m s-1", shape=(None, 3))
                sigma_velocity = take(dataset, path, "sigma_velocity", ("time", "ned"), None, shape=(None, 3))
            for name, sigma, unit in (
                ("sigma_position", sigma_position, "m"),
                ("sigma_velocity", sigma_velocity, "m s-1"),
            ):
                if sigma is not None:
                    if "units" in dataset[name].attrs:
                        checked(dataset, path, name, ("time", "ned"), unit)
                    if (sigma <= 0).any():
                        raise InputError(
                            path,
                            f"variable '{name}'",
                            "has values that are not positive",
                            "give each fix its own standard deviation",
                        )
            quality = take(dataset, path, "quality", ("time",), None).astype(np.int64)
            if unknown := sorted(set(quality.tolist()) - set(GNSS_QUALITIES)):
                raise InputError(path, "variable 'quality'", f"has values {unknown}", "use 1 fixed, 2 float, 5 single")
        return cls(
            time,
            np.deg2rad(latitude),
            np.unwrap(np.deg2rad(longitude)),  # continuous across the date line, so that differences are what they seem
            height,
            sigma_position,
            velocity,
            sigma_velocity,
            quality,
        )

    def to_dataset(self) -> xr.Dataset:
        variables: dict[str, Any] = {
            "latitude": (("time",), np.rad2deg(self.latitude), {"units": "degrees_north"}),
            "longitude": (("time",), np.rad2deg(self.longitude), {"units": "degrees_east"}),
            "height": (("time",), self.height, {"units": "m", "long_name": "height above the WGS-84 ellipsoid"}),
            "sigma_position": (("time", "ned"), self.sigma_position, {"units": "m"}),
            "quality": (
                ("time",),
                self.quality.astype(np.int8),
                {"flag_values": "1 2 5", "flag_meanings": "fixed float single"},
            ),
        }
        if self.velocity is not None and self.sigma_velocity is not None:
            variables["velocity"] = (("time", "ned"), self.velocity, {"units": "m s-1"})
            variables["sigma_velocity"] = (("time", "ned"), self.sigma_velocity, {"units": "m s-1"})
        return xr.Dataset(variables, {"time": (("time",), self.time, {"units": "s"}), "ned": ["north", "east", "down"]})


def _in_range(values: Array, low: float, high: float, where: Path, place: str, unit: str) -> None:
    outside = (values < low) | (values > high)
    if outside.any():
        i = int(np.argmax(outside))
        raise InputError(
            where,
            place,
            f"is {values[i]:g} at record {i}, outside {low:g} to {high:g} {unit}",
            "latitude and longitude may be swapped",
        )


@dataclass(frozen=True)
class Frames:
    """Raw detector frames: counts (frame, row, col) [DN], an array or anything that slices like one; time (frame,) [s]."""

    time: Array
    counts: Any

    @classmethod
    def from_file(cls, path: Path, rows: int, cols: int) -> Frames:
        """Counts stay on disk until they are sliced."""
        dataset = open_dataset(path)
        time = take_time(dataset, path, dim="frame", minimum=4)
        counts = checked(dataset, path, "frames", ("frame", "row", "col"), "DN", shape=(time.size, rows, cols))
        if counts.dtype != np.uint16:
            raise InputError(path, "variable 'frames'", f"is {counts.dtype}", "raw counts must be uint16")
        try:
            counts[-1].load()
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(
                path, "variable 'frames'", "cannot be read to its end", "the file is truncated: copy it again"
            ) from error
        return cls(time, counts.variable)

    def segments(self) -> list[tuple[int, int]]:
        """Runs (first, one past last) without a dropped frame inside; values are not interpolated across a drop."""
        step = np.diff(self.time)
        drops = np.flatnonzero(step > FRAME_DROP * np.median(step)) + 1
        return list(itertools.pairwise([0, *(int(i) for i in drops), self.time.size]))

    @property
    def missing(self) -> int:
        """How many frames were dropped, by the gaps in their times."""
        step = np.diff(self.time)
        usual = float(np.median(step))
        return int(np.round(step[step > FRAME_DROP * usual] / usual - 1.0).sum())

    def blocks(self, size: int) -> list[tuple[int, int]]:
        """Blocks (first, one past last) of at most size + 1 frames that share their end frames, none across a drop."""
        return [
            (first, min(first + size + 1, stop))
            for start, stop in self.segments()
            for first in range(start, max(stop - 1, start + 1), size)
        ]

    def sample(self, count: int) -> NDArray[np.uint16]:
        """About so many frames, evenly spread."""
        return np.asarray(self.counts[:: max(1, self.time.size // count)], dtype=np.uint16)

    def block(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Frames start:stop in memory."""
        return np.ascontiguousarray(np.asarray(self.counts[start:stop]), dtype=np.uint16)


@dataclass(frozen=True)
class Calibration:
    """dark (row, col) [DN], flat (row, col) [1], response (wavenumber) [DN per radiance unit and m-1], wavenumber [m-1].

    Pixels that are not finite in dark or flat, or whose flat is not positive, are bad ones and left out.
    """

    dark: Array
    flat: Array
    wavenumber: Array
    response: Array

    @classmethod
    def from_file(cls, path: Path, rows: int, cols: int) -> Calibration:
        with open_dataset(path) as dataset:
            dark = take(dataset, path, "dark", ("row", "col"), "DN", shape=(rows, cols), finite=False)
            flat = take(dataset, path, "flat", ("row", "col"), "1", shape=(rows, cols), finite=False)
            wavenumber = take(dataset, path, "wavenumber", ("wavenumber",), "m-1")
            response = take(dataset, path, "response", ("wavenumber",), None)
        for name, usable in (("dark", np.isfinite(dark)), ("flat", np.isfinite(flat) & (flat > 0.0))):
            if usable.mean() < 1.0 - MOST_BAD_PIXELS:
                raise InputError(
                    path,
                    f"variable '{name}'",
                    f"is of no use in {int((~usable).sum())} of {usable.size} pixels",
                    "measure it again: that many bad pixels leave no instrument",
                )
        if (np.diff(wavenumber) <= 0).any():
            raise InputError(path, "variable 'wavenumber'", "does not increase", "sort it")
        if (response <= 0).any():
            raise InputError(
                path,
                "variable 'response'",
                "has values that are not positive",
                "cut the table to where the instrument responds",
            )
        return cls(dark, flat, wavenumber, response)

    def without(self, bad: NDArray[np.bool_]) -> Calibration:
        """The calibration with these pixels (row, col) marked as bad, for `detector.correct` to leave out."""
        return replace(self, dark=np.where(bad, np.nan, self.dark))

    def with_effects(self, effects: Effects) -> Calibration:
        """The calibration with the response that a model update makes of it."""
        return replace(self, response=response_with_effects(self.wavenumber, self.response, effects))


@dataclass(frozen=True)
class References:
    """Reference radiances (reference, wavenumber) by name, on wavenumber [m-1]."""

    names: tuple[str, ...]
    wavenumber: Array
    radiance: Array

    @classmethod
    def from_file(cls, path: Path) -> References:
        with open_dataset(path) as dataset:
            wavenumber = take(dataset, path, "wavenumber", ("wavenumber",), "m-1")
            radiance = take(dataset, path, "radiance", ("reference", "wavenumber"), None)
            if "reference" not in dataset.coords:
                raise InputError(path, "coordinate 'reference'", "is missing", "name the spectra: reference(reference)")
            names = tuple(str(v) for v in dataset["reference"].values)
        if repeated := sorted({n for n in names if names.count(n) > 1}):
            raise InputError(
                path, "coordinate 'reference'", f"'{repeated[0]}' occurs twice", "give each spectrum its own name"
            )
        order = np.argsort(wavenumber)
        return cls(names, wavenumber[order], radiance[:, order])


def _read_csv(path: Path, columns: tuple[str, ...], optional_empty: tuple[str, ...] = ()) -> list[dict[str, str]]:
    if not path.is_file():
        raise InputError(path, "file", "does not exist", "put it there or correct the name in campaign.yaml")
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            header = tuple(name.strip() for name in reader.fieldnames or ())
            if not header:
                raise InputError(path, "line 1", "the file is empty", f"its header must be {','.join(columns)}")
            if set(header) != set(columns) or len(header) != len(columns):
                raise InputError(path, "line 1", f"the header is {','.join(header)}", f"it must be {','.join(columns)}")
            reader.fieldnames = list(header)
            rows = []
            for row in reader:
                if None in row or any(v is None for v in row.values()):
                    raise InputError(
                        path,
                        f"line {reader.line_num}",
                        "has not as many fields as the header",
                        f"give {','.join(columns)}",
                    )
                clean = {k: v.strip() for k, v in row.items()}
                for name in columns:
                    if not clean[name] and name not in optional_empty:
                        raise InputError(path, f"line {reader.line_num}, column {name}", "is empty", "fill it in")
                rows.append(clean | {"#": str(reader.line_num)})
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            path, "file", f"is not a CSV text file ({type(error).__name__})", "save it as UTF-8 CSV"
        ) from error
    return rows


def _number(row: dict[str, str], name: str, path: Path, low: float = -np.inf, high: float = np.inf) -> float:
    place = f"line {row['#']}, column {name}"
    try:
        value = float(row[name])
    except ValueError:
        raise InputError(path, place, f"'{row[name]}' is not a number", "correct it") from None
    if not np.isfinite(value):
        raise InputError(path, place, f"is {row[name]}", "give a finite number")
    if not (low <= value <= high):
        raise InputError(
            path, place, f"{value:g} is outside {low:g} to {high:g}", "columns may be swapped: correct the value"
        )
    return value


@dataclass(frozen=True)
class Targets:
    """Surveyed targets: ids, latitude, longitude [rad], height [m], reference name (may be empty), side length [m]."""

    ids: tuple[str, ...]
    latitude: Array
    longitude: Array
    height: Array
    reference: tuple[str, ...]
    size: Array

    @classmethod
    def from_file(cls, path: Path) -> Targets:
        rows = _read_csv(
            path, ("id", "latitude_deg", "longitude_deg", "height_m", "reference", "size_m"), ("reference",)
        )
        if not rows:
            raise InputError(path, "file", "has a header but no target", "list at least one target or name no line")
        ids = tuple(r["id"] for r in rows)
        if repeated := sorted({i for i in ids if ids.count(i) > 1}):
            raise InputError(path, "column id", f"{repeated[0]} occurs twice", "give each target its own id")
        return cls(
            ids,
            np.deg2rad([_number(r, "latitude_deg", path, -90, 90) for r in rows]),
            np.deg2rad([_number(r, "longitude_deg", path, -180, 360) for r in rows]),
            np.array([_number(r, "height_m", path, -1000, 10000) for r in rows]),
            tuple(r["reference"] for r in rows),
            np.array([_number(r, "size_m", path, 0, 1e5) for r in rows]),
        )


@dataclass(frozen=True)
class Gcps:
    """Points picked in single frames: frame index, row, col [px], latitude, longitude [rad], height [m], sigma [px]."""

    frame: NDArray[np.int64]
    row: Array
    col: Array
    latitude: Array
    longitude: Array
    height: Array
    sigma: Array

    @classmethod
    def from_file(cls, path: Path) -> Gcps:
        names = ("frame", "row", "col", "latitude_deg", "longitude_deg", "height_m", "sigma_px")
        rows = _read_csv(path, names)
        limits = {
            "latitude_deg": (-90.0, 90.0),
            "longitude_deg": (-180.0, 360.0),
            "sigma_px": (1e-6, 1e3),
            "frame": (0.0, 1e9),
        }
        for r in rows:
            if not _number(r, "frame", path).is_integer():
                raise InputError(
                    path, f"line {r['#']}, column frame", f"'{r['frame']}' is no whole number", "give the frame's index"
                )
        value = {n: np.array([_number(r, n, path, *limits.get(n, (-np.inf, np.inf))) for r in rows]) for n in names}
        return cls(
            value["frame"].astype(np.int64),
            value["row"],
            value["col"],
            np.deg2rad(value["latitude_deg"]),
            np.deg2rad(value["longitude_deg"]),
            value["height_m"],
            value["sigma_px"],
        )


@dataclass(frozen=True)
class Bench:
    """A laboratory interferogram (scan, sample) [counts] over OPD (sample,) [m], and a reference spectrum if there is one."""

    interferogram: Array
    opd: Array
    wavenumber: Array | None
    reference: Array | None
    apodization: str | None = None
    phase_correction: str | None = None
    zero_filling: int | None = None
    resolution: float | None = None  # m-1
    phase_resolution: float | None = None  # m-1

    ATTRIBUTES: ClassVar[dict[str, str]] = {
        "apodization": "apodization",
        "phase_correction": "phase_correction",
        "zero_filling": "zero_filling",
        "resolution": "resolution_m-1",
        "phase_resolution": "phase_resolution_m-1",
    }

    @classmethod
    def from_file(cls, path: Path) -> Bench:
        with open_dataset(path) as dataset:
            interferogram = take(dataset, path, "interferogram", ("scan", "sample"), "DN")
            opd = take(dataset, path, "opd", ("sample",), "m")
            wavenumber = reference = None
            if "reference" in dataset:
                wavenumber = take(dataset, path, "wavenumber", ("wavenumber",), "m-1")
                reference = take(dataset, path, "reference", ("wavenumber",), None)
            kinds = {
                "apodization": str,
                "phase_correction": str,
                "zero_filling": int,
                "resolution": float,
                "phase_resolution": float,
            }
            given = {}
            for key, kind in kinds.items():
                if cls.ATTRIBUTES[key] in dataset.attrs:
                    raw = dataset.attrs[cls.ATTRIBUTES[key]]
                    try:
                        given[key] = kind(raw)
                    except (TypeError, ValueError):
                        raise InputError(
                            path,
                            f"attribute '{cls.ATTRIBUTES[key]}'",
                            f"'{raw}' is not a {kind.__name__}",
                            "correct it",
                        ) from None
        if (np.diff(opd) <= 0).any():
            raise InputError(path, "variable 'opd'", "does not increase", "sort the samples by optical path difference")
        return cls(interferogram, opd, wavenumber, reference, **given)

    def to_dataset(self) -> xr.Dataset:
        variables = {
            "interferogram": (("scan", "sample"), self.interferogram, {"units": "counts"}),
            "opd": (("sample",), self.opd, {"units": "m"}),
        }
        coords = {}
        if self.wavenumber is not None and self.reference is not None:
            variables["reference"] = (
                ("wavenumber",),
                self.reference,
                {"long_name": "the vendor's spectrum of the same scan"},
            )
            coords["wavenumber"] = (("wavenumber",), self.wavenumber, {"units": "m-1"})
        attrs = {name: getattr(self, key) for key, name in self.ATTRIBUTES.items() if getattr(self, key) is not None}
        return xr.Dataset(variables, coords, attrs)


def _wrapped(longitude: Array) -> Array:
    """Longitudes [degrees] back within ±180°; those that are stay bit for bit."""
    return np.where(np.abs(longitude) > 180.0, (longitude + 180.0) % 360.0 - 180.0, longitude)


@dataclass(frozen=True)
class Trajectory:
    """The POS result at the IMU's origin: latitude, longitude [rad], height [m], velocity NED (n, 3) [m/s], rpy (n, 3) [rad].

    `sigma_attitude` is of roll, pitch, yaw [rad]; `rate` (n, 3) [rad/s] and `specific_force` (n, 3) [m/s²] are the
    compensated inertial data in body axes (they go into the SBET). Sigmas that are not known are NaN.
    """

    time: Array
    latitude: Array
    longitude: Array
    height: Array
    velocity: Array
    rpy: Array
    sigma_position: Array
    sigma_velocity: Array
    sigma_attitude: Array
    rate: Array
    specific_force: Array

    def to_dataset(self) -> xr.Dataset:
        time, ned, axis = ("time",), ("time", "ned"), ("time", "axis")
        deg = np.rad2deg
        return xr.Dataset(
            {
                "latitude": (time, deg(self.latitude), {"units": "degrees_north"}),
                "longitude": (time, _wrapped(deg(self.longitude)), {"units": "degrees_east"}),
                "height": (time, self.height, {"units": "m", "long_name": "height above the WGS-84 ellipsoid"}),
                "velocity": (ned, self.velocity, {"units": "m s-1"}),
                "roll": (time, deg(self.rpy[:, 0]), {"units": "degrees"}),
                "pitch": (time, deg(self.rpy[:, 1]), {"units": "degrees"}),
                "yaw": (time, deg(self.rpy[:, 2]) % 360.0, {"units": "degrees"}),
                "sigma_position": (ned, self.sigma_position, {"units": "m"}),
                "sigma_velocity": (ned, self.sigma_velocity, {"units": "m s-1"}),
                "sigma_attitude": (("time", "rpy"), deg(self.sigma_attitude), {"units": "degrees"}),
                "rate": (axis, self.rate, {"units": "rad s-1", "long_name": "compensated angular rate, body axes"}),
                "specific_force": (
                    axis,
                    self.specific_force,
                    {"units": "m s-2", "long_name": "compensated, body axes"},
                ),
            },
            {
                "time": (time, self.time, {"units": "s", "long_name": "seconds after the campaign's epoch"}),
                "ned": list(("north", "east", "down")),
                "rpy": ["roll", "pitch", "yaw"],
                "axis": ["x", "y", "z"],
            },
        )

    @classmethod
    def from_file(cls, path: Path) -> Trajectory:
        with open_dataset(path) as d:
            angle = {n: np.deg2rad(take(d, path, n, ("time",), "degrees")) for n in ("roll", "pitch", "yaw")}
            return cls(
                take_time(d, path),
                np.deg2rad(take(d, path, "latitude", ("time",), "degrees_north")),
                np.deg2rad(take(d, path, "longitude", ("time",), "degrees_east")),
                take(d, path, "height", ("time",), "m"),
                take(d, path, "velocity", ("time", "ned"), "m s-1"),
                np.stack([angle["roll"], angle["pitch"], (angle["yaw"] + np.pi) % (2 * np.pi) - np.pi], axis=1),
                take(d, path, "sigma_position", ("time", "ned"), "m", finite=False),
                take(d, path, "sigma_velocity", ("time", "ned"), "m s-1", finite=False),
                np.deg2rad(take(d, path, "sigma_attitude", ("time", "rpy"), "degrees", finite=False)),
                take(d, path, "rate", ("time", "axis"), "rad s-1"),
                take(d, path, "specific_force", ("time", "axis"), "m s-2"),
            )

    def between(self, start: float, stop: float) -> Trajectory:
        """The samples with start ≤ time ≤ stop."""
        return self._at(
            slice(int(np.searchsorted(self.time, start)), int(np.searchsorted(self.time, stop, side="right")))
        )

    def thinned(self, interval: float) -> Trajectory:
        """The samples nearest to the first one's time, every `interval` [s] after it, and the last; all if they come slower."""
        if interval <= np.diff(self.time).min(initial=np.inf):
            return self
        wanted = np.arange(self.time[0], self.time[-1] + 1e-9, interval)
        after = np.clip(np.searchsorted(self.time, wanted), 1, self.time.size - 1)
        nearest = after - (wanted - self.time[after - 1] < self.time[after] - wanted)
        return self._at(np.unique(np.append(nearest, self.time.size - 1)))

    def _at(self, index: slice | NDArray[np.int64]) -> Trajectory:
        return Trajectory(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


@dataclass(frozen=True)
class Tracks:
    """Where each point of each target is in each frame: row, col (method, target, point, frame) [px], NaN where unknown.

    A target's points are the 5 × 5 grid that the area score averages, |along|, |across| ≤ size/4; `CENTRE` is the
    surveyed centre. `notes` says of a method what a reader must know (frames it lost, key frames it used).
    """

    methods: tuple[str, ...]
    targets: tuple[str, ...]
    row: Array
    col: Array
    notes: dict[str, str] = field(default_factory=dict)

    GRID = 5
    CENTRE = 12

    def to_dataset(self) -> xr.Dataset:
        every, centre = ("method", "target", "point", "frame"), ("method", "target", "frame")
        pixel = {"units": "1"}
        return xr.Dataset(
            {
                "row": (
                    centre,
                    self.row[:, :, self.CENTRE],
                    pixel | {"long_name": "detector row of the target's centre"},
                ),
                "col": (
                    centre,
                    self.col[:, :, self.CENTRE],
                    pixel | {"long_name": "detector column of the target's centre"},
                ),
                "point_row": (
                    every,
                    self.row,
                    pixel | {"long_name": "detector row of the points that the area averages"},
                ),
                "point_col": (every, self.col, pixel | {"long_name": "detector column of these points"}),
            },
            {"method": list(self.methods), "target": list(self.targets)},
            {f"note_{k}": v for k, v in sorted(self.notes.items())},
        )

    @classmethod
    def from_file(cls, path: Path) -> Tracks:
        every = ("method", "target", "point", "frame")
        with open_dataset(path) as d:
            return cls(
                tuple(map(str, d["method"].values)),
                tuple(map(str, d["target"].values)),
                take(d, path, "point_row", every, "1", finite=False),
                take(d, path, "point_col", every, "1", finite=False),
                {k.removeprefix("note_"): str(v) for k, v in d.attrs.items() if k.startswith("note_")},
            )

    def only(self, method: str) -> Tracks:
        """One method's tracks."""
        i = self.methods.index(method)
        return Tracks((method,), self.targets, self.row[[i]], self.col[[i]])

    def joined(self, other: Tracks) -> Tracks:
        """The methods of both, for the same targets and frames, in the ladder's order."""
        methods = self.methods + other.methods
        order = sorted(range(len(methods)), key=lambda i: LADDER.index(methods[i]))
        row, col = (np.concatenate([getattr(t, n) for t in (self, other)])[order] for n in ("row", "col"))
        return Tracks(tuple(methods[i] for i in order), self.targets, row, col, self.notes | other.notes)


@dataclass(frozen=True)
class Spectra:
    """Spectra as scored: radiance and its sigma (method, target, wavenumber), of the centre and of the area mean.

    `reference` (target, wavenumber) has gone the same way (window, transform); NaN where a target has none.
    `phase`: coefficients of φ(u), u ∈ [−1, 1] over the wavenumbers, lowest first [rad].
    `points` (method, target) counts the points of the area that were seen well enough; a spectrum is NaN where too few.
    """

    methods: tuple[str, ...]
    targets: tuple[str, ...]
    wavenumber: Array
    radiance: Array
    sigma_radiance: Array
    radiance_area: Array
    sigma_radiance_area: Array
    reference: Array
    points: NDArray[np.int64]
    phase: Array
    attributes: dict[str, str | float] = field(default_factory=dict)

    SPECTRA = ("radiance", "sigma_radiance", "radiance_area", "sigma_radiance_area")

    def to_dataset(self) -> xr.Dataset:
        dims = ("method", "target", "wavenumber")
        unit = {"units": "reference radiance unit"}
        return xr.Dataset(
            {
                **{n: (dims, getattr(self, n), unit) for n in self.SPECTRA},
                "reference": (dims[1:], self.reference, unit | {"long_name": "reference at the scored line shape"}),
                "phase": (
                    ("order",),
                    self.phase,
                    {"units": "rad", "long_name": "coefficients of the instrument's phase"},
                ),
                "points": (
                    dims[:2],
                    self.points,
                    {"units": "1", "long_name": "points of the area seen on enough columns"},
                ),
            },
            {
                "method": list(self.methods),
                "target": list(self.targets),
                "wavenumber": (("wavenumber",), self.wavenumber, {"units": "m-1"}),
            },
            dict(self.attributes),
        )

    @classmethod
    def from_file(cls, path: Path) -> Spectra:
        dims = ("method", "target", "wavenumber")
        with open_dataset(path) as d:
            spectra = {n: take(d, path, n, dims, None, finite=False) for n in cls.SPECTRA}
            return cls(
                tuple(map(str, d["method"].values)),
                tuple(map(str, d["target"].values)),
                take(d, path, "wavenumber", ("wavenumber",), "m-1"),
                **spectra,
                reference=take(d, path, "reference", dims[1:], None, finite=False),
                points=take(d, path, "points", dims[:2], "1").astype(np.int64),
                phase=take(d, path, "phase", ("order",), None),
                attributes={str(k): v for k, v in d.attrs.items()},
            )


@dataclass(frozen=True)
class ThermalCorrection:
    """What the thermal model takes off a flight's inertial data, in the IMU's own axes.

    time (m,) [s]; bias of gyro (m, 3) [rad/s] and accel (m, 3) [m/s²] to be subtracted; their predictive sigmas;
    `distance` (m, 6): how far each channel's features lie outside what the chamber taught (0 inside, and where nothing is taken
    off). `uncovered_s` [s]: for how long there were no readings; the bias is held or interpolated there.
    """

    time: Array
    gyro: Array
    accel: Array
    sigma_gyro: Array
    sigma_accel: Array
    distance: Array
    uncovered_s: float = 0.0

    def taken_off(self, imu: Imu) -> Imu:
        """The inertial data less the bias: linear between the correction's times, its ends held."""
        gyro, accel = (
            values - np.stack([np.interp(imu.time, self.time, column) for column in bias.T], axis=1)
            for values, bias in ((imu.gyro, self.gyro), (imu.accel, self.accel))
        )
        return replace(imu, gyro=gyro, accel=accel)

    @property
    def reach(self) -> dict[str, Any]:
        """Channels from which nothing is taken off, how far the rest left what the chamber taught [its standard deviations], and
        for how long there were no readings [s]: plain data for run.json."""
        channels = [f"{sensor} {axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
        values = np.hstack([self.gyro, self.accel])
        return {
            "uncompensated": [n for n, column in zip(channels, values.T, strict=True) if not column.any()],
            "chamber_distance_max": float(self.distance.max()),
            "thermometers_missing_s": self.uncovered_s,
        }

    @property
    def warnings(self) -> list[str]:
        """What of that a reader must not miss."""
        reach, said = self.reach, []
        if reach["uncompensated"]:
            names = ", ".join(reach["uncompensated"])
            said.append(
                f"left uncompensated, for want of a thermometer that moves or of a chamber run that teaches it: {names}"
            )
        if reach["chamber_distance_max"] > FAR_FROM_CHAMBER:
            said.append(
                f"temperatures go up to {reach['chamber_distance_max']:.1f} of their standard deviations beyond what the chamber "
                "runs taught: the thermal correction is extrapolated there, with a wider sigma"
            )
        if self.uncovered_s > 0.0:
            said.append(
                f"the thermometers do not cover {self.uncovered_s:.0f} s of the inertial data: the thermal correction is held "
                "or interpolated there, with the sigma of no correction"
            )
        return said

    def to_dataset(self) -> xr.Dataset:
        dims = ("time", "axis")
        return xr.Dataset(
            {
                "gyro": (
                    dims,
                    self.gyro,
                    {"units": "rad s-1", "long_name": "bias, to be subtracted, in the IMU's axes"},
                ),
                "accel": (
                    dims,
                    self.accel,
                    {"units": "m s-2", "long_name": "bias, to be subtracted, in the IMU's axes"},
                ),
                "sigma_gyro": (dims, self.sigma_gyro, {"units": "rad s-1"}),
                "sigma_accel": (dims, self.sigma_accel, {"units": "m s-2"}),
                "distance": (
                    ("time", "channel"),
                    self.distance,
                    {
                        "units": "1",
                        "long_name": "how far outside the chamber's conditions, in their standard deviations",
                    },
                ),
            },
            {"time": (("time",), self.time, {"units": "s"}), "axis": ["x", "y", "z"]},
            {"uncovered_s": self.uncovered_s},
        )

    @classmethod
    def from_file(cls, path: Path) -> ThermalCorrection:
        dims = ("time", "axis")
        with open_dataset(path) as d:
            return cls(
                take_time(d, path),
                take(d, path, "gyro", dims, "rad s-1"),
                take(d, path, "accel", dims, "m s-2"),
                take(d, path, "sigma_gyro", dims, "rad s-1"),
                take(d, path, "sigma_accel", dims, "m s-2"),
                take(d, path, "distance", ("time", "channel"), "1"),
                float(d.attrs.get("uncovered_s", 0.0)),
            )


@dataclass(frozen=True)
class CameraPoses:
    """The camera at each frame: projection centre (frame, 3) [m] and C_camera→ECEF (frame, 3, 3); NaN outside the trajectory."""

    time: Array
    centre: Array
    dcm: Array

    def to_dataset(self) -> xr.Dataset:
        return xr.Dataset(
            {
                "centre": (("frame", "ecef"), self.centre, {"units": "m"}),
                "dcm": (
                    ("frame", "ecef", "camera"),
                    self.dcm,
                    {"units": "1", "long_name": "camera axes in ECEF, by column"},
                ),
            },
            {"time": (("frame",), self.time, {"units": "s", "long_name": "mid-exposure time, latency taken off"})},
        )

    @classmethod
    def from_file(cls, path: Path) -> CameraPoses:
        with open_dataset(path) as d:
            return cls(
                take(d, path, "time", ("frame",), "s"),
                take(d, path, "centre", ("frame", "ecef"), "m", finite=False),
                take(d, path, "dcm", ("frame", "ecef", "camera"), "1", finite=False),
            )


@dataclass(frozen=True)
class ImageMotion:
    """How the scene moved between pairs of frames, as images alone show it.

    first, second (pair,): frame indices; pair (point,): the pair that a point belongs to; row, col (point,) [px]: where it was in
    the first frame; row_shift, col_shift (point,) [px]: how far it moved to the second; sigma (pair,) [px]: scatter of points
    about the pair's smooth motion. Pixels as measured, distortion and all.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    pair: NDArray[np.int64]
    row: Array
    col: Array
    row_shift: Array
    col_shift: Array
    sigma: Array


@dataclass(frozen=True)
class Products:
    """Spectra under the window, phase correction and spacing that were asked for (target, wavenumber); they are not scored.

    radiance: of the centre; panel: of the best mean over the whole panel, of `panel_points` (target,) points; reference at
    the same line shape; imaginary (target,): mean of (Im/σ)² of the centre's two-sided spectrum, about 1 where all is well;
    contrast (target,): rms difference of the surroundings' interferogram to the panel's over the panel's rms.
    """

    method: str
    targets: tuple[str, ...]
    wavenumber: Array
    radiance: Array
    sigma_radiance: Array
    panel: Array
    sigma_panel: Array
    reference: Array
    panel_points: NDArray[np.int64]
    imaginary: Array
    contrast: Array
    attributes: dict[str, str | float] = field(default_factory=dict)

    def to_dataset(self) -> xr.Dataset:
        dims = ("target", "wavenumber")
        unit = {"units": "reference radiance unit"}
        names = {
            "radiance": "centre point",
            "sigma_radiance": "its standard deviation",
            "panel": "best mean over the whole panel",
            "sigma_panel": "its standard deviation",
            "reference": "reference at the same line shape",
        }
        return xr.Dataset(
            {
                **{n: (dims, getattr(self, n), unit | {"long_name": said}) for n, said in names.items()},
                "panel_points": (dims[:1], self.panel_points, {"units": "1"}),
                "imaginary": (
                    dims[:1],
                    self.imaginary,
                    {"units": "1", "long_name": "mean of (Im/sigma)^2 of the two-sided spectrum"},
                ),
                "contrast": (dims[:1], self.contrast, {"units": "1", "long_name": "of surroundings to panel"}),
            },
            {
                "target": list(self.targets),
                "wavenumber": (("wavenumber",), self.wavenumber, {"units": "m-1"}),
                "wavelength": (("wavenumber",), 1e9 / self.wavenumber, {"units": "nm"}),
            },
            {"method": self.method} | self.attributes,
        )


@dataclass(frozen=True)
class Interferograms:
    """Interferograms along the tracks, (method, target, point, col) each.

    value [DN after dark and flat]; gain: var(sample)/var(pixel); row: mean detector row of the sample [px]; crossings: how
    often the point crossed the column (0: interpolated from its neighbours).
    """

    methods: tuple[str, ...]
    targets: tuple[str, ...]
    value: Array
    gain: Array
    row: Array
    crossings: Array

    @property
    def seen(self) -> Array:
        """Fraction of the columns that each point crossed (method, target, point)."""
        return (self.crossings > 0).mean(axis=-1)

    def opd(self, interferometer: Interferometer) -> Array:
        """OPD [m] of each sample: (col,) where rows do not matter, else (method, target, point, col)."""
        columns = np.arange(self.value.shape[-1])
        if interferometer.fringe_tilt == 0.0:
            return interferometer.opd((interferometer.rows - 1) / 2, columns)
        return interferometer.opd(self.row, columns)

    def to_dataset(self) -> xr.Dataset:
        dims = ("method", "target", "point", "col")
        return xr.Dataset(
            {
                "value": (dims, self.value, {"units": "DN", "long_name": "after dark and flat"}),
                "gain": (dims, self.gain, {"units": "1", "long_name": "variance of a sample over that of a pixel"}),
                "row": (dims, self.row, {"units": "1", "long_name": "mean detector row of the sample"}),
                "crossings": (dims, self.crossings, {"units": "1"}),
            },
            {"method": list(self.methods), "target": list(self.targets)},
        )

    @classmethod
    def from_file(cls, path: Path) -> Interferograms:
        dims = ("method", "target", "point", "col")
        with open_dataset(path) as d:
            return cls(
                tuple(map(str, d["method"].values)),
                tuple(map(str, d["target"].values)),
                take(d, path, "value", dims, "DN", finite=False),
                *(take(d, path, n, dims, "1", finite=False) for n in ("gain", "row", "crossings")),
            )
