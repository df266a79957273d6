"""Content decides what runs again: keys, digests, the manifest, and what a broken run leaves."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from pipeline import run_stage as module
from pipeline.errors import InputError
from pipeline.run_stage import FOLDER, StageRecord, code_digest, file_digest, run_stage, write_json

Work = Callable[[Mapping[str, Path]], dict[str, Any]]


def copy(source: Path) -> Work:
    def work(to: Mapping[str, Path]) -> dict[str, Any]:
        to["copy"].write_bytes(source.read_bytes())
        return {"bytes": source.stat().st_size}

    return work


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "in.txt"
    path.write_text("one")
    return path


def stage(out: Path, source: Path, parameters: Any = None, work: Work | None = None, **switches: bool) -> StageRecord:
    return run_stage(
        out,
        "copying",
        "F1/L01",
        ("stages.scoring",),
        parameters,
        {"source": source},
        {"copy": "F1/L01/copy.txt"},
        work or copy(source),
        **switches,
    )


def test_the_second_time_is_a_hit_with_the_first_ones_record(tmp_path: Path, source: Path) -> None:
    first, second = stage(tmp_path, source), stage(tmp_path, source)
    assert (first.cached, second.cached) == (False, True)
    assert (first.digest, first.seconds, first.summary) == (second.digest, second.seconds, second.summary)
    assert first.summary == {"bytes": 3}


def test_an_input_of_the_same_size_and_name_but_other_content_is_a_miss(tmp_path: Path, source: Path) -> None:
    stage(tmp_path, source)
    source.write_text("two")
    os.utime(source, ns=(1, 1))
    assert not stage(tmp_path, source).cached
    assert (tmp_path / "F1/L01/copy.txt").read_text() == "two"


def test_the_place_of_an_input_does_not_matter(tmp_path: Path, source: Path) -> None:
    stage(tmp_path, source)
    moved = source.rename(tmp_path / "elsewhere.txt")
    assert stage(tmp_path, moved).cached


def test_other_parameters_are_a_miss(tmp_path: Path, source: Path) -> None:
    stage(tmp_path, source, {"a": 1})
    assert not stage(tmp_path, source, {"a": 2}).cached
    assert stage(tmp_path, source, {"a": 2}).cached


@pytest.mark.parametrize("spoil", [Path.unlink, lambda p: p.write_text("oen"), lambda p: p.write_text("")])
def test_a_lost_or_changed_output_is_made_again(spoil: Callable[[Path], Any], tmp_path: Path, source: Path) -> None:
    stage(tmp_path, source)
    spoil(tmp_path / "F1/L01/copy.txt")
    assert not stage(tmp_path, source).cached
    assert (tmp_path / "F1/L01/copy.txt").read_text() == "one"


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"key": 1}', "\x00"])
def test_a_spoiled_manifest_is_a_miss(text: str, tmp_path: Path, source: Path) -> None:
    stage(tmp_path, source)
    (tmp_path / FOLDER / "copying@F1@L01.json").write_text(text)
    assert not stage(tmp_path, source).cached


def test_a_manifest_of_the_right_key_without_outputs_is_a_miss(tmp_path: Path, source: Path) -> None:
    key = stage(tmp_path, source).digest
    (tmp_path / FOLDER / "copying@F1@L01.json").write_text(json.dumps({"key": key}))
    assert not stage(tmp_path, source).cached


def test_force_runs_on_a_hit_and_forbid_refuses_on_a_miss(tmp_path: Path, source: Path) -> None:
    with pytest.raises(InputError, match="has no current result"):
        stage(tmp_path / "out", source, forbid=True)
    assert not (tmp_path / "out").exists()
    stage(tmp_path / "out", source)
    assert stage(tmp_path / "out", source, forbid=True).cached
    assert not stage(tmp_path / "out", source, force=True).cached


def test_work_that_breaks_down_leaves_no_output_and_no_manifest(tmp_path: Path, source: Path) -> None:
    def breaks(to: Mapping[str, Path]) -> dict[str, Any]:
        to["copy"].write_text("half")
        raise MemoryError

    with pytest.raises(MemoryError):
        stage(tmp_path / "out", source, work=breaks)
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == []
    assert not (tmp_path / "out" / FOLDER).exists()


def test_work_that_breaks_down_leaves_the_earlier_output_but_does_not_believe_it(tmp_path: Path, source: Path) -> None:
    def breaks(to: Mapping[str, Path]) -> dict[str, Any]:
        raise MemoryError

    stage(tmp_path, source)
    with pytest.raises(MemoryError):
        stage(tmp_path, source, {"a": 2}, breaks)
    assert (tmp_path / "F1/L01/copy.txt").read_text() == "one"
    assert not stage(tmp_path, source, {"a": 2}).cached


def test_a_forgotten_output_is_no_result(tmp_path: Path, source: Path) -> None:
    with pytest.raises(FileNotFoundError):
        stage(tmp_path, source, work=lambda to: {})
    assert not stage(tmp_path, source).cached


def test_json_refuses_nan_and_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"b": 1.5, "a": "µ"})
    before = path.read_bytes()
    assert before == '{\n "a": "µ",\n "b": 1.5\n}\n'.encode()
    with pytest.raises(ValueError):
        write_json(path, {"b": float("nan")})
    assert path.read_bytes() == before


def test_a_folders_digest_is_of_names_and_bytes(tmp_path: Path) -> None:
    store = tmp_path / "store.zarr"
    (store / "a").mkdir(parents=True)
    (store / "a/0").write_text("x")
    first = file_digest(store)
    (store / "a/0").rename(store / "a/1")
    renamed = file_digest(store)
    (store / "a/1").write_text("yy")
    assert len({first, renamed, file_digest(store)}) == 3


# --- code -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of its own: `root` reaches `near` and, through it, `far`; `other` is reached by nobody."""
    package = tmp_path / "codedigest"
    (package / "sub").mkdir(parents=True)
    (package / "__init__.py").write_text("VERSION = 1\n")
    (package / "root.py").write_text("from codedigest import near\nimport json\n")
    (package / "near.py").write_text("def f():\n    from codedigest.sub.far import g\n    return g\n")
    (package / "sub/__init__.py").write_text("")
    (package / "sub/far.py").write_text("def g():\n    return 1\n")
    (package / "other.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(module, "PACKAGES", ("codedigest",))
    importlib.invalidate_caches()
    yield package
    for name in [n for n in sys.modules if n.split(".")[0] == "codedigest"]:
        del sys.modules[name]


def digest_of_root() -> str:
    code_digest.cache_clear()
    module._is_module.cache_clear()
    try:
        return code_digest("codedigest.root")
    finally:
        code_digest.cache_clear()
        module._is_module.cache_clear()


@pytest.mark.parametrize("file", ["root.py", "near.py", "sub/far.py", "__init__.py", "sub/__init__.py"])
def test_code_that_is_reached_changes_the_digest(file: str, project: Path) -> None:
    before = digest_of_root()
    path = project / file
    path.write_text(path.read_text() + "# changed\n")
    assert digest_of_root() != before


def test_code_that_is_not_reached_does_not(project: Path) -> None:
    before = digest_of_root()
    (project / "other.py").write_text("x = 2\n")
    (project / "new.py").write_text("x = 2\n")
    assert digest_of_root() == before


def test_a_stage_hangs_on_its_own_code_and_on_no_other_stages() -> None:
    assert code_digest("stages.navigation") != code_digest("stages.mapping")
