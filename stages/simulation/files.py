"""A simulated campaign → a folder in the campaign format, with its truth in a folder beside it."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import xarray as xr
import yaml
from scipy.spatial.transform import Rotation

from stages.simulation.records import ChamberRun, InertialRun, SimulatedCampaign, SimulatedLine
from stages.simulation.settings import SimulationSettings
from tsmftis.simulator.gnss import Fixes
from tsmftis.simulator.world import Terrain

AXES = ["x", "y", "z"]
NED = ["north", "east", "down"]
THERMOMETERS = ["anode", "cathode", "shell"]
Variables = Mapping[str, tuple[tuple[str, ...], Any, dict[str, Any]]]


def write(campaign: SimulatedCampaign, folder: Path) -> None:
    """The campaign into `folder` and its truth into `<folder>-truth`; the same campaign gives the same bytes.

    Built in a hidden folder beside them and renamed when complete, the truth first. Raises FileExistsError where
    either folder is there and not empty.
    """
    folder = Path(folder)
    truth = folder.with_name(folder.name + "-truth")
    for target in (folder, truth):
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise FileExistsError(f"{target}: exists and is not empty")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as scratch:
        built, built_truth = Path(scratch) / "campaign", Path(scratch) / "truth"
        _write_campaign(campaign, built)
        _write_truth(campaign, built_truth)
        for source, target in ((built_truth, truth), (built, folder)):
            if target.exists():
                target.rmdir()
            shutil.move(source, target)


def _write_campaign(campaign: SimulatedCampaign, root: Path) -> None:
    settings, flight = campaign.settings, campaign.settings.flight.id
    for name in ("", flight, "chamber"):
        (root / name).mkdir()
    _yaml(root / "campaign.yaml", _manifest(campaign))
    _yaml(root / "instrument.yaml", _instrument(settings))
    for name, run in campaign.chamber.items():
        _netcdf(root / "chamber" / f"{name}.nc", *_chamber(settings, run))
    _netcdf(root / flight / "imu.nc", *_imu(campaign.imu))
    _netcdf(root / flight / "gnss.nc", *_gnss(settings, campaign.gnss))
    for line in campaign.lines:
        base = root / flight / line.id
        _netcdf(base.with_name(f"{line.id}.nc"), *_frames(line))
        base.with_name(f"{line.id}_targets.csv").write_text(_targets(line), encoding="utf-8")
        if line.gcps:
            base.with_name(f"{line.id}_gcps.csv").write_text(_gcps(settings, line), encoding="utf-8")
    _netcdf(root / "calibration.nc", *_calibration(campaign))
    _netcdf(root / "references.nc", *_references(campaign))
    _dem(root / "dem.tif", campaign.terrain)


def _manifest(campaign: SimulatedCampaign) -> dict[str, Any]:
    settings, flight = campaign.settings, campaign.settings.flight.id
    entry: dict[str, Any] = {"id": flight, "imu": f"{flight}/imu.nc", "gnss": f"{flight}/gnss.nc"}
    if campaign.initial is not None:
        entry["initial"] = dict(campaign.initial)
    entry["lines"] = [
        {
            "id": line.id,
            "frames": f"{flight}/{line.id}.nc",
            "targets": f"{flight}/{line.id}_targets.csv",
            **({"gcps": f"{flight}/{line.id}_gcps.csv"} if line.gcps else {}),
        }
        for line in campaign.lines
    ]
    return {
        "format": "tsmftis-campaign/1",
        "name": settings.name,
        "time": {"scale": settings.scale, "epoch": settings.epoch},
        "instrument": "instrument.yaml",
        "calibration": "calibration.nc",
        "references": "references.nc",
        "dem": "dem.tif",
        "thermal": {"train": ["chamber/train.nc"], "verify": ["chamber/verify.nc"]},
        "flights": [entry],
    }


def _instrument(settings: SimulationSettings) -> dict[str, Any]:
    return settings.instrument.model_dump(mode="json")


def _yaml(path: Path, content: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _netcdf(path: Path, variables: Variables, coordinates: Variables, attributes: dict[str, Any]) -> None:
    """NetCDF-4, contiguous and uncompressed."""
    dataset = xr.Dataset(dict(variables), dict(coordinates), attributes)
    encoding: dict[Any, dict[str, Any]] = {
        name: {"_FillValue": None, "contiguous": True} for name, v in dataset.variables.items() if v.dtype.kind != "U"
    }
    dataset.to_netcdf(path, engine="h5netcdf", encoding=encoding)


def _inertial(run: InertialRun, temperature_time: str) -> Variables:
    return {
        "gyro": (("time", "axis"), run.gyro, {"units": "rad s-1"}),
        "accel": (("time", "axis"), run.accel, {"units": "m s-2"}),
        "temperature_gyro": (
            (temperature_time, "axis", "thermometer"),
            run.temperature_gyro.astype(np.float32),
            {"units": "degC"},
        ),
        "temperature_accel": ((temperature_time, "axis"), run.temperature_accel.astype(np.float32), {"units": "degC"}),
    }


def _names() -> Variables:
    return {"axis": (("axis",), AXES, {}), "thermometer": (("thermometer",), THERMOMETERS, {})}


def _imu(run: InertialRun) -> tuple[Variables, Variables, dict[str, Any]]:
    return (
        _inertial(run, "time_temperature"),
        {
            "time": (("time",), run.time, {"units": "s"}),
            "time_temperature": (("time_temperature",), run.time_temperature, {"units": "s"}),
            **_names(),
        },
        {},
    )


def _chamber(settings: SimulationSettings, run: ChamberRun) -> tuple[Variables, Variables, dict[str, Any]]:
    place = settings.chamber
    return (
        {
            **_inertial(run.inertial, "time"),
            "temperature_chamber": (("time",), run.temperature_chamber.astype(np.float32), {"units": "degC"}),
        },
        {"time": (("time",), run.inertial.time, {"units": "s"}), **_names()},
        {name: getattr(place, name) for name in ("latitude_deg", "height_m", "roll_deg", "pitch_deg", "yaw_deg")},
    )


def _gnss(settings: SimulationSettings, fixes: Fixes) -> tuple[Variables, Variables, dict[str, Any]]:
    section, shape = settings.gnss, fixes.velocity.shape
    return (
        {
            "latitude": (("time",), np.rad2deg(fixes.geodetic[:, 0]), {"units": "degrees_north"}),
            "longitude": (("time",), np.rad2deg(fixes.geodetic[:, 1]), {"units": "degrees_east"}),
            "height": (
                ("time",),
                fixes.geodetic[:, 2],
                {"units": "m", "long_name": "height above the WGS-84 ellipsoid"},
            ),
            "velocity": (("time", "ned"), fixes.velocity, {"units": "m s-1"}),
            "sigma_position": (
                ("time", "ned"),
                np.broadcast_to(section.sigma_position_north_east_down_m, shape),
                {"units": "m"},
            ),
            "sigma_velocity": (
                ("time", "ned"),
                np.broadcast_to(section.sigma_velocity_north_east_down_m_per_s, shape),
                {"units": "m s-1"},
            ),
            "quality": (
                ("time",),
                np.ones(shape[0], np.int8),
                {"flag_values": "1 2 5", "flag_meanings": "fixed float single"},
            ),
        },
        {"time": (("time",), fixes.time, {"units": "s"}), "ned": (("ned",), NED, {})},
        {},
    )


def _frames(line: SimulatedLine) -> tuple[Variables, Variables, dict[str, Any]]:
    return (
        {"frames": (("frame", "row", "col"), line.frames, {"units": "DN", "long_name": "raw detector counts"})},
        {"time": (("frame",), line.stamp, {"units": "s", "long_name": "mid-exposure time stamp"})},
        {},
    )


def _calibration(campaign: SimulatedCampaign) -> tuple[Variables, Variables, dict[str, Any]]:
    calibration = campaign.calibration
    return (
        {
            "dark": (("row", "col"), calibration.dark.astype(np.float32), {"units": "DN"}),
            "flat": (("row", "col"), calibration.flat.astype(np.float32), {"units": "1"}),
            "response": (
                ("wavenumber",),
                calibration.response,
                {"units": "DN / (reference radiance unit m-1)", "long_name": "fringe amplitude response"},
            ),
        },
        {"wavenumber": (("wavenumber",), calibration.wavenumber, {"units": "m-1"})},
        {},
    )


def _references(campaign: SimulatedCampaign) -> tuple[Variables, Variables, dict[str, Any]]:
    calibration = campaign.calibration
    return (
        {
            "radiance": (
                ("reference", "wavenumber"),
                np.stack(list(calibration.references.values())),
                {"units": "reference radiance unit"},
            )
        },
        {
            "reference": (("reference",), list(calibration.references), {}),
            "wavenumber": (("wavenumber",), calibration.wavenumber, {"units": "m-1"}),
        },
        {},
    )


def _targets(line: SimulatedLine) -> str:
    rows = ["id,latitude_deg,longitude_deg,height_m,reference,size_m"]
    for i, (reference, point, side) in enumerate(
        zip(line.references, line.panels.geodetic, line.panels.side, strict=True), 1
    ):
        lat, lon = np.rad2deg(point[:2])
        rows.append(f"{line.id}-{i},{lat:.9f},{lon:.9f},{point[2]:.3f},{reference},{side}")
    return "\n".join(rows) + "\n"


def _gcps(settings: SimulationSettings, line: SimulatedLine) -> str:
    rows = ["frame,row,col,latitude_deg,longitude_deg,height_m,sigma_px"]
    for gcp in line.gcps:
        lat, lon = np.rad2deg(gcp.geodetic[:2])
        rows.append(
            f"{gcp.frame},{gcp.row:.2f},{gcp.col:.2f},{lat:.9f},{lon:.9f},{gcp.geodetic[2]:.3f},{settings.gcps.sigma_px}"
        )
    return "\n".join(rows) + "\n"


def _dem(path: Path, terrain: Terrain) -> None:
    rows, cols = terrain.height.shape
    north, west, d_lat, d_lon = np.rad2deg([terrain.north, terrain.west, terrain.d_latitude, terrain.d_longitude])
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=cols,
        height=rows,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=rasterio.Affine(d_lon, 0.0, west, 0.0, -d_lat, north),
        compress="deflate",
    ) as raster:
        raster.write(terrain.height, 1)


def _write_truth(campaign: SimulatedCampaign, root: Path) -> None:
    root.mkdir()
    (root / "truth.json").write_text(json.dumps(campaign.truth, indent=1) + "\n", encoding="utf-8")
    np.savez_compressed(
        root / "trajectory.npz",
        t=campaign.true_time,
        llh=campaign.true_geodetic,
        ypr=campaign.true_attitude[:, ::-1],
    )
    for line in campaign.lines:
        np.savez_compressed(
            root / f"{line.id}.npz",
            t=line.true_time,
            pos=line.position,
            quat=Rotation.from_matrix(line.body_to_ecef).as_quat(),
        )
    thermal = {
        f"{name}_{sensor}": bias
        for name, run in campaign.chamber.items()
        for sensor, bias in (("gyro", run.gyro_bias), ("accel", run.accel_bias))
    }
    np.savez_compressed(root / "thermal.npz", **thermal)  # type: ignore[arg-type]
