"""All stages' settings in one tree: from a YAML file, then `key=value` from the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict

from pipeline.campaign import validate
from pipeline.errors import InputError
from pipeline.yaml_file import load_yaml
from stages.bench import BenchSettings
from stages.budget import BudgetSettings
from stages.closed_loop import LoopSettings
from stages.mapping import MappingSettings
from stages.navigation import NavigationSettings
from stages.reconstruction import ReconstructionSettings
from stages.registration import RegistrationSettings
from stages.thermal import ThermalSettings
from stages.tracking import GeometrySettings, TrackingSettings


class Settings(BaseModel):
    """Settings of a run; every key has a default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    thermal: ThermalSettings = ThermalSettings()
    navigation: NavigationSettings = NavigationSettings()
    tracking: TrackingSettings = TrackingSettings()
    geometry: GeometrySettings = GeometrySettings()
    registration: RegistrationSettings = RegistrationSettings()
    reconstruction: ReconstructionSettings = ReconstructionSettings()
    mapping: MappingSettings = MappingSettings()
    bench: BenchSettings = BenchSettings()
    budget: BudgetSettings = BudgetSettings()
    closed_loop: LoopSettings = LoopSettings()


def load_settings(file: Path | None, assignments: list[str]) -> Settings:
    """Settings from a file (or the defaults), then `stage.key=value` assignments, values read as YAML."""
    content: dict[str, Any] = {}
    if file is not None:
        content = load_yaml(file, "give an existing settings file") or {}
        if not isinstance(content, dict):
            raise InputError(file, "file", "holds no keys", "write stage: {key: value}")
    where = file or "--set"
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        stage, dot, key = name.partition(".")
        if not (equals and dot and key):
            raise InputError(
                "--set", f"'{assignment}'", "is not stage.key=value", "write for instance navigation.epoch_s=0.05"
            )
        part = content.setdefault(stage.strip(), {})
        if not isinstance(part, dict):
            raise InputError(where, f"key '{stage}'", "holds no keys", "write stage: {key: value}")
        try:
            part[key.strip()] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise InputError("--set", f"'{assignment}'", "has a value that is not valid YAML", "quote it") from error
    return validate(Settings, content, where, "`tsmftis settings` prints all")
