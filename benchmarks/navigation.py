"""Time and peak memory of the POS (forward filter and smoother together) against the duration of the data.

    python benchmarks/navigation.py [HOURS …]        default 0.5 1 3.3333

The data are of a unit at rest with noise (200 Hz, fixes with velocity at 5 Hz): the work does not hang on the motion. Each
duration runs in a process of its own; compilation is paid before the clock starts.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np

from pipeline.records import Gnss, Imu
from stages.navigation import NavigationSettings, run
from tsmftis.camera import Mounting
from tsmftis.geodesy import earth_rate_ned, normal_gravity
from tsmftis.inertial import DEG_PER_H, MICRO_G, ImuModel, SensorModel

RATE, FIX_RATE = 200.0, 5.0
LATITUDE, LONGITUDE, HEIGHT = np.deg2rad(37.4), np.deg2rad(122.1), 2800.0
MODEL = ImuModel(
    RATE,
    SensorModel(np.deg2rad(0.001) / 60.0, 0.01 * DEG_PER_H, 3600.0, 5e-6),
    SensorModel(12.0 * MICRO_G, 50.0 * MICRO_G, 3600.0, 20e-6),
)


def at_rest(seconds: float) -> tuple[Imu, Gnss]:
    """Noisy data of a level unit heading north."""
    rng = np.random.default_rng(1)
    time_imu = np.arange(1, int(seconds * RATE) + 1) / RATE
    gyro = earth_rate_ned(LATITUDE) + MODEL.gyro.white_noise * np.sqrt(RATE) * rng.standard_normal((time_imu.size, 3))
    gravity = np.array([0.0, 0.0, -float(normal_gravity(LATITUDE, HEIGHT))])
    accel = gravity + MODEL.accel.white_noise * np.sqrt(RATE) * rng.standard_normal((time_imu.size, 3))
    time_fix = np.arange(1, int(seconds * FIX_RATE)) / FIX_RATE
    offset = 0.02 * rng.standard_normal((time_fix.size, 3))
    gnss = Gnss(
        time_fix,
        LATITUDE + offset[:, 0] / 6.36e6,
        LONGITUDE + offset[:, 1] / (6.38e6 * np.cos(LATITUDE)),
        HEIGHT - offset[:, 2],
        np.full(offset.shape, 0.02),
        0.02 * rng.standard_normal(offset.shape),
        np.full(offset.shape, 0.02),
        np.ones(time_fix.size, np.int64),
    )
    return Imu(time_imu, gyro, accel), gnss


def measure(hours: float) -> None:
    """One run, printed; for a process of its own."""
    initial = (0.005, np.zeros(3), np.deg2rad([0.05, 0.05, 0.5]))
    mounting = Mounting(np.array([0.45, -0.2, -1.35]))
    run(*at_rest(10.0), MODEL, mounting, NavigationSettings(), initial=initial)
    imu, gnss = at_rest(3600.0 * hours)
    started = time.perf_counter()
    result = run(imu, gnss, MODEL, mounting, NavigationSettings(), initial=initial)
    seconds = time.perf_counter() - started
    print(
        f"{hours:g} h ({imu.time.size} samples, {gnss.time.size} fixes): {seconds:.1f} s, {seconds / hours:.1f} s an hour, "
        f"mean NIS {result.quality['innovation_nis_mean']:.3f} of 6",
        end="",
        flush=True,
    )


def main() -> None:
    if sys.argv[1:2] == ["--one"]:
        measure(float(sys.argv[2]))
        return
    print(f"{os.cpu_count()} cores")
    for hours in sys.argv[1:] or ("0.5", "1", "3.3333"):
        process = subprocess.Popen([sys.executable, __file__, "--one", hours])
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"the run of {hours} h failed")
        print(f"; peak memory of the process {usage.ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
