"""The preset of a simulation. Units stand in the keys; `instrument` is written to the campaign as it stands."""

from __future__ import annotations

from importlib import resources
from typing import Annotated, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tsmftis.simulator import effects, materials

Identifier = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Triple = tuple[float, float, float]
NotNegativeTriple = tuple[NotNegative, NotNegative, NotNegative]


class Section(BaseModel):
    """A part of the preset: no key unknown, none changed later."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Angles(Section):
    roll: float
    pitch: float
    yaw: float

    def triple(self) -> Triple:
        return self.roll, self.pitch, self.yaw


class PositiveAngles(Section):
    roll: Positive
    pitch: Positive
    yaw: Positive

    def triple(self) -> Triple:
        return self.roll, self.pitch, self.yaw


# --- instrument: the keys of instrument.yaml -------------------------------------------------------------------------


class Gyro(Section):
    angle_random_walk_deg_per_sqrt_h: NotNegative
    bias_sigma_deg_per_h: NotNegative
    bias_correlation_time_s: Positive
    scale_factor_sigma_ppm: NotNegative


class Accel(Section):
    velocity_random_walk_ug_per_sqrt_hz: NotNegative
    bias_sigma_ug: NotNegative
    bias_correlation_time_s: Positive
    scale_factor_sigma_ppm: NotNegative


class ImuUnit(Section):
    rate_hz: Positive
    gyro: Gyro
    accel: Accel


class Mounting(Section):
    imu_to_body_deg: Angles = Angles(roll=0.0, pitch=0.0, yaw=0.0)
    imu_to_antenna_m: Triple
    imu_to_camera_m: Triple
    boresight_deg: Angles


class PrincipalPoint(Section):
    row: float
    col: float


class Camera(Section):
    rows: Annotated[int, Field(ge=2)]
    cols: Annotated[int, Field(ge=2)]
    pixel_pitch_m: Positive
    focal_length_m: Positive
    principal_point_px: PrincipalPoint
    radial_k1: float = 0.0
    latency_s: float = 0.0
    frame_rate_hz: Positive
    saturation_dn: Annotated[int, Field(gt=0, le=65535)]


class Interferometer(Section):
    opd_step_m: Positive
    zpd_col: float
    opd_quadratic_m: float = 0.0
    fringe_tilt_m_per_row: float = 0.0
    detector_nonlinearity: float = 0.0
    wavelength_range_nm: tuple[Positive, Positive]


class Instrument(Section):
    imu: ImuUnit
    mounting: Mounting
    camera: Camera
    interferometer: Interferometer


# --- flight ----------------------------------------------------------------------------------------------------------


class Start(Section):
    latitude_deg: Annotated[float, Field(gt=-85.0, lt=85.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, lt=180.0)]
    height_m: float
    course_deg: float


class Straight(Section):
    straight_s: Positive
    climb_m: float = 0.0


class Turn(Section):
    turn_deg: float  # right positive
    bank_deg: Annotated[float, Field(gt=0.0, lt=60.0)]
    climb_m: float = 0.0

    @model_validator(mode="after")
    def _turns(self) -> Self:
        if self.turn_deg == 0.0:
            raise ValueError("turn_deg must not be zero")
        return self


class Gusts(Section):
    sigma_north_east_down_m_per_s: NotNegativeTriple
    corner_hz: Positive
    cutoff_hz: Positive
    terms: Annotated[int, Field(gt=0)]


class Wobble(Section):
    sigma_deg: Angles
    cutoff_hz: PositiveAngles
    terms: Annotated[int, Field(gt=0)]


class Vibration(Section):
    rate_sigma_deg_per_s: Angles
    band_hz: tuple[Positive, Positive]
    terms: Annotated[int, Field(gt=0)]


class Initial(Section):
    """The attitude handed to the pipeline: the true one with these errors."""

    time_s: NotNegative
    sigma_roll_deg: Positive
    sigma_pitch_deg: Positive
    sigma_yaw_deg: Positive


class FlightSettings(Section):
    id: Identifier
    start: Start
    speed_m_per_s: Positive
    pitch_deg: float
    drift_angle_deg: float
    bank_ramp_s: Positive
    legs: Annotated[list[Straight | Turn], Field(min_length=1)]
    gusts: Gusts
    wobble: Wobble
    vibration: Vibration
    initial: Initial | None


class Line(Section):
    id: Identifier
    start_s: NotNegative
    duration_s: Positive
    panels: Annotated[list[str], Field(min_length=1)]

    @model_validator(mode="after")
    def _known(self) -> Self:
        _check_materials(self.panels)
        return self


class Gnss(Section):
    rate_hz: Positive
    start_s: NotNegative
    sigma_position_north_east_down_m: NotNegativeTriple
    sigma_velocity_north_east_down_m_per_s: NotNegativeTriple
    drift_sigma_position_m: NotNegative  # Gauss–Markov, on top and not declared in the file's sigmas
    drift_correlation_time_s: Positive


# --- thermal ---------------------------------------------------------------------------------------------------------


class Hold(Section):
    hold_min: Positive


class Ramp(Section):
    to_degc: float
    rate_k_per_min: Positive


class AirProfile(Section):
    start_degc: float
    stages: list[Hold | Ramp]

    def straight_lines(self) -> list[tuple[float, float]]:
        """(duration [s], temperature at its end [°C]) of each stage."""
        lines, now = [], self.start_degc
        for stage in self.stages:
            if isinstance(stage, Hold):
                lines.append((60.0 * stage.hold_min, now))
            else:
                lines.append((60.0 * abs(stage.to_degc - now) / stage.rate_k_per_min, stage.to_degc))
                now = stage.to_degc
        return lines

    def duration_s(self) -> float:
        return sum(duration for duration, _ in self.straight_lines())


class NodeValues(Section):
    anode: Positive
    cathode: Positive
    shell: Positive
    accel: Positive


class Thermal(Section):
    gyro_bias_deg_per_h: NotNegative
    accel_bias_ug: NotNegative
    time_constant_s: NodeValues
    time_constant_spread: Annotated[float, Field(ge=0.0, lt=1.0)]  # relative, between axes
    self_heating_k: NodeValues
    thermometer_rate_hz: Positive
    thermometer_noise_k: NotNegative
    thermometer_resolution_k: Positive
    flight_air: AirProfile


class ChamberRuns(Section):
    rate_hz: Positive
    latitude_deg: float
    height_m: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    train: AirProfile
    verify: AirProfile


# --- ground and light ------------------------------------------------------------------------------------------------


class TerrainSettings(Section):
    height_m: float
    relief_sigma_m: NotNegative
    wavelength_m: tuple[Positive, Positive]
    waves: Annotated[int, Field(gt=0)]
    cell_m: Positive
    margin_m: NotNegative  # beyond what the camera would see of flat ground


class Scene(Section):
    panel_size_m: Positive
    panel_margin_m: NotNegative  # kept clear before the first and behind the last panel
    panel_scatter_m: NotNegative  # across the track, either side
    background: dict[str, Positive]  # shares of the materials between the panels
    contrast: NotNegative
    patch_m: tuple[Positive, Positive]
    cell_m: Positive
    samples_per_pixel_side: Annotated[int, Field(gt=0)]

    @model_validator(mode="after")
    def _known(self) -> Self:
        if not self.background:
            raise ValueError("background: at least one material")
        _check_materials(self.background)
        return self


class Light(Section):
    radiance_scale: Positive  # reference radiance unit of a perfect reflector where sunlight peaks
    wavenumber_start_per_m: Positive
    wavenumber_stop_per_m: Positive
    wavenumber_step_per_m: Positive


class Detector(Section):
    response_peak_dn_per_radiance_per_m: Positive
    response_centre_nm: Positive
    response_width_nm: Positive
    response_edge_per_m: Positive
    visibility: Annotated[float, Field(gt=0.0, le=1.0)]
    phase_rad: list[float]  # of powers of wavenumber scaled to −1 … 1
    dark_dn: NotNegative
    dark_sigma_dn: NotNegative
    vignetting: Annotated[float, Field(ge=0.0, lt=1.0)]  # loss in the corners
    pixel_gain_sigma: NotNegative
    electrons_per_dn: Positive
    read_noise_dn: NotNegative
    exposure_s: NotNegative  # zero freezes the motion
    exposure_instants: Annotated[int, Field(gt=0)]


class Gcps(Section):
    per_line: Annotated[int, Field(ge=0)]
    sigma_px: Positive


class SimulationSettings(Section):
    """A campaign to simulate."""

    name: Identifier
    epoch: str
    scale: Literal["GPS"]
    instrument: Instrument
    flight: FlightSettings
    lines: Annotated[list[Line], Field(min_length=1)]
    gnss: Gnss
    thermal: Thermal
    chamber: ChamberRuns
    terrain: TerrainSettings
    scene: Scene
    light: Light
    detector: Detector
    gcps: Gcps
    effects: dict[str, dict[str, float | list[float]]]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        effects.complete(self.effects)
        names = [line.id for line in self.lines]
        if len(set(names)) != len(names):
            raise ValueError("lines: two lines share an id")
        if self.detector.exposure_s > 0.0 and self.detector.exposure_instants < 2:
            raise ValueError("detector.exposure_instants: at least 2 where exposure_s is not zero")
        return self

    @classmethod
    def from_yaml(cls, text: str) -> Self:
        """From the text of a preset."""
        return cls.model_validate(yaml.safe_load(text))

    @classmethod
    def preset(cls, name: str) -> Self:
        """A preset that comes with the project: demo, survey, mems."""
        return cls.from_yaml(resources.files("configs").joinpath(f"simulation/{name}.yaml").read_text(encoding="utf-8"))


def _check_materials(names: list[str] | dict[str, float]) -> None:
    for name in names:
        if name not in materials.NAMES:
            raise ValueError(f"no material {name}; there are {', '.join(materials.NAMES)}")
