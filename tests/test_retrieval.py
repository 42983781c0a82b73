"""Retrieval finds the frames that share floor, whoever took them and in whatever order."""

import dataclasses

import numpy as np
import pytest
from floor_pairs import camera, features_of, photo
from road_features import along_a_road, features

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend import retrieval, retrieval_votes
from groundfuse.frontend.features import FeatureOptions
from groundfuse.frontend.retrieval import (
    RetrievalOptions,
    described,
    learned,
    retrieved,
    stacked,
    votes,
)
from groundfuse.tools.overlap import true_overlap

OPTIONS = RetrievalOptions()


def votes_of(frames, known, options):
    [found] = votes(*stacked(described(frame, known, options) for frame in frames), options)
    return found


def table(frames, options=OPTIONS, sample=None):
    """Votes as a square table."""
    found = votes_of(frames, learned(frames if sample is None else sample, options), options)
    square = np.zeros((len(frames), len(frames)))
    square[tuple(found.pairs.T)] = found.weight
    return square + square.T


@pytest.mark.parametrize("bits", [False, True], ids=["sift", "orb"])
@pytest.mark.parametrize("num_candidates", [8, 64], ids=["by a glance", "among all"])
def test_frames_that_share_marks_are_found(bits, num_candidates):
    """Each frame shares three quarters with the next, half with the one after, and so on."""
    frames = along_a_road(16, 15, np.random.default_rng(0), bits=bits)
    options = RetrievalOptions(num_candidates=num_candidates, num_frames=4)
    found = table(frames, options)
    for k in range(16):
        others = sorted((j for j in range(16) if j != k), key=lambda j: -found[k, j])
        neighbours = {j for j in (k - 1, k + 1) if 0 <= j < 16}
        assert set(others[: len(neighbours)]) == neighbours
        strangers = [found[k, j] for j in others if abs(j - k) >= 4]
        assert max(strangers) < 0.5 * found[k, others[0]]
    pairs = retrieved(frames, frames, options)
    assert {(k, k + 1) for k in range(15)} <= set(pairs)
    assert {(k, k + 2) for k in range(14)} <= set(pairs)


def test_a_glance_at_many_frames_loses_no_neighbour():
    """Among 120 frames a few candidates hold all that share half or more."""
    frames = along_a_road(120, 15, np.random.default_rng(10))
    options = RetrievalOptions(num_candidates=12, num_frames=4)
    found = set(retrieved(frames, frames[::4], options))
    assert {(k, k + 1) for k in range(119)} <= found
    assert {(k, k + 2) for k in range(118)} <= found
    assert len(found) <= 120 * 4


def test_only_candidates_are_voted_for():
    """The number of votes grows with the number of frames, not with its square."""
    for count in (20, 40):
        frames = along_a_road(count, 30, np.random.default_rng(11), seen=40)
        known = learned(frames, OPTIONS)
        few = RetrievalOptions(num_candidates=6)
        found = votes_of(frames, known, few)
        assert len(found.pairs) <= 6 * count
    assert len(found.stranger) == 40


def test_each_pair_is_counted_once_in_order_with_positive_votes():
    frames = along_a_road(30, 15, np.random.default_rng(1))
    few, known = RetrievalOptions(num_candidates=9), learned(frames, OPTIONS)
    found = votes_of(frames, known, few)
    assert (found.pairs[:, 0] < found.pairs[:, 1]).all()
    assert found.pairs.tolist() == sorted(found.pairs.tolist())
    assert len({tuple(pair) for pair in found.pairs.tolist()}) == len(found.pairs)
    assert (found.weight > 0.0).all()


def test_votes_of_both_directions_add_up():
    """Two frames: what one casts and what the other casts, worked out by hand."""
    frames = along_a_road(2, 20, np.random.default_rng(2))
    known = learned(frames, OPTIONS)
    a, b = (known.reduced(frame.descriptors) for frame in frames)
    likeness = np.maximum(a @ b.T, 0.0) ** 2
    expected = likeness.max(axis=1).sum() + likeness.max(axis=0).sum()
    # Likeness is kept in halves, good to 2^-12 of themselves, and squared.
    assert table(frames)[0, 1] == pytest.approx(expected, rel=2.0**-11)


def test_what_looks_like_everything_gets_no_votes():
    """A feature that all frames share tells nothing; one that two share tells all."""
    mark = np.eye(128, dtype=np.float32)
    common = np.repeat(mark[:1], 30, axis=0)
    own = [mark[1 + 2 * k : 3 + 2 * k] for k in range(20)]
    frames = [features(np.concatenate([common, rows])) for rows in own]
    frames.append(features(np.concatenate([common, own[3]])))
    options = RetrievalOptions(num_components=128, num_frames=1)
    found = table(frames, options)
    assert found[3, 20] > 1.0
    others = found.copy()
    others[3, 20] = others[20, 3] = 0.0
    assert others.max() < 0.01 * found[3, 20]


def test_pairs_are_sorted_unique_and_ordered():
    frames = along_a_road(12, 30, np.random.default_rng(2))
    pairs = retrieved(frames, frames, OPTIONS)
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)


def test_the_order_of_the_frames_does_not_matter():
    frames = along_a_road(40, 30, np.random.default_rng(3))
    order = np.random.default_rng(4).permutation(40)
    shuffled = [frames[k] for k in order]
    options = RetrievalOptions(num_frames=2, num_candidates=10)
    sample = frames[::2]
    found, other = table(frames, options, sample), table(shuffled, options, sample)
    # Sums of the same numbers in another order; float32 descriptors: worst seen 2e-6.
    np.testing.assert_allclose(other, found[np.ix_(order, order)], rtol=1e-3, atol=1e-4)
    pairs = {
        frozenset((int(order[i]), int(order[j]))) for i, j in retrieved(shuffled, sample, options)
    }
    assert pairs == {frozenset(pair) for pair in retrieved(frames, sample, options)}


def test_the_number_of_frames_per_frame_is_kept():
    frames = along_a_road(14, 4, np.random.default_rng(5))
    for most in (1, 2, 5):
        pairs = retrieved(frames, frames, RetrievalOptions(num_frames=most))
        # Each frame names `most`; one may be named by many.
        assert 7 * most <= len(pairs) <= 14 * most


def crowded():
    """Robots 0 and 1 on one road at ten places; each sees every place in four frames of its own.

    The other robot's frames show half of the same marks, its own nearly all.
    """
    rng = np.random.default_rng(21)
    frames, robots, places = [], [], []
    for place, marks in enumerate(rng.uniform(0.0, 1.0, (10, 90, 128)) ** 4):
        for robot, rows in enumerate((marks[:60], marks[30:])):
            for _ in range(4):
                noisy = np.abs(rows + 0.05 * rng.standard_normal(rows.shape))
                frames.append(
                    features(np.sqrt(noisy / noisy.sum(axis=1, keepdims=True)).astype(np.float32))
                )
                robots.append(robot)
                places.append(place)
    return frames, np.array(robots), np.array(places)


def test_other_robots_are_found_however_often_a_robot_sees_its_own_floor():
    frames, robots, places = crowded()
    options = RetrievalOptions(num_frames=3, num_others=2, num_candidates=20)
    alone = retrieved(frames, frames, options)
    assert all(robots[i] == robots[j] for i, j in alone)
    both = retrieved(frames, frames, options, robots)
    assert set(alone) <= set(both)
    between = [(i, j) for i, j in both if robots[i] != robots[j]]
    assert {frame for pair in between for frame in pair} == set(range(len(frames)))
    assert all(places[i] == places[j] for i, j in between)


def test_strangers_of_other_robots_are_not_returned():
    """Where the other robot has not been, its best frames get what all its frames get."""
    frames, robots, places = crowded()
    kept = np.flatnonzero((robots == 0) | (places < 5))
    few, robots, places = [frames[k] for k in kept], robots[kept], places[kept]
    options = RetrievalOptions(num_frames=3, num_others=2, num_candidates=15)
    between = [(i, j) for i, j in retrieved(few, few, options, robots) if robots[i] != robots[j]]
    assert between
    assert all(places[i] == places[j] for i, j in between)
    every = dataclasses.replace(options, least_votes=0.0)
    some = [(i, j) for i, j in retrieved(few, few, every, robots) if robots[i] != robots[j]]
    assert any(places[i] != places[j] for i, j in some)


def test_work_in_chunks_changes_nothing(monkeypatch):
    frames = along_a_road(30, 30, np.random.default_rng(6))
    options = RetrievalOptions(num_candidates=7)
    whole = table(frames, options)
    monkeypatch.setattr(retrieval_votes, "CHUNK", 11)
    np.testing.assert_allclose(table(frames, options), whole, rtol=1e-5)


def test_the_largest_features_have_a_say():
    """Small ones that look like other frames' change nothing beyond the limit."""
    rng = np.random.default_rng(7)
    frames = along_a_road(6, 30, rng, seen=60)
    limit = RetrievalOptions(num_features=60)
    clutter = rng.random((200, 128)).astype(np.float32)
    size = np.concatenate([np.zeros(200), np.ones(60)])
    mixed = [
        features(np.concatenate([clutter, frame.descriptors]), size + 0.001 * np.arange(260))
        for frame in frames
    ]
    turned = [features(frame.descriptors[::-1]) for frame in frames]  # the last is the largest
    np.testing.assert_array_equal(table(mixed, limit), table(turned, limit))


def test_frames_without_features_take_no_part():
    frames = along_a_road(15, 20, np.random.default_rng(8))
    empty = features(np.zeros((0, 128), np.float32))
    options = RetrievalOptions(num_candidates=20)
    found = table([empty, *frames, empty], options)
    assert not found[0].any()
    assert not found[-1].any()
    np.testing.assert_allclose(found[1:-1, 1:-1], table(frames, options), rtol=1e-5)
    for most in (4, 20):
        few = RetrievalOptions(num_candidates=most)
        pairs = retrieved([empty, *frames, empty], [*frames, empty], few)
        assert all(0 not in pair and 16 not in pair for pair in pairs)


def test_no_frame_one_frame_blank_frames():
    empty = features(np.zeros((0, 128), np.float32))
    one = along_a_road(1, 20, np.random.default_rng(9))
    assert learned([], OPTIONS) is None
    assert learned([empty], OPTIONS) is None
    assert retrieved([], [], OPTIONS) == []
    assert retrieved([empty, empty], [empty], OPTIONS) == []
    assert retrieved(one, one, OPTIONS) == []
    assert retrieved([], one, OPTIONS) == []
    tiny = features(np.ones((1, 128), np.float32) / np.sqrt(128.0))
    assert retrieved([tiny, tiny], [tiny], OPTIONS) == []  # one point has no principal component


def test_words_are_middles_of_what_is_nearest():
    """Three heaps of directions: three words, one in the middle of each."""
    rng = np.random.default_rng(13)
    middles = np.eye(128)[:3]
    rows = np.repeat(middles, 50, axis=0) + 0.02 * rng.standard_normal((150, 128))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    frame = features(rows.astype(np.float32))
    known = learned([frame], RetrievalOptions(num_words=3, num_components=2))
    expected = known.reduced(middles.astype(np.float32))
    likeness = expected @ known.words.T
    assert np.sort(likeness.max(axis=1))[0] > 0.999
    assert len(set(likeness.argmax(axis=1).tolist())) == 3


def test_a_glance_is_what_the_words_leave_over():
    """Each feature beside its nearest word; the words themselves say nothing."""
    words = np.eye(4, dtype=np.float32)[:2]
    rows = np.array([[1, 0, 0, 0], [0.8, 0, 0.6, 0], [0, 0.8, 0, -0.6], [0, 0, 0, 0]], np.float32)
    over = np.zeros((2, 4))
    over[0], over[1] = rows[1] - words[0], rows[2] - words[1]
    expected = over.ravel() / np.linalg.norm(over)
    np.testing.assert_allclose(retrieval._glance(rows, words), expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_photographs_of_the_same_floor_find_each_other(kind):
    """Two robots with different tilts, at three places: each view's partner is its best guess."""
    frames = []
    for place in range(3):
        at = Se2(0.9 * place, 0.0, 0.3 * place)
        frames.append(photo(camera(33.0), at, frame=FrameId("A", place)))
        ahead = Se2(0.4, 0.0, 0.0)  # turned about the middle of what it sees
        pose = at @ ahead @ Se2(0.03, 0.02, 2.0 + place) @ ahead.inverse()
        frames.append(photo(camera(45.0), pose, frame=FrameId("B", place)))
    found = [features_of(frame, FeatureOptions(kind=kind)) for frame in frames]
    pairs = set(retrieved(found, found, RetrievalOptions(num_frames=1)))
    for place in range(3):
        assert true_overlap(frames[2 * place].view, frames[2 * place + 1].view) > 0.35
        assert (2 * place, 2 * place + 1) in pairs
