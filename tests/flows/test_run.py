"""The whole chain on a tiny simulated campaign: what it writes, how good it is, and what runs again when."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.warp
import xarray as xr
import yaml

from flows.settings import load_settings
from flows.steps import STAGES, Plan
from pipeline.errors import StageError

METHODS = {"nominal", "phase", "registration", "hybrid", "tracking"}
EVERY = {"thermal@campaign", "navigation@F1"} | {
    f"{stage}@F1/{line}"
    for stage in ("tracking", "registration", "reconstruction", "mapping", "scoring")
    for line in ("L01", "L02")
}


# --- helpers ----------------------------------------------------------------------------------------------------------


def ran(campaign: Path, out: Path, *assignments: str, **options: Any) -> set[str]:
    """Run in this process; the stages that really ran, as stage@unit."""
    from flows.campaign import run_campaign

    out.mkdir(exist_ok=True)
    records = run_campaign(Plan(campaign, out, load_settings(None, list(assignments)), **options))
    assert {r.status for r in records} <= {"done"}
    return {f"{r.stage}@{r.unit}" for r in records if not r.cached}


def of_line(line: str, *stages: str) -> set[str]:
    return {f"{stage}@F1/{line}" for stage in stages or STAGES[2:7]}


def products(out: Path) -> dict[str, bytes]:
    """All files but the cache's own, run.json without its seconds."""
    found = {
        p.relative_to(out).as_posix(): p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and ".stages" not in p.parts
    }
    if "run.json" in found:
        found["run.json"] = json.dumps(without_seconds(json.loads(found["run.json"]))).encode()
    return found


def without_seconds(content: Any) -> Any:
    if isinstance(content, dict):
        return {k: without_seconds(v) for k, v in content.items() if k != "seconds"}
    return content


def different(a: Path, b: Path) -> list[str]:
    one, two = products(a), products(b)
    return sorted(name for name in one.keys() | two.keys() if one.get(name) != two.get(name))


def read(path: Path) -> xr.Dataset:
    return xr.load_dataset(path, engine="h5netcdf", decode_times=False)


def change_yaml(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def change_netcdf(path: Path, change: Callable[[xr.Dataset], Any]) -> None:
    dataset = read(path)
    change(dataset)
    path.unlink()
    dataset.to_netcdf(path, engine="h5netcdf")


@pytest.fixture
def again(demo_run: Path, tmp_path: Path) -> Path:
    """A copy of the demo's results that a test may run into."""
    return Path(shutil.copytree(demo_run, tmp_path / "out"))


@pytest.fixture(scope="module")
def result(demo_run: Path) -> dict[str, Any]:
    return json.loads((demo_run / "run.json").read_text())


# --- what the contract promises ---------------------------------------------------------------------------------------

SPECTRUM = ("method", "target", "wavenumber")
CONTRACT = {
    "F1/trajectory.nc": {
        "time": (("time",), {"s"}),
        "latitude": (("time",), {"degrees_north", "degrees"}),
        "longitude": (("time",), {"degrees_east", "degrees"}),
        "height": (("time",), {"m"}),
        "velocity": (("time", "ned"), {"m s-1"}),
        "roll": (("time",), {"degrees"}),
        "pitch": (("time",), {"degrees"}),
        "yaw": (("time",), {"degrees"}),
        "sigma_position": (("time", "ned"), {"m"}),
        "sigma_velocity": (("time", "ned"), {"m s-1"}),
        "sigma_attitude": (("time", "rpy"), {"degrees"}),
    },
    "F1/{line}/tracks.nc": {n: (("method", "target", "frame"), {"1"}) for n in ("row", "col")},
    "F1/{line}/spectra.nc": {
        "reference": (("target", "wavenumber"), {"reference radiance unit"}),
        "wavenumber": (("wavenumber",), {"m-1"}),
    }
    | {
        n: (SPECTRUM, {"reference radiance unit"})
        for n in ("radiance", "sigma_radiance", "radiance_area", "sigma_radiance_area")
    },
}


@pytest.mark.parametrize("line", ["L01", "L02"])
@pytest.mark.parametrize("file", CONTRACT)
def test_files_have_the_contracts_variables_dimensions_and_units(file: str, line: str, demo_run: Path) -> None:
    dataset = read(demo_run / file.format(line=line))
    for name, (dims, units) in CONTRACT[file].items():
        assert dataset[name].dims == dims, name
        assert dataset[name].attrs["units"] in units, name
    if "method" in dataset.dims:
        assert set(dataset.method.values) == METHODS
        assert list(dataset.target.values) == [f"{line}-1", f"{line}-2"]
    assert dataset.sizes.get("frame", 200) == 200


def test_the_scored_grid_runs_from_the_long_wavelength_in_steps_of_5000(demo_run: Path) -> None:
    wavenumber = read(demo_run / "F1/L01/spectra.nc").wavenumber.values
    np.testing.assert_allclose(wavenumber, 1e9 / 900.0 + 5000.0 * np.arange(wavenumber.size), rtol=1e-12)
    assert wavenumber[-1] <= 1e9 / 450.0 < wavenumber[-1] + 5000.0


def test_the_sbet_is_the_trajectory(demo_run: Path) -> None:
    records = np.fromfile(demo_run / "F1/trajectory.sbet", dtype="<f8").reshape(-1, 17)
    trajectory = read(demo_run / "F1/trajectory.nc")
    np.testing.assert_array_equal(records[:, 0], trajectory.time.values)
    for column, name in ((1, "latitude"), (2, "longitude"), (7, "roll"), (8, "pitch")):
        np.testing.assert_allclose(np.rad2deg(records[:, column]), trajectory[name].values, atol=1e-12)
    np.testing.assert_array_equal(records[:, 3], trajectory.height.values)


def test_the_cube_is_a_turned_utm_raster_with_a_band_a_wavenumber(demo: Path, demo_run: Path) -> None:
    spectra = read(demo_run / "F1/L01/spectra.nc")
    with rasterio.open(demo_run / "F1/L01/cube.tif") as cube:
        assert cube.crs.to_epsg() == 32651  # longitude 122.1° east, north
        assert cube.transform.b != 0.0
        assert np.isnan(cube.nodata)
        wavelength = np.array([float(d.removesuffix(" nm")) for d in cube.descriptions])
        assert wavelength.size == cube.count > 100
        assert wavelength.min() >= 450.0 and wavelength.max() <= 900.001
        # The white panel, where it was surveyed, has its spectrum: 6 m panels on cells of 0.6 m, read at the centre.
        with (demo / "F1/L01_targets.csv").open() as stream:
            white = next(csv.DictReader(stream))
        (x,), (y,) = rasterio.warp.transform(
            "EPSG:4326", cube.crs, [float(white["longitude_deg"])], [float(white["latitude_deg"])]
        )
        found = next(cube.sample([(x, y)]))
    reference = np.interp(1e9 / wavelength, spectra.wavenumber.values, spectra.reference.values[0])
    # One cell, noise and half a cell's shift: a coarse bound that a wrong place or band order would miss by far.
    assert np.linalg.norm(found - reference) < 0.15 * np.linalg.norm(reference)


def test_run_json_has_the_contracts_keys(result: dict[str, Any], demo_run: Path) -> None:
    assert result["schema"] == "tsmftis-run/1"
    assert result["campaign"] == "tiny"
    for kind in ("rqe", "rqe_area"):
        assert set(result[kind]) == METHODS
    assert set(result["partly_seen"]) <= METHODS
    for key in ("gyro_std_deg_per_h", "accel_std_ug"):
        table = result["thermal"]["verify"][key]
        assert set(table) >= {"raw", "polynomial", "rbf", "bayesian_rbf"}
        assert all(len(row) == 3 and min(row) > 0 for row in table.values())
    flight = result["flights"]["F1"]
    assert set(flight["lines"]) == {"L01", "L02"}
    for line in flight["lines"].values():
        for kind in ("rqe", "rqe_area"):
            assert set(line[kind]) == METHODS
            assert all(set(entry) == {"mean", "targets"} for entry in line[kind].values())
    assert flight["navigation"]["innovation_nis_mean"] > 0
    assert "position_residual_rms_m" in flight["navigation"]
    stages = {f"{stage}@{unit}" for stage, units in result["stages"].items() for unit in units}
    assert stages == EVERY
    for units in result["stages"].values():
        for entry in units.values():
            assert entry["status"] == "done" and entry["seconds"] >= 0 and len(entry["digest"]) == 32
    assert "provenance" in result


def test_the_report_is_one_self_contained_file(demo_run: Path) -> None:
    text = (demo_run / "report.html").read_text(encoding="utf-8")
    assert "</html>" in text
    page = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)  # plotly's own code names its makers' pages
    assert not re.search(r"<script[^>]+src=", text)
    for elsewhere in ('src="http', "src='http", "url(http", "<link"):
        assert elsewhere not in page


# --- how good it is ---------------------------------------------------------------------------------------------------


def scored_reference(campaign: Path, name: str, sigma: np.ndarray) -> np.ndarray:
    """response·B, two-sided, Connes window, transform, divided by response; shares nothing with the project."""
    calibration, references = read(campaign / "calibration.nc"), read(campaign / "references.nc")
    instrument = yaml.safe_load((campaign / "instrument.yaml").read_text())
    wavenumber, response = calibration.wavenumber.values, calibration.response.values
    radiance = np.interp(wavenumber, references.wavenumber, references.radiance.sel(reference=name))
    interferometer = instrument["interferometer"]
    columns = np.arange(instrument["camera"]["cols"]) - interferometer["zpd_col"]
    length = interferometer["opd_step_m"] * np.abs(columns).max()
    x = np.arange(-int(length / 1e-7), int(length / 1e-7) + 1) * 1e-7
    fringe = (response * radiance * np.gradient(wavenumber)) @ np.cos(2 * np.pi * np.outer(wavenumber, x))
    window = (1 - (x / length) ** 2).clip(0) ** 2
    spectrum = 2e-7 * (fringe * window) @ np.cos(2 * np.pi * np.outer(x, sigma))
    return spectrum / np.interp(sigma, wavenumber, response)


@pytest.mark.parametrize(("kind", "variable"), [("rqe", "radiance"), ("rqe_area", "radiance_area")])
def test_rqe_is_what_spectra_and_references_give(
    kind: str, variable: str, demo: Path, demo_run: Path, result: dict[str, Any]
) -> None:
    pooled: dict[str, list[float]] = {}
    for line in ("L01", "L02"):
        spectra = read(demo_run / "F1" / line / "spectra.nc")
        with (demo / f"F1/{line}_targets.csv").open() as stream:
            names = {row["id"]: row["reference"] for row in csv.DictReader(stream)}
        for target in map(str, spectra.target.values):
            reference = scored_reference(demo, names[target], spectra.wavenumber.values)
            for method in map(str, spectra.method.values):
                found = spectra[variable].sel({"method": method, "target": target}).values
                told = result["flights"]["F1"]["lines"][line][kind][method]["targets"]
                if not np.isfinite(found).all():
                    assert target not in told
                    assert f"F1/{line}/{target}" in result["partly_seen"][method]
                    continue
                rqe = np.linalg.norm(found - reference) / np.linalg.norm(reference)
                # The two integrate the reference's interferogram on different grids.
                assert told[target] == pytest.approx(rqe, abs=5e-4)
                pooled.setdefault(method, []).append(told[target])
    for method, values in pooled.items():
        assert result[kind][method] == pytest.approx(np.mean(values), rel=1e-12)


def test_tracking_beats_nominal(result: dict[str, Any]) -> None:
    """The simulated attitude wobbles by 0.1°, four pixels: straight motion cannot follow it."""
    for kind in ("rqe", "rqe_area"):
        assert result[kind]["tracking"] < 0.5 * result[kind]["nominal"]
    # 0.016 and 0.006 when this was written, of which noise is nearly all of the first.
    assert result["rqe"]["tracking"] < 0.03
    assert result["rqe_area"]["tracking"] < 0.015


def test_trajectory_agrees_with_the_truth_within_its_sigmas(demo: Path, demo_run: Path) -> None:
    truth = np.load(demo.with_name("tiny-truth") / "trajectory.npz")
    found = read(demo_run / "F1/trajectory.nc")
    inside = (truth["t"] > 5.0) & (truth["t"] < found.time.values[-1] - 3.0)
    t, llh, ypr = truth["t"][inside], truth["llh"][inside], np.rad2deg(truth["ypr"][inside])

    def at(values: np.ndarray) -> np.ndarray:
        return np.interp(t, found.time.values, values)

    radius = 6.37e6
    error = np.stack(
        [
            (np.deg2rad(at(found["latitude"].values)) - llh[:, 0]) * radius,
            (np.deg2rad(at(found["longitude"].values)) - llh[:, 1]) * radius * np.cos(llh[:, 0]),
            llh[:, 2] - at(found["height"].values),
        ]
    )
    yaw = np.rad2deg(at(np.unwrap(np.deg2rad(found["yaw"].values))))
    turn = np.stack([at(found["roll"].values) - ypr[:, 2], at(found["pitch"].values) - ypr[:, 1], yaw - ypr[:, 0]])
    turn = (turn + 180.0) % 360.0 - 180.0
    rms = np.sqrt((error**2).mean(axis=1)), np.sqrt((turn**2).mean(axis=1))
    # A minute of fixes of 2, 2, 4 cm at 5 Hz; heading is observed by one turn only.
    assert (rms[0] < [0.02, 0.02, 0.04]).all(), rms[0]
    assert (rms[1] < [0.005, 0.005, 0.05]).all(), rms[1]
    for errors, name in ((error, "sigma_position"), (turn, "sigma_attitude")):
        sigma = np.stack([at(column) for column in found[name].values.T])
        # Errors of a smoothed flight are one slow realisation, not many: up to 3 sigma an axis is no surprise.
        assert (np.sqrt(((errors / sigma) ** 2).mean(axis=1)) < 3.0).all(), name


def test_thermal_compensation_leaves_less_than_it_found(result: dict[str, Any]) -> None:
    table = result["thermal"]["verify"]["accel_std_ug"]
    assert np.mean(table["bayesian_rbf"]) < 0.7 * np.mean(table["raw"])


# --- the same input gives the same bytes ------------------------------------------------------------------------------


def test_a_second_run_into_a_fresh_folder_gives_the_same_bytes(
    demo: Path, demo_run: Path, tmp_path: Path, tsmftis: Any
) -> None:
    answer = tsmftis("run", demo, "--out", tmp_path / "out")
    assert answer.code == 0
    assert different(demo_run, tmp_path / "out") == []
    # every stage is told once, whatever thread it ran in
    told = [tuple(line.split()[:2]) for line in answer.out.split("RQE")[0].splitlines() if line.split()[0] in STAGES]
    assert sorted(f"{stage}@{unit}" for stage, unit in told) == sorted(EVERY)


def test_dask_workers_give_the_same_bytes(demo: Path, demo_run: Path, tmp_path: Path, tsmftis: Any) -> None:
    """Other processes, other numbers of threads: rounding must not hang on them."""
    answer = tsmftis("run", demo, "--out", tmp_path / "dask", "--dask", "local")
    assert answer.code == 0, answer.out + answer.err
    for name in ("F1/trajectory.nc", "F1/L01/spectra.nc", "F1/L02/cube.tif", "thermal_model.nc", "report.html"):
        assert (tmp_path / "dask" / name).read_bytes() == (demo_run / name).read_bytes(), name


def test_a_cached_run_gives_the_same_bytes(demo: Path, demo_run: Path, again: Path, tsmftis: Any) -> None:
    answer = tsmftis("run", demo, "--out", again)
    assert answer.code == 0
    assert answer.out.count("unchanged") == len(EVERY)
    assert different(demo_run, again) == []


# --- what runs again --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "least", "most"),
    [
        ("mapping.wavenumber_step_per_m=20000", {"mapping"}, {"mapping"}),
        ("reconstruction.phase_order=3", {"reconstruction"}, {"reconstruction", "mapping", "scoring"}),
        ("registration.corners=300", {"registration"}, {"registration", "reconstruction", "mapping", "scoring"}),
        ("navigation.epoch_s=0.05", {"navigation", "tracking"}, set(STAGES[1:7])),
    ],
)
def test_a_setting_runs_what_hangs_on_it(
    setting: str, least: set[str], most: set[str], demo: Path, again: Path
) -> None:
    stages = {name.split("@")[0] for name in ran(demo, again, setting)}
    assert least <= stages <= most


def brighter_frame(root: Path) -> None:
    change_netcdf(root / "F1/L01.nc", lambda d: d.frames.values.__setitem__((0, 0, 0), 999))


def brighter_reference(root: Path) -> None:
    change_netcdf(root / "references.nc", lambda d: d.radiance.values.__imul__(1.01))


def raised_dem(root: Path) -> None:
    with rasterio.open(root / "dem.tif", "r+") as dem:
        dem.write(dem.read(1) + np.float32(0.5), 1)


def warmer_verification(root: Path) -> None:
    change_netcdf(root / "chamber/verify.nc", lambda d: d.gyro.values.__imul__(1.0001))


def other_boresight(root: Path) -> None:
    change_yaml(root / "instrument.yaml", lambda c: c["mounting"]["boresight_deg"].update(yaw=0.46))


def same_again(root: Path) -> None:
    for path in root.rglob("*.*"):
        os.utime(path)


SCORED = ("reconstruction", "mapping", "scoring")


@pytest.mark.parametrize(
    ("touch", "least", "most"),
    [
        (same_again, set(), set()),
        (brighter_frame, of_line("L01", "registration", "reconstruction", "mapping"), of_line("L01")),
        (
            brighter_reference,
            {f"{s}@F1/{line}" for s in ("reconstruction", "scoring") for line in ("L01", "L02")},
            of_line("L01", *SCORED) | of_line("L02", *SCORED),
        ),
        (
            raised_dem,
            of_line("L01", "mapping") | of_line("L02", "mapping"),
            of_line("L01", "mapping") | of_line("L02", "mapping"),
        ),
        (warmer_verification, {"thermal@campaign"}, {"thermal@campaign"}),
        (
            other_boresight,
            of_line("L01", "tracking", "registration") | of_line("L02", "tracking", "registration"),
            of_line("L01") | of_line("L02"),
        ),
    ],
)
def test_a_changed_file_runs_what_depends_on_it(
    touch: Callable[[Path], None], least: set[str], most: set[str], copied: Path, again: Path
) -> None:
    touch(copied)
    assert least <= ran(copied, again) <= most


def test_a_lost_or_spoiled_output_is_made_again(demo: Path, demo_run: Path, again: Path) -> None:
    (again / "F1/L01/quicklook.png").unlink()
    spectra = again / "F1/L02/interferograms.nc"
    spectra.write_bytes(spectra.read_bytes()[:-1] + b"?")
    (again / ".stages/thermal@campaign.json").write_text("{")
    assert ran(demo, again) == {"mapping@F1/L01", "reconstruction@F1/L02", "thermal@campaign"}
    assert different(demo_run, again) == []


def test_a_run_that_broke_down_is_taken_up(
    demo: Path, demo_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tsmftis: Any
) -> None:
    def breaks(*_: Any, **__: Any) -> Any:
        raise MemoryError("on purpose")

    with monkeypatch.context() as patched:
        patched.setattr("stages.reconstruction.run", breaks)
        with pytest.raises(MemoryError):
            tsmftis("run", demo, "--out", tmp_path / "out")
    assert not (tmp_path / "out/run.json").exists()
    assert ran(demo, tmp_path / "out") == {
        f"{stage}@F1/{line}" for stage in ("reconstruction", "mapping", "scoring") for line in ("L01", "L02")
    }
    assert tsmftis("run", demo, "--out", tmp_path / "out").code == 0
    assert different(demo_run, tmp_path / "out") == []


def test_a_killed_run_is_taken_up_and_leaves_nothing_behind(
    demo: Path, demo_run: Path, tmp_path: Path, tsmftis: Any
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", "from flows.cli import main; main()", "run", str(demo), "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 240
    while not (out / ".stages/navigation@F1.json").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (out / ".stages/thermal@campaign.json").exists()
    assert not (out / "run.json").exists()
    # and what a kill in the middle of a stage leaves
    (out / ".stages/mapping@F1@L01.99999.1.tmp").mkdir()
    (out / ".stages/mapping@F1@L01.99999.1.tmp/0.tif").write_bytes(b"half")
    answer = tsmftis("run", demo, "--out", out)
    assert answer.code == 0
    assert answer.out.count("unchanged") >= 2
    assert different(demo_run, out) == []
    assert not list((out / ".stages").glob("*.tmp"))


# --- parts of a run ---------------------------------------------------------------------------------------------------


def test_only_runs_one_stage_on_the_results_that_are_there(demo: Path, demo_run: Path, again: Path) -> None:
    assert ran(demo, again, only="reconstruction") == of_line("L01", "reconstruction") | of_line(
        "L02", "reconstruction"
    )
    assert [n for n in different(demo_run, again) if n != "run.json"] == []


def test_only_keeps_the_other_scores_in_run_json(demo: Path, demo_run: Path, again: Path, tsmftis: Any) -> None:
    assert tsmftis("run", demo, "--out", again, "--only", "mapping").code == 0
    assert different(demo_run, again) == []


def test_from_runs_a_stage_and_those_after_it(demo: Path, again: Path) -> None:
    assert ran(demo, again, start="reconstruction") == of_line("L01", *SCORED) | of_line("L02", *SCORED)


def test_line_runs_one_line_and_scores_it(demo: Path, tmp_path: Path, tsmftis: Any, result: dict[str, Any]) -> None:
    answer = tsmftis("run", demo, "--out", tmp_path / "out", "--line", "L02")
    assert answer.code == 0
    content = json.loads((tmp_path / "out/run.json").read_text())
    assert list(content["flights"]["F1"]["lines"]) == ["L02"]
    assert not (tmp_path / "out/F1/L01").exists()
    assert content["rqe"]["tracking"] == result["flights"]["F1"]["lines"]["L02"]["rqe"]["tracking"]["mean"]


def test_a_line_whose_stage_fails_leaves_the_other_done(
    demo: Path, again: Path, monkeypatch: pytest.MonkeyPatch, tsmftis: Any
) -> None:
    """L02's reconstruction fails; so L01 is done, run.json says so, and no old score of L02 stands as if it were new."""
    import stages.reconstruction

    real = stages.reconstruction.run

    def fails(frames: Any, tracks: Any, *rest: Any) -> Any:
        if tracks.targets[0].startswith("L02"):
            raise StageError("line L02: no point is seen")
        return real(frames, tracks, *rest)

    monkeypatch.setattr("stages.reconstruction.run", fails)
    answer = tsmftis("run", demo, "--out", again, "--set", "reconstruction.phase_order=3")
    content = json.loads((again / "run.json").read_text())
    assert answer.code == 1
    assert "Traceback" not in answer.err
    assert content["stages"]["reconstruction"]["F1/L01"]["status"] == "done"
    assert content["stages"]["scoring"]["F1/L01"]["status"] == "done"
    failed = content["stages"]["reconstruction"]["F1/L02"]
    assert failed["status"] == "failed"
    assert failed["error"] == "line L02: no point is seen"
    for stage in ("mapping", "scoring"):
        assert content["stages"][stage].get("F1/L02", {"status": "absent"})["status"] != "done"
    assert not content["flights"]["F1"]["lines"]["L02"]["rqe"].get("tracking", {}).get("targets")
    assert (again / "report.html").is_file()


def test_a_failed_stage_ends_its_chain_and_the_next_run_takes_it_up(
    demo: Path, demo_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tsmftis: Any
) -> None:
    def fails(*_: Any, **__: Any) -> Any:
        raise StageError("the filter diverged")

    with monkeypatch.context() as patched:
        patched.setattr("stages.navigation.run", fails)
        answer = tsmftis("run", demo, "--out", tmp_path / "out")
    assert answer.code == 1
    assert "Traceback" not in answer.err
    assert json.loads((tmp_path / "out/run.json").read_text())["stages"]["navigation"]["F1"]["status"] == "failed"
    assert tsmftis("run", demo, "--out", tmp_path / "out").code == 0
    assert different(demo_run, tmp_path / "out") == []


def test_flight_and_line_flows_run_on_their_own(demo: Path, again: Path) -> None:
    from flows.campaign import run_flight, run_line

    plan = Plan(demo, again)
    assert {f"{r.stage}@{r.unit}" for r in run_line(plan, "F1", "L02")} == of_line("L02")
    flight = run_flight(plan, "F1")
    assert {f"{r.stage}@{r.unit}" for r in flight} == EVERY - {"thermal@campaign"}
    assert all(r.cached and r.status == "done" for r in flight)


# --- other campaigns --------------------------------------------------------------------------------------------------


def test_zarr_stores_give_the_same_result(copied: Path, demo_run: Path, again: Path) -> None:
    for file in ("F1/imu.nc", "F1/gnss.nc", "F1/L01.nc", "calibration.nc", "references.nc", "chamber/train.nc"):
        dataset = read(copied / file)
        (copied / file).unlink()
        dataset.to_zarr(copied / file, consolidated=False)
    assert {"thermal@campaign", "navigation@F1", "reconstruction@F1/L01"} <= ran(copied, again)
    assert [n for n in different(demo_run, again) if n not in ("run.json", "report.html")] == []


def dropped(*names: str) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for name in names:
            content.pop(name)

    return change


def run_of(campaign: Path, out: Path, tsmftis: Any) -> tuple[dict[str, Any], str]:
    answer = tsmftis("run", campaign, "--out", out)
    assert answer.code == 0, answer.out + answer.err
    assert answer.err == ""
    assert (out / "report.html").is_file()
    return json.loads((out / "run.json").read_text()), answer.out


def test_without_dem_the_ground_is_flat_at_the_targets(copied: Path, again: Path, tsmftis: Any) -> None:
    change_yaml(copied / "campaign.yaml", dropped("dem"))
    content, _ = run_of(copied, again, tsmftis)
    assert "flat" in content["flights"]["F1"]["lines"]["L01"]["mapping"]["terrain"]


def test_without_references_there_are_spectra_and_no_rqe(
    copied: Path, demo_run: Path, again: Path, tsmftis: Any
) -> None:
    change_yaml(copied / "campaign.yaml", dropped("references"))
    content, told = run_of(copied, again, tsmftis)
    assert "no references" in told
    assert not content["rqe"] and not content["rqe_area"]
    one, other = (read(folder / "F1/L01/spectra.nc") for folder in (demo_run, again))
    np.testing.assert_array_equal(one.radiance.values, other.radiance.values)
    assert np.isnan(other.reference.values).all()


def test_a_target_without_reference_is_not_scored(copied: Path, again: Path, tsmftis: Any) -> None:
    path = copied / "F1/L01_targets.csv"
    path.write_text(path.read_text().replace(",white,", ",,"))
    content, _ = run_of(copied, again, tsmftis)
    line = content["flights"]["F1"]["lines"]["L01"]
    assert list(line["rqe"]["tracking"]["targets"]) == ["L01-2"]
    assert "F1/L01/L01-1" not in content["partly_seen"].get("tracking", [])


def test_without_chamber_runs_the_report_says_that_nothing_is_compensated(
    copied: Path, again: Path, tsmftis: Any
) -> None:
    change_yaml(copied / "campaign.yaml", dropped("thermal"))
    content, told = run_of(copied, again, tsmftis)
    assert "not compensated" in told
    assert "not compensated" in (again / "report.html").read_text()
    assert "thermal" not in content and "thermal" not in content["stages"]
    assert content["rqe"]["tracking"] < 0.05


def test_without_initial_the_pipeline_aligns_itself(copied: Path, demo_run: Path, again: Path, tsmftis: Any) -> None:
    change_yaml(copied / "campaign.yaml", lambda c: c["flights"][0].pop("initial"))
    run_of(copied, again, tsmftis)
    one, other = (read(folder / "F1/trajectory.nc") for folder in (demo_run, again))
    inside = (one.time.values > 10.0) & (one.time.values < 60.0)
    # in motion, by GNSS and one turn: the heading is the weak one
    for name, tolerance in (("roll", 0.005), ("pitch", 0.005), ("yaw", 0.05)):
        found = np.interp(one.time.values, other.time.values, np.unwrap(other[name].values, period=360.0))
        assert np.abs(found - one[name].values)[inside].max() < tolerance, name


def test_without_temperatures_in_flight_the_run_goes_on(copied: Path, again: Path, tsmftis: Any) -> None:
    path = copied / "F1/imu.nc"
    dataset = read(path).drop_vars(["temperature_gyro", "temperature_accel", "time_temperature"])
    path.unlink()
    dataset.to_netcdf(path, engine="h5netcdf")
    content, told = run_of(copied, again, tsmftis)
    assert "no temperatures" in told
    assert content["flights"]["F1"]["navigation"]["compensated"] is False


def test_without_lines_only_the_trajectory_is_made(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    """Then neither camera, interferometer nor calibration is needed."""

    def change(content: dict[str, Any]) -> None:
        content["flights"][0].pop("lines")
        dropped("calibration", "references", "dem", "thermal")(content)

    change_yaml(copied / "campaign.yaml", change)
    change_yaml(copied / "instrument.yaml", dropped("camera", "interferometer"))
    content, _ = run_of(copied, tmp_path / "out", tsmftis)
    assert set(content["stages"]) == {"navigation"}
    assert (tmp_path / "out/F1/trajectory.nc").is_file()
    assert not content.get("rqe")


def test_chamber_runs_alone_are_a_campaign(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    change_yaml(copied / "campaign.yaml", dropped("flights", "calibration", "references", "dem"))
    content, _ = run_of(copied, tmp_path / "out", tsmftis)
    assert set(content["stages"]) == {"thermal"}


def test_a_bench_interferogram_alone_is_a_campaign(tmp_path: Path, tsmftis: Any) -> None:
    """A Gaussian line spectrum whose interferogram is known in closed form comes back."""
    root = tmp_path / "campaign"
    root.mkdir()
    opd = np.arange(-2000, 2001) * 3.0e-7
    width, centre = 2.0e4, 1.0e6
    interferogram = np.exp(-2.0 * (np.pi * width * opd) ** 2) * np.cos(2.0 * np.pi * centre * opd)
    xr.Dataset(
        {
            "interferogram": (("scan", "sample"), interferogram[None], {"units": "counts"}),
            "opd": (("sample",), opd, {"units": "m"}),
        }
    ).to_netcdf(root / "sample.nc", engine="h5netcdf")
    (root / "instrument.yaml").write_text("{}\n")
    (root / "campaign.yaml").write_text(
        yaml.safe_dump(
            {
                "format": "tsmftis-campaign/1",
                "name": "bench",
                "time": {"scale": "GPS", "epoch": "2013-07-14T00:00:00Z"},
                "instrument": "instrument.yaml",
                "bench": [{"id": "B1", "file": "sample.nc"}],
            }
        )
    )
    content, _ = run_of(root, tmp_path / "out", tsmftis)
    assert set(content["stages"]) == {"bench"}
    found = read(tmp_path / "out/bench/B1.nc")
    spectrum = next(v for v in found.data_vars.values() if v.dims == ("wavenumber",))
    peak = float(found.wavenumber.values[int(np.argmax(spectrum.values))])
    assert peak == pytest.approx(centre, abs=1e3)


# --- thermal compensation and truth -----------------------------------------------------------------------------------


def test_a_flight_beyond_the_chamber_and_a_dead_thermometer_are_told(copied: Path, again: Path, tsmftis: Any) -> None:
    """40 K hotter than any chamber run, and gyro x without a thermometer that moves: both on the console and in run.json."""
    path = copied / "F1" / "imu.nc"
    with xr.open_dataset(path) as d:
        dataset = d.load()
    for name in ("temperature_gyro", "temperature_accel"):
        ramp = np.linspace(55.0, 60.0, dataset[name].shape[0]).reshape(-1, *[1] * (dataset[name].ndim - 1))
        dataset[name].values[:] += ramp
    dataset["temperature_gyro"].values[:, 0, :] = 85.0
    path.unlink()
    dataset.to_netcdf(path, engine="h5netcdf")
    answer = tsmftis("run", copied, "--out", again)
    assert answer.code == 0, answer.err
    assert "gyro x" in answer.out and "beyond what the chamber runs" in answer.out
    navigation = json.loads((again / "run.json").read_text())["flights"]["F1"]["navigation"]
    assert navigation["uncompensated"] == ["gyro x"] and navigation["chamber_distance_max"] > 0.5


def test_the_method_that_compensates_is_a_choice(demo: Path, again: Path) -> None:
    """`none` takes nothing off; `polynomial` takes off what the model file's polynomial says."""
    ran(demo, again, "thermal.method=none")
    navigation = json.loads((again / "F1" / "navigation.json").read_text())["quality"]
    assert "chamber_distance_max" not in navigation
    assert "navigation@F1" in ran(demo, again, "thermal.method=polynomial")
    from stages.thermal import ThermalModel

    channel = ThermalModel.from_file(again / "thermal_model.nc").channels[0]
    coefficients = channel.predictors["polynomial"].coefficients  # type: ignore[attr-defined]
    taken, imu = read(again / "F1" / "thermal.nc"), read(demo / "F1" / "imu.nc")
    warm = (float(imu["temperature_gyro"].values[:, 0].mean()) - channel.mean[0]) / channel.scale[0]
    assert np.allclose(
        taken["gyro"].values[:, 0].mean(), np.polynomial.polynomial.polyval(warm, coefficients), rtol=0.02
    )


def test_true_poses_are_a_method_and_no_worse_than_tracking(demo: Path, again: Path, tsmftis: Any) -> None:
    """Tracks by the simulator's own poses lie within 4 sigmas of the POS's; a folder without such files is refused."""
    truth = demo.with_name(demo.name + "-truth")
    answer = tsmftis("run", demo, "--out", again, "--truth", truth)
    assert answer.code == 0, answer.err
    with xr.open_dataset(again / "F1" / "L01" / "tracks.nc") as d:
        away = np.hypot(*(d[n].sel({"method": "true"}) - d[n].sel({"method": "tracking"}) for n in ("row", "col")))
        assert 0.0 < float(away.max()) < 0.5
    assert answer.out.count("true ") >= 1
    wrong = tsmftis("run", demo, "--out", again, "--truth", demo)
    assert wrong.code == 2 and "--truth" in wrong.err and "Traceback" not in wrong.err
