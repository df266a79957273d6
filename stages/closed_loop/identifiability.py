"""What these data can tell at all, before anything is tested.

    SNR_k = |θ|·√(S_k'K⁻¹S_k with the nuisance projected off)

An effect whose SNR at its plausible size is below the threshold cannot be seen; one whose SNR falls below it only once a rival
is projected off cannot be told from that rival. |cos| alone is too blunt: .989 still separates at high SNR.

Functions
---------
limits     effects and pairs that these data cannot see or separate, at plausible sizes
rivals     effects from which one that was found, at the size found, cannot be told
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.residual_problem import Candidate
from stages.closed_loop.score_test import inverse, project
from stages.closed_loop.separation import would_separate
from stages.closed_loop.signatures import Member

Array = NDArray[np.float64]

FALL = 0.8  # a rival takes at least the rest of the signal-to-noise ratio
ALIKE = 0.7  # |cos| of two signatures that are alike, whatever the data prefer
PREFERRED = 6.0  # of χ²: 20 to 1


@dataclass(frozen=True)
class Limit:
    """Effects that cannot be seen (one) or told apart (several), why, and what would separate them."""

    effects: tuple[str, ...]
    why: str
    would_separate: str


def limits(
    projected: Array,
    where: Sequence[Sequence[int]],
    found: Sequence[Member],
    candidates: Mapping[str, Candidate],
    snr: float,
) -> list[Limit]:
    """At plausible sizes; `projected`: Gram matrix of [N | members | r] with N projected off."""
    effects = list(dict.fromkeys(m.effect for m in found))
    out = [
        Limit((name,), "it leaves no trace in these data", would_separate([name]))
        for name in candidates
        if name not in effects
    ]
    size = {e: _snr(projected, where, found, candidates[e]) for e in effects}
    for e in effects:
        if size[e] < snr:
            why = f"at a plausible size it stands {size[e]:.1f} sigma above the noise beside what the model takes up anyway"
            out.append(Limit((e,), why, would_separate([e])))
    seen = [e for e in effects if size[e] >= snr]
    beside_member = [(m.effect, project(projected, list(columns))) for m, columns in zip(found, where, strict=True)]
    pairs = []
    for i, a in enumerate(seen):
        for b in seen[i + 1 :]:
            beside = {
                one: min(_snr(left, where, found, candidates[one]) for name, left in beside_member if name == other)
                for one, other in ((a, b), (b, a))
            }
            if min(beside.values()) < snr:
                pairs.append((a, b, beside))
    for a, b, beside in pairs:
        why = "; ".join(f"{one} alone {size[one]:.3g} sigma, beside the other {beside[one]:.2g}" for one in (a, b))
        out.append(Limit((a, b), f"at plausible sizes: {why}", would_separate([a, b])))
    return out


def _snr(projected: Array, where: Sequence[Sequence[int]], found: Sequence[Member], candidate: Candidate) -> float:
    """Best of the members, of their best seen parameter at its plausible size."""
    best = 0.0
    for member, columns in zip(found, where, strict=True):
        if member.effect != candidate.effect:
            continue
        sizes = ([1.0] if member.secant else []) + [candidate.parameters[name].size for name in member.names]
        block = projected[np.ix_(columns, columns)]
        best = max(best, float(np.sqrt(np.max(np.array(sizes) ** 2 * np.maximum(np.diag(block), 0.0)))))
    return best


def rivals(
    projected: Array, where: Sequence[Sequence[int]], effects: Sequence[str], index: int, snr: float
) -> dict[str, float]:
    """Other effect → SNR of member `index`, at the size the data show, once that effect is projected off; only those from
    which it cannot be told: it falls below `snr` and by a fifth, and the two are alike or explain the data alike. `effects`:
    whose each member is."""
    own = list(where[index])
    u, block = projected[own, -1], projected[np.ix_(own, own)]
    inv, _ = inverse(block)
    theta = inv @ u
    full = float(u @ theta)  # χ²
    out: dict[str, float] = {}
    for effect, columns in zip(effects, where, strict=True):
        if effect == effects[index]:
            continue
        other = [c for c in columns if projected[c, c] > 0.0]
        if not other:
            continue
        beside = project(projected, other)
        left = np.sqrt(max(float(theta @ beside[np.ix_(own, own)] @ theta), 0.0))
        alike = 1.0 - left**2 / max(full, 1e-300) > ALIKE**2
        inv_other, _ = inverse(projected[np.ix_(other, other)])
        v = projected[other, -1]
        close = full - float(v @ inv_other @ v) < PREFERRED
        if left < snr and left < FALL * np.sqrt(full) and (alike or close):
            out[effect] = min(left, out.get(effect, np.inf))
    return out
