"""tsmftis settings: every setting with its default and meaning, as a file to start from."""

from __future__ import annotations

import textwrap

import yaml
from pydantic import BaseModel

from flows.settings import Settings


def settings() -> None:
    """Print all settings with their defaults as YAML, ready for `tsmftis run --settings FILE`."""
    print(template(Settings()), end="")


def template(values: BaseModel) -> str:
    """YAML of a settings tree, the descriptions as comments."""
    lines = []
    for stage, part in values:
        lines.append(f"{stage}:")
        for key, value in part:
            description = type(part).model_fields[key].description
            text = " ".join(yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n").split())
            lines += [f"  # {part_line}" for part_line in textwrap.wrap(description or "", 100)]
            lines.append(f"  {key}: {text}")
    return "\n".join(lines) + "\n"
