"""Figures of the report, each from records to a plotly figure. Labels carry units; colours mean methods throughout."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from pipeline.records import Frames, Interferograms, Spectra, Targets, ThermalCorrection, Tracks, Trajectory
from tsmftis.geodesy import STANDARD_GRAVITY, local_metres
from tsmftis.inertial import DEG_PER_H, MICRO_G

Array = NDArray[np.float64]

COLOURS = {
    "nominal": "#8c8c8c",
    "phase": "#b07aa1",
    "hybrid": "#8a5a00",
    "true": "#a5d8ac",
    "registration": "#e07b00",
    "tracking": "#0b63b0",
    "reference": "#111111",
}
SENSOR = {"raw": "#8c8c8c", "polynomial": "#b07aa1", "rbf": "#e07b00", "bayesian_rbf": "#0b63b0"}
AXES = ("x", "y", "z")
NED = ("north", "east", "down")
ANGLES = ("roll", "pitch", "yaw")
PALETTE = ("#0b63b0", "#e07b00", "#3a9a4d")  # of three axes
MOST_POINTS = 1500
FAR_OFF = ("nominal", "phase")  # methods whose spectra would only hide the others


def layout(figure: go.Figure, height: int, title: str | None = None) -> go.Figure:
    """The report's one style."""
    figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 70, "r": 25, "t": 50 if title else 40, "b": 55},
        title=title,
        font={"family": "system-ui, sans-serif", "size": 13},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "xanchor": "left"},
    )
    return figure


def _stroke(method: str, width: float) -> dict[str, Any]:
    """A method's line; registration is dashed, so that tracking shows where both agree."""
    dash = {"registration": "dash", "hybrid": "dashdot"}.get(method, "solid")
    # The truth lies broad and pale beneath what should run along it.
    return {"color": COLOURS.get(method), "width": 3.0 * width if method == "true" else width, "dash": dash}


def _bottom_up(methods: tuple[str, ...]) -> list[tuple[int, str]]:
    """Methods and their places in the order of drawing."""
    return sorted(enumerate(methods), key=lambda m: m[1] != "true")


def thin(*series: Array) -> list[list[float]]:
    """Series of one length, every k-th value, so that the page stays light."""
    step = max(1, len(series[0]) // MOST_POINTS)
    return [np.round(np.asarray(s, float)[::step], 9).tolist() for s in series]


def trajectory_map(
    trajectory: Trajectory, lines: dict[str, tuple[float, float]], targets: dict[str, Targets]
) -> go.Figure:
    """Plan view about the flight's middle, its lines and targets; in metres where it is less than 2 km across."""
    origin = (
        float(np.median(trajectory.latitude)),
        float(np.median(trajectory.longitude)),
        float(np.median(trajectory.height)),
    )
    ned = local_metres(trajectory.latitude, trajectory.longitude, trajectory.height, *origin)
    unit, scale = ("m", 1.0) if np.ptp(ned[:, :2], axis=0).max() < 2000.0 else ("km", 1e-3)
    ned *= scale
    figure = go.Figure()
    along, right = thin(ned[:, 0], ned[:, 1])
    figure.add_scatter(x=right, y=along, mode="lines", name="flight", line={"color": "#777", "width": 1.5})
    triangle = {"symbol": "triangle-up", "size": 10, "color": "#777"}
    figure.add_scatter(x=right[:1], y=along[:1], mode="markers", name="start", marker=triangle)
    for name, (start, stop) in lines.items():
        inside = (trajectory.time >= start) & (trajectory.time <= stop)
        n, e = thin(ned[inside, 0], ned[inside, 1])
        figure.add_scatter(x=e, y=n, mode="lines", name=f"line {name}", line={"width": 5})
    for name, t in targets.items():
        at = scale * local_metres(t.latitude, t.longitude, t.height, *origin)
        figure.add_scatter(
            x=at[:, 1].tolist(),
            y=at[:, 0].tolist(),
            mode="markers",
            name=f"targets {name}",
            text=list(t.ids),
            marker={"symbol": "square-open", "size": 5, "color": "#111"},
        )
    north, east = np.rad2deg(origin[0]), np.rad2deg(origin[1])
    figure.update_xaxes(title=f"east [{unit}] of {north:.5f}°, {east:.5f}°")
    figure.update_yaxes(title=f"north [{unit}]", scaleanchor="x", scaleratio=1)
    return layout(figure, 520)


def attitude(trajectory: Trajectory, lines: dict[str, tuple[float, float]]) -> go.Figure:
    """Height, ground speed, roll, pitch and heading (unwrapped) over time, the lines shaded."""
    names = ("height [m]", "speed [m/s]", "roll [°]", "pitch [°]", "heading [°]")
    speed = np.hypot(trajectory.velocity[:, 0], trajectory.velocity[:, 1])
    rpy = np.rad2deg(trajectory.rpy)
    heading = np.rad2deg(np.unwrap(trajectory.rpy[:, 2]))
    figure = make_subplots(rows=5, cols=1, shared_xaxes=True, vertical_spacing=0.03)
    for i, (name, values) in enumerate(
        zip(names, (trajectory.height, speed, rpy[:, 0], rpy[:, 1], heading), strict=True), start=1
    ):
        time, y = thin(trajectory.time, values)
        figure.add_scatter(
            x=time, y=y, mode="lines", line={"color": COLOURS["tracking"], "width": 1}, showlegend=False, row=i, col=1
        )
        figure.update_yaxes(title=name, row=i, col=1)
    _shade(figure, lines)
    figure.update_xaxes(title="time [s after the epoch]", exponentformat="none", separatethousands=False, row=5, col=1)
    return layout(figure, 760)


def navigation_quality(
    trajectory: Trajectory, quality: dict[str, Any], lines: dict[str, tuple[float, float]]
) -> go.Figure:
    """Sigmas of position and attitude, smoothed and forward; fixes minus path; NIS of the fixes against its band."""
    figure = make_subplots(rows=4, cols=1, shared_xaxes=True, vertical_spacing=0.04)
    history = quality["history_time"]
    sigmas = (
        (NED, trajectory.sigma_position, "forward_sigma_position", 1),
        (ANGLES, np.rad2deg(trajectory.sigma_attitude), "forward_sigma_deg", 2),
    )
    for names, values, forward, row in sigmas:
        for i, name in enumerate(names):
            time, y = thin(trajectory.time, values[:, i])
            line = {"color": PALETTE[i], "width": 1.4}
            figure.add_scatter(x=time, y=y, name=name, legendgroup=name, line=line, row=row, col=1)
            dotted = line | {"dash": "dot", "width": 1.0}
            y = quality[f"{forward}_{name}"]
            figure.add_scatter(
                x=history,
                y=y,
                name=f"{name}, forward only",
                legendgroup=name,
                showlegend=False,
                line=dotted,
                row=row,
                col=1,
            )
    for i, name in enumerate(NED):
        for kind, symbol in (("residual", "circle"), ("withheld", "x")):
            time, y = thin(np.array(quality[f"{kind}_time"]), np.array(quality[f"{kind}_{name}"]))
            marker = {"color": PALETTE[i], "size": 3 if kind == "residual" else 6, "symbol": symbol}
            figure.add_scatter(
                x=time, y=y, mode="markers", legendgroup=name, showlegend=False, marker=marker, row=3, col=1
            )
    time, y = thin(np.array(quality["fix_time"]), np.array(quality["fix_nis_over_expected"]))
    figure.add_scatter(x=time, y=y, mode="markers", showlegend=False, marker={"color": "#999", "size": 3}, row=4, col=1)
    blocks = quality["nis_blocks"]
    _band(figure, blocks["time"], blocks["low"], blocks["high"], "95 % of a mean", 4)
    figure.add_scatter(
        x=blocks["time"], y=blocks["mean"], name="mean NIS", line={"color": "#c0392b", "width": 1.8}, row=4, col=1
    )
    for row, name in enumerate(("σ position [m]", "σ attitude [°]", "fix − path [m]", "NIS / expected [1]"), start=1):
        figure.update_yaxes(title=name, row=row, col=1)
        if row != 3:
            figure.update_yaxes(type="log", dtick=1, exponentformat="none", row=row, col=1)
    _shade(figure, lines)
    figure.update_xaxes(title="time [s after the epoch]", exponentformat="none", separatethousands=False, row=4, col=1)
    return layout(figure, 820)


def separation(quality: dict[str, Any], lines: dict[str, tuple[float, float]]) -> go.Figure:
    """Backward minus forward solution, each with the 95 % that their sigmas allow."""
    figure = make_subplots(rows=6, cols=1, shared_xaxes=True, vertical_spacing=0.025)
    time = quality["history_time"]
    for first, key, unit in ((1, "", "m"), (4, "_deg", "°")):
        for i, name in enumerate(NED):
            value, sigma = quality[f"separation{key}_{name}"], quality[f"separation_sigma{key}_{name}"]
            known = [j for j, v in enumerate(value) if v is not None]
            at = [time[j] for j in known]
            band = [1.96 * sigma[j] for j in known]
            _band(figure, at, [-b for b in band], band, "95 % by the sigmas", first + i, show=first + i == 1)
            figure.add_scatter(
                x=at,
                y=[value[j] for j in known],
                showlegend=False,
                line={"color": PALETTE[i], "width": 1.3},
                row=first + i,
                col=1,
            )
            figure.update_yaxes(title=f"{name if unit == 'm' else 'φ ' + name} [{unit}]", row=first + i, col=1)
    _shade(figure, lines)
    figure.update_xaxes(title="time [s after the epoch]", exponentformat="none", separatethousands=False, row=6, col=1)
    return layout(figure, 900)


def sensor_errors(quality: dict[str, Any], lines: dict[str, tuple[float, float]]) -> go.Figure:
    """What the filter estimates beside the path, smoothed, with one sigma either side."""
    groups = quality["parameters"]
    shown = {
        "gyro_bias": ("gyro bias [°/h]", 1.0 / DEG_PER_H),
        "accel_bias": ("accel bias [µg]", 1.0 / MICRO_G),
        "gyro_scale_factor": ("gyro scale [ppm]", 1e6),
        "accel_scale_factor": ("accel scale [ppm]", 1e6),
        "gyro_g_sensitivity": ("gyro g-sens. [°/h/g]", STANDARD_GRAVITY / DEG_PER_H),
        "antenna_lever_arm": ("lever arm [m]", 1.0),
        "gnss_latency": ("latency [ms]", 1e3),
    }
    names = [name for name in shown if name in groups]
    figure = make_subplots(rows=max(len(names), 1), cols=1, shared_xaxes=True, vertical_spacing=0.04)
    time = quality["history_time"]
    for row, name in enumerate(names, start=1):
        title, scale = shown[name]
        for i, (value, sigma) in enumerate(zip(groups[name]["value"], groups[name]["sigma"], strict=True)):
            low = [scale * (v - s) for v, s in zip(value, sigma, strict=True)]
            high = [scale * (v + s) for v, s in zip(value, sigma, strict=True)]
            colour = PALETTE[i]
            _band(figure, time, low, high, f"{AXES[i]}, ±1 σ", row, show=False, colour=colour)
            figure.add_scatter(
                x=time,
                y=[scale * v for v in value],
                name=AXES[i],
                legendgroup=AXES[i],
                showlegend=row == 1,
                line={"color": colour, "width": 1.4},
                row=row,
                col=1,
            )
        figure.update_yaxes(title=title, row=row, col=1)
    _shade(figure, lines)
    figure.update_xaxes(
        title="time [s after the epoch]", exponentformat="none", separatethousands=False, row=max(len(names), 1), col=1
    )
    return layout(figure, 120 + 180 * max(len(names), 1))


def _band(
    figure: go.Figure,
    x: list[float],
    low: list[float],
    high: list[float],
    name: str,
    row: int,
    show: bool = True,
    colour: str = "#0b63b0",
) -> None:
    """A shaded band between two curves."""
    figure.add_scatter(
        x=[*x, *x[::-1]],
        y=[*high, *low[::-1]],
        fill="toself",
        mode="none",
        fillcolor=colour,
        opacity=0.18,
        name=name,
        showlegend=show,
        hoverinfo="skip",
        row=row,
        col=1,
    )


def _shade(figure: go.Figure, lines: dict[str, tuple[float, float]]) -> None:
    for name, (start, stop) in lines.items():
        figure.add_vrect(x0=start, x1=stop, fillcolor="#ffd54d", opacity=0.35, line_width=0)
        figure.add_annotation(x=0.5 * (start + stop), y=1.0, yref="paper", yanchor="bottom", text=name, showarrow=False)


def thermal(runs: list[dict[str, Any]], sensor: str) -> go.Figure:
    """Verification runs one after the other: means of raw and compensated output per axis, with the model's 95 % band.

    Each run holds `time_s`, and of six channels (gyro x, y, z, accelerometer x, y, z) in SI `temperature_degc`, `raw`,
    `left` by method and `sigma`. Each trace is shown about its own mean, as the standard deviation of the table is.
    """
    first, unit, scale = (0, "°/h", 1.0 / DEG_PER_H) if sensor == "gyro" else (3, "µg", 1.0 / MICRO_G)
    figure = make_subplots(rows=4, cols=1, shared_xaxes=True, vertical_spacing=0.04)
    offset = 0.0
    for r, run in enumerate(runs):
        hours = (np.asarray(run["time_s"]) - run["time_s"][0]) / 3600.0 + offset
        offset = float(hours[-1]) + 0.2
        temperature = np.asarray(run["temperature_degc"])[:, first : first + 3].mean(axis=1)
        figure.add_scatter(
            x=hours.tolist(),
            y=temperature.tolist(),
            showlegend=False,
            line={"color": "#c0392b", "width": 1.2},
            row=1,
            col=1,
        )
        for axis in range(3):
            band = 1.96 * scale * np.asarray(run["sigma"])[:, first + axis]
            figure.add_scatter(
                x=np.concatenate([hours, hours[::-1]]).tolist(),
                y=np.concatenate([band, -band[::-1]]).tolist(),
                fill="toself",
                mode="none",
                fillcolor="rgba(11,99,176,0.18)",
                name="95 % by the model",
                legendgroup="band",
                showlegend=r == 0 and axis == 0,
                row=axis + 2,
                col=1,
            )
            for name in ("raw", *(n for n in ("rbf", "bayesian_rbf") if n in run["left"])):
                values = np.asarray(run["raw"] if name == "raw" else run["left"][name])[:, first + axis]
                figure.add_scatter(
                    x=hours.tolist(),
                    y=(scale * (values - values.mean())).tolist(),
                    name=name.replace("_", " "),
                    legendgroup=name,
                    showlegend=r == 0 and axis == 0,
                    line={"color": SENSOR[name], "width": 1.2},
                    row=axis + 2,
                    col=1,
                )
    figure.update_yaxes(title="T [°C]", row=1, col=1)
    for axis in range(3):
        figure.update_yaxes(title=f"{sensor} {AXES[axis]} [{unit}]", row=axis + 2, col=1)
    figure.update_xaxes(title="time in the chamber [h]", row=4, col=1)
    return layout(figure, 760)


def correction(taken: ThermalCorrection, lines: dict[str, tuple[float, float]]) -> go.Figure:
    """The bias taken off a flight's inertial data with its 95 % band, and how far its temperatures left the chamber's."""
    figure = make_subplots(rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.05)
    parts = ((taken.gyro, taken.sigma_gyro, 1.0 / DEG_PER_H), (taken.accel, taken.sigma_accel, 1.0 / MICRO_G))
    for row, (bias, sigma, scale) in enumerate(parts, start=1):
        for axis in range(3):
            time, middle = thin(taken.time, scale * bias[:, axis])
            _, low = thin(taken.time, scale * (bias - 1.96 * sigma)[:, axis])
            _, high = thin(taken.time, scale * (bias + 1.96 * sigma)[:, axis])
            figure.add_scatter(
                x=[*time, *time[::-1]],
                y=[*high, *low[::-1]],
                fill="toself",
                mode="none",
                fillcolor=PALETTE[axis],
                opacity=0.2,
                name="95 %",
                showlegend=False,
                row=row,
                col=1,
            )
            line = {"color": PALETTE[axis], "width": 1.4}
            name = AXES[axis]
            figure.add_scatter(
                x=time, y=middle, name=name, legendgroup=name, showlegend=row == 1, line=line, row=row, col=1
            )
    time, farthest = thin(taken.time, taken.distance.max(axis=1))
    line = {"color": COLOURS["nominal"], "width": 1.4}
    figure.add_scatter(x=time, y=farthest, name="farthest channel", showlegend=False, line=line, row=3, col=1)
    for row, title in enumerate(("gyro [°/h]", "accel [µg]", "outside chamber [σ]"), start=1):
        figure.update_yaxes(title=title, row=row, col=1)
    figure.update_yaxes(rangemode="tozero", row=3, col=1)
    _shade(figure, lines)
    figure.update_xaxes(title="time [s after the epoch]", exponentformat="none", separatethousands=False, row=3, col=1)
    return layout(figure, 620)


def tracks_over_frame(frames: Frames, tracks: Tracks) -> go.Figure:
    """The line's middle frame, and every method's track of every target over the detector."""
    middle = frames.time.size // 2
    step = max(1, frames.time.size // 60)
    stack = np.stack([frames.block(i, i + 1)[0] for i in range(0, frames.time.size, step)])
    flattened = frames.block(middle, middle + 1)[0] / np.maximum(np.median(stack, axis=0), 1.0)
    low, high = np.percentile(flattened, [1, 99])
    image = np.clip((flattened - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    rows, cols = image.shape
    figure = go.Figure()
    figure.add_layout_image(
        source=png(image),
        xref="x",
        yref="y",
        x=-0.5,
        y=-0.5,
        sizex=cols,
        sizey=rows,
        sizing="stretch",
        layer="below",
        xanchor="left",
        yanchor="top",
    )
    for m, method in _bottom_up(tracks.methods):
        x: list[float | None] = []
        y: list[float | None] = []
        for t in range(len(tracks.targets)):
            row, col = tracks.row[m, t, Tracks.CENTRE], tracks.col[m, t, Tracks.CENTRE]
            inside = np.isfinite(col) & (col > -1) & (col < cols) & (row > -1) & (row < rows)
            x += [*np.round(col[inside], 2).tolist(), None]
            y += [*np.round(row[inside], 2).tolist(), None]
        figure.add_scatter(x=x, y=y, mode="lines", name=method, line=_stroke(method, 1.8))
    for t, name in enumerate(tracks.targets):
        m = tracks.methods.index("tracking") if "tracking" in tracks.methods else 0
        row, col = tracks.row[m, t, Tracks.CENTRE, middle], tracks.col[m, t, Tracks.CENTRE, middle]
        if np.isfinite(row) and -0.5 <= row <= rows - 0.5 and -0.5 <= col <= cols - 0.5:
            figure.add_scatter(
                x=[float(col)],
                y=[float(row)],
                mode="markers+text",
                text=[name],
                textposition="top center",
                showlegend=False,
                marker={"symbol": "cross-thin", "size": 12, "line": {"color": "#d81b60", "width": 2}},
                textfont={"color": "#d81b60"},
            )
    figure.update_xaxes(
        title="column [px] (optical path difference runs along columns)",
        range=[-0.5, cols - 0.5],
        constrain="domain",
        showgrid=False,
    )
    figure.update_yaxes(title="row [px]", range=[rows - 0.5, -0.5], scaleanchor="x", showgrid=False)
    return layout(figure, 560)


def spectra(record: Spectra, references: tuple[str, ...], area: bool) -> go.Figure:
    """Each target's spectrum under each method with its 95 % band, against the reference at the same line shape."""
    names = record.targets
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = make_subplots(
        rows=rows,
        cols=columns,
        subplot_titles=[f"{n} ({r})" if r else n for n, r in zip(names, references, strict=True)],
        vertical_spacing=0.28 / rows,
        horizontal_spacing=0.06,
    )
    value = record.radiance_area if area else record.radiance
    sigma = record.sigma_radiance_area if area else record.sigma_radiance
    wavelength = 1e9 / record.wavenumber
    for t in range(len(names)):
        at = {"row": t // columns + 1, "col": t % columns + 1}
        if np.isfinite(record.reference[t]).all():
            figure.add_scatter(
                x=wavelength.tolist(),
                y=record.reference[t].tolist(),
                name="reference",
                legendgroup="reference",
                showlegend=t == 0,
                line={"color": COLOURS["reference"], "width": 2, "dash": "dot"},
                **at,
            )
        for m, method in _bottom_up(record.methods):
            y, s = value[m, t], 1.96 * sigma[m, t]
            if not np.isfinite(y).all() or method in FAR_OFF:
                continue
            if method == "tracking":
                figure.add_scatter(
                    x=np.concatenate([wavelength, wavelength[::-1]]).tolist(),
                    y=np.concatenate([y + s, (y - s)[::-1]]).tolist(),
                    fill="toself",
                    mode="none",
                    fillcolor="rgba(11,99,176,0.2)",
                    name="95 % (tracking)",
                    legendgroup="band",
                    showlegend=t == 0,
                    **at,
                )
            figure.add_scatter(
                x=wavelength.tolist(),
                y=y.tolist(),
                name=method,
                legendgroup=method,
                showlegend=False,
                line=_stroke(method, 1.4),
                **at,
            )
        figure.update_xaxes(title="wavelength [nm]" if t + columns >= len(names) else None, **at)
        figure.update_yaxes(title="radiance [ref. unit]" if t % columns == 0 else None, **at)
    # The first target need not have every method: the legend is given its own traces.
    for method in record.methods:
        if method not in FAR_OFF:
            figure.add_scatter(
                x=[None], y=[None], mode="lines", name=method, legendgroup=method, line=_stroke(method, 1.4)
            )
    layout(figure, 90 + 260 * rows)
    figure.update_layout(legend={"y": 1.0 + 0.18 / rows}, margin={"t": 80})
    return figure


def interferogram(record: Interferograms, opd: Array, target: int) -> go.Figure:
    """One target's centre under each method: what the columns recorded."""
    figure = make_subplots(rows=len(record.methods), cols=1, shared_xaxes=True, vertical_spacing=0.05)
    for m, method in enumerate(record.methods):
        figure.add_scatter(
            x=(opd * 1e6).tolist(),
            y=np.round(record.value[m, target, Tracks.CENTRE], 2).tolist(),
            name=method,
            line={"color": COLOURS.get(method), "width": 1.2},
            row=m + 1,
            col=1,
        )
        figure.update_yaxes(title="signal [DN]", row=m + 1, col=1)
    figure.update_xaxes(title="optical path difference [µm]", row=len(record.methods), col=1)
    return layout(figure, 170 * len(record.methods) + 80)


def bench(wavenumber: Array, spectrum: Array, reference: Array | None) -> go.Figure:
    """A laboratory spectrum over the vendor's, and their difference."""
    figure = make_subplots(
        rows=2 if reference is not None else 1,
        cols=1,
        shared_xaxes=True,
        vertical_spacing=0.06,
        row_heights=[0.7, 0.3] if reference is not None else [1.0],
    )
    cm, ours = thin(wavenumber / 100.0, spectrum)
    if reference is not None:
        _, theirs = thin(wavenumber, reference)
        figure.add_scatter(
            x=cm,
            y=theirs,
            name="reference",
            line={"color": COLOURS["reference"], "width": 3, "dash": "dot"},
            row=1,
            col=1,
        )
        scale = float(np.linalg.norm(reference)) / np.sqrt(reference.size)
        _, left = thin(wavenumber, (spectrum - reference) / scale)
        figure.add_scatter(x=cm, y=left, name="difference", line={"color": "#c0392b", "width": 1}, row=2, col=1)
        figure.update_yaxes(title="difference / RMS [1]", exponentformat="e", row=2, col=1)
    figure.add_scatter(
        x=cm, y=ours, name="reconstructed", line={"color": COLOURS["tracking"], "width": 1.2}, row=1, col=1
    )
    figure.update_yaxes(title="single-channel signal [counts]", row=1, col=1)
    figure.update_xaxes(
        title="wavenumber [cm⁻¹]",
        autorange="reversed",
        exponentformat="none",
        row=2 if reference is not None else 1,
        col=1,
    )
    return layout(figure, 520)


def png(image: NDArray[np.uint8]) -> str:
    done, data = cv2.imencode(".png", image)
    assert done
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()
