"""Chamber runs → a thermal model: blocks of targets and features, and the predictors of each channel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Chamber
from stages.thermal.baselines import Free, fit_multi_polynomial, fit_polynomial, fit_traditional_rbf
from stages.thermal.binning import block_means
from stages.thermal.features import STEPS_PER_TIME_CONSTANT, channel_features, stuck_thermometers
from stages.thermal.memory import Memory
from stages.thermal.model import ChannelModel, Predictor, ThermalModel
from stages.thermal.network import BayesianRbf, fit_network
from stages.thermal.offsets import Offsets
from stages.thermal.oracles import fit_gaussian_process, fit_ridge
from stages.thermal.settings import ThermalSettings
from stages.thermal.targets import CHANNELS, bias_samples, refuse_motion, thinned
from tsmftis.inertial import DEG_PER_H, MICRO_G

Array = NDArray[np.float64]

# A feature that spans less than this in the chamber is noise: temperature and gradients [K], rate [K/s].
LEAST_SPAN = (0.5, 1e-3, 0.5, 0.5)
FEWEST_BLOCKS = 20
# Blocks as alike as this, one to the next, are not independent.
COLOURED = 0.3
# A sample of hyperparameters worth fewer draws than this says little about their width.
FEWEST_DRAWS = 5.0
# A level beyond so many sigmas of turn-on bias and change together is rather of a wrong attitude: units of the simulator's
# presets reach 5, a tilt of a tenth of a degree or a yaw of a degree makes 10 of a good one.
SUSPECT_LEVEL = 10.0


@dataclass(frozen=True)
class TrainingSet:
    """Blocks of all runs: bias (N, 6), features of each channel (N, F), which run each block is of (N,), why a channel cannot be
    taught, and how many thermometers a gyro has."""

    bias: Array
    run: NDArray[np.int64]
    features: tuple[Array, ...]
    refused: tuple[str, ...]
    thermometers: int

    @property
    def starts(self) -> NDArray[np.bool_]:
        """Which blocks begin a run (N,)."""
        return np.diff(self.run, prepend=-1) > 0


def training_set(train: Sequence[Chamber], settings: ThermalSettings, memory: Memory | None = None) -> TrainingSet:
    """Block means of bias and features, the runs one after the other; what the unit's `memory` makes is no part of them."""
    memory = memory or Memory()
    bias: list[Array] = []
    features: list[list[Array]] = [[] for _ in CHANNELS]
    refused = [""] * 6
    step = settings.smoothing_s / STEPS_PER_TIME_CONSTANT
    thermometers = _thermometers(train)
    for chamber in (thinned(c, settings.block_s, step) for c in train):
        refuse_motion(chamber, settings.block_s)
        remembered = memory.bias(chamber.temperatures, chamber.time, settings.smoothing_s, settings.causal)
        if chamber.attitude is None:
            remembered = remembered - remembered.mean(axis=0)  # as the samples are
        bias.append(block_means(chamber.time, bias_samples(chamber) - remembered, settings.block_s))
        where = f"chamber run {chamber.name}"
        felt = memory.felt(chamber.temperatures)
        made = channel_features(chamber.temperatures, chamber.time, settings.smoothing_s, settings.causal, where, felt)
        for i, f in enumerate(made):
            features[i].append(block_means(chamber.time, f, settings.block_s))
        for i, label in enumerate(stuck_thermometers(chamber.temperatures, settings.minimum_span_k)):
            if label:
                refused[i] = f"the {label} thermometer does not move in chamber run {chamber.name}"
    joined = tuple(np.vstack(channel) for channel in features)
    for i, f in enumerate(joined):
        if not refused[i] and (span := float(np.ptp(f[:, 0]))) < settings.minimum_span_k:
            refused[i] = f"its temperature spans only {span:.2g} K in the chamber"
    targets = np.vstack(bias)
    if len(targets) < FEWEST_BLOCKS:
        raise InputError(
            f"chamber run {', '.join(c.name for c in train)}",
            "duration",
            f"gives {len(targets)} blocks of {settings.block_s:g} s where {FEWEST_BLOCKS} are needed",
            "give a longer run or a smaller thermal.block_s",
        )
    run = np.repeat(np.arange(len(bias)), [len(b) for b in bias])
    return TrainingSet(targets, run, joined, tuple(refused), thermometers)


def _thermometers(train: Sequence[Chamber]) -> int:
    """How many a gyro has in all runs; one that stands for three is another temperature than their mean."""
    counts = {c.temperatures.gyro.shape[2]: c.name for c in reversed(train)}
    if len(counts) > 1:
        told = " and ".join(f"{count} in {name}" for count, name in sorted(counts.items()))
        raise InputError(
            f"chamber run {', '.join(c.name for c in train)}",
            "temperatures",
            f"are of different numbers of thermometers a gyro: {told}",
            "train on runs with the same thermometers",
        )
    return next(iter(counts))


def fit_channel(
    features: Array,
    bias: Array,
    starts: NDArray[np.bool_],
    settings: ThermalSettings,
    teach: bool,
    offsets: Offsets | None = None,
    turn_on: float | None = None,
) -> ChannelModel:
    """One channel from features (N, F), bias (N,) and which blocks begin a stretch without gaps (N,).

    `offsets` tells runs whose levels differ, by about `turn_on` [the channel's unit] where that is known; left out, the blocks
    are of one run. Without `teach` only the channel's range and the size of its bias are noted.
    """
    span = np.ptp(features, axis=0)
    least = np.array(LEAST_SPAN[: features.shape[1]])
    used = span >= least
    scale = np.where(used, features.std(axis=0), least)
    mean, low, high = features.mean(axis=0), features.min(axis=0), features.max(axis=0)
    # Block means span a little less than the readings between them.
    margin = np.where(used, 0.02 * span, least)
    prior = float(np.sqrt((bias**2).mean()))
    predictors = (
        _predictors(((features - mean) / scale)[:, used], bias, starts, settings, offsets, turn_on) if teach else {}
    )
    refused = "" if teach else "the chamber teaches it nothing"
    return ChannelModel(used, mean, scale, low - margin, high + margin, prior, predictors, refused)


def _predictors(
    x: Array,
    bias: Array,
    starts: NDArray[np.bool_],
    settings: ThermalSettings,
    offsets: Offsets | None,
    turn_on: float | None,
) -> dict[str, Predictor]:
    """Every method by its name, in scaled features x (N, D). What runs differ by, all take from the network."""
    network = fit_network(
        x,
        bias,
        starts=starts,
        offsets=offsets,
        turn_on=turn_on,
        centres=settings.centres,
        start_widths=settings.start_widths,
        iterations=settings.iterations,
        seed=settings.seed,
        device=settings.device,
    )
    free, level = Free.none(len(bias)), bias
    if offsets is not None:
        free = Free(offsets.columns(len(bias)), offsets.weights(float(network.offset_ratio[0])), offsets.anchored)
        level = bias - np.concatenate(
            [np.full(len(bias[r]), o) for r, o in zip(offsets.runs, network.offsets, strict=True)]
        )
    fits: dict[str, Callable[[], Predictor]] = {
        "polynomial": lambda: fit_polynomial(x, bias, settings.polynomial_degrees, free),
        "multi_polynomial": lambda: fit_multi_polynomial(x, bias, settings.multi_polynomial_degrees, free),
        "rbf": lambda: fit_traditional_rbf(x, bias, settings.rbf_nodes, settings.rbf_widths, settings.seed, free),
        "gaussian_process": lambda: fit_gaussian_process(x, level, settings.seed),
        "bayesian_ridge": lambda: fit_ridge(x, level, settings.seed),
    }
    return {name: fit() for name, fit in fits.items() if name in settings.baselines} | {"bayesian_rbf": network}


def fit_model(
    train: Sequence[Chamber],
    settings: ThermalSettings,
    turn_on: tuple[float, float] | None = None,
    memory: Memory | None = None,
) -> tuple[ThermalModel, list[dict[str, object]], list[str]]:
    """The model, a table of what each network learnt, and notes on what could not be learnt or is hard to believe.

    `turn_on`: the declared sigmas of what gyros [rad/s] and accelerometers [m/s²] are off by from one start to the next;
    `memory`: what a model update adds.
    """
    memory = memory or Memory()
    data = training_set(train, settings, memory)
    known = np.array([c.attitude is not None for c in train])
    offsets = Offsets.of(data.run, known) if len(train) > 1 or not known.any() else None
    declared = [None] * 6 if turn_on is None else np.repeat(turn_on, 3).tolist()
    channels = []
    for i in range(6):
        channel = fit_channel(
            data.features[i], data.bias[:, i], data.starts, settings, not data.refused[i], offsets, declared[i]
        )
        channels.append(replace(channel, refused=data.refused[i]))
    levels, doubts = _levels(train, data, declared)
    model = ThermalModel(
        tuple(channels),
        settings.smoothing_s,
        settings.causal,
        settings.block_s,
        settings.minimum_span_k,
        data.thermometers,
        tuple(doubts),
        memory,
    )
    table: list[dict[str, object]] = []
    notes = [
        f"Trained on N = {len(data.bias)} means over {settings.block_s:g} s of {len(train)} chamber "
        f"run{'s' if len(train) > 1 else ''} ({', '.join(c.name for c in train)})."
    ]
    notes += [
        f"Chamber run {c.name} has no attitude: its own mean is the reference, so only the change of bias with "
        "temperature is learnt."
        for c in train
        if c.attitude is None
    ]
    notes += levels
    notes += [f"Warning: {doubt}" for doubt in doubts]
    for i, name in enumerate(CHANNELS):
        if data.refused[i]:
            notes.append(f"Channel {name} is left uncompensated: {data.refused[i]}.")
            continue
        network = channels[i].predictors["bayesian_rbf"]
        assert isinstance(network, BayesianRbf)
        correlation = float(network.correlation[0])
        if correlation > COLOURED:
            notes.append(
                f"Channel {name}: the noise of one block correlates with the next by {correlation:.2f}, so its "
                f"{network.count} blocks count as {network.informative:.0f}: the noise is coloured, or the bias has a memory "
                "that this model lacks."
            )
        if network.effective < FEWEST_DRAWS:
            notes.append(
                f"Channel {name}: the sample of hyperparameters is worth {network.effective:.1f} independent draws, so sigma "
                "may not hold all that they leave open."
            )
        table.append(
            {
                "channel": name,
                "n": network.count,
                "m": network.weights.shape[1],
                "alpha": float(network.alpha[0]),
                "beta": float(network.beta[0]),
                "gamma": float(network.gamma[0]),
                "log_evidence": network.log_evidence,
                "widths": network.widths[0].tolist(),
                "linear_ratio": float(network.ratio[0]),
                "noise_sigma": network.noise_sigma,
                "noise_correlation": correlation,
                "constant": float(data.bias[np.flatnonzero(known[data.run]), i].mean()) if known.any() else None,
                "run_offsets": network.offsets.tolist() if offsets is not None else [],
                "effective_draws": network.effective,
            }
        )
    return model, table, notes


def _levels(
    train: Sequence[Chamber], data: TrainingSet, declared: Sequence[float | None]
) -> tuple[list[str], list[str]]:
    """The mean bias of each run with an attitude, and doubts where it is rather the attitude that is wrong.

    That a unit's mean bias goes far beyond its turn-on bias and its own change with temperature together is less likely than a
    wrong angle or sign: every error of the attitude is learnt as a constant, and taken off every flight.
    """
    notes, doubts = [], []
    for r, chamber in enumerate(train):
        if chamber.attitude is None:
            continue
        blocks = data.bias[data.run == r]
        mean, change = blocks.mean(axis=0), blocks.std(axis=0)
        gyro = ", ".join(f"{v:.4g}" for v in mean[:3] / DEG_PER_H)
        accel = ", ".join(f"{v:.4g}" for v in mean[3:] / MICRO_G)
        notes.append(
            f"Chamber run {chamber.name}: the mean bias is {gyro} °/h (gyro x, y, z), {accel} µg (accelerometer x, y, z)."
        )
        suspect = [
            name
            for name, level, moved, sigma in zip(CHANNELS, mean, change, declared, strict=True)
            if sigma is not None and abs(level) > SUSPECT_LEVEL * np.hypot(sigma, moved)
        ]
        if suspect:
            doubts.append(
                f"in chamber run {chamber.name} the mean bias of {', '.join(suspect)} is more than {SUSPECT_LEVEL:g} "
                "times what instrument.yaml's bias_sigma and the change with temperature allow: check the run's roll_deg, "
                "pitch_deg, yaw_deg and latitude_deg, because what is wrong with them is taken off every flight as a bias."
            )
    return notes, doubts
