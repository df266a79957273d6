"""The thermal model: six trained channels, applied to thermometer readings, written to and read from NetCDF.

Classes
-------
ChannelModel    one channel: how its features are scaled, and its predictors
ThermalModel    the six channels and how their features are made
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pipeline.datasets import open_dataset
from pipeline.errors import InputError
from pipeline.records import Temperatures, ThermalCorrection
from stages.thermal.baselines import MultiPolynomial, Polynomial, TraditionalRbf
from stages.thermal.features import NAMES, STEPS_PER_TIME_CONSTANT, channel_features, stuck_thermometers
from stages.thermal.network import BayesianRbf
from stages.thermal.oracles import GaussianProcess, RidgeRbf
from stages.thermal.targets import CHANNELS

Array = NDArray[np.float64]

SCHEMA = "tsmftis-thermal-model/1"
PREDICTORS: dict[str, type[Any]] = {
    "polynomial": Polynomial,
    "multi_polynomial": MultiPolynomial,
    "rbf": TraditionalRbf,
    "gaussian_process": GaussianProcess,
    "bayesian_ridge": RidgeRbf,
    "bayesian_rbf": BayesianRbf,
}
UNITS = ("rad s-1", "m s-2")


class Predictor(Protocol):
    """What all methods have in common."""

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) at scaled features (n, D)."""
        ...


@dataclass(frozen=True)
class ChannelModel:
    """One channel, its unit that of the channel (rad/s or m/s²).

    `used` (F,) tells which features vary in the chamber; mean, scale, low, high (F,) are theirs there. `predictors` is
    empty where the channel is left uncompensated: then the correction is 0 and its sigma `prior_sigma`, the RMS of the
    bias seen.
    """

    used: NDArray[np.bool_]
    mean: Array
    scale: Array
    low: Array
    high: Array
    prior_sigma: float
    predictors: dict[str, Predictor]

    def predict(self, features: Array, method: str = "bayesian_rbf") -> tuple[Array, Array]:
        """Bias and its standard deviation (n,) at features (n, F) as `channel_features` makes them."""
        if method not in self.predictors:
            return np.zeros(len(features)), np.full(len(features), self.prior_sigma)
        return self.predictors[method].predict(((features - self.mean) / self.scale)[:, self.used])

    def distance(self, features: Array) -> Array:
        """How far features (n, F) lie outside the chamber's range, in its standard deviations; 0 inside, (n,).

        A feature that did not vary in the chamber has no standard deviation and counts with that of its kind (`scale`).
        """
        outside = np.maximum(np.maximum(self.low - features, features - self.high), 0.0)
        return np.sqrt(((outside / self.scale) ** 2).sum(axis=1))


@dataclass(frozen=True)
class ThermalModel:
    """Six channels in the order gyro x, y, z, accelerometer x, y, z, and how features are made of readings."""

    channels: tuple[ChannelModel, ...]
    smoothing_s: float
    causal: bool
    block_s: float
    minimum_span_k: float

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were fitted, in the order in which tables have them."""
        fitted = {name for channel in self.channels for name in channel.predictors} | {"bayesian_rbf"}
        return tuple(name for name in PREDICTORS if name in fitted)

    def features(self, temperatures: Temperatures, at: Array) -> tuple[Array, ...]:
        """Features of the six channels at times (n,); a channel trained without gradients gets none."""
        made = channel_features(temperatures, at, self.smoothing_s, self.causal)
        for name, channel, feature in zip(CHANNELS, self.channels, made, strict=True):
            if feature.shape[1] < len(channel.used):
                raise InputError(
                    "thermal model",
                    f"channel {name}",
                    "was trained with three thermometers where the readings have one",
                    "apply it to readings of the same thermometers, or train on a chamber run with one",
                )
        return tuple(f[:, : len(c.used)] for f, c in zip(made, self.channels, strict=True))

    def correction(self, temperatures: Temperatures, method: str = "bayesian_rbf") -> ThermalCorrection:
        """The bias to subtract by a method, with its sigma and the distance from the chamber's envelope.

        Given at the readings' own times, or, where they come faster than features change, twenty times a time constant.
        A channel whose thermometer stands still while the others move is left uncompensated.
        """
        time = temperatures.time
        step = self.smoothing_s / STEPS_PER_TIME_CONSTANT
        if float(np.median(np.diff(time))) < 0.5 * step:
            time = np.linspace(time[0], time[-1], int(np.ceil((time[-1] - time[0]) / step)) + 1)
        stuck = stuck_thermometers(temperatures, self.minimum_span_k)
        bias, sigma, distance = (np.zeros((len(time), 6)) for _ in range(3))
        for i, (channel, features) in enumerate(zip(self.channels, self.features(temperatures, time), strict=True)):
            bias[:, i], sigma[:, i] = channel.predict(features, "none" if stuck[i] else method)
            distance[:, i] = channel.distance(features)
        return ThermalCorrection(time, bias[:, :3], bias[:, 3:], sigma[:, :3], sigma[:, 3:], distance)

    def to_dataset(self) -> xr.Dataset:
        """Every number of the model as plain variables `<channel>_<method>_<quantity>`."""
        variables: dict[str, tuple[tuple[str, ...], Any, dict[str, str]]] = {}
        for name, channel in zip(CHANNELS, self.channels, strict=True):
            unit = UNITS[name.startswith("accel")]
            for key in ("used", "mean", "scale", "low", "high"):
                value = getattr(channel, key)
                variables[f"{name}_{key}"] = (
                    (f"{name}_feature",),
                    value.astype(np.float64),
                    {"long_name": ", ".join(NAMES[: len(value)])},
                )
            variables[f"{name}_prior_sigma"] = ((), channel.prior_sigma, {"units": unit})
            for method, predictor in channel.predictors.items():
                for key, value in _numbers(predictor).items():
                    shape = np.shape(value)
                    dims = tuple(f"{name}_{method}_{key}_{axis}" for axis in range(len(shape)))
                    variables[f"{name}_{method}_{key}"] = (dims, np.asarray(value, dtype=np.float64), {})
        return xr.Dataset(
            variables,
            attrs={
                "schema": SCHEMA,
                "smoothing_s": self.smoothing_s,
                "causal": int(self.causal),
                "block_s": self.block_s,
                "minimum_span_k": self.minimum_span_k,
            },
        )

    @classmethod
    def from_file(cls, path: Path) -> ThermalModel:
        """Read what `to_dataset` wrote; InputError where it is something else."""
        with open_dataset(path) as d:
            variables = {str(k): v.values for k, v in d.variables.items()}
            attributes = dict(d.attrs)
        if attributes.get("schema") != SCHEMA:
            raise InputError(
                path,
                "attribute 'schema'",
                f"is {attributes.get('schema')!r} where {SCHEMA!r} is expected",
                "train the model again",
            )
        try:
            return cls(
                tuple(_read_channel(name, variables) for name in CHANNELS),
                float(attributes["smoothing_s"]),
                bool(attributes["causal"]),
                float(attributes["block_s"]),
                float(attributes["minimum_span_k"]),
            )
        except KeyError as error:
            raise InputError(path, f"entry {error}", "is missing", "train the model again") from error


def _numbers(predictor: Predictor) -> dict[str, Any]:
    return {f.name: getattr(predictor, f.name) for f in fields(predictor)}  # type: ignore[arg-type]  # a dataclass


def _read_channel(name: str, variables: dict[str, NDArray[Any]]) -> ChannelModel:
    predictors: dict[str, Predictor] = {}
    for method, kind in PREDICTORS.items():
        numbers: dict[str, Any] = {}
        for field in fields(kind):
            key = f"{name}_{method}_{field.name}"
            if key in variables:
                value = variables[key]
                numbers[field.name] = value if value.ndim else float(value)
        if numbers:
            predictors[method] = kind(**numbers)
    of = {key: variables[f"{name}_{key}"] for key in ("used", "mean", "scale", "low", "high", "prior_sigma")}
    return ChannelModel(
        of["used"].astype(bool),
        of["mean"],
        of["scale"],
        of["low"],
        of["high"],
        float(of["prior_sigma"]),
        predictors,
    )
