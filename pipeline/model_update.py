"""The model update: what a campaign's declared models lack, as a YAML file of effects.

    format: tsmftis-model-update/1
    effects:
      gnss_latency: {latency: 0.04}
      antenna_lever_arm: {x: 0.1, y: 0.0, z: -0.2}

Names, parameters and units are those of `tsmftis.effects`; a parameter left out is zero.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.yaml_file import load_yaml
from tsmftis.effects import EFFECTS

FORMAT = "tsmftis-model-update/1"
Effects = dict[str, dict[str, float]]


def read_model_update(path: Path, applied: frozenset[str]) -> Effects:
    """Effects by name, every parameter given; raises InputError for what is no effect, or of a stage that is not `applied`."""
    content = load_yaml(path, "give an existing model update")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(path, "key 'format'", f"is not {FORMAT}", f"write  format: {FORMAT}")
    if unknown := sorted(set(content) - {"format", "effects"}):
        raise InputError(path, f"key '{unknown[0]}'", "is not known", "a model update has format and effects")
    effects = content.get("effects") or {}
    if not isinstance(effects, dict):
        raise InputError(path, "key 'effects'", "holds no keys", "write  effects: {gnss_latency: {latency: 0.04}}")
    return {name: _effect(path, name, given, applied) for name, given in effects.items()}


def _effect(path: Path, name: Any, given: Any, applied: frozenset[str]) -> dict[str, float]:
    place = f"key 'effects.{name}'"
    if name not in EFFECTS:
        raise InputError(path, place, "is no known effect", f"use one of {', '.join(EFFECTS)}")
    effect = EFFECTS[name]
    if effect.stage not in applied:
        raise InputError(
            path,
            place,
            f"changes the {effect.stage} model, which takes no update yet",
            f"leave it out; updates are taken by {', '.join(sorted(applied))}",
        )
    if not isinstance(given, dict):
        raise InputError(path, place, "holds no parameters", f"write {{{', '.join(f'{k}: …' for k in effect.units)}}}")
    values = dict.fromkeys(effect.units, 0.0)
    for key, value in given.items():
        if key not in effect.units:
            raise InputError(path, f"{place[:-1]}.{key}'", "is no parameter", f"it has {', '.join(effect.units)}")
        try:
            number = math.nan if isinstance(value, bool) else float(value)  # YAML 1.1 reads 1e-6 as text
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise InputError(path, f"{place[:-1]}.{key}'", f"is {value!r}", f"give a number [{effect.units[key]}]")
        if abs(number) > effect.largest[key]:
            problem = f"is {number:g}, more than {effect.largest[key]:g} {effect.units[key]}"
            raise InputError(path, f"{place[:-1]}.{key}'", problem, "correct the value or its unit")
        values[key] = number
    return values
