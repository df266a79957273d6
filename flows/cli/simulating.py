"""tsmftis simulate: a synthetic campaign with its truth beside it."""

from __future__ import annotations

import time
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer
import yaml
from rich.console import Console

from pipeline.campaign import validate
from pipeline.errors import InputError

PRESETS = files("configs").joinpath("simulation")


def simulate(
    out: Annotated[Path, typer.Argument(help="Campaign folder to make; the truth goes into OUT-truth beside it.")],
    preset: Annotated[
        str,
        typer.Option(
            "--preset", metavar="NAME|FILE", help="A preset's name (demo, survey, mems) or a YAML file like one."
        ),
    ] = "demo",
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same bytes.")] = 1,
) -> None:
    """Simulate a campaign: flight, inertial data with thermal errors, GNSS, terrain, scene, frames, chamber runs, truth."""
    from stages import simulation

    settings = validate(simulation.SimulationSettings, load_preset(preset), preset, "see configs/simulation/demo.yaml")
    for folder in (out, out.with_name(out.name + "-truth")):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(folder, "folder", "exists and is not empty", "give another name or remove it")
    started = time.perf_counter()
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        simulation.write(simulation.run(settings, seed), out)
    except ValueError as error:
        raise InputError(preset, "preset", str(error), "correct the value") from error
    Console(highlight=False, soft_wrap=True).print(
        f"campaign: {out}   truth: {out.with_name(out.name + '-truth')}   ({time.perf_counter() - started:.0f} s)",
        markup=False,
    )


def load_preset(name: str) -> object:
    """Content of a preset by name, or of a YAML file."""
    known = sorted(p.name.removesuffix(".yaml") for p in PRESETS.iterdir() if p.name.endswith(".yaml"))
    try:
        text = (
            PRESETS.joinpath(f"{name}.yaml").read_text(encoding="utf-8")
            if name in known
            else Path(name).read_text(encoding="utf-8")
        )
        return yaml.safe_load(text)
    except OSError:
        raise InputError(
            "--preset",
            f"'{name}'",
            "is neither a preset nor a readable file",
            f"use one of {', '.join(known)}, or a YAML file",
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError):
        raise InputError(name, "file", "is not valid YAML", "correct the syntax") from None
