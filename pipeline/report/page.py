"""report.html: assembled from run.json and the files beside it; nothing is computed here that a stage has not written."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from pipeline.campaign import Campaign
from pipeline.datasets import open_dataset
from pipeline.records import LADDER, Interferograms, Spectra, ThermalCorrection, Tracks, Trajectory
from pipeline.report import figures, maps


class Numbered:
    """Numbers the figures, so that the page's bytes do not hang on random identifiers."""

    def __init__(self) -> None:
        self.count = 0

    def html(self, figure: go.Figure) -> Markup:
        self.count += 1
        return Markup(
            figure.to_html(
                full_html=False,
                include_plotlyjs=False,
                div_id=f"figure-{self.count}",
                config={"displaylogo": False, "responsive": True},
            )
        )


def write_page(path: Path, template: str, filters: dict[str, Any], **content: Any) -> Path:
    """A self-contained page of a template of this package, by a temporary file and one rename; returns `path`."""
    here = files("pipeline.report")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= filters
    text = environment.from_string(here.joinpath(template).read_text(encoding="utf-8")).render(
        plotly=Markup(get_plotlyjs()),
        style=Markup(here.joinpath("page.css").read_text(encoding="utf-8")),
        **content,
    )
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)
    return path


def write_report(
    campaign: Campaign, out: Path, run: dict[str, Any], settings: dict[str, Any], warnings: list[str]
) -> Path:
    """Write `out`/report.html for what `run` (the content of run.json) lists; returns its path."""
    draw = Numbered()
    return write_page(
        out / "report.html",
        "page.html",
        {"figure": significant},
        run=run,
        ladder=[method for method in LADDER if method in run.get("rqe", {})],
        settings=json.dumps(settings, indent=1, sort_keys=True),
        warnings=warnings,
        thermal=_thermal(out, run, draw),
        flights=[_flight(campaign, out, f, run, draw) for f in run["flights"]],
        bench=[_bench(out, b, run, draw) for b in run["bench"]],
    )


def significant(value: Any, digits: int = 3) -> str:
    """A number for a table: `digits` significant ones, a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, int) or abs(value) >= 10**digits:
        return f"{value:.0f}"
    # Trailing zeros are kept, so that a column's numbers line up and say how well they are known.
    return f"{value:#.{digits}g}".rstrip(".")


def _thermal(out: Path, run: dict[str, Any], draw: Numbered) -> dict[str, Any] | None:
    path = out / "thermal_figures.json"
    if not run.get("thermal") or not path.exists():
        return None
    runs = json.loads(path.read_text(encoding="utf-8"))["verify"]
    shown = (
        {"gyro": draw.html(figures.thermal(runs, "gyro")), "accel": draw.html(figures.thermal(runs, "accel"))}
        if runs
        else {}
    )
    return {"figures": shown, "verify": run["thermal"]["verify"], "notes": run["thermal"].get("notes", [])}


def _flight(campaign: Campaign, out: Path, flight: str, run: dict[str, Any], draw: Numbered) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "id": flight,
        "navigation": run["flights"][flight].get("navigation"),
        "figures": {},
        "lines": [],
    }
    path = out / flight / "trajectory.nc"
    lines = [line.id for line in campaign.flight(flight).lines if line.id in run["flights"][flight]["lines"]]
    if path.exists():
        trajectory = Trajectory.from_file(path)
        spans, targets = {}, {}
        for line in lines:
            time = campaign.frames(flight, line).time
            spans[line], targets[line] = (float(time[0]), float(time[-1])), campaign.targets(flight, line)
        quality = json.loads((out / flight / "navigation.json").read_text(encoding="utf-8"))["figures"]
        entry["figures"] = {
            "map": draw.html(figures.trajectory_map(trajectory, spans, targets)),
            "attitude": draw.html(figures.attitude(trajectory, spans)),
            "quality": draw.html(figures.navigation_quality(trajectory, quality, spans)),
            "separation": draw.html(figures.separation(quality, spans)),
            "sensor_errors": draw.html(figures.sensor_errors(quality, spans)),
        }
        if (out / flight / "thermal.nc").exists() and (entry["navigation"] or {}).get("compensated"):
            taken = ThermalCorrection.from_file(out / flight / "thermal.nc")
            entry["figures"]["correction"] = draw.html(figures.correction(taken, spans))
    for line in lines:
        entry["lines"].append(_line(campaign, out, flight, line, run["flights"][flight]["lines"][line], draw))
    return entry


def _line(
    campaign: Campaign, out: Path, flight: str, line: str, scores: dict[str, Any], draw: Numbered
) -> dict[str, Any]:
    folder = out / flight / line
    entry: dict[str, Any] = {
        "id": line,
        "scores": scores,
        "figures": {},
        "quicklook": None,
        "targets": [],
        "methods": [],
    }
    if (folder / "tracks.nc").exists():
        tracks = Tracks.from_file(folder / "tracks.nc")
        entry["figures"]["tracks"] = draw.html(figures.tracks_over_frame(campaign.frames(flight, line), tracks))
        entry["notes"] = tracks.notes
    if (folder / "spectra.nc").exists():
        spectra = Spectra.from_file(folder / "spectra.nc")
        record = Interferograms.from_file(folder / "interferograms.nc")
        names = campaign.targets(flight, line).reference
        entry["figures"]["area"] = draw.html(figures.spectra(spectra, names, area=True))
        entry["figures"]["point"] = draw.html(figures.spectra(spectra, names, area=False))
        with open_dataset(folder / "interferograms.nc") as d:
            opd = d["opd"].values
        shown = int(np.argmax(record.seen[:, :, Tracks.CENTRE].sum(axis=0)))
        entry["figures"]["interferogram"] = draw.html(figures.interferogram(record, opd, shown))
        entry["interferogram_of"] = spectra.targets[shown]
        entry["targets"], entry["methods"] = spectra.targets, spectra.methods
    if scores.get("mapping") and (folder / "quicklook.png").exists():
        entry["quicklook"] = base64.b64encode((folder / "quicklook.png").read_bytes()).decode()
        dem = campaign.path(campaign.keys.dem) if campaign.keys.dem is not None else None
        entry["figures"]["map"] = draw.html(maps.over_terrain(folder / "cube.tif", dem, campaign.targets(flight, line)))
    return entry


def _bench(out: Path, bench: str, run: dict[str, Any], draw: Numbered) -> dict[str, Any]:
    entry: dict[str, Any] = {"id": bench, "summary": run["bench"][bench], "figure": None}
    path = out / "bench" / f"{bench}.nc"
    if path.exists():
        with open_dataset(path) as d:
            reference = d["reference"].values if "reference" in d else None
            entry["figure"] = draw.html(figures.bench(d["wavenumber"].values, d["spectrum"].values, reference))
    return entry
