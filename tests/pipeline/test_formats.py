"""SMRMSG and RTKLIB solutions."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import pytest

from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.formats import rtklib, smrmsg
from pipeline.records import Gnss, Trajectory

HEADER = """% program   : RTKLIB
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  {system}  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio{more}
"""
VELOCITY = "    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun"
ROW = "40.096691600 -105.147166500 1601.4350 {q} 25 0.0100 0.0110 0.0140 0.001 0.001 0.001 0.25 99.9"
MOVING = " 0.10 -0.20 0.30 0.05 0.06 0.07 0 0 0"


def written(tmp_path: Path, rows: list[str], system: str = "GPST", more: str = "") -> Path:
    path = tmp_path / "solution.pos"
    path.write_text(HEADER.format(system=system, more=more) + "\n".join(rows) + "\n")
    return path


def test_a_solution_by_date_becomes_fixes_in_seconds_of_the_week(tmp_path: Path) -> None:
    """2025-08-28 17:30:39.749 GPST is second 408639.749 of the week that began on Sunday, 2025-08-24; up turns into down."""
    rows = [f"2025/08/28 17:30:{s} {ROW.format(q=1)}{MOVING}" for s in ("39.749", "39.999")]
    gnss, epoch = rtklib.read_pos(written(tmp_path, rows, more=VELOCITY))
    assert epoch == dt.datetime(2025, 8, 24)
    np.testing.assert_allclose(gnss.time, [408639.749, 408639.999], atol=1e-6)
    np.testing.assert_allclose(
        np.rad2deg([gnss.latitude[0], gnss.longitude[0]]), [40.0966916, -105.1471665], atol=1e-12
    )
    assert gnss.velocity is not None and gnss.sigma_velocity is not None
    np.testing.assert_allclose(gnss.velocity[0], [0.1, -0.2, -0.3])
    np.testing.assert_allclose(gnss.sigma_velocity[0], [0.05, 0.06, 0.07])
    np.testing.assert_allclose(gnss.sigma_position[0], [0.010, 0.011, 0.014])


def test_week_and_utc_stamps_mean_the_same_time(tmp_path: Path) -> None:
    """Since 2017 GPS time is 18 s ahead of UTC."""
    by_week, _ = rtklib.read_pos(written(tmp_path, [f"2381 {s} {ROW.format(q=2)}" for s in ("408639.749", "408640.0")]))
    rows = [f"2025/08/28 17:30:{s} {ROW.format(q=2)}" for s in ("21.749", "22.000")]
    by_utc, _ = rtklib.read_pos(written(tmp_path, rows, system="UTC"))
    np.testing.assert_allclose(by_week.time, by_utc.time, atol=1e-6)
    assert by_week.velocity is None and set(by_week.quality.tolist()) == {2}


def test_fixes_survive_the_file(tmp_path: Path) -> None:
    rows = [f"2381 {408639 + i} {ROW.format(q=q)}{MOVING}" for i, q in enumerate((1, 4, 6))]
    gnss, _ = rtklib.read_pos(written(tmp_path, rows, more=VELOCITY))
    write_dataset(gnss.to_dataset(), tmp_path / "gnss.nc")
    back = Gnss.from_file(tmp_path / "gnss.nc")
    assert back.quality.tolist() == [1, 5, 2]  # DGPS is a code solution, PPP a float one
    np.testing.assert_array_equal(back.time, gnss.time)
    np.testing.assert_allclose(back.longitude, gnss.longitude, rtol=1e-15)
    np.testing.assert_array_equal(back.velocity, gnss.velocity)


@pytest.mark.parametrize(
    ("rows", "change", "said"),
    [
        ([f"2381 408639 {ROW.format(q=1)}"], ("", ""), "holds 1 solutions"),
        ([f"2381 408639 {ROW.format(q=1)}"] * 2, ("", ""), "line 5"),
        ([f"2381 408639 {ROW.format(q=1)}", "2381 408640 40.1 -105.1"], ("", ""), "line 5"),
        ([f"2381 408639 {ROW.format(q=1)}", f"2381 408640 {ROW.format(q='x')}"], ("", ""), "line 5"),
        ([f"2381 408639 {ROW.format(q=9)}", f"2381 408640 {ROW.format(q=9)}"], ("", ""), "column Q"),
        ([f"2381 408639 {ROW.format(q=1)}"] * 2, ("ellipsoidal", "geodetic"), "above a geoid"),
        ([f"2381 408639 {ROW.format(q=1)}"] * 2, ("latitude(deg)", "x-ecef(m)"), "does not hold latitude"),
        ([f"2381 408639 {ROW.format(q=1)}"] * 2, ("%", ""), "no line of column names"),
    ],
)
def test_what_is_no_such_solution_is_refused_in_one_line(
    tmp_path: Path, rows: list[str], change: tuple[str, str], said: str
) -> None:
    path = written(tmp_path, rows)
    path.write_text(path.read_text().replace(*change) if change[0] else path.read_text())
    with pytest.raises(InputError) as problem:
        rtklib.read_pos(path)
    assert said in str(problem.value) and "\n" not in str(problem.value) and str(path) in str(problem.value)


def test_smrmsg_holds_the_sigmas_in_its_units_and_round_trips(tmp_path: Path) -> None:
    """One arc minute is 1/60 of a degree."""
    zeros, ones = np.zeros((3, 3)), np.ones((3, 3))
    trajectory = Trajectory(
        np.arange(3.0), *np.zeros((3, 3)), zeros, zeros, 0.02 * ones, 0.01 * ones, np.deg2rad(0.5) * ones, zeros, zeros
    )
    records = smrmsg.from_trajectory(trajectory)
    np.testing.assert_allclose(records["heading"], 30.0)
    np.testing.assert_array_equal(records["position_down"], 0.02)
    smrmsg.write_smrmsg(records, tmp_path / "a.smrmsg")
    np.testing.assert_array_equal(smrmsg.read_smrmsg(tmp_path / "a.smrmsg"), records)
    assert (tmp_path / "a.smrmsg").stat().st_size == 3 * 80
    (tmp_path / "b.smrmsg").write_bytes((tmp_path / "a.smrmsg").read_bytes()[:-1])
    with pytest.raises(InputError, match="truncated"):
        smrmsg.read_smrmsg(tmp_path / "b.smrmsg")
