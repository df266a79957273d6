"""What a user may choose about the thermal model; units are in the names."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipeline.records import THERMAL_TIME_S

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


class ThermalSettings(BaseModel):
    """Settings of the thermal stage.

    Times are time constants in seconds, never samples, so that chamber and flight are treated alike at any sampling.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    block_s: Positive = 60.0
    """Targets are means over this time: short against the thermal time constants, long against the noise."""
    smoothing_s: Positive = THERMAL_TIME_S
    """Time constant of the smoothing and differentiation of the thermometers."""
    causal: bool = False
    """Smooth with the past alone (as a real-time system must) instead of with past and future; Ṫ then comes a time
    constant late, which costs accuracy wherever the ramp changes."""
    centres: tuple[Annotated[int, Field(ge=4)], ...] = Field(default=(20, 40, 80), min_length=1)
    """Numbers of Gaussian units among which the evidence chooses: the smallest that is within a nat of the best."""
    start_widths: tuple[tuple[Positive, Positive], ...] = Field(default=((0.5, 5.0), (2.0, 2.0)), min_length=1)
    """From where the search for the most probable widths starts: pairs of the width in T and that in Ṫ and ∇T, in
    standard deviations of the features. The evidence often has two maxima: wavy in T and straight in the rest, or
    alike in all."""
    iterations: Count = 100
    """Most steps of the search from each start."""
    verification_block_s: Positive = 100.0
    """The verification figures are standard deviations of means over this time, of which a run must have ten."""
    minimum_span_k: float = Field(default=2.0, ge=0.5)
    """Chamber runs over all of which a channel's temperature spans less than this teach it nothing."""
    baselines: tuple[Literal["polynomial", "multi_polynomial", "rbf", "gaussian_process", "bayesian_ridge"], ...] = (
        "polynomial",
        "multi_polynomial",
        "rbf",
    )
    """Methods fitted beside the network, to be held against it: a polynomial in T, one in all features, the traditional RBF; and
    scikit-learn's Gaussian process and BayesianRidge, where it is installed."""
    method: Literal[
        "bayesian_rbf", "gaussian_process", "bayesian_ridge", "rbf", "multi_polynomial", "polynomial", "none"
    ] = "bayesian_rbf"
    """What compensates the flights; it must be among those fitted. `none`: nothing does."""
    multi_polynomial_degrees: tuple[Count, ...] = Field(default=(1, 2, 3), min_length=1)
    """Degrees among which cross-validation chooses for the polynomial in all features."""
    polynomial_degrees: tuple[Count, ...] = Field(default=(1, 2, 3, 4, 5), min_length=1)
    """Degrees among which cross-validation chooses for the polynomial in T."""
    rbf_nodes: tuple[Count, ...] = Field(default=(4, 6, 10, 15, 25, 40), min_length=1)
    """Numbers of nodes among which cross-validation chooses for the traditional RBF."""
    rbf_widths: tuple[Positive, ...] = Field(default=(0.7, 1.0, 1.5, 2.5, 4.0, 7.0), min_length=1)
    """Widths among which cross-validation chooses for the traditional RBF, in standard deviations of the features."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the k-means that places the traditional RBF's nodes, and of the sample of hyperparameters."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the Bayesian network is trained."""

    @model_validator(mode="after")
    def _fitted(self) -> Self:
        if self.method not in (*self.baselines, "bayesian_rbf", "none"):
            raise ValueError(f"method {self.method} is not among baselines, so it is not fitted: add it there")
        return self
