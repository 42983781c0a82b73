"""Guided matching follows what an isometry cannot, and no wrong corner bends the homography."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.decomposition import floor_homography
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.refine import (
    RefineOptions,
    fitted_homography,
    guided_matches,
    num_in_common,
    refined_homography,
    transferred,
)

A = Attitude(math.radians(33), 0.0, 0.55)
B = Attitude(math.radians(45), 0.0, 0.55)
MOTION = Se2(0.15, 0.05, 0.4)
FOCAL_PX = 520.0
# Normal equations square the condition of the design (below 1e3 when normalised): 2.2e-16 x 1e6;
# worst seen 6e-12.
TOLERANCE_RAY = 1e-9


def corners(seed=0, count=250, true_a=A, true_b=B):
    """Rays in both cameras of floor points that both see, shuffled, with distinct invariants."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform((0.1, -0.4), (0.9, 0.4), (count, 2))
    rays_a = rays_from_floor(true_a, floor)
    rays_b = rays_from_floor(true_b, MOTION.inverse().apply(floor))
    order = rng.permutation(count)
    described = rng.random((count, 6))
    return (rays_a, rays_b[order]), (described, described[order]), np.argsort(order)


def best_isometry(rays_a, rays_b):
    """Least-squares motion between floor points at the nominal attitudes."""
    a, b = (floor_from_rays(t, r) @ [1.0, 1.0j] for t, r in ((A, rays_a), (B, rays_b)))
    turn = np.sum((a - a.mean()) * np.conj(b - b.mean()))
    shift = a.mean() - turn / abs(turn) * b.mean()
    return Se2(shift.real, shift.imag, math.atan2(turn.imag, turn.real))


@given(st.integers(0, 99), st.floats(0.01, 100.0))
def test_four_points_or_more_determine_the_homography(seed, size):
    rng = np.random.default_rng(seed)
    truth = np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))
    rays_a = rng.uniform(-1, 1, (12, 2)) * size + 3.0 * size
    truth = truth @ np.diag([1 / size, 1 / size, 4.0])
    rays_b = transferred(truth, rays_a)
    got = fitted_homography(rays_a, rays_b)
    np.testing.assert_allclose(transferred(got, rays_a), rays_b, atol=TOLERANCE_RAY, rtol=1e-9)


def test_three_points_are_refused():
    with pytest.raises(ValueError, match="a homography needs 4 points, got 3"):
        fitted_homography(np.zeros((3, 2)), np.zeros((3, 2)))


@pytest.mark.parametrize("scale", [1.0, -2.0])
def test_transfer_does_not_mind_the_scale_and_drops_what_is_behind(scale):
    homography = scale * floor_homography(A, MOTION, B)
    floor = np.array([[0.5, 0.0], [0.6, 0.1], [0.4, 0.1], [-0.65, 0.0]])
    rays_a = rays_from_floor(A, floor)
    expected = rays_from_floor(B, MOTION.inverse().apply(floor))
    assert np.isnan(expected[3]).all()
    np.testing.assert_allclose(transferred(homography, rays_a), expected, atol=1e-12)


def test_guided_matches_are_the_closest_like_corners_one_to_one():
    rays, described, index = corners()
    got = guided_matches(floor_homography(A, MOTION, B), rays, described, 0.02, RefineOptions())
    np.testing.assert_array_equal(got.index_b, index[got.index_a])
    assert len(got.index_a) == len(rays[0])
    twice = (np.vstack([rays[0], rays[0] + 1e-4]), rays[1])
    both = (np.vstack([described[0], described[0]]), described[1])
    got = guided_matches(floor_homography(A, MOTION, B), twice, both, 0.02, RefineOptions())
    assert len(np.unique(got.index_b)) == len(got.index_b)
    assert (got.index_a < len(rays[0])).all()


def test_an_unlike_corner_is_passed_over_for_the_next_closest():
    rays_a, rays_b = np.array([[0.0, 0.1]]), np.array([[0.001, 0.1], [0.004, 0.1], [0.0, 0.2]])
    described = np.zeros((1, 6)), np.array([[1.0] * 6, [0.0] * 6, [0.0] * 6])
    got = guided_matches(np.eye(3), (rays_a, rays_b), described, 0.02, RefineOptions())
    assert (got.index_a.tolist(), got.index_b.tolist()) == ([0], [1])
    got = guided_matches(np.eye(3), (rays_a, rays_b), described, 0.006, RefineOptions())
    assert len(got.index_a) == 0


def test_the_window_is_square():
    rays_a, rays_b = np.array([[0.0, 0.0]]), np.array([[0.009, 0.009]])
    described = np.zeros((1, 6)), np.zeros((1, 6))
    got = guided_matches(np.eye(3), (rays_a, rays_b), described, 0.02, RefineOptions())
    assert len(got.index_a) == 1


@pytest.mark.parametrize("seed", range(5))
def test_wobble_is_followed_through_noise_and_clutter(seed):
    rng = np.random.default_rng(seed)
    true_a = Attitude(A.tilt_rad + 0.009, 0.003, 0.553)
    true_b = Attitude(B.tilt_rad - 0.009, -0.003, 0.548)
    rays, described, index = corners(seed, 250, true_a, true_b)
    noisy = tuple(r + rng.normal(scale=0.4 / FOCAL_PX, size=r.shape) for r in rays)
    clutter = rays_from_floor(B, rng.uniform((0.0, -0.4), (0.9, 0.4), (150, 2)))
    all_b = np.vstack([noisy[1], clutter])
    described_b = np.vstack([described[1], rng.random((150, 6))])
    start = floor_homography(A, best_isometry(rays[0], rays[1][index]), B)
    before = np.linalg.norm(transferred(start, rays[0]) - rays[1][index], axis=1)
    got = refined_homography(start, (noisy[0], all_b), (described[0], described_b), FOCAL_PX)
    right = got.index_b == index[got.index_a]
    assert np.median(before) * FOCAL_PX > 2.5
    assert len(got.index_a) > 220
    assert right.mean() > 0.97
    after = np.linalg.norm(transferred(got.b_from_a, rays[0]) - rays[1][index], axis=1)
    # 8 parameters from 240 points with 0.6 px per axis: 0.6 sqrt(2) sqrt(4 / 240) = 0.11 px; the
    # border three times that; worst of 50 seeds 0.21 px.
    assert np.median(after) * FOCAL_PX < 0.3


def test_no_match_at_all_is_no_error():
    rays, described, _ = corners()
    unlike = described[0], described[1] + 9.0
    got = refined_homography(floor_homography(A, MOTION, B), rays, unlike, FOCAL_PX)
    assert len(got.index_a) == 0


def test_corners_in_common_are_counted_where_both_look():
    rays, _, _ = corners()
    homography = floor_homography(A, MOTION, B)
    assert num_in_common(homography, *rays) == len(rays[0])
    away = floor_homography(A, Se2(5.0, 0.0, 0.0), B)
    assert num_in_common(away, *rays) == 0
