"""Robots that mow: even steps, neighbours that see common floor, blocks that meet, any size."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from world_cameras import camera, view

from groundfuse.tools.lawn import mown, plan_lawn
from groundfuse.tools.overlap import true_overlap
from groundfuse.tools.trajectories import meetings

ROW_M, STEP_M, SWING_M = 0.4, 0.26, 0.5


@given(st.integers(1, 80), st.floats(0.3, 6.0), st.floats(0.1, 1.0), st.floats(0.0, 0.8))
@settings(max_examples=40)
def test_what_the_camera_sees_moves_one_step_at_a_time(num_views, length_m, row_m, swing_m):
    """No point that is `swing_m` ahead jumps: along rows it moves with the robot, on arcs less."""
    poses = mown(num_views, length_m, row_m, STEP_M, swing_m)
    assert poses.shape == (num_views, 3)
    np.testing.assert_array_equal(poses[0], 0.0)
    ahead = poses[:, :2] + swing_m * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    moved = np.hypot(*np.diff(ahead, axis=0).T)
    assert (moved <= STEP_M * 1.001).all()
    assert (poses[:, 0] >= -row_m / 2.0 - 1e-9).all()
    assert (poses[:, 0] <= length_m + row_m / 2.0 + 1e-9).all()


def test_rows_are_parallel_and_alternate():
    poses = mown(200, 3.0, ROW_M, STEP_M, SWING_M)
    straight = (poses[:, 0] > 0.01) & (poses[:, 0] < 2.99)
    row = poses[straight, 1] / ROW_M
    np.testing.assert_allclose(row, row.round(), atol=1e-9)
    np.testing.assert_allclose(np.cos(poses[straight, 2]), 1 - 2 * (row.round() % 2), atol=1e-9)
    assert set(row.round().astype(int)) == set(range(int(poses[-1, 1] / ROW_M + 0.5) + 1))
    along = np.diff(poses, axis=0)
    heading = np.arctan2(along[:, 1], along[:, 0])
    # A chord of an arc lies between the headings at its ends; steps turn by less than 45 deg.
    astray = np.angle(np.exp(1j * (heading - poses[:-1, 2])))
    assert np.abs(astray).max() < math.radians(45.0)


def test_a_lawn_needs_views_and_lengths():
    with pytest.raises(ValueError, match="0 views, length 1 m, row 1 m, step 1 m"):
        mown(0, 1.0, 1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="3 views, length 1 m, row 0 m, step 1 m"):
        mown(3, 1.0, 0.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="3 views, length 1 m, row 1 m, step nan m"):
        mown(3, 1.0, 1.0, math.nan, 1.0)


def test_four_robots_cover_a_field_and_meet_their_neighbours():
    tilts = (33.0, 45.0, 33.0, 45.0)
    cameras = [(name, camera(tilt)) for name, tilt in zip("ABCD", tilts, strict=True)]
    team = plan_lawn(cameras, 40, np.random.default_rng(3))
    views = [[view(robot.camera, pose) for pose in robot.world_from_base] for robot in team]
    for of_robot in views:
        assert len(of_robot) == 40
        assert min(true_overlap(*pair) for pair in itertools.pairwise(of_robot)) > 0.15
    met = {(i, j): len(meetings(views[i], views[j])) for i, j in ((0, 1), (0, 2), (1, 3), (2, 3))}
    assert min(met.values()) >= 3


def test_a_field_is_shared_out_in_blocks_that_share_their_borders():
    """Each robot's block begins two rows before the one beside it ends."""
    cameras = [(name, camera()) for name in "ABCD"]
    team = plan_lawn(cameras, 900, np.random.default_rng(3))
    places = [np.array([[p.x_m, p.y_m] for p in robot.world_from_base]) for robot in team]
    low, high = (np.array([end(at, axis=0) for at in places]) for end in (np.min, np.max))
    # Arcs stick out by half a row at the ends of rows, and the last row may not be whole.
    shared = 2.0 * 0.7 * 0.55
    assert high[0, 0] - low[1, 0] == pytest.approx(shared, abs=0.8 * 0.55)
    assert high[0, 1] - low[2, 1] == pytest.approx(shared, abs=0.8 * 0.55)
    assert high[2, 0] - low[3, 0] == pytest.approx(shared, abs=0.8 * 0.55)
    turned = [np.median(np.abs(np.cos([p.theta_rad for p in r.world_from_base]))) for r in team]
    np.testing.assert_allclose(np.round(turned), [1.0, 0.0, 0.0, 1.0])


def test_the_field_grows_with_the_team_and_its_density_does_not():
    """Four times the views: twice as wide, the same number of pictures per square metre."""

    def size(num_views):
        (robot,) = plan_lawn([("A", camera())], num_views, np.random.default_rng(0))
        places = np.array([[pose.x_m, pose.y_m] for pose in robot.world_from_base])
        return np.ptp(places, axis=0)

    assert np.prod(size(1600)) / np.prod(size(400)) == pytest.approx(4.0, rel=0.15)
    assert size(1600)[0] / size(1600)[1] == pytest.approx(1.0, abs=0.15)


def test_what_is_planned_follows_from_the_seed_and_needs_no_robot():
    cameras = [("A", camera())]
    assert plan_lawn(cameras, 5, np.random.default_rng(1)) == plan_lawn(
        cameras, 5, np.random.default_rng(1)
    )
    assert plan_lawn([], 5, np.random.default_rng(1)) == ()
