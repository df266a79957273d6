"""tsmftis thermal fit, verify, apply: on files alone, as a laboratory uses them."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr


def load(path: Path) -> xr.Dataset:
    return xr.load_dataset(path, engine="h5netcdf", decode_times=False)


def write(dataset: xr.Dataset, path: Path) -> Path:
    path.unlink(missing_ok=True)
    dataset.to_netcdf(path, engine="h5netcdf")
    return path


@pytest.fixture(scope="module")
def model(demo: Path, tmp_path_factory: pytest.TempPathFactory, tsmftis: Any) -> Path:
    out = tmp_path_factory.mktemp("thermal") / "model.nc"
    answer = tsmftis("thermal", "fit", demo / "chamber" / "train.nc", "--out", out)
    assert answer.code == 0, answer.err
    assert "gyro_x" in answer.out and "°/h" in answer.out and "Trained on N =" in answer.out
    return out


def test_a_model_alone_is_that_of_a_run(model: Path, demo_run: Path) -> None:
    """The same bytes of every number as the campaign's thermal stage writes."""
    alone, of_run = load(model), load(demo_run / "thermal_model.nc")
    xr.testing.assert_identical(alone, of_run)


def test_verify_prints_the_figures_of_the_run(model: Path, demo: Path, demo_run: Path, tsmftis: Any) -> None:
    answer = tsmftis("thermal", "verify", model, demo / "chamber" / "verify.nc")
    assert answer.code == 0
    table = json.loads((demo_run / "run.json").read_text())["thermal"]["verify"]
    row = next(line for line in answer.out.splitlines() if line.startswith("bayesian rbf"))
    shown = [[float(v) for v in re.findall(r"[-+.\de]+", cell)] for cell in row.split("│")[1:]]
    for kind, values, digits in (("std", [v[0] for v in shown], 1e-3), ("mean", [v[1] for v in shown], 1e-2)):
        expected = [*table[f"gyro_{kind}_deg_per_h"]["bayesian_rbf"], *table[f"accel_{kind}_ug"]["bayesian_rbf"]]
        np.testing.assert_allclose(values, expected, rtol=digits)


def test_verify_tells_extrapolation_and_dead_channels_and_wants_ten_blocks(
    model: Path, demo: Path, tmp_path: Path, tsmftis: Any
) -> None:
    chamber = load(demo / "chamber" / "verify.nc")
    inside = tsmftis("thermal", "verify", model, demo / "chamber" / "verify.nc")
    assert re.search(r"verify\.nc: \d+ means, temperatures (inside the chamber's|up to 0\.[01]\d of)", inside.out)
    assert "uncompensated" not in inside.out
    for name in ("temperature_gyro", "temperature_accel"):
        chamber[name].values[:] += 30.0
    chamber["temperature_gyro"].values[:, 1, 2] = 21.0
    write(chamber, tmp_path / "warm.nc")
    answer = tsmftis("thermal", "verify", model, tmp_path / "warm.nc")
    assert re.search(r"warm\.nc: \d+ means, temperatures up to \d+\.\d\d of their σ outside", answer.out)
    assert "gyro_y is left uncompensated: the shell thermometer does not move" in answer.out
    longer = tsmftis("thermal", "verify", model, demo / "chamber" / "verify.nc", "--block-s", "50")
    assert longer.code == 0 and longer.out != inside.out and "means over 50 s" in longer.out
    write(chamber.isel(time=slice(0, chamber.time.size // 4)), tmp_path / "short.nc")
    short = tsmftis("thermal", "verify", model, tmp_path / "short.nc", "--block-s", "1000")
    assert short.code == 2 and "short.nc" in short.err and "10 are needed" in short.err
    for seconds in ("0", "-3", "nan", "inf"):
        assert tsmftis("thermal", "verify", model, demo / "chamber" / "verify.nc", "--block-s", seconds).code == 2


def test_apply_takes_off_what_the_run_takes_off(
    model: Path, demo: Path, demo_run: Path, tmp_path: Path, tsmftis: Any
) -> None:
    out = tmp_path / "imu.nc"
    answer = tsmftis("thermal", "apply", model, demo / "F1" / "imu.nc", out)
    assert answer.code == 0 and "bias taken off" in answer.out
    raw, compensated, correction = load(demo / "F1" / "imu.nc"), load(out), load(demo_run / "F1" / "thermal.nc")
    for name in ("gyro", "accel"):
        taken = (raw[name] - compensated[name]).values
        at = np.stack(
            [np.interp(raw["time"], correction["time"], correction[name].values[:, i]) for i in range(3)], axis=1
        )
        np.testing.assert_allclose(taken, at, atol=1e-12)
    assert set(compensated.variables) == set(raw.variables)
    twice = tsmftis("thermal", "apply", model, out, tmp_path / "twice.nc")
    assert twice.code == 2 and "compensated already" in twice.err and not (tmp_path / "twice.nc").exists()


def test_wrong_files_end_in_one_line(model: Path, demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    imu, chamber = demo / "F1" / "imu.nc", demo / "chamber" / "train.nc"
    bare = tmp_path / "bare.nc"
    load(imu).drop_vars(["temperature_gyro", "temperature_accel"]).to_netcdf(bare, engine="h5netcdf")
    cases = [
        (("fit", tmp_path / "none.nc", "--out", tmp_path / "m.nc"), ("none.nc", "does not exist")),
        (("fit", imu, "--out", tmp_path / "m.nc"), ("imu.nc", "temperature_gyro")),
        (("fit", chamber, "--out", tmp_path / "no" / "m.nc"), ("m.nc", "existing folder")),
        (("fit", chamber, "--out", tmp_path / "m.nc", "--set", "thermal.colour=1"), ("thermal.colour", "not known")),
        (("verify", chamber, chamber), ("train.nc", "schema")),
        (("apply", model, bare, tmp_path / "o.nc"), ("bare.nc", "temperatures", "missing")),
        (
            ("apply", model, imu, tmp_path / "o.nc", "--method", "rbff"),
            ("model.nc", "rbff", "polynomial", "bayesian_rbf"),
        ),
        (("fit", chamber, "--out", tmp_path / "m.nc", "--set", "thermal.method=none"), ("thermal.method", "--method")),
        (
            ("fit", chamber, "--out", tmp_path / "m.nc", "--set", "thermal.verification_block_s=9"),
            ("verification_block_s", "--block-s"),
        ),
    ]
    for arguments, parts in cases:
        answer = tsmftis("thermal", *arguments)
        assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
        assert all(part in answer.err for part in parts), answer.err
    assert [p.name for p in tmp_path.iterdir()] == ["bare.nc"]


def test_no_command_overwrites_what_it_reads(model: Path, demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    """Chamber runs, model and imu file stay: by another spelling, through a link, or where the temporary file is theirs."""
    chamber, known, imu = (tmp_path / n for n in ("own.nc", "m.nc", "imu.nc"))
    for source, path in ((demo / "chamber" / "train.nc", chamber), (model, known), (demo / "F1" / "imu.nc", imu)):
        shutil.copy(source, path)
    shutil.copy(chamber, tmp_path / "new.nc.tmp")
    (tmp_path / "link.nc").symlink_to(chamber)
    store = tmp_path / "store.zarr"
    load(imu).to_zarr(store)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    cases = [
        ("fit", chamber, "--out", chamber),
        ("fit", demo / "chamber" / "train.nc", chamber, "--out", tmp_path / "." / "own.nc"),
        ("fit", tmp_path / "link.nc", "--out", chamber),
        ("fit", tmp_path / "new.nc.tmp", "--out", tmp_path / "new.nc"),
        ("apply", known, imu, known),
        ("apply", known, imu, imu),
        ("apply", known, store, store / "o.nc"),
    ]
    for arguments in cases:
        answer = tsmftis("thermal", *arguments)
        assert answer.code == 2 and answer.err.count("\n") == 1 and "would overwrite the input" in answer.err, arguments
        assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("labels", [True, False], ids=["labels", "no labels"])
def test_apply_subtracts_by_label(model: Path, demo: Path, tmp_path: Path, tsmftis: Any, labels: bool) -> None:
    """Axes z, x, y and (axis, time) in the file: the same axes and order come out, each less its own bias."""
    plain = load(demo / "F1" / "imu.nc")
    if "axis" not in plain.coords:
        plain = plain.assign_coords(axis=["x", "y", "z"])
    if labels:
        turned = plain.isel(axis=[2, 0, 1]).transpose("thermometer", "axis", "time_temperature", "time")
    else:
        turned = plain.drop_vars("axis").transpose("thermometer", "axis", "time_temperature", "time")
    for name, dataset in (("plain", plain), ("turned", turned)):
        answer = tsmftis(
            "thermal", "apply", model, write(dataset, tmp_path / f"{name}.nc"), tmp_path / f"{name}-out.nc"
        )
        assert answer.code == 0, answer.err
    one, other = (load(tmp_path / f"{name}-out.nc") for name in ("plain", "turned"))
    assert other["gyro"].dims == ("axis", "time") and other["gyro"].attrs["units"] == "rad s-1"
    for name in ("gyro", "accel"):
        assert np.abs(one[name] - plain[name]).max() > 0.0
        expected = one[name].sel(axis=["z", "x", "y"]) if labels else one[name]
        np.testing.assert_array_equal(other[name].transpose("time", "axis").values, expected.values)
    if labels:
        assert list(other["axis"].values) == ["z", "x", "y"]


def test_apply_by_a_method_and_what_it_warns_of(model: Path, demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    """Another method takes off something else; a dead thermometer, heat beyond the chamber and missing readings are told."""
    imu = demo / "F1" / "imu.nc"
    outs = {}
    for method in ("bayesian_rbf", "polynomial"):
        answer = tsmftis("thermal", "apply", model, imu, tmp_path / f"{method}.nc", "--method", method)
        assert answer.code == 0 and not re.search("uncompensated|cover", answer.out)
        outs[method] = load(tmp_path / f"{method}.nc")
    assert np.abs(outs["bayesian_rbf"]["gyro"] - outs["polynomial"]["gyro"]).max() > 0.0
    spoiled = load(imu)
    for name in ("temperature_gyro", "temperature_accel"):
        steps = spoiled[name].shape[0]
        spoiled[name].values[:] += np.linspace(55.0, 60.0, steps).reshape(-1, *[1] * (spoiled[name].ndim - 1))
    spoiled["temperature_gyro"].values[:, 0] = 85.0
    spoiled = spoiled.isel(time_temperature=spoiled.time_temperature.values < spoiled.time.values[0] + 45.0)
    told = tsmftis("thermal", "apply", model, write(spoiled, tmp_path / "hot.nc"), tmp_path / "o.nc").out
    assert re.search(r"warning: left uncompensated.*gyro x", told)
    assert re.search(r"warning: temperatures go up to .* beyond what the chamber runs taught.*wider sigma", told)
    assert re.search(r"warning: the thermometers do not cover 2\d s", told)
    other = load(imu)
    other = other.assign_coords(time_temperature=other["time_temperature"] + 1e6)
    other["time_temperature"].attrs["units"] = "s"
    answer = tsmftis("thermal", "apply", model, write(other, tmp_path / "clock.nc"), tmp_path / "p.nc")
    assert answer.code == 2 and "clock.nc" in answer.err and "in common" in answer.err


def test_a_compensated_file_is_not_compensated_again_by_a_run(
    model: Path, copied: Path, tmp_path: Path, tsmftis: Any
) -> None:
    path = copied / "F1" / "imu.nc"
    assert tsmftis("thermal", "apply", model, path, tmp_path / "imu.nc").code == 0
    shutil.copy(tmp_path / "imu.nc", path)
    told = tsmftis("inspect", copied)
    assert told.code == 0 and "compensated already, by model.nc" in told.out
    answer = tsmftis("run", copied, "--out", tmp_path / "out", "--only", "thermal")
    assert answer.code == 0
    answer = tsmftis("run", copied, "--out", tmp_path / "out", "--only", "navigation")
    assert answer.code == 0, answer.err
    navigation = json.loads((tmp_path / "out" / "run.json").read_text())["flights"]["F1"]["navigation"]
    assert navigation["compensated"] is False and not (tmp_path / "out" / "F1" / "thermal.nc").exists()
    assert any("compensated already, by model.nc" in w for w in navigation["warnings"])


def test_a_run_and_inspect_tell_of_missing_readings(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    path = copied / "F1" / "imu.nc"
    imu = load(path)
    write(imu.isel(time_temperature=imu.time_temperature.values < imu.time.values[0] + 45.0), path)
    told = tsmftis("inspect", copied)
    assert told.code == 0 and re.search(r"thermometers do not cover 2\d of 6\d s", told.out)
    for stage in ("thermal", "navigation"):
        answer = tsmftis("run", copied, "--out", tmp_path / "out", "--only", stage)
        assert answer.code == 0, answer.err
    navigation = json.loads((tmp_path / "out" / "run.json").read_text())["flights"]["F1"]["navigation"]
    assert navigation["thermometers_missing_s"] > 20.0
    assert any("thermometers do not cover" in w for w in navigation["warnings"])


def test_a_wrong_attitude_is_warned_of_by_run_and_apply(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    """The chamber's yaw half a turn off: 19 °/h would be taken off the flight; `fit` prints the level."""
    path = copied / "chamber" / "train.nc"
    chamber = load(path)
    write(chamber.assign_attrs(yaw_deg=chamber.attrs["yaw_deg"] + 180.0), path)
    answer = tsmftis("run", copied, "--out", tmp_path / "out", "--only", "thermal")
    assert answer.code == 0, answer.err
    assert tsmftis("run", copied, "--out", tmp_path / "out", "--only", "navigation").code == 0
    content = json.loads((tmp_path / "out" / "run.json").read_text())
    said = [n for n in content["thermal"]["notes"] if n.startswith("Warning")]
    assert len(said) == 1 and "gyro_x" in said[0] and "yaw_deg" in said[0]
    assert any("yaw_deg" in w for w in content["flights"]["F1"]["navigation"]["warnings"])
    applied = tsmftis(
        "thermal", "apply", tmp_path / "out" / "thermal_model.nc", copied / "F1" / "imu.nc", tmp_path / "o.nc"
    )
    assert applied.code == 0 and "yaw_deg" in applied.out
    fitted = tsmftis("thermal", "fit", path, "--out", tmp_path / "m.nc")
    assert "constant" in fitted.out and re.search(r"the mean bias is -?\d\d?\.\d+, ", fitted.out)
