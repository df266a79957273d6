"""A simulated campaign: its form on disk, its truth, and that an effect changes what it should and nothing else."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
import yaml
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from stages.simulation import SimulatedCampaign, SimulationSettings, run, write
from tsmftis.simulator import effects as effect


def tiny(**effects: dict[str, Any]) -> SimulationSettings:
    """The demo cut down: 30 s of flight, one line of 1.5 s, 32 × 48 pixels, ten minutes of chamber."""
    preset = SimulationSettings.preset("demo").model_dump()
    preset["name"] = "tiny"
    preset["instrument"]["imu"]["rate_hz"] = 100.0
    preset["instrument"]["camera"] |= {"rows": 32, "cols": 48, "principal_point_px": {"row": 15.8, "col": 23.1}}
    preset["instrument"]["interferometer"]["zpd_col"] = 12.0
    preset["flight"]["legs"] = [{"straight_s": 30.0}]
    preset["flight"]["wobble"]["sigma_deg"] = {"roll": 0.03, "pitch": 0.03, "yaw": 0.03}
    preset["lines"] = [{"id": "L01", "start_s": 15.0, "duration_s": 1.5, "panels": ["white", "red"]}]
    preset["scene"] |= {"panel_margin_m": 12.0, "panel_scatter_m": 0.5, "cell_m": 0.5}
    preset["terrain"]["margin_m"] = 40.0
    preset["gcps"]["per_line"] = 6
    for name in ("train", "verify"):
        preset["chamber"][name]["stages"] = [{"hold_min": 2.0}, {"to_degc": 40.0, "rate_k_per_min": 4.0}]
    preset["effects"] = effects
    return SimulationSettings.model_validate(preset)


@pytest.fixture(scope="module")
def campaign() -> SimulatedCampaign:
    return run(tiny(), 3)


@pytest.fixture(scope="module")
def folder(campaign: SimulatedCampaign, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "tiny"
    write(campaign, path)
    return path


def read(path: Path) -> xr.Dataset:
    return xr.load_dataset(path, engine="h5netcdf")


# --- the contract's projection, in a few lines of its own -------------------------------------------------------------


def ecef(latitude: float, longitude: float, height: float) -> np.ndarray:
    e2 = (2.0 - 1.0 / 298.257223563) / 298.257223563
    n = 6378137.0 / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    horizontal = (n + height) * np.cos(latitude)
    return np.array(
        [horizontal * np.cos(longitude), horizontal * np.sin(longitude), (n * (1.0 - e2) + height) * np.sin(latitude)]
    )


def project(folder: Path, line: str, row: dict[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of a point of a CSV in every frame, by the true pose and the declared instrument."""
    instrument = yaml.safe_load((folder / "instrument.yaml").read_text())
    camera, mounting = instrument["camera"], instrument["mounting"]
    truth = np.load(folder.with_name(folder.name + "-truth") / f"{line}.npz")
    body = Rotation.from_quat(truth["quat"])
    angles = mounting["boresight_deg"]
    boresight = Rotation.from_euler("ZYX", [angles["yaw"], angles["pitch"], angles["roll"]], degrees=True)
    latitude, longitude = (np.deg2rad(float(row[name])) for name in ("latitude_deg", "longitude_deg"))
    point = ecef(latitude, longitude, float(row["height_m"]))
    offset = (body * boresight).inv().apply(point - truth["pos"] - body.apply(mounting["imu_to_camera_m"]))
    scale = camera["focal_length_m"] / camera["pixel_pitch_m"]
    principal = camera["principal_point_px"]
    return (
        principal["row"] + offset[:, 1] / offset[:, 2] * scale,
        principal["col"] - offset[:, 0] / offset[:, 2] * scale,
    )


def targets(folder: Path, line: str, kind: str = "targets") -> list[dict[str, str]]:
    with (folder / "F1" / f"{line}_{kind}.csv").open() as lines:
        return list(csv.DictReader(lines))


def corrected_frames(folder: Path, line: str) -> np.ndarray:
    calibration = read(folder / "calibration.nc")
    frames = read(folder / "F1" / f"{line}.nc").frames.values.astype(float)
    return (frames - calibration.dark.values) / calibration.flat.values


def track(frames: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Each column's value, from the two frames between which the target crosses it, each at the target's own row."""
    values = np.full(frames.shape[2], np.nan)
    for c in range(values.size):
        k = np.flatnonzero((col[:-1] <= c) & (col[1:] > c))
        if k.size:
            weight = (c - col[k[0]]) / (col[k[0] + 1] - col[k[0]])
            two = [np.interp(row[i], np.arange(frames.shape[1]), frames[i, :, c]) for i in (k[0], k[0] + 1)]
            values[c] = (1.0 - weight) * two[0] + weight * two[1]
    return values


def test_panels_lie_in_the_frames_where_the_contract_projects_them(folder: Path) -> None:
    """The white panel outshines all ground: the centroid of its light is its surveyed centre."""
    row, col = project(folder, "L01", targets(folder, "L01")[0])
    frames = corrected_frames(folder, "L01")
    errors = []
    for k in np.flatnonzero((col > 8) & (col < 40) & (row > 7) & (row < 25)):
        top, left = round(row[k]) - 7, round(col[k]) - 7
        # fringes vary along columns: each column is held against its own ground
        patch = frames[k, top : top + 15, left : left + 15]
        light = np.maximum(patch - 1.3 * np.median(frames[k][:, left : left + 15], axis=0), 0.0)
        light = light / np.maximum(light.sum(axis=0), 1e-9)  # column by column
        seen = (patch > 2.0 * np.median(frames[k][:, left : left + 15], axis=0)).sum(axis=0) > 6
        rows = (light * (top + np.arange(15))[:, None]).sum(axis=0)[seen]
        errors.append((rows.mean() - row[k], (left + np.flatnonzero(seen)).mean() - col[k]))
    assert len(errors) > 20
    assert np.abs(np.mean(errors, axis=0)).max() < 0.15
    assert np.std(errors, axis=0).max() < 0.5


def test_a_tracked_panel_gives_the_radiance_of_its_material(folder: Path) -> None:
    """A plain windowed cosine sum over the interferogram, beside the same sum over the reference's."""
    instrument = yaml.safe_load((folder / "instrument.yaml").read_text())["interferometer"]
    calibration, references = read(folder / "calibration.nc"), read(folder / "references.nc")
    opd = instrument["opd_step_m"] * (np.arange(48) - instrument["zpd_col"])
    sigma = np.arange(1.15e6, 2.15e6, 2e4)
    short = instrument["zpd_col"] * instrument["opd_step_m"]
    window = (1.0 - (opd / opd.max()) ** 2) ** 2 * np.clip((opd + short) / (2.0 * short), 0.0, 1.0)
    kernel = 4.0 * instrument["opd_step_m"] * window * np.exp(-2j * np.pi * np.outer(sigma, opd))
    frames = corrected_frames(folder, "L01")
    grid, response = calibration.wavenumber.values, calibration.response.values
    u = 2.0 * (sigma - grid[0]) / (grid[-1] - grid[0]) - 1.0
    for target in targets(folder, "L01"):
        signal = track(frames, *project(folder, "L01", target))
        assert np.isfinite(signal).all()
        # φ is smooth, small and the same for all: 0.15 + 0.05·u of the preset
        found = (kernel @ (signal - signal.mean()) * np.exp(-1j * (0.15 + 0.05 * u))).real
        radiance = references.radiance.sel(reference=target["reference"]).values
        even = (response * radiance * 2500.0) @ np.cos(2.0 * np.pi * np.outer(grid, opd))
        expected = (kernel @ (even - even.mean())).real
        assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(expected)
        # and so, at this coarse resolution, the material's own spectrum in absolute units
        inside = (sigma > 1.25e6) & (sigma < 2.05e6)
        spectrum = (found / np.interp(sigma, grid, response))[inside]
        difference = np.abs(spectrum - np.interp(sigma, grid, radiance)[inside])
        assert np.median(difference) < 0.05 * radiance.max()  # narrow absorption lines are not resolved


def test_picked_points_project_where_they_were_picked(folder: Path, campaign: SimulatedCampaign) -> None:
    picked = targets(folder, "L01", "gcps")
    assert len(picked) == 6
    errors = []
    for point in picked:
        row, col = project(folder, "L01", point)
        frame = int(point["frame"])
        errors.append((float(point["row"]) - row[frame], float(point["col"]) - col[frame]))
        assert float(point["sigma_px"]) == campaign.settings.gcps.sigma_px
    assert 0.1 < np.std(errors) < 0.6


def test_surveyed_points_lie_on_the_dem(folder: Path) -> None:
    with rasterio.open(folder / "dem.tif") as dem:
        assert dem.crs.to_epsg() == 4326
        heights, transform = dem.read(1), dem.transform
    for point in targets(folder, "L01") + targets(folder, "L01", "gcps"):
        col = (float(point["longitude_deg"]) - transform.c) / transform.a
        row = (float(point["latitude_deg"]) - transform.f) / transform.e
        i, j, v, u = int(row - 0.5), int(col - 0.5), (row - 0.5) % 1.0, (col - 0.5) % 1.0
        surface = (1 - v) * ((1 - u) * heights[i, j] + u * heights[i, j + 1]) + v * (
            (1 - u) * heights[i + 1, j] + u * heights[i + 1, j + 1]
        )
        assert surface == pytest.approx(float(point["height_m"]), abs=2e-3)


# --- form ------------------------------------------------------------------------------------------------------------


def test_every_file_has_the_contracts_variables_and_units(folder: Path) -> None:
    manifest = yaml.safe_load((folder / "campaign.yaml").read_text())
    assert manifest["format"] == "tsmftis-campaign/1"
    assert set(manifest["flights"][0]["initial"]) == {
        "time_s",
        "roll_deg",
        "pitch_deg",
        "yaw_deg",
        "sigma_roll_deg",
        "sigma_pitch_deg",
        "sigma_yaw_deg",
    }
    imu, fixes = read(folder / manifest["flights"][0]["imu"]), read(folder / manifest["flights"][0]["gnss"])
    line = read(folder / manifest["flights"][0]["lines"][0]["frames"])
    chamber = read(folder / manifest["thermal"]["train"][0])
    calibration, references = read(folder / manifest["calibration"]), read(folder / manifest["references"])
    for dataset, variables in (
        (
            imu,
            {
                "time": (("time",), "s"),
                "gyro": (("time", "axis"), "rad s-1"),
                "accel": (("time", "axis"), "m s-2"),
                "time_temperature": (("time_temperature",), "s"),
                "temperature_gyro": (("time_temperature", "axis", "thermometer"), "degC"),
                "temperature_accel": (("time_temperature", "axis"), "degC"),
            },
        ),
        (
            fixes,
            {
                "time": (("time",), "s"),
                "latitude": (("time",), "degrees_north"),
                "longitude": (("time",), "degrees_east"),
                "height": (("time",), "m"),
                "velocity": (("time", "ned"), "m s-1"),
                "sigma_position": (("time", "ned"), "m"),
                "sigma_velocity": (("time", "ned"), "m s-1"),
            },
        ),
        (line, {"frames": (("frame", "row", "col"), "DN"), "time": (("frame",), "s")}),
        (
            chamber,
            {
                "time": (("time",), "s"),
                "gyro": (("time", "axis"), "rad s-1"),
                "accel": (("time", "axis"), "m s-2"),
                "temperature_gyro": (("time", "axis", "thermometer"), "degC"),
                "temperature_accel": (("time", "axis"), "degC"),
                "temperature_chamber": (("time",), "degC"),
            },
        ),
        (
            calibration,
            {
                "dark": (("row", "col"), "DN"),
                "flat": (("row", "col"), "1"),
                "wavenumber": (("wavenumber",), "m-1"),
            },
        ),
        (references, {"radiance": (("reference", "wavenumber"), "reference radiance unit")}),
    ):
        for name, (dims, units) in variables.items():
            assert dataset[name].dims == dims and dataset[name].attrs["units"] == units, name
            assert np.isfinite(dataset[name].values).all(), name
    assert set(chamber.attrs) == {"latitude_deg", "height_m", "roll_deg", "pitch_deg", "yaw_deg"}
    assert list(imu.thermometer.values) == ["anode", "cathode", "shell"]
    assert line.frames.dtype == np.uint16 and line.frames.shape == (150, 32, 48)
    assert line.frames.encoding["chunksizes"] is None and (fixes.quality == 1).all()
    assert set(references.reference.values) == {t["reference"] for t in targets(folder, "L01")}
    assert imu.time.values[0] == pytest.approx(0.01) and np.ptp(np.diff(imu.time.values)) < 1e-9


def test_the_truth_is_what_the_checking_tool_reads(folder: Path, campaign: SimulatedCampaign) -> None:
    truth = folder.with_name("tiny-truth")
    record = json.loads((truth / "truth.json").read_text())
    assert record["lines"]["L01"] == {"t0": 15.0, "t1": 16.5} and record["effects"] == {}
    trajectory, line, thermal = (np.load(truth / f"{n}.npz") for n in ("trajectory", "L01", "thermal"))
    assert trajectory["llh"].shape == trajectory["ypr"].shape == (trajectory["t"].size, 3)
    k = np.searchsorted(trajectory["t"], 15.5)
    at = np.searchsorted(line["t"], 15.5)
    np.testing.assert_allclose(ecef(*trajectory["llh"][k]), line["pos"][at], atol=1e-6)
    noise = read(folder / "chamber/verify.nc").gyro.values - thermal["verify_gyro"]
    arw = campaign.settings.instrument.imu.gyro.angle_random_walk_deg_per_sqrt_h * np.deg2rad(1.0) / 60.0
    np.testing.assert_allclose(noise.std(axis=0), arw, rtol=0.15)


def test_the_same_seed_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    write(run(tiny(), 3), tmp_path / "tiny")
    for suffix in ("", "-truth"):
        first, second = folder.with_name("tiny" + suffix), tmp_path / ("tiny" + suffix)
        names = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
        assert names == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
        for name in names:
            assert (first / name).read_bytes() == (second / name).read_bytes(), name
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_full_folder_is_never_overwritten(campaign: SimulatedCampaign, folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileExistsError, match="not empty"):
        write(campaign, folder)
    (tmp_path / "new-truth").mkdir()
    (tmp_path / "new-truth" / "kept").write_text("mine")
    with pytest.raises(FileExistsError, match="new-truth"):
        write(campaign, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "empty").mkdir()
    write(campaign, tmp_path / "empty")
    assert (tmp_path / "empty" / "campaign.yaml").exists()


# --- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["demo", "survey", "mems"])
def test_presets_load(name: str) -> None:
    assert SimulationSettings.preset(name).name == name


def test_settings_refuse_what_they_do_not_know() -> None:
    good = tiny().model_dump()
    for change, match in (
        ({"colour": 1}, "colour"),
        ({"effects": {"ghost": {"a": 1.0}}}, "ghost"),
        ({"lines": [*good["lines"], *good["lines"]]}, "share an id"),
        ({"lines": [good["lines"][0] | {"panels": ["velvet"]}]}, "velvet"),
        ({"detector": good["detector"] | {"exposure_s": 0.002}}, "exposure_instants"),
    ):
        with pytest.raises(ValidationError, match=match):
            SimulationSettings.model_validate(good | change)


def test_a_line_that_cannot_be_flown_is_refused() -> None:
    good = tiny().model_dump()
    for line, match in (({"start_s": 29.5}, "not within the flight"), ({"duration_s": 0.9}, "fly longer")):
        settings = SimulationSettings.model_validate(good | {"lines": [good["lines"][0] | line]})
        with pytest.raises(ValueError, match=match):
            run(settings, 3)


def test_without_initial_none_is_written(tmp_path: Path) -> None:
    good = tiny().model_dump()
    settings = SimulationSettings.model_validate(good | {"flight": good["flight"] | {"initial": None}})
    write(run(settings, 3), tmp_path / "c")
    assert "initial" not in yaml.safe_load((tmp_path / "c" / "campaign.yaml").read_text())["flights"][0]


def test_motion_within_the_exposure_blurs() -> None:
    good = tiny().model_dump()
    sharp = run(tiny(), 3).lines[0].frames.astype(float)
    blurred = (
        run(
            SimulationSettings.model_validate(
                good | {"detector": good["detector"] | {"exposure_s": 0.03, "exposure_instants": 6}}
            ),
            3,
        )
        .lines[0]
        .frames.astype(float)
    )
    assert np.abs(np.diff(blurred, axis=1)).mean() < np.abs(np.diff(sharp, axis=1)).mean()


# --- effects ---------------------------------------------------------------------------------------------------------

PARTS: dict[str, Callable[[SimulatedCampaign], Any]] = {
    "imu gyro": lambda c: c.imu.gyro,
    "imu accel": lambda c: c.imu.accel,
    "thermometers": lambda c: (c.imu.temperature_gyro, c.imu.temperature_accel),
    "chamber gyro": lambda c: c.chamber["train"].inertial.gyro,
    "chamber accel": lambda c: c.chamber["verify"].inertial.accel,
    "gnss time": lambda c: c.gnss.time,
    "gnss position": lambda c: c.gnss.geodetic,
    "gnss velocity": lambda c: c.gnss.velocity,
    "frames": lambda c: c.lines[0].frames,
    "stamps": lambda c: c.lines[0].stamp,
    "survey": lambda c: c.lines[0].panels.geodetic,
    "picked": lambda c: np.array([[g.frame, g.row, g.col, *g.geodetic] for g in c.lines[0].gcps]),
    "dem": lambda c: c.terrain.height,
    "calibration": lambda c: (c.calibration.dark, c.calibration.flat, c.calibration.response),
    "trajectory": lambda c: (c.true_geodetic, c.true_attitude),
}
VIEW = {"frames", "picked"}
CHANGES: list[tuple[str, dict[str, Any], set[str]]] = [
    ("antenna_lever_arm", {"y": 0.3}, {"gnss position", "gnss velocity"}),
    ("gnss_latency", {"latency": 0.02}, {"gnss time"}),
    ("gyro_scale_factor", {"z": 1e-3}, {"imu gyro", "chamber gyro"}),
    ("accel_scale_factor", {"z": 1e-3}, {"imu accel", "chamber accel"}),
    ("gyro_g_sensitivity", {"z": 1e-7}, {"imu gyro", "chamber gyro"}),
    (
        "thermal_hysteresis",
        {"half_width": 2.0, "gyro": [1e-6] * 3, "accel": [1e-2] * 3},
        {"imu gyro", "imu accel", "chamber gyro", "chamber accel"},
    ),
    ("thermal_lag", {"lag": 60.0}, {"imu gyro", "chamber gyro"}),
    ("camera_latency", {"latency": 0.007}, {"stamps"}),
    ("boresight", {"roll": 2e-3}, VIEW),
    ("boresight_thermal_drift", {"pitch": 2e-4}, VIEW),
    ("mount_flexure", {"roll": 5e-3}, VIEW),
    ("focal_length", {"scale": 0.01}, VIEW),
    ("radial_distortion", {"k1": 20.0}, VIEW),
    ("dem_bias", {"height": 20.0}, {"survey", *VIEW}),
    ("opd_scale", {"scale": 0.01}, {"frames"}),
    ("opd_quadratic", {"quadratic": 1e-10}, {"frames"}),
    ("fringe_tilt", {"tilt": 2e-9}, {"frames"}),
    ("detector_nonlinearity", {"a": 0.08}, {"frames"}),
    ("channel_fringe", {"amplitude": 0.1, "thickness": 5e-6, "phase": 0.3}, {"frames"}),
    ("response_scale", {"scale": 0.05}, {"frames"}),
]


def test_every_effect_is_in_the_list_below() -> None:
    assert {name for name, _, _ in CHANGES} == set(effect.NULL)


@pytest.mark.parametrize(("name", "parameters", "changed"), CHANGES, ids=[c[0] for c in CHANGES])
def test_an_effect_changes_what_it_should_and_nothing_else(
    campaign: SimulatedCampaign, name: str, parameters: dict[str, Any], changed: set[str]
) -> None:
    other = run(tiny(**{name: parameters}), 3)
    differs = {part for part, get in PARTS.items() if _digest(get(campaign)) != _digest(get(other))}
    assert differs == changed
    assert other.settings.instrument == campaign.settings.instrument
    assert other.truth["undeclared"] == {name: parameters}


def _digest(arrays: Any) -> list[bytes]:
    return [np.asarray(a).tobytes() for a in (arrays if isinstance(arrays, tuple) else (arrays,))]


def test_effects_have_the_declared_sign_and_size(campaign: SimulatedCampaign) -> None:
    """stamp = true time + latency; measured = (1 + value)·true; the true terrain is the DEM plus the bias."""
    other = run(
        tiny(
            camera_latency={"latency": 0.007},
            gnss_latency={"latency": 0.02},
            gyro_scale_factor={"x": 0.5},
            dem_bias={"height": 20.0},
            opd_scale={"scale": 0.01},
        ),
        3,
    )
    np.testing.assert_allclose(other.lines[0].stamp, campaign.lines[0].stamp + 0.007)
    np.testing.assert_allclose(other.gnss.time, campaign.gnss.time + 0.02)
    shift = other.imu.gyro[:, 0] - campaign.imu.gyro[:, 0]
    slope = (shift @ campaign.imu.gyro[:, 0]) / (campaign.imu.gyro[:, 0] @ campaign.imu.gyro[:, 0])
    assert slope == pytest.approx(0.5, abs=1e-3)
    rise = other.lines[0].panels.geodetic[:, 2] - campaign.lines[0].panels.geodetic[:, 2]
    np.testing.assert_allclose(rise, 20.0, atol=0.01)
    assert other.truth["interferometer"]["opd_step"] == pytest.approx(1.01 * 2.05e-7)
