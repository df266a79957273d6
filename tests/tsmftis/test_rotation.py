"""Rotations against scipy's own, and attitude histories against one known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tsmftis.rotation import (
    Attitude,
    dcm_to_quaternion,
    dcm_to_rpy,
    exp_so3,
    log_so3,
    quaternion_to_dcm,
    rpy_jacobian,
    rpy_to_dcm,
)

angle = st.floats(-3.1, 3.1)
steep = st.floats(-1.5, 1.5)
small = st.floats(-1.5, 1.5)


@given(angle, steep, angle)
@settings(deadline=None)
def test_roll_pitch_yaw_are_scipys_and_come_back(roll: float, pitch: float, yaw: float) -> None:
    """1e-14 is rounding; coming back loses 1/cos(pitch), at 1.5 rad a factor of 14 twice."""
    dcm = rpy_to_dcm(roll, pitch, yaw)
    np.testing.assert_allclose(dcm, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(dcm_to_rpy(dcm), (roll, pitch, yaw), atol=1e-12)


def test_contract_axes() -> None:
    """Positive pitch lifts the nose, positive roll drops the right wing, positive yaw turns north to east."""
    forward, right = np.eye(3)[:2]
    assert (rpy_to_dcm(0.0, 0.1, 0.0) @ forward)[2] < 0 < (rpy_to_dcm(0.1, 0.0, 0.0) @ right)[2]
    np.testing.assert_allclose(rpy_to_dcm(0.0, 0.0, np.pi / 2) @ forward, [0, 1, 0], atol=1e-15)


@given(small, small, small)
@settings(deadline=None)
def test_exponential_logarithm_quaternion_round_trips(x: float, y: float, z: float) -> None:
    """|v| < 2.6 stays clear of π, where the logarithm has two values; 1e-12 is rounding there."""
    v = np.array([x, y, z])
    dcm = exp_so3(v)
    np.testing.assert_allclose(log_so3(dcm), v, atol=1e-12)
    np.testing.assert_allclose(quaternion_to_dcm(dcm_to_quaternion(dcm)), dcm, atol=1e-14)
    np.testing.assert_allclose(dcm @ v, v, atol=1e-13)  # the axis stays


@given(angle, st.floats(-1.2, 1.2), angle)
@settings(deadline=None, max_examples=30)
def test_jacobian_is_the_derivative_of_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> None:
    """Central differences at 1e-6: truncation 1e-12/cos³(pitch) < 1e-10, rounding 1e-10; hence 1e-8."""
    dcm, rpy = rpy_to_dcm(roll, pitch, yaw), np.array([[roll, pitch, yaw]])
    step = 1e-6 * np.eye(3)
    difference = [np.subtract(dcm_to_rpy(exp_so3(s) @ dcm), dcm_to_rpy(exp_so3(-s) @ dcm)) / 2e-6 for s in step]
    wrapped = np.where(np.abs(difference) > 100, 0, difference)  # across ±180° the difference jumps
    known = np.abs(np.transpose(difference)) < 100
    np.testing.assert_allclose(rpy_jacobian(rpy)[0][known], wrapped.T[known], atol=1e-8)


def test_attitude_history_is_smooth_between_samples() -> None:
    """2 Hz, 0.03 rad sampled at 200 Hz: a cubic spline errs by (5/384)·h⁴·φ⁗ = 6e-9 rad an axis; linear would by 1e-5."""
    time = np.arange(0.0, 4.0, 0.005)

    def dcm(t: np.ndarray) -> np.ndarray:
        wobble = 0.03 * np.sin(2 * np.pi * 2.0 * t)
        return Rotation.from_euler("ZYX", np.stack([1.0 + 0.5 * t, wobble, -wobble + 0.1], -1)).as_matrix()

    history = Attitude.fit(time, dcm(time))
    between = np.linspace(0.1, 3.8, 1371)
    assert np.linalg.norm(log_so3(np.swapaxes(dcm(between), 1, 2) @ history(between)), axis=-1).max() < 2e-8
    with pytest.raises(ValueError, match="170"):
        Attitude.fit(time, Rotation.from_euler("z", 2.0 * time[:, None]).as_matrix())
