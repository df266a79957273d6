"""tsmftis thermal: the thermal model by itself, without a campaign."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from flows.cli.importing import writable
from flows.settings import load_settings
from pipeline.datasets import open_dataset, write_dataset
from pipeline.errors import InputError
from pipeline.records import Chamber, Imu

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

    writable(out)
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
    temporary = out.with_name(out.name + ".tmp")
    write_dataset(result.model.to_dataset(), temporary)
    os.replace(temporary, out)
    table = Table(show_edge=False, header_style="bold", pad_edge=False)
    for name in ("channel", "N", "M", "γ", "noise of a block", "unit"):
        table.add_column(name, justify="left" if name in ("channel", "unit") else "right")
    for row in result.figures["training"]:
        gyro = str(row["channel"]).startswith("gyro")
        sigma = float(row["noise_sigma"]) / (thermal.DEG_PER_H if gyro else thermal.MICRO_G)
        values = (row["channel"], row["n"], row["m"], f"{row['gamma']:.1f}", f"{sigma:.3g}", "°/h" if gyro else "µg")
        table.add_row(*map(str, values))
    console = Console(highlight=False, soft_wrap=True)
    Console(highlight=False, width=110).print(table)
    for note in result.notes:
        console.print(note, markup=False)
    console.print(
        f"{out}: {taught} of 6 channels, thermometers' features smoothed over {settings.smoothing_s:g} s", markup=False
    )


@app.command("verify")
def verify(model: Model, chambers: Runs) -> None:
    """Hold the model against chamber runs that it has not seen: standard deviations of 100 s means of what is left."""
    from stages import thermal

    known = thermal.ThermalModel.from_file(model)
    table = thermal.verify(known, _read(chambers), thermal.ThermalSettings().verification_block_s)
    shown = Table(show_edge=False, header_style="bold", pad_edge=False)
    shown.add_column("method", no_wrap=True)
    for name in ("gyro x [°/h]", "y", "z", "accel x [µg]", "y", "z"):
        shown.add_column(name, justify="right", no_wrap=True)
    for method in table["gyro_std_deg_per_h"]:
        values = [*table["gyro_std_deg_per_h"][method], *table["accel_std_ug"][method]]
        shown.add_row(method.replace("_", " "), *(f"{v:.4g}" for v in values))
    # As wide as it is, also where the output goes to a file or a narrow window.
    Console(highlight=False, width=110).print(shown)


@app.command("apply")
def apply(
    model: Model,
    imu: Annotated[Path, typer.Argument(metavar="IMU", help="An imu file with temperatures.")],
    out: Annotated[Path, typer.Argument(help="The compensated imu file (NetCDF-4) to write.")],
) -> None:
    """Take the modelled bias off an imu file; all else in it stays."""
    from stages import thermal

    writable(out)
    if imu.resolve() == out.resolve():
        raise InputError(out, "OUT", "is the imu file itself", "give another name: raw data stay as they are")
    record = Imu.from_file(imu)
    if record.temperatures is None:
        raise InputError(
            imu, "temperatures", "are missing", "a thermal model needs temperature_gyro and temperature_accel"
        )
    correction = thermal.ThermalModel.from_file(model).correction(record.temperatures)
    with open_dataset(imu) as source:
        if source.attrs.get("thermally_compensated_by"):
            raise InputError(
                imu,
                "attribute 'thermally_compensated_by'",
                f"is '{source.attrs['thermally_compensated_by']}'",
                "it is compensated already: give the raw file",
            )
        dataset = source.load()
    changed: dict[str, Any] = {}
    for name, bias in (("gyro", correction.gyro), ("accel", correction.accel)):
        at = np.stack([np.interp(record.time, correction.time, bias[:, i]) for i in range(3)], 1)
        dims = dataset[name].dims
        values = getattr(record, name) - at
        changed[name] = (dims, values if dims[0] == "time" else values.T, dataset[name].attrs)
    temporary = out.with_name(out.name + ".tmp")
    write_dataset(dataset.assign(changed).assign_attrs(thermally_compensated_by=model.name), temporary)
    os.replace(temporary, out)
    console = Console(highlight=False, soft_wrap=True)
    for name, bias, unit, scale in (
        ("gyro", correction.gyro, "°/h", thermal.DEG_PER_H),
        ("accel", correction.accel, "µg", thermal.MICRO_G),
    ):
        low, high = bias.min(axis=0) / scale, bias.max(axis=0) / scale
        ranges = ", ".join(f"{a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True))
        console.print(f"{name} bias taken off, x, y, z: {ranges} {unit}", markup=False)
    farthest = float(correction.distance.max())
    where = (
        "inside the chamber's conditions"
        if farthest == 0.0
        else f"up to {farthest:.2f} of their σ outside the chamber's"
    )
    console.print(f"{out}: {record.time.size} samples; {where}", markup=False)


def _read(paths: list[Path]) -> list[Chamber]:
    return [Chamber.from_file(path, path.name) for path in paths]
