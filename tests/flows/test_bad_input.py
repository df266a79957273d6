"""A user's mistake ends in one line that names the file, the place and the mend; exit code 2; nothing is written."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
import yaml

Spoil = Callable[[Path], Any]


# --- ways to spoil a campaign -----------------------------------------------------------------------------------------


def keys(*path: Any, to: Any = None, file: str = "campaign.yaml", drop: bool = False) -> Spoil:
    """Set (or drop) the YAML key at `path`."""

    def spoil(root: Path) -> None:
        content = yaml.safe_load((root / file).read_text())
        part = content
        for step in path[:-1]:
            part = part[step]
        if drop:
            del part[path[-1]]
        else:
            part[path[-1]] = to
        (root / file).write_text(yaml.safe_dump(content, sort_keys=False))

    return spoil


def instrument(*path: Any, to: Any = None, drop: bool = False) -> Spoil:
    return keys(*path, to=to, file="instrument.yaml", drop=drop)


def netcdf(file: str, change: Callable[[xr.Dataset], Any]) -> Spoil:
    """Load, change (in place or by returning another) and write a NetCDF file again."""

    def spoil(root: Path) -> None:
        dataset = xr.load_dataset(root / file, engine="h5netcdf", decode_times=False)
        changed = change(dataset)
        (root / file).unlink()
        (dataset if changed is None else changed).to_netcdf(root / file, engine="h5netcdf")

    return spoil


def unit(file: str, variable: str, to: str) -> Spoil:
    return netcdf(file, lambda d: d[variable].attrs.update(units=to))


def scaled(file: str, variable: str, factor: float, offset: float = 0.0) -> Spoil:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        new = dataset[variable] * factor + offset
        return dataset.assign({variable: new.assign_attrs(dataset[variable].attrs)})

    return netcdf(file, change)


def value(file: str, variable: str, index: Any, to: float) -> Spoil:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        values = dataset[variable].values.copy()
        values[index] = to
        return dataset.assign({variable: (dataset[variable].dims, values, dataset[variable].attrs)})

    return netcdf(file, change)


def truncated(file: str, share: float = 0.5) -> Spoil:
    def spoil(root: Path) -> None:
        content = (root / file).read_bytes()
        (root / file).write_bytes(content[: int(share * len(content))])

    return spoil


def content(file: str, text: str | bytes) -> Spoil:
    return lambda root: (root / file).write_bytes(text.encode() if isinstance(text, str) else text)


def csv_column(file: str, *fields: tuple[int, str], line: int = 1) -> Spoil:
    """Replace fields of one data line of a CSV by (column, text)."""

    def spoil(root: Path) -> None:
        lines = (root / file).read_text().splitlines()
        parts = lines[line].split(",")
        for column, text in fields:
            parts[column] = text
        lines[line] = ",".join(parts)
        (root / file).write_text("\n".join(lines) + "\n")

    return spoil


def swapped_positions(root: Path) -> None:
    lines = (root / TARGETS).read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    (root / TARGETS).write_text("\n".join([lines[0], *(",".join([r[0], r[2], r[1], *r[3:]]) for r in rows)]) + "\n")


def linked_outside(root: Path) -> None:
    (root / IMU).rename(root.parent / "imu.nc")
    (root / IMU).symlink_to(root.parent / "imu.nc")


def dem_without_crs(root: Path) -> None:
    with rasterio.open(root / "dem.tif") as source:
        heights, profile = source.read(), source.profile | {"crs": None}
    (root / "dem.tif").unlink()
    with rasterio.open(root / "dem.tif", "w", **profile) as target:
        target.write(heights)


def dem_with_hole(root: Path) -> None:
    with rasterio.open(root / "dem.tif", "r+") as dem:
        heights = dem.read(1)
        heights[3, 4] = np.nan
        dem.write(heights, 1)


def both(*spoils: Spoil) -> Spoil:
    return lambda root: [spoil(root) for spoil in spoils]


IMU, GNSS, FRAMES, TARGETS, GCPS = "F1/imu.nc", "F1/gnss.nc", "F1/L01.nc", "F1/L01_targets.csv", "F1/L01_gcps.csv"
TRAIN, CALIBRATION, REFERENCES = "chamber/train.nc", "calibration.nc", "references.nc"
FLIGHT, LINE = ("flights", 0), ("flights", 0, "lines", 0)

# name: (what is spoiled, what the message must name: file, place, and a word of the problem or the mend)
CAMPAIGNS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    # campaign.yaml
    "no campaign.yaml": (lambda r: (r / "campaign.yaml").unlink(), ("campaign.yaml", "does not exist")),
    "campaign.yaml is not YAML": (content("campaign.yaml", "a: [1\nb: }"), ("campaign.yaml", "line 2", "YAML")),
    "campaign.yaml is binary": (content("campaign.yaml", b"\xff\xfe\x00\x80"), ("campaign.yaml", "YAML")),
    "campaign.yaml is empty": (content("campaign.yaml", ""), ("campaign.yaml", "holds no keys")),
    "campaign.yaml is a list": (content("campaign.yaml", "- a\n- b\n"), ("campaign.yaml", "holds no keys")),
    "unknown key": (keys("colour", to="red"), ("campaign.yaml", "'colour'", "not known")),
    "unknown key in a line": (keys(*LINE, "frame", to="x"), ("campaign.yaml", "flights.0.lines.0.frame", "not known")),
    "missing key": (keys("time", drop=True), ("campaign.yaml", "'time'", "missing")),
    "missing key of a line": (keys(*LINE, "targets", drop=True), ("campaign.yaml", "lines.0.targets", "missing")),
    "wrong format": (keys("format", to="tsmftis-campaign/2"), ("campaign.yaml", "'format'", "tsmftis-campaign/1")),
    "wrong time scale": (keys("time", "scale", to="UTC"), ("campaign.yaml", "time.scale", "GPS")),
    "epoch that is no time": (keys("time", "epoch", to="yesterday"), ("campaign.yaml", "time.epoch")),
    "flights is a text": (keys("flights", to="F1"), ("campaign.yaml", "flights")),
    "no lines without calibration": (keys("calibration", drop=True), ("campaign.yaml", "calibration", "missing")),
    "two lines of one id": (keys("flights", 0, "lines", 1, "id", to="L01"), ("campaign.yaml", "'L01' occurs twice")),
    "id with a slash": (keys(*LINE, "id", to="../L01"), ("campaign.yaml", "lines.0.id")),
    "id with a newline": (keys(*LINE, "id", to="L01\n"), ("campaign.yaml", "lines.0.id")),
    "id that is a folder's parent": (keys(*FLIGHT, "id", to=".."), ("campaign.yaml", "flights[].id")),
    "id that is an output": (keys(*LINE, "id", to="trajectory.nc"), ("campaign.yaml", "lines[].id")),
    "path with ..": (
        keys(*FLIGHT, "imu", to="../campaign/F1/../../imu.nc"),
        ("campaign.yaml", "flights[F1].imu", "leaves"),
    ),
    "absolute path": (keys(*FLIGHT, "imu", to="/etc/hostname"), ("campaign.yaml", "flights[F1].imu", "leaves")),
    "link out of the folder": (linked_outside, ("campaign.yaml", "flights[F1].imu", "leaves")),
    "empty path": (keys("instrument", to=""), ("campaign.yaml", "'instrument'")),
    "path with a null byte": (keys("dem", to="dem\0.tif"), ("campaign.yaml", "'dem'")),
    "path that is the folder": (keys("instrument", to="."), ("campaign.yaml", "'instrument'")),
    "missing imu": (lambda r: (r / IMU).unlink(), ("campaign.yaml", "flights[F1].imu", "imu.nc", "does not exist")),
    "missing frames": (lambda r: (r / FRAMES).unlink(), ("campaign.yaml", "lines[L01].frames", "does not exist")),
    "missing chamber run": (lambda r: (r / TRAIN).unlink(), ("campaign.yaml", "thermal.train", "does not exist")),
    "missing dem": (lambda r: (r / "dem.tif").unlink(), ("campaign.yaml", "'dem'", "does not exist")),
    "initial outside the flight": (
        keys(*FLIGHT, "initial", "time_s", to=1e6),
        ("campaign.yaml", "initial", "outside"),
    ),
    "initial without a sigma": (
        keys(*FLIGHT, "initial", "sigma_yaw_deg", drop=True),
        ("campaign.yaml", "initial.sigma_yaw_deg", "missing"),
    ),
    "initial with a text": (
        keys(*FLIGHT, "initial", "roll_deg", to="north"),
        ("campaign.yaml", "initial.roll_deg", "number"),
    ),
    # instrument.yaml
    "no instrument.yaml": (lambda r: (r / "instrument.yaml").unlink(), ("instrument.yaml", "does not exist")),
    "instrument.yaml is not YAML": (content("instrument.yaml", "imu: [1\n"), ("instrument.yaml", "YAML")),
    "instrument.yaml is empty": (content("instrument.yaml", ""), ("instrument.yaml", "holds no keys")),
    "unknown key of the camera": (instrument("camera", "focal", to=1.0), ("instrument.yaml", "camera.focal")),
    "missing key of the camera": (
        instrument("camera", "rows", drop=True),
        ("instrument.yaml", "camera.rows", "missing"),
    ),
    "no camera": (instrument("camera", drop=True), ("instrument.yaml", "'camera'", "missing")),
    "no mounting": (instrument("mounting", drop=True), ("instrument.yaml", "'mounting'", "missing")),
    "no boresight": (instrument("mounting", "boresight_deg", drop=True), ("instrument.yaml", "boresight_deg")),
    "boresight without yaw": (
        instrument("mounting", "boresight_deg", "yaw", drop=True),
        ("instrument.yaml", "boresight_deg.yaw", "missing"),
    ),
    "lever arm of two numbers": (
        instrument("mounting", "imu_to_antenna_m", to=[0.1, 0.2]),
        ("instrument.yaml", "imu_to_antenna_m"),
    ),
    "negative focal length": (instrument("camera", "focal_length_m", to=-0.07), ("instrument.yaml", "focal_length_m")),
    "focal length in mm": (instrument("camera", "focal_length_m", to=70.0), ("instrument.yaml", "focal_length_m")),
    "rate that is nan": (instrument("imu", "rate_hz", to=float("nan")), ("instrument.yaml", "imu.rate_hz")),
    "range upside down": (
        instrument("interferometer", "wavelength_range_nm", to=[900.0, 450.0]),
        ("instrument.yaml", "wavelength_range_nm"),
    ),
    "range in micrometres": (
        instrument("interferometer", "wavelength_range_nm", to=[0.45, 0.9]),
        ("instrument.yaml", "interferometer"),
    ),
    "zpd outside the detector": (instrument("interferometer", "zpd_col", to=200.0), ("instrument.yaml", "zpd_col")),
    "opd step in nm": (instrument("interferometer", "opd_step_m", to=205.0), ("instrument.yaml", "opd_step_m")),
    "detector of another size": (instrument("camera", "rows", to=40), ("calibration.nc", "'dark'", "40", "48")),
    # imu
    "imu is a text file": (content(IMU, "time,gyro\n1,2\n"), ("imu.nc", "NetCDF")),
    "imu is empty": (content(IMU, ""), ("imu.nc", "NetCDF")),
    "imu truncated": (truncated(IMU), ("imu.nc", "truncated")),
    "imu truncated by a little": (truncated(IMU, 0.99), ("imu.nc", "truncated")),
    "imu without gyro": (netcdf(IMU, lambda d: d.drop_vars("gyro")), ("imu.nc", "'gyro'", "missing")),
    "imu without time": (netcdf(IMU, lambda d: d.drop_vars("time")), ("imu.nc", "'time'", "missing")),
    "imu of two axes": (netcdf(IMU, lambda d: d.isel(axis=[0, 1])), ("imu.nc", "'gyro'", "axis")),
    "imu with another dimension": (netcdf(IMU, lambda d: d.rename(axis="xyz")), ("imu.nc", "'gyro'", "axis")),
    "imu with unknown labels": (
        netcdf(IMU, lambda d: d.assign_coords(axis=["a", "b", "c"])),
        ("imu.nc", "axis", "'x', 'y', 'z'"),
    ),
    "gyro's unit attribute": (unit(IMU, "gyro", "deg s-1"), ("imu.nc", "'gyro'", "deg s-1", "rad s-1")),
    "accel's unit attribute": (unit(IMU, "accel", "g"), ("imu.nc", "'accel'", "m s-2")),
    "gyro without unit": (netcdf(IMU, lambda d: d.gyro.attrs.clear()), ("imu.nc", "'gyro'", "units")),
    "time in ms": (unit(IMU, "time", "ms"), ("imu.nc", "'time'", "ms")),
    "gyro in deg/s": (scaled(IMU, "gyro", 180 / np.pi), ("imu.nc", "'gyro'", "deg")),
    "accel in g": (scaled(IMU, "accel", 1 / 9.80665), ("imu.nc", "'accel'", "m s-2")),
    "time in milliseconds under the unit s": (scaled(IMU, "time", 1000.0), ("imu.nc", "'time'")),
    "x and z swapped": (
        netcdf(IMU, lambda d: d.isel(axis=[2, 1, 0]).assign_coords(axis=d.axis)),
        ("imu.nc", "'accel'", "body x", "swapped"),
    ),
    "z upside down": (scaled(IMU, "accel", -1.0), ("imu.nc", "'accel'", "signs")),
    "nan in gyro": (value(IMU, "gyro", (5, 1), np.nan), ("imu.nc", "'gyro'", "time 5, axis 1")),
    "inf in accel": (value(IMU, "accel", (7, 2), np.inf), ("imu.nc", "'accel'", "time 7, axis 2")),
    "nan in temperature": (value(IMU, "temperature_gyro", (1, 0, 0), np.nan), ("imu.nc", "'temperature_gyro'")),
    "nan in time": (value(IMU, "time", 3, np.nan), ("imu.nc", "'time'")),
    "time runs back": (value(IMU, "time", 9, 0.0), ("imu.nc", "'time'", "sample 9")),
    "time repeats": (
        netcdf(IMU, lambda d: d.isel(time=np.r_[0:10, 9 : d.time.size])),
        ("imu.nc", "'time'", "sample 10"),
    ),
    "one imu sample": (netcdf(IMU, lambda d: d.isel(time=[0])), ("imu.nc", "'time'", "at least")),
    "no temperature sample": (netcdf(IMU, lambda d: d.isel(time_temperature=[])), ("imu.nc", "time_temperature")),
    # gnss
    "gnss truncated": (truncated(GNSS), ("gnss.nc", "truncated")),
    "gnss on another clock": (scaled(GNSS, "time", 1.0, 1e6), ("'time'", "fixes overlap", "clock")),
    "latitude in rad": (unit(GNSS, "latitude", "rad"), ("gnss.nc", "'latitude'", "degrees_north")),
    "latitude and longitude swapped": (
        netcdf(
            GNSS,
            lambda d: d.assign(
                latitude=("time", d.longitude.values, d.latitude.attrs),
                longitude=("time", d.latitude.values, d.longitude.attrs),
            ),
        ),
        ("gnss.nc", "'latitude'", "swapped"),
    ),
    "nan in height": (value(GNSS, "height", 3, np.nan), ("gnss.nc", "'height'", "time 3")),
    "sigma of zero": (value(GNSS, "sigma_position", (0, 0), 0.0), ("gnss.nc", "'sigma_position'", "positive")),
    "sigma with a wrong unit": (unit(GNSS, "sigma_position", "cm"), ("gnss.nc", "'sigma_position'", "cm")),
    "unknown quality": (value(GNSS, "quality", 0, 9), ("gnss.nc", "'quality'", "9")),
    "velocity without sigma": (
        netcdf(GNSS, lambda d: d.drop_vars("sigma_velocity")),
        ("gnss.nc", "'sigma_velocity'", "missing"),
    ),
    # frames
    "frames truncated": (truncated(FRAMES), ("L01.nc", "truncated")),
    "frames truncated by a little": (truncated(FRAMES, 0.999), ("L01.nc", "truncated")),
    "frames on another clock": (scaled(FRAMES, "time", 1.0, 5e5), ("L01.nc", "'time'", "overlap")),
    "frames as float": (
        netcdf(FRAMES, lambda d: d.assign(frames=d.frames.astype("f4").assign_attrs(d.frames.attrs))),
        ("L01.nc", "'frames'", "uint16"),
    ),
    "frames with a wrong unit": (unit(FRAMES, "frames", "V"), ("L01.nc", "'frames'", "DN")),
    "frames turned": (
        netcdf(FRAMES, lambda d: d.rename(row="col", col="row")),
        ("L01.nc", "'frames'", "row", "48"),
    ),
    "one frame": (netcdf(FRAMES, lambda d: d.isel(frame=[0])), ("L01.nc", "'time'", "at least")),
    "no frame": (netcdf(FRAMES, lambda d: d.isel(frame=[])), ("L01.nc", "'time'")),
    # calibration, references
    "calibration truncated": (truncated(CALIBRATION), ("calibration.nc", "truncated")),
    "flat of another size": (netcdf(CALIBRATION, lambda d: d.isel(row=slice(0, 40))), ("calibration.nc", "'dark'")),
    "dead flat": (value(CALIBRATION, "flat", np.s_[:20], 0.0), ("calibration.nc", "'flat'", "pixels")),
    "nan in dark": (value(CALIBRATION, "dark", np.s_[:20], np.nan), ("calibration.nc", "'dark'", "pixels")),
    "response of zero": (value(CALIBRATION, "response", 0, 0.0), ("calibration.nc", "'response'")),
    "response does not cover the range": (
        netcdf(CALIBRATION, lambda d: d.sel(wavenumber=slice(1.3e6, None))),
        ("calibration.nc", "'response'", "range"),
    ),
    "response over wavelength": (unit(CALIBRATION, "wavenumber", "nm"), ("calibration.nc", "'wavenumber'", "m-1")),
    "response in cm-1": (unit(CALIBRATION, "wavenumber", "cm-1"), ("calibration.nc", "'wavenumber'", "m-1")),
    "references truncated": (truncated(REFERENCES), ("references.nc", "truncated")),
    "references without names": (
        netcdf(REFERENCES, lambda d: d.drop_vars("reference")),
        ("references.nc: ", "'reference'"),
    ),
    "references of one name twice": (
        netcdf(REFERENCES, lambda d: d.isel(reference=[0, 0, *range(1, d.reference.size)])),
        ("references.nc", "reference"),
    ),
    "references that do not cover the range": (
        netcdf(REFERENCES, lambda d: d.sel(wavenumber=slice(1.5e6, None))),
        ("references.nc", "range"),
    ),
    "nan in a reference": (value(REFERENCES, "radiance", (0, 3), np.nan), ("references.nc", "'radiance'")),
    # chamber
    "chamber truncated": (truncated(TRAIN), ("train.nc", "truncated")),
    "chamber without temperatures": (
        netcdf(TRAIN, lambda d: d.drop_vars(["temperature_gyro", "temperature_accel"])),
        ("train.nc", "temperature"),
    ),
    "chamber in kelvin": (unit(TRAIN, "temperature_gyro", "K"), ("train.nc", "'temperature_gyro'", "degC")),
    "chamber in kelvin that says degC": (
        scaled(TRAIN, "temperature_accel", 1.0, 273.15),
        ("train.nc", "'temperature_accel'", "kelvin"),
    ),
    "flight in kelvin that says degC": (
        scaled(IMU, "temperature_gyro", 1.0, 273.15),
        ("imu.nc", "'temperature_gyro'", "kelvin"),
    ),
    "thermometers on another clock": (
        scaled(IMU, "time_temperature", 1.0, 1e6),
        ("imu.nc", "'time_temperature'", "in common", "clock"),
    ),
    "thermometers for an eighth of the flight": (
        netcdf(IMU, lambda d: d.isel(time_temperature=slice(0, d.time_temperature.size // 8))),
        ("imu.nc", "'time_temperature'", "in common"),
    ),
    "chamber with a wild last stamp": (value(TRAIN, "time", -1, 1e13), ("train.nc", "times", "stamp")),
    "chamber with half an attitude": (
        netcdf(TRAIN, lambda d: d.attrs.__delitem__("yaw_deg")),
        ("train.nc", "yaw_deg", "missing"),
    ),
    "chamber with a text as attitude": (
        netcdf(TRAIN, lambda d: d.attrs.update(yaw_deg="north")),
        ("train.nc", "yaw_deg"),
    ),
    "chamber of ten samples": (netcdf(TRAIN, lambda d: d.isel(time=slice(0, 12))), ("train.nc",)),
    "chamber of another temperature shape": (
        netcdf(TRAIN, lambda d: d.isel(thermometer=[0])),
        ("train.nc", "'temperature_gyro'", "thermometer"),
    ),
    # targets, gcps
    "targets empty": (content(TARGETS, ""), ("L01_targets.csv", "line 1", "empty")),
    "targets with a header only": (
        content(TARGETS, "id,latitude_deg,longitude_deg,height_m,reference,size_m\n"),
        ("L01_targets.csv", "no target"),
    ),
    "targets with another header": (content(TARGETS, "name,lat,lon\na,1,2\n"), ("L01_targets.csv", "line 1", "header")),
    "targets are binary": (content(TARGETS, b"\x00\xff\xfe\x80"), ("L01_targets.csv", "CSV")),
    "targets with a text in a number": (
        csv_column(TARGETS, (3, "high")),
        ("L01_targets.csv", "line 2", "height_m", "'high'"),
    ),
    "targets with an empty number": (csv_column(TARGETS, (3, "")), ("L01_targets.csv", "line 2", "height_m")),
    "targets with nan": (csv_column(TARGETS, (3, "nan")), ("L01_targets.csv", "line 2", "height_m", "nan")),
    "targets with a decimal comma": (csv_column(TARGETS, (3, "60,5")), ("L01_targets.csv", "line 2")),
    "targets of one id": (csv_column(TARGETS, (0, "L01-2")), ("L01_targets.csv", "L01-2 occurs twice")),
    "targets with swapped columns": (swapped_positions, ("L01_targets.csv", "latitude_deg", "swapped")),
    "target far away": (csv_column(TARGETS, (1, "-37.0")), ("L01_targets.csv", "L01-1", "km")),
    "unknown reference": (csv_column(TARGETS, (4, "cheese")), ("L01_targets.csv", "L01-1", "'cheese'", "use one of")),
    "negative size": (csv_column(TARGETS, (5, "-6")), ("L01_targets.csv", "line 2", "size_m")),
    "gcps empty": (content(GCPS, ""), ("L01_gcps.csv", "line 1", "empty")),
    "gcp in a frame that is not there": (csv_column(GCPS, (0, "5000")), ("L01_gcps.csv", "frame")),
    "gcp in half a frame": (csv_column(GCPS, (0, "10.5")), ("L01_gcps.csv", "line 2", "frame")),
    "gcp with a text": (csv_column(GCPS, (1, "left")), ("L01_gcps.csv", "line 2", "row", "'left'")),
    "gcp beside the image": (csv_column(GCPS, (2, "500.3")), ("L01_gcps.csv", "point 1, column col", "48 × 64")),
    # dem
    "dem is a text file": (content("dem.tif", "60 61 62\n"), ("dem.tif", "raster")),
    "dem truncated": (truncated("dem.tif"), ("dem.tif", "raster")),
    "dem without CRS": (dem_without_crs, ("dem.tif", "CRS")),
    "dem with a hole": (dem_with_hole, ("dem.tif", "band 1", "cells")),
}


def assert_one_line(err: str, *parts: str) -> None:
    assert "Traceback" not in err
    assert re.fullmatch(r"tsmftis: [^\n]+\n", err), err
    for part in parts:
        assert part in err, f"{part!r} is not named in: {err}"
    # place, problem and mend follow the file
    assert re.search(r": .+: .+; .+", err), err


def assert_nothing_in(folder: Path) -> None:
    assert not folder.exists() or not any(folder.iterdir()), list(folder.rglob("*"))


@pytest.mark.parametrize(("spoil", "parts"), CAMPAIGNS.values(), ids=CAMPAIGNS)
def test_a_spoiled_campaign_ends_in_one_line(
    spoil: Spoil, parts: tuple[str, ...], copied: Path, tmp_path: Path, tsmftis: Any
) -> None:
    spoil(copied)
    answer = tsmftis("run", copied, "--out", tmp_path / "out", "--only", "thermal")
    print(answer.err)
    assert answer.code == 2
    assert_one_line(answer.err, *parts)
    assert_nothing_in(tmp_path / "out")


# --- options ----------------------------------------------------------------------------------------------------------

OPTIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "unknown stage after --from": (("--from", "magic"), ("--from", "'magic'", "navigation")),
    "unknown stage after --only": (("--only", "magic"), ("--only", "'magic'", "navigation")),
    "--from with --only": (("--from", "thermal", "--only", "thermal"), ("--from", "--only")),
    "unknown line": (("--line", "L09"), ("--line", "'L09'", "L01")),
    "setting without value": (("--set", "navigation.epoch_s"), ("--set", "navigation.epoch_s", "key=value")),
    "setting without stage": (("--set", "epoch_s=1"), ("--set", "epoch_s=1", "key=value")),
    "unknown setting": (("--set", "navigation.colour=1"), ("--set", "navigation.colour", "not known")),
    "unknown stage of a setting": (("--set", "magic.x=1"), ("--set", "magic", "not known")),
    "text for a number": (("--set", "navigation.epoch_s=fast"), ("--set", "navigation.epoch_s", "number")),
    "negative epoch": (("--set", "navigation.epoch_s=-1"), ("--set", "navigation.epoch_s")),
    "nan": (("--set", "navigation.epoch_s=.nan"), ("--set", "navigation.epoch_s")),
    "value that is no YAML": (("--set", "navigation.epoch_s=[1"), ("--set", "navigation.epoch_s", "YAML")),
    "no settings file": (("--settings", "nowhere.yaml"), ("nowhere.yaml", "does not exist")),
}


@pytest.mark.parametrize(("options", "parts"), OPTIONS.values(), ids=OPTIONS)
def test_a_wrong_option_ends_in_one_line(
    options: tuple[str, ...], parts: tuple[str, ...], demo: Path, tmp_path: Path, tsmftis: Any
) -> None:
    answer = tsmftis("run", demo, "--out", tmp_path / "out", *options)
    print(answer.err)
    assert answer.code == 2
    assert_one_line(answer.err, *parts)
    assert_nothing_in(tmp_path / "out")


SETTINGS_FILES: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "not YAML": (b"navigation: [1\n", ("settings.yaml", "YAML")),
    "binary": (b"\xff\xfe\x80", ("settings.yaml", "YAML")),
    "a list": (b"- navigation\n", ("settings.yaml", "holds no keys")),
    "unknown key": (b"navigation: {colour: 1}\n", ("settings.yaml", "navigation.colour", "not known")),
    "a number for a stage": (b"navigation: 3\n", ("settings.yaml", "navigation")),
    "a key twice": (
        b"navigation: {passes: 2}\nnavigation: {passes: 3}\n",
        ("settings.yaml", "line 2", "'navigation'", "twice"),
    ),
}


@pytest.mark.parametrize(("text", "parts"), SETTINGS_FILES.values(), ids=SETTINGS_FILES)
def test_a_wrong_settings_file_ends_in_one_line(
    text: bytes, parts: tuple[str, ...], demo: Path, tmp_path: Path, tsmftis: Any
) -> None:
    file = tmp_path / "settings.yaml"
    file.write_bytes(text)
    answer = tsmftis("run", demo, "--out", tmp_path / "out", "--settings", file)
    assert answer.code == 2
    assert_one_line(answer.err, *parts)
    assert_nothing_in(tmp_path / "out")


def test_only_needs_the_results_before_it(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    answer = tsmftis("run", demo, "--out", tmp_path / "out", "--only", "mapping")
    print(answer.err)
    assert answer.code == 2
    assert_one_line(answer.err, "thermal", "--from thermal")
    assert_nothing_in(tmp_path / "out")


# --- places -----------------------------------------------------------------------------------------------------------


def test_a_campaign_that_does_not_exist(tmp_path: Path, tsmftis: Any) -> None:
    answer = tsmftis("run", tmp_path / "nowhere", "--out", tmp_path / "out")
    assert answer.code == 2
    assert_one_line(answer.err, "nowhere", "campaign.yaml")
    assert not (tmp_path / "out").exists()


def test_a_campaign_that_is_a_file(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    answer = tsmftis("run", copied / "campaign.yaml", "--out", tmp_path / "out")
    assert answer.code == 2
    assert_one_line(answer.err, "campaign.yaml", "folder")


def test_out_that_is_a_file(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    (tmp_path / "out").write_text("mine")
    answer = tsmftis("run", demo, "--out", tmp_path / "out")
    assert answer.code == 2
    assert_one_line(answer.err, "--out", "is a file")
    assert (tmp_path / "out").read_text() == "mine"


def test_out_below_a_file(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    (tmp_path / "file").write_text("mine")
    answer = tsmftis("run", demo, "--out", tmp_path / "file" / "out")
    assert answer.code == 2
    assert_one_line(answer.err, "--out")


@pytest.mark.parametrize("out", [".", "..", "out", "F1"])
def test_out_that_would_touch_the_campaign(out: str, copied: Path, tsmftis: Any) -> None:
    before = sorted(copied.rglob("*"))
    answer = tsmftis("run", copied, "--out", copied / out)
    assert answer.code == 2
    assert_one_line(answer.err, "--out", "campaign")
    assert sorted(copied.rglob("*")) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_out_that_cannot_be_written(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    answer = tsmftis("run", demo, "--out", tmp_path / "closed" / "out")
    assert answer.code == 2
    assert_one_line(answer.err, "--out")


# --- other commands ---------------------------------------------------------------------------------------------------


def test_inspect_lists_every_problem_and_the_rest_of_the_table(copied: Path, tsmftis: Any) -> None:
    unit(IMU, "gyro", "deg s-1")(copied)
    truncated(FRAMES)(copied)
    content(TARGETS, "")(copied)
    answer = tsmftis("inspect", copied)
    problems = [line for line in answer.out.splitlines() if line.startswith("problem: ")]
    assert answer.code == 2
    assert [any(name in p for p in problems) for name in ("imu.nc", "L01.nc", "L01_targets.csv")] == [True] * 3
    assert len(problems) == 3
    assert "line F1/L02" in answer.out


def test_inspect_of_a_sound_campaign_finds_nothing(demo: Path, tsmftis: Any) -> None:
    answer = tsmftis("inspect", demo)
    assert (answer.code, answer.err) == (0, "")
    assert "no problem found" in answer.out


DEMO = (Path(__file__).parents[2] / "configs" / "simulation" / "demo.yaml").read_text()
PRESETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown key": (DEMO + "colour: red\n", ("preset.yaml", "'colour'", "not known")),
    "missing key": (DEMO.replace("name: demo", ""), ("preset.yaml", "'name'", "missing")),
    "a line after the flight's end": (DEMO.replace("start_s: 170.0", "start_s: 1700.0"), ("preset.yaml", "L02")),
    "not YAML": ("a: [1\n", ("preset.yaml", "YAML")),
    "empty": ("", ("preset.yaml",)),
    "a list": ("- 1\n", ("preset.yaml",)),
}


@pytest.mark.parametrize(("text", "parts"), PRESETS.values(), ids=PRESETS)
def test_a_wrong_preset_ends_in_one_line(text: str, parts: tuple[str, ...], tmp_path: Path, tsmftis: Any) -> None:
    (tmp_path / "preset.yaml").write_text(text, encoding="utf-8")
    answer = tsmftis("simulate", tmp_path / "new", "--preset", tmp_path / "preset.yaml")
    print(answer.err)
    assert answer.code == 2
    assert_one_line(answer.err, *parts)
    assert not (tmp_path / "new").exists()


def test_a_preset_that_does_not_exist(tmp_path: Path, tsmftis: Any) -> None:
    answer = tsmftis("simulate", tmp_path / "new", "--preset", "deluxe")
    assert answer.code == 2
    assert_one_line(answer.err, "--preset", "'deluxe'", "demo")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["new", "new-truth"])
def test_simulate_spares_a_folder_that_is_not_empty(name: str, tmp_path: Path, tsmftis: Any) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "notes.txt").write_text("mine")
    answer = tsmftis("simulate", tmp_path / "new")
    assert answer.code == 2
    assert_one_line(answer.err, name, "not empty")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["notes.txt"]


def test_import_opus_of_a_text_file(tmp_path: Path, tsmftis: Any) -> None:
    pytest.importorskip("brukeropus")
    (tmp_path / "sample.0").write_text("this is no OPUS file\n")
    answer = tsmftis("import", "opus", tmp_path / "sample.0", tmp_path / "sample.nc")
    print(answer.err)
    assert answer.code == 2
    assert_one_line(answer.err, "sample.0", "OPUS")
    assert [p.name for p in tmp_path.iterdir()] == ["sample.0"]


@pytest.mark.parametrize("file", ["nowhere.0", "."])
def test_import_opus_of_no_file(file: str, tmp_path: Path, tsmftis: Any) -> None:
    pytest.importorskip("brukeropus")
    answer = tsmftis("import", "opus", tmp_path / file, tmp_path / "sample.nc")
    assert answer.code == 2
    assert_one_line(answer.err, "file")
    assert not list(tmp_path.iterdir())


def test_import_opus_into_no_folder(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    answer = tsmftis("import", "opus", demo / IMU, tmp_path / "nowhere" / "sample.nc")
    assert answer.code == 2
    assert_one_line(answer.err, "OUT")


# --- as a user starts it: a process of its own ------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["imu truncated", "path with .."])
def test_the_command_itself_ends_in_one_line(case: str, copied: Path, tmp_path: Path) -> None:
    spoil, parts = CAMPAIGNS[case]
    spoil(copied)
    script = Path(sys.executable).with_name("tsmftis")
    command = [str(script)] if script.exists() else [sys.executable, "-c", "from flows.cli import main; main()"]
    done = subprocess.run(
        [*command, "run", str(copied), "--out", str(tmp_path / "out")], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert_one_line(done.stderr, *parts)
    assert_nothing_in(tmp_path / "out")


def test_an_earlier_result_survives_bad_input(copied: Path, demo_run: Path, tmp_path: Path, tsmftis: Any) -> None:
    """A run over input that has gone bad since must leave the old results as they are."""
    out = Path(shutil.copytree(demo_run, tmp_path / "out"))
    before = {p.relative_to(out): p.read_bytes() for p in out.rglob("*") if p.is_file()}
    truncated(FRAMES)(copied)
    assert tsmftis("run", copied, "--out", out).code == 2
    assert {p.relative_to(out): p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_a_folder_of_another_campaign_is_left_alone(demo_run: Path, copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    keys("name", to="another")(copied)
    before = (demo_run / "run.json").read_bytes()
    answer = tsmftis("run", copied, "--out", demo_run)
    assert answer.code == 2
    assert_one_line(answer.err, "--out", "holds results of the campaign 'tiny', not of 'another'")
    assert (demo_run / "run.json").read_bytes() == before


def test_two_runs_into_one_folder_do_not_meet(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    """The lock is held by this process: a run in another one is told so, and leaves the folder as it is."""
    out = tmp_path / "out"
    out.mkdir()
    with (out / ".lock").open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        answer = tsmftis("run", demo, "--out", out)
    assert answer.code == 2
    assert_one_line(answer.err, "--out", "is in use by another run")
    assert [p.name for p in out.iterdir()] == [".lock"]
