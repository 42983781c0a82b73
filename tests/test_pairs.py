"""Which pairs are tried: neighbours, what looks alike, and skips that bridge a cut chain."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from road_features import along_a_road

from groundfuse.backend.measurement import FrameId
from groundfuse.frontend.pairs import (
    neighbour_pairs,
    retrieved_pairs,
    sample_of,
    skip_pairs,
)
from groundfuse.frontend.retrieval import RetrievalOptions


def robot(name, count):
    return [FrameId(name, k) for k in range(count)]


def pair(name, i, j):
    return FrameId(name, i), FrameId(name, j)


def test_neighbours_are_consecutive_frames_of_one_robot():
    frames = [*robot("B", 3), *robot("A", 2)]
    assert neighbour_pairs(frames) == [pair("A", 0, 1), pair("B", 0, 1), pair("B", 1, 2)]
    assert neighbour_pairs([]) == []
    assert neighbour_pairs(robot("A", 1)) == []


def test_neighbours_go_by_number_not_by_text():
    frames = robot("A", 12)[::-1]
    assert neighbour_pairs(frames)[9:] == [pair("A", 9, 10), pair("A", 10, 11)]


def test_a_whole_chain_needs_no_skips():
    frames = robot("A", 6)
    assert skip_pairs(frames, neighbour_pairs(frames), 2) == []


def test_one_bad_image_is_bridged_by_its_neighbours():
    """Frame 3 matches nothing: 2-4 is what joins the chain again (1-3 and 3-5 are tried too)."""
    frames = robot("A", 7)
    joined = [p for p in neighbour_pairs(frames) if frames[3] not in p]
    wanted = skip_pairs(frames, joined, 2)
    assert pair("A", 2, 4) in wanted
    assert wanted == [pair("A", 1, 3), pair("A", 2, 4), pair("A", 3, 5)]
    assert skip_pairs(frames, [*joined, pair("A", 2, 4)], 3) == []


def test_two_bad_images_need_a_longer_skip():
    frames = robot("A", 8)
    joined = [p for p in neighbour_pairs(frames) if not {frames[3], frames[4]} & set(p)]
    assert pair("A", 2, 5) in skip_pairs(frames, joined, 3)
    assert skip_pairs(frames, [*joined, pair("A", 2, 5)], 4) == []


def test_a_loop_that_spans_the_gap_joins_too():
    """An accepted pair from far before to far after leaves nothing to bridge."""
    frames = robot("A", 7)
    joined = [p for p in neighbour_pairs(frames) if frames[3] not in p]
    assert skip_pairs(frames, [*joined, pair("A", 0, 6)], 2) == []
    assert skip_pairs(frames, [*joined, pair("A", 6, 0)], 2) == []


def test_overlaps_with_other_robots_bridge_nothing():
    frames = [*robot("A", 3), *robot("B", 3)]
    joined = [(FrameId("A", k), FrameId("B", k)) for k in range(3)]
    wanted = skip_pairs(frames, joined, 2)
    assert wanted == [pair("A", 0, 2), pair("B", 0, 2)]


def test_a_skip_longer_than_the_robot_gives_nothing():
    assert skip_pairs(robot("A", 3), [], 3) == []
    assert skip_pairs([], [], 2) == []


@given(st.integers(1, 12), st.sets(st.integers(0, 10)), st.integers(2, 4))
def test_every_gap_that_can_be_bridged_is(count, gaps, skip):
    """Against the definition: all pairs of that length over a gap, once each, in order."""
    frames = robot("A", count)
    joined = [p for k, p in enumerate(neighbour_pairs(frames)) if k not in gaps]
    wanted = skip_pairs(frames, joined, skip)
    expected = [
        (a, b)
        for a, b in itertools.combinations(frames, 2)
        if b.index - a.index == skip and gaps & set(range(a.index, b.index)) & set(range(count - 1))
    ]
    assert wanted == expected


def test_retrieved_pairs_name_frames_whatever_their_order():
    found = along_a_road(8, 15, np.random.default_rng(0))
    names = [*robot("A", 4), *robot("B", 4)]
    options = RetrievalOptions(num_frames=2)
    alike = retrieved_pairs(dict(zip(names, found, strict=True)), options)
    assert {(names[k], names[k + 1]) for k in range(7)} <= set(alike)
    assert (FrameId("A", 3), FrameId("B", 0)) in alike
    assert all(a < b for a, b in alike)
    backwards = dict(reversed(list(zip(names, found, strict=True))))
    assert retrieved_pairs(backwards, options) == alike


def test_one_more_frame_changes_no_pair_far_away():
    """What is learned from is drawn by name: the sample of the others stays, as do their pairs."""
    found = along_a_road(81, 15, np.random.default_rng(1))
    names = [*robot("A", 40), *robot("B", 41)]
    options = RetrievalOptions(num_frames=2, num_candidates=12, num_sample=20)
    whole = dict(zip(names, found, strict=True))
    last = names[-1]
    assert last not in sample_of(names, options)
    without = {name: frame for name, frame in whole.items() if name != last}
    before, after = retrieved_pairs(without, options), retrieved_pairs(whole, options)
    assert {pair for pair in after if last not in pair} <= set(before)
    assert len(set(before) - set(after)) <= 2
    for k in range(79):
        assert (names[k], names[k + 1]) in after
