"""The command `tsmftis`: one file a command; errors end in one line and an exit code."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from flows.cli import budgeting, closing, compensating, exporting, importing, inspecting, running, settings, simulating
from pipeline.errors import TsmftisError
from tsmftis import __version__

app = typer.Typer(
    name="tsmftis",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Post-processing for airborne imaging Fourier spectrometry: a campaign in, spectra, trajectory, maps, scores out.",
)
app.command("inspect")(inspecting.inspect)
app.command("run")(running.run)
app.command("budget")(budgeting.budget)
app.command("close-loop")(closing.close_loop)
app.command("settings")(settings.settings)
app.command("simulate")(simulating.simulate)
app.add_typer(importing.app, name="import")
app.add_typer(exporting.app, name="export")
app.add_typer(compensating.app, name="thermal")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"tsmftis {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point: a TsmftisError becomes one line on standard error and its exit code; set TSMFTIS_DEBUG=1 for its origin."""
    try:
        app()
    except TsmftisError as error:
        if os.environ.get("TSMFTIS_DEBUG"):
            raise
        print(f"tsmftis: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)
    except OSError as error:
        if os.environ.get("TSMFTIS_DEBUG"):
            raise
        print(f"tsmftis: {error.filename or 'file system'}: {error.strerror or error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("tsmftis: interrupted; the same command takes the run up where it was", file=sys.stderr)
        sys.exit(130)
