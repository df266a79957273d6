"""The flight and what its inertial unit and GNSS receiver record, in the air and in the chamber."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.simulation.records import Array, ChamberRun, InertialRun
from stages.simulation.settings import AirProfile, SimulationSettings, Straight, Triple
from tsmftis import geodesy, rotation
from tsmftis.simulator import effects as effect
from tsmftis.simulator import flight, gnss, inertial, thermal
from tsmftis.simulator.streams import stream

DEG = np.pi / 180.0
DEG_PER_H = DEG / 3600.0
MICRO_G = 1e-6 * geodesy.STANDARD_GRAVITY


@dataclass(frozen=True)
class Sensors:
    """The true unit: its thermal nodes, the laws of its biases, its constant errors, C_imu→body."""

    nodes: thermal.Nodes
    biases: thermal.Biases
    errors: inertial.UnitErrors
    to_body: Array


def fly(settings: SimulationSettings, seed: int) -> flight.Flight:
    """The true flight. Raises ValueError where a line is not within it."""
    plan, start = settings.flight, settings.flight.start
    path = flight.plan(
        [
            flight.Leg(duration=leg.straight_s, climb=leg.climb_m)
            if isinstance(leg, Straight)
            else flight.Leg(turn=leg.turn_deg * DEG, bank=leg.bank_deg * DEG, climb=leg.climb_m)
            for leg in plan.legs
        ],
        latitude=start.latitude_deg * DEG,
        longitude=start.longitude_deg * DEG,
        height=start.height_m,
        course=start.course_deg * DEG,
        speed=plan.speed_m_per_s,
        bank_ramp=plan.bank_ramp_s,
        pitch=plan.pitch_deg * DEG,
        drift_angle=plan.drift_angle_deg * DEG,
    )
    for line in settings.lines:
        if line.start_s < 0.5 or line.start_s + line.duration_s > path.duration - 0.5:
            raise ValueError(f"lines.{line.id}: not within the flight of {path.duration:.1f} s")
    gusts = flight.gusts(
        np.array(plan.gusts.sigma_north_east_down_m_per_s),
        plan.gusts.corner_hz,
        plan.gusts.cutoff_hz,
        plan.gusts.terms,
        stream(seed, "gusts"),
    )
    shaking = flight.wobble(
        np.array(plan.wobble.sigma_deg.triple()) * DEG,
        np.array(plan.wobble.cutoff_hz.triple()),
        plan.wobble.terms,
        stream(seed, "wobble"),
    )
    vibration = flight.vibration(
        np.array(plan.vibration.rate_sigma_deg_per_s.triple()) * DEG,
        plan.vibration.band_hz,
        plan.vibration.terms,
        stream(seed, "vibration"),
    )
    return flight.Flight(path, gusts.integral(), shaking + vibration)


def draw_sensors(settings: SimulationSettings, effects: effect.Effects, seed: int) -> Sensors:
    """One true unit out of those that the settings allow."""
    unit, section = settings.instrument.imu, settings.thermal
    tau, warm = section.time_constant_s, section.self_heating_k
    nodes = thermal.draw_nodes(
        np.array([tau.anode, tau.cathode, tau.shell]),
        np.array([warm.anode, warm.cathode, warm.shell]),
        tau.accel,
        warm.accel,
        section.time_constant_spread,
        stream(seed, "nodes"),
    )
    laws = [stream(seed, "law", sensor, axis) for sensor in ("gyro", "accel") for axis in "xyz"]
    biases = thermal.Biases(
        [thermal.draw_law(4, section.gyro_bias_deg_per_h * DEG_PER_H, rng) for rng in laws[:3]],
        [thermal.draw_law(2, section.accel_bias_ug * MICRO_G, rng) for rng in laws[3:]],
        effect.number(effects, "thermal_hysteresis", "half_width"),
        np.array(effect.values(effects, "thermal_hysteresis", "gyro")),
        np.array(effect.values(effects, "thermal_hysteresis", "accel")),
        effect.number(effects, "thermal_lag", "lag"),
    )
    rng = stream(seed, "scale factors")
    errors = inertial.UnitErrors(
        1e-6 * unit.gyro.scale_factor_sigma_ppm * rng.standard_normal(3) + effect.triple(effects, "gyro_scale_factor"),
        1e-6 * unit.accel.scale_factor_sigma_ppm * rng.standard_normal(3)
        + effect.triple(effects, "accel_scale_factor"),
        np.array(effect.triple(effects, "gyro_g_sensitivity")),
    )
    return Sensors(nodes, biases, errors, dcm(settings.instrument.mounting.imu_to_body_deg.triple()))


def dcm(angles_deg: Triple) -> Array:
    """Rotation of roll, pitch, yaw in degrees."""
    return rotation.rpy_to_dcm(*(a * DEG for a in angles_deg))


def _white_noise(settings: SimulationSettings, interval: float) -> tuple[float, float]:
    """Standard deviation of a mean over an interval [s], from the random walks: gyro [rad/s], accelerometer [m/s²]."""
    unit = settings.instrument.imu
    return (
        unit.gyro.angle_random_walk_deg_per_sqrt_h * DEG / 60.0 / np.sqrt(interval),
        unit.accel.velocity_random_walk_ug_per_sqrt_hz * MICRO_G / np.sqrt(interval),
    )


def record_flight(
    settings: SimulationSettings, aircraft: flight.Flight, sensors: Sensors, seed: int
) -> tuple[InertialRun, Array, tuple[Array, Array]]:
    """Samples; ideal body rates [rad/s] at the samples; times and true mean accelerometer temperature [°C]."""
    unit = settings.instrument.imu
    interval = 1.0 / unit.rate_hz
    time = np.arange(1, int(aircraft.path.duration * unit.rate_hz) + 1) / unit.rate_hz
    ideal_gyro, ideal_accel = inertial.interval_means(aircraft, time, interval)

    section = settings.thermal
    step = 1.0 / section.thermometer_rate_hz
    warm_time = np.arange(np.ceil(aircraft.path.duration / step) + 1.0, dtype=np.float64) * step
    air = thermal.piecewise(section.flight_air.start_degc, section.flight_air.straight_lines(), warm_time)
    temperatures = thermal.settle(air, step, sensors.nodes)
    gyro_bias, accel_bias = (
        np.stack([np.interp(time - 0.5 * interval, warm_time, b) for b in bias.T], -1)
        for bias in sensors.biases(temperatures)
    )
    rng = stream(seed, "imu")
    gyro_bias = gyro_bias + inertial.gauss_markov(
        unit.gyro.bias_sigma_deg_per_h * DEG_PER_H, unit.gyro.bias_correlation_time_s, interval, time.size, rng
    )
    accel_bias = accel_bias + inertial.gauss_markov(
        unit.accel.bias_sigma_ug * MICRO_G, unit.accel.bias_correlation_time_s, interval, time.size, rng
    )
    gyro, accel = inertial.measure(
        ideal_gyro @ sensors.to_body,
        ideal_accel @ sensors.to_body,
        sensors.errors,
        gyro_bias,
        accel_bias,
        *_white_noise(settings, interval),
        rng,
    )
    read = stream(seed, "thermometers")
    recorded = warm_time < time[-1]
    samples = InertialRun(
        time,
        gyro,
        accel,
        warm_time[recorded],
        *(
            thermal.thermometers(t, section.thermometer_noise_k, section.thermometer_resolution_k, read)[recorded]
            for t in (temperatures.gyro, temperatures.accel)
        ),
    )
    return samples, ideal_gyro, (warm_time, temperatures.accel.mean(axis=1))


def record_chamber(
    settings: SimulationSettings, profile: AirProfile, sensors: Sensors, rng: np.random.Generator
) -> ChamberRun:
    """A static run; the attitude declared in the file is that of the unit's own axes."""
    place, section = settings.chamber, settings.thermal
    step = 1.0 / place.rate_hz
    time = np.arange(round(profile.duration_s() * place.rate_hz), dtype=np.float64) * step
    air = thermal.piecewise(profile.start_degc, profile.straight_lines(), time)
    temperatures = thermal.settle(air, step, sensors.nodes)
    gyro_bias, accel_bias = sensors.biases(temperatures)
    rate, force = inertial.static(
        place.latitude_deg * DEG, place.height_m, dcm((place.roll_deg, place.pitch_deg, place.yaw_deg))
    )
    gyro, accel = inertial.measure(
        np.broadcast_to(rate, gyro_bias.shape),
        np.broadcast_to(force, accel_bias.shape),
        sensors.errors,
        gyro_bias,
        accel_bias,
        *_white_noise(settings, step),
        rng,
    )
    read = [
        thermal.thermometers(t, section.thermometer_noise_k, section.thermometer_resolution_k, rng)
        for t in (temperatures.gyro, temperatures.accel)
    ]
    return ChamberRun(InertialRun(time, gyro, accel, time, *read), air, gyro_bias, accel_bias)


def record_fixes(
    settings: SimulationSettings, effects: effect.Effects, aircraft: flight.Flight, seed: int
) -> gnss.Fixes:
    """GNSS fixes of the flight, from start_s to a second before its end."""
    section = settings.gnss
    last = aircraft.path.duration - 1.0
    time = section.start_s + np.arange(int((last - section.start_s) * section.rate_hz) + 1) / section.rate_hz
    rng = stream(seed, "gnss")
    position_error = np.array(section.sigma_position_north_east_down_m) * rng.standard_normal((time.size, 3))
    velocity_error = np.array(section.sigma_velocity_north_east_down_m_per_s) * rng.standard_normal((time.size, 3))
    position_error += inertial.gauss_markov(
        section.drift_sigma_position_m, section.drift_correlation_time_s, 1.0 / section.rate_hz, time.size, rng
    )
    lever_arm = np.array(settings.instrument.mounting.imu_to_antenna_m) + effect.triple(effects, "antenna_lever_arm")
    return gnss.observe(
        aircraft,
        time,
        lever_arm,
        effect.number(effects, "gnss_latency", "latency"),
        position_error,
        velocity_error,
    )


def hand_over(settings: SimulationSettings, aircraft: flight.Flight, seed: int) -> dict[str, float] | None:
    """The `initial` entry of the flight, as campaign.yaml has it."""
    section = settings.flight.initial
    if section is None:
        return None
    _, attitude = aircraft.navigation(np.array([section.time_s]))
    sigma = np.array([section.sigma_roll_deg, section.sigma_pitch_deg, section.sigma_yaw_deg])
    angles = attitude[0] / DEG + sigma * stream(seed, "initial").standard_normal(3)
    return {
        "time_s": section.time_s,
        **{f"{name}_deg": round(float(a), 4) for name, a in zip(("roll", "pitch", "yaw"), angles, strict=True)},
        **{f"sigma_{name}_deg": float(s) for name, s in zip(("roll", "pitch", "yaw"), sigma, strict=True)},
    }
