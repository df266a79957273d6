"""tsmftis close-loop: what a campaign's models lack, by what the data say, and the campaign again with it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from flows.cli.running import alone, belongs, make
from flows.settings import load_settings
from flows.steps import Plan
from pipeline.campaign import read_campaign
from pipeline.errors import InputError
from pipeline.inspect import check_campaign
from pipeline.run_stage import StageRecord

SAID = {
    "effects_added": "effects added",
    "no_effect": "no effect is missing, as far as these data show",
    "unexplained": "something is left that no effect accounts for",
}


def close_loop(
    campaign: Annotated[Path, typer.Argument(help="Campaign folder (it holds campaign.yaml).")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; made if need be.")],
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting, for instance closed_loop.p_value=0.01."),
    ] = None,
    settings_file: Annotated[
        Path | None,
        typer.Option("--settings", metavar="FILE", help="YAML file of settings (`tsmftis settings` prints one)."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the loop's draws and of its sealed groups.")] = 1,
) -> None:
    """Process a campaign, find which effects its models lack, and process it again with them.

    It runs on parts, too: a campaign without frames, chamber runs only, laboratory interferograms only. Exit code 0: all done;
    1: a stage failed; 2: the input or the options are wrong.
    """
    console = Console(highlight=False, soft_wrap=True)
    started = time.perf_counter()
    settings = load_settings(settings_file, assignments or [])
    opened = read_campaign(campaign)
    plan = Plan(campaign.resolve(), out.resolve(), settings)
    if plan.out.exists() and not plan.out.is_dir():
        raise InputError(out, "--out", "is a file", "give a folder")
    if plan.campaign.is_relative_to(plan.out) or plan.out.is_relative_to(plan.campaign):
        raise InputError(out, "--out", "would write into the campaign's own place", "give another folder")
    if (plan.out / "run.json").exists():
        raise InputError(
            out, "--out", "holds the results of a run", "give another folder: the loop keeps two runs in its own"
        )
    belongs(plan, opened.keys.name, out, "loop.json")
    for warning in check_campaign(opened).warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)
    _refuse_nothing(plan)
    make(plan, out)
    with alone(plan, out):
        failed = _process(plan, seed, console)
    console.print(
        f"{out}: loop.json, model-update.yaml, loop.html   ({time.perf_counter() - started:.0f} s)", markup=False
    )
    if failed:
        raise typer.Exit(1)


def _refuse_nothing(plan: Plan) -> None:
    from flows.loop.problems import parts_of

    parts, missing = parts_of(plan)
    if not parts:
        why = "; ".join(f"{name}: {said}" for name, said in missing.items())
        raise InputError(
            plan.campaign / "campaign.yaml", "campaign", f"holds nothing to look at ({why})", "add what is missing"
        )


def _process(plan: Plan, seed: int, console: Console) -> bool:
    """Run the flow, print what it came to; whether a stage failed. A wrong input that leaves nothing to look at is raised."""
    from flows.loop.close import run_loop
    from pipeline.report.loop import write_loop_page

    def say(record: StageRecord) -> None:
        took = "unchanged" if record.cached else f"{record.seconds:.1f} s"
        status = took if record.status == "done" else record.status
        console.print(f"{record.stage:<15}{record.unit:<18}{status}", markup=False)
        if record.problem:
            console.print(f"  {record.problem}", style="red", markup=False)

    closed = run_loop(plan, seed, say)
    write_loop_page(closed.content, plan.out)
    print_loop(console, closed.content)
    return any(record.status == "failed" for record in closed.records)


def print_loop(console: Console, content: dict[str, Any]) -> None:
    """Verdict, what was added and why, what cannot be told, figures before and after."""
    partly = " (of the parts that could be looked at)" if content["not_examined"] else ""
    console.print(f"\n{content['campaign']}: {SAID[content['verdict']]}{partly}", style="bold", markup=False)
    from pipeline.report.loop import FIGURES, values

    for step in content["steps"]:
        of = f", bench {step['bench']}" if "bench" in step else ""
        console.print(f"+ {step['effect']} ({step['stage']}{of}): {values(step['parameters'])}", markup=False)
        console.print(f"    {step['evidence']}", markup=False)
        if step["indistinguishable_from"]:
            console.print(f"    cannot be told from: {', '.join(step['indistinguishable_from'])}", markup=False)
    for flight, receiver in content["parts"].get("navigation", {}).get("receiver", {}).items():
        for name, value in receiver.items():
            console.print(f"+ receiver of {flight}: {name} {value:.4g}", markup=False)
    for name, answer in content["parts"].items():
        if answer["verdict"] == "unexplained":
            console.print(f"? {name}: {'; '.join(answer['notes'])}", markup=False)
    for name, why in content["not_examined"].items():
        console.print(f"- {name} was not looked at: {why}", markup=False)
    times = ("before", "after") if content["before"] != content["after"] else ("before",)
    table = Table(show_edge=False, header_style="bold", pad_edge=False)
    for name in ("on held-out data", *(times if len(times) > 1 else ("as declared",))):
        table.add_column(name, justify="left" if name[0] == "o" else "right")
    for key, label in FIGURES:
        if key in content["before"]:
            table.add_row(label, *(_figure(content[when][key]) for when in times))
    if table.row_count:
        Console(highlight=False, width=136).print(table)  # as wide as it is, also in a narrow window


def _figure(value: float | list[float]) -> str:
    return ", ".join(f"{v:.4g}" for v in (value if isinstance(value, list) else [value]))
