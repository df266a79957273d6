"""The Bayesian-regularised network of Gaussian radial basis functions.

    δ(x) = c + Σ_m v_m·exp(−½ Σ_d ((x_d − c_md)/ℓ_d)²) + ρ·Σ_d a_d·x_d
    v = U·w_v,   (w_v, a) = w ~ N(0, 1/(2α)),   noise variance 1/(2β)

x are features less their mean, over their standard deviation in the chamber. The linear units carry the trend, so that
the Gaussian ones need not: a bias that is nearly linear in Ṫ and ∇T would else ask for widths far beyond the data. One
width ℓ_d for each input, the strength ρ of the linear units, α and β are those of the largest evidence (`evidence.py`)
times a weak prior on ℓ and ρ.

U makes E_w the energy of the function and not of its coefficients: with K_ij the value of unit j at centre i,
U = L⁻ᵀ, L·Lᵀ = K. Otherwise the prior would depend on where the centres happen to lie and how many there are.

Away from the chamber's envelope the Gaussian units fade and the linear ones hold the value they have one standard
deviation outside it, so the mean is bounded. What the units then cannot represent,
(1 − |φ_Gauss(x)|²)/(2α) + ρ²·|x − clamp(x)|²/(2α), is added to the predictive variance: without it a network is the
surer the farther x lies from its centres [3]_.

The noise of successive blocks may be correlated: with r_t = ρ·r_{t−1} + … it is whitened before anything is weighed, and ρ ≥ 0
is of the largest evidence too (weights integrated out, so this is restricted maximum likelihood): N in the evidence then
counts information and not samples.

References
----------
.. [1] D. J. C. MacKay, A practical Bayesian framework for backpropagation networks, Neural Computation 4 (1992) 448.
.. [2] F. D. Foresee, M. T. Hagan, Gauss-Newton approximation to Bayesian learning, Proc. ICNN (1997) 1930.
.. [3] C. E. Rasmussen, J. Quiñonero-Candela, Healing the relevance vector machine through augmentation, ICML (2005).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from stages.thermal.evidence import log_evidence, posterior, reestimate

Array = NDArray[np.float64]

# On the diagonal of K: far below any noise the data can have against the signal, far above rounding.
JITTER = 1e-8
# Weak log-normal priors: widths around 3 standard deviations of their input, ρ around 1, each within a factor of e².
LOG_WIDTH_MEAN, LOG_WIDTH_SIGMA = math.log(3.0), 2.0
LOG_RATIO_MEAN, LOG_RATIO_SIGMA = 0.0, 2.0
# Linear units go on this far outside the envelope, in standard deviations of a feature.
LINEAR_MARGIN = 1.0
PREDICT_ROWS = 8192


@dataclass(frozen=True)
class BayesianRbf:
    """A trained network of m Gaussian and D linear units, M = m + D.

    centres (m, D), widths (D,), low and high (D,), where the linear units stop, in scaled features; `mixing` U (m, m);
    weights w (M,); `factor` F (M, M) with F·Fᵀ = H⁻¹; `ratio` ρ; `constant` c and `scale` in the target's unit: all
    else is of (target − c)/scale. `count` is N; `correlation` that of one block's noise with the next one's.
    """

    centres: Array
    widths: Array
    low: Array
    high: Array
    mixing: Array
    weights: Array
    factor: Array
    alpha: float
    beta: float
    gamma: float
    ratio: float
    constant: float
    scale: float
    count: int
    correlation: float
    log_evidence: float

    @property
    def noise_sigma(self) -> float:
        """Standard deviation of a target's noise, in the target's unit: √(1/(2β))."""
        return self.scale * math.sqrt(0.5 / self.beta)

    @property
    def informative(self) -> float:
        """How many independent targets the N correlated ones are worth: N·(1 − ρ)/(1 + ρ)."""
        return self.count * (1.0 - self.correlation) / (1.0 + self.correlation)

    def noise_of_mean(self, blocks: float) -> float:
        """Standard deviation of the noise in a mean over as long as `blocks` targets: σ/√blocks, more where it is correlated."""
        inflation = (1.0 + self.correlation) / (1.0 - self.correlation)
        independent = blocks if blocks < 1.0 else max(blocks / inflation, 1.0)
        return self.noise_sigma / math.sqrt(independent)

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) of the function at scaled features (n, D), in the target's unit."""
        mean, variance = np.empty(len(features)), np.empty(len(features))
        scaled = self.centres / self.widths
        size = len(scaled)
        phi = np.empty((min(PREDICT_ROWS, len(features)), size + features.shape[1]))
        for start in range(0, len(features), PREDICT_ROWS):
            part = slice(start, start + PREDICT_ROWS)
            x = features[part]
            held = np.clip(x, self.low, self.high)
            phi = phi[: len(x)]
            square = np.zeros((len(x), size))
            for d in range(x.shape[1]):
                square += (x[:, d, None] / self.widths[d] - scaled[:, d]) ** 2
            phi[:, :size] = np.exp(-0.5 * square) @ self.mixing
            phi[:, size:] = self.ratio * held
            mean[part] = phi @ self.weights
            unknown = np.maximum(1.0 - (phi[:, :size] ** 2).sum(axis=1), 0.0)
            unknown += self.ratio**2 * ((x - held) ** 2).sum(axis=1)
            variance[part] = ((phi @ self.factor) ** 2).sum(axis=1) + unknown / (2.0 * self.alpha)
        # The constant is a mean of N targets and no surer than that.
        variance += 0.5 / self.beta / self.informative
        return self.constant + self.scale * mean, self.scale * np.sqrt(variance)


def spread_points(features: Array, count: int) -> NDArray[np.int64]:
    """Indices of up to `count` rows of features (n, D): first the one nearest the mean, then ever the farthest."""
    distance = ((features - features.mean(axis=0)) ** 2).sum(axis=1)
    chosen = [int(np.argmin(distance))]
    distance = ((features - features[chosen[0]]) ** 2).sum(axis=1)
    # Rows that coincide would make K singular.
    while len(chosen) < count and distance.max() > 1e-6:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((features - features[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def _units(x: Tensor, centres: Tensor, log_width: Tensor) -> Tensor:
    """exp(−½|(x − c)/ℓ|²) for x (n, D), centres (m, D), log_width (D,) → (n, m)."""
    a, b = x / log_width.exp(), centres / log_width.exp()
    square = (a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2.0 * a @ b.T
    return torch.exp(-0.5 * square.clamp_min(0.0))


def _cholesky(centres: Tensor, log_width: Tensor) -> Tensor:
    """Cholesky factor L of K + jitter (m, m)."""
    kernel = _units(centres, centres, log_width)
    return torch.linalg.cholesky(kernel + JITTER * torch.eye(len(centres), dtype=kernel.dtype, device=kernel.device))


def _orthonormal(x: Tensor, centres: Tensor, log_width: Tensor) -> Tensor:
    """Φ = units(x)·L⁻ᵀ (n, m)."""
    lower = _cholesky(centres, log_width)
    return torch.linalg.solve_triangular(lower, _units(x, centres, log_width).T, upper=False).T


@contextmanager
def one_thread() -> Iterator[None]:
    """The matrices are small, and sums in one order give the same bytes on any machine load."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def whitened(values: Tensor, correlation: Tensor | float, starts: Tensor) -> Tensor:
    """Rows (N, ...) freed of first-order correlated noise: r_t → (r_t − ρ·r_{t−1})/√(1 − ρ²), but for the first of each run."""
    rho = torch.as_tensor(correlation, dtype=values.dtype, device=values.device)
    inner = (values[1:] - rho * values[:-1]) / torch.sqrt(1.0 - rho**2)
    mask = starts[1:].reshape(-1, *[1] * (values.ndim - 1))
    return torch.cat([values[:1], torch.where(mask, values[1:], inner)])


def fit_network(
    features: Array,
    target: Array,
    *,
    starts: NDArray[np.bool_] | None = None,
    centres: tuple[int, ...] = (20, 40, 80),
    start_widths: tuple[tuple[float, float], ...] = ((0.5, 5.0), (2.0, 2.0)),
    iterations: int = 100,
    device: str = "cpu",
) -> BayesianRbf:
    """Train on scaled features (N, D) and targets (N,): widths, noise and its colour by evidence from each start, the best kept.

    A start is a pair of widths: of the first feature (T) and of the others. `starts` (N,) marks the first block of each run; one
    run where it is left out. The number of Gaussian units is the smallest of `centres` whose evidence is within a nat of the
    best.
    """
    constant, scale = float(target.mean()), float(target.std()) or 1.0
    dimensions = features.shape[1]
    if starts is None:
        starts = np.arange(len(target)) == 0

    def tensor(a: Array) -> Tensor:
        return torch.as_tensor(a, dtype=torch.float64, device=device)

    with one_thread():
        x, y, first_of_run = (
            tensor(features),
            tensor((target - constant) / scale),
            torch.as_tensor(starts, device=device),
        )
        later = int((~starts).sum())

        def design(q: Tensor, c: Tensor) -> Tensor:
            return torch.cat([_orthonormal(x, c, q[:dimensions]), q[dimensions].exp() * x], dim=1)

        def objective(p: Array, c: Tensor) -> tuple[float, Array]:
            """−ln evidence − ln prior of (ln ℓ, ln ρ, artanh of the noise's correlation, ln α, ln β), and its gradient."""
            q = tensor(p).requires_grad_(True)
            prior = ((q[:dimensions] - LOG_WIDTH_MEAN) / LOG_WIDTH_SIGMA).square().sum()
            prior = prior + ((q[dimensions] - LOG_RATIO_MEAN) / LOG_RATIO_SIGMA).square()
            correlation = q[-3].tanh()
            phi, goal = (whitened(v, correlation, first_of_run) for v in (design(q, c), y))
            evidence = log_evidence(phi, goal, q[-2], q[-1]) - 0.5 * later * torch.log(1.0 - correlation**2)
            loss = 0.5 * prior - evidence
            loss.backward()
            assert q.grad is not None
            return float(loss.detach()), q.grad.cpu().numpy()

        # Prior variance between 1e-4 and 1e4 of the target's, noise between 1e-7 and 10: H stays well conditioned.
        bounds = [(math.log(0.05), math.log(100.0))] * dimensions + [(-6.0, 6.0), (0.0, 2.0)]
        bounds += [(math.log(0.5e-4), math.log(0.5e4)), (math.log(0.05), math.log(0.5e7))]

        def search(start: Array, c: Tensor) -> tuple[float, Array]:
            options = {"maxiter": iterations}
            fit = minimize(objective, start, args=(c,), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
            return float(fit.fun), np.asarray(fit.x)

        sizes = sorted({min(n, len(target)) for n in centres})
        begin = [
            np.r_[np.log([first] + [others] * (dimensions - 1)), LOG_RATIO_MEAN, 0.1, math.log(2.0), math.log(50.0)]
            for first, others in start_widths
        ]
        fits: list[tuple[float, Array, Array]] = []
        for n in sizes:
            middle = features[spread_points(features, n)]
            c = tensor(middle)
            # More units go on from where fewer ended.
            loss, best = min((search(p, c) for p in begin), key=lambda f: f[0])
            fits.append((loss, best, middle))
            begin = [best]
            if len(middle) < n:
                break
        least = min(f[0] for f in fits)
        _, best, middle = next(f for f in fits if f[0] <= least + 1.0)

        c, q = tensor(middle), tensor(best)
        correlation = math.tanh(best[-3])
        phi, goal = (whitened(v, correlation, first_of_run) for v in (design(q, c), y))
        final = reestimate(phi, goal, float(q[-2].exp()), float(q[-1].exp()))
        if not (final.alpha < 1e9 and final.beta < 1e9):
            # Without signal or without noise the fixed point runs away: the bounded values of the search stand.
            final = posterior(phi, goal, float(q[-2].exp()), float(q[-1].exp()))
        evidence = float(log_evidence(phi, goal, tensor(np.log(final.alpha)), tensor(np.log(final.beta))))
        evidence -= 0.5 * later * math.log(1.0 - correlation**2)
        mixing = torch.linalg.inv(_cholesky(c, q[:dimensions])).T
    return BayesianRbf(
        centres=middle,
        widths=np.exp(best[:dimensions]),
        low=features.min(axis=0) - LINEAR_MARGIN,
        high=features.max(axis=0) + LINEAR_MARGIN,
        mixing=mixing.cpu().numpy(),
        weights=final.weights.cpu().numpy(),
        factor=final.factor.cpu().numpy(),
        alpha=final.alpha,
        beta=final.beta,
        gamma=final.gamma,
        ratio=float(q[dimensions].exp()),
        constant=constant,
        scale=scale,
        count=len(target),
        correlation=correlation,
        log_evidence=evidence - len(target) * math.log(scale),
    )
