"""MacKay's evidence framework for a model that is linear in its weights, in the SUM convention.

    F(w) = α·E_w + β·E_d,   E_w = Σ w_m²,   E_d = Σ (y_n − φ_n·w)²
    H = 2αI + 2βΦᵀΦ,   w = 2β·H⁻¹Φᵀy,   γ = M − 2α·tr H⁻¹,   α = γ/(2E_w),   β = (N − γ)/(2E_d)

The noise variance is 1/(2β), a weight's prior variance 1/(2α). γ, the number of weights that the data determine, lies
between 0 and M. The paper prints E_w and E_d as means beside the γ of the sums; the two do not go together: with means
α and β of this module become Mα and Nβ, and nothing else changes (a test holds the two against each other).

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415.
.. [2] F. D. Foresee, M. T. Hagan, Gauss-Newton approximation to Bayesian learning, Proc. ICNN (1997) 1930.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Posterior:
    """What the data say about the weights: mean (M,), `factor` F (M, M) with F·Fᵀ = H⁻¹, and α, β, γ."""

    weights: Tensor
    factor: Tensor
    alpha: float
    beta: float
    gamma: float


def posterior(design: Tensor, target: Tensor, alpha: float, beta: float) -> Posterior:
    """The posterior at given α, β for design Φ (N, M) and target y (N,)."""
    count, units = design.shape
    identity = torch.eye(units, dtype=design.dtype, device=design.device)
    hessian = 2.0 * alpha * identity + 2.0 * beta * design.T @ design
    cholesky = torch.linalg.cholesky(hessian)
    weights = 2.0 * beta * torch.cholesky_solve((design.T @ target)[:, None], cholesky)[:, 0]
    factor = torch.linalg.solve_triangular(cholesky.T, identity, upper=True)
    gamma = units - 2.0 * alpha * float((factor**2).sum())
    if not -1e-6 * units <= gamma <= min(units, count) * (1.0 + 1e-6):
        raise AssertionError(f"γ = {gamma:.6g} lies outside 0 … {units}: α, β and H are not of one convention")
    return Posterior(weights, factor, alpha, beta, min(max(gamma, 0.0), float(units)))


def reestimate(
    design: Tensor, target: Tensor, alpha: float, beta: float, iterations: int = 1000, tolerance: float = 1e-10
) -> Posterior:
    """MacKay's fixed point: α ← γ/(2E_w), β ← (N − γ)/(2E_d) until neither changes by more than `tolerance`.

    Worked in the eigenvectors of ΦᵀΦ, where a step costs M operations: γ = Σ βλ/(βλ + α).
    """
    count = len(target)
    values, vectors = torch.linalg.eigh(design.T @ design)
    values = values.clamp_min(0.0)
    projected = vectors.T @ (design.T @ target)
    # The part of y outside the span of Φ, kept apart so that a small E_d does not drown in the size of y.
    inside = values > 1e-14 * values.max()
    solution = torch.where(inside, projected / torch.where(inside, values, 1.0), 0.0)
    outside = float(((target - design @ (vectors @ solution)) ** 2).sum())
    tiny = 1e-14 * float((target**2).sum()) + 1e-300
    for _ in range(iterations):
        shrink = beta * values / (beta * values + alpha)
        weights = shrink * solution
        gamma = float(shrink.sum())
        e_w = float((weights**2).sum())
        e_d = outside + float((values * (solution - weights) ** 2).sum())
        # A target that is fitted exactly, or that is zero, would send β or α to infinity.
        new_alpha = gamma / (2.0 * max(e_w, tiny))
        new_beta = max(count - gamma, 1e-9) / (2.0 * max(e_d, tiny))
        change = max(abs(math.log(new_alpha / alpha)), abs(math.log(new_beta / beta)))
        alpha, beta = new_alpha, new_beta
        if change < tolerance:
            break
    return posterior(design, target, alpha, beta)


def log_evidence(design: Tensor, target: Tensor, log_alpha: Tensor, log_beta: Tensor) -> Tensor:
    """ln p(y | α, β, Φ) = −F(w) − ½ ln|H| + (M/2)·ln 2α + (N/2)·ln(β/π), differentiable in everything."""
    count, units = design.shape
    alpha, beta = log_alpha.exp(), log_beta.exp()
    identity = torch.eye(units, dtype=design.dtype, device=design.device)
    cholesky = torch.linalg.cholesky(2.0 * alpha * identity + 2.0 * beta * (design.T @ design))
    weights = 2.0 * beta * torch.cholesky_solve((design.T @ target)[:, None], cholesky)[:, 0]
    energy = alpha * (weights**2).sum() + beta * ((target - design @ weights) ** 2).sum()
    return (
        -energy
        - cholesky.diagonal().log().sum()
        + 0.5 * units * (math.log(2.0) + log_alpha)
        + 0.5 * count * (log_beta - math.log(math.pi))
    )
