"""OPUS files: what the reader makes of measured ones, and one line for what is none."""

from __future__ import annotations

import builtins
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.formats import opus
from pipeline.formats.opus import read_opus
from pipeline.records import Bench

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "data" / "opus"
real_data = pytest.mark.skipif(not SHARED.is_dir(), reason=f"measured OPUS files are not in {SHARED}")
FILES = {
    "brukeropus_file.0": ("mertz", 1579582.0598, 10000.0),
    "opusreader2_617262_1TP_C-1_A5.0": ("power", 1579761.81640625, 3200.0),
    "opusreader2_629266_1TP_A-1_C1.0": ("power", 1579819.0743, 3200.0),
}


@real_data
@pytest.mark.parametrize("name", FILES)
def test_measured_file(name: str, tmp_path: Path) -> None:
    pytest.importorskip("brukeropus")
    correction, folding, phase_resolution = FILES[name]
    bench = read_opus(SHARED / name)
    assert bench.interferogram.shape[0] == 2 and bench.opd.size == bench.interferogram.shape[1]
    np.testing.assert_allclose(np.diff(bench.opd), 1 / (2 * folding), rtol=1e-9)
    # ZPD of both scans on the same OPD (within the two samples that hold the burst's top), the first exactly at 0
    at = [bench.opd[np.argmax(np.abs(scan - scan.mean()))] for scan in bench.interferogram]
    assert at[0] == 0.0 and abs(at[1]) <= 1.001 / (2 * folding)
    assert (bench.apodization, bench.phase_correction, bench.zero_filling) == ("blackman-harris-3", correction, 2)
    assert (bench.resolution, bench.phase_resolution) == (400.0, phase_resolution)
    assert bench.wavenumber is not None and bench.reference is not None
    assert (np.diff(bench.wavenumber) > 0).all() and 4.9e4 < bench.wavenumber[0] < 6e4
    write_dataset(bench.to_dataset(), tmp_path / "bench.nc")
    again = Bench.from_file(tmp_path / "bench.nc")
    for field in ("interferogram", "opd", "wavenumber", "reference"):
        np.testing.assert_array_equal(getattr(again, field), getattr(bench, field))
    for field in Bench.ATTRIBUTES:
        assert getattr(again, field) == getattr(bench, field)


@real_data
def test_reference_channel_of_one_direction() -> None:
    pytest.importorskip("brukeropus")
    assert read_opus(SHARED / "brukeropus_file.0", "reference").interferogram.shape == (1, 14728)


class Parameters(SimpleNamespace):
    """Parameters as brukeropus gives them: attributes by three-letter key."""


def fake(**parameters: Any) -> SimpleNamespace:
    """A small OPUS file of both directions, burst at sample 40 of 100 forward and so at 59 backward."""
    scan = np.zeros(100)
    scan[40], scan[41] = 1.0, 0.5
    block = Parameters(y=np.concatenate([scan, scan[::-1]]))
    spectrum = Parameters(x=np.array([30.0, 20.0, 10.0]), y=np.array([3.0, 2.0, 1.0]), params=Parameters(dxu="WN"))
    plain = {"hfl": 50.0, "lfl": 0.0, "gfw": 1, "gbw": 1, "aqm": "DD", "apf": "NBM", "phz": "ML"}
    given = Parameters(**(plain | parameters))
    keys = ["igsm", "sm"]
    return SimpleNamespace(is_opus=True, data_keys=keys, all_data_keys=keys, igsm=block, sm=spectrum, params=given)


def test_backward_scan_is_turned_and_units_are_per_metre(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opus, "_open", lambda path: fake(res=4.0, phr=64.0, zff=4))
    bench = read_opus(Path("x.0"))
    np.testing.assert_array_equal(bench.interferogram[0], bench.interferogram[1])
    assert bench.opd[40] == 0.0 and bench.opd[41] == pytest.approx(1e-4)
    assert bench.wavenumber is not None and bench.reference is not None
    np.testing.assert_allclose(bench.wavenumber, [1000.0, 2000.0, 3000.0])
    np.testing.assert_allclose(bench.reference, [1.0, 2.0, 3.0])
    assert (bench.apodization, bench.resolution, bench.phase_resolution) == ("norton-beer-medium", 400.0, 6400.0)


def test_counts_of_scans_decide_and_parameters_may_be_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opus, "_open", lambda path: fake(gbw=0))
    bench = read_opus(Path("x.0"))
    assert bench.interferogram.shape == (1, 200)
    assert bench.resolution is None and bench.zero_filling is None


@pytest.mark.parametrize(
    ("parameters", "place"), [({"hfl": None}, "HFL"), ({"lfl": 100.0}, "LFL"), ({"hfl": "x"}, "HFL")]
)
def test_parameters_of_no_use(parameters: dict[str, Any], place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opus, "_open", lambda path: fake(**parameters))
    with pytest.raises(InputError, match=place):
        read_opus(Path("x.0"))


def test_no_interferogram(monkeypatch: pytest.MonkeyPatch) -> None:
    with_reference = fake()
    with_reference.rf_params = with_reference.params
    monkeypatch.setattr(opus, "_open", lambda path: with_reference)
    with pytest.raises(InputError, match=r"no reference interferogram \(the file holds igsm, sm\)"):
        read_opus(Path("x.0"), "reference")


MAGIC = b"\n\n\xfe\xfe"


@pytest.mark.parametrize("content", [b"", b"id,latitude_deg\n", MAGIC, MAGIC + bytes(range(256)) * 4])
def test_no_opus_file(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("brukeropus")
    path = tmp_path / "other.0"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_opus(path)
    assert "other.0" in str(caught.value) and "\n" not in str(caught.value)


@real_data
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_truncated_file(share: float, tmp_path: Path) -> None:
    pytest.importorskip("brukeropus")
    content = (SHARED / "brukeropus_file.0").read_bytes()
    path = tmp_path / "cut.0"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"cut\.0"):
        read_opus(path)


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("brukeropus"):
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r'pip install "tsmftis\[opus\]"'):
        read_opus(tmp_path / "any.0")


def test_absent_file(tmp_path: Path) -> None:
    pytest.importorskip("brukeropus")
    with pytest.raises(InputError, match="does not exist"):
        read_opus(tmp_path / "none.0")
