"""The floor under a camera: two routes to one point, and the signs a person would expect."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.overhead import floor_from_rays, foot_from_cam, rays_from_floor

# Two routes to one ray in double precision: eps 2.2e-16 x 1e2 (division by a depth down to
# h / 20) x 20 (rays up to 20) = 4e-13. Worst seen over 20,000 attitudes: the same to the bit.
TOLERANCE = 1e-11
# There and back, per height: worst seen over 20,000 attitudes 1.1e-14.
ROUND_TRIP = 1e-12

ATTITUDES = st.builds(Attitude, st.floats(-1.4, 1.4), st.floats(-0.5, 0.5), st.floats(0.05, 100.0))


def floor_points(attitude, seed):
    """Points within six heights of the foot, in metres."""
    rng = np.random.default_rng(seed)
    return attitude.height_m * rng.uniform(-6.0, 6.0, (60, 2))


@given(ATTITUDES)
def test_axes_are_a_rotation(attitude):
    axes = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-15)


@given(ATTITUDES, st.integers(0, 2**32 - 1))
def test_rays_are_those_of_opencv(attitude, seed):
    floor = floor_points(attitude, seed)
    rays = rays_from_floor(attitude, floor)
    seen = ~np.isnan(rays[:, 0])
    cam_from_foot = foot_from_cam(attitude.tilt_rad, attitude.roll_rad).T
    centre = np.array([0.0, 0.0, attitude.height_m])
    points = np.column_stack([floor, np.zeros(len(floor))])
    depth = (points - centre) @ cam_from_foot.T[:, 2]
    assert np.array_equal(seen, depth > 0.0)
    near = depth > attitude.height_m / 20.0
    if near.any():
        turn, _ = cv2.Rodrigues(cam_from_foot)
        expected, _ = cv2.projectPoints(
            points[near], turn, -cam_from_foot @ centre, np.eye(3), np.zeros(4)
        )
        # cv2 takes the rotation as a vector, exact to 1e-5 rad only near a half turn (which
        # nadir is); a ray at r off the axis moves by (1 + r2) times that. A wrong sign moves it
        # by its own length.
        allowed = 2e-5 * (1.0 + (rays[near] ** 2).sum(axis=1, keepdims=True))
        assert (np.abs(rays[near] - expected.reshape(-1, 2)) < allowed).all()


@given(st.floats(-1.4, 1.4), st.floats(0.05, 100.0), st.integers(0, 2**32 - 1))
def test_rays_are_those_of_the_paper(tilt, height, seed):
    """G(a, h) of the paper's eq. 1 in its right form takes floor points to rays, without roll."""
    attitude = Attitude(tilt, 0.0, height)
    c, s = math.cos(tilt), math.sin(tilt)
    G = np.array([[0.0, -1.0, 0.0], [-c, 0.0, height * s], [s, 0.0, height * c]])
    floor = floor_points(attitude, seed)
    x, y, z = G @ np.column_stack([floor, np.ones(len(floor))]).T
    near = z > height / 20.0
    expected = np.column_stack([x[near] / z[near], y[near] / z[near]])
    assert rays_from_floor(attitude, floor)[near] == pytest.approx(expected, abs=TOLERANCE)


@given(ATTITUDES, st.integers(0, 2**32 - 1))
def test_floor_undoes_rays(attitude, seed):
    floor = floor_points(attitude, seed)
    rays = rays_from_floor(attitude, floor)
    kept = np.abs(rays).max(axis=1) < 20.0
    again = floor_from_rays(attitude, rays[kept])
    assert again == pytest.approx(floor[kept], abs=attitude.height_m * ROUND_TRIP)


def test_at_nadir_up_in_the_picture_is_forward():
    nadir = Attitude(0.0, 0.0, 2.0)
    rays = np.array([[0.0, 0.0], [0.0, -0.5], [0.5, 0.0]])  # the axis, above it, right of it
    expected = [[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]]  # the foot, ahead, to the right
    assert floor_from_rays(nadir, rays) == pytest.approx(np.array(expected))


@pytest.mark.parametrize("tilt_deg", [33.0, 45.0, -20.0])
def test_tilt_looks_ahead(tilt_deg):
    attitude = Attitude(math.radians(tilt_deg), 0.0, 0.55)
    (point,) = floor_from_rays(attitude, np.zeros((1, 2)))
    assert point == pytest.approx([0.55 * math.tan(math.radians(tilt_deg)), 0.0])


def test_roll_with_the_left_side_up_looks_left():
    attitude = Attitude(0.0, math.radians(10.0), 1.0)
    (point,) = floor_from_rays(attitude, np.zeros((1, 2)))
    assert point == pytest.approx([0.0, math.tan(math.radians(10.0))])
    axes = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    assert (axes @ [-1.0, 0.0, 0.0])[2] > 0.0  # the camera's left side


def test_above_the_horizon_and_behind_the_camera_is_nothing():
    attitude = Attitude(math.radians(45.0), 0.0, 1.0)
    rays = np.array([[0.0, -0.999], [0.0, -1.0], [0.3, -1.001]])  # the horizon is at y = -1
    floor = floor_from_rays(attitude, rays)
    assert floor[0, 0] > 1000.0
    assert np.isnan(floor[2]).all()
    assert np.isnan(rays_from_floor(attitude, np.array([[-1.001, 0.2]]))).all()
    assert np.isfinite(rays_from_floor(attitude, np.array([[-0.999, 0.2]]))).all()
