"""The closed loop as a user meets it: verdict, model update, the campaign again; parts of campaigns; a second look; bad input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from tiny_campaign import tiny_campaign

from flows.loop import close, problems
from flows.loop.problems import Part
from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.model_update import read_model_update
from pipeline.records import Bench
from pipeline.residual_problem import ResidualProblem
from stages import bench as bench_stage

HEAD = {
    "format": "tsmftis-campaign/1",
    "time": {"scale": "GPS", "epoch": "2020-01-01T00:00:00Z"},
    "instrument": "instrument.yaml",
}
STEP = ("stage", "effect", "parameters", "evidence", "indistinguishable_from", "heldout_before", "heldout_after")


def bench_file(path: Path, a: float, seed: int) -> None:
    """A burst of three lines recorded by a detector with s' = s·(1 − a·s), and the spectrum of the same burst without."""
    x = (np.arange(4000) - 1500) * 3.0e-7
    signal = np.zeros(x.size)
    for centre, width, strength in ((3.0e5, 6.0e4, 1.0), (5.0e5, 3.0e4, 0.5), (6.5e5, 1.0e4, 0.2)):
        signal += strength * np.exp(-0.5 * (2 * np.pi * width * x) ** 2) * np.cos(2 * np.pi * centre * x)
    given = ("connes", "mertz", 2, 0.9 / 390e-6)
    wavenumber = np.arange(5.0e4, 8.5e5, 1.0e3)
    clean = Bench(signal[None], x, wavenumber, np.ones(wavenumber.size), *given)
    vendor = bench_stage.run(clean, bench_stage.BenchSettings()).spectrum
    signal = signal - signal.mean()
    v = signal / np.abs(signal).max()
    recorded = 1e4 * v * (1 - a * v) + 0.2 * np.random.default_rng(seed).standard_normal((2, x.size))
    write_dataset(Bench(recorded, x, wavenumber, vendor, *given).to_dataset(), path)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of three laboratory interferograms: linear, not linear, and one without a reference."""
    folder = tmp_path_factory.mktemp("laboratory")
    for name, a, seed in (("linear", 0.0, 1), ("bent", 0.03, 2), ("lonely", 0.0, 3)):
        bench_file(folder / f"{name}.nc", a, seed)
    with xr.open_dataset(folder / "lonely.nc", engine="h5netcdf") as d:
        alone = d.load().drop_vars(["reference", "wavenumber"])
    alone.to_netcdf(folder / "lonely.nc", engine="h5netcdf")
    bench = [{"id": n, "file": f"{n}.nc"} for n in ("linear", "bent", "lonely")]
    (folder / "campaign.yaml").write_text(yaml.safe_dump(HEAD | {"name": "laboratory", "bench": bench}))
    (folder / "instrument.yaml").write_text("{}\n")
    return folder


def loop_of(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "loop.json").read_text())
    assert content["schema"] == "tsmftis-loop/1" and (out / content["model_update"]).is_file()
    assert content["verdict"] in ("effects_added", "no_effect", "unexplained")
    for step in content["steps"]:
        assert set(STEP) <= set(step)
        assert all({"value", "sigma", "unit"} == set(v) for v in step["parameters"].values())
    for limit in content["not_identifiable"]:
        assert {"effects", "why", "would_separate"} <= set(limit)
    assert set(content["before"]) == set(content["after"])
    return content


def test_a_nonlinear_detector_is_found_in_the_laboratory(laboratory: Path, tmp_path: Path, tsmftis: Any) -> None:
    out = tmp_path / "loop"
    answer = tsmftis("close-loop", laboratory, "--out", out)
    assert answer.code == 0, answer.out + answer.err
    content = loop_of(out)
    (step,) = content["steps"]
    assert (step["stage"], step["effect"], step["bench"]) == ("spectral", "detector_nonlinearity", "bent")
    a = step["parameters"]["a"]
    assert abs(a["value"] - 0.03) < max(3.0 * a["sigma"], 3e-4)
    assert content["parts"]["bench-linear"]["verdict"] == "no_effect"
    assert "no reference spectrum" in content["not_examined"]["bench-lonely"]
    each = [content[when]["bench_relative_rms_each"] for when in ("before", "after")]
    assert each[1]["bent"] < 0.2 * each[0]["bent"] and each[1]["linear"] == each[0]["linear"]
    assert "detector nonlinearity" in (out / "loop.html").read_text() and "bench bent" in answer.out

    # The update reprocesses the campaign as the loop did, and touches no other interferogram.
    update = read_model_update(out / "model-update.yaml")
    assert update.effects == {} and update.bench["bent"]["detector_nonlinearity"]["a"] == a["value"]
    again = tmp_path / "again"
    assert tsmftis("run", laboratory, "--out", again, "--model-update", out / "model-update.yaml").code == 0
    runs = [json.loads((folder / "run.json").read_text())["bench"] for folder in (again, out / "after", out / "before")]
    assert runs[0] == runs[1] and runs[0]["linear"] == runs[2]["linear"]
    assert runs[0]["bent"]["relative_rms_scaled"] < 0.2 * runs[2]["bent"]["relative_rms_scaled"]

    # A second look costs nothing but looking, and says the same.
    before = {p: p.read_bytes() for p in (out / "loop.json", out / "loop.html", out / "model-update.yaml")}
    second = tsmftis("close-loop", laboratory, "--out", out)
    assert second.code == 0 and all(
        line.endswith("unchanged") for line in second.out.splitlines() if line.startswith("loop ")
    )
    assert {p: p.read_bytes() for p in before} == before


def test_a_single_interferogram_is_the_instrument(laboratory: Path, tmp_path: Path, tsmftis: Any) -> None:
    folder = Path(shutil.copytree(laboratory, tmp_path / "one"))
    content = yaml.safe_load((folder / "campaign.yaml").read_text()) | {"bench": [{"id": "bent", "file": "bent.nc"}]}
    (folder / "campaign.yaml").write_text(yaml.safe_dump(content))
    assert tsmftis("close-loop", folder, "--out", tmp_path / "loop").code == 0
    update = read_model_update(tmp_path / "loop" / "model-update.yaml")
    assert set(update.effects) == {"detector_nonlinearity"} and not update.bench


def test_undeclared_effects_of_two_stages_are_traced_and_taken_out(tmp_path: Path, tsmftis: Any) -> None:
    true = {"camera_latency": 0.012, "gnss_latency": 0.3}
    campaign = tiny_campaign(tmp_path / "tiny", 1, {name: {"latency": value} for name, value in true.items()})
    out = tmp_path / "loop"
    answer = tsmftis("close-loop", campaign, "--out", out)
    assert answer.code == 0, answer.out + answer.err
    content = loop_of(out)
    assert set(content["parts"]) == {"thermal", "navigation", "geometry", "spectral"} and not content["not_examined"]
    found = {
        step["effect"]: step["parameters"] for step in content["steps"] if step["stage"] in ("navigation", "geometry")
    }
    assert set(found) == set(true)
    for effect, value in true.items():
        latency = found[effect]["latency"]
        assert latency["unit"] == "s" and abs(latency["value"] - value) < 3.0 * latency["sigma"]
    before, after = content["before"], content["after"]
    assert after["geometry_residual_px"] < 0.5 * before["geometry_residual_px"]
    assert after["navigation_withheld_m"][0] < 0.5 * before["navigation_withheld_m"][0]
    assert after["rqe_area_tracking_mean"] < before["rqe_area_tracking_mean"]
    run = json.loads((out / "after" / "run.json").read_text())
    update = run["provenance"]["model_update"]["effects"]
    assert {name: update[name]["latency"] for name in true} == {n: found[n]["latency"]["value"] for n in true}
    assert run["rqe"]["tracking"] == pytest.approx(after["rqe_tracking_mean"], rel=0.05)


def test_chamber_runs_alone(demo: Path, tmp_path: Path, tsmftis: Any) -> None:
    folder = Path(shutil.copytree(demo, tmp_path / "chamber"))
    keys = yaml.safe_load((folder / "campaign.yaml").read_text())
    (folder / "campaign.yaml").write_text(
        yaml.safe_dump({k: v for k, v in keys.items() if k not in ("flights", "calibration", "references", "dem")})
    )
    answer = tsmftis("close-loop", folder, "--out", tmp_path / "loop")
    assert answer.code == 0, answer.out + answer.err
    content = loop_of(tmp_path / "loop")
    assert list(content["parts"]) == ["thermal"] and set(content["not_examined"]) == {
        "navigation",
        "geometry",
        "spectral",
    }
    assert len(content["before"]["thermal_gyro_std_deg_per_h"]) == 3 and "rqe_tracking_mean" not in content["before"]


def test_wrong_input_ends_in_one_line(laboratory: Path, tmp_path: Path, tsmftis: Any) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    lonely = Path(shutil.copytree(laboratory, tmp_path / "lonely"))
    keys = HEAD | {"name": "lonely", "bench": [{"id": "lonely", "file": "lonely.nc"}]}
    (lonely / "campaign.yaml").write_text(yaml.safe_dump(keys))
    for arguments, part in (
        ((laboratory, "--out", tmp_path / "run"), "holds the results of a run"),
        ((laboratory, "--out", laboratory / "loop"), "campaign's own place"),
        ((lonely, "--out", tmp_path / "out"), "nothing to look at"),
        ((laboratory, "--out", tmp_path / "out", "--set", "closed_loop.p_value=2"), "closed_loop.p_value"),
    ):
        answer = tsmftis("close-loop", *arguments)
        assert answer.code == 2 and part in answer.err and answer.err.count("\n") == 1, answer.err
    assert not (tmp_path / "out").exists()


def test_what_geometry_adds_to_an_unexplained_path_is_doubted() -> None:
    added = {"steps": [{"effect": "boresight"}], "notes": ["one"]}
    for doubted in (True, False):
        told = close._doubted(Part("geometry"), added, {"navigation": {"unexplained": doubted}})
        assert told["notes"] == ["one"] + [close.DOUBTFUL_PATH] * doubted
    assert close._doubted(Part("geometry"), added, {}) == added
    nothing = {"steps": [], "notes": []}
    assert close._doubted(Part("geometry"), nothing, {"navigation": {"unexplained": True}}) == nothing
    assert close._doubted(Part("spectral"), added, {"navigation": {"unexplained": True}}) == added


def test_a_flight_that_cannot_serve_leaves_the_others_their_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its reason is told with the answer; where no flight can, it is the answer."""
    good = ResidualProblem(
        "navigation", lambda _: np.ones(4), (), *(np.arange(4) for _ in range(2)), np.arange(4.0), np.zeros((4, 0))
    )

    def of(imu: str, **_: Any) -> ResidualProblem:
        if imu == "F2":
            raise InputError("gnss", "variable 'time'", "leaves 3 usable fixes", "record more")
        return good

    class Campaign:
        root = Path()

        def __init__(self, *names: str) -> None:
            self.keys = SimpleNamespace(
                flights=[SimpleNamespace(id=n, gnss=f"{n}.nc", imu=f"{n}-imu.nc") for n in names]
            )

        def path(self, name: str) -> Path:
            return Path(name)

    monkeypatch.setattr(problems.navigation, "residual_problem", of)
    monkeypatch.setattr(problems, "flight_of", lambda _, flight: {"imu": flight})
    plans = [SimpleNamespace(opened=Campaign(*names), effects=lambda _: {}) for names in (("F1", "F2"), ("F2",))]
    made = problems.problem_of(plans[0], Part("navigation"))  # type: ignore[arg-type]
    assert made.group.size == 4 and len(made.notes) == 1
    assert made.notes[0].startswith("flight F2 was not looked at: F2.nc: variable 'time': leaves 3")
    with pytest.raises(InputError, match="3 usable fixes"):
        problems.problem_of(plans[1], Part("navigation"))  # type: ignore[arg-type]
