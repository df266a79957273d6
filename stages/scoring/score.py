"""RQE = ‖B_rec − B_ref‖₂ / ‖B_ref‖₂ at the scored line shape, of the centre point and of the area mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.records import Spectra
from tsmftis.fourier import rqe

KINDS = {"rqe": "radiance", "rqe_area": "radiance_area"}


@dataclass(frozen=True)
class ScoringResult:
    """`scores[kind][method] = {"mean", "targets": {id: value}}` for kind rqe and rqe_area; targets left out of means."""

    scores: dict[str, dict[str, dict[str, Any]]]
    partly_seen: dict[str, list[str]]


def run(spectra: Spectra) -> ScoringResult:
    """Score one line. A target without reference is not scored; one that is not seen well enough under a method is left
    out of that method's mean and listed in `partly_seen[method]`."""
    has_reference = [bool(np.isfinite(row).all()) for row in spectra.reference]
    scores: dict[str, dict[str, dict[str, Any]]] = {kind: {} for kind in KINDS}
    partly: dict[str, list[str]] = {}
    for kind, name in KINDS.items():
        values = rqe(getattr(spectra, name), spectra.reference)
        for m, method in enumerate(spectra.methods):
            good = {t: float(v) for t, v in zip(spectra.targets, values[m], strict=True) if np.isfinite(v)}
            mean = float(np.mean(list(good.values()))) if good else None
            scores[kind][method] = {"mean": mean, "targets": good}
            missed = [t for t, r in zip(spectra.targets, has_reference, strict=True) if r and t not in good]
            if missed:
                partly[method] = sorted(set(partly.get(method, [])) | set(missed))
    return ScoringResult(scores, partly)
