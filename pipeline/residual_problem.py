"""What a stage offers the closed loop: its residual as a function of named effects, and what is needed to judge it.

    r(θ) = data − model(θ) = N·β + S·θ_missing + e,        S = −∂r/∂θ

N are columns that the stage's own model can take up (its nuisance parameters, linearised), β their unknown values, θ the
parameters of candidate effects, all zero in the declared model, and e noise: white, or white and a Gauss–Markov process.

Classes
-------
Parameter        one parameter of a candidate: its unit, what is believed of it, the step of its differences
Candidate        an effect that the declared model may lack
Basis            a covariate with curves of its own
ResidualProblem  the residual with its nuisance, candidates, covariates, groups and noise blocks
joined           several problems of one instrument as one
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
Parameters = Mapping[str, Mapping[str, float]]
"""Effect → parameter → value; what is not named is zero."""


@dataclass(frozen=True)
class Parameter:
    """`largest`, `smallest`: the physical bounds (default: −largest); `plausible`: a size worth naming, which the data must be
    able to show at all (default: largest); `step` of the central differences (default: plausible/1000)."""

    unit: str
    largest: float
    smallest: float | None = None
    plausible: float | None = None
    step: float | None = None

    @property
    def low(self) -> float:
        return -self.largest if self.smallest is None else self.smallest

    @property
    def size(self) -> float:
        return self.largest if self.plausible is None else self.plausible

    @property
    def difference(self) -> float:
        return 1e-3 * self.size if self.step is None else self.step


@dataclass(frozen=True)
class Candidate:
    """An effect with its parameters; null at zero.

    grid: values of the parameters that the residual is not linear in, each entry one start and one test of its own. Where the
    residual there is that of the null (the width of a play whose amplitude is zero), the other parameters are differentiated
    there; where it is not (a lag), the secant from the null to there is the signature. A parameter that an entry puts to
    zero, its null, is left out of the effect where that entry is the one that fits: one axis alone, say.

    shared: parameter → the parameters for which it is one number (adding to each of them): three sensors of one make, say.
    Answers name those; the shared one is how the effect is looked for, and estimated as long as the data do not tell them apart.
    """

    effect: str
    parameters: Mapping[str, Parameter]
    grid: tuple[Mapping[str, float], ...] = ()
    shared: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Basis:
    """A covariate whose curves reach the samples in the stage's own way (as differences, in several channels of unlike noise).

    columns (n, k): curves of the covariate as they show in the samples, none constant in the covariate, the straight line first
    where they are `smooth`, which penalises the others; values (n,): the covariate at each sample, with which the size of an
    effect must not change (NaN: not asked); at (m,) and curves, name → (m, k): what the
    columns stand for, for a table; unit of the covariate, units of the curves by their names; common: a coefficient means
    the same in every problem that has the covariate.
    """

    columns: Array
    values: Array
    at: Array
    curves: Mapping[str, Array]
    unit: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    common: bool = False
    smooth: bool = True

    @classmethod
    def scaled(cls, columns: Array, values: Array, at: Array, curves: Array, named: tuple[str, str, str]) -> Basis:
        """One scale for all columns: what the data say little of is then held small as a curve, not as a signal.

        named: unit of the covariate, what is a curve of it, and its unit.
        """
        unit, name, of = named
        scale = float(np.sqrt(np.mean(columns**2)))
        return cls(columns / scale, values, at, {name: curves / scale}, unit, {name: of})


@dataclass(frozen=True)
class ResidualProblem:
    """A stage's residual (n,), ordered in series of growing time.

    residual    parameters → (n,); every sample of a channel has the same white noise
    group       (n,) what is held out together (branch, minute, line, band); labels of a sample
    series      (n,) samples of different series share no noise; each is one stretch of the ordered samples
    time        (n,) coordinate of the coloured noise, strictly growing within a series
    nuisance    (n, p) columns N of what the stage's own model takes up; those that are zero outside one group are that group's
                own, and are fitted there when it is held out
    channel     (n,) samples of one channel share their noise's variances (default: all of them)
    covariates  name → (n,), NaN: not this sample, or a basis: what the remainder may depend on if no candidate accounts for it
    sigma       the white noise's standard deviation where it is declared, one number or (n,) with NaN where it is not: more
                than it, and serially correlated, is structure
    drifts      whether the noise may be a slow drift, than which a slow signature must be likelier; not where the stage knows its
                noise and has whitened it
    floor       RMS of the residual that is the method's own accuracy: below it nothing is looked for
    unit        of the residual, for a reader
    notes       what a reader must be told of the data, such as what was left out
    unnamed     structure that the stage has found beyond doubt, and taken up in N, though its model knows nothing of it
    beside      what was estimated of the instrument beforehand, that is no candidate, by name
    """

    stage: str
    residual: Callable[[Parameters], Array]
    candidates: tuple[Candidate, ...]
    group: Labels
    series: Labels
    time: Array
    nuisance: Array
    channel: Labels | None = None
    covariates: Mapping[str, Array | Basis] = field(default_factory=dict)
    sigma: float | Array | None = None
    drifts: bool = True
    floor: float = 0.0
    unit: str = "1"
    group_names: Mapping[int, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    unnamed: tuple[str, ...] = ()
    beside: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = self.group.size
        for name in ("series", "time", "nuisance", "channel", "sigma"):
            value = getattr(self, name)
            if value is not None and np.ndim(value) and len(value) != n:
                raise ValueError(f"{self.stage}: {name} has {len(value)} samples, group has {n}")
        for name, covariate in self.covariates.items():
            shape = covariate.values.shape if isinstance(covariate, Basis) else covariate.shape
            if shape != (n,) or (isinstance(covariate, Basis) and len(covariate.columns) != n):
                raise ValueError(f"{self.stage}: covariate {name} has shape {shape}, not ({n},)")
        same = np.diff(self.series) == 0
        if (np.diff(self.time)[same] <= 0).any():
            raise ValueError(f"{self.stage}: time does not grow within a series")
        if 1 + np.count_nonzero(~same) != np.unique(self.series).size:
            raise ValueError(f"{self.stage}: a series is not one stretch of samples")
        names = [c.effect for c in self.candidates]
        if len(set(names)) != len(names):
            raise ValueError(f"{self.stage}: a candidate is named twice: {', '.join(names)}")


def joined(problems: Mapping[str, ResidualProblem]) -> ResidualProblem:
    """Problems of one instrument under one set of parameters, by name (a flight's), one after the other.

    Groups, series, channels, notes, what is unnamed and nuisance are each problem's own; all else is the first's;
    covariates those that all have, of bases the common ones. A single problem stays as it is.
    """
    parts = list(problems.values())
    first = parts[0]
    if len(parts) == 1:
        return first
    if any(np.ndim(0.0 if part.sigma is None else part.sigma) for part in parts):
        raise ValueError(f"{first.stage}: sigmas of single samples cannot be joined")
    own: dict[str, list[Labels]] = {"group": [], "series": [], "channel": []}
    names: dict[int, str] = {}
    for name, part in problems.items():
        channel = np.zeros(part.group.size, int) if part.channel is None else part.channel
        for kind, labels in (("group", part.group), ("series", part.series), ("channel", channel)):
            _, new = np.unique(labels, return_inverse=True)
            start = 1 + int(own[kind][-1].max()) if own[kind] else 0
            own[kind].append(new + start)
        for old, new_label in zip(part.group.tolist(), own["group"][-1].tolist(), strict=True):
            names[new_label] = f"{name} {part.group_names.get(old, old)}"
    shared = [k for k in first.covariates if all(k in part.covariates for part in parts)]
    covariates = {k: _stacked([part.covariates[k] for part in parts]) for k in shared}
    return replace(
        first,
        residual=lambda parameters: np.concatenate([part.residual(parameters) for part in parts]),
        group=np.concatenate(own["group"]),
        series=np.concatenate(own["series"]),
        channel=np.concatenate(own["channel"]),
        time=np.concatenate([part.time for part in parts]),
        nuisance=block_diag(*(part.nuisance for part in parts)),
        covariates={k: v for k, v in covariates.items() if v is not None},
        group_names=names,
        notes=tuple(f"{name}: {note}" for name, part in problems.items() for note in part.notes),
        unnamed=tuple(f"{name}: {one}" for name, part in problems.items() for one in part.unnamed),
    )


def _stacked(parts: Sequence[Array | Basis]) -> Array | Basis | None:
    """One covariate of several problems; None where its coefficients are each problem's own."""
    plain = [part for part in parts if not isinstance(part, Basis)]
    bases = [part for part in parts if isinstance(part, Basis)]
    if not bases:
        return np.concatenate(plain)
    if plain or not all(b.common and b.columns.shape[1] == bases[0].columns.shape[1] for b in bases):
        return None
    widest = max(bases, key=lambda b: float(np.ptp(b.at)))
    return replace(
        widest, columns=np.vstack([b.columns for b in bases]), values=np.concatenate([b.values for b in bases])
    )
