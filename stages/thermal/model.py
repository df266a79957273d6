"""The thermal model: six trained channels, applied to thermometer readings, written to and read from NetCDF.

Classes
-------
ChannelModel    one channel: how its features are scaled, and its predictors
ThermalModel    the six channels and how their features are made
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pipeline.datasets import open_dataset
from pipeline.errors import InputError
from pipeline.records import Temperatures, ThermalCorrection
from stages.thermal.baselines import MultiPolynomial, Polynomial, TraditionalRbf
from stages.thermal.features import (
    NAMES,
    STEPS_PER_TIME_CONSTANT,
    channel_features,
    refuse_endless,
    stuck_thermometers,
)
from stages.thermal.memory import Memory
from stages.thermal.network import BayesianRbf
from stages.thermal.oracles import GaussianProcess, RidgeRbf
from stages.thermal.targets import CHANNELS

Array = NDArray[np.float64]

SCHEMA = "tsmftis-thermal-model/2"
MOST_IN_GAP = 1000  # times of a correction in a stretch without readings
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

    `used` (F,) tells which features vary in the chamber; mean, scale, low, high (F,) are theirs there. `refused` says why the
    chamber teaches this channel nothing, and is empty where it does: a refused channel has no `predictors`, its correction is 0
    and its sigma `prior_sigma`, the RMS of the bias seen.
    """

    used: NDArray[np.bool_]
    mean: Array
    scale: Array
    low: Array
    high: Array
    prior_sigma: float
    predictors: dict[str, Predictor]
    refused: str = ""

    def predict(self, features: Array, method: str = "bayesian_rbf") -> tuple[Array, Array]:
        """Bias and its standard deviation (n,) at features (n, F) as `channel_features` makes them; KeyError: no such method."""
        if self.refused:
            return self.untouched(len(features))
        return self.predictors[method].predict(((features - self.mean) / self.scale)[:, self.used])

    def untouched(self, count: int) -> tuple[Array, Array]:
        """What leaving `count` readings as they are amounts to: no bias taken off, and the sigma of not knowing it."""
        return np.zeros(count), np.full(count, self.prior_sigma)

    def distance(self, features: Array) -> Array:
        """How far features (n, F) lie outside the chamber's range, in its standard deviations; 0 inside, (n,).

        A feature that did not vary in the chamber has no standard deviation and counts with that of its kind (`scale`).
        """
        outside = np.maximum(np.maximum(self.low - features, features - self.high), 0.0)
        return np.sqrt(((outside / self.scale) ** 2).sum(axis=1))


@dataclass(frozen=True)
class ThermalModel:
    """Six channels in the order gyro x, y, z, accelerometer x, y, z, and how their features are made of readings.

    `thermometers`: how many a gyro had in the chamber (3 or 1). `doubts`: what whoever applies the model must know about its
    training. `memory`: what a model update adds, known to the fit and to every correction. `source`: what an error about the
    model names.
    """

    channels: tuple[ChannelModel, ...]
    smoothing_s: float
    causal: bool
    block_s: float
    minimum_span_k: float
    thermometers: int
    doubts: tuple[str, ...] = ()
    memory: Memory = field(default_factory=Memory)
    source: str = field(default="thermal model", compare=False)

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were fitted, in the order in which tables have them; none where the chamber taught no channel."""
        fitted = {name for channel in self.channels for name in channel.predictors}
        return tuple(name for name in PREDICTORS if name in fitted)

    def features(self, temperatures: Temperatures, at: Array, where: Path | str = "readings") -> tuple[Array, ...]:
        """Features of the six channels at times (n,); InputError, about `where`, if readings are of other thermometers."""
        if (count := temperatures.gyro.shape[2]) != self.thermometers:
            names = {1: "one thermometer", 3: "three thermometers"}
            raise InputError(
                where,
                "temperatures",
                f"are of {names[count]} a gyro where {self.source} was trained with {names[self.thermometers]}",
                "apply it to readings of the same thermometers, or train on a chamber run with these",
            )
        felt = self.memory.felt(temperatures)
        return channel_features(temperatures, at, self.smoothing_s, self.causal, str(where), felt)

    def remembered(self, temperatures: Temperatures, at: Array) -> Array:
        """The part of the six channels' biases (n, 6) at times (n,) that hangs on what temperatures were before."""
        return self.memory.bias(temperatures, at, self.smoothing_s, self.causal)

    def correction(
        self,
        temperatures: Temperatures,
        method: str = "bayesian_rbf",
        *,
        of: Array | None = None,
        where: Path | str = "readings",
    ) -> ThermalCorrection:
        """The bias to subtract by a method, with its sigma and the distance from the chamber's envelope.

        Given at the readings' own times, or, where they come faster than features change, twenty times a time constant; and,
        where `of` are the times (n,) [s] of the inertial data, over all of them: without readings the bias is held (at the
        ends) or interpolated, and its sigma is no less than that of an uncompensated channel. A channel whose thermometer stands
        still while the others move is left uncompensated. InputError where the method was not fitted, where readings (of the
        file `where`) are of other thermometers or have next to no time in common with `of`.
        """
        if self.methods and method not in self.methods:
            raise InputError(
                self.source,
                f"method {method}",
                f"was not fitted (fitted are {', '.join(self.methods)})",
                "choose one of these, or fit again with it among thermal.baselines",
            )
        readings = temperatures.time
        refuse_endless(readings, self.smoothing_s, str(where))
        gaps = [] if of is None else temperatures.uncovered(of, where, self.smoothing_s)
        step = self.smoothing_s / STEPS_PER_TIME_CONSTANT
        time = readings
        if float(np.median(np.diff(readings))) < 0.5 * step:
            time = np.linspace(readings[0], readings[-1], int(np.ceil((readings[-1] - readings[0]) / step)) + 1)
        for start, stop in gaps:
            time = np.union1d(time, np.linspace(start, stop, min(MOST_IN_GAP, int((stop - start) / step) + 2)))
        missing = np.zeros(len(time), dtype=bool)
        for start, stop in gaps:
            missing |= (time > start) & (time < stop)
        if gaps:
            # The last reading, and the first after a gap, are readings; the ends of the inertial data are not.
            missing |= (time < readings[0]) | (time > readings[-1])
        at = np.clip(time, readings[0], readings[-1])
        features, remembered = self.features(temperatures, at, where), self.remembered(temperatures, at)
        stuck = stuck_thermometers(temperatures, self.minimum_span_k)
        bias, sigma, distance = (np.zeros((len(time), 6)) for _ in range(3))
        for i, (channel, of_channel) in enumerate(zip(self.channels, features, strict=True)):
            if channel.refused or stuck[i]:
                bias[:, i], sigma[:, i] = channel.untouched(len(time))
                continue
            bias[:, i], sigma[:, i] = channel.predict(of_channel, method)
            bias[:, i] += remembered[:, i]
            distance[:, i] = channel.distance(of_channel)
            sigma[missing, i] = np.maximum(sigma[missing, i], channel.prior_sigma)
        seconds = float(sum(stop - start for start, stop in gaps))
        return ThermalCorrection(time, bias[:, :3], bias[:, 3:], sigma[:, :3], sigma[:, 3:], distance, seconds)

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
            told = {"units": unit, "refused": channel.refused}
            variables[f"{name}_prior_sigma"] = ((), channel.prior_sigma, told)
            for method, predictor in channel.predictors.items():
                for key in PREDICTORS[method].SHAPES:
                    value = np.asarray(getattr(predictor, key), dtype=np.float64)
                    dims = tuple(f"{name}_{method}_{key}_{axis}" for axis in range(value.ndim))
                    variables[f"{name}_{method}_{key}"] = (dims, value, {})
        return xr.Dataset(
            variables,
            attrs={
                "schema": SCHEMA,
                "smoothing_s": self.smoothing_s,
                "causal": int(self.causal),
                "block_s": self.block_s,
                "minimum_span_k": self.minimum_span_k,
                "thermometers": self.thermometers,
                "methods": " ".join(self.methods),
                "doubts": "\n".join(self.doubts),
                "hysteresis_half_width_k": self.memory.half_width,
                "hysteresis_gyro_rad_per_s": list(self.memory.gyro),
                "hysteresis_accel_m_per_s2": list(self.memory.accel),
                "lag_s": self.memory.lag,
            },
        )

    @classmethod
    def from_file(cls, path: Path) -> ThermalModel:
        """Read what `to_dataset` wrote; InputError where it is something else, or lacks or spoils any of it."""
        with open_dataset(path) as d:
            if d.attrs.get("schema") != SCHEMA:
                raise InputError(
                    path,
                    "attribute 'schema'",
                    f"is {d.attrs.get('schema')!r} where {SCHEMA!r} is expected",
                    "train the model again",
                )
            file = _File(path, {str(k): v.values for k, v in d.variables.items()}, dict(d.attrs))
            methods = str(d.attrs.get("methods", "")).split()
            if unknown := [m for m in methods if m not in PREDICTORS]:
                raise file.spoiled("attribute 'methods'", f"names '{unknown[0]}', which is none")
            reasons = {
                n: str(d[f"{n}_prior_sigma"].attrs.get("refused", "")) for n in CHANNELS if f"{n}_prior_sigma" in d
            }
        thermometers = int(file.attribute("thermometers"))
        if thermometers not in (1, 3):
            raise file.spoiled("attribute 'thermometers'", f"is {thermometers} where 1 or 3 can be")
        return cls(
            tuple(_read_channel(name, file, reasons.get(name, ""), methods, thermometers) for name in CHANNELS),
            file.attribute("smoothing_s", positive=True),
            bool(file.attribute("causal")),
            file.attribute("block_s", positive=True),
            file.attribute("minimum_span_k", positive=True),
            thermometers,
            tuple(str(file.attributes.get("doubts", "")).splitlines()),
            file.memory(),
            str(path),
        )


@dataclass(frozen=True)
class _File:
    """A model file's variables and attributes, given out when they are what they must be."""

    path: Path
    variables: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any]

    def spoiled(self, place: str, problem: str) -> InputError:
        return InputError(self.path, place, problem, "train the model again")

    def attribute(self, name: str, positive: bool = False) -> float:
        """A finite number."""
        try:
            value = float(self.attributes[name])
        except KeyError:
            raise self.spoiled(f"attribute '{name}'", "is missing") from None
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value) or (positive and value <= 0.0):
            raise self.spoiled(f"attribute '{name}'", f"is {self.attributes[name]!r}")
        return value

    def memory(self) -> Memory:
        """What is missing is none, as in files from before there were model updates."""
        names = ("hysteresis_half_width_k", "hysteresis_gyro_rad_per_s", "hysteresis_accel_m_per_s2", "lag_s")
        none = (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
        half_width, gyro, accel, lag = (self.attributes.get(n, d) for n, d in zip(names, none, strict=True))
        effects = {
            "thermal_hysteresis": {"half_width": half_width, "gyro": gyro, "accel": accel},
            "thermal_lag": {"lag": lag},
        }
        try:
            memory = Memory.of(effects)
        except (TypeError, ValueError) as error:
            raise self.spoiled(f"attributes {', '.join(names)}", f"are no hysteresis and lag ({error})") from None
        if not np.isfinite([memory.half_width, *memory.gyro, *memory.accel, memory.lag]).all():
            raise self.spoiled(f"attributes {', '.join(names)}", "are not finite")
        return memory

    def array(self, name: str) -> Array:
        """A variable of finite numbers."""
        if name not in self.variables:
            raise self.spoiled(f"variable '{name}'", "is missing")
        try:
            value = np.asarray(self.variables[name], dtype=np.float64)
        except (TypeError, ValueError):
            raise self.spoiled(f"variable '{name}'", "is not of numbers") from None
        if not np.isfinite(value).all():
            raise self.spoiled(
                f"variable '{name}'", f"has {int((~np.isfinite(value)).sum())} values that are not finite"
            )
        return value

    def arrays(self, prefix: str, shapes: Mapping[str, tuple[str, ...]], sizes: dict[str, int]) -> dict[str, Any]:
        """Variables `<prefix>_<key>` whose lengths agree: a letter is one length throughout, given in `sizes` or by the first
        that has it, `a+b` the sum of two. Scalars come as float."""
        found = {key: self.array(f"{prefix}_{key}") for key in shapes}
        for key, shape in shapes.items():
            for letter, length in zip(shape, found[key].shape, strict=False):
                if "+" not in letter:
                    sizes.setdefault(letter, length)
        for key, shape in shapes.items():
            wanted = tuple(sum(int(s) if s.isdigit() else sizes[s] for s in letter.split("+")) for letter in shape)
            if found[key].shape != wanted:
                raise self.spoiled(
                    f"variable '{prefix}_{key}'", f"has shape {found[key].shape} where {wanted} is expected"
                )
        return {key: value if value.ndim else float(value) for key, value in found.items()}


def _read_channel(name: str, file: _File, refused: str, methods: list[str], thermometers: int) -> ChannelModel:
    features = 4 if thermometers == 3 and name.startswith("gyro") else 2
    shapes = {key: ("F",) for key in ("used", "mean", "scale", "low", "high")}
    of = file.arrays(name, {**shapes, "prior_sigma": ()}, {"F": features})
    if not (of["scale"] > 0.0).all():
        raise file.spoiled(f"variable '{name}_scale'", "is not positive")
    used = of.pop("used").astype(bool)
    predictors: dict[str, Predictor] = {}
    for method in [] if refused else methods:
        kind = PREDICTORS[method]
        predictors[method] = kind(**file.arrays(f"{name}_{method}", kind.SHAPES, {"D": int(used.sum())}))
    if not refused and not predictors:
        raise file.spoiled(f"channel {name}", "has no method, and nothing says why")
    return ChannelModel(used=used, predictors=predictors, refused=refused, **of)
