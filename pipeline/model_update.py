"""The model update: what a campaign's declared models lack, as a YAML file of effects.

    format: tsmftis-model-update/1
    effects:
      gnss_latency: {latency: 0.04}
      antenna_lever_arm: {x: 0.1, y: 0.0, z: -0.2}
    bench:                          # optional
      mct: {detector_nonlinearity: {a: -0.015}}
    receiver:                       # optional
      F1: {velocity_lag_s: 0.04}
    learned:                        # optional
      - {stage: thermal, covariate: time, unit: rad s-1, table: {covariate: [0, 10], value: [0.0, 1.0e-7]}}

Names, parameters and units are those of `tsmftis.effects`; a parameter left out is zero, one of three axes a list of three.
A receiver whose velocities lag their positions has them at an earlier instant, flight by flight.
A laboratory interferogram that `bench` names has its own effects and not those of `effects`: its detector is another one.
Learned terms are what the closed loop found without a name: curves of what is left over a covariate. Those of the geometry that
are curves of what a frame is under (time, temperature, attitude, …) turn the camera (`stages.tracking.learned`); no model
applies the others, which are on record.

Functions
---------
read_model_update    file → ModelUpdate
write_model_update   ModelUpdate → file
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from pipeline.errors import InputError
from pipeline.yaml_file import load_yaml
from tsmftis.effects import EFFECTS, Effect

FORMAT = "tsmftis-model-update/1"
SECTIONS = ("format", "effects", "bench", "learned", "receiver")
RECEIVER, LARGEST_LAG_S = "velocity_lag_s", 2.0
LEARNED = ("stage", "covariate", "unit", "table")
MAY_HAVE = {"covariate_unit"}
Effects = dict[str, dict[str, Any]]  # floats, and tuples of three where an effect has lists


@dataclass(frozen=True)
class ModelUpdate:
    """`effects` of the campaign's instrument; `receiver`: lag of velocities, by flight; `bench`: effects of single laboratory
    interferograms; `learned`: curves on record,
    each with stage, covariate, unit of the curve and table {covariate: […], value: […]}, and the covariate's unit where known."""

    effects: Effects = field(default_factory=dict)
    bench: Mapping[str, Effects] = field(default_factory=dict)
    learned: tuple[Mapping[str, Any], ...] = ()
    receiver: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def velocity_lag(self, flight: str) -> float:
        """Of the velocities of a flight's receiver against its positions [s]."""
        return self.velocity_lags().get(flight, 0.0)

    def velocity_lags(self) -> dict[str, float]:
        return {flight: float(values[RECEIVER]) for flight, values in self.receiver.items()}


def read_model_update(path: Path) -> ModelUpdate:
    """Every effect with every parameter; raises InputError for what is no effect, no number or beyond belief."""
    content = load_yaml(path, "give an existing model update")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(path, "key 'format'", f"is not {FORMAT}", f"write  format: {FORMAT}")
    if unknown := sorted(set(content) - set(SECTIONS)):
        raise InputError(path, f"key '{unknown[0]}'", "is not known", f"a model update has {', '.join(SECTIONS)}")
    bench = content.get("bench") or {}
    if not isinstance(bench, dict):
        raise InputError(path, "key 'bench'", "holds no keys", "write  bench: {id: {detector_nonlinearity: {a: 0.01}}}")
    return ModelUpdate(
        _effects(path, "effects", content.get("effects") or {}),
        {str(name): _effects(path, f"bench.{name}", given or {}) for name, given in bench.items()},
        _learned(path, content.get("learned") or []),
        _receiver(path, content.get("receiver") or {}),
    )


def write_model_update(update: ModelUpdate, path: Path) -> None:
    """The same file for the same content; sections that hold nothing are left out, but for `effects`."""
    content: dict[str, Any] = {"format": FORMAT, "effects": _listed(update.effects)}
    if update.bench:
        content["bench"] = {name: _listed(effects) for name, effects in update.bench.items()}
    if update.receiver:
        content["receiver"] = {flight: dict(values) for flight, values in update.receiver.items()}
    if update.learned:
        content["learned"] = [dict(one) for one in update.learned]
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    path.write_text(text, encoding="utf-8")


def _listed(effects: Effects) -> dict[str, dict[str, Any]]:
    """Tuples as lists, which YAML knows."""
    return {
        name: {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}
        for name, values in effects.items()
    }


def _effects(path: Path, section: str, effects: Any) -> Effects:
    if not isinstance(effects, dict):
        raise InputError(path, f"key '{section}'", "holds no keys", "write  effects: {gnss_latency: {latency: 0.04}}")
    return {name: _effect(path, f"{section}.{name}", name, given) for name, given in effects.items()}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _receiver(path: Path, given: Any) -> dict[str, dict[str, float]]:
    shape = f"write  receiver: {{F1: {{{RECEIVER}: 0.04}}}}"
    if not isinstance(given, dict) or not all(isinstance(v, dict) and set(v) == {RECEIVER} for v in given.values()):
        raise InputError(path, "key 'receiver'", "names no flights with their receivers' lag", shape)
    out = {}
    for flight, values in given.items():
        lag = values[RECEIVER]
        place = f"key 'receiver.{flight}.{RECEIVER}'"
        if not _is_number(lag) or abs(lag) > LARGEST_LAG_S:
            raise InputError(path, place, f"is {lag!r}", f"give seconds, {LARGEST_LAG_S:g} at most either way")
        out[str(flight)] = {RECEIVER: float(lag)}
    return out


def _learned(path: Path, given: Any) -> tuple[Mapping[str, Any], ...]:
    if not isinstance(given, list):
        raise InputError(path, "key 'learned'", "is no list", "write one entry a curve, or leave it out")
    for i, one in enumerate(given):
        place = f"key 'learned[{i}]'"
        if not isinstance(one, dict) or set(one) - MAY_HAVE != set(LEARNED):
            raise InputError(path, place, "is no learned term", f"it has {', '.join(LEARNED)}")
        table = one["table"]
        columns = list(table.values()) if isinstance(table, dict) else []
        numbers = all(isinstance(c, list) and c and all(_is_number(v) for v in c) for c in columns)
        if not numbers or len(columns) < 2 or "covariate" not in table or len({len(c) for c in columns}) != 1:
            raise InputError(
                path,
                f"{place[:-1]}.table'",
                "is no table",
                "give covariate and its curves, lists of numbers of one length",
            )
        if any(b <= a for a, b in pairwise(table["covariate"])):
            raise InputError(
                path, f"{place[:-1]}.table.covariate'", "does not increase", "put its values in order, each once"
            )
    return tuple(given)


def _effect(path: Path, where: str, name: Any, given: Any) -> dict[str, Any]:
    place = f"key '{where}'"
    if str(name).startswith("learned:"):
        raise InputError(path, place, "has no parameters", "a learned term stands under learned, with its table")
    if name not in EFFECTS:
        raise InputError(path, place, "is no known effect", f"use one of {', '.join(EFFECTS)}")
    effect = EFFECTS[name]
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
