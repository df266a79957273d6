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

Several runs differ by what a unit's bias changes from start to start: one offset a run is integrated out (`offsets.py`), its size
τ relative to the noise, t, of the largest evidence with a weak prior about the declared turn-on bias, where that is known. A
run without attitude has a free offset. Where no run has an attitude the level of the function means nothing: `origin`, the mean
of the units over the training, is then taken off them, so that the mean correction there is 0 and sigma is that of a change.

ℓ, ρ, α, β are not known exactly. The mean is that of the most probable ones; the variance is that of a sample of networks drawn
by evidence (`hyperparameters.py`), about this mean: Σ_k p_k·(σ_k² + (δ_k − δ)²).

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
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from stages.thermal.evidence import Posterior, log_evidence, posterior, reestimate
from stages.thermal.hyperparameters import alternatives
from stages.thermal.offsets import Offsets

Array = NDArray[np.float64]

# On the diagonal of K: far below any noise the data can have against the signal, far above rounding.
JITTER = 1e-8
# Weak log-normal priors: widths around 3 standard deviations of their input, the linear units a little less likely than the
# Gaussian ones, each within a factor of e².
LOG_WIDTH_MEAN, LOG_WIDTH_SIGMA = math.log(3.0), 2.0
LOG_RATIO_MEAN, LOG_RATIO_SIGMA = -2.0, 2.0
# Offsets of runs: a tenth of the bias' own change within a factor of e², or the declared turn-on bias within a factor of e.
LOG_OFFSET_MEAN, LOG_OFFSET_SIGMA, LOG_OFFSET_SIGMA_DECLARED = math.log(0.1), 2.0, 1.0
# Linear units go on this far outside the envelope, in standard deviations of a feature.
LINEAR_MARGIN = 1.0
PREDICT_ROWS = 8192
ALTERNATIVES = 12


@dataclass(frozen=True)
class BayesianRbf:
    """K networks of m Gaussian and D linear units, M = m + D, on the same centres: the most probable and some as likely.

    centres (m, D), low and high (D,), where the linear units stop, in scaled features. By network, the most probable one first:
    `share` p (K,), widths (K, D), `mixing` U (K, m, m); weights w (K, M); `factor` F (K, M, M) with F·Fᵀ = H⁻¹; α, β, γ,
    `ratio` ρ of the linear units, `correlation` of one block's noise with the next one's (K,). `constant` c and `scale` are in
    the target's unit: all else is of (target − c)/scale. `count` is N. `origin` (K, M): what is taken off the
    units, 0 where the level is known. `offsets` (R,): what each run of the training was off by, in the target's unit;
    `offset_ratio` (K,): t. `effective`: how many independent draws the sample of networks is worth.
    """

    centres: Array
    low: Array
    high: Array
    share: Array
    widths: Array
    mixing: Array
    weights: Array
    factor: Array
    alpha: Array
    beta: Array
    gamma: Array
    ratio: Array
    correlation: Array
    constant: float
    scale: float
    count: int
    log_evidence: float
    origin: Array
    offsets: Array
    offset_ratio: Array
    effective: float

    SHAPES: ClassVar[dict[str, tuple[str, ...]]] = {
        "centres": ("m", "D"),
        "low": ("D",),
        "high": ("D",),
        "share": ("K",),
        "widths": ("K", "D"),
        "mixing": ("K", "m", "m"),
        "weights": ("K", "m+D"),
        "factor": ("K", "m+D", "m+D"),
        "alpha": ("K",),
        "beta": ("K",),
        "gamma": ("K",),
        "ratio": ("K",),
        "correlation": ("K",),
        "constant": (),
        "scale": (),
        "count": (),
        "log_evidence": (),
        "origin": ("K", "m+D"),
        "offsets": ("R",),
        "offset_ratio": ("K",),
        "effective": (),
    }

    @property
    def noise_sigma(self) -> float:
        """Standard deviation of a target's noise, in the target's unit: √(1/(2β))."""
        return self.scale * math.sqrt(float(self.share @ (0.5 / self.beta)))

    @property
    def informative(self) -> float:
        """How many independent targets the N correlated ones are worth: N·(1 − ρ)/(1 + ρ)."""
        return self.count / self._inflation

    @property
    def _inflation(self) -> float:
        return float(self.share @ ((1.0 + self.correlation) / (1.0 - self.correlation)))

    def noise_of_mean(self, blocks: float) -> float:
        """Standard deviation of the noise in a mean over as long as `blocks` targets: σ/√blocks, more where it is correlated."""
        independent = blocks if blocks < 1.0 else max(blocks / self._inflation, 1.0)
        return self.noise_sigma / math.sqrt(independent)

    def predict(self, features: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (n,) of the function at scaled features (n, D), in the target's unit."""
        means, variances = self.members(features)
        mean = means[0]
        # The constant is a mean of N targets and no surer than that.
        constant = (self.noise_sigma / self.scale) ** 2 / self.informative
        variance = self.share @ (variances + (means - mean) ** 2) + constant
        return self.constant + self.scale * mean, self.scale * np.sqrt(variance)

    def members(self, features: Array) -> tuple[Array, Array]:
        """Mean and variance (K, n) by each network, of (target − c)/scale."""
        means, variances = (np.empty((len(self.share), len(features))) for _ in range(2))
        for start in range(0, len(features), PREDICT_ROWS):
            part = slice(start, start + PREDICT_ROWS)
            x = features[part]
            held = np.clip(x, self.low, self.high)
            beyond = ((x - held) ** 2).sum(axis=1)
            apart = (x.T[:, :, None] - self.centres.T[:, None]) ** 2
            for k in range(len(self.share)):
                square = np.tensordot(0.5 / self.widths[k] ** 2, apart, axes=1)
                gaussian = np.exp(-square) @ self.mixing[k]
                phi = np.hstack([gaussian, self.ratio[k] * held]) - self.origin[k]
                unknown = np.maximum(1.0 - (gaussian**2).sum(axis=1), 0.0) + self.ratio[k] ** 2 * beyond
                means[k, part] = phi @ self.weights[k]
                variances[k, part] = ((phi @ self.factor[k]) ** 2).sum(axis=1) + unknown / (2.0 * self.alpha[k])
        return means, variances


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


@dataclass(frozen=True)
class _Made:
    """One network: posterior of its weights, U, ln evidence, the units' origin (M,), the runs' offsets (R,)."""

    posterior: Posterior
    mixing: Array
    evidence: float
    origin: Array
    offsets: Array


@dataclass(frozen=True)
class _Task:
    """Features x (N, D) and scaled targets y (N,) as tensors, where runs begin, and their offsets, whose ln τ is `expected`
    within `within`; p = (ln ℓ (D,), ln ρ, ln t where offsets have a size, artanh of the noise's correlation, ln α, ln β)."""

    x: Tensor
    y: Tensor
    starts: Tensor
    offsets: Offsets
    expected: float
    within: float

    @property
    def dimensions(self) -> int:
        return self.x.shape[1]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Prior variance between 1e-4 and 1e4 of the target's, noise between 1e-7 and 10: H stays well conditioned."""
        widths = [(math.log(0.05), math.log(100.0))] * self.dimensions
        noise = [(math.log(0.5e-4), math.log(0.5e4)), (math.log(0.05), math.log(0.5e7))]
        size = [(math.log(0.01), math.log(1e5))] if self.offsets.finite else []
        return [*widths, (-6.0, 6.0), *size, (0.0, 2.0), *noise]

    def begin(self, first: float, others: float) -> Array:
        """Where the search starts: widths of the first feature and of the others."""
        log_beta = math.log(50.0)
        size = [self.expected + 0.5 * (math.log(2.0) + log_beta)] if self.offsets.finite else []
        widths = np.log([first] + [others] * (self.dimensions - 1))
        return np.array([*widths, 0.0, *size, 0.1, math.log(2.0), log_beta])

    def tensor(self, a: Array) -> Tensor:
        return torch.as_tensor(a, dtype=torch.float64, device=self.x.device)

    def size(self, q: Tensor) -> Tensor:
        """t, the offsets' size over the noise of a block."""
        return q[self.dimensions + 1].exp() if self.offsets.finite else torch.ones_like(q[0])

    def units(self, q: Tensor, centres: Tensor) -> Tensor:
        """Φ (N, M)."""
        d = self.dimensions
        return torch.cat([_orthonormal(self.x, centres, q[:d]), q[d].exp() * self.x], dim=1)

    def white(self, values: Tensor, q: Tensor) -> Tensor:
        """Rows (N, ...) freed of the noise's colour."""
        return whitened(values, q[-3].tanh(), self.starts)

    def whitened(self, q: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
        """Design (N', M) and target (N',) freed of the noise's colour and of the runs' offsets."""
        ones, size = self.white(torch.ones_like(self.y), q), self.size(q)
        design, target = self.white(self.units(q, centres), q), self.white(self.y[:, None], q)
        return self.offsets.freed(design, ones, size), self.offsets.freed(target, ones, size)[:, 0]

    def volume(self, q: Tensor) -> Tensor:
        """ln of the determinant of the whitening, which the evidence of the whitened targets lacks."""
        colour = -0.5 * (~self.starts).sum() * torch.log(1.0 - q[-3].tanh() ** 2)
        return colour + self.offsets.volume(self.white(torch.ones_like(self.y), q), self.size(q))

    def cost(self, q: Tensor, centres: Tensor) -> Tensor:
        """−ln evidence − ln prior."""
        d = self.dimensions
        prior = ((q[:d] - LOG_WIDTH_MEAN) / LOG_WIDTH_SIGMA).square().sum()
        prior = prior + ((q[d] - LOG_RATIO_MEAN) / LOG_RATIO_SIGMA).square()
        if self.offsets.finite:
            log_size = q[d + 1] - 0.5 * (math.log(2.0) + q[-1])
            prior = prior + ((log_size - self.expected) / self.within).square()
        return 0.5 * prior - log_evidence(*self.whitened(q, centres), q[-2], q[-1]) - self.volume(q)

    def value(self, p: Array, centres: Tensor) -> float:
        with torch.no_grad():
            return float(self.cost(self.tensor(p), centres))

    def slope(self, p: Array, centres: Tensor) -> tuple[float, Array]:
        """The cost and its gradient."""
        q = self.tensor(p).requires_grad_(True)
        cost = self.cost(q, centres)
        cost.backward()
        assert q.grad is not None
        return float(cost.detach()), q.grad.cpu().numpy()

    def search(self, start: Array, centres: Tensor, iterations: int) -> tuple[float, Array]:
        """The least cost from a start, and where it is."""
        options = {"maxiter": iterations}
        fit = minimize(
            self.slope, start, args=(centres,), jac=True, method="L-BFGS-B", bounds=self.bounds, options=options
        )
        return float(fit.fun), np.asarray(fit.x)

    def network(self, p: Array, centres: Tensor, settled: bool) -> _Made:
        """Weights at p, with α and β at their own maximum where `settled`, and all that goes with them."""
        q = self.tensor(p)
        design, target = self.whitened(q, centres)
        given = posterior(design, target, float(q[-2].exp()), float(q[-1].exp()))
        found = reestimate(design, target, given.alpha, given.beta) if settled else given
        if not (found.alpha < 1e9 and found.beta < 1e9):
            # Without signal or without noise the fixed point runs away: the bounded values of the search stand.
            found = given
        log_alpha, log_beta = (self.tensor(np.log(v)) for v in (found.alpha, found.beta))
        evidence = log_evidence(design, target, log_alpha, log_beta) + self.volume(q)
        mixing = torch.linalg.inv(_cholesky(centres, q[: self.dimensions])).T
        phi = self.units(q, centres)
        origin = torch.zeros_like(phi[0]) if self.offsets.anchored else phi.mean(dim=0)
        residual = self.white(self.y - phi @ found.weights, q)
        offsets = self.offsets.estimated(residual, self.white(torch.ones_like(self.y), q), self.size(q))
        return _Made(found, mixing.cpu().numpy(), float(evidence), origin.cpu().numpy(), offsets)


def fit_network(
    features: Array,
    target: Array,
    *,
    starts: NDArray[np.bool_] | None = None,
    offsets: Offsets | None = None,
    turn_on: float | None = None,
    centres: tuple[int, ...] = (20, 40, 80),
    start_widths: tuple[tuple[float, float], ...] = ((0.5, 5.0), (2.0, 2.0)),
    iterations: int = 100,
    seed: int = 0,
    device: str = "cpu",
) -> BayesianRbf:
    """Train on scaled features (N, D) and targets (N,): widths, noise and its colour by evidence from each start, the best kept.

    A start is a pair of widths: of the first feature (T) and of the others. `starts` (N,) marks the first block of each stretch;
    one stretch where it is left out. `offsets` tells runs whose levels differ (none where left out), by about `turn_on`, in the
    target's unit, where that is known. The number of Gaussian units is the smallest of `centres` whose evidence is within a nat
    of the best. `seed` is of the sample of hyperparameters.
    """
    dimensions = features.shape[1]
    if starts is None:
        starts = np.arange(len(target)) == 0
    if offsets is None:
        offsets = Offsets((slice(0, len(target)),), (True,))
    levels = [target[run] for run, known in zip(offsets.runs, offsets.known, strict=True) if known] or [target]
    constant, scale = float(np.concatenate(levels).mean()), float(target.std()) or 1.0
    expected, within = LOG_OFFSET_MEAN, LOG_OFFSET_SIGMA
    if turn_on is not None:
        expected, within = math.log(turn_on / scale), LOG_OFFSET_SIGMA_DECLARED
    with one_thread():
        x, y = (torch.as_tensor(a, dtype=torch.float64, device=device) for a in (features, (target - constant) / scale))
        task = _Task(x, y, torch.as_tensor(starts, device=device), offsets, expected, within)
        begin = [task.begin(*widths) for widths in start_widths]
        fits: list[tuple[float, Array, Array]] = []
        for n in sorted({min(n, len(target)) for n in centres}):
            middle = features[spread_points(features, n)]
            c = task.tensor(middle)
            # More units go on from where fewer ended.
            cost, best = min((task.search(p, c, iterations) for p in begin), key=lambda f: f[0])
            fits.append((cost, best, middle))
            begin = [best]
            if len(middle) < n:
                break
        least = min(f[0] for f in fits)
        _, best, middle = next(f for f in fits if f[0] <= least + 1.0)
        c = task.tensor(middle)
        others, share, effective = alternatives(
            lambda p: task.value(p, c),
            lambda p: task.slope(p, c)[1],
            best,
            np.array(task.bounds),
            ALTERNATIVES,
            seed,
        )
        points = np.vstack([best, others])
        made = [task.network(p, c, settled=k == 0) for k, p in enumerate(points)]
    return BayesianRbf(
        centres=middle,
        low=features.min(axis=0) - LINEAR_MARGIN,
        high=features.max(axis=0) + LINEAR_MARGIN,
        share=np.r_[0.0, share],
        widths=np.exp(points[:, :dimensions]),
        mixing=np.stack([m.mixing for m in made]),
        weights=np.stack([m.posterior.weights.cpu().numpy() for m in made]),
        factor=np.stack([m.posterior.factor.cpu().numpy() for m in made]),
        alpha=np.array([m.posterior.alpha for m in made]),
        beta=np.array([m.posterior.beta for m in made]),
        gamma=np.array([m.posterior.gamma for m in made]),
        ratio=np.exp(points[:, dimensions]),
        correlation=np.tanh(points[:, -3]),
        constant=constant if offsets.anchored else 0.0,
        scale=scale,
        count=len(target),
        log_evidence=made[0].evidence - len(target) * math.log(scale),
        origin=np.stack([m.origin for m in made]),
        offsets=scale * made[0].offsets,
        offset_ratio=np.exp(points[:, dimensions + 1]) if offsets.finite else np.zeros(len(points)),
        effective=effective,
    )
