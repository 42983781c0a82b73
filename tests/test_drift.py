"""Drift measures of trajectories whose errors are known by construction."""

import math

import numpy as np
import pytest
from graph_world import edge

from groundfuse.backend import drift, planar
from groundfuse.backend.measurement import FrameId, Se2

# Sums of a few dozen doubles of size 10; worst seen 5e-15.
EXACT = 1e-12


def square(robot="A", side=3):
    """Frames 1 m apart around a square, back at the start: 4 side + 1 frames."""
    poses, pose = {}, Se2(0.0, 0.0, 0.0)
    for k in range(4 * side + 1):
        poses[FrameId(robot, k)] = pose
        turn = math.pi / 2 if k % side == side - 1 else 0.0
        pose = pose @ Se2(1.0, 0.0, turn)
    return poses


def moved(poses, team_from_map):
    return {f: team_from_map @ p for f, p in poses.items()}


def test_the_closing_error_is_the_papers():
    poses = square()
    first, last = FrameId("A", 0), FrameId("A", 12)
    measured = poses[first].inverse() @ poses[last] @ Se2(0.3, 0.4, 0.1)
    result = drift.closing(poses, [edge(first, last, measured)], "A")
    assert result == pytest.approx((first, last, 0.5, 0.1, 12.0, 100 * 0.5 / 12.0), abs=EXACT)


def test_the_closing_error_is_over_the_widest_loop_in_either_direction():
    poses = square()
    names = sorted(poses)
    loops = [edge(names[2], names[9], poses[names[2]].inverse() @ poses[names[9]]),
             edge(names[11], names[0], poses[names[11]].inverse() @ poses[names[0]]),
             edge(names[0], names[1], Se2(9.0, 9.0, 0.0))]  # fmt: skip
    result = drift.closing(poses, loops, "A")
    assert result is not None
    assert (result.first, result.last) == (names[0], names[11])
    assert result.error_m == pytest.approx(0.0, abs=EXACT)
    assert result.path_m == pytest.approx(11.0)


def test_without_a_loop_there_is_no_closing_error():
    poses = square()
    names = sorted(poses)
    assert drift.closing(poses, [edge(names[0], names[1], Se2(1, 0, 0))], "A") is None
    assert drift.closing(poses, [], "A") is None
    stranger = edge(names[0], FrameId("A", 99), Se2(1, 0, 0))
    assert drift.closing(poses, [stranger], "A") is None


def test_truth_in_another_frame_has_no_error():
    truth = square()
    result = drift.accuracy(moved(truth, Se2(5.0, -2.0, 2.5)), truth)
    assert result is not None
    assert (result.num_frames, result.path_m) == (13, pytest.approx(12.0))
    errors = (result.ate_m, result.ate_percent, result.heading_rad, result.ate_scaled_m,
              result.rpe_m_per_m, result.rpe_rad_per_m)  # fmt: skip
    assert errors == pytest.approx((0.0,) * 6, abs=1e-10)
    assert result.scale == pytest.approx(1.0)


def test_scale_is_told_apart_from_shape():
    truth = square()
    shrunk = {f: Se2(0.9 * p.x_m, 0.9 * p.y_m, p.theta_rad) for f, p in truth.items()}
    result = drift.accuracy(moved(shrunk, Se2(1.0, 2.0, -3.0)), truth)
    assert result is not None
    assert result.scale == pytest.approx(1.0 / 0.9)
    assert result.ate_scaled_m == pytest.approx(0.0, abs=1e-10)
    xy = planar.stacked([truth[f] for f in sorted(truth)])[:, :2]
    spread = math.sqrt(((xy - xy.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert result.ate_m == pytest.approx(0.1 * spread)
    assert result.rpe_m_per_m == pytest.approx(0.1)


def test_errors_of_position_and_heading_are_root_mean_squares():
    truth = square()
    names = sorted(truth)
    signs = [1.0 if k % 2 else -1.0 for k in range(len(names))]
    turned = {f: truth[f] @ Se2(0.0, 0.0, 0.02 * s) for f, s in zip(names, signs, strict=True)}
    result = drift.accuracy(turned, truth)
    assert result is not None
    assert result.ate_m == pytest.approx(0.0, abs=EXACT)
    assert result.heading_rad == pytest.approx(0.02)
    assert result.rpe_rad_per_m == pytest.approx(0.04)


def test_accuracy_needs_two_frames():
    truth = square()
    assert drift.accuracy({FrameId("A", 0): Se2(0, 0, 0)}, truth) is None
    assert drift.accuracy({}, truth) is None


def test_a_displaced_robot_shows_between_robots_only():
    truth = square("A") | moved(square("B"), Se2(4.0, 0.0, 0.0))
    wrong = square("A") | moved(square("B"), Se2(4.3, 0.4, 0.0))
    result = drift.between_robots(wrong, truth)
    assert result == pytest.approx((13 * 13, 0.5, 0.0), abs=1e-10)
    alone = drift.accuracy({f: p for f, p in wrong.items() if f.robot == "B"}, truth)
    assert alone is not None
    assert alone.ate_m == pytest.approx(0.0, abs=1e-10)


def test_between_robots_needs_two_robots():
    assert drift.between_robots(square(), square()) is None
    assert drift.between_robots({}, {}) is None


def test_many_frames_are_thinned_not_refused():
    number = np.arange(3000)
    truth = {FrameId(r, int(k)): Se2(float(k), 0.0, 0.0) for r in "AB" for k in number}
    wrong = {f: p if f.robot == "A" else Se2(p.x_m, 0.25, 0.0) for f, p in truth.items()}
    result = drift.between_robots(wrong, truth)
    assert result is not None
    assert result.num_pairs <= drift.MAX_FRAMES**2
    assert result.rms_m == pytest.approx(0.25)


def test_a_robot_that_stands_still_has_no_path():
    still = {FrameId("A", k): Se2(1.0, 1.0, 0.0) for k in range(3)}
    result = drift.accuracy(still, still)
    assert result is not None
    assert (result.path_m, result.ate_m, result.scale) == (0.0, 0.0, 1.0)
    assert result.ate_percent == math.inf
    assert result.rpe_m_per_m == math.inf
