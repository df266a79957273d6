"""loop.html: how the loop came to its answer, for a person; all of it from loop.json, the parts' pictures and the two runs."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots
from scipy.stats import norm

from pipeline.datasets import open_dataset
from pipeline.report.figures import layout, thin
from pipeline.report.page import Numbered, significant

Array = NDArray[np.float64]

BEFORE, AFTER = "#8c8c8c", "#0b63b0"
BINS = 12
FEWEST_A_BIN = 8
MOST_COVARIATES = 9
COLUMNS = 3
FIGURES = (
    ("rqe_tracking_mean", "RQE of tracking, one point, mean over targets"),
    ("rqe_area_tracking_mean", "RQE of tracking, area mean, mean over targets"),
    ("geometry_residual_px", "picked points minus prediction, RMS [px]"),
    ("navigation_nis_mean", "NIS of the innovations, mean"),
    ("thermal_gyro_std_deg_per_h", "gyros in the chamber, 100 s means, x, y, z [°/h]"),
    ("thermal_accel_std_ug", "accelerometers in the chamber, x, y, z [µg]"),
    ("bench_relative_rms", "bench spectrum against the reference, relative RMS after one scale"),
)


def write_loop_page(content: dict[str, Any], out: Path) -> Path:
    """Write `out`/loop.html for the content of loop.json; returns its path."""
    draw = Numbered()
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"figure": significant, "sigmas": sigmas, "values": values}
    template = environment.from_string(files("pipeline.report").joinpath("loop.html").read_text(encoding="utf-8"))
    runs = [json.loads((out / path).read_text(encoding="utf-8")) for path in content["provenance"]["runs"].values()]
    shown = {}
    for name in content["parts"]:
        with open_dataset(out / "loop" / f"{name}.nc") as d:
            shown[name] = {
                "terms": {k[5:]: draw.html(evidence(d.load(), k)) for k in map(str, d) if k.startswith("term_")},
                "covariates": draw.html(covariates(d.load())),
                "residual": draw.html(residual(d.load())),
            }
    text = template.render(
        content=content,
        figures=[(label, content["before"][k], content["after"][k]) for k, label in FIGURES if k in content["before"]],
        shown=shown,
        targets=draw.html(targets(*runs)) if runs[0].get("rqe") and len({*map(json.dumps, runs)}) > 1 else None,
        plotly=Markup(get_plotlyjs()),
        style=Markup(files("pipeline.report").joinpath("page.css").read_text(encoding="utf-8")),
    )
    path = out / "loop.html"
    temporary = path.with_name("loop.html.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)
    return path


def sigmas(p: float) -> str:
    """A p-value as the distance in sigma that a normal variate has with it, both sides."""
    return "> 37" if p < 1e-300 else f"{norm.isf(p / 2.0):.1f}"


def values(parameters: dict[str, Any]) -> str:
    """name value ± sigma unit, of every parameter."""
    said = []
    for name, entry in parameters.items():
        pairs = zip(*([v] if not isinstance(v, list) else v for v in (entry["value"], entry["sigma"])), strict=True)
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        said.append(f"{name} " + ", ".join(f"{v:.4g} ± {s:.2g}" for v, s in pairs) + unit)
    return "; ".join(said)


def binned(x: Array, y: Array, bins: int = BINS) -> tuple[Array, Array, Array]:
    """Mean x, mean y and the standard error of y in bins of equally many samples (k,); bins of too few are left out."""
    order = np.argsort(x, kind="stable")
    parts = [part for part in np.array_split(order, bins) if part.size >= FEWEST_A_BIN]
    spread = [y[part].std(ddof=1) / np.sqrt(part.size) for part in parts]
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts]), np.array(spread)


def _points(figure: go.Figure, x: Array, y: Array, name: str, colour: str, first: bool, **where: int) -> None:
    at, mean, error = binned(x, y)
    figure.add_scatter(
        x=at.tolist(),
        y=mean.tolist(),
        error_y={"type": "data", "array": error.tolist(), "thickness": 1.2, "width": 2},
        mode="markers",
        marker={"color": colour, "size": 6},
        name=name,
        legendgroup=name,
        showlegend=first,
        **where,
    )


def evidence(d: xr.Dataset, term: str) -> go.Figure:
    """Residual before and after against what the effect contributes, both free of what the model takes up."""
    unit = d["before"].attrs["units"]
    x = d[term].values
    figure = go.Figure()
    reach = [float(x.min()), float(x.max())]
    figure.add_scatter(x=reach, y=reach, mode="lines", name="slope 1", line={"color": "#c0392b", "width": 1.2})
    figure.add_hline(y=0.0, line={"color": "#999", "width": 1})
    _points(figure, x, d["before"].values, "before", BEFORE, True)
    _points(figure, x, d["after"].values, "after", AFTER, True)
    figure.update_xaxes(title=f"contribution of {term[5:].replace('_', ' ')} [{unit}]")
    figure.update_yaxes(title=f"residual, mean of a bin [{unit}]")
    return layout(figure, 400)


def covariates(d: xr.Dataset) -> go.Figure:
    """Residual before and after, binned, against each covariate."""
    names = [k for k in d if str(k).startswith("covariate_")][:MOST_COVARIATES]
    rows = max(1, -(-len(names) // COLUMNS))
    figure = make_subplots(
        rows=rows, cols=COLUMNS, subplot_titles=[d[k].attrs["long_name"] for k in names], vertical_spacing=0.16 / rows
    )
    for i, k in enumerate(names):
        where = {"row": i // COLUMNS + 1, "col": i % COLUMNS + 1}
        for name, colour in (("before", BEFORE), ("after", AFTER)):
            _points(figure, d[k].values, d[name].values, name, colour, i == 0, **where)
    unit = d["before"].attrs["units"]
    figure.update_yaxes(title=f"[{unit}]", col=1)
    return layout(figure, 90 + 200 * rows)


def residual(d: xr.Dataset) -> go.Figure:
    """Residual before and after, sample by sample in their order, one panel a channel (six at most)."""
    channels = np.unique(d["channel"].values)[:6]
    figure = make_subplots(rows=channels.size, cols=1, shared_xaxes=True, vertical_spacing=0.03)
    for i, channel in enumerate(channels, start=1):
        mine = np.flatnonzero(d["channel"].values == channel)
        for name, colour in (("before", BEFORE), ("after", AFTER)):
            at, y = thin(np.arange(mine.size, dtype=float), d[name].values[mine])
            figure.add_scattergl(
                x=at,
                y=y,
                mode="markers",
                marker={"color": colour, "size": 3, "opacity": 0.6},
                name=name,
                legendgroup=name,
                showlegend=i == 1,
                row=i,
                col=1,
            )
        figure.update_yaxes(
            title=f"channel {channel}" if channels.size > 1 else d["before"].attrs["units"], row=i, col=1
        )
    figure.update_xaxes(title="sample, in the order of the series", row=channels.size, col=1)
    return layout(figure, 110 + 130 * channels.size)


def targets(first: dict[str, Any], second: dict[str, Any]) -> go.Figure:
    """RQE of every target under tracking, in the run before and the run after; one point and area mean."""
    figure = make_subplots(
        rows=1, cols=2, shared_yaxes=True, subplot_titles=("one point", "area mean"), horizontal_spacing=0.04
    )
    for col, kind in enumerate(("rqe", "rqe_area"), start=1):
        for run, name, colour in ((first, "before", BEFORE), (second, "after", AFTER)):
            scores = {
                f"{f}/{i} {t}": v
                for f, flight in run["flights"].items()
                for i, line in flight["lines"].items()
                for t, v in line[kind].get("tracking", {}).get("targets", {}).items()
            }
            figure.add_scatter(
                x=list(scores.values()),
                y=list(scores),
                mode="markers",
                marker={"color": colour, "size": 9},
                name=name,
                legendgroup=name,
                showlegend=col == 1,
                row=1,
                col=col,
            )
    figure.update_xaxes(title="RQE", rangemode="tozero")
    figure.update_yaxes(autorange="reversed")
    return layout(figure, 140 + 22 * len(figure.data[0].y or ()))
