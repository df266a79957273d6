"""tsmftis import: other programs' files into the campaign format."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
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

    if out.is_dir() or not out.parent.is_dir():
        raise InputError(out, "OUT", "is not a file name in an existing folder", "give for instance bench/sample.nc")
    bench = read_opus(file)
    temporary = out.with_name(out.name + ".tmp")
    write_dataset(bench.to_dataset(), temporary)
    os.replace(temporary, out)
    scans, samples = bench.interferogram.shape
    Console(highlight=False, soft_wrap=True).print(
        f"{out}: {scans} scan{'s' if scans > 1 else ''} of {samples} samples, apodization {bench.apodization or 'not told'}, "
        f"phase {bench.phase_correction or 'not told'}, "
        f"vendor's spectrum {'included' if bench.reference is not None else 'not in the file'}",
        markup=False,
    )
