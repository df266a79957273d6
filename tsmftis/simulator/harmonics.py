"""Band-limited random processes as sums of sinusoids: smooth at any time, derivatives exact.

x(t) = Σ_j a_j cos(ω_j t + φ_j), one frequency drawn in each bin of a log-spaced grid (so that nothing repeats within a
flight), a_j² /2 = S(f_j)·Δf_j, φ_j uniform. M. Shinozuka and C.-M. Jan, Digital simulation of random processes and its
applications, J. Sound and Vibration 25 (1972) 111.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Harmonics:
    """amplitude [any], angular_frequency [rad/s], phase [rad], each (channel, term)."""

    amplitude: Array
    angular_frequency: Array
    phase: Array

    def __call__(self, time: Array, derivative: int = 0) -> Array:
        """The process or its derivative at times (n,) [s] → (n, channel)."""
        return np.asarray(
            _sum_of_cosines(
                np.ascontiguousarray(time, float),
                self.amplitude * self.angular_frequency**derivative,
                self.angular_frequency,
                self.phase + derivative * np.pi / 2.0,
            )
        )

    def __add__(self, other: Harmonics) -> Harmonics:
        """The sum of two independent processes with the same channels."""
        return Harmonics(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)], axis=1)
                for name in ("amplitude", "angular_frequency", "phase")
            )
        )

    def integral(self) -> Harmonics:
        """The process whose derivative this is (without a constant)."""
        return Harmonics(self.amplitude / self.angular_frequency, self.angular_frequency, self.phase - np.pi / 2.0)


def draw(
    density: Callable[[Array], Array],
    sigma: Array,
    band: tuple[float, float],
    terms: int,
    rng: np.random.Generator,
) -> Harmonics:
    """Channels of standard deviation sigma (channel,) and spectral density ∝ density(f [Hz]) within the band [Hz]."""
    sigma = np.asarray(sigma, float)
    edges = np.geomspace(*band, terms + 1)
    frequency = edges[:-1] + rng.uniform(size=(sigma.size, terms)) * np.diff(edges)
    power = density(frequency) * np.diff(edges)
    amplitude = sigma[:, None] * np.sqrt(2.0 * power / power.sum(axis=1, keepdims=True))
    return Harmonics(amplitude, 2.0 * np.pi * frequency, rng.uniform(0.0, 2.0 * np.pi, frequency.shape))


@numba.njit(parallel=True, cache=True)
def _sum_of_cosines(time, amplitude, angular_frequency, phase):  # type: ignore[no-untyped-def]
    channels, terms = amplitude.shape
    out = np.empty((time.size, channels))
    for i in numba.prange(time.size):
        for c in range(channels):
            total = 0.0
            for j in range(terms):
                total += amplitude[c, j] * np.cos(angular_frequency[c, j] * time[i] + phase[c, j])
            out[i, c] = total
    return out
