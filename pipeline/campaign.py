"""The campaign folder: campaign.yaml and instrument.yaml, read strictly, every path confined to the folder.

`read_campaign` checks the two YAML files and that every named file exists; the records read themselves when they are
asked for (`Campaign.imu`, `.frames`, …), so a run over trajectory only never opens a frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, field_validator

from pipeline import records
from pipeline.errors import InputError
from pipeline.yaml_file import load_yaml
from tsmftis.camera import Camera, Mounting
from tsmftis.inertial import DEG_PER_H, MICRO_G, ImuModel, SensorModel
from tsmftis.interferometer import Interferometer

ZARR_MARKERS = ("zarr.json", ".zgroup", ".zmetadata")
# A flight's folder stands beside these in the results, a line's beside those.
TAKEN_BY_RESULTS = {"bench", "run.json", "report.html", "thermal_model.nc", "thermal_figures.json", ".stages"}
TAKEN_BY_FLIGHT = {"trajectory.nc", "trajectory.sbet", "trajectory.smrmsg", "navigation.json", "thermal.nc"}

Identifier = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]+$")]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Strict(BaseModel):
    """Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, coerce_numbers_to_str=True)


class TimeKeys(Strict):
    scale: Literal["GPS"]
    epoch: str

    @field_validator("epoch")
    @classmethod
    def _is_a_date(cls, value: str) -> str:
        datetime.fromisoformat(value)
        return value


class InitialKeys(Strict):
    time_s: Finite
    roll_deg: Finite
    pitch_deg: Annotated[float, Field(ge=-85.0, le=85.0)]
    yaw_deg: Finite
    sigma_roll_deg: Positive
    sigma_pitch_deg: Positive
    sigma_yaw_deg: Positive


class LineKeys(Strict):
    id: Identifier
    frames: str
    targets: str
    gcps: str | None = None


class FlightKeys(Strict):
    id: Identifier
    imu: str
    gnss: str
    initial: InitialKeys | None = None
    lines: tuple[LineKeys, ...] = ()


class BenchKeys(Strict):
    id: Identifier
    file: str


class ThermalKeys(Strict):
    train: tuple[str, ...] = Field(min_length=1)
    verify: tuple[str, ...] = ()


class CampaignKeys(Strict):
    format: Literal["tsmftis-campaign/1"]
    name: str
    time: TimeKeys
    instrument: str
    calibration: str | None = None
    references: str | None = None
    dem: str | None = None
    thermal: ThermalKeys | None = None
    flights: tuple[FlightKeys, ...] = ()
    bench: tuple[BenchKeys, ...] = ()


class GyroKeys(Strict):
    angle_random_walk_deg_per_sqrt_h: Positive
    bias_sigma_deg_per_h: NonNegative
    bias_correlation_time_s: Positive
    scale_factor_sigma_ppm: NonNegative


class AccelKeys(Strict):
    velocity_random_walk_ug_per_sqrt_hz: Positive
    bias_sigma_ug: NonNegative
    bias_correlation_time_s: Positive
    scale_factor_sigma_ppm: NonNegative


class ImuKeys(Strict):
    rate_hz: Positive
    gyro: GyroKeys
    accel: AccelKeys


class AngleKeys(Strict):
    roll: Finite = 0.0
    pitch: Finite = 0.0
    yaw: Finite = 0.0


class BoresightKeys(Strict):
    """No angle has a default here: a boresight that was never calibrated is no boresight of zero."""

    roll: Finite
    pitch: Finite
    yaw: Finite


Vector = Annotated[tuple[Finite, Finite, Finite], Field()]


class MountingKeys(Strict):
    imu_to_body_deg: AngleKeys = AngleKeys()
    imu_to_antenna_m: Vector | None = None
    imu_to_camera_m: Vector | None = None
    boresight_deg: BoresightKeys | None = None


class PrincipalPointKeys(Strict):
    row: Finite
    col: Finite


class CameraKeys(Strict):
    rows: int = Field(gt=1)
    cols: int = Field(gt=7)
    pixel_pitch_m: Annotated[float, Field(gt=0, lt=1e-3)]
    focal_length_m: Annotated[float, Field(gt=0, lt=10)]
    principal_point_px: PrincipalPointKeys
    frame_rate_hz: Positive
    saturation_dn: Positive
    radial_k1: Finite = 0.0
    latency_s: Finite = 0.0


class InterferometerKeys(Strict):
    opd_step_m: Positive
    zpd_col: Finite
    wavelength_range_nm: tuple[Positive, Positive]
    opd_quadratic_m: Finite = 0.0
    fringe_tilt_m_per_row: Finite = 0.0
    detector_nonlinearity: Finite = 0.0


class InstrumentKeys(Strict):
    imu: ImuKeys | None = None
    mounting: MountingKeys | None = None
    camera: CameraKeys | None = None
    interferometer: InterferometerKeys | None = None


@dataclass(frozen=True)
class Instrument:
    """The declared models in SI; None where the campaign does not use that part."""

    imu: ImuModel | None
    mounting: Mounting | None
    camera: Camera | None
    interferometer: Interferometer | None


@dataclass(frozen=True)
class Campaign:
    """A checked campaign: `keys` as in campaign.yaml, `instrument` in SI, and readers of its records."""

    root: Path
    keys: CampaignKeys
    instrument: Instrument
    warnings: tuple[str, ...] = ()

    def path(self, name: str) -> Path:
        """The file of a path in campaign.yaml; confined to the folder when the campaign was read."""
        return self.root / name

    def flight(self, flight: str) -> FlightKeys:
        return next(f for f in self.keys.flights if f.id == flight)

    def line(self, flight: str, line: str) -> LineKeys:
        return next(entry for entry in self.flight(flight).lines if entry.id == line)

    def imu(self, flight: str) -> records.Imu:
        path = self.path(self.flight(flight).imu)
        imu = records.Imu.from_file(path)
        assert self.instrument.mounting is not None
        mean = self.instrument.mounting.dcm_imu_to_body @ np.median(imu.accel, axis=0)
        if -mean[2] < 0.7 * np.linalg.norm(mean):
            axis = "xyz"[int(np.argmax(np.abs(mean)))]
            raise InputError(
                path,
                "variable 'accel'",
                f"gravity acts along body {axis} ({mean[0]:.1f}, {mean[1]:.1f}, {mean[2]:.1f} m s-2 in forward, right, down) "
                "where an upright aircraft reads about (0, 0, -9.8)",
                "columns are swapped or signs turned, or mounting.imu_to_body_deg in instrument.yaml is wrong",
            )
        return imu

    def gnss(self, flight: str) -> records.Gnss:
        return records.Gnss.from_file(self.path(self.flight(flight).gnss))

    def chamber(self, name: str) -> records.Chamber:
        return records.Chamber.from_file(self.path(name), name)

    def frames(self, flight: str, line: str) -> records.Frames:
        camera = self.instrument.camera
        assert camera is not None
        return records.Frames.from_file(self.path(self.line(flight, line).frames), camera.rows, camera.cols)

    def targets(self, flight: str, line: str) -> records.Targets:
        path = self.path(self.line(flight, line).targets)
        targets = records.Targets.from_file(path)
        if self.keys.references is not None:
            known = self.references().names
            for target, name in zip(targets.ids, targets.reference, strict=True):
                if name and name not in known:
                    raise InputError(
                        path,
                        f"target {target}, column reference",
                        f"'{name}' is not in {self.keys.references}",
                        f"use one of {', '.join(known)} or leave it empty",
                    )
        return targets

    def gcps(self, flight: str, line: str) -> records.Gcps | None:
        name = self.line(flight, line).gcps
        return None if name is None else records.Gcps.from_file(self.path(name))

    def calibration(self) -> records.Calibration:
        camera = self.instrument.camera
        assert camera is not None and self.keys.calibration is not None
        return records.Calibration.from_file(self.path(self.keys.calibration), camera.rows, camera.cols)

    def references(self) -> records.References:
        assert self.keys.references is not None
        return records.References.from_file(self.path(self.keys.references))

    def bench(self, bench: str) -> records.Bench:
        entry = next(b for b in self.keys.bench if b.id == bench)
        return records.Bench.from_file(self.path(entry.file))


def read_campaign(folder: Path) -> Campaign:
    """Read and check campaign.yaml and instrument.yaml; every file they name must exist inside the folder.

    Raises InputError (one line: file, key, problem, mend) for anything the contract does not allow.
    """
    root = folder.resolve()
    if not root.is_dir():
        raise InputError(folder, "campaign", "is not a folder", "give the folder that holds campaign.yaml")
    where = root / "campaign.yaml"
    keys = _validated(CampaignKeys, where)
    for place, name in _named_files(keys):
        _confined(root, name, where, place)
    _unique([f.id for f in keys.flights], where, "flights[].id")
    _free([f.id for f in keys.flights], TAKEN_BY_RESULTS, where, "flights[].id")
    _free([entry.id for f in keys.flights for entry in f.lines], TAKEN_BY_FLIGHT, where, "flights[].lines[].id")
    _free([b.id for b in keys.bench], set(), where, "bench[].id")
    _unique([b.id for b in keys.bench], where, "bench[].id")
    for flight in keys.flights:
        _unique([entry.id for entry in flight.lines], where, f"flights[{flight.id}].lines[].id")
    if not (keys.flights or keys.bench or keys.thermal):
        raise InputError(
            where, "flights", "there is no flight, no bench file and no chamber run", "name at least one of them"
        )
    has_lines = any(flight.lines for flight in keys.flights)
    if has_lines and keys.calibration is None:
        raise InputError(where, "calibration", "is missing although there are lines", "name the calibration file")
    instrument_path = root / keys.instrument
    instrument, warnings = _instrument(
        _validated(InstrumentKeys, instrument_path), instrument_path, bool(keys.flights), has_lines
    )
    return Campaign(root, keys, instrument, warnings)


def _validated(model: type[Any], path: Path) -> Any:
    content = load_yaml(path, "a campaign needs it: see the campaign format")
    return validate(model, content, path)


def validate(model: type[Any], content: Any, where: Path | str, hint: str = "see the campaign format") -> Any:
    """`model` from plain data; the first thing wrong becomes an InputError that names the key."""
    if not isinstance(content, dict):
        raise InputError(where, "file", "holds no keys", hint)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = f"key '{'.'.join(map(str, first['loc']))}'" if first["loc"] else "file"
        if first["type"] == "extra_forbidden":
            raise InputError(where, place, "is not known", f"remove it or correct its spelling ({hint})") from None
        if first["type"] == "missing":
            raise InputError(where, place, "is missing", f"add it ({hint})") from None
        said = first["msg"].replace("a valid tuple", "a list").removeprefix("Value error, ")
        raise InputError(where, place, f"{said} (given: {str(first['input'])[:60]!r})", "correct the value") from None


def _named_files(keys: CampaignKeys) -> list[tuple[str, str]]:
    named = [("instrument", keys.instrument)]
    named += [(k, v) for k in ("calibration", "references", "dem") if (v := getattr(keys, k)) is not None]
    if keys.thermal:
        named += [("thermal.train", n) for n in keys.thermal.train] + [
            ("thermal.verify", n) for n in keys.thermal.verify
        ]
    for flight in keys.flights:
        named += [(f"flights[{flight.id}].{k}", getattr(flight, k)) for k in ("imu", "gnss")]
        for line in flight.lines:
            place = f"flights[{flight.id}].lines[{line.id}]"
            named += [(f"{place}.{k}", v) for k in ("frames", "targets", "gcps") if (v := getattr(line, k)) is not None]
    return named + [(f"bench[{b.id}].file", b.file) for b in keys.bench]


def _confined(root: Path, name: str, where: Path, place: str) -> None:
    if not name or "\0" in name:
        raise InputError(where, f"key '{place}'", "is no file name", "name a file by a path relative to the folder")
    path = (root / name).resolve()
    if Path(name).is_absolute() or not path.is_relative_to(root):
        raise InputError(
            where,
            f"key '{place}'",
            f"'{name}' leaves the campaign folder",
            "move the file into the folder and name it by a relative path",
        )
    if not path.exists():
        raise InputError(
            where, f"key '{place}'", f"the file '{name}' does not exist", "put it there or correct the name"
        )
    if path.is_dir() and not any((path / marker).exists() for marker in ZARR_MARKERS):
        raise InputError(where, f"key '{place}'", f"'{name}' is a folder", "name the file (or Zarr store) inside it")


def _free(ids: list[str], taken: set[str], where: Path, place: str) -> None:
    """Ids become folders of the results: none may be one of the results' own names, or walk out of them."""
    for name in ids:
        if name in taken | {".", ".."}:
            raise InputError(
                where,
                f"key '{place}'",
                f"'{name}' cannot be an id",
                "it would take the place of one of the results' own names: use another",
            )


def _unique(ids: list[str], where: Path, place: str) -> None:
    if repeated := sorted({i for i in ids if ids.count(i) > 1}):
        raise InputError(where, f"key '{place}'", f"'{repeated[0]}' occurs twice", "give each its own id")


def _instrument(
    keys: InstrumentKeys, path: Path, has_flights: bool, has_lines: bool
) -> tuple[Instrument, tuple[str, ...]]:
    def needed(place: str, part: Any, why: str) -> None:
        if part is None:
            raise InputError(
                path, f"key '{place}'", f"is missing although there {why}", "add it (see the campaign format)"
            )

    warnings: list[str] = []
    if has_flights:
        needed("imu", keys.imu, "are flights")
        needed("mounting", keys.mounting, "are flights")
        needed("mounting.imu_to_antenna_m", keys.mounting and keys.mounting.imu_to_antenna_m, "are flights")
    if has_lines:
        needed("mounting.imu_to_camera_m", keys.mounting and keys.mounting.imu_to_camera_m, "are lines")
        needed("mounting.boresight_deg", keys.mounting and keys.mounting.boresight_deg, "are lines")
        needed("camera", keys.camera, "are lines")
        needed("interferometer", keys.interferometer, "are lines")
    mounting = None
    if keys.mounting and keys.mounting.imu_to_antenna_m is not None:
        if not any(keys.mounting.imu_to_antenna_m):
            warnings.append(
                f"{path.name}: mounting.imu_to_antenna_m is exactly zero: used as it stands; is it surveyed?"
            )
        boresight = keys.mounting.boresight_deg or BoresightKeys(roll=0.0, pitch=0.0, yaw=0.0)
        mounting = Mounting(
            np.array(keys.mounting.imu_to_antenna_m),
            np.array(keys.mounting.imu_to_camera_m or (0.0, 0.0, 0.0)),
            _radians(boresight),
            _radians(keys.mounting.imu_to_body_deg),
        )
    camera = interferometer = None
    if keys.camera:
        c = keys.camera
        camera = Camera(
            c.rows,
            c.cols,
            c.pixel_pitch_m,
            c.focal_length_m,
            c.principal_point_px.row,
            c.principal_point_px.col,
            c.frame_rate_hz,
            c.saturation_dn,
            c.radial_k1,
            c.latency_s,
        )
        if keys.interferometer:
            interferometer = _interferometer(keys.interferometer, camera, path)
    imu = None if keys.imu is None else _imu_model(keys.imu)
    return Instrument(imu, mounting, camera, interferometer), tuple(warnings)


def _interferometer(keys: InterferometerKeys, camera: Camera, path: Path) -> Interferometer:
    low, high = keys.wavelength_range_nm
    if low >= high:
        raise InputError(
            path, "key 'interferometer.wavelength_range_nm'", f"[{low:g}, {high:g}] is not a range", "give [low, high]"
        )
    if not 1.0 <= keys.zpd_col <= camera.cols - 2:
        raise InputError(
            path,
            "key 'interferometer.zpd_col'",
            f"{keys.zpd_col:g} is not inside the {camera.cols} columns",
            "phase correction needs columns on both sides of zero path difference",
        )
    if 1e-9 * low < 2.0 * keys.opd_step_m * 0.98:
        raise InputError(
            path,
            "key 'interferometer.opd_step_m'",
            f"{keys.opd_step_m:g} m samples nothing shorter than {2e9 * keys.opd_step_m:.0f} nm without aliasing, "
            f"but the range begins at {low:g} nm",
            "correct the step (by a factor of two?) or the range",
        )
    return Interferometer(
        camera.rows,
        camera.cols,
        keys.opd_step_m,
        keys.zpd_col,
        1e-9 * low,
        1e-9 * high,
        keys.opd_quadratic_m,
        keys.fringe_tilt_m_per_row,
        keys.detector_nonlinearity,
    )


def _radians(angles: AngleKeys | BoresightKeys) -> np.ndarray:
    return np.deg2rad([angles.roll, angles.pitch, angles.yaw])


def _imu_model(keys: ImuKeys) -> ImuModel:
    g, a = keys.gyro, keys.accel
    return ImuModel(
        keys.rate_hz,
        SensorModel(
            float(np.deg2rad(g.angle_random_walk_deg_per_sqrt_h)) / 60.0,
            g.bias_sigma_deg_per_h * DEG_PER_H,
            g.bias_correlation_time_s,
            1e-6 * g.scale_factor_sigma_ppm,
        ),
        SensorModel(
            a.velocity_random_walk_ug_per_sqrt_hz * MICRO_G,
            a.bias_sigma_ug * MICRO_G,
            a.bias_correlation_time_s,
            1e-6 * a.scale_factor_sigma_ppm,
        ),
    )
