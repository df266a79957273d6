"""tsmftis export: a trajectory into other programs' files."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from flows.cli.importing import writable
from pipeline.datasets import open_dataset
from pipeline.errors import InputError
from pipeline.records import Trajectory

app = typer.Typer(no_args_is_help=True, help="Turn a trajectory.nc into other programs' files.")

Source = Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="A trajectory.nc of a run, or of `import sbet`.")]
Out = Annotated[Path, typer.Argument(help="The file to write.")]
Rate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", min=1e-3, help="Samples a second; default: as they are.")
]


@app.callback()
def _group() -> None:
    pass


@app.command("csv")
def export_csv(trajectory: Source, out: Out, rate: Rate = None) -> None:
    """Write position, velocity, attitude and their sigmas as CSV, units in the header."""
    from pipeline.formats.table import write_csv

    _export(trajectory, out, rate, write_csv)


@app.command("kml")
def export_kml(trajectory: Source, out: Out, rate: Rate = 1.0) -> None:
    """Write the path as KML (heights above the ellipsoid), one sample a second unless --rate says otherwise."""
    from pipeline.formats.table import write_kml

    _export(trajectory, out, rate, lambda record, path: write_kml(record, path, trajectory.stem))


@app.command("sbet")
def export_sbet(
    trajectory: Source,
    out: Out,
    rate: Rate = None,
    week: Annotated[
        bool, typer.Option("--seconds-of-week", help="Times in seconds of the GPS week, as other programs expect.")
    ] = False,
) -> None:
    """Write an SBET (17 little-endian float64 a record); times are seconds after the campaign's epoch unless told otherwise."""
    from pipeline.formats import sbet
    from pipeline.formats.rtklib import seconds_of_week

    def write(record: Trajectory, path: Path) -> None:
        if week:
            with open_dataset(trajectory) as d:
                record = replace(record, time=seconds_of_week(record.time, d.attrs.get("epoch"), trajectory))
        sbet.write_sbet(sbet.from_trajectory(record), path)

    _export(trajectory, out, rate, write)


@app.command("smrmsg")
def export_smrmsg(trajectory: Source, out: Out, rate: Rate = None) -> None:
    """Write the sigmas as an SMRMSG (10 little-endian float64 a record)."""
    from pipeline.formats import smrmsg

    def write(record: Trajectory, path: Path) -> None:
        if not np.isfinite(record.sigma_position).all():
            raise InputError(trajectory, "sigma_position", "is not known", "import the SBET together with its --smrmsg")
        smrmsg.write_smrmsg(smrmsg.from_trajectory(record), path)

    _export(trajectory, out, rate, write)


def _export(source: Path, out: Path, rate: float | None, write: Callable[[Trajectory, Path], None]) -> None:
    writable(out)
    if source.resolve() == out.resolve():
        raise InputError(out, "OUT", "is the trajectory itself", "give another name")
    if source.suffix in (".sbet", ".out"):
        raise InputError(source, "file", "is no trajectory.nc", "turn it into one first: tsmftis import sbet")
    record = Trajectory.from_file(source)
    if rate is not None:
        record = record.thinned(1.0 / rate)
    temporary = out.with_name(out.name + ".tmp")
    try:
        write(record, temporary)
        os.replace(temporary, out)
    finally:
        temporary.unlink(missing_ok=True)
    Console(highlight=False, soft_wrap=True).print(f"{out}: {record.time.size} samples", markup=False)
