"""YAML files as people write them: an error names the line, and a key given twice is an error.

Functions
---------
load_yaml       a file's content as plain data
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pipeline.errors import InputError


class _Loader(yaml.SafeLoader):
    """Refuses a mapping that gives a key twice, where YAML would take the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{key.value}' is given twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def load_yaml(path: Path, mend: str) -> Any:
    """Plain data of a YAML file; raises InputError where it cannot be read (`mend` says what to do then) or is no valid YAML."""
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        problem = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise InputError(path, "file", problem, mend) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        said = getattr(error, "problem", None)
        twice = said if said and "given twice" in said else "is not valid YAML"
        raise InputError(path, f"line {mark.line + 1}" if mark else "file", twice, "correct the syntax") from error
