"""What a unit's bias differs by from one start to the next: one unknown offset for each chamber run, integrated out.

A run's offset o_r ~ N(0, (t·σ)²), σ the noise of a block, adds t²·σ²·1·1ᵀ to the noise of its blocks. Whitened, blocks have
covariance σ²·(I + t²·u·uᵀ), u what whitening makes of the 1; v → v − (1 − g)·û·(ûᵀv), g = 1/√(1 + t²·|u|²), whitens this too
and costs the evidence ½·ln g² a run. A run without attitude has its own mean for a reference: there t is infinite, the component
along û says nothing, and the run has one row less.

Classes
-------
Offsets     which blocks are of which run, and which runs' level means something
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Offsets:
    """Runs one after the other: where each begins and ends among the blocks, and whether its level is known (by attitude)."""

    runs: tuple[slice, ...]
    known: tuple[bool, ...]

    @classmethod
    def of(cls, run: NDArray[np.int64], known: NDArray[np.bool_]) -> Offsets:
        """From the number of the run of each block (N,), which does not fall, and whether runs' levels are known (R,)."""
        edges = np.r_[0, np.flatnonzero(np.diff(run)) + 1, len(run)]
        return cls(tuple(slice(int(a), int(b)) for a, b in pairwise(edges)), tuple(map(bool, known)))

    @property
    def finite(self) -> bool:
        """Whether the size of offsets is a parameter: one level alone has nothing to differ from."""
        return sum(self.known) > 1

    @property
    def anchored(self) -> bool:
        """Whether any run tells the level of the bias, and not only its change."""
        return any(self.known)

    def freed(self, values: Tensor, ones: Tensor, ratio: Tensor) -> Tensor:
        """Whitened rows (N, q) freed of the runs' offsets of t = `ratio`; `ones` (N,) is the whitened constant."""
        parts = []
        for run, known in zip(self.runs, self.known, strict=True):
            v, u = values[run], ones[run]
            square = u.square().sum()
            if not known:
                # A reflection that carries û to the first axis, whose row is then left out.
                w = (u / square.sqrt()).clone()
                w[0] += 1.0
                v = (v - torch.outer(w, w @ v) * (2.0 / w.square().sum()))[1:]
            elif self.finite:
                v = v - torch.outer(u, u @ v) * ((1.0 - torch.rsqrt(1.0 + ratio**2 * square)) / square)
            parts.append(v)
        return torch.cat(parts)

    def volume(self, ones: Tensor, ratio: Tensor) -> Tensor:
        """What ln evidence of the freed rows lacks."""
        total = ones.new_zeros(())
        for run, known in zip(self.runs, self.known, strict=True):
            square = ones[run].square().sum()
            if not known:
                total = total - 0.5 * square.log()
            elif self.finite:
                total = total - 0.5 * torch.log1p(ratio**2 * square)
        return total

    def estimated(self, residual: Tensor, ones: Tensor, ratio: Tensor) -> Array:
        """The runs' offsets (R,), most probable ones given whitened residuals (N,) of the function."""
        found = []
        for run, known in zip(self.runs, self.known, strict=True):
            u = ones[run]
            square, along = u.square().sum(), u @ residual[run]
            if not known:
                found.append(float(along / square))
            else:
                found.append(float(along * ratio**2 / (1.0 + ratio**2 * square)) if self.finite else 0.0)
        return np.array(found)

    def columns(self, count: int) -> Array:
        """For least squares: ones where a run with an offset has its blocks, (N, R')."""
        free = [run for run, known in zip(self.runs, self.known, strict=True) if not known or self.finite]
        made = np.zeros((count, len(free)))
        for i, run in enumerate(free):
            made[run, i] = 1.0
        return made

    def weights(self, ratio: float) -> Array:
        """1/t of each of these columns (R',), 0 where the level is unknown."""
        return np.array([1.0 / ratio if known else 0.0 for known in self.known if not known or self.finite])
