"""Scores against the definition, written out."""

from __future__ import annotations

import numpy as np
import pytest

from flows.results import campaign_means
from pipeline.records import Spectra
from stages.scoring import run

NAN = np.full(4, np.nan)


def spectra() -> Spectra:
    """Four targets: three with a reference (one of them unseen by `nominal`), one without."""
    reference = np.array([[3.0, 4.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0], [2.0, 0.0, 0.0, 0.0], NAN])
    off = np.array([[0.0, 0.0, 1.0, 0.0], [0.5, -0.5, 0.5, -0.5], [0.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
    tracking = np.where(np.isnan(reference), 1.0, reference) + off
    nominal = tracking + off
    nominal[2] = np.nan
    radiance = np.stack([nominal, tracking])
    area = np.stack([tracking, tracking])
    area[1, 0] = np.nan
    return Spectra(
        ("nominal", "tracking"),
        ("a", "b", "c", "d"),
        np.arange(4.0),
        radiance,
        radiance,
        area,
        area,
        reference,
        np.full((2, 4), 25),
        np.zeros(3),
    )


def test_scores_means_and_partly_seen() -> None:
    """RQE = ‖B − B_ref‖/‖B_ref‖ by hand: 1/5, 1/2, 1/2; d has no reference and is nowhere; rounding."""
    result = run(spectra())
    point = result.scores["rqe"]
    assert point["tracking"]["targets"] == pytest.approx({"a": 0.2, "b": 0.5, "c": 0.5})
    assert point["tracking"]["mean"] == pytest.approx(0.4)
    assert point["nominal"]["targets"] == pytest.approx({"a": 0.4, "b": 1.0})
    assert point["nominal"]["mean"] == pytest.approx(0.7)
    assert result.scores["rqe_area"]["tracking"]["targets"] == pytest.approx({"b": 0.5, "c": 0.5})
    # Left out of a mean is named, whichever of the two scores it is left out of; no reference is not "partly seen".
    assert result.partly_seen == {"nominal": ["c"], "tracking": ["a"]}


def test_campaign_means_weigh_targets_not_lines() -> None:
    one = run(spectra()).scores
    two = {"rqe": {"tracking": {"mean": 0.9, "targets": {"z": 0.9}}, "nominal": {"mean": None, "targets": {}}}}
    means = campaign_means([one, two])
    assert means["rqe"]["tracking"] == pytest.approx((0.2 + 0.5 + 0.5 + 0.9) / 4)
    assert means["rqe"]["nominal"] == pytest.approx(0.7)
    assert campaign_means([two])["rqe"] == pytest.approx({"tracking": 0.9})
