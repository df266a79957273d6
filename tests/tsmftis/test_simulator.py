"""The simulator's physics against closed forms, definitions and integration; never against the pipeline's own code."""

from __future__ import annotations

from itertools import pairwise

import numba
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from tsmftis import geodesy, rotation
from tsmftis.simulator import (
    effects,
    flight,
    gnss,
    harmonics,
    imaging,
    inertial,
    interferometer,
    lens,
    materials,
    thermal,
    world,
)
from tsmftis.simulator.streams import stream

LATITUDE, LONGITUDE = 0.65, 2.13


@pytest.fixture(scope="module")
def aircraft() -> flight.Flight:
    """30 s: straight, a turn, straight, in turbulence."""
    path = flight.plan(
        [flight.Leg(duration=8.0, climb=5.0), flight.Leg(turn=0.6, bank=0.4), flight.Leg(duration=8.0)],
        latitude=LATITUDE,
        longitude=LONGITUDE,
        height=1000.0,
        course=0.3,
        speed=60.0,
        bank_ramp=3.0,
        pitch=0.02,
        drift_angle=0.03,
    )
    rng = np.random.default_rng(5)
    shaking = flight.wobble(np.array([2e-3, 2e-3, 1e-3]), np.array([2.0, 1.5, 0.8]), 20, rng)
    shaking += flight.vibration(np.array([0.01, 0.01, 0.001]), (15.0, 50.0), 12, rng)
    return flight.Flight(path, flight.gusts(np.full(3, 0.3), 0.05, 0.8, 20, rng).integral(), shaking)


def to_inertial(time: float) -> np.ndarray:
    return Rotation.from_euler("z", geodesy.EARTH_RATE * time).as_matrix()


# --- inertial --------------------------------------------------------------------------------------------------------


def test_a_body_at_rest_feels_gravity_and_the_earth_turning() -> None:
    dcm = rotation.rpy_to_dcm(0.02, -0.03, 0.6)
    gyro, accel = inertial.static(0.7, 30.0, dcm)
    gravity = float(geodesy.normal_gravity(0.7, 30.0))
    np.testing.assert_allclose(dcm @ accel, [0.0, 0.0, -gravity], atol=1e-9)
    earth = geodesy.EARTH_RATE * np.array([np.cos(0.7), 0.0, -np.sin(0.7)])
    np.testing.assert_allclose(dcm @ gyro, earth, atol=1e-18)


def test_rates_integrated_in_the_inertial_frame_give_the_attitude(aircraft: flight.Flight) -> None:
    step = 1e-3
    end = 9.0 + step * np.arange(1, 4001)
    gyro, _ = inertial.interval_means(aircraft, end, step)
    start, stop = aircraft.attitude(np.array([9.0, end[-1]]))
    attitude = Rotation.from_matrix(to_inertial(9.0) @ start)
    for turn in Rotation.from_rotvec(gyro * step):
        attitude = attitude * turn
    wrong = attitude.inv() * Rotation.from_matrix(to_inertial(end[-1]) @ stop)
    assert wrong.magnitude() < 1e-9 * 4000**0.5


def test_force_and_gravitation_integrated_give_the_inertial_velocity(aircraft: flight.Flight) -> None:
    node, weight = np.polynomial.legendre.leggauss(40)
    start, stop = 9.0, 11.0
    time = start + (stop - start) * 0.5 * (node + 1.0)
    _, force = inertial.sensed(aircraft, time)
    gain = np.zeros(3)
    for t, f, c, r, w in zip(time, force, aircraft.attitude(time), aircraft.position(time), weight, strict=True):
        gain += 0.5 * (stop - start) * w * to_inertial(t) @ (c @ f + inertial.gravitation(r))

    def velocity(t: float, h: float = 1e-3) -> np.ndarray:
        points = [to_inertial(t + k * h) @ aircraft.position(np.array([t + k * h]))[0] for k in (-2, -1, 1, 2)]
        return (points[0] - 8.0 * points[1] + 8.0 * points[2] - points[3]) / (12.0 * h)

    np.testing.assert_allclose(gain, velocity(stop) - velocity(start), atol=5e-6)


def test_interval_means_are_means(aircraft: flight.Flight) -> None:
    end = np.array([9.005, 15.3])
    gyro, accel = inertial.interval_means(aircraft, end, 0.005)
    for i, t in enumerate(end):
        fine = t - 0.005 + 0.005 * (np.arange(500) + 0.5) / 500
        rate, force = inertial.sensed(aircraft, fine)
        np.testing.assert_allclose(gyro[i], rate.mean(axis=0), atol=1e-8)
        np.testing.assert_allclose(accel[i], force.mean(axis=0), atol=1e-6)


def test_gravitation_is_newtons_far_from_detail() -> None:
    """Normal gravitation differs from GM/r² by the flattening alone, J2 ≈ 1e-3."""
    position = geodesy.geodetic_to_ecef(0.6, 1.0, 2000.0)
    pull = inertial.gravitation(position)
    newton = -geodesy.GM * position / np.linalg.norm(position) ** 3
    assert np.linalg.norm(pull - newton) < 3e-3 * np.linalg.norm(newton)


def test_unit_errors_act_as_defined() -> None:
    gyro, accel = np.full((4, 3), 0.1), np.full((4, 3), -9.0)
    errors = inertial.UnitErrors(np.array([1e-3, 0.0, 0.0]), np.array([0.0, 2e-3, 0.0]), np.array([0.0, 0.0, 1e-5]))
    bias = np.full((4, 3), 1e-4)
    g, a = inertial.measure(gyro, accel, errors, bias, bias, 0.0, 0.0, np.random.default_rng(0))
    np.testing.assert_allclose(g[0], [0.1 * 1.001 + 1e-4, 0.1 + 1e-4, 0.1 - 9e-5 + 1e-4])
    np.testing.assert_allclose(a[0], [-9.0 + 1e-4, -9.0 * 1.002 + 1e-4, -9.0 + 1e-4])


def test_gauss_markov_is_stationary_and_correlated() -> None:
    x = inertial.gauss_markov(2.0, 10.0, 1.0, 200_000, np.random.default_rng(1))
    np.testing.assert_allclose(x.std(axis=0), 2.0, rtol=0.03)
    lagged = (x[10:] * x[:-10]).mean(axis=0) / x.var(axis=0)
    np.testing.assert_allclose(lagged, np.exp(-1.0), atol=0.03)


# --- flight ----------------------------------------------------------------------------------------------------------


def test_derivatives_of_the_flight_are_exact(aircraft: flight.Flight) -> None:
    t, h = np.array([3.3, 12.1, 20.7]), 1e-3
    speed = (aircraft.position(t + h) - aircraft.position(t - h)) / (2.0 * h)
    np.testing.assert_allclose(aircraft.velocity(t), speed, atol=1e-5)
    change = (aircraft.velocity(t + h) - aircraft.velocity(t - h)) / (2.0 * h)
    np.testing.assert_allclose(aircraft.acceleration(t), change, atol=1e-5)
    h = 2e-5  # short against the vibration's 20 ms
    turn = Rotation.from_matrix(np.swapaxes(aircraft.attitude(t - h), 1, 2) @ aircraft.attitude(t + h)).as_rotvec()
    np.testing.assert_allclose(aircraft.angular_rate(t), turn / (2.0 * h), atol=1e-5)


def test_the_plan_is_flown_and_turns_are_coordinated() -> None:
    path = flight.plan(
        [flight.Leg(duration=10.0), flight.Leg(turn=np.pi / 2, bank=0.35, climb=30.0), flight.Leg(duration=10.0)],
        latitude=0.5,
        longitude=0.1,
        height=500.0,
        course=0.0,
        speed=50.0,
        bank_ramp=4.0,
        pitch=0.0,
        drift_angle=0.0,
    )
    calm = harmonics.Harmonics(*(np.zeros((3, 1)) + x for x in (0.0, 1.0, 0.0)))
    aircraft = flight.Flight(path, calm, calm)
    geodetic, attitude = aircraft.navigation(np.array([1.0, path.duration - 1.0, path.duration / 2.0]))
    np.testing.assert_allclose(attitude[1, 2] - attitude[0, 2], np.pi / 2, atol=1e-6)
    np.testing.assert_allclose(geodetic[1, 2] - geodetic[0, 2], 30.0, atol=1e-3)
    assert abs(attitude[2, 0] - 0.35) < 0.02
    _, force = inertial.sensed(aircraft, np.array([path.duration / 2.0]))
    assert abs(force[0, 1]) < 0.05  # no side force but Coriolis'


def test_harmonics_have_the_spread_asked_for_and_repeat_with_the_seed() -> None:
    draw = [harmonics.draw(np.ones_like, np.array([2.0, 0.5]), (0.1, 5.0), 30, stream(3, "x")) for _ in range(2)]
    time = np.linspace(0.0, 2000.0, 40_001)
    x = draw[0](time)
    np.testing.assert_allclose(x.std(axis=0), [2.0, 0.5], rtol=0.02)
    np.testing.assert_array_equal(x, draw[1](time))
    slope = (draw[0](time + 1e-5) - draw[0](time - 1e-5)) / 2e-5
    np.testing.assert_allclose(draw[0](time, 1), slope, atol=1e-5)
    np.testing.assert_allclose(draw[0].integral()(time, 1), x, atol=1e-12)


def test_one_worker_or_more_give_the_same_bits(aircraft: flight.Flight) -> None:
    time = np.linspace(1.0, 20.0, 1001)
    threads = numba.get_num_threads()
    many = inertial.interval_means(aircraft, time, 0.005)
    try:
        numba.set_num_threads(1)
        one = inertial.interval_means(aircraft, time, 0.005)
    finally:
        numba.set_num_threads(threads)
    for a, b in zip(many, one, strict=True):
        np.testing.assert_array_equal(a, b)


# --- GNSS ------------------------------------------------------------------------------------------------------------


def test_antenna_velocity_is_the_derivative_of_its_position(aircraft: flight.Flight) -> None:
    t, h, lever = np.array([5.0, 11.7]), 1e-4, np.array([0.4, -0.2, -1.3])
    ahead, _ = gnss.antenna(aircraft, t + h, lever)
    behind, _ = gnss.antenna(aircraft, t - h, lever)
    _, velocity = gnss.antenna(aircraft, t, lever)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2.0 * h), atol=2e-5)


def test_fixes_are_stamped_late_and_displaced_along_ned(aircraft: flight.Flight) -> None:
    t, error = np.array([5.0]), np.array([[0.3, -0.2, 0.5]])
    fixes = gnss.observe(aircraft, t, np.zeros(3), 0.02, error, np.zeros((1, 3)))
    geodetic, _ = aircraft.navigation(t)
    moved = geodesy.local_metres(*fixes.geodetic[0], *geodetic[0])
    np.testing.assert_allclose(moved, error[0], atol=1e-5)
    np.testing.assert_allclose(fixes.time, 5.02)


# --- thermal ---------------------------------------------------------------------------------------------------------


def test_lag_follows_a_ramp_as_the_closed_form() -> None:
    time = np.arange(500.0)
    y = thermal.lag(0.05 * time[:, None], 80.0, 1.0)[:, 0]
    np.testing.assert_allclose(y, 0.05 * (time - 80.0 * (1.0 - np.exp(-time / 80.0))), atol=1e-9)
    np.testing.assert_array_equal(thermal.lag(time[:, None], 0.0, 1.0)[:, 0], time)


def test_air_profile_and_settled_nodes() -> None:
    stages = [(100.0, 20.0), (200.0, 50.0), (100.0, 50.0)]
    air = thermal.piecewise(20.0, stages, np.array([0.0, 50.0, 200.0, 300.0, 999.0]))
    np.testing.assert_allclose(air, [20.0, 20.0, 35.0, 50.0, 50.0])
    nodes = thermal.draw_nodes(np.array([30.0, 20.0, 10.0]), np.array([9.0, 7.0, 3.0]), 25.0, 4.0, 0.2, stream(1, "n"))
    temperatures = thermal.settle(np.full(1000, 20.0), 1.0, nodes)
    np.testing.assert_allclose(temperatures.gyro, np.broadcast_to([29.0, 27.0, 23.0], (1000, 3, 3)))
    np.testing.assert_allclose(temperatures.accel, 24.0)


def test_play_is_a_backlash() -> None:
    temperature = np.concatenate([np.linspace(0, 10, 50), np.linspace(10, 0, 50)])[:, None]
    play = thermal.play(temperature, 2.0)[:, 0]
    assert play[0] == 0.0 and play[49] == pytest.approx(8.0) and play[-1] == pytest.approx(2.0)
    assert (np.abs(play - temperature[:, 0]) <= 2.0 + 1e-12).all()
    np.testing.assert_array_equal(play[(temperature[:, 0] > 6.0) & (np.arange(100) > 49)], play[49])


def test_hysteresis_and_lag_add_as_declared() -> None:
    nodes = thermal.draw_nodes(np.array([90.0, 70.0, 50.0]), np.array([9.0, 7.0, 3.0]), 80.0, 4.0, 0.2, stream(1, "n"))
    temperatures = thermal.settle(thermal.piecewise(20.0, [(600.0, 50.0), (600.0, 0.0)], np.arange(1200.0)), 1.0, nodes)

    def biases(h: float, gyro: float, accel: float, lag: float) -> tuple[np.ndarray, np.ndarray]:
        laws = [thermal.draw_law(4, 1e-7, stream(2, "g", str(i))) for i in range(3)]
        accel_laws = [thermal.draw_law(2, 1e-3, stream(2, "a", str(i))) for i in range(3)]
        return thermal.Biases(laws, accel_laws, h, np.full(3, gyro), np.full(3, accel), lag)(temperatures)

    gyro, accel = biases(1.0, 0.0, 0.0, 0.0)
    more_gyro, more_accel = biases(6.0, 1e-7, 1e-3, 0.0)
    for more, plain, size, mean in (
        (more_gyro, gyro, 1e-7, temperatures.gyro.mean(axis=2)),
        (more_accel, accel, 1e-3, temperatures.accel),
    ):
        shift = (more - plain) / size
        np.testing.assert_allclose(shift, (thermal.play(mean, 6.0) - mean) / 6.0, atol=1e-9)
        assert shift.max() == pytest.approx(1.0) and shift.min() == pytest.approx(-1.0)
    lagged, same = biases(1.0, 0.0, 0.0, 30.0)
    assert np.abs(lagged - gyro).max() > 1e-9
    np.testing.assert_array_equal(same, accel)


def test_thermometers_are_quantised() -> None:
    read = thermal.thermometers(np.full(20_000, 21.234), 0.02, 0.01, np.random.default_rng(2))
    np.testing.assert_allclose(read * 100.0, np.round(read * 100.0), atol=1e-9)
    assert read.std() == pytest.approx(np.hypot(0.02, 0.01 / np.sqrt(12.0)), rel=0.03)


# --- optics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k1", [0.0, 2.0, -3.0])
def test_rays_obey_the_contracts_projection(k1: float) -> None:
    optics = lens.Lens(47.8, 95.1, 4667.0, k1)
    row, col = np.meshgrid([0.0, 30.0, 95.0], [0.0, 95.1, 191.0])
    x, y = np.moveaxis(lens.ray(optics, row, col), -1, 0)
    s = 1.0 + k1 * (x**2 + y**2)
    np.testing.assert_allclose(47.8 + s * y * 4667.0, row, atol=1e-9)
    np.testing.assert_allclose(95.1 - s * x * 4667.0, col, atol=1e-9)


def test_find_is_the_inverse_of_ray() -> None:
    optics = lens.Lens(31.0, 63.0, 800.0, 0.5)
    to_ecef = rotation.rpy_to_dcm(0.1, -0.2, 2.0)
    camera = np.array([1e6, 2e6, 3e6])
    point = camera + 900.0 * to_ecef @ np.append(lens.ray(optics, 12.3, 101.7), 1.0)
    np.testing.assert_allclose(lens.find(optics, camera, to_ecef, point), [12.3, 101.7], atol=1e-6)
    with pytest.raises(ValueError, match="behind"):
        lens.find(optics, camera, to_ecef, camera - to_ecef[:, 2])


def test_a_lens_that_folds_is_refused() -> None:
    with pytest.raises(ValueError, match="folds"):
        lens.ray(lens.Lens(0.0, 0.0, 10.0, -50.0), np.array([5.0]), np.array([5.0]))


def test_path_difference_is_the_contracts() -> None:
    opd = interferometer.path_difference(5, 8, 2e-7, 3.0, 1e-10, 4e-9)
    d = 6 - 3.0
    assert opd[4, 6] == pytest.approx(2e-7 * d + 1e-10 * d**2 + 4e-9 * (4 - 2.0), abs=1e-20)
    assert opd[2, 3] == 0.0


def test_interferogram_of_a_gaussian_line() -> None:
    """∫ exp(−(σ−σ₀)²/2s²)·cos(2πσx + φ) dσ = s√(2π)·exp(−2π²s²x²)·cos(2πσ₀x + φ), and a constant part over V."""
    sigma = np.arange(1.0e6, 2.4e6, 1000.0)
    line = np.exp(-0.5 * ((sigma - 1.6e6) / 3e4) ** 2)
    opd = np.linspace(-5e-6, 25e-6, 200)
    signal = interferometer.interferogram(
        opd, sigma, np.full(sigma.size, 2.0), line[None], np.full(sigma.size, 0.3), 0.8
    )[0]
    area = 2.0 * 3e4 * np.sqrt(2.0 * np.pi)
    fringe = area * np.exp(-2.0 * (np.pi * 3e4 * opd) ** 2) * np.cos(2.0 * np.pi * 1.6e6 * opd + 0.3)
    np.testing.assert_allclose(signal, area / 0.8 + fringe, atol=1e-8 * area)


def test_parseval_of_an_interferogram() -> None:
    """∫ AC² dx over all path differences = ½∫ (response·B)² dσ."""
    sigma = np.arange(1.0e6, 2.4e6, 2500.0)
    line = np.exp(-0.5 * ((sigma - 1.5e6) / 6e4) ** 2)
    step = 1e-7
    opd = step * np.arange(-400, 401)
    signal = interferometer.interferogram(opd, sigma, np.ones(sigma.size), line[None], np.zeros(sigma.size), 1.0)[0]
    fringe = signal - line.sum() * 2500.0
    assert np.sum(fringe**2) * step == pytest.approx(0.5 * np.sum(line**2) * 2500.0, rel=1e-6)


def test_channel_fringe_nonlinearity_and_materials() -> None:
    fringe = interferometer.channel_fringe(np.array([0.0, 5e3]), 0.1, 1e-4, 0.0)
    np.testing.assert_allclose(fringe, [1.1, 0.9])
    np.testing.assert_allclose(interferometer.saturate(np.array([12000.0, 6000.0]), 0.1), [10800.0, 5700.0])
    sigma = np.arange(1.0e6, 2.35e6, 2500.0)
    for name in materials.NAMES:
        assert ((materials.reflectance(name, sigma) > 0.0) & (materials.reflectance(name, sigma) < 1.0)).all()
    with pytest.raises(ValueError, match="velvet"):
        materials.reflectance("velvet", sigma)
    light = materials.illumination(sigma)
    assert light.min() > 0.0 and 0.5 < light.max() < 1.0


# --- ground and frames -----------------------------------------------------------------------------------------------


def bounds(half: float = 6e-5) -> tuple[float, float, float, float]:
    return LATITUDE - half, LONGITUDE - half, LATITUDE + half, LONGITUDE + half


def test_rays_end_on_the_terrain() -> None:
    terrain = world.draw_terrain(bounds(), 4.0, 60.0, 8.0, (100.0, 600.0), 30, np.random.default_rng(4))
    assert 3.0 < terrain.height.std() < 14.0
    position = np.tile(geodesy.geodetic_to_ecef(LATITUDE, LONGITUDE, 1000.0), (50, 1))
    slopes = np.random.default_rng(5).uniform(-0.15, 0.15, (50, 2))
    direction = np.concatenate([slopes, np.ones((50, 1))], 1) @ geodesy.ned_to_ecef_dcm(LATITUDE, LONGITUDE).T
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    hit = imaging.cast(position, direction, terrain)
    lat, lon, height = geodesy.ecef_to_geodetic(hit)
    np.testing.assert_allclose(terrain.at(lat, lon), height, atol=1e-4)
    np.testing.assert_allclose(np.cross(hit - position, direction), 0.0, atol=1e-6)
    lost = imaging.cast(position[:1], -direction[:1], terrain)
    assert np.isnan(lost).all()


def test_points_laid_on_the_terrain_keep_their_place() -> None:
    terrain = world.draw_terrain(bounds(), 4.0, 60.0, 8.0, (100.0, 600.0), 30, np.random.default_rng(4))
    plane = world.Plane.at(LATITUDE, LONGITUDE, 55.0, 0.4)
    wanted = np.array([[30.0, -20.0], [-80.0, 5.0]])
    point = world.on_terrain(plane, terrain, wanted)
    np.testing.assert_allclose(terrain.at(point[:, 0], point[:, 1]), point[:, 2], atol=1e-6)
    np.testing.assert_allclose(plane.coordinates(geodesy.geodetic_to_ecef(*point.T)), wanted, atol=1e-6)
    north, east, _ = geodesy.local_metres(point[0, 0], point[0, 1], 55.0, LATITUDE, LONGITUDE, 55.0)
    c, s = np.cos(0.4), np.sin(0.4)
    np.testing.assert_allclose([north, east], [30 * c + 20 * s, 30 * s - 20 * c], atol=0.02)


def test_texture_abundances_add_to_one() -> None:
    texture = world.draw_texture(
        np.zeros(2), np.array([60.0, 40.0]), 0.5, np.array([0.6, 0.3, 0.1]), 1.5, (1.0, 20.0), stream(1, "t")
    )
    np.testing.assert_allclose(texture.abundance.sum(axis=-1), 1.0, atol=1e-6)
    assert texture.abundance[..., 0].std() > 0.1


def _scene(background: int = 0) -> imaging.Scene:
    """One panel of material 1 on a background of material 0 over rolling ground."""
    terrain = world.draw_terrain(bounds(), 4.0, 60.0, 4.0, (200.0, 600.0), 30, np.random.default_rng(4))
    plane = world.Plane.at(LATITUDE, LONGITUDE, 60.0, 0.25)
    centre = np.array([[3.0, -2.0]])
    panels = world.Panels(centre, world.on_terrain(plane, terrain, centre), np.array([6.0]), np.array([1]))
    texture = world.Texture(np.ones((8, 8, 1), np.float32), np.zeros(2), 1.0)
    return imaging.Scene(terrain, plane, panels, texture, np.array([background]))


def _pose() -> tuple[np.ndarray, np.ndarray]:
    """A camera 900 m up, tilted a little, over the panel; one frame, one instant."""
    position = geodesy.geodetic_to_ecef(LATITUDE, LONGITUDE, 960.0)
    to_ecef = geodesy.ned_to_ecef_dcm(LATITUDE, LONGITUDE) @ rotation.rpy_to_dcm(0.004, 0.003, 0.28)
    return position[None, None], to_ecef[None, None]


def test_a_panel_is_seen_where_the_contract_projects_it() -> None:
    optics, scene = lens.Lens(31.8, 39.1, 1500.0, 5.0), _scene()
    signal = np.stack([np.zeros((64, 80)), np.ones((64, 80))])
    position, to_ecef = _pose()
    frame = imaging.expose(position, to_ecef, optics, scene, signal, 6)[0]
    offset = to_ecef[0, 0].T @ (geodesy.geodetic_to_ecef(*scene.panels.geodetic[0]) - position[0, 0])
    x, y = offset[:2] / offset[2]
    s = 1.0 + 5.0 * (x**2 + y**2)
    rows, cols = np.indices(frame.shape)
    assert (rows * frame).sum() / frame.sum() == pytest.approx(31.8 + s * y * 1500.0, abs=0.03)
    assert (cols * frame).sum() / frame.sum() == pytest.approx(39.1 - s * x * 1500.0, abs=0.03)
    # A 6 m square at 900 m through 1500 px of focal length
    assert frame.sum() == pytest.approx((6.0 * 1500.0 / 900.0) ** 2, rel=0.02)


def test_bare_ground_gives_its_own_signal_and_instants_average() -> None:
    scene = _scene()
    signal = np.random.default_rng(0).uniform(1.0, 2.0, (2, 16, 20))
    far = lens.Lens(600.0, 10.0, 4000.0, 0.0)  # looks past the panel
    position, to_ecef = _pose()
    frame = imaging.expose(position, to_ecef, far, scene, signal, 2)
    np.testing.assert_allclose(frame[0], signal[0], rtol=1e-6)
    twice = imaging.expose(position.repeat(2, 1), to_ecef.repeat(2, 1), far, scene, signal, 2)
    np.testing.assert_allclose(twice, frame, rtol=1e-6)


def test_a_look_beyond_the_terrain_is_refused() -> None:
    position, to_ecef = _pose()
    with pytest.raises(ValueError, match="leaves the terrain"):
        imaging.expose(position, to_ecef, lens.Lens(8.0, 10.0, 5.0, 0.0), _scene(), np.ones((2, 16, 20)), 1)


def test_counts_have_dark_noise_and_ceiling() -> None:
    signal = np.full((400, 8, 8), 4000.0)
    counts = imaging.digitise(signal, np.full((8, 8), 200.0), 4.0, 6.0, 16383, np.random.default_rng(0))
    assert counts.dtype == np.uint16
    assert counts.mean() == pytest.approx(4200.0, abs=1.0)
    assert counts.astype(float).var() == pytest.approx(4000.0 / 4.0 + 36.0 + 1.0 / 12.0, rel=0.03)
    assert imaging.digitise(signal, np.zeros((8, 8)), 4.0, 6.0, 3000, np.random.default_rng(0)).max() == 3000


def test_the_mount_drifts_and_flexes_as_defined(aircraft: flight.Flight) -> None:
    time = np.array([8.0, 9.0])
    boresight = rotation.rpy_to_dcm(0.01, 0.02, 0.03)
    drift, flexure = np.array([1e-4, -2e-4, 3e-4]), np.array([1e-3, 2e-3])
    lever = np.array([0.15, -0.1, 0.25])
    end = np.arange(1, 4001) / 200.0
    gyro, _ = inertial.interval_means(aircraft, end, 0.005)
    acceleration = imaging.angular_acceleration(end, gyro, 200.0)
    mount = imaging.Mount(lever, boresight, drift, flexure)
    position, to_ecef = imaging.camera_poses(aircraft, time, mount, np.array([10.0, 5.0]), acceleration)
    body = aircraft.attitude(time)
    np.testing.assert_allclose(position, aircraft.position(time) + body @ lever, atol=1e-8)
    bend = np.append(flexure * acceleration(9.0)[:2], 0.0)
    warm = Rotation.from_rotvec(5.0 * drift).as_matrix()
    expected = Rotation.from_rotvec(bend).as_matrix() @ warm @ boresight
    np.testing.assert_allclose(body[1].T @ to_ecef[1], expected, atol=1e-12)
    with pytest.raises(ValueError, match="angular acceleration"):
        imaging.camera_poses(aircraft, time, mount, np.zeros(2), None)


def test_angular_acceleration_passes_slow_motion() -> None:
    end = np.arange(1, 2001) / 200.0
    gyro = np.stack([np.cos(2 * np.pi * (end - 0.0025)), np.zeros(end.size), np.zeros(end.size)], -1)
    alpha = imaging.angular_acceleration(end, gyro, 200.0)
    time = np.linspace(2.0, 8.0, 50)
    np.testing.assert_allclose(alpha(time)[:, 0], -2 * np.pi * np.sin(2 * np.pi * time), atol=0.01)


# --- effects and streams ---------------------------------------------------------------------------------------------


def test_effects_are_completed_or_refused() -> None:
    full = effects.complete({"opd_scale": {"scale": 0.01}})
    assert full["opd_scale"]["scale"] == 0.01 and full["boresight"]["yaw"] == 0.0
    for wrong, match in (
        ({"ghost": {"a": 1.0}}, "ghost"),
        ({"opd_scale": {"slope": 1.0}}, "opd_scale.slope"),
        ({"thermal_hysteresis": {"gyro": 1.0}}, "list of three"),
        ({"thermal_hysteresis": {"gyro": [1.0]}}, "three values"),
        ({"thermal_hysteresis": {"half_width": 0.0}}, "half_width"),
        ({"thermal_lag": {"lag": -1.0}}, "lag"),
    ):
        with pytest.raises(ValueError, match=match):
            effects.complete(wrong)  # type: ignore[arg-type]


def test_streams_are_independent_and_repeat() -> None:
    draws = [stream(1, *p).standard_normal(1000) for p in (("a",), ("b",), ("a", "b"), ("a",))]
    np.testing.assert_array_equal(draws[0], draws[3])
    for x, y in pairwise(draws[:3]):
        assert abs(np.corrcoef(x, y)[0, 1]) < 0.15


def test_response_integrates_to_what_its_parts_say() -> None:
    sigma = np.arange(1.0e6, 2.35e6, 2500.0)
    r = materials.response(sigma, 0.009, 640.0, 180.0, (450.0, 900.0), 12500.0)
    assert r.max() == pytest.approx(0.009, rel=1e-3) and r[0] < 1e-4 * r.max()
    area, _ = quad(lambda s: 0.009 * np.exp(-0.5 * ((1e9 / s - 640.0) / 180.0) ** 2), 1e9 / 900.0, 1e9 / 450.0)
    assert r.sum() * 2500.0 == pytest.approx(area, rel=0.02)
    np.testing.assert_allclose(materials.phase(sigma, np.array([0.1, 0.2]))[[0, -1]], [-0.1, 0.3])
