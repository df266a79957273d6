"""Random streams: one a purpose, so that more draws for one purpose leave all others as they were."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *purpose: str) -> np.random.Generator:
    """The generator of a purpose, e.g. stream(7, "gnss"): depends on the seed and the words alone."""
    return np.random.default_rng([seed, *(zlib.crc32(word.encode()) for word in purpose)])
