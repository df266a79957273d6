"""Chamber runs → a thermal model: blocks of targets and features, and the three predictors of each channel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import Chamber
from stages.thermal.baselines import fit_multi_polynomial, fit_polynomial, fit_traditional_rbf
from stages.thermal.features import STEPS_PER_TIME_CONSTANT, channel_features, stuck_thermometers
from stages.thermal.model import ChannelModel, Predictor, ThermalModel
from stages.thermal.network import BayesianRbf, fit_network
from stages.thermal.oracles import fit_gaussian_process, fit_ridge
from stages.thermal.settings import ThermalSettings
from stages.thermal.targets import CHANNELS, bias_samples, block_means, refuse_motion, thinned

Array = NDArray[np.float64]

# A feature that spans less than this in the chamber is noise: temperature and gradients [K], rate [K/s].
LEAST_SPAN = (0.5, 1e-3, 0.5, 0.5)
FEWEST_BLOCKS = 20
# Blocks as alike as this, one to the next, are not independent.
COLOURED = 0.3


@dataclass(frozen=True)
class TrainingSet:
    """Blocks of all runs: bias (N, 6), features of each channel (N, F), which blocks begin a run (N,), and which channels cannot
    be taught."""

    bias: Array
    starts: NDArray[np.bool_]
    features: tuple[Array, ...]
    refused: tuple[str | None, ...]


def training_set(train: Sequence[Chamber], settings: ThermalSettings) -> TrainingSet:
    """Block means of bias and features, the runs one after the other."""
    bias: list[Array] = []
    features: list[list[Array]] = [[] for _ in CHANNELS]
    refused: list[str | None] = [None] * 6
    step = settings.smoothing_s / STEPS_PER_TIME_CONSTANT
    for chamber in (thinned(c, settings.block_s, step) for c in train):
        refuse_motion(chamber, settings.block_s)
        bias.append(block_means(chamber.time, bias_samples(chamber), settings.block_s))
        made = channel_features(chamber.temperatures, chamber.time, settings.smoothing_s, settings.causal)
        for i, f in enumerate(made):
            features[i].append(block_means(chamber.time, f, settings.block_s))
        for i, label in enumerate(stuck_thermometers(chamber.temperatures, settings.minimum_span_k)):
            if label:
                refused[i] = f"the {label} thermometer does not move in chamber run {chamber.name}"
    fewest = [min(f.shape[1] for f in channel) for channel in features]
    joined = tuple(np.vstack([f[:, :k] for f in channel]) for channel, k in zip(features, fewest, strict=True))
    for i, f in enumerate(joined):
        if refused[i] is None and (span := float(np.ptp(f[:, 0]))) < settings.minimum_span_k:
            refused[i] = f"its temperature spans only {span:.2g} K in the chamber"
    targets = np.vstack(bias)
    if len(targets) < FEWEST_BLOCKS:
        raise InputError(
            f"chamber run {', '.join(c.name for c in train)}",
            "duration",
            f"gives {len(targets)} blocks of {settings.block_s:g} s where {FEWEST_BLOCKS} are needed",
            "give a longer run or a smaller thermal.block_s",
        )
    starts = np.concatenate([np.arange(len(b)) == 0 for b in bias])
    return TrainingSet(targets, starts, joined, tuple(refused))


def fit_channel(
    features: Array, bias: Array, starts: NDArray[np.bool_], settings: ThermalSettings, teach: bool
) -> ChannelModel:
    """One channel from features (N, F), bias (N,) and which blocks begin a run (N,)."""
    span = np.ptp(features, axis=0)
    least = np.array(LEAST_SPAN[: features.shape[1]])
    used = span >= least
    scale = np.where(used, features.std(axis=0), least)
    mean, low, high = features.mean(axis=0), features.min(axis=0), features.max(axis=0)
    # Block means span a little less than the readings between them.
    margin = np.where(used, 0.02 * span, least)
    prior = float(np.sqrt((bias**2).mean()))
    predictors: dict[str, Predictor] = {}
    if teach:
        x = ((features - mean) / scale)[:, used]
        fits: dict[str, Callable[[], Predictor]] = {
            "polynomial": lambda: fit_polynomial(x, bias, settings.polynomial_degrees),
            "multi_polynomial": lambda: fit_multi_polynomial(x, bias, settings.multi_polynomial_degrees),
            "rbf": lambda: fit_traditional_rbf(x, bias, settings.rbf_nodes, settings.rbf_widths, settings.seed),
            "gaussian_process": lambda: fit_gaussian_process(x, bias, settings.seed),
            "bayesian_ridge": lambda: fit_ridge(x, bias, settings.seed),
        }
        predictors = {name: fit() for name, fit in fits.items() if name in settings.baselines}
        predictors["bayesian_rbf"] = fit_network(
            x,
            bias,
            starts=starts,
            centres=settings.centres,
            start_widths=settings.start_widths,
            iterations=settings.iterations,
            seed=settings.seed,
            device=settings.device,
        )
    return ChannelModel(used, mean, scale, low - margin, high + margin, prior, predictors)


def fit_model(
    train: Sequence[Chamber], settings: ThermalSettings
) -> tuple[ThermalModel, list[dict[str, object]], list[str]]:
    """The model, a table of what each network learnt, and notes on what could not be learnt."""
    data = training_set(train, settings)
    channels = tuple(
        fit_channel(data.features[i], data.bias[:, i], data.starts, settings, data.refused[i] is None) for i in range(6)
    )
    model = ThermalModel(channels, settings.smoothing_s, settings.causal, settings.block_s, settings.minimum_span_k)
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
            }
        )
    return model, table, notes
