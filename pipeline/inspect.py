"""What a campaign holds, and what is wrong with it, before anything is computed.

`inspect_campaign` reads every file as the run would and collects rows for a table and problems; `check_campaign` raises the
first problem, so that a run over bad input ends before it has written anything.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.campaign import Campaign, FlightKeys
from pipeline.errors import InputError
from pipeline.raster import Dem
from pipeline.records import DATA_GAP, GNSS_QUALITIES, Chamber, Gnss, Imu
from tsmftis.geodesy import SEMI_MAJOR_AXIS

TURN_S = 2.0  # over which courses and turns are compared
TURN_SPEED = 10.0  # m/s: below it a vehicle may turn without its course, or its course without it
LEAST_TURN = 1.0  # rad of course change in all, for the comparison to mean anything
LOOKED_AT = 64  # frames of a line that are looked at
MOST_SATURATED = 1e-3  # share of pixels that may be saturated without a word
FARTHEST_TARGET_DEG = 1.0  # from the nearest fix: farther is a mistake in the coordinates


@dataclass
class Inspection:
    """Rows (part, item, value), warnings and problems; a problem stops a run, a warning does not."""

    rows: list[tuple[str, str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    problems: list[InputError] = field(default_factory=list)

    def add(self, part: str, **items: Any) -> None:
        self.rows += [(part, name.replace("_", " "), str(value)) for name, value in items.items()]

    def attempt(self, read: Callable[..., Any], *arguments: Any) -> Any:
        """The result of `read`, or None with the problem noted."""
        try:
            return read(*arguments)
        except InputError as problem:
            self.problems.append(problem)
            return None


def check_campaign(campaign: Campaign) -> Inspection:
    """Inspect and raise the first problem."""
    inspection = inspect_campaign(campaign)
    if inspection.problems:
        raise inspection.problems[0]
    return inspection


def inspect_campaign(campaign: Campaign) -> Inspection:
    """Read every file of the campaign and describe it."""
    found = Inspection(warnings=list(campaign.warnings))
    keys, instrument = campaign.keys, campaign.instrument
    found.add(
        "campaign",
        name=keys.name,
        epoch=f"{keys.time.epoch} ({keys.time.scale})",
        flights=len(keys.flights),
        bench=len(keys.bench),
    )
    _describe_shared(campaign, found)
    if keys.thermal is None and keys.flights:
        found.warnings.append("no chamber runs: the inertial data are not compensated for temperature")
    thermometers: set[int] = set()
    if keys.thermal is not None:
        for role in ("train", "verify"):
            for name in getattr(keys.thermal, role):
                chamber = found.attempt(campaign.chamber, name)
                if chamber is not None:
                    thermometers.add(chamber.temperatures.gyro.shape[2])
                    _describe_chamber(f"chamber {name} ({role})", chamber, found)
    for flight in keys.flights:
        imu = found.attempt(campaign.imu, flight.id)
        gnss = found.attempt(campaign.gnss, flight.id)
        if imu is not None:
            assert instrument.imu is not None
            _describe_imu(f"flight {flight.id}: IMU", imu, instrument.imu.rate, found)
            if (
                keys.thermal is not None
                and imu.temperatures is not None
                and thermometers - {imu.temperatures.gyro.shape[2]}
            ):
                found.problems.append(
                    InputError(
                        campaign.path(flight.imu),
                        "temperatures",
                        f"are of {imu.temperatures.gyro.shape[2]} thermometers a gyro, "
                        f"the chamber runs' of {sorted(thermometers)}",
                        "record the flight with the chamber's thermometers, or leave thermal out of campaign.yaml",
                    )
                )
        if gnss is not None:
            _describe_gnss(f"flight {flight.id}: GNSS", gnss, found)
        if imu is not None and gnss is not None:
            found.attempt(_fit_together, campaign, flight, imu, gnss)
        if imu is not None and keys.thermal is not None:
            found.attempt(_describe_compensation, campaign.path(flight.imu), flight.id, imu, found)
        for line in flight.lines:
            _describe_line(campaign, flight.id, line.id, imu, gnss, found)
    for bench in keys.bench:
        record = found.attempt(campaign.bench, bench.id)
        if record is not None:
            found.add(
                f"bench {bench.id}",
                scans=record.interferogram.shape[0],
                samples=record.opd.size,
                OPD=f"{record.opd[0] * 1e3:.4g} to {record.opd[-1] * 1e3:.4g} mm",
                apodization=record.apodization or "not told",
                phase=record.phase_correction or "not told",
                reference="yes" if record.reference is not None else "no",
            )
    return found


def _describe_shared(campaign: Campaign, found: Inspection) -> None:
    keys, camera, interferometer = campaign.keys, campaign.instrument.camera, campaign.instrument.interferometer
    if camera is not None:
        found.add(
            "camera",
            detector=f"{camera.rows} rows × {camera.cols} columns, {camera.pixel_pitch * 1e6:g} µm",
            focal_length=f"{camera.focal_length * 1e3:g} mm",
            frame_rate=f"{camera.frame_rate:g} Hz",
        )
    if interferometer is not None:
        found.add(
            "interferometer",
            OPD_step=f"{interferometer.opd_step * 1e9:g} nm",
            longest_OPD=f"{interferometer.longest_opd * 1e6:.2f} µm, short side {interferometer.shortest_side * 1e6:.2f} µm",
            range=f"{interferometer.wavelength_low * 1e9:g} to {interferometer.wavelength_high * 1e9:g} nm",
            resolution=f"{0.5 / interferometer.longest_opd / 100:.0f} cm-1",
        )
    if keys.calibration is not None and camera is not None:
        calibration = found.attempt(campaign.calibration)
        if calibration is not None:
            found.add(
                "calibration",
                dark=f"{calibration.dark.mean():.0f} DN",
                flat=f"{calibration.flat.min():.2f} to {calibration.flat.max():.2f}",
                response=f"{calibration.wavenumber[0] / 100:.0f} to {calibration.wavenumber[-1] / 100:.0f} cm-1",
            )
            found.attempt(_covers, campaign, keys.calibration, "response", calibration.wavenumber)
    if keys.references is not None:
        references = found.attempt(campaign.references)
        if references is not None:
            found.add("references", spectra=", ".join(references.names))
            found.attempt(_covers, campaign, keys.references, "radiance", references.wavenumber)
    elif any(f.lines for f in keys.flights):
        found.warnings.append("no references: spectra are made but not scored")
    if keys.dem is not None:
        dem = found.attempt(Dem.from_file, campaign.path(keys.dem))
        if dem is not None:
            found.add(
                "terrain",
                cells="{} × {}".format(*dem.heights.shape),
                heights=f"{dem.heights.min():.1f} to {dem.heights.max():.1f} m",
            )
            for flight, line in ((f.id, entry.id) for f in keys.flights for entry in f.lines):
                with contextlib.suppress(InputError):  # said of the line itself, below
                    targets = campaign.targets(flight, line)
                    if not dem.covers(targets.latitude, targets.longitude).all():
                        found.warnings.append(
                            f"line {flight}/{line}: the terrain model does not reach all targets: its edge holds on"
                        )


def _covers(campaign: Campaign, name: str, variable: str, wavenumber: np.ndarray) -> None:
    interferometer = campaign.instrument.interferometer
    if interferometer is None:
        return
    low, high = 1.0 / interferometer.wavelength_high, 1.0 / interferometer.wavelength_low
    if wavenumber[0] > low or wavenumber[-1] < high:
        raise InputError(
            campaign.path(name),
            f"variable '{variable}'",
            f"covers {wavenumber[0]:.6g} to {wavenumber[-1]:.6g} m-1 but the instrument's range is {low:.6g} to {high:.6g} m-1",
            "extend the table or correct interferometer.wavelength_range_nm",
        )


def _describe_chamber(part: str, chamber: Chamber, found: Inspection) -> None:
    t = chamber.temperatures
    found.add(
        part,
        duration=f"{np.ptp(chamber.time) / 3600:.2f} h at {1 / np.median(np.diff(chamber.time)):.3g} Hz",
        gyro_temperature=f"{t.gyro.min():.1f} to {t.gyro.max():.1f} °C",
        accelerometer_temperature=f"{t.accel.min():.1f} to {t.accel.max():.1f} °C",
        attitude="given" if chamber.attitude else "not given: the run's mean is the reference",
    )
    for axis, name in enumerate("xyz"):
        if np.ptp(t.gyro[:, axis], axis=0).min() == 0.0 or np.ptp(t.accel[:, axis]) == 0.0:
            found.warnings.append(f"{part}: a thermometer of axis {name} never changes")


def _describe_imu(part: str, imu: Imu, nominal: float, found: Inspection) -> None:
    step = np.diff(imu.time)
    rate = step.size / float(np.ptp(imu.time))
    gaps = int((step > DATA_GAP * np.median(step)).sum())
    found.add(
        part,
        duration=f"{np.ptp(imu.time):.1f} s at {rate:.5g} Hz ({imu.time.size} samples)",
        gaps=f"{gaps}, longest {step.max():.3g} s",
    )
    if imu.temperatures is not None:
        t = imu.temperatures
        found.add(
            part, temperatures=f"{t.gyro.min():.1f} to {t.gyro.max():.1f} °C, {t.gyro.shape[2]} thermometers a gyro"
        )
    if not 0.8 < rate / nominal < 1.25:
        found.warnings.append(f"{part}: runs at {rate:.4g} Hz where instrument.yaml says imu.rate_hz {nominal:g}")
    if gaps:
        found.warnings.append(f"{part}: {gaps} gaps; attitude is bridged with the flight's own scatter as uncertainty")


def _describe_compensation(file: Path, flight: str, imu: Imu, found: Inspection) -> None:
    """What stands in the way of a thermal correction; InputError where the thermometers are on another clock."""
    if imu.compensated_by is not None:
        found.warnings.append(
            f"flight {flight}: the IMU file is compensated already, by {imu.compensated_by}: it is not compensated again"
        )
    elif imu.temperatures is None:
        found.warnings.append(f"flight {flight}: the IMU file has no temperatures: its data are not compensated")
    elif gaps := imu.temperatures.uncovered(imu.time, file):
        seconds = sum(stop - start for start, stop in gaps)
        found.warnings.append(
            f"flight {flight}: the thermometers do not cover {seconds:.0f} of {np.ptp(imu.time):.0f} s of the inertial data"
        )


def _describe_gnss(part: str, gnss: Gnss, found: Inspection) -> None:
    step = np.diff(gnss.time)
    shares = ", ".join(
        f"{(gnss.quality == q).mean():.0%} {name}" for q, name in GNSS_QUALITIES.items() if (gnss.quality == q).any()
    )
    gaps = int((step > DATA_GAP * np.median(step)).sum())
    found.add(
        part,
        duration=f"{np.ptp(gnss.time):.1f} s at {1 / np.median(step):.3g} Hz ({gnss.time.size} fixes)",
        quality=shares,
        gaps=f"{gaps}, longest {step.max():.3g} s",
        velocity="given" if gnss.velocity is not None else "not given",
        sigma="{:.3g} m horizontal, {:.3g} m vertical (median)".format(*np.median(gnss.sigma_position[:, 1:], axis=0)),
    )


def _fit_together(campaign: Campaign, flight: FlightKeys, imu: Imu, gnss: Gnss) -> None:
    """IMU, fixes and `initial` share one clock, the rates are the nominal ones, and both sensors see the same turns."""
    name = flight.imu
    inside = (gnss.time >= imu.time[0]) & (gnss.time <= imu.time[-1])
    if inside.sum() < 5:
        raise InputError(
            campaign.path(name),
            "variable 'time'",
            f"spans {imu.time[0]:.1f} to {imu.time[-1]:.1f} s but the fixes {gnss.time[0]:.1f} to {gnss.time[-1]:.1f} s: "
            f"{int(inside.sum())} fixes overlap",
            "both must be seconds on the campaign's one clock",
        )
    assert campaign.instrument.imu is not None
    nominal, rate = campaign.instrument.imu.rate, 1.0 / float(np.median(np.diff(imu.time)))
    if not 0.2 < rate / nominal < 5.0:
        raise InputError(
            campaign.path(name),
            "variable 'time'",
            f"runs at {rate:.4g} Hz where instrument.yaml says imu.rate_hz {nominal:g}",
            "correct the time axis (is it in seconds?) or the nominal rate",
        )
    if flight.initial is not None and not imu.time[0] - 1.0 <= flight.initial.time_s < imu.time[-1]:
        raise InputError(
            campaign.root / "campaign.yaml",
            f"key 'flights[{flight.id}].initial.time_s'",
            f"{flight.initial.time_s:g} s lies outside the IMU's {imu.time[0]:.2f} to {imu.time[-1]:.2f} s",
            "give a time inside the flight, or leave `initial` out",
        )
    _same_turns(campaign, name, imu, gnss)


def _same_turns(campaign: Campaign, name: str, imu: Imu, gnss: Gnss) -> None:
    """In a vehicle's turns the rate about body z is about the rate of the GNSS course; deg/s or swapped axes are not."""
    assert campaign.instrument.mounting is not None
    time = np.arange(max(imu.time[0], gnss.time[0]), min(imu.time[-1], gnss.time[-1]), TURN_S)
    if time.size < 10:
        return
    north = np.interp(time, gnss.time, gnss.latitude)
    east = np.interp(time, gnss.time, np.unwrap(gnss.longitude)) * np.cos(north[0])
    dn, de = np.diff(north) * SEMI_MAJOR_AXIS, np.diff(east) * SEMI_MAJOR_AXIS
    fast = np.hypot(dn, de) / TURN_S > TURN_SPEED
    course = np.diff(np.unwrap(np.arctan2(de, dn))) / TURN_S
    down = campaign.instrument.mounting.dcm_imu_to_body[2] @ imu.gyro.T
    turned = np.concatenate([[0.0], np.cumsum(down[1:] * np.diff(imu.time))])
    # The course of an interval holds at its middle, so its change runs from middle to middle.
    middle = 0.5 * (time[1:] + time[:-1])
    rate = np.diff(np.interp(middle, imu.time, turned)) / TURN_S
    good = fast[1:] & fast[:-1]
    if good.sum() < 10 or np.abs(course[good]).sum() * TURN_S < LEAST_TURN:
        return
    slope = float((course[good] * rate[good]).sum() / max((rate[good] ** 2).sum(), 1e-30))
    if not 0.2 < slope < 5.0:
        raise InputError(
            campaign.path(name),
            "variable 'gyro'",
            f"the GNSS course turns at {slope:.3g} times the rate about body z (down), where about 1 is expected",
            "the rates are in deg s-1, or axes are swapped or turned: correct them or mounting.imu_to_body_deg",
        )


def _describe_line(
    campaign: Campaign, flight: str, line: str, imu: Imu | None, gnss: Gnss | None, found: Inspection
) -> None:
    part = f"line {flight}/{line}"
    keys = campaign.line(flight, line)
    frames = found.attempt(campaign.frames, flight, line)
    if frames is not None:
        some = frames.sample(LOOKED_AT)
        full = campaign.instrument.camera.saturation if campaign.instrument.camera else np.inf
        saturated = float((some >= full).mean())
        found.add(
            part,
            frames=f"{frames.time.size} in {np.ptp(frames.time):.2f} s",
            missing=f"{frames.missing} in {len(frames.segments()) - 1} gaps",
            counts=f"{some.min()} to {some.max()} DN, {saturated:.2%} of the pixels saturated",
        )
        if frames.missing:
            found.warnings.append(
                f"{part}: {frames.missing} frames are missing in {len(frames.segments()) - 1} places: targets that were crossing "
                "the detector there lack columns, which are interpolated, or are only partly seen"
            )
        if saturated > MOST_SATURATED:
            found.warnings.append(
                f"{part}: {saturated:.2%} of the pixels are saturated and left out: bright targets may be only partly seen"
            )
        if imu is not None:
            latency = campaign.instrument.camera.latency if campaign.instrument.camera else 0.0
            time = frames.time - latency
            outside = int(((time < imu.time[0]) | (time > imu.time[-1])).sum())
            if outside == time.size:
                found.problems.append(
                    InputError(
                        campaign.path(keys.frames),
                        "variable 'time'",
                        f"spans {time[0]:.2f} to {time[-1]:.2f} s but the IMU {imu.time[0]:.2f} to {imu.time[-1]:.2f} s: "
                        "they do not overlap",
                        "frames and IMU must share the campaign's one clock",
                    )
                )
            elif outside:
                found.warnings.append(f"{part}: {outside} frames lie outside the IMU's time and are not used")
    targets = found.attempt(campaign.targets, flight, line)
    if targets is not None:
        found.add(part, targets=f"{len(targets.ids)} ({sum(map(bool, targets.reference))} with reference)")
        camera = campaign.instrument.camera
        if gnss is not None and frames is not None and camera is not None:
            height = float(np.interp(frames.time, gnss.time, gnss.height).mean() - targets.height.mean())
            sample = camera.ground_sample(height)
            found.add(
                part,
                ground_sample=f"{sample:.3g} m from {height:.0f} m above the targets, swath {sample * camera.rows:.3g} m",
            )
            if not 1.0 < targets.size.mean() / sample < 1e4:
                found.warnings.append(
                    f"{part}: targets of {targets.size.mean():.3g} m are seen with samples of {sample:.3g} m"
                )
        if gnss is not None:
            away = np.rad2deg(
                np.hypot(
                    targets.latitude[:, None] - gnss.latitude[::10],
                    (targets.longitude[:, None] - gnss.longitude[::10]) * np.cos(gnss.latitude[0]),
                )
            ).min(axis=1)
            if (away > FARTHEST_TARGET_DEG).any():
                i = int(np.argmax(away))
                found.problems.append(
                    InputError(
                        campaign.path(keys.targets),
                        f"target {targets.ids[i]}",
                        f"lies {away[i] * 111:.0f} km from the flight",
                        "latitude and longitude may be swapped: correct the coordinates",
                    )
                )
    gcps = found.attempt(campaign.gcps, flight, line)
    if gcps is not None:
        found.add(part, ground_control=f"{gcps.frame.size} points")
        if (camera := campaign.instrument.camera) is not None:
            for column, values, size in (("row", gcps.row, camera.rows), ("col", gcps.col, camera.cols)):
                beyond = np.flatnonzero((values < -1.0) | (values > size))
                if beyond.size:
                    found.problems.append(
                        InputError(
                            campaign.path(keys.gcps or ""),
                            f"point {beyond[0] + 1}, column {column}",
                            f"is {values[beyond[0]]:g}, outside the image of {camera.rows} × {camera.cols} pixels",
                            "count pixels from 0, or leave the point out",
                        )
                    )
        if frames is not None and gcps.frame.max(initial=0) >= frames.time.size:
            found.problems.append(
                InputError(
                    campaign.path(keys.gcps or ""),
                    "column frame",
                    f"goes up to {gcps.frame.max()} but the line has {frames.time.size} frames",
                    "count frames from 0",
                )
            )
