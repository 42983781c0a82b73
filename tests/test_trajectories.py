"""Loops come back, neighbours see common floor, robots meet."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from world_cameras import camera, view

from groundfuse.backend.measurement import IDENTITY
from groundfuse.tools.overlap import true_overlap
from groundfuse.tools.trajectories import count_places, loop, meetings, plan_team


@given(st.integers(2, 60), st.floats(0.05, 30.0), st.integers(0, 999), st.integers(1, 3))
@settings(max_examples=30)
def test_a_loop_starts_at_the_origin_goes_in_even_steps_and_comes_back(views, step_m, seed, laps):
    poses = loop(views * laps, step_m, np.random.default_rng(seed), laps)
    assert poses[0] == IDENTITY
    places = np.array([[p.x_m, p.y_m] for p in poses])
    steps = np.hypot(*np.diff(places, axis=0).T)
    assert steps.max() <= step_m * 1.001  # a chord is no longer than its arc
    assert steps.min() >= step_m * 0.95
    along = np.arctan2(*np.diff(places, axis=0).T[::-1])
    heading = np.array([p.theta_rad for p in poses])
    # A chord lies between the headings at its ends: half a turn of 30 deg and the draws' 2 deg.
    astray = np.angle(np.exp(1j * (along - heading[:-1])))
    assert np.abs(astray).max() < math.radians(45.0)
    if views >= 13:
        assert np.hypot(*places[-1]) <= step_m


def test_a_loop_needs_views_and_a_step():
    for views, step, laps in [(0, 0.1, 1), (3, 0.0, 1), (3, 0.1, 0), (3, math.nan, 1)]:
        with pytest.raises(ValueError, match=f"{views} views, {laps} laps, step {step:g} m"):
            loop(views, step, np.random.default_rng(0), laps)


def test_meeting_places_are_counted_around_the_loops():
    assert count_places([], (13, 13)) == 0
    assert count_places([(0, 0), (12, 12), (1, 0)], (13, 13)) == 1
    assert count_places([(0, 0), (2, 0), (4, 4), (5, 3)], (13, 13)) == 3
    assert count_places([(3, 0), (3, 12), (3, 2)], (13, 13)) == 2
    assert count_places([(3, 0), (3, 6)], (13, 7)) == 1
    assert count_places([(0, 3), (6, 3)], (13, 7)) == 2


def test_a_planned_team_meets_and_each_robot_sees_its_neighbours():
    cameras = [("A", camera()), ("B", camera(45.0)), ("C", camera(30.0, 0.7))]
    team = plan_team(cameras, 13, np.random.default_rng(11))
    views = [[view(robot.camera, pose) for pose in robot.world_from_base] for robot in team]
    for of_robot in views:
        shares = [true_overlap(*pair) for pair in itertools.pairwise(of_robot)]
        assert len(of_robot) == 13
        assert min(shares) > 0.2
        assert 0.35 < np.mean(shares) < 0.7
        assert true_overlap(of_robot[0], of_robot[-1]) > 0.4
    places = np.array(
        [[count_places(meetings(a, b), (13, 13)) for a in views[:k]] for k, b in enumerate(views)][
            2
        ]
    )
    assert count_places(meetings(views[0], views[1]), (13, 13)) in (2, 3)
    assert set(places) & {2, 3}
