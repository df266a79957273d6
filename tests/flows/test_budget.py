"""tsmftis budget: what it writes, that it starts from the run's own results, and what it says where it cannot tell."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

SIGMAS = ("navigation, its σ", "gyro noise in a pass", "boresight σ", "latency σ", "target height σ")


def strictly(path: Path) -> Any:
    """JSON without NaN or infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in {path.name}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.fixture(scope="module")
def out(demo: Path, demo_run: Path, tmp_path_factory: pytest.TempPathFactory, tsmftis: Any) -> Path:
    """The budget of the demo with its truth, in a copy of its run."""
    folder = Path(shutil.copytree(demo_run, tmp_path_factory.mktemp("budget") / "out"))
    answer = tsmftis(
        "budget", demo, "--out", folder, "--truth", demo.with_name("tiny-truth"), "--set", "budget.draws=4"
    )
    assert answer.code == 0, answer.out + answer.err
    assert "Error budget of tiny" in answer.out and "navigation          F1                unchanged" not in answer.out
    assert answer.out.count("unchanged") == 12  # the base is the run that was there
    return folder


@pytest.fixture(scope="module")
def content(out: Path) -> dict[str, Any]:
    return strictly(out / "budget.json")


def test_the_base_is_the_run(content: dict[str, Any], out: Path) -> None:
    run = strictly(out / "run.json")
    for kind, key in (("point", "rqe"), ("area", "rqe_area")):
        assert content["total"][kind]["rqe"] == pytest.approx(run[key]["tracking"], rel=1e-4)
        scored = {
            f"F1/{line}/{target}": value
            for line, entry in run["flights"]["F1"]["lines"].items()
            for target, value in entry[key]["tracking"]["targets"].items()
        }
        found = {name: v["rqe"] for name, v in content["total"][kind]["targets"].items()}
        assert found == pytest.approx(scored, rel=1e-3)


def test_every_part_has_figures(content: dict[str, Any]) -> None:
    rows = {row["part"]: row for row in content["rows"]}
    for name in ("thermal compensation off", "true poses instead", *SIGMAS):
        row = rows[name]
        assert row["cannot_tell"] is None
        assert all(value is not None for value in row["pixels_rms"].values())
        for kind in ("point", "area"):
            assert row[kind]["rqe"] == pytest.approx(content["total"][kind]["rqe"] + row[kind]["rqe_change"])
            assert row[kind]["share_upper"] is not None and row[kind]["targets"] == 4
    assert [name for name, row in rows.items() if row["adds"]] == list(SIGMAS)
    terrain = rows["terrain model off"]
    assert terrain["pixels_rms"]["col"] > 0.0 and terrain["point"]["rqe"] is None


def test_small_displacements_change_spectra_as_noise_does(content: dict[str, Any]) -> None:
    """Half a pixel of another place on an even panel is the noise of other pixels: the weights must foretell it."""
    row = next(row for row in content["rows"] if row["part"] == "navigation, its σ")["point"]
    assert row["change_rms"] == pytest.approx(row["noise_in_change_rms"], rel=0.3)


def test_control_points_find_no_boresight_where_none_is_hidden(content: dict[str, Any]) -> None:
    control = content["control"]
    assert control["points"] == 12
    for angle, sigma in zip(control["boresight_deg"].values(), control["boresight_sigma_deg"].values(), strict=True):
        assert abs(angle) < 4.0 * sigma


def test_csv_and_page_hold_the_same(content: dict[str, Any], out: Path) -> None:
    with (out / "budget.csv").open(encoding="utf-8") as stream:
        table = {line["part"]: line for line in csv.DictReader(stream)}
    for row in content["rows"]:
        line = table[row["part"]]
        expected = row["pixels_rms"]["row"]
        assert line["row_rms_px"] == ("" if expected is None else f"{expected:.6g}")
    assert float(table["rqe (rms)"]["area_share"]) == pytest.approx(content["total"]["area"]["rqe_rms"], rel=1e-5)
    page = (out / "budget.html").read_text(encoding="utf-8")
    assert "Plotly.newPlot" in page and 'src="http' not in page and "NaN" not in page.split("figure-1")[-1]


def test_again_nothing_is_computed(demo: Path, out: Path, content: dict[str, Any], tsmftis: Any) -> None:
    truth = demo.with_name("tiny-truth")
    answer = tsmftis("budget", demo, "--out", out, "--truth", truth, "--set", "budget.draws=4")
    assert answer.code == 0 and answer.out.count("unchanged") == 13
    assert strictly(out / "budget.json") == content


def test_what_is_missing_is_said(copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    """No chamber, no references, no terrain model, no control points: rows say why, pixels are there."""

    def strip(keys: dict[str, Any]) -> None:
        for key in ("thermal", "references", "dem"):
            keys.pop(key)
        lines = keys["flights"][0]["lines"]
        del lines[1:]
        lines[0].pop("gcps")

    change(copied / "campaign.yaml", strip)
    found = tmp_path / "found"
    answer = tsmftis("budget", copied, "--out", found, "--set", "budget.draws=2", "--set", "budget.latency_sigma_ms=1")
    assert answer.code == 0, answer.err
    content = strictly(found / "budget.json")
    rows = {row["part"]: row for row in content["rows"]}
    for name, why in (
        ("thermal compensation off", "no chamber run"),
        ("true poses instead", "--truth"),
        ("terrain model off", "no terrain model"),
    ):
        assert why in rows[name]["cannot_tell"] and f"{name}: cannot tell" in answer.out
    assert "assumed, since there are no ground control points" in rows["latency σ"]["done"]
    assert content["control"] is None and content["total"]["point"]["rqe"] is None
    for name in SIGMAS:
        assert rows[name]["pixels_rms"]["col"] > 0.0 and rows[name]["point"]["rqe"] is None
        assert rows[name]["point"]["share_upper"] is not None


def test_wrong_input_ends_in_one_line(demo: Path, copied: Path, tmp_path: Path, tsmftis: Any) -> None:
    change(copied / "campaign.yaml", lambda keys: keys["flights"][0].update(lines=[]))
    out = tmp_path / "o"
    cases: list[tuple[tuple[object, ...], tuple[str, ...]]] = [
        ((copied, "--out", out), ("flights[].lines", "no line")),
        ((demo, "--out", out, "--line", "L07"), ("--line", "L07", "L01")),
        ((demo, "--out", out, "--truth", tmp_path), ("--truth", "npz")),
        ((demo, "--out", demo / "o"), ("--out", "campaign's own place")),
        ((demo, "--out", demo / "campaign.yaml"), ("--out", "is a file")),
        ((demo, "--out", out, "--set", "budget.draws=1"), ("budget.draws", "greater than or equal to 2")),
    ]
    for arguments, parts in cases:
        answer = tsmftis("budget", *arguments)
        assert answer.code == 2 and answer.err.count("\n") == 1, answer.out + answer.err
        assert all(part in answer.err for part in parts), answer.err
    assert not out.exists()


def change(path: Path, how: Callable[[dict[str, Any]], Any]) -> None:
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    how(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
