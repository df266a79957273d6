"""What of registration may be set; lengths in pixels of the detector."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class RegistrationSettings(BaseModel):
    """Flattening, corners, key frames, phase correlation and refinement; lengths in pixels of the detector."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    median_frames: int = Field(200, ge=10, description="frames that the temporal median is taken over, evenly spread")
    contrast_px: int = Field(17, ge=5, le=127, description="side of the square that local mean and contrast are of")
    contrast_floor: float = Field(
        0.02, gt=0, lt=1, description="relative contrast below which texture is not amplified"
    )

    corners: int = Field(400, ge=20, description="most corners followed from a key frame")
    corner_quality: float = Field(0.01, gt=0, lt=1, description="least corner response over the best one")
    corner_distance_px: float = Field(4.0, gt=0, description="least distance between corners")
    window_px: int = Field(15, ge=5, le=63, description="side of the KLT window")
    pyramid_levels: int = Field(3, ge=0, le=6, description="halvings of the image for large motions")
    ransac_threshold_px: float = Field(0.7, gt=0, description="a corner farther from the common motion is left out")
    least_inliers: int = Field(12, ge=4, description="fewer inliers than this start a new key frame")
    agreeing_fraction: float = Field(
        0.3,
        gt=0,
        lt=1,
        description="a new key frame when fewer of the corners followed are inliers: noise agrees by chance",
    )
    kept_fraction: float = Field(
        0.5, gt=0, lt=1, description="a new key frame when fewer of the corners are still followed"
    )

    phase_overlap: float = Field(
        0.75, gt=0, lt=1, description="phase: a new key frame when the frame shares less of its area with the last one"
    )
    phase_response: float = Field(
        25.0,
        gt=1,
        description="phase: a peak lower than this, in units of 1/√pixels, is not believed; noise reaches 20",
    )

    ecc_half_px: int = Field(20, ge=8, le=100, description="half the side of the square refined about a target")
    ecc_iterations: int = Field(10, ge=1, le=200, description="most iterations of a refinement")
    ecc_precision: float = Field(
        1e-4, gt=0, description="a refinement ends when the correlation grows by less than this"
    )
    ecc_reach_px: float = Field(2.0, gt=0, description="a refinement that moves farther than this is not believed")
