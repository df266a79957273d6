"""tsmftis thermal: the thermal model by itself, without a campaign."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import xarray as xr
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from flows.cli.importing import writable
from flows.settings import load_settings
from pipeline.datasets import LABELS, open_dataset, write_dataset
from pipeline.errors import InputError
from pipeline.records import COMPENSATED, Chamber, Imu
from tsmftis.inertial import DEG_PER_H, MICRO_G

app = typer.Typer(no_args_is_help=True, help="Fit, verify and apply a thermal model of an inertial unit.")

Model = Annotated[Path, typer.Argument(metavar="MODEL", help="A thermal_model.nc of `thermal fit` or of a run.")]
Runs = Annotated[list[Path], typer.Argument(metavar="CHAMBER...", help="Static chamber runs of the campaign format.")]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting, for instance thermal.block_s=30.")
]
SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="YAML file of settings (`tsmftis settings` prints one)."),
]

# What a setting of `run` is called here, where it is no business of `fit`.
ELSEWHERE = {"thermal.method": "thermal apply --method", "thermal.verification_block_s": "thermal verify --block-s"}


@app.callback()
def _group() -> None:
    pass


@app.command("fit")
def fit(
    chambers: Runs,
    out: Annotated[Path, typer.Option("--out", metavar="MODEL", help="The model file (NetCDF-4) to write.")],
    assignments: Assignments = None,
    settings_file: SettingsFile = None,
) -> None:
    """Train on chamber runs and write the model; what each channel learnt is printed."""
    from stages import thermal

    _new_file(out, chambers)
    for assignment in assignments or []:
        key = assignment.split("=", 1)[0].strip()
        if key in ELSEWHERE:
            raise InputError("--set", key, "changes nothing about a fit", f"give it to `{ELSEWHERE[key]}`")
    settings = load_settings(settings_file, assignments or []).thermal
    result = thermal.run(_read(chambers), [], settings)
    taught = len(result.figures["training"])
    if not taught:
        raise InputError(
            ", ".join(str(path) for path in chambers),
            "temperatures",
            "teach no channel anything: " + result.notes[-1].removesuffix("."),
            "give a run in which the temperature moves",
        )
    _write(result.model.to_dataset(), out)
    table = Table(show_edge=False, header_style="bold", pad_edge=False)
    for name in ("channel", "N", "M", "γ", "noise of a block", "constant", "unit"):
        table.add_column(name, justify="left" if name in ("channel", "unit") else "right")
    for row in result.figures["training"]:
        unit, scale = ("°/h", DEG_PER_H) if str(row["channel"]).startswith("gyro") else ("µg", MICRO_G)
        constant = "–" if row["constant"] is None else f"{row['constant'] / scale:.4g}"
        noise = f"{row['noise_sigma'] / scale:.3g}"
        table.add_row(*map(str, (row["channel"], row["n"], row["m"], f"{row['gamma']:.1f}", noise, constant, unit)))
    console = Console(highlight=False, soft_wrap=True)
    Console(highlight=False, width=110).print(table)
    for note in result.notes:
        console.print(note, markup=False)
    console.print(
        f"{out}: {taught} of 6 channels, thermometers' features smoothed over {settings.smoothing_s:g} s", markup=False
    )


@app.command("verify")
def verify(
    model: Model,
    chambers: Runs,
    block_s: Annotated[
        float | None,
        typer.Option("--block-s", metavar="SECONDS", help="Means over this time (100), at least ten a run."),
    ] = None,
) -> None:
    """Hold the model against chamber runs that it has not seen: standard deviation (mean) of 100 s means of what is left."""
    from stages import thermal

    seconds = thermal.ThermalSettings().verification_block_s if block_s is None else block_s
    if not 0.0 < seconds < float("inf"):
        raise InputError("--block-s", str(block_s), "is no time", "give seconds above 0")
    known = thermal.ThermalModel.from_file(model)
    runs = [thermal.verify_run(known, chamber, seconds) for chamber in _read(chambers)]
    table = thermal.verification_table(runs)
    shown = Table(show_edge=False, header_style="bold", pad_edge=False)
    shown.add_column("method", no_wrap=True)
    for name in ("gyro x [°/h]", "y", "z", "accel x [µg]", "y", "z"):
        shown.add_column(name, justify="right", no_wrap=True)
    for method in table["gyro_std_deg_per_h"]:
        figures = [[*table[f"gyro_{k}_deg_per_h"][method], *table[f"accel_{k}_ug"][method]] for k in ("std", "mean")]
        cells = (f"{std:.4g} ({mean:.3g})" for std, mean in zip(*figures, strict=True))
        shown.add_row(method.replace("_", " "), *cells)
    # As wide as it is, also where the output goes to a file or a narrow window.
    Console(highlight=False, width=150).print(shown)
    console = Console(highlight=False, soft_wrap=True)
    console.print(
        f"standard deviation, about each run's own mean, and (mean) of means over {seconds:g} s", markup=False
    )
    for run in runs:
        farthest = float(run["distance"].max())
        where = (
            "inside the chamber's conditions" if farthest == 0.0 else f"up to {farthest:.2f} of their σ outside these"
        )
        console.print(f"{run['name']}: {len(run['raw'])} means, temperatures {where}", markup=False)
        for channel, why in run["uncompensated"].items():
            console.print(f"{run['name']}: {channel} is left uncompensated: {why}", markup=False)


@app.command("apply")
def apply(
    model: Model,
    imu: Annotated[Path, typer.Argument(metavar="IMU", help="An imu file with temperatures.")],
    out: Annotated[Path, typer.Argument(help="The compensated imu file (NetCDF-4) to write.")],
    method: Annotated[
        str, typer.Option("--method", metavar="METHOD", help="Which of the fitted methods makes the correction.")
    ] = "bayesian_rbf",
) -> None:
    """Take the modelled bias off an imu file; all else in it stays."""
    from stages import thermal

    _new_file(out, [model, imu])
    record = Imu.from_file(imu)
    if record.temperatures is None:
        raise InputError(
            imu, "temperatures", "are missing", "a thermal model needs temperature_gyro and temperature_accel"
        )
    if record.compensated_by is not None:
        raise InputError(
            imu,
            f"attribute '{COMPENSATED}'",
            f"is '{record.compensated_by}'",
            "it is compensated already: give the raw file",
        )
    known = thermal.ThermalModel.from_file(model)
    correction = known.correction(record.temperatures, method, of=record.time, where=imu)
    less = correction.taken_off(record)
    with open_dataset(imu) as source:
        dataset = source.load()
    changed = {name: _as_in(dataset[name], getattr(less, name)) for name in ("gyro", "accel")}
    _write(dataset.assign(changed).assign_attrs({COMPENSATED: model.name}), out)
    console = Console(highlight=False, soft_wrap=True)
    for name, bias, unit, scale in (
        ("gyro", correction.gyro, "°/h", DEG_PER_H),
        ("accel", correction.accel, "µg", MICRO_G),
    ):
        low, high = bias.min(axis=0) / scale, bias.max(axis=0) / scale
        ranges = ", ".join(f"{a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True))
        console.print(f"{name} bias taken off, x, y, z: {ranges} {unit}", markup=False)
    for warning in (*known.doubts, *correction.warnings):
        console.print(f"warning: {warning}", style="yellow", markup=False)
    farthest = correction.reach["chamber_distance_max"]
    where = (
        "inside the chamber's conditions"
        if farthest == 0.0
        else f"up to {farthest:.2f} of their σ outside the chamber's"
    )
    console.print(f"{out}: {record.time.size} samples; {where}", markup=False)


def _as_in(variable: xr.DataArray, values: NDArray[np.float64]) -> tuple[Any, ...]:
    """Values (time, axis x, y, z) in the variable's own order of dimensions and, where the file has labels, of axes: (dimensions,
    values, attributes)."""
    made = xr.DataArray(values, dims=("time", "axis"))
    if "axis" in variable.coords:
        order = [LABELS["axis"].index(str(label)) for label in variable["axis"].values]
        made = made.isel(axis=order)
    return variable.dims, made.transpose(*variable.dims).values, variable.attrs


def _new_file(out: Path, inputs: Sequence[Path]) -> None:
    """Raise InputError where `out` cannot be a new file, or writing it would overwrite one of the inputs."""
    writable(out)
    touched = {out.resolve(), _temporary(out).resolve()}
    for path in inputs:
        # A Zarr store is a folder: nothing is written into it either.
        if touched & {path.resolve()} or path.resolve() in out.resolve().parents:
            raise InputError(
                out, "OUT", f"would overwrite the input {path}", "give another name: inputs stay as they are"
            )


def _temporary(out: Path) -> Path:
    return out.with_name(out.name + ".tmp")


def _write(dataset: xr.Dataset, out: Path) -> None:
    write_dataset(dataset, _temporary(out))
    os.replace(_temporary(out), out)


def _read(paths: list[Path]) -> list[Chamber]:
    return [Chamber.from_file(path, path.name) for path in paths]
