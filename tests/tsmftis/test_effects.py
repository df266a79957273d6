"""What effects do to camera, mounting and interferometer: closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsmftis.camera import Camera, Mounting, angular_acceleration, camera_pose
from tsmftis.detector import undo_nonlinearity
from tsmftis.effects import EFFECTS, amounts, nested, refuse_others, scalars
from tsmftis.geodesy import ned_to_ecef_dcm
from tsmftis.interferometer import Interferometer, response_with_effects

CAMERA = Camera(96, 192, 15e-6, 0.07, 47.8, 95.1, 100.0, 16383.0, 0.3, 0.004)
MOUNTING = Mounting(np.zeros(3), np.array([0.15, -0.1, 0.25]), np.array([0.003, -0.005, 0.008]))
INTERFEROMETER = Interferometer(96, 192, 2.05e-7, 28.0, 450e-9, 900e-9, 1e-12, 2e-9, 0.01)


def test_no_effect_changes_nothing() -> None:
    assert CAMERA.with_effects({}) == CAMERA and INTERFEROMETER.with_effects({}) == INTERFEROMETER
    same = MOUNTING.with_effects({"boresight": {}, "mount_flexure": {"roll": 0.0}})
    np.testing.assert_array_equal(same.dcm_at(None, None), MOUNTING.dcm_camera_to_body)
    assert amounts({}, "boresight") == (0.0, 0.0, 0.0) and amounts({"boresight": {"yaw": 2.0}}, "boresight")[2] == 2.0


def test_latency_adds_focal_length_scales_and_distortion_grows_with_the_cube() -> None:
    """(1 + scale) on distances from the principal point; k1·r³·f/p more at the radius r, in its direction."""
    point = np.array([0.012, -0.007, 1.0])
    row, col = replace(CAMERA, radial_k1=0.0).project(point)
    longer = replace(CAMERA, radial_k1=0.0).with_effects({"focal_length": {"scale": 0.01}}).project(point)
    np.testing.assert_allclose(longer[0] - 47.8, 1.01 * (row - 47.8), rtol=1e-12)
    np.testing.assert_allclose(longer[1] - 95.1, 1.01 * (col - 95.1), rtol=1e-12)
    bent = CAMERA.with_effects({"radial_distortion": {"k1": 0.7}, "camera_latency": {"latency": -0.001}})
    assert bent.radial_k1 == pytest.approx(1.0) and bent.latency == pytest.approx(0.003)
    r2 = 0.012**2 + 0.007**2
    np.testing.assert_allclose(bent.project(point)[0] - row, r2 * (row - 47.8), rtol=1e-9)


def test_the_mount_turns_as_the_contract_says() -> None:
    """Exp(roll·α_x, pitch·α_y, 0)·Exp(drift·(T − 25))·C(boresight + angles), by another library's rotations."""
    effects = {
        "boresight": {"roll": 0.001, "pitch": 0.002, "yaw": -0.003},
        "boresight_thermal_drift": {"roll": 1e-4, "pitch": -2e-4, "yaw": 3e-4},
        "mount_flexure": {"roll": 2e-3, "pitch": -1e-3},
    }
    moved = MOUNTING.with_effects(effects)
    temperature, alpha = np.array([25.0, 31.0]), np.array([[0.0, 0.0, 9.0], [0.5, -0.4, 9.0]])
    latitude, longitude, height = np.full(2, 0.6), np.full(2, 2.1), np.full(2, 900.0)
    level = np.tile(np.eye(3), (2, 1, 1))
    centre, dcm = camera_pose(latitude, longitude, height, level, moved, temperature, alpha)
    mount = Rotation.from_euler("ZYX", [0.005, -0.003, 0.004])
    warm = Rotation.from_rotvec(6.0 * np.array([1e-4, -2e-4, 3e-4]))
    bend = Rotation.from_rotvec([2e-3 * 0.5, 1e-3 * 0.4, 0.0])
    to_ecef = ned_to_ecef_dcm(0.6, 2.1)
    np.testing.assert_allclose(dcm[0], to_ecef @ mount.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(dcm[1], to_ecef @ (bend * warm * mount).as_matrix(), atol=1e-14)
    np.testing.assert_array_equal(centre, camera_pose(latitude, longitude, height, level, MOUNTING)[0])
    with pytest.raises(ValueError, match="temperatures"):
        moved.dcm_at(None, alpha)
    with pytest.raises(ValueError, match="accelerations"):
        moved.dcm_at(temperature, None)


def test_angular_acceleration_is_the_low_passed_derivative() -> None:
    """2 Hz passes; at 12 Hz half is left of what goes there and back through a Butterworth; 40 Hz is gone. No delay.

    The rates are means over the 5 ms that end at their stamps, which is sinc-small at 12 Hz (0.6 %).
    """
    time = np.arange(1, 2001) * 0.005
    at = np.arange(4.0, 6.0, 0.0031)
    for hertz, gain in ((2.0, 1.0), (12.0, 0.5), (40.0, 0.0)):
        w = 2.0 * np.pi * hertz
        rate = np.stack([np.sin(w * (time - 0.0025)), np.zeros(time.size), np.ones(time.size)], -1)
        found = angular_acceleration(time, rate, at)
        np.testing.assert_allclose(found[:, 0], gain * w * np.cos(w * at), atol=0.02 * w)
        assert np.abs(found[:, 1:]).max() < 1e-9
    slow = np.arange(1, 201) * 0.1  # an IMU at 10 Hz has nothing to filter
    ramp = np.outer(slow - 0.05, [1.0, -2.0, 0.5])
    np.testing.assert_allclose(angular_acceleration(slow, ramp, np.array([10.0])), [[1.0, -2.0, 0.5]], atol=1e-9)


def test_opd_scale_is_of_the_step_and_the_rest_adds() -> None:
    effects = {"opd_scale": {"scale": 0.01}, "opd_quadratic": {"quadratic": 3e-12}, "fringe_tilt": {"tilt": -1e-9}}
    changed = INTERFEROMETER.with_effects(effects | {"detector_nonlinearity": {"a": 0.07}})
    d = np.arange(192.0) - 28.0
    np.testing.assert_allclose(
        changed.opd(10.0, np.arange(192)), 1.01 * 2.05e-7 * d + 4e-12 * d**2 + 1e-9 * (10.0 - 47.5)
    )
    assert changed.detector_nonlinearity == pytest.approx(0.08)


def test_response_is_scaled_and_fringed() -> None:
    sigma, response = np.array([1.0e6, 1.5e6]), np.array([2.0, 3.0])
    fringe = {"channel_fringe": {"amplitude": 0.1, "thickness": 1e-6, "phase": 0.0}}
    np.testing.assert_allclose(response_with_effects(sigma, response, fringe), [2.2, 2.7])
    np.testing.assert_allclose(response_with_effects(sigma, response, {"response_scale": {"scale": -0.1}}), [1.8, 2.7])


@pytest.mark.parametrize("a", [-0.2, 1e-9, 0.0, 0.1])
def test_nonlinearity_is_undone(a: float) -> None:
    s = np.linspace(-1.0, 1.0, 9)
    np.testing.assert_allclose(undo_nonlinearity(s * (1.0 - a * s), a, 1.0), s, atol=1e-14)


def test_what_is_no_effect_of_a_stage_is_refused() -> None:
    refuse_others({"opd_scale": {"scale": 1.0}, "boresight": {"roll": 1.0}}, "spectral", "geometry")
    for wrong in ({"boresight": {"x": 1.0}}, {"gnss_latency": {}}, {"colour": {}}):
        with pytest.raises(ValueError, match="no effect"):
            refuse_others(wrong, "geometry")


def test_bounds_belong_to_parameters() -> None:
    for effect in EFFECTS.values():
        assert set(effect.largest) == set(effect.units)
        assert set(effect.least) | effect.lists <= set(effect.units)


def test_lists_of_three_have_scalar_names_and_are_put_together_again() -> None:
    assert list(scalars("thermal_hysteresis")) == [
        "half_width",
        *(f"{k}.{a}" for k in ("gyro", "accel") for a in "xyz"),
    ]
    values = {"thermal_hysteresis": {"half_width": 6.0, "gyro.y": 2e-7}, "boresight": {"yaw": 0.1}}
    assert nested(values) == {
        "thermal_hysteresis": {"half_width": 6.0, "gyro": (0.0, 2e-7, 0.0), "accel": (0.0, 0.0, 0.0)},
        "boresight": {"roll": 0.0, "pitch": 0.0, "yaw": 0.1},
    }
