"""What the closed loop is offered of all chamber runs: bias minus what the stage's own model could learn of it.

    r(θ) = [b − A·(play(T; h) − T)/h − (f(x_τ) − f(x))]/σ,        N = [level of each run, x, smooth functions of x]

b are block means of output minus reference, the six channels one after the other, σ the noise of a channel's block, x its
features (T, Ṫ, and ∇T1, ∇T2 where a gyro has three thermometers), which a lag τ makes x_τ for the gyros. N is what the
network could learn of x (`smooth.py`); f, the function that a lag acts on, is fitted to the same blocks. Rate and gradients
belong to N: without them a lag "explains" clean instruments. f is that of x, unless x of some lag explains the data better
beyond doubt: a function fitted to lagged features has learnt some of the very noise that it is then tested on.

Of a single thermometer with three branches or more, N is a curve in T, with the rate where it predicts branches held out
better by a tenth, unless one history for the whole unit does better still: rate and history are one another's image there.

A is looked for as one number that the gyros share, one that the accelerometers share, one of each channel alone, and several.

Functions
---------
residual_problem    of chamber runs
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Chamber
from pipeline.residual_problem import Candidate, Parameter, Parameters, ResidualProblem
from stages.thermal import memory as history
from stages.thermal import smooth
from stages.thermal.binning import block_means
from stages.thermal.branches import branches, held_out, pieces
from stages.thermal.features import NAMES, STEPS_PER_TIME_CONSTANT, smoothed
from stages.thermal.memory import Memory
from stages.thermal.settings import ThermalSettings
from stages.thermal.smooth import Curve, Smooth, Task
from stages.thermal.targets import CHANNELS, thinned
from stages.thermal.training import LEAST_SPAN, TrainingSet, training_set
from tsmftis.effects import EFFECTS, scalars

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

BLOCKS = 400  # of all runs together: what a thermal time constant can fill, and a kernel matrix costs little
SHORTEST_BLOCK_S = 10.0
BRANCHES = 3  # of a single thermometer, from which they are held out one by one
HELPS = 0.9  # of the RMS in held-out branches, that a richer model of a single thermometer must come under
DEGREES = (1, 2, 3, 4, 5, 6)  # of the curve in its temperature
HALF_WIDTHS = (0.04, 0.08, 0.16, 0.32)  # of the span; less looks like the noise and the delay of thermometers
LAGS_S = (30.0, 100.0, 300.0, 900.0)
LAG_STEP_S = 2.0
PLAUSIBLE_SHARE = 0.3  # of the RMS of a channel's bias: an amplitude worth naming
PLAUSIBLE_LAG_S = 100.0
PAST_S = 1800.0  # over which the covariate "history" remembers
DOUBT = 10.0  # nats by which a lag must be likelier than none before f is one of lagged features


@dataclass(frozen=True)
class Run:
    """A chamber run, thinned: times of its blocks (n,) [s] and its smoothed mean temperatures (m, 6)."""

    chamber: Chamber
    time: Array
    times: Array
    mean: Array
    block_s: float

    @classmethod
    def of(cls, chamber: Chamber, settings: ThermalSettings) -> Run:
        c = thinned(chamber, settings.block_s, settings.smoothing_s / STEPS_PER_TIME_CONSTANT)
        times, mean = history.means(c.temperatures, settings.smoothing_s, settings.causal)
        time = block_means(c.time, c.time[:, None], settings.block_s)[:, 0]
        return cls(c, time, times, mean, settings.block_s)

    def behind(self, half_width: float) -> Array:
        """Block means (n, 6) of (play − T)/h."""
        at = self.chamber.time
        return block_means(at, history.behind(self.times, self.mean, half_width, at), self.block_s)

    def felt(self, lag: float, settings: ThermalSettings) -> tuple[Array, Array]:
        """Block means (n, 6) of T after a lag [s], and of its rate."""
        t = self.chamber.temperatures
        mean = history.lagged(t.time, Memory().felt(t), lag) if lag > 0.0 else Memory().felt(t)
        value, rate = smoothed(t.time, mean, self.chamber.time, settings.smoothing_s, settings.causal)
        blocks = block_means(self.chamber.time, np.hstack([value, rate]), self.block_s)
        return blocks[:, :6], blocks[:, 6:]


@dataclass(frozen=True)
class Axis:
    """One channel: number, bias (N,), features (N, F), those `used` (F,) that vary and belong to the model, noise σ of a block.

    `degree` of the curve in T that is its model; None where that is all the network could learn.
    """

    number: int
    bias: Array
    features: Array
    used: NDArray[np.bool_]
    sigma: float
    degree: int | None = None

    @classmethod
    def of(cls, number: int, data: TrainingSet) -> Axis:
        bias, features = data.bias[:, number], data.features[number]
        used = np.ptp(features, axis=0) >= LEAST_SPAN[: features.shape[1]]
        return cls(number, bias, features, used, _noise(bias, data.starts))

    def scaled(self, features: Array) -> Array:
        """Features (N, F) in standard deviations about their mean, those that vary."""
        mean, spread = self.features.mean(axis=0), self.features.std(axis=0)
        return np.asarray(((features - mean) / np.where(self.used, spread, 1.0))[:, self.used])

    @property
    def lags(self) -> bool:
        return self.number < 3 and bool(self.used[0])

    def curve(self, degree: int, temperature: Array) -> Array:
        """Columns (N, degree) of a polynomial in a temperature (N,) that need not be the measured one."""
        x = ((temperature - self.features[:, 0].mean()) / self.features[:, 0].std())[:, None]
        return np.column_stack([x, Curve.of(degree, x, self.bias, np.ones((len(x), 1)), 1.0).columns])


def _noise(bias: Array, starts: NDArray[np.bool_]) -> float:
    """Of a block, from the differences of neighbours: no more than a scale."""
    steps = np.diff(bias)[~starts[1:]]
    size = 1.4826 * float(np.median(np.abs(steps - np.median(steps)))) / np.sqrt(2.0)
    return max(size, 1e-6 * float(np.abs(bias).max()), 1e-300)


def residual_problem(
    train: Sequence[Chamber],
    verify: Sequence[Chamber],
    settings: ThermalSettings,
    effects: Mapping[str, Mapping[str, Any]] | None = None,
) -> ResidualProblem:
    """Of all runs together, r in noises of a block.

    Thermal `effects` (nested, as in a model update) belong to the model already and are no candidates; those of other stages do
    not matter. Every run has a level of its own: a loop tells shapes, not levels.
    """
    known = {name: values for name, values in (effects or {}).items() if EFFECTS[name].stage == "thermal"}
    chambers = [*train, *verify]
    total = sum(float(c.time[-1] - c.time[0]) for c in chambers)
    settings = settings.model_copy(update={"block_s": max(total / BLOCKS, SHORTEST_BLOCK_S)})
    data = training_set(chambers, settings, Memory.of(known))
    runs = [Run.of(c, settings) for c in chambers]
    axes = [Axis.of(i, data) for i in range(6) if not data.refused[i]] or [Axis.of(i, data) for i in range(6)]
    levels = np.column_stack([1.0 * (data.run == i) for i in range(len(runs))])
    branch, called = _branches(runs, data.run, axes[0].features[:, 0])
    if data.thermometers == 1 and len(called) >= BRANCHES:
        group, names = branch, called
        axes = _simplest(axes, levels, branch, runs, settings)
    else:
        group = pieces(data.run)
        names = {int(k): f"stretches in turn, group {k + 1}" for k in np.unique(group)}
    return _Builder(settings, data, runs, axes, known, levels, group, names, len(called) == 1).problem()


def _branches(runs: Sequence[Run], run: Labels, temperature: Array) -> tuple[Labels, dict[int, str]]:
    """Branch of each block (N,) of all runs, and their names."""
    group = np.empty(len(run), np.int64)
    names: dict[int, str] = {}
    for r, one in enumerate(runs):
        label, rising = branches(temperature[run == r])
        group[run == r] = label + len(names)
        names |= {
            len(names) + k: f"{one.chamber.name}, {'heating' if up else 'cooling'} ({k + 1})"
            for k, up in enumerate(rising)
        }
    return group, names


def _simplest(
    axes: Sequence[Axis], levels: Array, branch: Labels, runs: Sequence[Run], settings: ThermalSettings
) -> list[Axis]:
    """Models of the channels of a single thermometer: the curve in T, and whether the rate belongs to it, that best predict
    branches (N,) held out. A richer model must do so by a tenth.

    Rate, lag and play are one another's image there (f(T_τ) ≈ f(T) − τ·f'·Ṫ). The rate of a channel gives way to history where
    one history for the whole unit, beside curves in T alone, predicts better by a tenth in the mean over all channels.
    """
    if not all(a.used[:2].all() for a in axes):
        return list(axes)
    best, lowest = [], len(axes) * float(np.log(HELPS))
    for axis in axes:
        t = axis.features[:, 0]
        degree, error = _degree(axis, levels, t, branch)
        with_rate, lower = _degree(axis, np.column_stack([levels, axis.features[:, 1]]), t, branch)
        rate = lower < HELPS * error
        used = axis.used & np.array([True, rate])
        best.append(replace(axis, used=used, degree=with_rate if rate else degree))
        lowest += float(np.log(lower if rate else error))
    for beside, temperature in _histories(axes, runs, settings):
        trial, missed = [], 0.0
        for axis, column, t in zip(axes, beside.T, temperature.T, strict=True):
            degree, error = _degree(axis, np.column_stack([levels, column]), t, branch)
            trial.append(replace(axis, used=axis.used & np.array([True, False]), degree=degree))
            missed += float(np.log(error))
        if missed < lowest:
            best, lowest = trial, missed
    return best


def _histories(axes: Sequence[Axis], runs: Sequence[Run], settings: ThermalSettings) -> Iterator[tuple[Array, Array]]:
    """For each width of a play, each lag: the column beside a channel's curve, and the temperature of that (N, axes)."""
    numbers = [a.number for a in axes]
    present = np.column_stack([a.features[:, 0] for a in axes])
    span = float(np.ptp(present, axis=0).max())
    for share in HALF_WIDTHS:
        yield np.vstack([r.behind(share * span) for r in runs])[:, numbers], present
    for lag in LAGS_S:
        late = np.vstack([r.felt(lag, settings)[0] for r in runs])[:, numbers]
        yield np.zeros_like(present), np.where([a.lags for a in axes], late, present)


def _degree(axis: Axis, flat: Array, temperature: Array, branch: Labels) -> tuple[int, float]:
    """Degree of the curve in a temperature (N,), beside columns `flat` (N, p), and its RMS in branches held out."""
    best, lowest = 1, np.inf
    for degree in DEGREES:
        missed = held_out(np.column_stack([flat, axis.curve(degree, temperature)]), axis.bias, branch)
        if missed < HELPS * lowest:
            best, lowest = degree, missed
    return best, max(lowest, 1e-300)


@dataclass(frozen=True)
class _Builder:
    settings: ThermalSettings
    data: TrainingSet
    runs: Sequence[Run]
    axes: Sequence[Axis]
    known: Mapping[str, Mapping[str, Any]]
    levels: Array
    group: Labels
    names: Mapping[int, str]
    monotone: bool

    def problem(self) -> ResidualProblem:
        n = len(self.data.bias)
        time = np.concatenate([r.time for r in self.runs])
        levels = self.levels
        span = float(np.ptp(np.vstack([r.mean for r in self.runs]), axis=0).max())
        widths = [share * max(span, LEAST_SPAN[0]) for share in HALF_WIDTHS]
        behind = lru_cache(maxsize=64)(lambda h: np.vstack([r.behind(h) for r in self.runs]))
        felt = lru_cache(maxsize=64)(self._felt)
        plays = "thermal_hysteresis" not in self.known
        lags = "thermal_lag" not in self.known and any(a.lags for a in self.axes)
        past = [felt(lag)[0] - felt(0.0)[0] for lag in LAGS_S] if lags else []
        beside, fits = [], []
        for axis in self.axes:
            x = axis.scaled(axis.features)
            columns = [behind(h)[:, axis.number] for h in widths] if plays else []
            columns += [p[:, axis.number] for p in past] if axis.lags else []
            beside.append(_independent(np.column_stack([levels, x]), columns))
            fits.append(self._fit(axis, x, levels, beside[-1], time))
        own = [
            np.column_stack([levels, axis.scaled(axis.features), fit.columns])
            for axis, fit in zip(self.axes, fits, strict=True)
        ]
        if self.monotone:  # there play and lag are functions of T like any other, and only T and time can be told
            own = [np.column_stack([c, b]) for c, b in zip(own, beside, strict=True)]
        # What N can take up anyway is taken out beforehand, so that a channel's RMS is that of what is left.
        bias = [
            axis.bias - c @ np.linalg.lstsq(c, axis.bias, rcond=None)[0] for axis, c in zip(self.axes, own, strict=True)
        ]
        sigma = [fit.sigma for fit in fits]
        functions = self._functions(fits, levels, beside, time, felt) if lags else {}
        null = {i: f(self.axes[i].scaled(self.axes[i].features)) for i, f in functions.items()}

        def residual(parameters: Parameters) -> Array:
            play = parameters.get("thermal_hysteresis", {})
            lag = parameters.get("thermal_lag", {}).get("lag", 0.0)
            out = np.empty((len(self.axes), n))
            for i, axis in enumerate(self.axes):
                sensor, letter = CHANNELS[axis.number].split("_")
                left = bias[i]
                if size := play.get(f"{sensor}.{letter}", 0.0) + play.get(sensor, 0.0):
                    left = left - size * behind(play["half_width"])[:, axis.number]
                if lag > 0.0 and i in functions:
                    left = left - (functions[i](axis.scaled(self._lagged(axis, felt(lag)))) - null[i])
                out[i] = left / sigma[i]
            return out.ravel()

        count = len(self.axes)
        made = []
        for i, model in enumerate(own):
            wide = np.zeros((count, n, model.shape[1]))
            wide[i] = model
            made.append(wide.reshape(count * n, -1))
        candidates = [self._hysteresis(widths, span)] if plays else []
        candidates += [self._lag(total=float(sum(np.ptp(r.time) for r in self.runs)))] if lags else []
        return ResidualProblem(
            stage="thermal",
            residual=residual,
            candidates=tuple(candidates),
            group=np.tile(self.group, count),
            series=np.concatenate([i * len(self.runs) + self.data.run for i in range(count)]),
            time=np.tile(time, count),
            nuisance=np.hstack(made),
            channel=np.repeat([a.number for a in self.axes], n),
            covariates=self._covariates(time, felt),
            unit="noises of a block",
            group_names=self.names,
        )

    def _felt(self, lag: float) -> tuple[Array, Array]:
        parts = [r.felt(lag, self.settings) for r in self.runs]
        return np.vstack([p[0] for p in parts]), np.vstack([p[1] for p in parts])

    def _lagged(self, axis: Axis, felt: tuple[Array, Array]) -> Array:
        """Features (N, F) of an axis with T and Ṫ after a lag."""
        return np.column_stack([felt[0][:, axis.number], felt[1][:, axis.number], axis.features[:, 2:]])

    def _fit(self, axis: Axis, x: Array, levels: Array, memories: Array, time: Array) -> Smooth | Curve:
        """What the channel's model can take up; of a temperature that hardly moves a straight line is all."""
        if axis.degree is not None or x.shape[1] == 0:
            return Curve.of(axis.degree or 1, x, axis.bias, levels, axis.sigma)
        task = Task(x, axis.bias, np.column_stack([levels, x, memories]), self.data.run, time)
        return Smooth.of(smooth.find(task), x, axis.bias, levels)

    def _functions(
        self, fits: Sequence[Smooth | Curve], levels: Array, memories: Sequence[Array], time: Array, felt: Any
    ) -> dict[int, Smooth | Curve]:
        """The function of each gyro that a lag acts on."""
        mine = {i: f for i, f in enumerate(fits) if self.axes[i].lags}
        learnt = {i: f for i, f in mine.items() if isinstance(f, Smooth)}
        best: tuple[float, dict[int, Smooth]] = (0.0, learnt)
        flat = {i: np.column_stack([levels, fits[i].x, memories[i]]) for i in learnt}
        nothing = self._evidence(learnt, 0.0, flat, time, felt)
        for lag in LAGS_S:
            gain = self._evidence(learnt, lag, flat, time, felt) - nothing - DOUBT
            if gain > best[0]:
                made = {}
                for i, f in learnt.items():
                    axis = self.axes[i]
                    x = axis.scaled(self._lagged(axis, felt(lag)))
                    made[i] = Smooth.of(f.kernel, x, axis.bias, levels)
                best = (gain, made)
        return mine | best[1]

    def _evidence(
        self, fits: Mapping[int, Smooth], lag: float, flat: Mapping[int, Array], time: Array, felt: Any
    ) -> float:
        """Of features after a lag, the same columns with flat priors beside them whatever the lag."""
        total = 0.0
        for i, f in fits.items():
            axis = self.axes[i]
            x = axis.scaled(self._lagged(axis, felt(lag)))
            task = Task(x, axis.bias, flat[i], self.data.run, time)
            total += smooth.evidence(task, f.kernel)
        return total

    def _hysteresis(self, widths: Sequence[float], span: float) -> Candidate:
        effect, numbers = EFFECTS["thermal_hysteresis"], {CHANNELS[a.number]: a for a in self.axes}
        parameters = {}
        for name, key in scalars("thermal_hysteresis").items():
            if key == "half_width":
                high = min(effect.largest[key], max(0.5 * span, 2.0 * effect.least[key]))
                parameters[name] = Parameter(
                    effect.units[key], high, effect.least[key], min(0.1 * span, high), step=2e-3 * max(span, 0.1)
                )
            elif (axis := numbers.get(name.replace(".", "_"))) is not None:
                size = min(PLAUSIBLE_SHARE * float(axis.bias.std()), effect.largest[key])
                parameters[name] = Parameter(effect.units[key], effect.largest[key], plausible=size)
        names = [name for name in parameters if name != "half_width"]
        shared = {}
        for sensor in ("gyro", "accel"):
            mine = tuple(n for n in names if n.startswith(sensor))
            if len(mine) > 1:
                size = float(np.median([parameters[n].size for n in mine]))
                parameters[sensor] = replace(parameters[mine[0]], plausible=size)
                shared[sensor] = mine
        sets = {tuple(n for n in names if n.startswith(which)) for which in ("", "gyro", "accel", *names)} - {()}
        sets |= {(sensor,) for sensor in shared}
        grid = [
            {"half_width": h} | {n: 0.0 for n in parameters if n not in some and n != "half_width"}
            for h in widths
            for some in sorted(sets, key=lambda s: (len(s), s))
        ]
        return Candidate("thermal_hysteresis", parameters, tuple(grid), shared)

    def _lag(self, total: float) -> Candidate:
        effect = EFFECTS["thermal_lag"]
        largest = min(effect.largest["lag"], max(0.5 * total, 2.0 * LAG_STEP_S))
        parameter = Parameter(effect.units["lag"], largest, 0.0, min(PLAUSIBLE_LAG_S, largest), LAG_STEP_S)
        return Candidate("thermal_lag", {"lag": parameter}, tuple({"lag": v} for v in LAGS_S if v < largest))

    def _covariates(self, time: Array, felt: Any) -> dict[str, Array]:
        n, count = len(time), len(self.axes)
        value, rate = felt(0.0)
        past = felt(PAST_S)[0]
        out = {}
        for i, axis in enumerate(self.axes):
            own = {"time": time, "T": value[:, axis.number], "dT/dt": rate[:, axis.number]}
            own["history"] = value[:, axis.number] - past[:, axis.number]
            own |= {name: f for name, f in zip(NAMES[2:], axis.features[:, 2:].T, strict=False)}
            for name, values in own.items():
                wide = np.full((count, n), np.nan)
                wide[i] = values
                out[f"{name} ({CHANNELS[axis.number]})"] = wide.ravel()
        return out


def _independent(flat: Array, columns: Sequence[Array]) -> Array:
    """Those directions of `columns` [(N,), …] that `flat` (N, p) does not hold, orthonormal (N, q)."""
    if not columns:
        return np.zeros((len(flat), 0))
    c = np.column_stack(columns)
    c = c / np.maximum(np.linalg.norm(c, axis=0), 1e-300)
    c = c - flat @ np.linalg.lstsq(flat, c, rcond=None)[0]
    u, s, _ = np.linalg.svd(c, full_matrices=False)
    return np.asarray(u[:, s > 1e-3])
