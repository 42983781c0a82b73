"""The consensus: the planted motion wins, its rivals are seen, and every option does its work."""

import dataclasses
import math

import numpy as np
import pytest
from floor_pairs import error_of
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend.measurement import IDENTITY, Se2
from groundfuse.frontend.consensus import (
    Candidates,
    ConsensusOptions,
    Gate,
    _coefficients,
    _limits,
    _table,
    find_modes,
)
from groundfuse.frontend.consensus_compiled import (
    _apart,
    _fit,
    _guide,
    _picked,
    climb,
    count_votes,
    draw,
)

TOLERANCE_M = 0.01
OPTIONS = ConsensusOptions(num_draws=8000)
TRUTH = Se2(0.3, -0.2, 2.0)
poses = st.builds(Se2, st.floats(-2, 2), st.floats(-2, 2), st.floats(-math.pi, math.pi))


def planted(rng, motions=(TRUTH,), right=40, wrong=120, scale=1.0, noise_m=0.0015, size_m=0.4):
    """Features of b, each with one right candidate per motion and some wrong ones, shuffled."""
    in_b = rng.uniform(-size_m, size_m, (right, 2))
    floor_a, floor_b, index_a, index_b, rank, turn = [], [], [], [], [], []
    for k, motion in enumerate(motions):
        floor_a.append(motion.apply(scale * in_b) + noise_m * rng.standard_normal((right, 2)))
        floor_b.append(in_b)
        index_a.append(np.arange(right) + k * right)
        index_b.append(np.arange(right))
        rank.append(np.zeros(right, dtype=int))
        turn.append(np.full(right, motion.theta_rad) + 0.05 * rng.standard_normal(right))
    floor_a.append(rng.uniform(-size_m, size_m, (wrong, 2)))
    floor_b.append(rng.uniform(-size_m, size_m, (wrong, 2)))
    index_a.append(len(motions) * right + np.arange(wrong))
    index_b.append(right + np.arange(wrong))
    rank.append(np.ones(wrong, dtype=int))
    turn.append(rng.uniform(-math.pi, math.pi, wrong))
    return Candidates(
        np.vstack(floor_a),
        np.vstack(floor_b),
        np.concatenate(index_a),
        np.concatenate(index_b),
        np.concatenate(rank),
        np.concatenate(turn),
    )


def limits(found, *, scales=0.0, options=OPTIONS, tolerance_m=TOLERANCE_M):
    return _limits(found, tolerance_m, scales, options, None)


def plain(function):
    """Return what was compiled as Python sees it."""
    return function.py_func


def modes(found, *, scales=0.0, options=OPTIONS, gate=None, seed=0):
    return find_modes(found, TOLERANCE_M, scales, options, np.random.default_rng(seed), gate)


# Least squares over 40 voters with 1.5 mm of noise would give 0.3 mm and 1 mrad; but a motion for
# which one wrong candidate more votes by chance is kept as it was drawn, good to the tolerance of
# 10 mm over the view's half metre. Worst seen 2.4 mm at foot b, 14 mrad.
NEAR_M, NEAR_RAD = 0.01, 0.025


def assert_near(mode, truth):
    error = error_of(mode.a_from_b, truth)
    assert np.hypot(*error[:2]) < NEAR_M
    assert abs(error[2]) < NEAR_RAD


@given(
    poses,
    st.integers(0, 2**16),
    st.booleans(),
)
@settings(max_examples=15)
def test_the_planted_motion_is_found(truth, seed, turned):
    """One right candidate in four, with and without orientations."""
    found = planted(np.random.default_rng(seed), (truth,))
    if not turned:
        found = found._replace(turn_rad=np.full(len(found.turn_rad), np.nan))
    best, *rivals = modes(found)
    assert_near(best, truth)
    assert best.scale == pytest.approx(1.0, abs=1e-12)
    assert best.voters[:40].sum() >= 38
    # A wrong candidate votes by chance only: a disc of 1 cm on 0.64 m^2 is 0.05 % of the floor.
    assert best.voters[40:].sum() <= 2
    assert best.votes >= 40
    assert all(rival.votes < 0.4 * best.votes for rival in rivals)


@given(poses, poses, st.floats(-2, 2), st.floats(-2, 2))
def test_motions_are_compared_at_the_view(one, other, x, y):
    asked = limits(planted(np.random.default_rng(0)))._replace(centre_x_m=x, centre_y_m=y)
    place, turn = plain(_apart)(_coefficients(one), _coefficients(other), asked)
    moved = one.apply(np.array([[x, y]])) - other.apply(np.array([[x, y]]))
    assert place == pytest.approx(np.hypot(*moved[0]), abs=1e-12)
    between = abs((one.inverse() @ other).theta_rad)
    assert turn == pytest.approx(between, abs=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1.15, 0.9])
def test_every_draw_from_exact_matches_is_the_motion(scale):
    """Without noise or wrong candidates; nearly all pairs of points are long enough."""
    exact = planted(np.random.default_rng(13), wrong=0, noise_m=0.0, scale=scale)
    asked = limits(exact, scales=0.0 if scale == 1.0 else 0.2)
    draws = np.random.default_rng(0).random((2, 2000))
    motions = np.empty((2000, 4))
    count = draw(_table(exact), draws, asked, motions)
    c, s = math.cos(TRUTH.theta_rad), math.sin(TRUTH.theta_rad)
    wanted = [scale * c, scale * s, TRUTH.x_m, TRUTH.y_m]
    np.testing.assert_allclose(motions[:count], np.broadcast_to(wanted, (count, 4)), atol=1e-12)
    assert count > 0.9 * 2000
    # Drawing ends where there is no more room, with the same motions so far.
    few = np.empty((10, 4))
    assert draw(_table(exact), draws, asked, few) == 10
    np.testing.assert_array_equal(few, motions[:10])


@given(st.integers(0, 2**16))
@settings(max_examples=20)
def test_a_draw_takes_the_candidate_that_its_weight_gives_it(seed):
    """Against bisection, shares at the very borders included."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40))
    cumulative = np.cumsum(1.0 / rng.integers(1, 6, count))
    guide = plain(_guide)(cumulative)
    borders = np.minimum(cumulative / cumulative[-1], 1.0 - 2.0**-53)
    for share in [0.0, *rng.random(200), *borders, *np.nextafter(borders, 0.0)]:
        wanted = np.searchsorted(cumulative, share * cumulative[-1])
        assert plain(_picked)(share, cumulative, guide) == wanted


@given(
    poses,
    st.floats(0.8, 1.25),
    st.integers(0, 2**16),
)
def test_least_squares_over_the_voters(truth, scale, seed):
    """Against the linear solution of a similarity; the isometry keeps its heading."""
    rng = np.random.default_rng(seed)
    b = rng.uniform(-0.5, 0.5, (20, 2))
    a = truth.apply(scale * b) + 0.01 * rng.standard_normal((20, 2))
    one, zero = np.ones(20), np.zeros(20)
    design = np.vstack(
        [
            np.column_stack([b[:, 0], -b[:, 1], one, zero]),
            np.column_stack([b[:, 1], b[:, 0], zero, one]),
        ]
    )
    linear = np.linalg.lstsq(design, np.concatenate([a[:, 0], a[:, 1]]), rcond=None)[0]

    def fitted(most):
        index = np.arange(20)
        table = _table(Candidates(a, b, index, index, 0 * index, np.zeros(20)))
        motion = np.empty(4)
        asked = limits(planted(rng))._replace(max_scale=math.exp(most))
        assert plain(_fit)(table, np.ones(20, dtype=bool), asked, motion)
        return motion

    found = fitted(0.5)
    # The scale of the linear solution is that of b to a: the same sum of squares.
    np.testing.assert_allclose(found, linear, atol=1e-9)
    rigid = fitted(0.0)
    assert np.hypot(*rigid[:2]) == pytest.approx(1.0)
    assert math.atan2(rigid[1], rigid[0]) == pytest.approx(math.atan2(linear[1], linear[0]))
    np.testing.assert_allclose(
        Se2(rigid[2], rigid[3], math.atan2(rigid[1], rigid[0])).apply(b).mean(axis=0),
        a.mean(axis=0),
    )
    narrow = fitted(0.01)
    assert abs(math.log(np.hypot(*narrow[:2]))) <= 0.01 + 1e-12


def test_a_repeated_floor_shows_as_a_rival_of_equal_weight():
    """Each feature of b lies in a twice, 15 cm apart: no count of inliers tells which is right."""
    other = Se2(TRUTH.x_m + 0.15, TRUTH.y_m, TRUTH.theta_rad)
    found = modes(planted(np.random.default_rng(1), (TRUTH, other)))
    assert len(found) >= 2
    assert found[1].votes > 0.9 * found[0].votes
    places = sorted(found[:2], key=lambda mode: mode.a_from_b.x_m)
    assert_near(places[0], TRUTH)
    assert_near(places[1], other)


def test_motions_that_differ_in_turn_alone_are_rivals():
    """About the middle of the view: no distance tells them apart there."""
    turned = Se2(0.0, 0.0, 1.0)
    found = modes(planted(np.random.default_rng(2), (IDENTITY, turned)))
    headings = sorted(mode.a_from_b.theta_rad for mode in found[:2])
    np.testing.assert_allclose(headings, [0.0, 1.0], atol=NEAR_RAD)


def test_one_motion_is_not_its_own_rival():
    """Hypotheses on the slope of the best motion climb back to it."""
    for noise_m, apart in ((0.004, OPTIONS.distinct_tolerances), (0.0015, 0.5)):
        found = planted(np.random.default_rng(3), wrong=0, noise_m=noise_m)
        options = dataclasses.replace(OPTIONS, distinct_tolerances=apart)
        assert all(mode.votes < 20 for mode in modes(found, options=options)[1:])


def test_a_gate_leaves_the_rival_out():
    other = Se2(TRUTH.x_m + 0.15, TRUTH.y_m, TRUTH.theta_rad)
    found = planted(np.random.default_rng(1), (TRUTH, other))
    for wanted in (TRUTH, other):
        expected = wanted @ Se2(0.02, -0.02, 0.03)
        best, *rivals = modes(found, gate=Gate(expected, 0.06, 0.1))
        assert_near(best, wanted)
        assert all(rival.votes < 0.4 * best.votes for rival in rivals)


def test_a_gate_elsewhere_leaves_nothing():
    found = planted(np.random.default_rng(1), wrong=0)
    assert modes(found, gate=Gate(TRUTH @ Se2(0.3, 0.0, 0.0), 0.06, 0.1)) == []
    assert modes(found, gate=Gate(TRUTH @ Se2(0.0, 0.0, 0.5), 0.06, 0.1)) == []


def test_a_gate_judges_the_place_and_the_turn_apart():
    """A robot that turned on the spot: its view swings far, which the turn's range allows for."""
    rng = np.random.default_rng(4)
    found = planted(rng, (Se2(0.0, 0.0, 0.6),))
    ahead = np.array([[1.0, 0.0]])
    far = found._replace(
        floor_b=found.floor_b + ahead, floor_a=found.floor_a + Se2(0.0, 0.0, 0.6).apply(ahead)
    )
    best = modes(far, gate=Gate(Se2(0.0, 0.0, 0.55), 0.02, 0.1))[0]
    assert best.voters[:40].all()
    assert best.a_from_b.theta_rad == pytest.approx(0.6, abs=NEAR_RAD)
    # The turn is right, so no swing excuses the place, and a draw that is turned enough to be let
    # in does not climb back to it.
    shaky = far._replace(floor_a=far.floor_a + 0.004 * rng.standard_normal(far.floor_a.shape))
    assert modes(shaky)[0].votes > 30
    aside = Gate(Se2(0.0, 0.08, 0.6), 0.02, 0.15)
    for mode in modes(shaky, gate=aside):
        assert mode.votes < 15 or abs(mode.a_from_b.theta_rad - 0.6) > 0.04


def test_a_similarity_is_found_where_it_is_looked_for():
    found = planted(np.random.default_rng(5), scale=1.15)
    best = modes(found, scales=0.3)[0]
    assert best.scale == pytest.approx(1.15, rel=0.01)
    assert best.voters[:40].all()
    assert_near(best, TRUTH)
    rigid = modes(found)
    assert all(mode.votes < 30 and mode.scale == pytest.approx(1.0) for mode in rigid)


def test_scales_outside_the_range_are_not_reached():
    found = planted(np.random.default_rng(5), scale=1.3)
    for mode in modes(found, scales=0.1):
        assert abs(math.log(mode.scale)) <= 0.1 + 1e-9
        assert mode.votes < 30


def test_orientations_that_contradict_do_not_vote():
    found = planted(np.random.default_rng(6), wrong=0)
    turned = found._replace(turn_rad=found.turn_rad + 2 * OPTIONS.max_turn_rad)
    assert all(mode.votes < 5 for mode in modes(turned))
    around = found._replace(turn_rad=found.turn_rad - 2 * math.pi)
    assert modes(around)[0].votes == 40


def test_orientations_a_little_off_do_vote():
    found = planted(np.random.default_rng(6), wrong=0)
    off = found._replace(turn_rad=TRUTH.theta_rad + 0.9 * OPTIONS.max_turn_rad * np.ones(40))
    assert modes(off)[0].votes == 40


def test_neighbours_tell_no_motion():
    """Segments shorter than six tolerances have no direction worth the name."""
    close = planted(np.random.default_rng(7), wrong=0, size_m=0.02)
    assert modes(close) == []
    loose = dataclasses.replace(OPTIONS, min_baseline_tolerances=1.0)
    assert modes(close, options=loose)


def test_too_few_candidates_give_no_motion():
    found = planted(np.random.default_rng(8), right=1, wrong=0)
    assert modes(found) == []
    nothing = Candidates(*(np.asarray(part)[:0] for part in found))
    assert modes(nothing) == []


def test_a_feature_votes_once_however_many_candidates_it_has():
    """Copies of every candidate of a, a millimetre apart: forty votes, not two hundred."""
    found = planted(np.random.default_rng(9), wrong=0)
    copies = Candidates(*(np.repeat(part, 5, axis=0) for part in found))
    best = modes(copies)[0]
    assert best.votes == 40
    assert best.voters.sum() == 40


def test_no_more_modes_than_asked_for():
    motions = [Se2(0.15 * k, 0.0, 0.0) for k in range(5)]
    found = planted(np.random.default_rng(10), motions, wrong=0)
    assert len(modes(found)) == OPTIONS.num_modes
    many = modes(found, options=dataclasses.replace(OPTIONS, num_modes=5))
    assert [mode.votes for mode in many] == [40] * 5
    np.testing.assert_allclose(
        sorted(mode.a_from_b.x_m for mode in many), 0.15 * np.arange(5), atol=NEAR_M
    )


def test_the_same_draws_give_the_same_modes():
    found = planted(np.random.default_rng(11))
    one, two = modes(found, seed=3), modes(found, seed=3)
    assert [m.a_from_b for m in one] == [m.a_from_b for m in two]
    assert_near(modes(found, seed=4)[0], one[0].a_from_b)


def test_moving_a_view_moves_the_motion():
    found = planted(np.random.default_rng(12))
    shift = Se2(0.7, 1.1, -2.5)  # new frame of b seen from the old one
    moved = found._replace(
        floor_b=shift.inverse().apply(found.floor_b), turn_rad=found.turn_rad + shift.theta_rad
    )
    old, new = modes(found)[0], modes(moved)[0]
    assert_near(new, old.a_from_b @ shift)
    assert new.votes == old.votes


@given(st.integers(0, 2**16), st.integers(1, 200))
@settings(max_examples=30)
def test_candidates_laid_out(seed, count):
    """Against numpy: each rank's weight, and where each feature of a begins."""
    rng = np.random.default_rng(seed)
    floor, turn = rng.normal(size=(2, count, 2)), rng.uniform(-7.0, 7.0, count)
    index_a, index_b = np.sort(rng.integers(0, 40, count)), rng.integers(0, 40, count)
    rank = rng.integers(0, 5, count)
    table = _table(Candidates(*floor, index_a, index_b, rank, turn))
    np.testing.assert_array_equal(table.places, np.hstack(floor))
    np.testing.assert_array_equal(table.cumulative, np.cumsum(1.0 / (1.0 + rank)))
    np.testing.assert_array_equal(table.starts[:-1], np.unique(index_a, return_index=True)[1])
    assert table.starts[-1] == count
    assert table.num_b == index_b.max() + 1
    exact = np.column_stack([np.cos(turn), np.sin(turn)])
    np.testing.assert_allclose(table.turned, exact, atol=np.finfo(np.float32).eps / 2.0)


@given(st.integers(0, 2**16))
@settings(max_examples=30)
def test_voters_are_one_to_one_and_the_nearest(seed):
    rng = np.random.default_rng(seed)
    count = 60
    floor = rng.uniform(-0.03, 0.03, (2, count, 2))
    index_a = np.sort(rng.integers(0, 15, count))
    index_b = rng.integers(0, 15, count)
    found = Candidates(*floor, index_a, index_b, np.zeros(count, int), np.zeros(count))
    motion = np.array([1.0, 0.0, 0.002, 0.001])
    options = dataclasses.replace(OPTIONS, max_turn_rad=0.5)
    voters = np.empty(count, dtype=bool)
    asked = limits(found, options=options, tolerance_m=0.02)
    climb(_table(found), motion, asked, 0, voters)
    distance = np.hypot(*(floor[1] + motion[2:] - floor[0]).T)
    near = distance < 0.02
    assert not voters[~near].any()
    for index in (index_a, index_b):
        assert len(set(index[voters])) == voters.sum()
    first = near & (distance == distance[near].min(initial=np.inf))
    assert voters[first].all()
    # A candidate that is the nearest of its a is left out only for a nearer one of its b.
    for i in np.flatnonzero(near):
        if distance[i] == distance[near & (index_a == index_a[i])].min():
            chosen = voters & (index_b == index_b[i])
            assert chosen.any()
            assert distance[chosen][0] <= distance[i]


@given(st.integers(0, 2**16), st.booleans())
@settings(max_examples=20)
def test_votes_are_those_of_whole_matrices(seed, scaled):
    """Every motion against every candidate at once; some without orientation."""
    rng = np.random.default_rng(seed)
    found = planted(rng, wrong=60)
    turn = np.where(rng.random(len(found.turn_rad)) < 0.2, np.nan, found.turn_rad)
    found = found._replace(turn_rad=turn, index_a=np.sort(rng.integers(0, 50, len(turn))))
    motions = np.array([_coefficients(TRUTH)] * 30) + rng.normal(0.0, 0.02, (30, 4))
    motions[:, :2] *= 1.1 if scaled else 1.0
    asked, table = limits(found, tolerance_m=0.03), _table(found)
    counts = np.empty(30, dtype=np.int64)
    count_votes(table, motions, asked, counts)
    c, s, x, y = (motions[:, k, None] for k in range(4))
    dx = c * found.floor_b[:, 0] - s * found.floor_b[:, 1] + x - found.floor_a[:, 0]
    dy = s * found.floor_b[:, 0] + c * found.floor_b[:, 1] + y - found.floor_a[:, 1]
    off = np.abs(np.remainder(np.arctan2(s, c) - turn + np.pi, 2 * np.pi) - np.pi)
    agree = (np.hypot(dx, dy) < 0.03) & ~(off > OPTIONS.max_turn_rad)
    wanted = [len(set(found.index_a[row])) for row in agree]
    # Single precision moves a border by 1e-7; none of the candidates is so near to one.
    np.testing.assert_array_equal(counts, wanted)
    for motion, votes in zip(motions, wanted, strict=True):
        assert climb(table, motion.copy(), asked, 0, np.empty(len(turn), dtype=bool)) == votes
