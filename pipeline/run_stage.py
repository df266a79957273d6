"""Run a stage or believe its earlier result: content decides.

key = digest of (stage, settings and parameters, digests of the input files, digest of the project's own code that the stage
can reach). Outputs are written into a temporary folder, then renamed to their places; the manifest comes last. A hit is
believed only if every output is there with its recorded digest, so a run killed half-way, an edited file or changed code
all lead to the stage being run again, and nothing else does.

Functions
---------
run_stage           run or reuse
earlier_records     what earlier runs left that still holds
file_digest         digest of a file or of a folder (Zarr)
code_digest         digest of a module and all of the project's modules that it imports
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pipeline.errors import InputError, TsmftisError

PACKAGES = ("tsmftis", "pipeline", "stages", "flows")
LIBRARIES = ("h5py", "numba", "numpy", "opencv-python-headless", "rasterio", "scipy", "torch")
FOLDER = ".stages"

_known_digests: dict[tuple[str, int, int], str] = {}
_lock = threading.Lock()


@dataclass(frozen=True)
class StageRecord:
    """What run.json says of one stage of one unit (a flight, a line, the campaign)."""

    stage: str
    unit: str
    status: str  # done, failed, or skipped because a stage before it was not done
    cached: bool
    seconds: float  # of the run that made the outputs
    digest: str  # the key
    summary: dict[str, Any]
    problem: TsmftisError | None = None


def run_stage(
    out: Path,
    stage: str,
    unit: str,
    modules: tuple[str, ...],
    parameters: Any,
    inputs: Mapping[str, Path],
    outputs: Mapping[str, str],
    work: Callable[[Mapping[str, Path]], dict[str, Any]],
    *,
    force: bool = False,
    forbid: bool = False,
) -> StageRecord:
    """Run `work` unless its outputs are there and current. `modules`: whose code makes the outputs, besides `work` itself.

    parameters: JSON data of everything that is no file; inputs: files by name; outputs: name → path relative to `out`.
    `work` gets output name → temporary path to write to and returns a small JSON summary, which is kept in the manifest.
    force: run even on a hit. forbid: raise InputError instead of running on a miss.
    """
    manifest = out / FOLDER / f"{stage}@{unit.replace('/', '@')}.json"
    key = _digest_text(
        json.dumps(
            {
                "stage": stage,
                "unit": unit,
                "parameters": parameters,
                "outputs": dict(outputs),
                "inputs": {n: file_digest(p) for n, p in sorted(inputs.items())},
                "code": [*map(code_digest, modules), _source_digest(work.__module__)],
                "versions": _versions(),
            },
            sort_keys=True,
        )
    )
    if not force and (known := _current(manifest, key, out)):
        return StageRecord(stage, unit, "done", True, known["seconds"], key, known["summary"])
    if forbid:
        raise InputError(
            out,
            f"stage {stage} of {unit}",
            "has no current result",
            f"run it first: `--from {stage}` or no stage option",
        )
    manifest.parent.mkdir(parents=True, exist_ok=True)
    manifest.unlink(missing_ok=True)
    for left_behind in manifest.parent.iterdir():
        if re.fullmatch(re.escape(manifest.stem) + r"\.\d+\.\d+\.tmp", left_behind.name):
            shutil.rmtree(left_behind, ignore_errors=True)
    scratch = manifest.with_suffix(f".{os.getpid()}.{threading.get_ident()}.tmp")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        started = time.perf_counter()
        paths = {name: scratch / f"{i}{Path(relative).suffix}" for i, (name, relative) in enumerate(outputs.items())}
        summary = work(paths)
        seconds = round(time.perf_counter() - started, 3)
        digests = {}
        for name, relative in outputs.items():
            digests[relative] = file_digest(paths[name])
            final = out / relative
            final.parent.mkdir(parents=True, exist_ok=True)
            os.replace(paths[name], final)
        record = {
            "key": key,
            "seconds": seconds,
            "summary": summary,
            "outputs": digests,
            "inputs": {os.path.relpath(path, out): file_digest(path) for path in inputs.values()},
        }
        write_json(manifest, record)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        with contextlib.suppress(OSError):  # not empty: it is kept
            manifest.parent.rmdir()
    return StageRecord(stage, unit, "done", False, seconds, key, summary)


def earlier_records(out: Path) -> list[StageRecord]:
    """Records of runs into `out` whose outputs are there and whose inputs are still those that they were made from."""
    found = []
    for manifest in sorted((out / FOLDER).glob("*.json")):
        stage, _, unit = manifest.stem.partition("@")
        record = _read(manifest)
        if record and _agree(out, record.get("outputs")) and _agree(out, record.get("inputs")):
            summary = record["summary"]
            found.append(
                StageRecord(stage, unit.replace("@", "/"), "done", True, record["seconds"], record["key"], summary)
            )
    return found


def write_json(path: Path, content: Any) -> None:
    """JSON by a temporary file and one rename; NaN is refused."""
    text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n"
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def _read(manifest: Path) -> dict[str, Any] | None:
    try:
        record = json.loads(manifest.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def _agree(out: Path, digests: dict[str, str] | None) -> bool:
    """Whether all files, relative to `out`, are there with these digests."""
    if not digests:
        return False
    return all((out / name).exists() and file_digest(out / name) == digest for name, digest in digests.items())


def _current(manifest: Path, key: str, out: Path) -> dict[str, Any] | None:
    record = _read(manifest)
    return record if record and record.get("key") == key and _agree(out, record.get("outputs")) else None


def _digest_text(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def file_digest(path: Path) -> str:
    """BLAKE2b of a file's bytes, or of a folder's relative names and bytes; remembered while size and mtime stay."""
    if path.is_dir():
        parts = [(p.relative_to(path).as_posix(), file_digest(p)) for p in sorted(path.rglob("*")) if p.is_file()]
        return _digest_text(json.dumps(parts))
    status = path.stat()
    tag = (str(path), status.st_size, status.st_mtime_ns)
    with _lock:
        if tag in _known_digests:
            return _known_digests[tag]
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    with _lock:
        _known_digests[tag] = digest
    return digest


@cache
def _versions() -> dict[str, str]:
    """Of the libraries that figures hang on: another version may give other figures."""
    known = {d.metadata["Name"].lower(): d.version for d in importlib.metadata.distributions() if d.metadata["Name"]}
    return {name: known[name] for name in LIBRARIES if name in known}


@cache
def _source_digest(module: str) -> str:
    spec = importlib.util.find_spec(module)
    return _digest_text(Path(spec.origin).read_text(encoding="utf-8")) if spec and spec.origin else ""


# CPython before 3.11.9 counts the parser's depth for all threads together and may raise where two of them parse at once.
_PARSING = threading.Lock()


@cache
def code_digest(module: str) -> str:
    """Digest of a module's source and of every module of this project that it reaches by import."""
    todo, seen = [module], {}
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            continue
        source = Path(spec.origin).read_text(encoding="utf-8")
        seen[name] = _digest_text(source)
        if "." in name:
            todo.append(name.rpartition(".")[0])
        with _PARSING:
            todo.extend(_imports(ast.parse(source)))
    return _digest_text(json.dumps(sorted(seen.items())))


def _imports(tree: ast.AST) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            # `from package import module` reaches the module too.
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] in PACKAGES and _is_module(name)}


@cache
def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False
