"""tsmftis run: a campaign in, spectra, trajectory, maps and scores out."""

from __future__ import annotations

import contextlib
import fcntl
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from flows.results import SCORES
from flows.settings import load_settings
from flows.steps import STAGES, Plan
from pipeline.campaign import Campaign, read_campaign
from pipeline.errors import InputError
from pipeline.inspect import check_campaign
from pipeline.model_update import ModelUpdate, read_model_update
from pipeline.records import LADDER
from pipeline.run_stage import StageRecord
from pipeline.truth import true_poses_file


def run(
    campaign: Annotated[Path, typer.Argument(help="Campaign folder (it holds campaign.yaml).")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; made if need be.")],
    start: Annotated[
        str | None,
        typer.Option("--from", metavar="STAGE", help=f"Run this stage and those after it again: {', '.join(STAGES)}."),
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", metavar="STAGE", help="Run this stage alone, on the results that are there.")
    ] = None,
    line: Annotated[
        list[str] | None,
        typer.Option("--line", metavar="ID", help="Only this line (LINE or FLIGHT/LINE); may be repeated."),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="A setting, for instance navigation.epoch_s=0.05; may be repeated."
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option("--dask", metavar="ADDRESS", help="Run on a Dask scheduler, or 'local' (needs the extra 'dask')."),
    ] = None,
    update: Annotated[
        Path | None,
        typer.Option("--model-update", metavar="FILE", help="YAML file of effects that the declared models lack."),
    ] = None,
    settings_file: Annotated[
        Path | None,
        typer.Option("--settings", metavar="FILE", help="YAML file of settings (`tsmftis settings` prints one)."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="DIR", help="Folder of true poses (<line>.npz): adds the method `true`."),
    ] = None,
) -> None:
    """Process a campaign. Only what changed since the last run into the same folder runs again.

    Exit code 0: all done; 1: a stage failed (run.json says which); 2: the input or the options are wrong.
    """
    console = Console(highlight=False, soft_wrap=True)
    settings = load_settings(settings_file, assignments or [])
    for option, stage in (("--from", start), ("--only", only)):
        if stage is not None and stage not in STAGES:
            raise InputError(option, f"'{stage}'", "is no stage", f"use one of {', '.join(STAGES)}")
    if start and only:
        raise InputError("--from", "with --only", "contradict each other", "give one of them")
    taken = read_model_update(update) if update is not None else ModelUpdate()
    opened = read_campaign(campaign)
    if truth is not None and not any(
        true_poses_file(truth, entry.id) for f in opened.keys.flights for entry in f.lines
    ):
        raise InputError(truth, "--truth", "holds no <line>.npz of the campaign's lines", "give the truth folder")
    known_truth = None if truth is None else truth.resolve()
    plan = Plan(campaign.resolve(), out.resolve(), settings, start, only, tuple(line or ()), taken, known_truth)
    known = {i for f in opened.keys.flights for entry in f.lines for i in (entry.id, f"{f.id}/{entry.id}")}
    if unknown := [i for i in plan.lines if i not in known]:
        raise InputError(
            "--line",
            f"'{unknown[0]}'",
            "is not in the campaign",
            f"use one of {', '.join(sorted(known)) or 'none: it has no lines'}",
        )
    if plan.out.exists() and not plan.out.is_dir():
        raise InputError(out, "--out", "is a file", "give a folder")
    if plan.campaign.is_relative_to(plan.out) or plan.out.is_relative_to(plan.campaign):
        raise InputError(out, "--out", "would write into the campaign's own place", "give another folder")
    belongs(plan, opened.keys.name, out)
    inspection = check_campaign(opened)
    for warning in inspection.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)
    make(plan, out)
    try:
        with alone(plan, out):
            _process(plan, opened, inspection.warnings, dask, console)
    finally:
        # Where nothing came of the run, nothing is left of it either.
        with contextlib.suppress(OSError):
            plan.out.rmdir()


def _process(plan: Plan, opened: Campaign, warnings: list[str], dask: str | None, console: Console) -> None:
    """Run the flow, write run.json and the report, print the scores; raises what the command ends with."""
    started = time.perf_counter()
    # Prefect takes seconds to import: bad input has been answered by now.
    from flows.campaign import run_campaign
    from flows.results import assemble, write_run
    from pipeline.report import write_report

    def say(record: StageRecord) -> None:
        took = "unchanged" if record.cached else f"{record.seconds:.1f} s"
        status = took if record.status == "done" else record.status
        console.print(f"{record.stage:<15}{record.unit:<18}{status}", markup=False)
        if record.problem and not isinstance(record.problem, InputError):
            console.print(f"  {record.problem}", style="red", markup=False)

    records = run_campaign(plan, say, dask)
    wrong_input = next((record.problem for record in records if isinstance(record.problem, InputError)), None)
    if wrong_input and not any(record.status == "done" and not record.cached for record in records):
        raise wrong_input
    # In the order that run.json has, so that report and table do not hang on what was computed and what was read back.
    content = json.loads(json.dumps(assemble(plan, records), sort_keys=True))
    write_run(plan, content)
    for said in told(plan.update):
        console.print(said, markup=False)
    ran = sum(record.status == "done" and not record.cached for record in records)
    console.print(f"ran {ran} of {len(records)} stages; writing the report", markup=False)
    report = write_report(opened, plan.out, content, plan.settings.model_dump(mode="json"), warnings)
    print_scores(console, content)
    for flight, entry in content["flights"].items():
        for said in (entry["navigation"] or {}).get("warnings", []):
            console.print(f"warning: flight {flight}: {said}", style="yellow", markup=False)
        for line, results in entry["lines"].items():
            for said in results.get("mapping", {}).get("warnings", []):
                console.print(f"warning: line {flight}/{line}: {said}", style="yellow", markup=False)
    console.print(f"report: {_short(report)}   ({time.perf_counter() - started:.0f} s)", markup=False)
    if wrong_input:
        raise wrong_input
    if any(record.status == "failed" for record in records):
        raise typer.Exit(1)


def told(update: ModelUpdate) -> list[str]:
    """What a model update does, and what of it is on record only."""
    from stages import tracking

    said = []
    if update.effects:
        said.append(f"model update: {', '.join(update.effects)}")
    said += [f"model update of bench {i}: {', '.join(effects) or 'none'}" for i, effects in update.bench.items()]
    said += [f"model update of the receiver of {f}: velocities {v:g} s late" for f, v in update.velocity_lags().items()]
    used = tracking.applied(update.learned)
    said += [
        f"model update: learned:{one['covariate']} of the stage {one['stage']} "
        + ("turns the camera" if one in used else "is on record, and applied by no model")
        for one in update.learned
    ]
    return said


def belongs(plan: Plan, name: str, out: Path, kept: str = "run.json") -> None:
    """A folder holds the results of one campaign: another's would be overwritten where ids are alike, and mixed elsewhere."""
    try:
        before = json.loads((plan.out / kept).read_text(encoding="utf-8")).get("campaign")
    except (OSError, ValueError):
        return
    if before != name:
        raise InputError(
            out,
            "--out",
            f"holds results of the campaign '{before}', not of '{name}'",
            "give another folder, or remove it",
        )


def make(plan: Plan, out: Path) -> None:
    """The folder for the results."""
    try:
        plan.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(out, "--out", f"cannot be made ({error.strerror})", "give another folder") from error


@contextlib.contextmanager
def alone(plan: Plan, out: Path) -> Iterator[None]:
    """One run at a time in a folder; the lock goes with the process, however it ends."""
    path = plan.out / ".lock"
    with path.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(out, "--out", "is in use by another run", "wait for it or give another folder") from error
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def print_scores(console: Console, content: dict[str, Any]) -> None:
    """The RQE table of a run, if it has scores."""
    if not content.get("rqe"):
        return
    table = Table(
        title="RQE (0 is perfect), mean over the targets of all lines",
        show_edge=False,
        header_style="bold",
        pad_edge=False,
        title_justify="left",
    )
    table.add_column("method")
    for name in ("one point", "by noise alone", "area mean", "by noise alone", "targets"):
        table.add_column(name, justify="right")
    for method in sorted(content["rqe"], key=LADDER.index):
        values = [source[kind].get(method) for kind in SCORES for source in (content, content["noise_limit"])]
        shown = ["–" if v is None else f"{v:.4f}" for v in values]
        table.add_row(method, *shown, str(content["targets_scored"][method]))
    console.print(table)
    for method, targets in content["partly_seen"].items():
        console.print(f"not seen well enough under {method}: {', '.join(targets)}", markup=False)


def _short(path: Path) -> Path:
    try:
        return path.relative_to(Path.cwd())
    except ValueError:
        return path
