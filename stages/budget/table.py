"""The table: variants of all lines pooled into one row a part, beside noise, the base and what neither explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.budget.comparison import DISPLACEMENT, KINDS, Comparison

Array = NDArray[np.float64]

SURE = 2.0  # standard deviations above which a share is told from noise
NOISE_KNOWN = 0.1  # of its variance: how well noise is known


@dataclass(frozen=True)
class Part:
    """A row to be: what was done in words, and whether its share is an error that the base holds, so that it adds up.

    `cannot_tell`: why there is no figure. `pixels` (4,) [px²]: mean squares where they come from elsewhere than the targets.
    """

    name: str
    done: str
    adds: bool = False
    cannot_tell: str | None = None
    pixels: Array | None = None


@dataclass(frozen=True)
class BudgetResult:
    """`rows`: one a part, in the order of the parts; `total`: base, noise, what is explained and what is not, by kind."""

    rows: list[dict[str, Any]]
    total: dict[str, Any]


def run(parts: Sequence[Part], comparisons: Sequence[Comparison]) -> BudgetResult:
    """Pool lines (targets alike) into rows and sum up. Numbers that are not known are None, never NaN."""
    rows = [_row(part, comparisons) for part in parts]
    return BudgetResult(rows, {kind: _total(k, rows, comparisons) for k, kind in enumerate(KINDS)})


def _row(part: Part, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    row: dict[str, Any] = {"part": part.name, "done": part.done, "adds": part.adds, "cannot_tell": part.cannot_tell}
    pixels = np.full(4, np.nan) if part.pixels is None else part.pixels
    pooled = _pool(part.name, comparisons)
    if pooled is not None:
        pixels = _mean(pooled["displacement"])
    row["pixels_rms"] = dict(zip(DISPLACEMENT, map(_number, np.sqrt(pixels)), strict=True))
    for k, kind in enumerate(KINDS):
        row[kind] = _kind(pooled, k)
    return row


def _pool(part: str, comparisons: Sequence[Comparison]) -> dict[str, Array] | None:
    """Arrays (direction, sample, target of any line, …) of a part; None where no line has it."""
    names = ("displacement", "change", "noise", "scatter", "rqe", "base")
    found: dict[str, list[Array]] = {name: [] for name in names}
    for c in comparisons:
        order = sorted((v.direction, v.sample, i) for i, v in enumerate(c.variants) if v.part == part)
        if not order:
            continue
        index = np.array([i for *_, i in order]).reshape(len({d for d, *_ in order}), -1)
        found["displacement"].append(c.displacement[index])
        for name in ("change", "noise", "scatter", "rqe"):
            found[name].append(getattr(c, name)[1:][index])
        found["base"].append(np.broadcast_to(c.rqe[0], found["rqe"][-1].shape))
    return {name: np.concatenate(values, axis=2) for name, values in found.items()} if found["rqe"] else None


def _common(values: Array) -> Array:
    """The targets (direction, sample, target, …) that are known in every direction and sample."""
    other = tuple(i for i in range(values.ndim) if i != 2)
    return values[:, :, np.isfinite(values).all(axis=other)]


def _mean(values: Array) -> Array:
    """Σ over directions of the mean over samples and common targets, (direction, sample, target, …) → (…)."""
    kept = _common(values)
    if kept.shape[2] == 0:
        return np.full(values.shape[3:], np.nan)
    return np.asarray(kept.mean(axis=(1, 2)).sum(axis=0))


def _standard_error(values: Array) -> float:
    """Of `_mean` of values (direction, sample, target): over draws and over targets, in quadrature; NaN where neither tells."""
    kept = _common(values)
    by_sample, by_target = kept.mean(axis=2).sum(axis=0), kept.mean(axis=1).sum(axis=0)
    # Two samples of a direction are its two signs: no draws.
    scattered = [each for each, least in ((by_sample, 3), (by_target, 2)) if kept.size and each.size >= least]
    return float(np.sqrt(sum(each.var(ddof=1) / each.size for each in scattered))) if scattered else np.nan


def _kind(pooled: dict[str, Array] | None, k: int) -> dict[str, Any]:
    """Share of the spectra and change of the score, of one kind (point or area)."""
    names = (
        "change_rms",
        "noise_in_change_rms",
        "share",
        "share_upper",
        "rqe",
        "rqe_change",
        "standard_error",
        "targets",
    )
    out: dict[str, Any] = dict.fromkeys(names)
    if pooled is None:
        return out
    change, noise, scatter = (pooled[name][..., k] for name in ("change", "noise", "scatter"))
    if np.isfinite(_mean(change)):
        out |= share(change, noise, scatter)
    difference = pooled["rqe"][..., k] - pooled["base"][..., k]
    moved = float(_mean(difference))
    if np.isfinite(moved):
        out["targets"] = int(_common(difference).shape[2])
        out["rqe_change"], out["standard_error"] = moved, _number(_standard_error(difference))
        out["rqe"] = float(np.nanmean(pooled["base"][0, 0, :, k])) + moved
    return out


def share(change: Array, noise: Array, scatter: Array) -> dict[str, float | None]:
    """√(mean(change² − noise²)), the change's own part; where it is not told from noise, or noise is not known, a bound alone.

    All (direction, sample, target), see `Comparison`. Samples share the base's noise, so they do not average it out; targets
    and directions do. That the noise is known to `NOISE_KNOWN` only comes on top.
    """
    raw = float(np.sqrt(_mean(change**2)))
    out: dict[str, float | None] = {"change_rms": raw, "share": None, "share_upper": raw}
    noise2 = float(_mean(noise**2))
    if not np.isfinite(noise2):
        return out
    kept = _common(np.stack([change, noise, scatter], axis=-1))[..., 2]
    chance = float(np.sqrt((kept.mean(axis=1) ** 2).sum()) / kept.shape[2])
    error = SURE * float(np.hypot(chance, NOISE_KNOWN * noise2))
    square = raw**2 - noise2
    return out | {
        "noise_in_change_rms": float(np.sqrt(noise2)),
        "share": float(np.sqrt(square)) if square > error or raw == 0.0 else None,
        "share_upper": float(np.sqrt(max(square, 0.0) + error)),
    }


def _total(k: int, rows: Sequence[Mapping[str, Any]], comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Base, noise and sum, of one kind: `rqe`, `noise` and `sigma` (with the lines' own σ) as the score averages, the rest in
    rms, which adds in quadrature; `targets`: RQE and noise of each."""
    names = ("rqe", "noise", "sigma", "rqe_rms", "noise_rms", "explained_rms", "left_rms", "left_upper")
    out: dict[str, Any] = dict.fromkeys(names) | {"targets": {}}
    marked = [row[KINDS[k]] for row in rows if row["adds"] and row[KINDS[k]]["share_upper"] is not None]
    told = [entry["share"] for entry in marked if entry["share"] is not None]
    parts = sum(value**2 for value in told)
    out["parts_rms"] = float(np.sqrt(parts)) if told else None
    out["parts_upper"] = float(np.sqrt(sum(entry["share_upper"] ** 2 for entry in marked))) if marked else None
    lines = list({c.line: c for c in reversed(comparisons)}.values())[::-1]  # a line has its base in each
    if not lines:
        return out
    base, noise, scatter = np.concatenate([np.stack([c.rqe, c.noise, c.scatter])[:, 0, :, k] for c in lines], axis=1)
    sigma = np.concatenate([c.rqe_sigma[:, k] for c in lines])
    known = np.isfinite(base) & np.isfinite(noise)
    if not known.any():
        return out
    base, noise, scatter, sigma = base[known], noise[known], scatter[known], sigma[known]
    left = share(*(a[None, None] for a in (base, noise, scatter)))
    ids = [f"{c.line}/{t}" for c in lines for t in c.targets]
    each = zip(np.array(ids)[known].tolist(), base.tolist(), noise.tolist(), strict=True)
    return out | {
        "targets": {name: {"rqe": b, "noise": n} for name, b, n in each},
        "rqe": float(base.mean()),
        "noise": float(noise.mean()),
        "sigma": float(sigma.mean()),
        "rqe_rms": float(np.sqrt((base**2).mean())),
        "noise_rms": float(np.sqrt((noise**2).mean())),
        "explained_rms": float(np.sqrt((noise**2).mean() + parts)),
        "left_rms": left["share"],
        "left_upper": left["share_upper"],
    }


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
