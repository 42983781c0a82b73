"""The bundle's camera against the front-end's, `transfer` and differences."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.bundle_cut import link_chi2
from groundfuse.backend.bundle_model import (
    State,
    derivatives,
    floor_points,
    moved,
    residuals,
)
from groundfuse.backend.bundle_setup import with_points
from groundfuse.backend.bundle_tracks import Links, Sightings, observations
from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.backend.reprojection import transfer
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor

# Two routes to one ray in double precision: eps x 1e2 (depth over 0.05 heights), worst seen 9e-14.
TOLERANCE_RAY = 1e-11
# Central differences with step 1e-6: see test_reprojection.py; worst seen 2e-7.
TOLERANCE_DERIVATIVE = 4e-6
STEP = 1e-6
ROBOT_OF = np.array([0, 1])

attitudes = st.tuples(st.floats(-0.9, 0.9), st.floats(-0.3, 0.3), st.floats(0.3, 3.0))
poses = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1))
lenses = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))


def seen_from(pose, attitude, lens, seed):
    """Two frames (the second is under test) and what the second sees of random points."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform(-2, 2, (300, 2))
    rays = rays_from_floor(Attitude(*attitude), Se2(*pose).inverse().apply(floor))
    inside = (np.abs(rays) < 1.0).all(axis=1)
    floor, rays = floor[inside], rays[inside]
    gain = rng.uniform(0.8, 1.4, len(rays))
    bulge = 1 + lens[1] * (rays**2).sum(axis=1)
    measured = rays * ((1 + gain * lens[0]) * bulge)[:, None]
    frame = np.ones(len(rays), dtype=np.int64)
    sightings = Sightings(frame, measured, np.full(len(rays), 1e-3), gain)
    seen = observations(sightings, np.arange(len(rays)), np.arange(len(rays)), 2)
    shared = np.zeros((2, 6))
    shared[1, 3:5] = lens
    state = State(
        np.array([(0.0, 0.0, 0.0), pose]),
        np.array([(0.1, 0.0, 1.0), attitude]),
        shared,
        np.pad(floor, ((0, 0), (0, 1))),
    )
    return seen, state


@given(poses, attitudes, lenses, st.integers(0, 99))
def test_the_truth_has_no_residual(pose, attitude, lens, seed):
    seen, state = seen_from(pose, attitude, lens, seed)
    residual, unseen = residuals(seen, state, ROBOT_OF)
    assert not unseen.any()
    np.testing.assert_allclose(residual, 0.0, atol=TOLERANCE_RAY)


@given(poses, attitudes, attitudes, st.integers(0, 99))
def test_derivatives_agree_with_the_transfer(pose, attitude, other, seed):
    seen, state = seen_from(pose, attitude, (0.0, 0.0), seed)
    floor = state.point[seen.point, :2]
    rays_a = rays_from_floor(Attitude(*other), floor)
    good = np.isfinite(rays_a).all(axis=1) & (np.abs(rays_a) < 2.0).all(axis=1)
    expected = transfer(rays_a, np.array(other), np.array(pose), np.array(attitude))
    found = derivatives(seen, state, ROBOT_OF, np.ones(len(seen.frame)), size=2, lens=False)
    by_frame = found.by_frame
    assert found.by_lens.size == 0
    scale = 1.0 + np.abs(by_frame[good])
    wanted = np.concatenate([expected.by_pose, expected.by_attitude_b], axis=2)[good]
    np.testing.assert_allclose(by_frame[good] / scale, wanted / scale, atol=1e-8)


@given(poses, attitudes, lenses, st.integers(0, 99))
def test_derivatives_agree_with_differences(pose, attitude, lens, seed):
    seen, state = seen_from(pose, attitude, lens, seed)
    state.point[:, 2] = np.random.default_rng(seed).normal(0, 0.02, len(state.point))
    found = derivatives(seen, state, ROBOT_OF, np.ones(len(seen.frame)), size=3, lens=True)

    def changed(node, axis, size):
        step = np.zeros((4, 6))
        step[node, axis] = size
        return residuals(seen, moved(state, step, np.zeros_like(state.point)), ROBOT_OF)[0]

    def point_changed(axis, size):
        step = np.zeros_like(state.point)
        step[:, axis] = size
        return residuals(seen, moved(state, np.zeros((4, 6)), step), ROBOT_OF)[0]

    cases = [(found.by_frame[:, :, k], lambda s, k=k: changed(1, k, s)) for k in range(6)]
    cases += [(found.by_lens[:, :, k], lambda s, k=k: changed(3, 3 + k, s)) for k in range(2)]
    cases += [(found.by_point[:, :, k], lambda s, k=k: point_changed(k, s)) for k in range(3)]
    for analytic, at in cases:
        numeric = (at(-STEP) - at(STEP)) / (2 * STEP)  # a residual falls as the prediction grows
        assert (np.abs(analytic - numeric) / (1 + np.abs(analytic)) < TOLERANCE_DERIVATIVE).all()


@given(poses, attitudes, st.integers(0, 99))
def test_rays_meet_the_floor_where_the_front_end_says(pose, attitude, seed):
    seen, state = seen_from(pose, attitude, (0.0, 0.0), seed)
    found = floor_points(seen.frame, seen.ray, seen.gain, state, ROBOT_OF)
    expected = Se2(*pose).apply(floor_from_rays(Attitude(*attitude), seen.ray))
    np.testing.assert_allclose(found.point, expected, atol=TOLERANCE_RAY * 100)
    foot = np.array(pose[:2])
    np.testing.assert_allclose(found.point, foot + found.slope * attitude[2], atol=1e-12)
    for axis in range(2):
        step = np.eye(2)[axis] * STEP
        plus = floor_points(seen.frame, seen.ray + step, seen.gain, state, ROBOT_OF).point
        minus = floor_points(seen.frame, seen.ray - step, seen.gain, state, ROBOT_OF).point
        numeric, analytic = (plus - minus) / (2 * STEP), found.by_ray[:, :, axis]
        scale = 1.0 + np.abs(analytic) ** 1.5  # the third derivative grows faster than the first
        assert (np.abs(analytic - numeric) / scale < 10 * TOLERANCE_DERIVATIVE).all()


def test_the_lens_is_taken_off_before_rays_meet_the_floor():
    # The inverse is to first order in the distortion: 0.01^2 x radius^4 of a ray of length 0.5.
    seen, state = seen_from((0.3, -0.2, 1.0), (0.5, 0.05, 0.8), (0.01, 0.01), 1)
    true = state.point[seen.point, :2]
    points = floor_points(seen.frame, seen.ray, seen.gain, state, ROBOT_OF).point
    np.testing.assert_allclose(points, true, atol=3e-3)
    plain = floor_points(seen.frame, seen.ray, seen.gain, with_shared(state, 0.0), ROBOT_OF).point
    assert np.abs(points - true).max() < np.abs(plain - true).max() / 20


@given(poses, attitudes, st.integers(0, 99))
def test_points_begin_at_the_weighted_mean_of_where_their_rays_land(pose, attitude, seed):
    seen, state = seen_from(pose, attitude, (0.0, 0.0), seed)
    rng = np.random.default_rng(seed)
    seen = replace(
        seen,
        ray=seen.ray + rng.normal(0.0, 1e-3, seen.ray.shape),
        sigma=rng.uniform(0.5, 2.0, len(seen.ray)),
        point=rng.integers(0, 2, len(seen.ray)),
        num_points=3,
    )
    landing = floor_points(seen.frame, seen.ray, seen.gain, state, ROBOT_OF)
    found = with_points(state, seen, ROBOT_OF).point
    for point in range(3):
        mine = seen.point == point
        spread = landing.by_ray[mine] @ landing.by_ray[mine].transpose(0, 2, 1)
        information = np.linalg.inv(spread * seen.sigma[mine, None, None] ** 2)
        pulled = (information @ landing.point[mine][:, :, None]).sum(axis=0)[:, 0]
        wanted = np.linalg.solve(information.sum(axis=0), pulled) if mine.any() else np.zeros(2)
        # Both routes invert, and a camera at 0.9 rad sees rays near its horizon.
        np.testing.assert_allclose(found[point], [*wanted, 0.0], rtol=1e-8, atol=1e-9)


@given(poses, attitudes, st.integers(0, 99), st.floats(0.0, 0.05))
def test_ends_meet_by_the_variance_of_both_and_the_reliefs(pose, attitude, seed, relief):
    seen, state = seen_from(pose, attitude, (0.0, 0.0), seed)
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(1e-3, 2e-3, len(seen.ray))
    rays = seen.ray + rng.normal(0.0, 1e-3, seen.ray.shape)
    sightings = Sightings(seen.frame, rays, sigma, seen.gain)
    a, b = rng.permutation(len(rays)), rng.permutation(len(rays))
    links = Links(a, b, np.zeros_like(a))
    priors = SimpleNamespace(relief=relief, robot_of=ROBOT_OF)
    found = link_chi2(links, sightings, state, priors, 1.3)
    landing = floor_points(seen.frame, rays, seen.gain, state, ROBOT_OF)
    for one, other, chi2 in zip(a.tolist(), b.tolist(), found.tolist(), strict=True):
        apart = landing.point[one] - landing.point[other]
        slope = landing.slope[one] - landing.slope[other]
        tilted = relief * state.attitude[seen.frame[one], 2] * slope
        spread = np.outer(tilted, tilted)
        for end in (one, other):
            spread += landing.by_ray[end] @ landing.by_ray[end].T * (1.3 * sigma[end]) ** 2
        np.testing.assert_allclose(chi2, apart @ np.linalg.solve(spread, apart), rtol=1e-7)


def with_shared(state, value):
    return State(state.pose, state.attitude, np.full_like(state.shared, value), state.point)


def test_a_point_behind_the_camera_is_unseen():
    seen, state = seen_from((0.0, 0.0, 0.0), (0.8, 0.0, 0.5), (0.0, 0.0), 2)
    away = State(state.pose, state.attitude, state.shared, state.point - np.array([50.0, 0.0, 0.0]))
    _, unseen = residuals(seen, away, ROBOT_OF)
    assert unseen.all()
    landing = floor_points(np.array([1]), np.array([[0.0, -3.0]]), None, state, ROBOT_OF)
    assert np.isnan(landing.point).all()


def test_a_point_above_the_floor_is_seen_as_by_a_lower_camera():
    seen, state = seen_from((0.2, 0.1, -2.0), (0.6, 0.1, 0.9), (0.0, 0.0), 3)
    raised, lowered = state.point.copy(), state.attitude.copy()
    raised[:, 2], lowered[1, 2] = 0.2, 0.7
    found, _ = residuals(seen, State(state.pose, state.attitude, state.shared, raised), ROBOT_OF)
    wanted, _ = residuals(seen, State(state.pose, lowered, state.shared, state.point), ROBOT_OF)
    np.testing.assert_allclose(found, wanted, atol=1e-14)


def test_a_step_perturbs_the_pose_on_the_right():
    pose = Se2(0.4, -0.3, 2.0)
    state = State(np.array([pose.vector()]), np.zeros((1, 3)), np.zeros((1, 6)), np.ones((1, 3)))
    step = np.array([[1e-3, -2e-3, 0.01, 0.1, 0.2, 0.3], [0.0, 0.0, 0.0, 0.5, 0.6, 0.0]])
    after = moved(state, step, np.array([[0.5, 0.25]]))
    np.testing.assert_array_equal(after.point, [[1.5, 1.25, 1.0]])
    expected = pose @ Se2(1e-3, -2e-3, 0.0) @ Se2(0.0, 0.0, 0.01)
    np.testing.assert_allclose(after.pose[0], expected.vector(), atol=1e-15)
    np.testing.assert_array_equal(after.attitude, [[0.1, 0.2, 0.3]])
    assert math.isclose(after.shared[0, 3], 0.5)
    assert math.isclose(after.shared[0, 4], 0.6)
