"""The POS measured: time and memory, consistency, outages, lever arm and latency, a car in town, a recorded log.

    python benchmarks/navigation.py speed [HOURS …]          seconds an hour of data and peak memory (0.5 1 3.3333)
    python benchmarks/navigation.py consistency [FLIGHTS]    NEES, NIS, coverage over simulated surveys of two grades (20)
    python benchmarks/navigation.py outages [FLIGHTS]        60 s without fixes, navigation grade, forward and smoothed (10)
    python benchmarks/navigation.py lever-arm [FLIGHTS]      an undeclared lever arm and latency found (20)
    python benchmarks/navigation.py drive [DRIVES]           a car in town, 15 s of every minute withheld, ± standstill (5)
    python benchmarks/navigation.py log CAMPAIGN [PERIOD LENGTH]   a recorded log, LENGTH of every PERIOD s withheld (30 5)

The flights are those of `simulated.py`. What is measured against campaigns of another program stands in `campaigns.py`, the
free-inertial experiment in `free_inertial.py`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import simulated
from numpy.typing import NDArray
from scipy.stats import chi2
from simulated import LEVER, MEMS, RLG, SIGMA_POSITION, SIGMA_VELOCITY

from pipeline.campaign import read_campaign
from pipeline.records import Gnss, Imu
from stages.navigation import NavigationSettings, output, pos, run
from stages.navigation.states import DEFAULT_GROUPS
from tsmftis.camera import Mounting
from tsmftis.rotation import dcm_to_rpy, log_so3, quaternion_to_dcm, rpy_jacobian
from tsmftis.simulator import flight

Array = NDArray[np.float64]

MOUNTING = Mounting(LEVER)
WORKERS = 2


def side_by_side(work: Callable[[int], Any], count: int) -> list[Any]:
    """`work` of the seeds 0 … count − 1, two processes at a time."""
    with ProcessPoolExecutor(WORKERS) as pool:
        return list(pool.map(work, range(count)))


def table(rows: list[tuple[str, Array]]) -> None:
    for name, values in rows:
        print(f"  {name:<46}" + " ".join(f"{v:9.4f}" for v in values))


# --- speed -----------------------------------------------------------------------------------------------------------


def speed(hours: list[str]) -> None:
    """Filter and smoother together on a racetrack at 200 Hz, fixes with velocity at 5 Hz; compiled before the clock starts."""
    wanted = [float(h) for h in hours] or [0.5, 1.0, 3.3333]
    craft = simulated.racetrack(1, 3600.0 * max(wanted))
    rng = np.random.default_rng(1)
    imu = simulated.measured(simulated.ideal(craft, 200.0), RLG.model, rng)
    gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng)
    initial = simulated.attitude_known_to(craft, RLG.sigma_rpy, rng)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "flight.npz"
        np.savez(
            file,
            time=imu.time,
            gyro=imu.gyro,
            accel=imu.accel,
            fix_time=gnss.time,
            fix=np.stack([gnss.latitude, gnss.longitude, gnss.height], 1),
            velocity=gnss.velocity if gnss.velocity is not None else 0.0,
            rpy=initial[1],
        )
        for h in wanted:
            process = subprocess.Popen([sys.executable, __file__, "--one", str(file), str(h)])
            _, status, usage = os.wait4(process.pid, 0)
            if status:
                raise SystemExit(f"the run of {h} h failed")
            print(f"; peak memory of the process {usage.ru_maxrss / 1e6:.2f} GB")


def one_speed(file: str, hours: float) -> None:
    """One run, printed; for a process of its own."""
    with np.load(file) as d:
        stop = int(np.searchsorted(d["time"], 3600.0 * hours))
        imu = Imu(d["time"][:stop], d["gyro"][:stop], d["accel"][:stop])
        upto = slice(0, int(np.searchsorted(d["fix_time"], imu.time[-1])))
        n = upto.stop
        gnss = Gnss(
            d["fix_time"][upto],
            *d["fix"][upto].T,
            np.tile(SIGMA_POSITION, (n, 1)),
            d["velocity"][upto],
            np.tile(SIGMA_VELOCITY, (n, 1)),
            np.ones(n, np.int64),
        )
        initial = (0.5, d["rpy"], RLG.sigma_rpy)
    few = Imu(imu.time[:2000], imu.gyro[:2000], imu.accel[:2000])
    run(few, gnss, RLG.model, MOUNTING, NavigationSettings(), initial=initial)
    started = time.perf_counter()
    result = run(imu, gnss, RLG.model, MOUNTING, NavigationSettings(), initial=initial)
    seconds = time.perf_counter() - started
    print(
        f"{hours:g} h ({imu.time.size} samples, {n} fixes): {seconds:.1f} s, {seconds / hours:.2f} s an hour, "
        f"mean NIS {result.quality['innovation_nis_mean']:.3f} of 6",
        end="",
        flush=True,
    )


# --- consistency -----------------------------------------------------------------------------------------------------

AT = [100.0, 180.0, 260.0, 340.0, 420.0]


def _consistency(seed: int) -> dict[str, tuple[Array, Array, Array, Array, Array]]:
    craft, perfect = simulated.ideal_survey(seed)
    out = {}
    for grade in (RLG, MEMS):
        rng = np.random.default_rng([5, seed])
        imu = simulated.measured(perfect, grade.model, rng)
        gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng)
        initial = simulated.attitude_known_to(craft, grade.sigma_rpy, rng)
        solution, _ = pos.smooth(imu, gnss, grade.model, MOUNTING, NavigationSettings(), initial)
        ahead, after, _, _ = simulated.consistency(craft, solution, AT)
        t = simulated.thinned(output.trajectory(solution, []), 50)
        r, v, rotation = simulated.errors(craft, t)
        scaled = np.concatenate(
            [r / t.sigma_position, v / t.sigma_velocity, _rpy(t.rpy, rotation) / t.sigma_attitude], 1
        )
        nis = solution.store.nis[solution.store.used]
        size = np.array([np.sqrt(np.mean(np.square(x), axis=0)) for x in (r, v, np.rad2deg(rotation))]).ravel()
        out[grade.name] = (ahead, after, (np.abs(scaled) < 1.96).mean(axis=0), nis, size)
    return out


def _rpy(rpy: Array, rotation: Array) -> Array:
    """Errors of roll, pitch, yaw for rotation vectors in NED."""
    return np.asarray(np.einsum("nij,nj->ni", rpy_jacobian(rpy), rotation))


def consistency(count: int) -> None:
    """NEES over 9 navigation states, NIS over 6, and how often 95 % intervals hold, over independent surveys of 450 s."""
    found = side_by_side(_consistency, count)
    low, high = chi2.ppf([0.025, 0.975], 9 * count) / count
    inside = total = 0
    for grade in ("RLG", "MEMS"):
        mine = [f[grade] for f in found]
        print(f"{grade}, {count} flights; NEES of 9, 95 % band {low:.2f} to {high:.2f} at each time {AT}")
        for name, k in (("filter", 0), ("smoother", 1)):
            mean = np.mean([m[k] for m in mine], axis=0)
            inside, total = inside + int(((low <= mean) & (mean <= high)).sum()), total + mean.size
            table([(f"NEES of the {name}", mean)])
            print(f"  … mean over the times {mean.mean():.3f}")
        nis = np.concatenate([m[3] for m in mine])
        band = chi2.ppf([0.025, 0.975], 6 * nis.size) / nis.size
        print(f"  NIS of 6: mean {nis.mean():.3f}, 95 % band {band[0]:.3f} to {band[1]:.3f}")
        coverage = np.mean([m[2] for m in mine], axis=0)
        table([("95 % intervals hold: N E D, vN vE vD, r p y", coverage)])
        print(f"  … over all states and flights {coverage.mean():.4f}")
        table([("RMS m, m/s, ° (N E D each)", np.sqrt(np.mean(np.square([m[4] for m in mine]), axis=0)))])
    print(f"NEES inside its 95 % band: {inside} of {total} times")


# --- outages ---------------------------------------------------------------------------------------------------------

OUTAGES = tuple((start, start + 60.0) for start in (1700.0, 2000.0, 2350.0))


def _outages(seed: int) -> tuple[Array, Array]:
    craft = simulated.racetrack(seed, 2500.0)
    rng = np.random.default_rng([7, seed])
    imu = simulated.measured(simulated.ideal(craft, 100.0), RLG.model, rng)
    gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng)
    initial = simulated.attitude_known_to(craft, RLG.sigma_rpy, rng)
    settings = NavigationSettings(withhold_s=OUTAGES)
    solution, _ = pos.smooth(imu, gnss, RLG.model, MOUNTING, settings, initial)
    trajectory = output.trajectory(solution, [])
    store, stamps = solution.store, solution.problem.imu.time
    ends = np.array([int(np.searchsorted(stamps, stop)) - 2 for _, stop in OUTAGES])
    spans = [slice(*np.searchsorted(stamps, span)) for span in OUTAGES]
    geodetic, _, dcm = simulated.truth(craft, stamps[ends])
    metres = simulated.metres(geodetic)
    off = (geodetic - store.position[ends]) * metres
    q = quaternion_to_dcm(store.q[ends])
    forward = np.stack([np.hypot(off[:, 0], off[:, 1]), off[:, 2], *_angles(dcm, q)], 1)
    smoothed = []
    for span in spans:
        part = trajectory._at(np.arange(span.start, span.stop, 10))
        r, _, rotation = simulated.errors(craft, part)
        angles = _rpy(part.rpy, rotation)
        worst = [np.hypot(r[:, 0], r[:, 1]), r[:, 2], *angles.T]
        smoothed.append([np.abs(w).max() for w in worst])
    return forward, np.array(smoothed)


def _angles(true: Array, estimate: Array) -> tuple[Array, Array, Array]:
    rpy = np.stack(dcm_to_rpy(estimate), -1)
    rotation = log_so3(true @ np.swapaxes(estimate, 1, 2))
    roll, pitch, yaw = _rpy(rpy, rotation).T
    return roll, pitch, yaw


def outages(count: int) -> None:
    """Errors at the end of 60 s without fixes (forward) and at their worst inside (smoothed), navigation grade."""
    found = side_by_side(_outages, count)
    print(f"{count} flights × {len(OUTAGES)} outages of 60 s, RMS: horizontal, vertical [m], roll, pitch, heading [°]")
    unit = np.array([1.0, 1.0, *np.rad2deg([1.0, 1.0, 1.0])])
    for name, k in (("forward filter, at the end", 0), ("smoothed, at its worst inside", 1)):
        table([(name, unit * np.sqrt(np.mean(np.square(np.concatenate([f[k] for f in found])), axis=0)))])


# --- lever arm and latency -------------------------------------------------------------------------------------------

TRUE_LATENCY = 0.040
ALL = (*DEFAULT_GROUPS, "antenna_lever_arm", "gnss_latency")


def _lever_arm(seed: int) -> dict[str, Any]:
    craft, perfect = simulated.ideal_survey(seed)
    out: dict[str, Any] = {}
    for grade in (RLG, MEMS):
        rng = np.random.default_rng([6, seed])
        direction = rng.standard_normal(3)
        added = 0.3 * direction / np.linalg.norm(direction)
        imu = simulated.measured(perfect, grade.model, rng)
        last = float(imu.time[-1]) - 0.3
        gnss = simulated.fixes(craft, last, rng, lever=LEVER + added, latency=TRUE_LATENCY)
        initial = simulated.attitude_known_to(craft, grade.sigma_rpy, rng)
        result = run(imu, gnss, grade.model, MOUNTING, NavigationSettings(estimate=ALL), initial=initial)
        c = result.quality["calibration"]
        off = np.array(
            [
                *(np.array(c["antenna_lever_arm"]["added_to_declared"]) - added),
                c["gnss_latency"]["value"][0] - TRUE_LATENCY,
            ]
        )
        sigma = np.array([*c["antenna_lever_arm"]["sigma"], *c["gnss_latency"]["sigma"]])
        out[grade.name] = (off, sigma, np.array(c["correlation"]), c["sentence"])
    return out


def lever_arm(count: int) -> None:
    """0.3 m of lever arm in a random direction and 40 ms of latency, neither declared, on surveys with turns to both sides."""
    found = side_by_side(_lever_arm, count)
    for grade in ("RLG", "MEMS"):
        off, sigma = (np.array([f[grade][k] for f in found]) for k in (0, 1))
        z = off / sigma
        print(f"{grade}, {count} flights: lever arm x, y, z [m], latency [s]")
        table(
            [
                ("RMS error", np.sqrt((off**2).mean(axis=0))),
                ("mean sigma", sigma.mean(axis=0)),
                ("RMS of error over sigma", np.sqrt((z**2).mean(axis=0))),
                ("within 2 sigma", (np.abs(z) < 2.0).mean(axis=0)),
            ]
        )
        print("  correlation of the last flight:", np.round(found[-1][grade][2], 3).tolist())
        print(f"  {found[-1][grade][3]}")
    for name, calm in (("in gusts", False), ("in calm air", True)):
        straight = simulated.flown([flight.Leg(duration=300.0)], 1, calm=calm)
        rng = np.random.default_rng(1)
        imu = simulated.measured(simulated.ideal(straight, 100.0), RLG.model, rng)
        gnss = simulated.fixes(straight, float(imu.time[-1]) - 0.3, rng, latency=TRUE_LATENCY)
        initial = simulated.attitude_known_to(straight, RLG.sigma_rpy, rng)
        result = run(imu, gnss, RLG.model, MOUNTING, NavigationSettings(estimate=ALL), initial=initial)
        print(f"five minutes straight on {name}: {result.quality['calibration']['sentence']}")


# --- a car -----------------------------------------------------------------------------------------------------------


def _drive(seed: int) -> dict[str, Array]:
    craft = simulated.drive(seed, stops=True)
    rng = np.random.default_rng([8, seed])
    # Road and engine: without them every standstill would be as quiet as the bench.
    imu = simulated.shaken(simulated.measured(simulated.ideal(craft, 100.0), MEMS.model, rng), craft, rng)
    gnss = simulated.fixes(craft, float(imu.time[-1]) - 0.3, rng)
    out = {}
    for name, updates in (("with", True), ("without", False)):
        settings = NavigationSettings(withhold_every_s=(60.0, 15.0), standstill_updates=updates)
        missed = run(imu, gnss, MEMS.model, MOUNTING, settings).quality
        w = missed["withheld"]
        keys = ("horizontal_rms_m", "vertical_rms_m", "forward_horizontal_rms_m", "forward_vertical_rms_m")
        out[name] = np.array([*(w[k] for k in keys), missed["standstill_s"]])
    return out


def town(count: int) -> None:
    """Withheld fixes missed by a car in town that aligns itself, MEMS grade, RMS over the drives."""
    found = side_by_side(_drive, count)
    print(f"{count} drives of 10 min, 15 s of every minute withheld, RMS")
    print("  smoothed horizontal, vertical; forward horizontal, vertical [m]; standstill found [s]")
    for name in ("with", "without"):
        table([(f"{name} standstill updates", np.sqrt(np.mean(np.square([f[name] for f in found]), axis=0)))])


# --- a recorded log --------------------------------------------------------------------------------------------------


def log(arguments: list[str]) -> None:
    """A campaign's first flight, part of its fixes withheld here: what filter and smoother miss of them, in one run."""
    campaign = read_campaign(Path(arguments[0]))
    period, length = (float(a) for a in arguments[1:3]) if len(arguments) > 2 else (30.0, 5.0)
    name, instrument = campaign.keys.flights[0].id, campaign.instrument
    assert instrument.imu is not None and instrument.mounting is not None
    settings = NavigationSettings(withhold_every_s=(period, length))
    quality = run(campaign.imu(name), campaign.gnss(name), instrument.imu, instrument.mounting, settings).quality
    print(f"{campaign.keys.name}: the last {length:g} s of every {period:g} s withheld, {quality['alignment']}")
    for key, value in quality["withheld"].items():
        print(f"  {key:<28}{value:.3f}")
    print(f"  sigma of unit weight        {quality['sigma_of_unit_weight']:.3f}")


def main() -> None:
    what, *rest = sys.argv[1:] or ["speed"]
    if what == "--one":
        one_speed(rest[0], float(rest[1]))
        return
    counted = {
        "consistency": (consistency, 20),
        "outages": (outages, 10),
        "lever-arm": (lever_arm, 20),
        "drive": (town, 5),
    }
    print(f"{os.cpu_count()} cores")
    if what == "speed":
        speed(rest)
    elif what == "log":
        log(rest)
    elif what in counted:
        work, usual = counted[what]
        work(int(rest[0]) if rest else usual)
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
