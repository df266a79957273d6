"""Settings of the closed loop: what counts as found, declared beforehand."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class LoopSettings(BaseModel):
    """Thresholds of the loop; the defaults are those that its certification was measured with."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    p_value: float = Field(0.02, gt=0, lt=1)
    """Of the largest statistic over the whole library, below which an effect is looked at."""
    learned_p_value: float = Field(0.01, gt=0, lt=1)
    """The same for a curve of a covariate, which has no name to be checked against."""
    gain: float = Field(0.10, gt=0, lt=1)
    """Share of the held-out RMS by which an effect must lower it, ..."""
    decisive: float = Field(3.0, gt=0)
    """... or gain in held-out log-likelihood where noise hides the RMS (3 is 20 to 1); needs four folds, and a gain that is
    not all of one fold."""
    snr: float = Field(5.0, gt=0)
    """Signal-to-noise ratio under which an effect cannot be told from a rival, or be seen at all."""
    steps: int = Field(5, ge=1, le=20)
    """Most effects added."""
    controls: int = Field(39, ge=0, le=999)
    """Shifted signatures (negative controls) and shifted covariates; at most 5 % of them may do as well as the real one."""
    draws: int = Field(4000, ge=100)
    """Of the null distribution of the largest statistic."""
    spline_columns: int = Field(7, ge=4, le=30)
    """Size of the basis of a learned term."""
    seal: bool = True
    """Keep one group for the very end where there are four or more."""
