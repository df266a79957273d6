"""budget.html: the error budget as one figure and its table, self-contained; all numbers come from the content of budget.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from markupsafe import Markup
from plotly.subplots import make_subplots

from pipeline.report.figures import layout
from pipeline.report.page import write_page

ROW, COL = "#0b63b0", "#e07b00"
POINT, AREA = "#8c8c8c", "#0b63b0"
SMALLEST_PX = 1e-4  # what is smaller is drawn there
SMALLEST_SHARE = 1e-5
PIXELS = (
    ("row", "rows", ROW, "circle"),
    ("col", "columns", COL, "square"),
    ("row_varying", "rows, within a pass", ROW, "circle-open"),
    ("col_varying", "columns, within a pass", COL, "square-open"),
)
KINDS = (("point", "one point", POINT), ("area", "area mean", AREA))


def write_budget_page(content: dict[str, Any], path: Path) -> None:
    """Write the page for the content of budget.json."""
    shown = figure(content).to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id="figure-1",
        config={"displaylogo": False, "responsive": True},
    )
    write_page(path, "budget.html", {"number": number, "share": share}, content=content, figure=Markup(shown))


def number(value: float | None, digits: int = 2) -> str:
    """A number of `digits` significant ones in plain notation, a dash for none; below a thousandth in powers."""
    if value is None:
        return "–"
    if value == 0.0:
        return "0"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def share(entry: dict[str, Any]) -> str:
    """A share, or < its upper bound where it is not told from noise."""
    if entry["share"] is not None:
        return number(entry["share"])
    return "–" if entry["share_upper"] is None else f"< {number(entry['share_upper'])}"


def _marker(colour: str, symbol: str) -> dict[str, Any]:
    return {"color": colour, "symbol": symbol, "size": 10, "line": {"width": 2 if symbol.endswith("open") else 0}}


def figure(content: dict[str, Any]) -> go.Figure:
    """Pixels (left) and shares of the spectra (right) of each part, on logarithmic axes; noise and base as the last rows."""
    rows = content["rows"]
    names = [row["part"] for row in rows]
    totals = [("noise", "noise_rms"), ("RQE of the base", "rqe_rms"), ("√(base² − noise²)", "left_rms")]
    made = make_subplots(
        rows=1,
        cols=2,
        shared_yaxes=True,
        horizontal_spacing=0.03,
        subplot_titles=("displacement of the tracks", "change of the spectra, noise taken off"),
    )
    for key, label, colour, symbol in PIXELS:
        values = [row["pixels_rms"][key] for row in rows]
        made.add_scatter(
            x=[max(v, SMALLEST_PX) if v else None for v in values],
            y=names,
            mode="markers",
            name=label,
            marker=_marker(colour, symbol),
            row=1,
            col=1,
        )
    for kind, label, colour in KINDS:
        known = [(row["part"], row[kind]["share"]) for row in rows if row[kind]["share"] is not None]
        known += [(n, content["total"][kind][k]) for n, k in totals if content["total"][kind][k] is not None]
        bounds = [
            (row["part"], row[kind]["share_upper"])
            for row in rows
            if row[kind]["share"] is None and row[kind]["share_upper"] is not None
        ]
        if content["total"][kind]["left_rms"] is None and content["total"][kind]["left_upper"] is not None:
            bounds.append((totals[2][0], content["total"][kind]["left_upper"]))
        for points, symbol, said in ((known, "diamond", label), (bounds, "triangle-left-open", f"{label}, at most")):
            made.add_scatter(
                x=[max(v, SMALLEST_SHARE) for _, v in points] or [None],
                y=[n for n, _ in points] or [None],
                mode="markers",
                name=said,
                marker=_marker(colour, symbol),
                row=1,
                col=2,
            )
    made.update_xaxes(type="log", dtick=1, exponentformat="none", showgrid=True)
    made.update_xaxes(title="rms [px]", row=1, col=1)
    made.update_xaxes(title="‖B′ − B‖ / ‖B_ref‖, rms over targets [1]", row=1, col=2)
    order = [*names, *(n for n, _ in totals)]
    made.update_yaxes(categoryorder="array", categoryarray=order[::-1], range=[-0.6, len(order) - 0.4])
    made.add_hline(y=len(totals) - 0.5, line={"color": "#999", "width": 1})
    layout(made, 130 + 36 * len(order))
    made.update_layout(margin={"l": 190, "t": 105}, legend={"y": 1.08})
    return made
