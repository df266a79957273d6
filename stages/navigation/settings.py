"""Settings of the navigation stage; the sensors' own figures come from instrument.yaml."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from stages.navigation.states import DEFAULT_GROUPS

Group = Literal[
    "gyro_bias",
    "accel_bias",
    "gyro_scale_factor",
    "accel_scale_factor",
    "gyro_g_sensitivity",
    "antenna_lever_arm",
    "gnss_latency",
]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Span = tuple[Annotated[float, Field(allow_inf_nan=False)], Annotated[float, Field(allow_inf_nan=False)]]


class NavigationSettings(BaseModel):
    """How the filter is run, and what it estimates."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    estimate: tuple[Group, ...] = Field(
        DEFAULT_GROUPS,  # type: ignore[arg-type]
        description="groups of parameters estimated beside position, velocity and attitude; antenna_lever_arm, gnss_latency and "
        "gyro_g_sensitivity may be added",
    )
    lever_arm_sigma_m: Positive = Field(
        0.5, le=100.0, description="how far the declared antenna lever arm may be off an axis, where it is estimated"
    )
    gnss_latency_sigma_s: Positive = Field(
        0.1, le=5.0, description="how far the fixes' stamps may be off, where the latency is estimated"
    )
    g_sensitivity_sigma_deg_per_h_per_g: Positive = Field(
        1.0, le=1e4, description="g-sensitivity of the gyros that is to be expected, where it is estimated"
    )
    epoch_s: float = Field(0.2, ge=1e-3, le=1.0, description="longest step of the covariance")
    gate_probability: float = Field(1e-6, gt=0, lt=0.1, description="chance that a good fix is rejected")
    reentry_s: Positive = Field(
        20.0,
        description="where positions that agree with each other are rejected for so long, the filter doubts itself instead",
    )
    sigma_factor: tuple[Positive, Positive, Positive] = Field(
        (1.0, 1.0, 1.0), description="factors on the sigmas of fixed, float and single fixes"
    )
    use_gnss_velocity: bool = Field(True, description="use the fixes' velocities besides their positions")
    course_speed_m_per_s: Positive = Field(
        1.0, description="least speed whose course is taken for the heading when the pipeline aligns itself"
    )
    standstill_updates: bool = Field(
        True, description="hold velocity and attitude where IMU and GNSS show that the vehicle stands"
    )
    standstill_sigma_m_per_s: Positive = Field(0.01, description="how well the velocity is zero at standstill")
    passes: int = Field(5, ge=1, le=10, description="most filter passes when the first attitude was poor")
    longest_imu_gap_s: Positive = Field(
        5.0, description="a longer gap in the inertial data is refused: nothing tells how the body moved in it"
    )
    withhold_s: tuple[Span, ...] = Field(
        (),
        description="times [[start, stop], ...] [s after the epoch] whose fixes are not used, and whose misses are reported",
    )
    withhold_every_s: tuple[Positive, Positive] | None = Field(
        None,
        description="[period, length] [s] from the first fix on: the last `length` of every `period` is withheld likewise",
    )
    free_inertial_after_s: float | None = Field(
        None,
        allow_inf_nan=False,
        description="no fix is used after this time [s after the epoch]; their misses are reported",
    )
    free_inertial_height_sigma_m: Positive = Field(
        5.0,
        description="in free-inertial mode the fixes' height alone is used with this sigma, as a barometer would be: without, "
        "the vertical channel diverges",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for start, stop in self.withhold_s:
            if not start < stop:
                raise ValueError(f"withhold_s: [{start:g}, {stop:g}] does not increase")
        if self.withhold_every_s is not None and not self.withhold_every_s[1] < self.withhold_every_s[0]:
            raise ValueError("withhold_every_s: the length must be shorter than the period")
        return self
