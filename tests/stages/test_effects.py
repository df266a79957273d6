"""Effects as the pipeline takes them into its models, against the simulator's own, written apart from it.

A campaign is simulated with an effect that it does not declare, and processed with the effect's true value in the model update
and without. With it, points lie where the simulator put them and spectra are as good as those of the campaign without the effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.campaign import Campaign, read_campaign
from pipeline.datasets import write_dataset
from pipeline.errors import InputError
from pipeline.raster import Dem, to_crs
from pipeline.records import Chamber, Frames, StaticAttitude, Targets, Temperatures, Tracks, Trajectory
from stages import mapping, reconstruction, scoring, simulation, thermal, tracking
from stages.simulation.records import ChamberRun
from stages.simulation.sensors import draw_sensors, fly, record_chamber
from stages.thermal import ThermalModel, verify_run
from stages.thermal.baselines import fit_polynomial
from stages.thermal.binning import block_means
from stages.thermal.memory import Memory, lagged, play
from stages.thermal.model import ChannelModel
from stages.thermal.training import training_set
from tsmftis.fourier import smooth_phase
from tsmftis.geodesy import radii_of_curvature
from tsmftis.inertial import DEG_PER_H, MICRO_G
from tsmftis.simulator import thermal as simulated_thermal
from tsmftis.simulator.effects import complete
from tsmftis.simulator.streams import stream

Effects = Mapping[str, Mapping[str, Any]]
SEED = 3
GEOMETRY: dict[str, dict[str, float]] = {
    "camera_latency": {"latency": 0.012},
    "boresight": {"roll": 1.0e-3, "pitch": -1.5e-3, "yaw": 4.0e-3},
    "boresight_thermal_drift": {"roll": 2.0e-4, "pitch": -1.5e-4, "yaw": 3.0e-4},
    "mount_flexure": {"roll": 6.0e-4, "pitch": -4.0e-4},
    "focal_length": {"scale": 0.04},
    "radial_distortion": {"k1": 90.0},
}
SPECTRAL: dict[str, dict[str, float]] = {
    "opd_scale": {"scale": 0.02},
    "opd_quadratic": {"quadratic": 1.0e-10},
    "fringe_tilt": {"tilt": 1.0e-8},
    "detector_nonlinearity": {"a": 0.1},
    "channel_fringe": {"amplitude": 0.1, "thickness": 6.0e-6, "phase": 0.5},
    "response_scale": {"scale": 0.1},
}


@dataclass(frozen=True)
class World:
    """A simulated campaign as the pipeline reads it, with the unit's true path and the points picked in its frames."""

    simulated: simulation.SimulatedCampaign
    campaign: Campaign
    path: Trajectory

    @property
    def frames(self) -> Frames:
        return self.campaign.frames("F1", "L01")

    def tracked(self, targets: Targets, effects: Effects) -> tracking.TrackingResult:
        instrument = self.campaign.instrument
        assert instrument.camera is not None and instrument.mounting is not None
        return tracking.run(
            self.path,
            self.frames.time,
            targets,
            instrument.camera,
            instrument.mounting,
            tracking.TrackingSettings(),
            temperatures=self.campaign.imu("F1").temperatures,
            effects=effects,
        )

    def misplaced(self, effects: Effects) -> float:
        """RMS distance [px] of the points that the simulator picked from where tracking has them."""
        gcps = self.simulated.lines[0].gcps
        latitude, longitude, height = np.stack([g.geodetic for g in gcps], 1)
        names = tuple(f"g{i}" for i in range(len(gcps)))
        result = self.tracked(
            Targets(names, latitude, longitude, height, ("",) * len(gcps), np.ones(len(gcps))), effects
        )
        tracks = result.tracks.only("tracking")
        at = np.array([g.frame for g in gcps]), np.array([[g.row, g.col] for g in gcps])
        place = np.stack([a[0, np.arange(len(gcps)), Tracks.CENTRE, at[0]] for a in (tracks.row, tracks.col)], -1)
        return float(np.sqrt(np.mean(np.sum((place - at[1]) ** 2, axis=1))))

    def reconstructed(
        self, geometry: Effects, spectral: Effects
    ) -> tuple[tracking.TrackingResult, reconstruction.ReconstructionResult]:
        campaign, instrument = self.campaign, self.campaign.instrument
        assert instrument.camera is not None and instrument.interferometer is not None
        targets = campaign.targets("F1", "L01")
        placed = self.tracked(targets, geometry)
        made = reconstruction.run(
            self.frames,
            placed.tracks.only("tracking"),
            targets,
            campaign.calibration(),
            campaign.references(),
            instrument.camera,
            instrument.interferometer,
            reconstruction.ReconstructionSettings(),
            spectral,
        )
        return placed, made

    def rqe_area(self, geometry: Effects, spectral: Effects) -> float:
        _, made = self.reconstructed(geometry, spectral)
        return float(scoring.run(made.spectra).scores["rqe_area"]["tracking"]["mean"])


Make = Callable[..., World]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """`world(camera_latency=…)`: 30 s of flight over one line of 3 s, 64 × 128 pixels; `world()` is the one without effects.

    The path is the true one, so that what is left is the effect's alone.
    """
    folder = tmp_path_factory.mktemp("effects")

    def make(**effects: Any) -> World:
        preset = simulation.SimulationSettings.preset("demo").model_dump()
        preset["flight"]["legs"] = [{"straight_s": 30.0}]
        preset["lines"] = [{"id": "L01", "start_s": 15.0, "duration_s": 3.0, "panels": ["white", "red"]}]
        preset["scene"] |= {"panel_scatter_m": 0.5, "cell_m": 0.5, "samples_per_pixel_side": 2}
        preset["terrain"]["margin_m"] = 60.0
        preset["gcps"] = {"per_line": 40, "sigma_px": 1e-6}
        for name in ("train", "verify"):
            preset["chamber"][name]["stages"] = [{"hold_min": 2.0}, {"to_degc": 40.0, "rate_k_per_min": 4.0}]
        preset["effects"] = effects
        settings = simulation.SimulationSettings.model_validate(preset)
        simulated = simulation.run(settings, SEED)
        place = folder / ("_".join(effects) or "clean")
        simulation.write(simulated, place)
        return World(simulated, read_campaign(place), true_path(simulated))

    return cache(lambda **effects: make(**{k: dict(v) for k, v in effects.items()}))  # type: ignore[return-value]


def true_path(simulated: simulation.SimulatedCampaign) -> Trajectory:
    """The true pose at the inertial stamps; the gyros' own samples."""
    time = simulated.imu.time
    place, attitude = fly(simulated.settings, simulated.seed).navigation(time)
    before, _ = fly(simulated.settings, simulated.seed).navigation(time - 1e-3)
    after, _ = fly(simulated.settings, simulated.seed).navigation(time + 1e-3)
    meridian, vertical = radii_of_curvature(place[:, 0])
    rate = (after - before) / 2e-3
    velocity = np.stack(
        [
            rate[:, 0] * (meridian + place[:, 2]),
            rate[:, 1] * (vertical + place[:, 2]) * np.cos(place[:, 0]),
            -rate[:, 2],
        ],
        -1,
    )
    blank = np.zeros((time.size, 3))
    return Trajectory(time, *place.T, velocity, attitude, blank, blank, blank, simulated.imu.gyro, simulated.imu.accel)


class Frozen(dict[str, float]):
    """Parameters that a cache can hold."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))


def of(name: str, values: Mapping[str, float]) -> dict[str, Frozen]:
    return {name: Frozen(values)}


@pytest.fixture(scope="module")
def honest(world: Make) -> float:
    """RQE of area means without an effect."""
    return world().rqe_area({}, {})


@pytest.mark.parametrize("name", GEOMETRY)
def test_geometry(name: str, world: Make, honest: float) -> None:
    """Points within 0.02 px (rounded thermometers, rates of a noisy gyro), and half a pixel off without the update."""
    there, update = world(**of(name, GEOMETRY[name])), {name: GEOMETRY[name]}
    assert there.misplaced(update) < 0.02
    assert there.misplaced({}) > 0.4
    # Flexure shakes the camera by pixels from frame to frame: between two frames a point is read across the panel's edge, and
    # that is so on the true track as on the smooth one.
    if name != "mount_flexure":
        # The same panels through other pixels: 0.2 % of noise.
        assert there.rqe_area(update, {}) < honest + 2e-3
    # Distortion is nothing in the middle rows, where the panels pass.
    if name not in ("mount_flexure", "radial_distortion"):
        assert there.rqe_area({}, {}) > 2.0 * honest


@pytest.mark.parametrize("name", SPECTRAL)
def test_spectral(name: str, world: Make, honest: float) -> None:
    there = world(**of(name, SPECTRAL[name]))
    assert there.rqe_area({}, {name: SPECTRAL[name]}) < honest + 2e-3
    assert there.rqe_area({}, {}) > 4.0 * honest


def test_dem_bias(world: Make) -> None:
    """The ground lies 80 m above the terrain model: the camera, pitched by 1.2°, sees it 1.7 m behind where the model has it.

    The white panel in the cube stands where it was surveyed with the update; targets and picked points never move.
    """
    there = world(**of("dem_bias", {"height": 80.0}))
    update = {"dem_bias": {"height": 80.0}}
    assert there.misplaced(update) == there.misplaced({}) < 1e-4
    assert panel_distance(there, update) < 0.4
    assert panel_distance(there, {}) > 1.2


def panel_distance(world: World, effects: Effects) -> float:
    """Distance [m] of the white panel's middle in the cube from its survey."""
    campaign, instrument = world.campaign, world.campaign.instrument
    assert instrument.camera is not None and instrument.interferometer is not None
    targets = campaign.targets("F1", "L01")
    placed, made = world.reconstructed({}, {})
    heights, ground = mapping.surface(targets, Dem.from_file(campaign.path("dem.tif")), effects)
    grid = mapping.line_grid(placed.poses, instrument.camera, ground, mapping.MappingSettings(), effects)
    band = np.array([1.5e6, 1.6e6, 1.7e6])
    sigma = made.spectra.wavenumber
    strips = mapping.run(
        world.frames,
        placed.poses,
        heights,
        grid,
        band,
        smooth_phase(made.phase, band, (sigma[0], sigma[-1])),
        campaign.calibration(),
        instrument.camera,
        instrument.interferometer,
        1,
        effects,
    )
    image = np.nan_to_num(np.concatenate([part.mean(axis=2) for _, part in strips]))
    x, y = grid.centres(0, grid.shape[0])
    east, north = to_crs(grid.crs, targets.latitude[:1], targets.longitude[:1])
    away = np.hypot(x - east, y - north)
    bright = (image > 0.6 * image[away < 2.0].max()) & (away < 8.0)
    return float(np.hypot(x[bright].mean() - east[0], y[bright].mean() - north[0]))


def test_a_drifting_boresight_needs_temperatures(world: Make) -> None:
    there = world()
    instrument = there.campaign.instrument
    assert instrument.camera is not None and instrument.mounting is not None
    arguments = (
        there.path,
        there.frames.time,
        there.campaign.targets("F1", "L01"),
        instrument.camera,
        instrument.mounting,
    )
    settings = tracking.TrackingSettings()
    drift = {"boresight_thermal_drift": {"roll": 1e-4}}
    with pytest.raises(InputError, match="temperature_accel: is missing"):
        tracking.run(*arguments, settings, effects=drift)
    with pytest.raises(ValueError, match="opd_scale"):
        tracking.run(*arguments, settings, effects={"opd_scale": {"scale": 0.1}})


# --- thermal ------------------------------------------------------------------------------------------------------------

THERMAL: dict[str, dict[str, Any]] = {
    "thermal_hysteresis": {
        "half_width": 5.0,
        "gyro": [0.03 * DEG_PER_H, -0.04 * DEG_PER_H, 0.02 * DEG_PER_H],
        "accel": [200.0 * MICRO_G, -150.0 * MICRO_G, 100.0 * MICRO_G],
    },
    "thermal_lag": {"lag": 900.0},
}


def chambers(**effects: Any) -> tuple[Chamber, Chamber, ChamberRun]:
    """The demo's training run, and its verification run with its truth."""
    preset = simulation.SimulationSettings.preset("demo").model_dump() | {"effects": effects}
    settings = simulation.SimulationSettings.model_validate(preset)
    sensors, place = draw_sensors(settings, complete(settings.effects), SEED), settings.chamber
    angles = np.deg2rad([place.roll_deg, place.pitch_deg, place.yaw_deg])
    attitude = StaticAttitude(float(np.deg2rad(place.latitude_deg)), place.height_m, *map(float, angles))

    def record(name: str) -> tuple[Chamber, ChamberRun]:
        run = record_chamber(settings, getattr(place, name), sensors, stream(SEED, "chamber", name))
        i = run.inertial
        read = Temperatures(i.time, i.temperature_gyro, i.temperature_accel)
        return Chamber(name, i.time, i.gyro, i.accel, read, attitude, None), run

    (train, _), (verify, truth) = record("train"), record("verify")
    return train, verify, truth


def test_thermal_hysteresis() -> None:
    """What the fit takes off its targets, and every correction adds, is what the simulator's biases gained: to 3 % of it.

    (Thermometers are noisy and read to 0.01 K; the simulator plays with their true temperatures.)
    """
    effects = {"thermal_hysteresis": THERMAL["thermal_hysteresis"]}
    settings, memory = thermal.ThermalSettings(), Memory.of(effects)
    (clean, _, without), (train, verify, truth) = chambers(), chambers(**effects)
    taught, plain, honest = (
        training_set([c], settings, m).bias for c, m in ((train, memory), (train, None), (clean, None))
    )
    assert (rms(taught - honest) < 0.03 * rms(plain - honest)).all()
    model = replace(untrained(train), memory=memory)
    correction = model.correction(verify.temperatures, "polynomial")
    gained = np.hstack([truth.gyro_bias - without.gyro_bias, truth.accel_bias - without.accel_bias])
    added = np.stack(
        [np.interp(verify.time, correction.time, c) for c in np.hstack([correction.gyro, correction.accel]).T], -1
    )
    assert (rms(added - gained) < 0.03 * rms(gained)).all()
    found = verify_run(model, verify, 100.0)
    held = verify_run(replace(model, memory=Memory()), verify, 100.0)
    gone = held["left"]["polynomial"] - found["left"]["polynomial"]
    assert (rms(gone - block_means(verify.time, gained, 100.0)) < 0.03 * rms(gained)).all()


def test_thermal_lag() -> None:
    """T and Ṫ of the gyros are the simulator's lagged ones, in the chamber as in a correction; all else is as it was."""
    effects = {"thermal_lag": THERMAL["thermal_lag"]}
    train, _, _ = chambers()
    settings, memory = thermal.ThermalSettings(), Memory.of(effects)
    felt = simulated_thermal.lag(train.temperatures.gyro.mean(axis=2), memory.lag, 1.0)
    model, plain = replace(untrained(train), memory=memory), untrained(train)
    lagging, prompt = (m.features(train.temperatures, train.time) for m in (model, plain))
    for axis in range(3):
        assert np.abs(lagging[axis][:, 0] - felt[:, axis]).max() < 0.05 < np.ptp(prompt[axis][:, 0] - felt[:, axis])
        rate = np.gradient(felt[:, axis], 1.0)
        assert rms(lagging[axis][:, 1] - rate) < 0.02 * rms(prompt[axis][:, 1] - rate)
        np.testing.assert_array_equal(lagging[axis][:, 2:], prompt[axis][:, 2:])
        np.testing.assert_array_equal(lagging[axis + 3], prompt[axis + 3])
    in_fit = training_set([train], settings, memory).features[0]
    np.testing.assert_allclose(in_fit, block_means(train.time, lagging[0], settings.block_s), rtol=1e-9, atol=1e-9)


def rms(values: np.ndarray) -> Any:
    return np.sqrt(np.mean(values**2, axis=0))


def untrained(train: Chamber) -> ThermalModel:
    """A model that takes nothing off but what it remembers: polynomials without a coefficient."""
    settings = thermal.ThermalSettings()
    channels = []
    for x in training_set([train], settings).features:
        nothing = fit_polynomial(x, np.zeros(len(x)), (1,))
        spread = np.zeros(x.shape[1]), np.ones(x.shape[1]), x.min(axis=0), x.max(axis=0)
        channels.append(ChannelModel(np.ones(x.shape[1], bool), *spread, 1.0, {"polynomial": nothing}))
    return ThermalModel(tuple(channels), settings.smoothing_s, False, settings.block_s, 2.0, 3)


def test_the_memory_survives_the_file(tmp_path: Path) -> None:
    train, verify, _ = chambers()
    model = replace(untrained(train), memory=Memory.of(THERMAL))
    write_dataset(model.to_dataset(), tmp_path / "model.nc")
    again = ThermalModel.from_file(tmp_path / "model.nc")
    assert again.memory == model.memory == Memory.of(THERMAL) and again.memory.lag == 900.0
    a, b = (m.correction(verify.temperatures, "polynomial") for m in (model, again))
    np.testing.assert_array_equal(a.gyro, b.gyro)
    spoilt = model.to_dataset().assign_attrs(hysteresis_half_width_k=0.0)
    write_dataset(spoilt, tmp_path / "spoilt.nc")
    with pytest.raises(InputError, match="hysteresis_half_width_k"):
        ThermalModel.from_file(tmp_path / "spoilt.nc")


def test_play_and_lag_are_the_simulators() -> None:
    """Two programs of one definition, on the same readings: rounding; play and lag by hand on a ramp up and down."""
    time = np.arange(0.0, 4000.0, 2.0)
    walk = 20.0 + np.cumsum(np.random.default_rng(7).normal(0.0, 0.3, (time.size, 3)), axis=0)
    np.testing.assert_allclose(play(walk, 2.5), simulated_thermal.play(walk, 2.5), atol=1e-12)
    np.testing.assert_allclose(lagged(time, walk, 300.0), simulated_thermal.lag(walk, 300.0, 2.0), atol=1e-9)
    tent = np.minimum(time, 4000.0 - time)[:, None] / 100.0
    np.testing.assert_allclose(play(tent, 3.0)[-1], 3.0 + tent[-1])
    np.testing.assert_allclose(play(tent, 3.0)[900], tent[900] - 3.0)
    ramp = time[:, None] / 100.0
    expected = (time - 300.0 * (1.0 - np.exp(-time / 300.0)))[:, None] / 100.0
    np.testing.assert_allclose(lagged(time, ramp, 300.0), expected, atol=1e-9)


@pytest.mark.parametrize(
    "effects",
    [
        {"thermal_hysteresis": {"gyro": [1e-7, 0.0, 0.0]}},
        {"thermal_lag": {"lag": -1.0}},
        {"opd_scale": {"scale": 0.1}},
    ],
)
def test_a_memory_that_makes_no_sense_is_refused(effects: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"thermal|opd_scale"):
        Memory.of(effects)
