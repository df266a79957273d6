"""RQE = ‖B_rec − B_ref‖₂ / ‖B_ref‖₂ at the scored line shape, of the centre point and of the area mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.records import Spectra
from tsmftis.fourier import rqe

KINDS = {"rqe": "radiance", "rqe_area": "radiance_area"}
HIGH_GRADIENT = 0.5  # contrast of the surroundings over the panel's own signal


@dataclass(frozen=True)
class ScoringResult:
    """`scores[kind][method] = {"mean", "targets": {id: value}}` for kind rqe and rqe_area; targets left out of means.

    noise_limit[kind][method] = {id: value}: what noise alone would make of the score, √Σσ²/‖B_ref‖. high_gradient: targets
    whose surroundings differ from them so much that a little of those changes the score.
    """

    scores: dict[str, dict[str, dict[str, Any]]]
    partly_seen: dict[str, list[str]]
    noise_limit: dict[str, dict[str, dict[str, float]]]
    high_gradient: list[str] = field(default_factory=list)


def run(spectra: Spectra, contrast: Mapping[str, float] | None = None) -> ScoringResult:
    """Score one line. A target without reference is not scored; one that is not seen well enough under a method is left
    out of that method's mean and listed in `partly_seen[method]`. contrast: of each target's surroundings, where known."""
    has_reference = [bool(np.isfinite(row).all()) for row in spectra.reference]
    scores: dict[str, dict[str, dict[str, Any]]] = {kind: {} for kind in KINDS}
    limits: dict[str, dict[str, dict[str, float]]] = {kind: {} for kind in KINDS}
    partly: dict[str, list[str]] = {}
    size = np.linalg.norm(spectra.reference, axis=-1)
    for kind, name in KINDS.items():
        values = rqe(getattr(spectra, name), spectra.reference)
        noise = np.linalg.norm(getattr(spectra, f"sigma_{name}"), axis=-1) / size
        for m, method in enumerate(spectra.methods):
            good = {t: float(v) for t, v in zip(spectra.targets, values[m], strict=True) if np.isfinite(v)}
            mean = float(np.mean(list(good.values()))) if good else None
            scores[kind][method] = {"mean": mean, "targets": good}
            limits[kind][method] = {t: float(v) for t, v in zip(spectra.targets, noise[m], strict=True) if t in good}
            missed = [t for t, r in zip(spectra.targets, has_reference, strict=True) if r and t not in good]
            if missed:
                partly[method] = sorted(set(partly.get(method, [])) | set(missed))
    steep = [t for t, c in (contrast or {}).items() if c > HIGH_GRADIENT]
    return ScoringResult(scores, partly, limits, steep)
