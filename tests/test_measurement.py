"""The border's values obey gtsam's laws, refuse what they can't be, and travel by pickle."""

import math
import pickle

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import (
    IDENTITY,
    Anchor,
    Attitude,
    Correspondences,
    EdgeVerdict,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
    TeamEstimate,
    checked_covariance,
    wrap_rad,
)

# Lengths up to 100 m, a dozen double operations: 100 x 2.2e-16 x 12 = 2.7e-13. Worst seen over
# 20,000 pairs 5.7e-14. gtsam keeps a heading as cosine and sine, which costs nothing more.
TOLERANCE = 1e-12

METRES = st.floats(-100.0, 100.0)
POSES = st.builds(Se2, METRES, METRES, st.floats(-math.pi, math.pi))
A, B = FrameId("A", 7), FrameId("B", 9)


def pose2(pose: Se2) -> gtsam.Pose2:
    return gtsam.Pose2(pose.x_m, pose.y_m, pose.theta_rad)


def assert_same(ours: Se2, theirs: gtsam.Pose2) -> None:
    assert ours.x_m == pytest.approx(theirs.x(), abs=TOLERANCE)
    assert ours.y_m == pytest.approx(theirs.y(), abs=TOLERANCE)
    turn = math.remainder(ours.theta_rad - theirs.theta(), 2 * math.pi)
    assert turn == pytest.approx(0.0, abs=TOLERANCE)
    assert -math.pi <= ours.theta_rad <= math.pi


@given(POSES, POSES)
def test_compose_and_inverse_are_those_of_gtsam(a_from_b, b_from_c):
    assert_same(a_from_b @ b_from_c, pose2(a_from_b) * pose2(b_from_c))
    assert_same(a_from_b.inverse(), pose2(a_from_b).inverse())
    assert_same(a_from_b.inverse() @ a_from_b, gtsam.Pose2())
    assert (a_from_b @ IDENTITY).vector() == pytest.approx(a_from_b.vector(), abs=0.0)


@given(POSES, st.lists(st.tuples(METRES, METRES), min_size=0, max_size=5))
def test_points_matrix_and_adjoint_are_those_of_gtsam(a_from_b, points):
    theirs = pose2(a_from_b)
    assert a_from_b.matrix() == pytest.approx(theirs.matrix(), abs=TOLERANCE)
    assert a_from_b.adjoint() == pytest.approx(theirs.AdjointMap(), abs=TOLERANCE)
    in_b = np.array(points, dtype=float).reshape(-1, 2)
    expected = [theirs.transformFrom(point) for point in in_b]
    assert a_from_b.apply(in_b) == pytest.approx(np.reshape(expected, (-1, 2)), abs=TOLERANCE)


@given(st.floats(-1e3, 1e3))
def test_wrapping_keeps_the_direction(angle):
    wrapped = wrap_rad(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.remainder(wrapped - angle, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    if abs(angle) <= math.pi:
        assert wrapped == angle


def edge(a_from_b=IDENTITY, covariance=None, **others):
    return RelativePose(A, B, a_from_b, np.eye(3) if covariance is None else covariance, **others)


@given(POSES, st.integers(0, 2**32 - 1))
def test_a_reversed_edge_is_the_same_factor(a_from_b, seed):
    """gtsam gives both directions one error at any nearby pose, whatever the direction."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) + 3 * np.eye(3)
    forward = edge(a_from_b, root @ root.T)
    backward = forward.reversed()
    assert (backward.a, backward.b) == (B, A)
    step = gtsam.Pose2.Expmap(1e-4 * rng.normal(size=3))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2())
    values.insert(1, pose2(a_from_b) * step)
    errors = []
    for measured, first, second in ((forward, 0, 1), (backward, 1, 0)):
        noise = gtsam.noiseModel.Gaussian.Covariance(measured.covariance)
        z = pose2(measured.a_from_b)
        errors.append(gtsam.BetweenFactorPose2(first, second, z, noise).error(values))
    # The adjoint takes a step of 1e-4 to 1e-2 m at 100 m, and its covariance is inverted with a
    # condition of 1e4 squared: 1e8 x 2.2e-16 / 1e-2. Worst seen over 3,000 edges 1.2e-6.
    assert errors[1] == pytest.approx(errors[0], rel=1e-4)


def test_an_edge_reversed_twice_is_itself():
    rays = np.arange(8.0).reshape(4, 2)
    pairs = Correspondences(rays, rays + 1, np.ones(4), np.full(4, 2.0))
    once = edge(
        Se2(1, 2, 3), np.diag([1.0, 2, 3]), num_inliers=4, ambiguity=0.5, correspondences=pairs
    )
    twice = once.reversed().reversed()
    assert twice.a_from_b.vector() == pytest.approx(once.a_from_b.vector(), abs=1e-15)
    assert twice.covariance == pytest.approx(once.covariance, abs=1e-13)
    assert (twice.num_inliers, twice.ambiguity) == (4, 0.5)
    assert len(pairs) == 4
    swapped = once.reversed().correspondences
    assert swapped is not None
    assert np.array_equal(swapped.rays_a, pairs.rays_b)
    assert np.array_equal(swapped.rays_b, pairs.rays_a)
    assert np.array_equal(swapped.sigma_a, pairs.sigma_b)
    assert np.array_equal(swapped.sigma_b, pairs.sigma_a)
    assert edge().reversed().correspondences is None


@pytest.mark.parametrize("values", [(math.nan, 0, 0), (0, math.inf, 0), (0, 0, -math.inf)])
def test_a_pose_must_be_finite(values):
    with pytest.raises(ValueError, match=r"^a pose must be finite, got "):
        Se2(*values)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(2), r"must be 3x3, got shape \(2, 2\)$"),
        (np.diag([1, math.nan, 1]), r"is not finite$"),
        (np.eye(3) + np.eye(3, k=1), r"is not symmetric$"),
        (np.diag([1.0, 1.0, 0.0]), r"must be positive definite, its smallest eigenvalue is 0$"),
        (np.diag([1.0, -2.0, 1.0]), r"must be positive definite, its smallest eigenvalue is -2$"),
    ],
)
def test_what_is_no_covariance(covariance, message):
    with pytest.raises(ValueError, match=r"^covariance of edge A7-B9 " + message):
        edge(covariance=covariance)
    with pytest.raises(ValueError, match=r"^covariance of an anchor " + message):
        checked_covariance(covariance, "an anchor")


def test_a_self_loop_is_refused():
    with pytest.raises(ValueError, match=r"^an edge needs two different frames, got A7 twice$"):
        RelativePose(A, A, IDENTITY, np.eye(3))


def test_frames_sort_and_speak():
    assert sorted([B, FrameId("A", 10), A]) == [A, FrameId("A", 10), B]
    assert str(A) == "A7"


def plain(value):
    """Turn a value into what == compares whole."""
    if isinstance(value, np.ndarray):
        return (value.dtype, value.tolist())
    if isinstance(value, dict):
        return [(key, plain(entry)) for key, entry in value.items()]
    if isinstance(value, tuple):
        return [plain(entry) for entry in value]
    if hasattr(value, "__dataclass_fields__"):
        return [plain(getattr(value, name)) for name in value.__dataclass_fields__]
    return value


@pytest.mark.parametrize(
    "value",
    [
        A,
        Se2(1, 2, 3),
        Attitude(0.1, 0.2, 0.3),
        Correspondences(np.ones((2, 2)), np.zeros((2, 2)), np.ones(2), np.ones(2)),
        edge(Se2(1, 2, 3), np.diag([1.0, 2.0, 3.0]), num_inliers=3),
        Rejected(A, B, Reason.AMBIGUOUS, 0.9, 0.6),
        EdgeVerdict(A, B, accepted=False, chi2=20.0, limit=11.3),
        Anchor("B", 0, 0, B, Se2(1, 2, 3), np.eye(3), 2),
        TeamEstimate({A: IDENTITY}, {A: 0}, {}, (), (), 0.0, 0),
    ],
    ids=lambda value: type(value).__name__,
)
def test_border_values_travel_by_pickle_and_are_frozen(value):
    copied = pickle.loads(pickle.dumps(value))  # noqa: S301 (our own)
    assert type(copied) is type(value)
    assert plain(copied) == plain(value)
    name = next(iter(value.__dataclass_fields__))
    with pytest.raises(AttributeError):
        setattr(value, name, None)
