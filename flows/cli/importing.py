"""tsmftis import: other programs' files into the campaign format."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from rich.console import Console

from pipeline.datasets import write_dataset
from pipeline.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Turn other programs' files into files of the campaign format.")


@app.callback()
def _group() -> None:
    pass


@app.command("opus")
def import_opus(
    file: Annotated[Path, typer.Argument(help="A Bruker OPUS file with interferogram data.")],
    out: Annotated[Path, typer.Argument(help="The bench file (NetCDF-4) to write.")],
) -> None:
    """Write an OPUS file's interferogram, its parameters and the vendor's spectrum as a bench file of a campaign."""
    from pipeline.formats.opus import read_opus

    writable(out)
    bench = read_opus(file)
    _write(bench.to_dataset(), out)
    scans, samples = bench.interferogram.shape
    Console(highlight=False, soft_wrap=True).print(
        f"{out}: {scans} scan{'s' if scans > 1 else ''} of {samples} samples, apodization {bench.apodization or 'not told'}, "
        f"phase {bench.phase_correction or 'not told'}, "
        f"vendor's spectrum {'included' if bench.reference is not None else 'not in the file'}",
        markup=False,
    )


@app.command("pos")
def import_pos(
    file: Annotated[Path, typer.Argument(help="An RTKLIB solution (.pos): latitude, longitude, ellipsoidal height.")],
    out: Annotated[Path, typer.Argument(help="The gnss file (NetCDF-4) to write.")],
    epoch: Annotated[
        datetime | None,
        typer.Option(
            "--epoch", help="The campaign's epoch (GPS time); default: the start of the first fix's GPS week."
        ),
    ] = None,
) -> None:
    """Write an RTKLIB solution as a gnss file of a campaign; the epoch that its times count from is printed."""
    from pipeline.formats.rtklib import read_pos

    writable(out)
    gnss, start = read_pos(file, epoch)
    _write(gnss.to_dataset(), out)
    Console(highlight=False, soft_wrap=True).print(
        f"{out}: {gnss.time.size} fixes, velocity {'included' if gnss.velocity is not None else 'not in the file'}; "
        f"in campaign.yaml write  time: {{scale: GPS, epoch: '{start.isoformat()}Z'}}",
        markup=False,
    )


@app.command("sbet")
def import_sbet(
    file: Annotated[Path, typer.Argument(help="An SBET (smoothed best estimate of trajectory).")],
    out: Annotated[Path, typer.Argument(help="The trajectory file (NetCDF-4) to write.")],
    sigmas: Annotated[
        Path | None, typer.Option("--smrmsg", metavar="FILE", help="The SMRMSG that goes with it: its sigmas.")
    ] = None,
) -> None:
    """Write another program's trajectory as a trajectory.nc; times stay as they are in the file."""
    from pipeline.formats import sbet, smrmsg

    writable(out)
    trajectory = sbet.to_trajectory(sbet.read_sbet(file))
    if sigmas is not None:
        trajectory = smrmsg.with_sigmas(trajectory, smrmsg.read_smrmsg(sigmas), sigmas)
    _write(trajectory.to_dataset().assign_attrs(source=file.name), out)
    said = "sigmas included" if sigmas is not None else "no --smrmsg: its sigmas are not known (NaN in the file)"
    Console(highlight=False, soft_wrap=True).print(
        f"{out}: {trajectory.time.size} records, {trajectory.time[0]:.3f} to {trajectory.time[-1]:.3f} s; {said}",
        markup=False,
    )


def writable(out: Path) -> None:
    """Raise InputError where `out` cannot be a new file."""
    if out.is_dir() or not out.parent.is_dir():
        raise InputError(out, "OUT", "is not a file name in an existing folder", "make the folder or give another name")


def _write(dataset: xr.Dataset, out: Path) -> None:
    temporary = out.with_name(out.name + ".tmp")
    write_dataset(dataset, temporary)
    os.replace(temporary, out)
