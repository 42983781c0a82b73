"""Equal segments with equal profiles vote for the isometry between two overhead views."""

import math

import cv2
import numpy as np
import pytest

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.overhead_view import OverheadGrid
from groundfuse.frontend.segments import (
    Candidates,
    Scene,
    SegmentOptions,
    SegmentView,
    matched_segments,
    nearest_candidates,
    profile,
    voted,
)

CELL_M = 0.002
GRID = OverheadGrid(CELL_M, 0.5, 0.4, 400, 500, 9.0)
MOTION = Se2(0.12, -0.07, math.radians(25.0))
OPTIONS = SegmentOptions(num_draws=60_000)


def texture():
    noise = np.random.default_rng(3).normal(size=(900, 900)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return 128 + 40 * smooth / smooth.std()


def view_of(floor, view_from_world, points_in_world):
    """The overhead view GRID of a floor painted on the world, and points as the view has them."""
    u, v = np.meshgrid(np.arange(GRID.width_px), np.arange(GRID.height_px))
    cells = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    world = view_from_world.inverse().apply(GRID.floor_from_overhead(cells))
    at = (450.0 - world / CELL_M).astype(np.float32).reshape(GRID.height_px, GRID.width_px, 2)
    grey = cv2.remap(floor, at[..., 1].copy(), at[..., 0].copy(), cv2.INTER_LINEAR)
    here = view_from_world.apply(points_in_world)
    return SegmentView(here, GRID.overhead_from_floor(here), grey, CELL_M)


def scene(num_right=40, num_wrong=360, world_from_b=MOTION):
    """View a is the world; of all candidates `num_right` are right, one per point."""
    rng = np.random.default_rng(11)
    count = num_right + num_wrong
    world = rng.uniform(-0.25, 0.3, (count, 2))
    floor = texture()
    a = view_of(floor, Se2(0.0, 0.0, 0.0), world)
    b = view_of(floor, world_from_b.inverse(), world)
    index_b = np.arange(count)
    index_b[num_right:] = rng.permutation(index_b[num_right:])
    return Scene(a, b, Candidates(np.arange(count), index_b, 1), 0.55)


def off(found, truth):
    error = truth.inverse() @ found
    return math.hypot(error.x_m, error.y_m), abs(error.theta_rad)


def test_nine_wrong_candidates_in_ten_do_not_hide_the_motion():
    pair = scene()
    segments = matched_segments(pair, OPTIONS, np.random.default_rng(0))
    votes = voted(pair, segments, OPTIONS)
    # Right segments are exact, wrong ones within the vote's 16 mm blur the mean; worst of ten
    # seeds 0.9 mm, 0.002 rad.
    far_m, turn_rad = off(votes[0].a_from_b, MOTION)
    assert far_m < 0.003
    assert turn_rad < 0.006
    assert votes[0].num_segments > 5 * votes[1].num_segments


def test_matched_segments_are_right_or_alike():
    pair = scene()
    segments = matched_segments(pair, OPTIONS, np.random.default_rng(0))
    one, two = segments.T
    a, b = pair.candidates.a, pair.candidates.b
    length_a = np.linalg.norm(pair.a.floor_m[a[two]] - pair.a.floor_m[a[one]], axis=1)
    length_b = np.linalg.norm(pair.b.floor_m[b[two]] - pair.b.floor_m[b[one]], axis=1)
    assert (np.abs(length_a - length_b) < 2 * CELL_M + 0.015 * length_a + 1e-6).all()
    assert length_a.min() > 0.12 * 0.55
    assert length_a.max() < 0.9 * 0.55
    along_a = profile(pair.a, a[one], a[two], 8)
    along_b = profile(pair.b, b[one], b[two], 8)
    assert ((along_a * along_b).sum(axis=1) > 0.8).all()
    # Of segments equal in length by chance few have equal profiles: right ones are 1 % of the
    # draws, and most of what is left.
    right = (one < 40) & (two < 40)
    assert right.mean() > 0.5


def test_a_repeating_floor_shows_as_a_rival():
    pair = scene(40, 0)
    shift = Se2(0.1, 0.0, 0.0)
    index_b = np.concatenate([np.arange(40), np.arange(40)])
    floor_a = np.vstack([pair.a.floor_m, shift.apply(pair.a.floor_m)])
    a = SegmentView(floor_a, GRID.overhead_from_floor(floor_a), pair.a.grey, CELL_M)
    twice = Scene(a, pair.b, Candidates(np.arange(80), index_b, 1), 0.55)
    options = SegmentOptions(num_draws=60_000, min_correlation=-1.1)
    votes = voted(twice, matched_segments(twice, options, np.random.default_rng(0)), options)
    expected = {0: MOTION, 1: shift @ MOTION}
    found = [min(expected, key=lambda k: off(vote.a_from_b, expected[k])[0]) for vote in votes[:2]]
    assert sorted(found) == [0, 1]
    assert max(off(v.a_from_b, expected[k])[0] for v, k in zip(votes, found, strict=False)) < 0.004
    assert votes[1].num_segments > 0.8 * votes[0].num_segments


@pytest.mark.parametrize("theta", [0.0, math.pi, -3.0, 1.5])
def test_any_turn_is_found(theta):
    motion = Se2(0.02, 0.01, theta)
    pair = scene(60, 140, motion)
    segments = matched_segments(pair, OPTIONS, np.random.default_rng(1))
    far_m, turn_rad = off(voted(pair, segments, OPTIONS)[0].a_from_b, motion)
    assert far_m < 0.003
    assert min(turn_rad, 2 * math.pi - turn_rad) < 0.006


def test_the_same_draws_give_the_same_votes():
    pair = scene()
    first, second = (
        voted(pair, matched_segments(pair, OPTIONS, np.random.default_rng(7)), OPTIONS)
        for _ in range(2)
    )
    assert first == second


def test_heights_only_set_the_scale():
    pair = scene()

    def scaled(view):
        return view._replace(floor_m=view.floor_m * 100, m_per_px=CELL_M * 100)

    far = Scene(scaled(pair.a), scaled(pair.b), pair.candidates, 55.0)
    near = voted(pair, matched_segments(pair, OPTIONS, np.random.default_rng(2)), OPTIONS)[0]
    high = voted(far, matched_segments(far, OPTIONS, np.random.default_rng(2)), OPTIONS)[0]
    assert high.num_segments == pytest.approx(near.num_segments, abs=2)
    assert high.a_from_b.x_m / 100 == pytest.approx(near.a_from_b.x_m, abs=1e-4)


def test_profiles_read_the_view_from_start_to_end():
    grey = np.tile(np.arange(400, dtype=np.float32) ** 2, (500, 1))
    px = np.array([[10.0, 20.0], [90.0, 60.0]])
    view = SegmentView(GRID.floor_from_overhead(px), px, grey, CELL_M)
    there, back = profile(view, np.array([0, 1]), np.array([1, 0]), 8)
    expected = np.linspace(10.0, 90.0, 9) ** 2
    expected -= expected.mean()
    np.testing.assert_allclose(there, expected / np.linalg.norm(expected), atol=1e-6)
    np.testing.assert_allclose(back, there[::-1], atol=1e-12)


def test_flat_profiles_correlate_with_nothing():
    px = np.array([[10.0, 20.0], [90.0, 60.0]])
    view = SegmentView(px, px, np.full((500, 400), 7.0, np.float32), CELL_M)
    assert (profile(view, np.array([0]), np.array([1]), 8) == 0.0).all()


@pytest.mark.parametrize("count", [0, 1, 4097, 40_000])
def test_any_number_of_profiles(count):
    rng = np.random.default_rng(0)
    px = rng.uniform(0, 399, (50, 2))
    view = SegmentView(px, px, rng.normal(size=(500, 400)).astype(np.float32), CELL_M)
    start, end = rng.integers(50, size=(2, count))
    got = profile(view, start, end, 8)
    assert got.shape == (count, 9)
    if count:
        np.testing.assert_allclose(got[-1:], profile(view, start[-1:], end[-1:], 8), atol=1e-6)


def test_candidates_are_the_nearest_first():
    rng = np.random.default_rng(0)
    one, other = rng.random((30, 6)), rng.random((50, 6))
    got = nearest_candidates(one, other, 4)
    expected = np.argsort(np.linalg.norm(one[:, None] - other, axis=2), axis=1)[:, :4]
    np.testing.assert_array_equal(got.b.reshape(30, 4), expected)
    np.testing.assert_array_equal(got.a, np.repeat(np.arange(30), 4))


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_points_than_candidates(count):
    got = nearest_candidates(np.random.default_rng(0).random((5, 6)), np.zeros((count, 6)), 10)
    assert (got.num_ranks, len(got.a), len(got.b)) == (count, 5 * count, 5 * count)


def test_every_rank_is_drawn_and_near_ones_more_often():
    pair = scene(100, 0)
    wrong = np.random.default_rng(5).permutation(np.repeat(np.arange(100), 3)).reshape(100, 3)
    options = SegmentOptions(num_draws=60_000, max_segments=60_000)
    counts = []
    for rank in (0, 2):
        index_b = wrong.copy()
        index_b[:, rank] = np.arange(100)
        candidates = Candidates(np.repeat(np.arange(100), 3), index_b.ravel(), 3)
        ranked = pair._replace(candidates=candidates)
        segments = matched_segments(ranked, options, np.random.default_rng(0))
        assert off(voted(ranked, segments, options)[0].a_from_b, MOTION)[0] < 0.003
        right = candidates.a[segments] == candidates.b[segments]
        counts.append(right.all(axis=1).sum())
    # Ranks are drawn as 1 : 1/2 : 1/3, and both ends must be right: nine to one.
    assert counts[0] / counts[1] == pytest.approx(9.0, rel=0.15)


def test_no_more_segments_vote_than_allowed():
    options = SegmentOptions(num_draws=60_000, max_segments=70)
    segments = matched_segments(scene(200, 0), options, np.random.default_rng(0))
    assert segments.shape == (70, 2)


def test_nothing_matched_is_no_vote():
    pair = scene(0, 50)
    strict = SegmentOptions(num_draws=1000, min_correlation=1.1)
    segments = matched_segments(pair, strict, np.random.default_rng(0))
    assert segments.shape == (0, 2)
    assert voted(pair, segments, strict) == []
