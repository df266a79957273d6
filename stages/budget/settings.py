"""What a user may choose about the error budget; units are in the names."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class BudgetSettings(BaseModel):
    """How often to draw, and sigmas of what nothing in a campaign tells."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    draws: int = Field(8, ge=2, le=1000, description="draws of the navigation's errors, a line")
    seed: int = Field(0, ge=0, description="of these draws")
    target_height_sigma_m: float = Field(
        0.1, gt=0, le=1000, description="sigma of the surveyed targets' heights; a campaign does not tell it"
    )
    boresight_sigma_deg: float = Field(
        0.005,
        gt=0,
        le=10,
        description="sigma of each boresight angle, where ground control points (GCPs) do not tell it",
    )
    latency_sigma_ms: float = Field(
        0.1, gt=0, le=1000, description="sigma of the frames' latency, where ground control points do not tell it"
    )
