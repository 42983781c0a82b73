"""Retrieval finds the frames that share floor, whoever took them and in whatever order."""

import numpy as np
import pytest
from floor_pairs import camera, features_of, photo
from road_features import along_a_road, features

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend import retrieval
from groundfuse.frontend.features import FeatureOptions
from groundfuse.frontend.retrieval import RetrievalOptions, retrieved, similarity
from groundfuse.tools.overlap import true_overlap

OPTIONS = RetrievalOptions()


@pytest.mark.parametrize("bits", [False, True], ids=["sift", "orb"])
def test_frames_that_share_marks_are_found(bits):
    """Each frame shares three quarters with the next, half with the one after, and so on."""
    frames = along_a_road(16, 15, np.random.default_rng(0), bits=bits)
    votes = similarity(frames, OPTIONS)
    for k in range(16):
        others = sorted((j for j in range(16) if j != k), key=lambda j: -votes[k, j])
        neighbours = {j for j in (k - 1, k + 1) if 0 <= j < 16}
        assert set(others[: len(neighbours)]) == neighbours
        strangers = [votes[k, j] for j in others if abs(j - k) >= 4]
        assert max(strangers) < 0.5 * votes[k, others[0]]
    pairs = retrieved(frames, RetrievalOptions(num_frames=4))
    assert {(k, k + 1) for k in range(15)} <= set(pairs)
    assert {(k, k + 2) for k in range(14)} <= set(pairs)


def test_votes_are_symmetric_and_never_for_oneself():
    votes = similarity(along_a_road(12, 30, np.random.default_rng(1)), OPTIONS)
    np.testing.assert_array_equal(votes, votes.T)
    assert not votes.diagonal().any()
    assert (votes >= 0.0).all()


def test_pairs_are_sorted_unique_and_ordered():
    pairs = retrieved(along_a_road(12, 30, np.random.default_rng(2)), OPTIONS)
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)


def test_the_order_of_the_frames_does_not_matter():
    frames = along_a_road(15, 30, np.random.default_rng(3))
    order = np.random.default_rng(4).permutation(15)
    options = RetrievalOptions(num_frames=3)
    votes = similarity(frames, options)
    shuffled = similarity([frames[k] for k in order], options)
    # The components come from sums in another order; float32 descriptors: worst seen 2e-6.
    np.testing.assert_allclose(shuffled, votes[np.ix_(order, order)], rtol=1e-3, atol=1e-4)
    pairs = {
        frozenset((int(order[i]), int(order[j])))
        for i, j in retrieved([frames[k] for k in order], options)
    }
    assert pairs == {frozenset(pair) for pair in retrieved(frames, options)}


def test_the_number_of_frames_per_frame_is_kept():
    frames = along_a_road(14, 4, np.random.default_rng(5))
    for most in (1, 2, 5):
        pairs = retrieved(frames, RetrievalOptions(num_frames=most))
        # Each frame names `most`; one may be named by many.
        assert 7 * most <= len(pairs) <= 14 * most


def test_work_in_chunks_changes_nothing(monkeypatch):
    frames = along_a_road(10, 30, np.random.default_rng(6))
    whole = similarity(frames, OPTIONS)
    monkeypatch.setattr(retrieval, "CHUNK", 37)
    np.testing.assert_allclose(similarity(frames, OPTIONS), whole, rtol=1e-5)


def test_many_features_are_thinned_evenly():
    """Twice the features of the limit: every other one has a say, first and last included."""
    rng = np.random.default_rng(7)
    frames = along_a_road(6, 30, rng, seen=60)
    limit = RetrievalOptions(num_features=60)
    doubled = [features(np.repeat(f.descriptors, 2, axis=0)) for f in frames]
    plain, thinned = similarity(frames, limit), similarity(doubled, limit)
    assert np.corrcoef(plain.ravel(), thinned.ravel())[0, 1] > 0.99


def test_frames_without_features_take_no_part():
    frames = along_a_road(5, 20, np.random.default_rng(8))
    empty = features(np.zeros((0, 128), np.float32))
    found = similarity([empty, *frames, empty], OPTIONS)
    assert not found[0].any()
    assert not found[-1].any()
    np.testing.assert_allclose(found[1:-1, 1:-1], similarity(frames, OPTIONS), rtol=1e-5)
    assert all(
        0 not in pair and 6 not in pair for pair in retrieved([empty, *frames, empty], OPTIONS)
    )


def test_no_frame_one_frame_blank_frames():
    empty = features(np.zeros((0, 128), np.float32))
    assert similarity([], OPTIONS).shape == (0, 0)
    assert retrieved([], OPTIONS) == []
    assert retrieved([empty, empty], OPTIONS) == []
    assert retrieved(along_a_road(1, 20, np.random.default_rng(9)), OPTIONS) == []
    tiny = features(np.ones((1, 128), np.float32) / np.sqrt(128.0))
    assert retrieved([tiny, tiny], OPTIONS) == []  # one point has no principal component


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
    pairs = set(retrieved(found, RetrievalOptions(num_frames=1)))
    for place in range(3):
        assert true_overlap(frames[2 * place].view, frames[2 * place + 1].view) > 0.35
        assert (2 * place, 2 * place + 1) in pairs
