"""SBET: round trips, sign conventions on real files, and a closed form for what a trajectory becomes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import InputError
from pipeline.formats import smrmsg
from pipeline.formats.sbet import (
    DTYPE,
    from_trajectory,
    heading,
    read_sbet,
    to_trajectory,
    velocity_ned,
    write_sbet,
)
from pipeline.records import Trajectory
from tsmftis.geodesy import earth_rate_ned, normal_gravity, radii_of_curvature
from tsmftis.rotation import log_so3, rpy_to_dcm

SHARED = Path(os.environ.get("TSMFTIS_SHARED", Path(__file__).parents[2].parent / "shared")) / "data" / "sbet"
real_data = pytest.mark.skipif(not SHARED.is_dir(), reason=f"measured SBET files are not in {SHARED}")
AIRCRAFT = SHARED / "leeward_sbet_200rec.out"


def plain(n: int = 5) -> np.ndarray:
    records = np.zeros(n, DTYPE)
    records["time"] = np.arange(n)
    return records


def test_record_is_17_little_endian_doubles() -> None:
    assert DTYPE.itemsize == 136 and len(DTYPE.names) == 17
    assert all(DTYPE[name] == np.dtype("<f8") for name in DTYPE.names)


@real_data
@pytest.mark.parametrize("name", ["leeward_sbet_200rec.out", "pdal_2-points.sbet"])
def test_real_files_come_back_bit_for_bit(name: str, tmp_path: Path) -> None:
    records = read_sbet(SHARED / name)
    write_sbet(records, tmp_path / name)
    assert (tmp_path / name).read_bytes() == (SHARED / name).read_bytes()
    assert read_sbet(tmp_path / name).tobytes() == records.tobytes()


def position_rate(records: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """NED velocity from position differences, each over its `seconds`."""

    def mid(values: np.ndarray) -> np.ndarray:
        return 0.5 * (values[1:] + values[:-1])

    meridian, prime = radii_of_curvature(records["latitude"])
    north = np.diff(records["latitude"]) * mid(meridian + records["height"])
    east = np.diff(records["longitude"]) * mid((prime + records["height"]) * np.cos(records["latitude"]))
    return np.stack([north, east, -np.diff(records["height"])], -1) / seconds[:, None]


@real_data
def test_velocity_of_the_aircraft_is_that_of_its_positions() -> None:
    """The file's stamps are rounded (steps of 5.000, 5.001, 5.009 ms): 9 µs at 110 m/s are 1 mm, or 0.16 m/s in 5 ms.

    Its positions lie on an even clock, and there each difference agrees; with the stamps as they are, over 0.25 s.
    """
    records = read_sbet(AIRCRAFT)
    step = np.diff(records["time"])
    velocity = velocity_ned(records)
    middle = 0.5 * (velocity[1:] + velocity[:-1])
    even = position_rate(records, np.full(step.size, step.mean()))
    assert np.abs(even - middle).max() < 0.01  # measured 0.0030
    moved = np.cumsum(position_rate(records, step) * step[:, None], axis=0)
    expected = np.cumsum(middle * step[:, None], axis=0)
    span = records["time"][51:] - records["time"][1:-50]
    over = (moved - expected)[50:] - (moved - expected)[:-50]
    assert np.abs(over / span[:, None]).max() < 0.01  # measured 0.0059


@real_data
def test_aircraft_flies_where_it_heads_and_its_rates_are_against_the_local_level_frame() -> None:
    records = read_sbet(AIRCRAFT)
    velocity = velocity_ned(records)
    drift = heading(records) - np.arctan2(velocity[:, 1], velocity[:, 0])
    assert np.abs((drift + np.pi) % (2 * np.pi) - np.pi).max() < np.deg2rad(10.0)
    platform = rpy_to_dcm(records["roll"], records["pitch"], records["platform_heading"])
    turned = log_so3(np.swapaxes(platform[:-1], 1, 2) @ platform[1:]) / np.diff(records["time"])[:, None]
    rate = np.stack([records[f"rate_{axis}"] for axis in "xyz"], -1)[1:]
    assert np.abs((rate - turned).mean(axis=0)).max() < 2e-6  # Earth rate alone: 5e-5


def test_level_flight_at_constant_velocity() -> None:
    """Rates of a body that keeps its attitude against NED vanish, and f = −g + 2ω×v leaves the Coriolis term alone."""
    latitude, height, n = np.full(4, 0.7), np.full(4, 1500.0), 4
    velocity, rpy = np.tile([60.0, 30.0, -1.0], (n, 1)), np.tile([0.1, -0.05, 2.0], (n, 1))
    dcm = rpy_to_dcm(*rpy.T)
    meridian, prime = radii_of_curvature(latitude)
    east, north = 30.0 / (prime + height), 60.0 / (meridian + height)
    transport = np.stack([east, -north, -east * np.tan(latitude)], -1)
    earth = earth_rate_ned(latitude)
    coriolis = np.cross(2 * earth + transport, velocity)
    force = coriolis - np.stack([0 * height, 0 * height, normal_gravity(latitude, height)], -1)
    to_body = np.swapaxes(dcm, 1, 2)
    ones = np.ones((n, 3))
    trajectory = Trajectory(
        np.arange(n) * 0.01,
        latitude,
        np.full(n, 0.2),
        height,
        velocity,
        rpy,
        ones,
        ones,
        ones,
        np.einsum("nij,nj->ni", to_body, earth + transport),
        np.einsum("nij,nj->ni", to_body, force),
    )
    records = from_trajectory(trajectory)
    np.testing.assert_allclose(velocity_ned(records), velocity, atol=1e-12)
    np.testing.assert_allclose(heading(records), 2.0, atol=1e-12)
    np.testing.assert_array_equal(records["time"], trajectory.time)
    np.testing.assert_array_equal(records["wander"], 0.0)
    np.testing.assert_allclose([records[f"rate_{a}"] for a in "xyz"], 0.0, atol=1e-15)
    acceleration = np.stack([records[f"acceleration_{a}"] for a in "xyz"], -1)
    np.testing.assert_allclose(acceleration, np.einsum("nij,nj->ni", to_body, coriolis), atol=1e-12)


def test_wander_angle_turns_velocity_and_heading_together() -> None:
    records = plain(1)
    records["velocity_x"], records["wander"], records["platform_heading"] = 100.0, 0.3, 0.0
    north, east, _ = velocity_ned(records)[0]
    assert np.arctan2(east, north) == pytest.approx(heading(records)[0]) == pytest.approx(-0.3)


def test_records_become_a_trajectory_and_records_again() -> None:
    """A round trip with all fields drawn at random: equal to rounding, sigmas unknown."""
    rng = np.random.default_rng(5)
    records = plain(50)
    records["time"] += 100.0
    for name, centre, size in (
        ("latitude", 0.7, 0.01), ("longitude", 2.0, 0.01), ("height", 500.0, 5.0), ("velocity_x", 60.0, 5.0),
        ("velocity_y", 10.0, 5.0), ("velocity_z", 0.0, 1.0), ("roll", 0.0, 0.2), ("pitch", 0.0, 0.1),
        ("platform_heading", 1.0, 0.3), *((f"{k}_{a}", 0.0, 0.1) for k in ("acceleration", "rate") for a in "xyz"),
    ):  # fmt: skip
        records[name] = centre + size * rng.standard_normal(records.size)
    trajectory = to_trajectory(records)
    assert np.isnan(trajectory.sigma_position).all() and np.isnan(trajectory.sigma_attitude).all()
    again = from_trajectory(trajectory)
    for name in DTYPE.names:
        np.testing.assert_allclose(again[name], records[name], atol=1e-9, err_msg=name)


@real_data
def test_the_aircrafts_wandering_frame_is_taken_into_account() -> None:
    """Its inertial rates, integrated against Earth rate and the path, must turn it as its attitude does: 1e-6 rad/s.

    The rate of the wander angle is part of that: the file's vertical rate differs by it from that against north, east, down.
    """
    records = read_sbet(AIRCRAFT)
    t = to_trajectory(records)
    dcm = rpy_to_dcm(*t.rpy.T)
    turned = log_so3(np.swapaxes(dcm[:-1], 1, 2) @ dcm[1:]) / np.diff(t.time)[:, None]
    meridian, prime = radii_of_curvature(t.latitude)
    north, east, _ = t.velocity.T
    transport = np.stack([east / prime, -north / meridian, -east * np.tan(t.latitude) / prime], -1)
    against_ned = t.rate - np.einsum("nji,nj->ni", dcm, earth_rate_ned(t.latitude) + transport)
    off = (against_ned[1:] - turned).mean(axis=0)
    print("wander", off)
    assert np.abs(off).max() < 3e-6


def test_sigmas_of_an_smrmsg_come_in_between_its_seconds() -> None:
    trajectory = to_trajectory(plain(5))
    records = np.zeros(6, smrmsg.DTYPE)
    records["time"] = np.arange(6) - 0.5
    records["position_down"], records["heading"] = np.arange(6), 60.0
    with_them = smrmsg.with_sigmas(trajectory, records, Path("x.smrmsg"))
    np.testing.assert_allclose(with_them.sigma_position[:, 2], np.arange(5) + 0.5)
    np.testing.assert_allclose(with_them.sigma_attitude[:, 2], np.deg2rad(1.0))
    records["time"] += 100.0
    with pytest.raises(InputError, match=r"x\.smrmsg: time: spans 99\.5 to 104\.5 s"):
        smrmsg.with_sigmas(trajectory, records, Path("x.smrmsg"))


def damaged(name: str, value: float) -> bytes:
    records = plain()
    records[name][3] = value
    return records.tobytes()


@pytest.mark.parametrize(
    ("content", "place"),
    [
        (b"", "empty"),
        (plain().tobytes()[:-8], "record 4"),
        (damaged("latitude", 2.0), "record 3, latitude"),
        (damaged("rate_z", np.nan), "record 3, rate_z"),
        (damaged("time", 0.5), "record 3, time"),
        (plain().astype(DTYPE.newbyteorder(">")).tobytes()[136:] + b"\x7f" * 136, "record"),
    ],
)
def test_bad_files_end_in_one_line(content: bytes, place: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.sbet"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_sbet(path)
    message = str(caught.value)
    assert place in message and "bad.sbet" in message and "\n" not in message


def test_absent_file_and_wrong_array(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_sbet(tmp_path / "none.sbet")
    with pytest.raises(ValueError, match="SBET dtype"):
        write_sbet(np.zeros(3), tmp_path / "out.sbet")
