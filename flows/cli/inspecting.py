"""tsmftis inspect: what is in a campaign and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipeline.campaign import read_campaign
from pipeline.inspect import inspect_campaign


def inspect(campaign: Annotated[Path, typer.Argument(help="Campaign folder (it holds campaign.yaml).")]) -> None:
    """Print what a campaign holds (rates, durations, gaps, fix quality, sizes, temperatures) and what is wrong with it.

    Exit code 0 where a run can start, 2 where a problem stands in its way.
    """
    found = inspect_campaign(read_campaign(campaign))
    console = Console(highlight=False)
    table = Table(show_edge=False, header_style="bold", pad_edge=False)
    for name in ("part", "item", "value"):
        table.add_column(name, overflow="fold")
    last = None
    for part, item, value in found.rows:
        if last is not None and part != last:
            table.add_section()
        table.add_row(part if part != last else "", item, value)
        last = part
    console.print(table)
    for warning in found.warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True, markup=False)
    for problem in found.problems:
        console.print(f"problem: {problem}", style="red", soft_wrap=True, markup=False)
    if found.problems:
        raise typer.Exit(2)
    console.print("no problem found" if not found.warnings else "no problem found, see the warnings", style="green")
