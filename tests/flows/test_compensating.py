"""tsmftis thermal fit, verify, apply: on files alone, as a laboratory uses them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr


def load(path: Path) -> xr.Dataset:
    return xr.load_dataset(path, engine="h5netcdf", decode_times=False)


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
    import json

    answer = tsmftis("thermal", "verify", model, demo / "chamber" / "verify.nc")
    assert answer.code == 0
    table = json.loads((demo_run / "run.json").read_text())["thermal"]["verify"]
    row = next(line for line in answer.out.splitlines() if line.startswith("bayesian rbf"))
    shown = [float(v) for v in row.split("│")[1:]]
    expected = [*table["gyro_std_deg_per_h"]["bayesian_rbf"], *table["accel_std_ug"]["bayesian_rbf"]]
    np.testing.assert_allclose(shown, expected, rtol=1e-3)


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
        (("apply", model, imu, imu), ("imu.nc", "imu file itself")),
    ]
    for arguments, parts in cases:
        answer = tsmftis("thermal", *arguments)
        assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
        assert all(part in answer.err for part in parts), answer.err
    assert [p.name for p in tmp_path.iterdir()] == ["bare.nc"]
