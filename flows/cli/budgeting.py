"""tsmftis budget: what each part of a campaign contributes to pixels and to RQE."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from flows.cli.running import alone, belongs, make
from flows.settings import load_settings
from flows.steps import Plan
from pipeline.campaign import Campaign, read_campaign
from pipeline.errors import InputError
from pipeline.inspect import check_campaign
from pipeline.run_stage import StageRecord
from pipeline.truth import true_poses_file

KINDS = ("point", "area")
SUMS = (
    ("noise", "noise"),
    ("parts marked +", "parts"),
    ("noise and these parts", "explained"),
    ("base", "rqe"),
    ("√(base² − noise²)", "left"),
)


def budget(
    campaign: Annotated[Path, typer.Argument(help="Campaign folder (it holds campaign.yaml).")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results, that of a run or a new one.")],
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", metavar="DIR", help="Folder of true poses (<line>.npz): the navigation's actual share."
        ),
    ] = None,
    line: Annotated[
        list[str] | None,
        typer.Option("--line", metavar="ID", help="Only this line (LINE or FLIGHT/LINE); may be repeated."),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting, for instance budget.draws=20; may be repeated."),
    ] = None,
    settings_file: Annotated[
        Path | None,
        typer.Option("--settings", metavar="FILE", help="YAML file of settings (`tsmftis settings` prints one)."),
    ] = None,
) -> None:
    """Run a campaign, then switch each part off or perturb it by its sigma: its share of displacement and of RQE.

    Exit code 0: all done; 1: a stage failed; 2: the input or the options are wrong.
    """
    console = Console(highlight=False, soft_wrap=True)
    started = time.perf_counter()
    settings = load_settings(settings_file, assignments or [])
    opened = read_campaign(campaign)
    plan = Plan(campaign.resolve(), out.resolve(), settings, lines=tuple(line or ()))
    _check(plan, opened, out, truth)
    for warning in check_campaign(opened).warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)
    make(plan, out)
    with alone(plan, out):
        _process(plan, None if truth is None else truth.resolve(), console)
    content = json.loads((plan.out / "budget.json").read_text(encoding="utf-8"))
    print_budget(content)
    console.print(
        f"{out}: budget.json, budget.csv, budget.html   ({time.perf_counter() - started:.0f} s)", markup=False
    )


def _check(plan: Plan, opened: Campaign, out: Path, truth: Path | None) -> None:
    """InputError for what `run` refuses too, and for a campaign of which no budget can be made."""
    entries = [(f.id, entry.id) for f in opened.keys.flights for entry in f.lines]
    known = {i for flight, line in entries for i in (line, f"{flight}/{line}")}
    if not entries:
        raise InputError(
            plan.campaign / "campaign.yaml",
            "flights[].lines",
            "there is no line",
            "an error budget is made of targets on frames: give a campaign with lines",
        )
    if unknown := [i for i in plan.lines if i not in known]:
        raise InputError(
            "--line", f"'{unknown[0]}'", "is not in the campaign", f"use one of {', '.join(sorted(known))}"
        )
    if truth is not None and not any(true_poses_file(truth, line) for _, line in entries):
        raise InputError(truth, "--truth", "holds no <line>.npz of the campaign's lines", "give the truth folder")
    if plan.out.exists() and not plan.out.is_dir():
        raise InputError(out, "--out", "is a file", "give a folder")
    if plan.campaign.is_relative_to(plan.out) or plan.out.is_relative_to(plan.campaign):
        raise InputError(out, "--out", "would write into the campaign's own place", "give another folder")
    belongs(plan, opened.keys.name, out)


def _process(plan: Plan, truth: Path | None, console: Console) -> None:
    """The base run, then the budget; the first failure is raised."""
    from flows.budget import budget_step
    from flows.campaign import run_campaign
    from flows.results import assemble, write_run

    def say(record: StageRecord) -> None:
        took = "unchanged" if record.cached else f"{record.seconds:.1f} s"
        console.print(
            f"{record.stage:<15}{record.unit:<18}{took if record.status == 'done' else record.status}", markup=False
        )

    records = run_campaign(plan, say)
    write_run(plan, assemble(plan, records))
    if failed := next((record.problem for record in records if record.problem is not None), None):
        raise failed
    say(budget_step(plan, truth))


def print_budget(content: dict[str, Any]) -> None:
    """The table on the console, as wide as it is, also where the output goes to a file or a narrow window."""
    wide = Console(highlight=False, width=136)
    table = Table(
        title=f"Error budget of {content['campaign']}: displacement of the tracks in rms px, share of the spectra, RQE",
        show_edge=False,
        header_style="bold",
        pad_edge=False,
        title_justify="left",
    )
    table.add_column("part", no_wrap=True)
    for name in ("rows", "cols", "rows ~", "cols ~", "share", "of area", "RQE", "Δ·10⁴", "RQE area", "Δ·10⁴"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in content["rows"]:
        pixels = [_fixed(row["pixels_rms"][k], 3) for k in ("row", "col", "row_varying", "col_varying")]
        scores = [cell for kind in KINDS for cell in (_fixed(row[kind]["rqe"]), _change(row[kind]))]
        mark = " +" if row["adds"] else ""
        table.add_row(row["part"] + mark, *pixels, *(_share(row[kind]) for kind in KINDS), *scores)
    table.add_section()
    total = content["total"]
    for label, key in SUMS:
        shares = [
            _share({"share": total[kind][f"{key}_rms"], "share_upper": total[kind].get(f"{key}_upper")})
            for kind in KINDS
        ]
        scores = [cell for kind in KINDS for cell in (_fixed(total[kind][key]) if key in total[kind] else "", "")]
        table.add_row(label, *[""] * 4, *shares, *scores)
    wide.print(table)
    wide.print(
        "~: what varies within a pass. Share: ‖B′ − B‖/‖B_ref‖ in rms, noise taken off. Area: of the area mean.",
        markup=False,
    )
    for row in content["rows"]:
        said = f"cannot tell: {row['cannot_tell']}" if row["cannot_tell"] else row["done"]
        wide.print(f"{row['part']}: {said}", markup=False)
    for note in content["notes"]:
        wide.print(note, markup=False)


def _fixed(value: float | None, digits: int = 4) -> str:
    if value is None:
        return "–"
    least = 10.0**-digits
    return f"<{least:.{digits}f}" if 0.0 < value < 0.5 * least else f"{value:.{digits}f}"


def _share(entry: dict[str, Any]) -> str:
    if entry["share"] is None and entry["share_upper"] is not None:
        return "<" + _fixed(max(entry["share_upper"], 1e-4))
    return _fixed(entry["share"])


def _change(entry: dict[str, Any]) -> str:
    if entry["rqe_change"] is None:
        return "–"
    error = entry["standard_error"]
    return f"{1e4 * entry['rqe_change']:+.1f}" + ("" if error is None else f"±{1e4 * error:.1f}")
