"""The campaign reader and the records: what is written is read again, labels are put in order, defaults are the contract's."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.campaign import read_campaign
from pipeline.datasets import UNIT_SPELLINGS, open_dataset, take, write_dataset
from pipeline.errors import InputError
from pipeline.records import (
    CameraPoses,
    Gnss,
    Imu,
    Interferograms,
    Spectra,
    ThermalCorrection,
    Tracks,
    Trajectory,
)

few = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def numbers(shape: tuple[int, ...], low: float = -1e6, high: float = 1e6, *, nan: bool = False) -> Any:
    elements = st.floats(low, high, allow_nan=False)
    return arrays(np.float64, shape, elements=elements | st.just(np.nan) if nan else elements)


def times(n: int) -> Any:
    """Strictly increasing stamps, steps of 1 ms to 10 s."""
    return arrays(np.float64, n, elements=st.floats(1e-3, 10.0)).map(np.cumsum)


def there_and_back(record: Any, folder: Path) -> Any:
    path = folder / "record.nc"
    write_dataset(record.to_dataset(), path)
    return type(record).from_file(path)


def assert_same(a: Any, b: Any, *, inexact: tuple[str, ...] = ()) -> None:
    """Bit for bit, but for the `inexact` fields: radians that went through degrees (one rounding each way)."""
    for name in (f.name for f in fields(a)):
        one, two = getattr(a, name), getattr(b, name)
        if name in inexact:
            np.testing.assert_allclose(two, one, rtol=4e-16, atol=1e-15, err_msg=name)
        elif isinstance(one, np.ndarray):
            np.testing.assert_array_equal(two, one, err_msg=name)
        else:
            assert one == two, name


# --- round trips ------------------------------------------------------------------------------------------------------


@few
@given(st.data(), st.integers(2, 6))
def test_trajectory(tmp_path: Path, data: st.DataObject, n: int) -> None:
    angle = st.floats(-3.14, 3.14)
    trajectory = Trajectory(
        time=data.draw(times(n)),
        latitude=data.draw(numbers((n,), -1.57, 1.57)),
        longitude=data.draw(numbers((n,), -3.14, 3.14)),
        height=data.draw(numbers((n,))),
        velocity=data.draw(numbers((n, 3))),
        rpy=data.draw(arrays(np.float64, (n, 3), elements=angle)),
        sigma_position=data.draw(numbers((n, 3), 0)),
        sigma_velocity=data.draw(numbers((n, 3), 0)),
        sigma_attitude=data.draw(numbers((n, 3), 0, 1)),
        rate=data.draw(numbers((n, 3))),
        specific_force=data.draw(numbers((n, 3))),
    )
    back = there_and_back(trajectory, tmp_path)
    # yaw is stored as 0 … 360° and comes back within ±π: one more rounding, at the size of a full turn
    np.testing.assert_allclose(back.rpy, trajectory.rpy, atol=4e-15)
    rest = {"rpy": trajectory.rpy}
    assert_same(
        trajectory,
        Trajectory(**{f.name: rest.get(f.name, getattr(back, f.name)) for f in fields(back)}),
        inexact=("latitude", "longitude", "sigma_attitude"),
    )


@few
@given(st.data(), st.integers(1, 3), st.integers(1, 3), st.integers(1, 5))
def test_tracks(tmp_path: Path, data: st.DataObject, methods: int, targets: int, frames: int) -> None:
    shape = (methods, targets, Tracks.GRID**2, frames)
    tracks = Tracks(
        tuple(f"m{i}" for i in range(methods)),
        tuple(f"t {i}" for i in range(targets)),
        data.draw(numbers(shape, nan=True)),
        data.draw(numbers(shape, nan=True)),
        {"tracking": "two frames lost"},
    )
    assert_same(tracks, there_and_back(tracks, tmp_path))
    dataset = tracks.to_dataset()
    np.testing.assert_array_equal(dataset.row.values, tracks.row[:, :, Tracks.CENTRE])


@few
@given(st.data(), st.integers(1, 3), st.integers(1, 3), st.integers(1, 5))
def test_spectra(tmp_path: Path, data: st.DataObject, methods: int, targets: int, bands: int) -> None:
    shape = (methods, targets, bands)
    spectra = Spectra(
        tuple(f"m{i}" for i in range(methods)),
        tuple(f"t{i}" for i in range(targets)),
        1e6 + 5e3 * np.arange(bands),
        *(data.draw(numbers(shape, nan=True)) for _ in Spectra.SPECTRA),
        reference=data.draw(numbers(shape[1:], nan=True)),
        points=data.draw(arrays(np.int64, shape[:2], elements=st.integers(0, 25))),
        phase=np.array([0.1, 0.2]),
        attributes={"apodization": "connes"},
    )
    assert_same(spectra, there_and_back(spectra, tmp_path))


@few
@given(st.data(), st.integers(1, 2), st.integers(1, 3), st.integers(1, 5))
def test_interferograms(tmp_path: Path, data: st.DataObject, methods: int, targets: int, cols: int) -> None:
    shape = (methods, targets, 25, cols)
    interferograms = Interferograms(
        tuple(f"m{i}" for i in range(methods)),
        tuple(f"t{i}" for i in range(targets)),
        *(data.draw(numbers(shape, nan=True)) for _ in range(3)),
        crossings=data.draw(numbers(shape, 0, 9)),
    )
    assert_same(interferograms, there_and_back(interferograms, tmp_path))


@few
@given(st.data(), st.integers(1, 6))
def test_camera_poses(tmp_path: Path, data: st.DataObject, frames: int) -> None:
    poses = CameraPoses(
        data.draw(times(frames)),
        data.draw(numbers((frames, 3), nan=True)),
        data.draw(numbers((frames, 3, 3), nan=True)),
    )
    assert_same(poses, there_and_back(poses, tmp_path))


@few
@given(st.data(), st.integers(2, 6))
def test_thermal_correction(tmp_path: Path, data: st.DataObject, n: int) -> None:
    correction = ThermalCorrection(
        data.draw(times(n)), *(data.draw(numbers((n, 3))) for _ in range(4)), data.draw(numbers((n, 6)))
    )
    assert_same(correction, there_and_back(correction, tmp_path))


def test_the_same_record_gives_the_same_bytes(tmp_path: Path) -> None:
    poses = CameraPoses(np.arange(3.0), np.ones((3, 3)), np.ones((3, 3, 3)))
    for name in ("a.nc", "b.nc"):
        write_dataset(poses.to_dataset(), tmp_path / name)
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()


# --- the door ---------------------------------------------------------------------------------------------------------


@given(st.permutations(range(3)), st.permutations(range(3)))
@few
def test_labels_in_another_order_are_put_right(copied: Path, axes: list[int], thermometers: list[int]) -> None:
    path = copied / "F1/imu.nc"
    before = Imu.from_file(path)
    dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    path.unlink()
    dataset.isel(axis=axes, thermometer=thermometers).to_netcdf(path, engine="h5netcdf")
    after = Imu.from_file(path)
    np.testing.assert_array_equal(after.gyro, before.gyro)
    np.testing.assert_array_equal(after.accel, before.accel)
    assert before.temperatures is not None and after.temperatures is not None
    assert_same(before.temperatures, after.temperatures)


@pytest.mark.parametrize("ned", [[2, 1, 0], [1, 0, 2]])
def test_north_east_down_in_another_order_is_put_right(ned: list[int], copied: Path) -> None:
    path = copied / "F1/gnss.nc"
    before = Gnss.from_file(path)
    dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    path.unlink()
    dataset.isel(ned=ned).to_netcdf(path, engine="h5netcdf")
    assert_same(before, Gnss.from_file(path))


def test_dimensions_in_another_order_are_put_right(copied: Path) -> None:
    path = copied / "F1/imu.nc"
    before = Imu.from_file(path)
    dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    path.unlink()
    dataset.transpose("thermometer", "axis", "time_temperature", "time").to_netcdf(path, engine="h5netcdf")
    np.testing.assert_array_equal(Imu.from_file(path).gyro, before.gyro)


def test_one_temperature_serves_all_sensors(copied: Path) -> None:
    path = copied / "F1/imu.nc"
    dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    one = dataset.temperature_accel.isel(axis=0).drop_vars("axis")
    path.unlink()
    dataset.drop_vars(["temperature_gyro", "temperature_accel", "thermometer"]).assign(temperature=one).to_netcdf(
        path, engine="h5netcdf"
    )
    temperatures = Imu.from_file(path).temperatures
    assert temperatures is not None
    assert temperatures.gyro.shape == (one.size, 3, 1)
    np.testing.assert_array_equal(temperatures.accel[:, 2], one.values)


@pytest.mark.parametrize(("unit", "spelling"), [(u, s) for u, all_ in UNIT_SPELLINGS.items() for s in all_])
def test_every_spelling_of_a_unit_is_read(unit: str, spelling: str) -> None:
    dataset = xr.Dataset({"a": (("n",), [1.0, 2.0], {"units": spelling})})
    np.testing.assert_array_equal(take(dataset, Path("x.nc"), "a", ("n",), unit), [1.0, 2.0])


@given(st.text(max_size=12))
def test_any_other_text_is_no_unit(text: str) -> None:
    dataset = xr.Dataset({"a": (("n",), [1.0, 2.0], {"units": text})})
    if text.strip() in UNIT_SPELLINGS["m s-2"]:
        return
    with pytest.raises(InputError, match="variable 'a'"):
        take(dataset, Path("x.nc"), "a", ("n",), "m s-2")


@given(st.binary(max_size=300))
@few
def test_no_bytes_make_the_reader_stumble(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file.nc"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"file\.nc: file: is not a readable"):
        open_dataset(path)


# --- campaign.yaml and instrument.yaml --------------------------------------------------------------------------------


def test_what_is_left_out_of_instrument_yaml_has_the_contracts_defaults(copied: Path) -> None:
    path = copied / "instrument.yaml"
    content = yaml.safe_load(path.read_text())
    content["mounting"].pop("imu_to_body_deg", None)
    for part, names in (
        ("camera", ("radial_k1", "latency_s")),
        ("interferometer", ("opd_quadratic_m", "fringe_tilt_m_per_row", "detector_nonlinearity")),
    ):
        for name in names:
            content[part].pop(name, None)
    path.write_text(yaml.safe_dump(content))
    instrument = read_campaign(copied).instrument
    assert instrument.camera is not None and instrument.interferometer is not None and instrument.mounting is not None
    assert (instrument.camera.radial_k1, instrument.camera.latency) == (0.0, 0.0)
    i = instrument.interferometer
    assert (i.opd_quadratic, i.fringe_tilt, i.detector_nonlinearity) == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(instrument.mounting.imu_to_body, 0.0)


def test_a_lever_arm_of_zero_is_used_with_a_warning(copied: Path) -> None:
    path = copied / "instrument.yaml"
    content = yaml.safe_load(path.read_text())
    content["mounting"]["imu_to_antenna_m"] = [0.0, 0.0, 0.0]
    path.write_text(yaml.safe_dump(content))
    (warning,) = read_campaign(copied).warnings
    assert "imu_to_antenna_m" in warning


def test_a_link_that_stays_inside_the_folder_is_allowed(copied: Path) -> None:
    (copied / "F1/imu.nc").rename(copied / "F1/raw.nc")
    (copied / "F1/imu.nc").symlink_to("raw.nc")
    assert read_campaign(copied).imu("F1").time.size > 0


@given(st.text(min_size=1, max_size=8))
@few
def test_an_id_is_letters_digits_dots_dashes_and_underscores(copied: Path, text: str) -> None:
    path = copied / "campaign.yaml"
    original = path.read_text()
    content = yaml.safe_load(original)
    content["flights"][0]["id"] = text
    path.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
    allowed = text.isascii() and all(c.isalnum() or c in "_.-" for c in text) and text.strip(".") != ""
    try:
        if allowed:
            assert read_campaign(copied).keys.flights[0].id == text
        else:
            with pytest.raises(InputError, match=r"campaign\.yaml"):
                read_campaign(copied)
    finally:
        path.write_text(original)
