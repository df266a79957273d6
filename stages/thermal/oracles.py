"""scikit-learn's Gaussian process and BayesianRidge as methods like the others: the yardsticks that the network is held against.

scikit-learn fits; what it found is kept as plain arrays, so that a model file with them can be read and applied without it.

References
----------
.. [1] F. Pedregosa et al., Scikit-learn: Machine Learning in Python, J. Machine Learning Research 12 (2011) 2825.
.. [2] C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press (2006), ch. 2.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.linalg import solve_triangular

from pipeline.errors import InputError
from stages.thermal.baselines import beyond, rbf_design

Array = NDArray[np.float64]

RIDGE_CENTRES, RIDGE_WIDTH = 60, 1.5


@dataclass(frozen=True)
class GaussianProcess:
    """δ = c + scale·Σ_n w_n·k(x, x_n), k = a·exp(−½ Σ_d ((x_d − x_nd)/ℓ_d)²), in scaled features and targets: points (N, D),
    widths ℓ (D,), amplitude a, weights w (N,), factor L⁻¹ (N, N) with L·Lᵀ = K + noise."""

    points: Array
    widths: Array
    amplitude: float
    weights: Array
    factor: Array
    constant: float
    scale: float
    noise_sigma: float

    SHAPES: ClassVar[dict[str, tuple[str, ...]]] = {
        "points": ("N", "D"),
        "widths": ("D",),
        "amplitude": (),
        "weights": ("N",),
        "factor": ("N", "N"),
        "constant": (),
        "scale": (),
        "noise_sigma": (),
    }

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) of the function at scaled features (n, D), in the target's unit."""
        square = ((features[:, None, :] / self.widths - self.points / self.widths) ** 2).sum(axis=2)
        k = self.amplitude * np.exp(-0.5 * square)
        variance = self.amplitude - ((k @ self.factor.T) ** 2).sum(axis=1)
        return self.constant + self.scale * (k @ self.weights), self.scale * np.sqrt(np.maximum(variance, 0.0))


@dataclass(frozen=True)
class RidgeRbf:
    """δ = φ(x)·w on a constant and Gaussian units of one width at fixed centres (M, D): weights (1 + M,), covariance of them.

    Its units fade outside the training data's range low … high (D,), and their variance with them: there the bias' standard
    deviation `spread` is added for each standard deviation of distance.
    """

    centres: Array
    width: float
    weights: Array
    covariance: Array
    noise_sigma: float
    low: Array
    high: Array
    spread: float

    SHAPES: ClassVar[dict[str, tuple[str, ...]]] = {
        "centres": ("m", "D"),
        "width": (),
        "weights": ("1+m",),
        "covariance": ("1+m", "1+m"),
        "noise_sigma": (),
        "low": ("D",),
        "high": ("D",),
        "spread": (),
    }

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) of the function at scaled features (n, D), in the target's unit."""
        phi = rbf_design(features, self.centres, self.width)
        variance = np.maximum(np.einsum("ni,ij,nj->n", phi, self.covariance, phi), 0.0)
        return phi @ self.weights, np.sqrt(variance + (self.spread * beyond(features, self.low, self.high)) ** 2)


def fit_gaussian_process(features: Array, target: Array, seed: int) -> GaussianProcess:
    """ARD squared exponential and white noise by marginal likelihood, two restarts."""
    process, kernels = _sklearn("gaussian_process"), _sklearn("gaussian_process.kernels")
    constant, scale = float(target.mean()), float(target.std()) or 1.0
    kernel = kernels.ConstantKernel(1.0, (1e-3, 1e4)) * kernels.RBF(np.ones(features.shape[1]), (0.05, 100.0))
    kernel = kernel + kernels.WhiteKernel(0.1, (1e-7, 10.0))
    fitted = process.GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bounds met, which leave a width without effect
        fitted.fit(features, (target - constant) / scale)
    signal, noise = fitted.kernel_.k1, fitted.kernel_.k2.noise_level
    return GaussianProcess(
        features.copy(),
        np.broadcast_to(signal.k2.length_scale, features.shape[1:]).astype(float).copy(),
        float(signal.k1.constant_value),
        np.asarray(fitted.alpha_, float),
        solve_triangular(fitted.L_, np.eye(len(features)), lower=True),
        constant,
        scale,
        scale * float(np.sqrt(noise)),
    )


def fit_ridge(features: Array, target: Array, seed: int) -> RidgeRbf:
    """BayesianRidge on a constant and 60 Gaussian units at k-means centres."""
    count = min(RIDGE_CENTRES, len(target) // 3)
    centres = kmeans2(features, count, minit="++", rng=np.random.default_rng(seed))[0]
    design, scale = rbf_design(features, centres, RIDGE_WIDTH), float(np.abs(target).max()) or 1.0
    ridge = _sklearn("linear_model").BayesianRidge(
        alpha_1=0.0, alpha_2=0.0, lambda_1=0.0, lambda_2=0.0, fit_intercept=False, tol=1e-8, max_iter=3000
    )
    ridge.fit(design, target / scale)
    noise = scale / float(np.sqrt(ridge.alpha_))
    low, high = features.min(axis=0), features.max(axis=0)
    weights, covariance = scale * ridge.coef_, scale**2 * ridge.sigma_
    return RidgeRbf(centres, RIDGE_WIDTH, weights, covariance, noise, low, high, float(target.std()))


def _sklearn(part: str):  # type: ignore[no-untyped-def]
    import importlib

    try:
        return importlib.import_module(f"sklearn.{part}")
    except ImportError as error:
        raise InputError(
            "settings",
            "thermal.baselines",
            "names a method of scikit-learn, which is not installed",
            "pip install scikit-learn",
        ) from error
