"""Where a vehicle stands: told by the inertial unit's quiet, learnt where GNSS confirms it.

The data are cut into windows of a second. In each the unrest is the larger of the gyros' and the accelerometers' scatter,
over their medians at confirmed standstill, so one number serves every unit and every engine that idles. Windows are
confirmed where GNSS says that the speed is nothing beside its own sigma. The limit on the unrest is drawn between the
standing and the moving windows of the same log; with it, a window counts also where GNSS is silent. Where the two do not
part, only confirmed windows count.

Functions
---------
find            windows at standstill, with the means that the gyros and accelerometers showed
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pipeline.records import Gnss, Imu
from stages.navigation.velocity import gnss_velocity
from tsmftis.geodesy import EARTH_RATE, local_metres
from tsmftis.inertial import SensorModel

Array = NDArray[np.float64]

WINDOW = 1.0  # s
LEAST_CONFIRMED = 3  # windows
MEDIAN = 31  # windows
USUAL = 2.0  # times its median at standstill: the unrest that a quiet unit reaches now and then
APART = 3.0  # the quietest moving windows must be louder than the standing ones by this factor
SLOWEST = 0.5  # m/s: below it a window never counts as moving
SUREST = 0.4  # m/s: a fix with a larger sigma of velocity confirms nothing
DISPLACED = 0.1  # m over the window: a confirmed window moves less, or less than the fixes' own scatter
SLOW, DRIFT = (
    0.25,
    0.05,
)  # m/s: a confirmed window's fixes and their mean are slower, or within the receiver's own sigma


@dataclass(frozen=True)
class Standstill:
    """Windows (k,): start and stop [s]; mean rate [rad/s] and force [m/s²] (k, 3) as measured, and the mean rate's variance."""

    start: Array
    stop: Array
    rate: Array
    force: Array
    variance: Array

    @classmethod
    def none(cls) -> Standstill:
        empty = np.empty((0, 3))
        return cls(np.empty(0), np.empty(0), empty, empty, empty)

    @property
    def seconds(self) -> float:
        return float((self.stop - self.start).sum())

    def after(self, time: float) -> Standstill:
        """The windows that begin at `time` or later."""
        kept = self.start >= time
        return Standstill(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))

    def holds(self, stamps: Array) -> NDArray[np.bool_]:
        """Which samples, each the mean over the interval that ends at its stamp, lie inside a window (n,)."""
        if not self.start.size:
            return np.zeros(stamps.size, np.bool_)
        window = np.clip(np.searchsorted(self.stop, stamps - 1e-9), 0, self.start.size - 1)
        return np.asarray((stamps > self.start[window] + 1e-9) & (stamps <= self.stop[window] + 1e-9))


def find(imu: Imu, gnss: Gnss, gyro: SensorModel) -> Standstill:
    """Windows in which the body stands. imu: body axes; gyro: the gyros' noise and bias, which bound what a body at rest shows.

    A vehicle in smooth flight is quiet too, but never confirmed: without at least three seconds at rest there are no windows.
    Nor are there any for one that turns on the spot, or hovers: its mean rate is more than Earth rate and bias allow.
    """
    n = imu.time.size
    edges = np.searchsorted(imu.time, np.arange(imu.time[0], imu.time[-1] + WINDOW, WINDOW), side="right")
    edges = np.unique(np.clip(edges, 1, n))
    first, stop = edges[:-1], edges[1:]
    usual = np.median(stop - first) if first.size else 0
    whole = (stop - first) > 0.7 * usual
    first, stop = first[whole], stop[whole]
    if first.size < LEAST_CONFIRMED or usual < 8:
        return Standstill.none()
    mean_gyro, spread_gyro = _moments(imu.gyro, first, stop)
    mean_accel, spread_accel = _moments(imu.accel, first, stop)
    confirmed, moving = _by_gnss(imu, gnss, first, stop)
    # What noise of that size may add to a mean of correlated vibration is taken as a tenth of it.
    allowed = EARTH_RATE + 4.0 * np.sqrt(3.0) * gyro.bias_sigma + 4.0 * gyro.white_noise / np.sqrt(WINDOW)
    turns = np.linalg.norm(mean_gyro, axis=1) > allowed + 0.1 * np.linalg.norm(spread_gyro, axis=1)
    confirmed &= ~turns
    if confirmed.sum() < LEAST_CONFIRMED:
        return Standstill.none()
    # The scatter inside a window, and how far the mean rate is from its usual: a slow steady turn is no standstill.
    rotation, force = np.linalg.norm(spread_gyro, axis=1), np.linalg.norm(spread_accel, axis=1)
    # The usual wanders with the biases, so it is the running median of what confirmed windows say.
    usual_rate = median_filter(mean_gyro[confirmed], size=(MEDIAN, 1), mode="nearest")
    at = np.flatnonzero(confirmed)
    reference = np.stack([np.interp(np.arange(first.size), at, usual_rate[:, i]) for i in range(3)], axis=1)
    turning = np.linalg.norm(mean_gyro - reference, axis=1) / np.sqrt(3.0)
    scale = [float(np.median(v[confirmed])) for v in (rotation, force, turning)]
    scale[2] = max(scale[2], 0.1 * scale[0])  # between two stops they wander further
    unrest = np.max([v / max(s, 1e-12) for v, s in zip((rotation, force, turning), scale, strict=True)], axis=0)
    loudest = max(float(np.percentile(unrest[confirmed], 90.0)), USUAL)
    quietest = float(np.percentile(unrest[moving], 1.0)) if moving.any() else np.inf
    if quietest < APART * loudest:
        # Not parted by the inertial data: only what GNSS itself confirms.
        at_rest = confirmed & (unrest <= loudest)
    else:
        at_rest = (unrest <= min(np.sqrt(loudest * quietest), APART * loudest)) & ~moving
    at_rest &= ~turns
    # A window beside a moving one may hold the first jolt: one is given up at each side.
    inner = at_rest.copy()
    inner[1:] &= at_rest[:-1]
    inner[:-1] &= at_rest[1:]
    first, stop = first[inner], stop[inner]
    start, end = imu.time[first - 1], imu.time[stop - 1]
    variance = np.maximum(
        spread_gyro[inner] ** 2 / (stop - first)[:, None], (gyro.white_noise**2 / (end - start))[:, None]
    )
    return Standstill(start, end, mean_gyro[inner], mean_accel[inner], variance)


def _moments(values: Array, first: NDArray[np.int64], stop: NDArray[np.int64]) -> tuple[Array, Array]:
    """Means and standard deviations (k, 3) of the windows."""
    edges = np.unique(np.concatenate([first, stop]))
    at = np.searchsorted(edges, first)
    last = min(int(edges[-1]), len(values))
    shifted = values[:last] - values[0]
    count = (stop - first)[:, None]
    mean = np.add.reduceat(shifted, edges[edges < last])[at] / count
    np.square(shifted, out=shifted)
    variance = np.add.reduceat(shifted, edges[edges < last])[at] / count - mean**2
    return mean + values[0], np.sqrt(np.maximum(variance, 0.0))


def _by_gnss(
    imu: Imu, gnss: Gnss, first: NDArray[np.int64], stop: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Windows that GNSS confirms to stand, and those it confirms to move; neither where it is silent or unsure."""
    velocity, sigma = gnss_velocity(gnss)
    speed = np.linalg.norm(velocity, axis=1)
    doubt = np.linalg.norm(sigma, axis=1)
    metres = local_metres(
        gnss.latitude, gnss.longitude, gnss.height, gnss.latitude[0], gnss.longitude[0], gnss.height[0]
    )
    start, end = imu.time[first - 1], imu.time[stop - 1]
    confirmed, moving = np.zeros(first.size, np.bool_), np.zeros(first.size, np.bool_)
    for i, (a, b) in enumerate(
        zip(np.searchsorted(gnss.time, start), np.searchsorted(gnss.time, end, side="right"), strict=True)
    ):
        if b <= a:
            continue
        inside = slice(a, b)
        # Receivers have been seen to say zero velocity on the move: the positions must agree.
        around = np.array([max(a - 1, 0), min(b, gnss.time.size - 1)])
        moved = np.linalg.norm(np.diff(metres[around], axis=0))
        confirmed[i] = bool(
            moved < max(DISPLACED, 3.0 * float(np.linalg.norm(gnss.sigma_position[around])))
            and (speed[inside] < np.maximum(3.0 * doubt[inside], SLOW)).all()
            and np.linalg.norm(velocity[inside].mean(axis=0))
            < max(DRIFT, 2.0 * float(doubt[inside].mean()) / np.sqrt(b - a))
            and (doubt[inside] < SUREST).all()
        )
        moving[i] = bool((speed[inside] > np.maximum(3.0 * doubt[inside], SLOWEST)).any())
    return confirmed, moving
