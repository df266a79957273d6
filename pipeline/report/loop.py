"""loop.html: how the loop came to its answer, for a person; all of it from loop.json, the parts' pictures and the two runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr
from numpy.typing import NDArray
from plotly.subplots import make_subplots
from scipy.stats import norm

from pipeline.datasets import open_dataset
from pipeline.report.figures import layout, thin
from pipeline.report.page import Numbered, significant, write_page
from tsmftis.geodesy import STANDARD_GRAVITY

Array = NDArray[np.float64]

COLOURS = {"before": "#8c8c8c", "after": "#0b63b0"}
BINS, EVIDENCE_BINS = 12, 16
FEWEST_A_BIN = 8
ONE_VALUE = 0.2  # share of the samples that one value of a covariate may have and still be a value of it
MOST_COVARIATES = 9
COLUMNS = 3
ORDER = ("thermal", "navigation", "geometry", "spectral")
FIGURES = (
    ("rqe_tracking_mean", "RQE of tracking, one point, mean over targets"),
    ("rqe_area_tracking_mean", "RQE of tracking, area mean, mean over targets"),
    ("geometry_residual_px", "picked points minus prediction, RMS [px]"),
    ("navigation_nis_mean", "NIS of the innovations, mean"),
    ("navigation_withheld_m", "withheld fixes, RMS, horizontal, vertical [m]"),
    ("thermal_gyro_std_deg_per_h", "gyros in the chamber, 100 s means, x, y, z [°/h]"),
    ("thermal_accel_std_ug", "accelerometers in the chamber, x, y, z [µg]"),
    ("bench_relative_rms", "bench spectrum against the reference, relative RMS after one scale"),
)


def write_loop_page(content: dict[str, Any], out: Path) -> Path:
    """Write `out`/loop.html for the content of loop.json; returns its path."""
    content = content | {"parts": {name: content["parts"][name] for name in sorted(content["parts"], key=_order)}}
    draw = Numbered()
    places = content["provenance"]["runs"]
    runs = [json.loads((out / places[when]).read_text(encoding="utf-8")) for when in COLOURS]
    shown = {}
    for name in content["parts"]:
        with open_dataset(out / "loop" / f"{name}.nc") as d:
            shown[name] = {
                "terms": {k[5:]: draw.html(evidence(d.load(), k)) for k in map(str, d) if k.startswith("term_")},
                "curves": {
                    s["effect"].removeprefix("learned:"): draw.html(curve(s["table"], s["units"], s["effect"]))
                    for s in content["parts"][name]["steps"]
                    if "table" in s
                },
                "covariates": draw.html(covariates(d.load())),
                "residual": draw.html(residual(d.load())),
            }
    return write_page(
        out / "loop.html",
        "loop.html",
        {"figure": significant, "sigmas": sigmas, "values": values},
        content=content,
        figures=[(label, content["before"][k], content["after"][k]) for k, label in FIGURES if k in content["before"]],
        held_out=[(label, k) for k, label in FIGURES if k in content["held_out"]],
        shown=shown,
        applied=[s["effect"].removeprefix("learned:") for s in content["steps"] if s.get("applied")],
        targets=draw.html(targets(*runs)) if runs[0].get("rqe") and places["before"] != places["after"] else None,
    )


def _order(part: str) -> tuple[int, str]:
    """Parts in the order of processing, laboratory interferograms last."""
    return (ORDER.index(part) if part in ORDER else len(ORDER), part)


def sigmas(p: float) -> str:
    """A p-value as the distance in sigma that a normal variate has with it, both sides."""
    return "> 37" if p < 1e-300 else f"{norm.isf(p / 2.0):.1f}"


READABLE = {  # SI unit → the field's, its factor; a time is in ms where it is short
    "rad s-1": ("°/h", np.rad2deg(3600.0)),
    "m s-2": ("µg", 1e6 / STANDARD_GRAVITY),
    "rad": ("°", np.rad2deg(1.0)),
    "rad/K": ("°/K", np.rad2deg(1.0)),
}
SHORT_S = 0.1


def values(parameters: dict[str, Any]) -> str:
    """name value ± sigma unit, of every parameter, in the field's units."""
    said = []
    for name, entry in parameters.items():
        pairs = [v if isinstance(v, list) else [v] for v in (entry["value"], entry["sigma"])]
        unit, factor = READABLE.get(entry["unit"], (entry["unit"], 1.0))
        if unit == "s" and abs(pairs[0][0]) < SHORT_S:
            unit, factor = "ms", 1e3
        told = ", ".join(f"{factor * v:.4g} ± {factor * s:.2g}" for v, s in zip(*pairs, strict=True))
        said.append(f"{name.replace('_', ' ')} {told}" + ("" if unit == "1" else f" {unit}"))
    return "; ".join(said)


def binned(x: Array, y: Array, edges: Array) -> tuple[Array, Array, Array]:
    """Mean x, mean y and the standard error of y between edges (k + 1,) → (k,); bins of too few samples are left out."""
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
    parts = [p for p in (np.flatnonzero(bins == b) for b in range(edges.size - 1)) if p.size >= FEWEST_A_BIN]
    spread = [y[part].std(ddof=1) / np.sqrt(part.size) for part in parts]
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts]), np.array(spread)


def applies(covariate: Array) -> NDArray[np.bool_]:
    """Samples that a covariate is of: where it is one channel's, the others have no value or all the same."""
    known = np.isfinite(covariate)
    value, count = np.unique(covariate[known], return_counts=True)
    if value.size > 2 and count.max() > ONE_VALUE * covariate.size:
        known &= covariate != value[count.argmax()]
    return known


def _points(figure: go.Figure, x: Array, y: Array, edges: Array, name: str, first: bool, **where: int) -> None:
    at, mean, error = binned(x, y, edges)
    figure.add_scatter(
        x=at.tolist(),
        y=mean.tolist(),
        error_y={"type": "data", "array": error.tolist(), "thickness": 1.2, "width": 2},
        mode="markers",
        marker={"color": COLOURS[name], "size": 6},
        name=name,
        legendgroup=name,
        showlegend=first,
        **where,
    )


def evidence(d: xr.Dataset, term: str) -> go.Figure:
    """Residual before and after against what the effect contributes, both free of what the model takes up."""
    unit = d["before"].attrs["units"]
    x = d[term].values
    reach = [float(x.min()), float(x.max())]
    edges = np.linspace(reach[0], reach[1], EVIDENCE_BINS + 1)
    at, _, _ = binned(x, x, edges)
    if at.size > 1:
        reach = [float(at.min() - 0.15 * np.ptp(at)), float(at.max() + 0.15 * np.ptp(at))]
    figure = go.Figure()
    figure.add_scatter(x=reach, y=reach, mode="lines", name="slope 1", line={"color": "#c0392b", "width": 1.2})
    figure.add_hline(y=0.0, line={"color": "#999", "width": 1})
    for name in COLOURS:
        _points(figure, x, d[name].values, edges, name, True)
    figure.update_xaxes(title=f"contribution of {term[5:].replace('_', ' ')} [{unit}]")
    figure.update_yaxes(title=f"residual, mean of a bin [{unit}]")
    return layout(figure, 400)


def curve(table: dict[str, list[float]], units: dict[str, str], effect: str) -> go.Figure:
    """A learned term over its covariate, both in their own units."""
    figure = go.Figure()
    figure.add_hline(y=0.0, line={"color": "#999", "width": 1})
    shades = (COLOURS["after"], "#e07b00", "#3a9a4d")
    for i, (name, y) in enumerate((k, v) for k, v in table.items() if k != "covariate"):
        figure.add_scatter(
            x=table["covariate"], y=y, mode="lines", name=name.removesuffix("_px"), line={"color": shades[i % 3]}
        )
    figure.update_xaxes(title=f"{effect.removeprefix('learned:').rsplit(' by ')[-1]}{_in(units['covariate'])}")
    figure.update_yaxes(
        title=", ".join(f"{k.removesuffix('_px')}{_in(u)}" for k, u in units.items() if k != "covariate")
    )
    figure.update_yaxes(exponentformat="e")
    return layout(figure, 340)


def _in(unit: str) -> str:
    """[unit], nothing where it is not known."""
    return f" [{unit}]" if unit else ""


def covariates(d: xr.Dataset) -> go.Figure:
    """Residual before and after, binned, against the nine covariates that it follows most; once where nothing was added."""
    shown, same = [], bool((d["before"] == d["after"]).all())
    for k in (k for k in map(str, d) if k.startswith("covariate_")):
        mine = applies(d[k].values)
        x = d[k].values[mine]
        bins = min(BINS, max(3, x.size // (2 * FEWEST_A_BIN)))
        edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, bins + 1))) if x.size else x
        if edges.size < 3:
            continue
        _, mean, error = binned(x, d["before"].values[mine], edges)
        strength = float(np.mean((mean / np.maximum(error, 1e-300)) ** 2)) if mean.size else 0.0
        shown.append((strength, k, mine, edges))
    shown = sorted(shown, key=lambda one: -one[0])[:MOST_COVARIATES]
    rows = max(1, -(-len(shown) // COLUMNS))
    figure = make_subplots(
        rows=rows,
        cols=COLUMNS,
        subplot_titles=[d[k].attrs["long_name"] + _in(d[k].attrs.get("units", "")) for _, k, _, _ in shown],
        vertical_spacing=0.3 / rows,
        horizontal_spacing=0.07,
    )
    for i, (_, k, mine, edges) in enumerate(shown):
        where = {"row": i // COLUMNS + 1, "col": i % COLUMNS + 1}
        for name in COLOURS if not same else ("after",):
            _points(figure, d[k].values[mine], d[name].values[mine], edges, name, i == 0 and not same, **where)
    figure.update_yaxes(title=f"[{d['before'].attrs['units']}]", col=1)
    figure.update_annotations(font_size=13)
    figure.update_xaxes(exponentformat="e")
    layout(figure, 130 + 210 * rows)
    figure.update_layout(margin={"t": 85}, legend={"y": 1.0 + 45.0 / (210.0 * rows)})
    return figure


def residual(d: xr.Dataset) -> go.Figure:
    """Residual before and after, sample by sample in their order, one panel a channel (six at most)."""
    channels = np.unique(d["channel"].values)[:6]
    figure = make_subplots(rows=channels.size, cols=1, shared_xaxes=True, vertical_spacing=0.03)
    for i, channel in enumerate(channels, start=1):
        mine = np.flatnonzero(d["channel"].values == channel)
        for name, colour in COLOURS.items():
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
        for run, (name, colour) in zip((first, second), COLOURS.items(), strict=True):
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
