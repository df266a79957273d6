"""tsmftis import and export of trajectories, the event file, and model updates, as a user calls them."""

from __future__ import annotations

import csv
import json
import os
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml

from pipeline.formats import sbet, smrmsg
from pipeline.model_update import ModelUpdate, read_model_update, write_model_update
from pipeline.records import Trajectory

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "data" / "sbet"
KML = "{http://www.opengis.net/kml/2.2}"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_csv_holds_the_trajectory_with_units_and_sigmas(demo_run: Path, tmp_path: Path, tsmftis: Any) -> None:
    source, out = demo_run / "F1" / "trajectory.nc", tmp_path / "path.csv"
    answer = tsmftis("export", "csv", source, out, "--rate", 2)
    assert answer.code == 0 and "path.csv" in answer.out
    table, whole = rows(out), Trajectory.from_file(source)
    step = np.diff([float(r["time_s"]) for r in table])
    np.testing.assert_allclose(step[:-1], 0.5, atol=0.006)  # the last sample is always there
    at = int(np.argmin(np.abs(whole.time - float(table[7]["time_s"]))))
    for name, value in (
        ("latitude_deg", np.rad2deg(whole.latitude[at])),
        ("height_m", whole.height[at]),
        ("velocity_down_m_per_s", whole.velocity[at, 2]),
        ("pitch_deg", np.rad2deg(whole.rpy[at, 1])),
        ("sigma_yaw_deg", np.rad2deg(whole.sigma_attitude[at, 2])),
    ):
        assert float(table[7][name]) == pytest.approx(value, abs=1e-4), name


def test_kml_is_a_path_that_another_reader_understands(demo_run: Path, tmp_path: Path, tsmftis: Any) -> None:
    source, out = demo_run / "F1" / "trajectory.nc", tmp_path / "path.kml"
    assert tsmftis("export", "kml", source, out).code == 0
    line = ET.parse(out).getroot().find(f".//{KML}LineString/{KML}coordinates")
    assert line is not None and line.text is not None
    points = np.array([[float(v) for v in p.split(",")] for p in line.text.split()])
    whole = Trajectory.from_file(source)
    assert len(points) == pytest.approx(np.ptp(whole.time), abs=2)
    np.testing.assert_allclose(
        points[0], [*np.rad2deg([whole.longitude[0], whole.latitude[0]]), whole.height[0]], atol=1e-3
    )


def test_an_exported_sbet_and_smrmsg_come_back(demo_run: Path, tmp_path: Path, tsmftis: Any) -> None:
    """Out and in again: position to 1e-12 rad, attitude and inertial data to 1e-9, sigmas linear between equal stamps."""
    source = demo_run / "F1" / "trajectory.nc"
    assert tsmftis("export", "sbet", source, tmp_path / "a.sbet").code == 0
    a, b = (sbet.read_sbet(path) for path in (tmp_path / "a.sbet", demo_run / "F1" / "trajectory.sbet"))
    for name in sbet.DTYPE.names or ():
        np.testing.assert_allclose(a[name], b[name], rtol=1e-12, atol=1e-12, err_msg=name)
    assert tsmftis("export", "smrmsg", source, tmp_path / "a.smrmsg", "--rate", 1).code == 0
    answer = tsmftis("import", "sbet", tmp_path / "a.sbet", tmp_path / "a.nc", "--smrmsg", tmp_path / "a.smrmsg")
    assert answer.code == 0 and "sigmas included" in answer.out
    first, second = Trajectory.from_file(source), Trajectory.from_file(tmp_path / "a.nc")
    np.testing.assert_allclose(second.latitude, first.latitude, atol=1e-12)
    np.testing.assert_allclose(second.rate, first.rate, atol=1e-9)
    np.testing.assert_allclose(second.specific_force, first.specific_force, atol=1e-9)
    seconds = slice(None, None, 100)
    np.testing.assert_allclose(second.sigma_attitude[seconds], first.sigma_attitude[seconds], rtol=0.01)


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"measured SBET files are not in {SHARED}")
def test_a_real_sbet_is_imported_and_exported_as_it_was(tmp_path: Path, tsmftis: Any) -> None:
    """Its wander angle is turned out of the frame, all else is the same: position bit for bit, velocity to 1e-9 m/s."""
    real = SHARED / "leeward_sbet_200rec.out"
    answer = tsmftis("import", "sbet", real, tmp_path / "real.nc")
    assert answer.code == 0 and "not known" in answer.out
    assert tsmftis("export", "sbet", tmp_path / "real.nc", tmp_path / "again.sbet").code == 0
    a, b = sbet.read_sbet(real), sbet.read_sbet(tmp_path / "again.sbet")
    np.testing.assert_allclose(a["latitude"], b["latitude"], atol=1e-14)
    np.testing.assert_allclose(sbet.velocity_ned(a), sbet.velocity_ned(b), atol=1e-9)
    np.testing.assert_allclose(sbet.heading(a), sbet.heading(b), atol=1e-12)
    for axis in "xyz":
        np.testing.assert_allclose(a[f"acceleration_{axis}"], b[f"acceleration_{axis}"], atol=1e-9)
    refused = tsmftis("export", "smrmsg", tmp_path / "real.nc", tmp_path / "x.smrmsg")
    assert refused.code == 2 and "--smrmsg" in refused.err and not (tmp_path / "x.smrmsg").exists()
    assert tsmftis("export", "csv", tmp_path / "real.nc", tmp_path / "x.csv").code == 0
    assert rows(tmp_path / "x.csv")[0]["sigma_north_m"] == ""


def test_the_event_file_has_a_pose_and_sigma_for_each_frame(demo: Path, demo_run: Path) -> None:
    table = rows(demo_run / "F1" / "L01" / "events.csv")
    with xr.open_dataset(demo / "F1" / "L01.nc", engine="h5netcdf", decode_times=False) as d:
        stamps = d["time"].values
    assert [int(r["frame"]) for r in table] == list(range(stamps.size))
    np.testing.assert_allclose([float(r["time_s"]) for r in table], stamps, atol=1e-6)
    whole = Trajectory.from_file(demo_run / "F1" / "trajectory.nc")
    for name, values in (("height_m", whole.height), ("roll_deg", np.rad2deg(whole.rpy[:, 0]))):
        expected = np.interp(stamps, whole.time, values)
        np.testing.assert_allclose([float(r[name]) for r in table], expected, atol=0.01)
    assert all(0 < float(r["sigma_roll_deg"]) < 0.1 and 0 < float(r["sigma_north_m"]) < 0.1 for r in table)


def update(folder: Path, effects: Any, **more: Any) -> Path:
    path = folder / "update.yaml"
    path.write_text(yaml.safe_dump({"format": "tsmftis-model-update/1", "effects": effects} | more))
    return path


def test_a_model_update_reprocesses_with_the_effect(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    """Fixes stamped 30 ms late: the update puts NIS back to what it was, only what hangs on navigation runs again."""
    (copied / "campaign.yaml").write_text(
        yaml.safe_dump(
            {**(content := yaml.safe_load((copied / "campaign.yaml").read_text())), "flights": [
                {**content["flights"][0], "lines": []}]}
        )
    )  # fmt: skip
    out = tmp_path / "out"

    def nis() -> float:
        return float(json.loads((out / "run.json").read_text())["flights"]["F1"]["navigation"]["innovation_nis_mean"])

    assert tsmftis("run", copied, "--out", out).code == 0
    honest = nis()
    path = copied / "F1" / "gnss.nc"
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as d:
        late = d.load().assign_coords(time=d["time"] + 0.03)
    late["time"].attrs["units"] = "s"
    path.unlink()
    late.to_netcdf(path, engine="h5netcdf")
    assert tsmftis("run", copied, "--out", out).code == 0
    assert nis() > 2.0 * honest
    answer = tsmftis(
        "run", copied, "--out", out, "--model-update", update(tmp_path, {"gnss_latency": {"latency": 0.03}})
    )
    assert answer.code == 0 and "ran 1 of" in answer.out
    assert nis() == pytest.approx(honest, rel=0.02)
    content = json.loads((out / "run.json").read_text())
    assert content["provenance"]["model_update"] == {"effects": {"gnss_latency": {"latency": 0.03}}}


def test_a_model_update_reaches_every_stage_that_it_concerns(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    """One effect of each stage, one line; later less of them: what does not hang on the change is not done again."""
    out, line = tmp_path / "out", ("--line", "L01")
    effects = {
        "thermal_hysteresis": {"half_width": 4.0, "gyro": [1e-7, -1e-7, 0.0]},
        "camera_latency": {"latency": 1e-3},
        "boresight_thermal_drift": {"pitch": 1e-5},
        "fringe_tilt": {"tilt": 1e-9},
        "dem_bias": {"height": 3.0},
    }
    answer = tsmftis("run", demo, "--out", out, *line, "--model-update", update(tmp_path, effects))
    assert answer.code == 0, answer.err
    content = json.loads((out / "run.json").read_text())["provenance"]["model_update"]["effects"]
    assert content["thermal_hysteresis"] == {"half_width": 4.0, "gyro": [1e-7, -1e-7, 0.0], "accel": [0.0, 0.0, 0.0]}
    assert "half_width 4.00" in (out / "report.html").read_text()
    answer = tsmftis("run", demo, "--out", out, *line, "--model-update", update(tmp_path, effects | {"dem_bias": {}}))
    assert answer.code == 0 and "ran 1 of" in answer.out
    effects["dem_bias"] = {}
    less = {k: v for k, v in effects.items() if k != "fringe_tilt"}
    answer = tsmftis("run", demo, "--out", out, *line, "--model-update", update(tmp_path, less))
    done = {row.split()[0] for row in answer.out.splitlines() if row.endswith(" s")}
    assert answer.code == 0 and done == {"reconstruction", "scoring", "mapping"}, answer.out
    with xr.open_dataset(out / "F1" / "L01" / "poses.nc", engine="h5netcdf", decode_times=False) as d:
        np.testing.assert_allclose(np.diff(d["time"].values), 0.01, atol=1e-9)
        stamps = xr.open_dataset(demo / "F1" / "L01.nc", engine="h5netcdf", decode_times=False)["time"].values
        np.testing.assert_allclose(stamps - d["time"].values, 1e-3, atol=1e-9)


def test_an_update_is_read_as_it_was_written(tmp_path: Path) -> None:
    given = ModelUpdate(
        {"thermal_hysteresis": {"half_width": 6.0, "gyro": (1e-7, 0.0, -1e-7), "accel": (0.0, 0.0, 0.0)}},
        {"mct": {"detector_nonlinearity": {"a": -0.015}}, "dtgs": {}},
        (
            {
                "stage": "thermal",
                "covariate": "time",
                "covariate_unit": "s",
                "unit": "rad s-1",
                "table": {"covariate": [0, 9.5], "value": [0.0, 1e-7]},
            },
        ),
        {"F1": {"velocity_lag_s": 0.04}},
    )
    assert given.velocity_lag("F1") == 0.04 and given.velocity_lag("F2") == 0.0
    write_model_update(given, tmp_path / "update.yaml")
    assert read_model_update(tmp_path / "update.yaml") == given
    write_model_update(ModelUpdate(), tmp_path / "none.yaml")
    assert (tmp_path / "none.yaml").read_text() == "format: tsmftis-model-update/1\neffects: {}\n"


@pytest.mark.parametrize(
    ("effects", "more", "parts"),
    [
        ({"colour": {"x": 1.0}}, {}, ("effects.colour", "no known effect")),
        ({"gnss_latency": {"delay": 1.0}}, {}, ("effects.gnss_latency.delay", "no parameter", "latency")),
        ({"gnss_latency": {"latency": "soon"}}, {}, ("effects.gnss_latency.latency", "'soon'", "[s]")),
        ({"gnss_latency": 0.04}, {}, ("effects.gnss_latency", "holds no parameters")),
        ({"camera_latency": {"latency": 7.0}}, {}, ("effects.camera_latency.latency", "more than 5 s")),
        ({"thermal_hysteresis": {"half_width": 5.0, "gyro": 1e-7}}, {}, ("thermal_hysteresis.gyro", "list of three")),
        (
            {"thermal_hysteresis": {"half_width": 5.0, "gyro": [1e-7, 0.0, True]}},
            {},
            ("thermal_hysteresis.gyro", "[rad s-1]"),
        ),
        ({"thermal_hysteresis": {"gyro": [1e-7, 0.0, 0.0]}}, {}, ("thermal_hysteresis.half_width", "less than 0.01 K")),
        ({"thermal_lag": {"lag": -3}}, {}, ("thermal_lag.lag", "less than 0 s")),
        (["gnss_latency"], {}, ("effects", "holds no keys")),
        ({}, {"format": "other"}, ("format", "tsmftis-model-update/1")),
        ({"learned:time": {}}, {}, ("effects.learned:time", "under learned")),
        ({}, {"bench": [1]}, ("bench", "holds no keys")),
        (
            {},
            {"bench": {"mct": {"detector_nonlinearity": {"b": 1.0}}}},
            ("bench.mct.detector_nonlinearity.b", "no parameter"),
        ),
        ({}, {"learned": [{"stage": "thermal"}]}, ("learned[0]", "covariate, unit, table")),
        (
            {},
            {"learned": [{"stage": "x", "covariate": "y", "unit": "1", "table": {"covariate": [1], "value": []}}]},
            ("learned[0].table", "of one length"),
        ),
        (
            {},
            {
                "learned": [
                    {"stage": "x", "covariate": "y", "unit": "1", "table": {"covariate": [1, 1], "value": [0, 1]}}
                ]
            },
            ("learned[0].table.covariate", "does not increase"),
        ),
        (
            {},
            {
                "learned": [
                    {
                        "stage": "x",
                        "covariate": "y",
                        "unit": "1",
                        "table": {"covariate": [1.0, float("nan")], "value": [0, 1]},
                    }
                ]
            },
            ("learned[0].table", "lists of numbers"),
        ),
        ({}, {"receiver": {"F1": 0.04}}, ("receiver", "velocity_lag_s")),
        ({}, {"receiver": {"F1": {"velocity_lag_s": "late"}}}, ("receiver.F1.velocity_lag_s", "'late'", "2 at most")),
        ({}, {"colour": 1}, ("colour", "not known")),
    ],
)
def test_a_wrong_model_update_ends_in_one_line(
    effects: Any, more: dict[str, Any], parts: tuple[str, ...], demo: Path, tmp_path: Path, tsmftis: Any
) -> None:
    path = update(tmp_path, effects, **more)
    answer = tsmftis("run", demo, "--out", tmp_path / "out", "--model-update", path)
    assert answer.code == 2 and answer.err.count("\n") == 1
    assert "update.yaml" in answer.err and all(part in answer.err for part in parts), answer.err
    assert not (tmp_path / "out").exists()


def test_wrong_files_of_import_and_export_end_in_one_line(demo_run: Path, tmp_path: Path, tsmftis: Any) -> None:
    trajectory = demo_run / "F1" / "trajectory.nc"
    cases = [
        (("export", "csv", tmp_path / "none.nc", tmp_path / "a.csv"), ("none.nc", "does not exist")),
        (("export", "csv", demo_run / "F1" / "L01" / "tracks.nc", tmp_path / "a.csv"), ("tracks.nc",)),
        (("export", "kml", trajectory, tmp_path / "no" / "a.kml"), ("a.kml", "existing folder")),
        (("export", "csv", trajectory, trajectory), ("trajectory itself",)),
        (("import", "sbet", trajectory, tmp_path / "a.nc"), ("trajectory.nc",)),
        (("import", "sbet", tmp_path / "none.sbet", tmp_path / "a.nc"), ("none.sbet", "cannot be read")),
    ]
    for arguments, parts in cases:
        answer = tsmftis(*arguments)
        assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
        assert all(part in answer.err for part in parts), answer.err
    assert list(tmp_path.iterdir()) == []


def test_smrmsg_is_ten_doubles() -> None:
    assert smrmsg.DTYPE.itemsize == 80
