"""The camera's projection, its inverse, and the contract's sign conventions."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tsmftis.camera import Camera, Mounting, camera_pose
from tsmftis.geodesy import geodetic_to_ecef, ned_to_ecef_dcm
from tsmftis.rotation import rpy_to_dcm


def camera(k1: float = 0.0) -> Camera:
    return Camera(96, 192, 15e-6, 0.07, 47.8, 95.1, 100.0, 16383.0, k1)


@given(st.floats(-50, 150), st.floats(-50, 250), st.floats(-5.0, 5.0))
@settings(deadline=None)
def test_directions_undo_project(row: float, col: float, k1: float) -> None:
    """Newton ends in rounding: 1e-9 px. |k1|·r² < 0.03 here, real lenses have less."""
    ray = camera(k1).directions(row, col)
    assert np.isclose(np.linalg.norm(ray), 1.0, atol=1e-14)
    np.testing.assert_allclose(camera(k1).project(1234.5 * ray), (row, col), atol=1e-9)


def test_the_principal_point_looks_along_the_axis() -> None:
    np.testing.assert_allclose(camera(0.3).directions(47.8, 95.1), [0, 0, 1], atol=1e-15)


def test_distortion_is_the_contracts() -> None:
    """row = row0 + s·y·f/p, col = col0 − s·x·f/p with s = 1 + k1·(x² + y²), written out: rounding."""
    x, y, k1 = 0.012, -0.007, 0.8
    s = 1 + k1 * (x * x + y * y)
    row, col = camera(k1).project(np.array([x, y, 1.0]) * 900.0)
    np.testing.assert_allclose([row, col], [47.8 + s * y * 0.07 / 15e-6, 95.1 - s * x * 0.07 / 15e-6], atol=1e-10)


def test_signs_of_the_contract() -> None:
    """Ahead is a smaller column, right a larger row; nose up throws a point below towards a larger column; right wing down
    (positive roll) turns the axis to the left, so a point below moves to a larger row; behind the camera is NaN."""
    row, col = camera().project(np.array([[0, 0, 1000.0], [1, 0, 1000.0], [0, 1, 1000.0]]))
    assert col[1] < col[0] and row[1] == row[0]
    assert row[2] > row[0] and col[2] == col[0]
    below = np.array([0.0, 0.0, 1000.0])
    assert camera().project(rpy_to_dcm(0.0, 0.01, 0.0).T @ below)[1] > col[0]
    assert camera().project(rpy_to_dcm(0.01, 0.0, 0.0).T @ below)[0] > row[0]
    assert np.isnan(camera().project(-below)).all()


def test_pose_puts_lever_arm_and_boresight_where_the_contract_says() -> None:
    """C_camera→body = Rz·Ry·Rx of the boresight, the lever arm from IMU to camera in the body; scipy as reference."""
    boresight, lever, rpy = np.array([0.02, -0.03, 0.1]), np.array([1.0, 2.0, 3.0]), (0.1, -0.2, 2.0)
    mounting = Mounting(np.zeros(3), lever, boresight, np.array([np.pi, 0.0, 0.5]))
    lat, lon, h = np.array([0.65]), np.array([2.13]), np.array([900.0])
    centre, dcm = camera_pose(lat, lon, h, rpy_to_dcm(*rpy)[None], mounting)
    to_ecef = ned_to_ecef_dcm(lat[0], lon[0]) @ Rotation.from_euler("ZYX", rpy[::-1]).as_matrix()
    np.testing.assert_allclose(centre[0] - geodetic_to_ecef(lat[0], lon[0], h[0]), to_ecef @ lever, atol=1e-8)
    np.testing.assert_allclose(dcm[0], to_ecef @ Rotation.from_euler("ZYX", boresight[::-1]).as_matrix(), atol=1e-14)


def test_central_frame_is_nearest_to_mid_detector() -> None:
    row = np.array([[10.0, 47.5, np.nan, 47.0]])
    col = np.array([[90.0, 80.0, 95.5, 94.0]])
    assert camera().central_frame(row, col).tolist() == [3]
    assert camera().ground_sample(1000.0) == 15e-6 * 1000.0 / 0.07
