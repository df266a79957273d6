"""Means over bins of time: the one place where samples become fewer.

Functions
---------
binned_means    means over bins of a length, those that hold samples, and how many they hold
block_means     means over the bins that are full
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A bin with less than this share of the samples of the fullest one is not full.
FULL = 0.9


def binned_means(time: Array, values: Array, seconds: float) -> tuple[Array, NDArray[np.int64]]:
    """Means of values (n, ...) over the bins ⌊(t − t_0)/seconds⌋ that hold samples, (b, ...), and their samples' number (b,).

    Times (n,) [s] increase. A stamp that is far off costs no memory: only bins with samples are counted.
    """
    # A stamp that should lie on the edge may miss it by rounding.
    index = np.floor((time - time[0]) / seconds + 1e-9)
    first = np.flatnonzero(np.diff(index, prepend=index[0] - 1.0))
    count = np.diff(first, append=len(time))
    means = np.add.reduceat(values, first, axis=0) / count.reshape(-1, *[1] * (values.ndim - 1))
    return means, count


def block_means(time: Array, values: Array, seconds: float) -> Array:
    """Means of values (n, ...) over the full blocks of `seconds` from the first stamp on, (b, ...).

    A block with less than 90 % of the samples of the fullest one (the tail of the run, or a gap) is not among them: its mean
    would be noisier than the others, and N counts blocks of equal noise.
    """
    means, count = binned_means(time, values, seconds)
    return means[count >= max(1, round(FULL * count.max()))]
