"""The bulk algebra of planar motions against gtsam, Se2 and numeric derivatives."""

import gtsam
import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from groundfuse.backend import planar
from groundfuse.backend.measurement import Se2, wrap_rad

# Doubles of size 10 through a handful of products: 10 x 1e-16 x 1e2; worst seen 3e-14.
EXACT = 1e-12
# gtsam's own logarithm loses digits below 1e-6 rad: 10 x 6e-8 / 2 without its second term.
GTSAM = 1e-6
# Central differences, step 1e-6: truncation 1e-12, rounding 1e-16 / 1e-6 x 10; worst seen 3e-9.
NUMERIC = 1e-7

angle = st.floats(-3.1, 3.1)
length = st.floats(-10.0, 10.0)
pose = st.builds(lambda x, y, t: np.array([x, y, t]), length, length, angle)


def same(one, two, tolerance=EXACT):
    difference = np.abs(np.asarray(one) - np.asarray(two))
    difference[..., 2] = np.abs(planar.wrapped(np.asarray(one - two)[..., 2]))
    return bool((difference <= tolerance).all())


def gtsam_tolerance(theta):
    """gtsam divides a rounding error by theta: 1e-5 m seen at theta = 1e-10, 8 m away."""
    return GTSAM + 100.0 * np.finfo(float).eps / max(abs(theta), 1e-10)


@given(pose, pose)
def test_the_bulk_algebra_is_that_of_se2(p, q):
    one, two = planar.pose(p), planar.pose(q)
    assert same(planar.compose(p, q), (one @ two).vector())
    assert same(planar.inverse(p), one.inverse().vector())
    assert same(planar.between(p, q), (one.inverse() @ two).vector())
    assert np.allclose(planar.adjoint(p), one.adjoint(), atol=EXACT)


@example(np.array([0.0, 4.0, 1e-4]))
@given(pose)
def test_log_and_exp_are_gtsams_and_undo_each_other(p):
    expected = gtsam.Pose2.Logmap(gtsam.Pose2(*p))
    assert same(planar.log(p), expected, gtsam_tolerance(p[2]))
    assert same(planar.exp(planar.log(p)), p)


@given(pose, st.floats(-2e-4, 2e-4))
def test_log_and_exp_are_smooth_where_the_series_takes_over(p, theta):
    p = np.array([p[0], p[1], theta])
    # The series is cut after theta^4/720: 10 x (1e-4)^4; gtsam's own threshold is elsewhere.
    assert same(planar.log(p), gtsam.Pose2.Logmap(gtsam.Pose2(*p)), gtsam_tolerance(theta))
    assert same(planar.exp(planar.log(p)), p, 1e-10)


@given(pose, pose)
def test_the_adjoint_moves_a_tangent_to_the_other_side(p, d):
    d = d * 0.1
    right = planar.compose(p, planar.exp(d))
    left = planar.compose(planar.exp(planar.adjoint(p) @ d), p)
    assert same(right, left, 1e-10)


@given(pose)
def test_by_right_is_the_derivative_of_the_logarithm(p):
    tangent = planar.log(p)
    step = 1e-6
    columns = [
        (
            planar.log(planar.compose(p, planar.exp(step * axis)))
            - planar.log(planar.compose(p, planar.exp(-step * axis)))
        )
        / (2 * step)
        for axis in np.eye(3)
    ]
    # Near a half turn log itself bends by x / (pi - theta)^2.
    assert np.allclose(planar.by_right(tangent), np.array(columns).T, atol=NUMERIC * 1e2)


@given(st.floats(-3.14159, 3.14159))
def test_wrapping_leaves_what_is_inside_alone(theta):
    assert planar.wrapped(np.array([theta]))[0] == theta == wrap_rad(theta)


@given(st.floats(-100.0, 100.0))
def test_wrapping_ends_inside_at_the_same_direction(theta):
    inside = float(planar.wrapped(np.array([theta]))[0])
    assert -np.pi <= inside <= np.pi
    assert np.isclose(np.cos(inside), np.cos(theta), atol=1e-12)
    assert np.isclose(np.sin(inside), np.sin(theta), atol=1e-12)


def test_mahalanobis_of_a_known_vector():
    covariance = np.diag([4.0, 9.0, 0.25])[None]
    assert planar.mahalanobis2(np.array([[2.0, 3.0, 0.5]]), covariance)[0] == 3.0


def test_rows_and_poses_are_the_same_numbers():
    poses = [Se2(1.0, 2.0, 3.0), Se2(-1.0, 0.5, -0.25)]
    assert [planar.pose(row) for row in planar.stacked(poses)] == poses
    assert planar.stacked([]).shape == (0, 3)
