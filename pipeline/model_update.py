"""The model update: what a campaign's declared models lack, as a YAML file of effects.

    format: tsmftis-model-update/1
    effects:
      gnss_latency: {latency: 0.04}
      antenna_lever_arm: {x: 0.1, y: 0.0, z: -0.2}

Names, parameters and units are those of `tsmftis.effects`; a parameter left out is zero, one of three axes a list of three.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.yaml_file import load_yaml
from tsmftis.effects import EFFECTS, Effect

FORMAT = "tsmftis-model-update/1"
Effects = dict[str, dict[str, Any]]  # floats, and tuples of three where an effect has lists


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
        shape = ", ".join(f"{k}: {'[…, …, …]' if k in effect.lists else '…'}" for k in effect.units)
        raise InputError(path, place, "holds no parameters", f"write {{{shape}}}")
    for key in given:
        if key not in effect.units:
            raise InputError(path, f"{place[:-1]}.{key}'", "is no parameter", f"it has {', '.join(effect.units)}")
    values: dict[str, Any] = {}
    for key in effect.units:
        where = f"{place[:-1]}.{key}'"
        if key in effect.lists:
            three = given.get(key, [0.0, 0.0, 0.0])
            if not isinstance(three, list) or len(three) != 3:
                raise InputError(
                    path, where, f"is {three!r}", f"give a list of three, one an axis [{effect.units[key]}]"
                )
            values[key] = tuple(_number(path, where, value, effect, key) for value in three)
        else:
            values[key] = _number(path, where, given.get(key, 0.0), effect, key)
    return values


def _number(path: Path, where: str, value: Any, effect: Effect, key: str) -> float:
    unit = effect.units[key]
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # YAML 1.1 reads 1e-6 as text
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(path, where, f"is {value!r}", f"give a number [{unit}]")
    if abs(number) > effect.largest[key]:
        problem = f"is {number:g}, more than {effect.largest[key]:g} {unit}"
        raise InputError(path, where, problem, "correct the value or its unit")
    if number < (least := effect.least.get(key, -math.inf)):
        raise InputError(path, where, f"is {number:g}, less than {least:g} {unit}", "correct or give the value")
    return number
