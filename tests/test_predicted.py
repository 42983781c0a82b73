"""The second round of pairs: views that share floor by their poses, where the graph is weak."""

import itertools
import math

import numpy as np
import pytest
from floor_pairs import camera
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.overhead_view import OverheadOptions, overhead_grid
from groundfuse.frontend.predicted import PredictedOptions, floor_outline, predicted_pairs

OPTIONS = PredictedOptions()
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def frames(robot, count):
    return [FrameId(robot, k) for k in range(count)]


def row(robot, count, step_m=0.25, y_m=0.0):
    """Squares of one metre along x, each with its next three overlapping by half at least."""
    return {f: SQUARE + np.array([step_m * f.index, y_m]) for f in frames(robot, count)}


def chain(robot, count):
    return list(itertools.pairwise(frames(robot, count)))


def predicted(outlines, accepted, tried=None, options=OPTIONS, component=None):
    component = component or dict.fromkeys(outlines, 0)
    tried = accepted if tried is None else tried
    return predicted_pairs(outlines, component, accepted, tried, options)


def test_two_rows_side_by_side_are_tied_together_along_their_way():
    outlines = row("A", 40) | row("B", 40)
    ends = [(FrameId("A", 0), FrameId("B", 0))]
    options = PredictedOptions(least_pairs=0)
    found = predicted(outlines, chain("A", 40) + chain("B", 40) + ends, options=options)
    assert all(a.robot == "A" and b.robot == "B" for a, b in found)
    assert all(abs(a.index - b.index) <= 2 for a, b in found)
    # Held within four edges of a tie: one tie about every third or fourth frame, not all 40.
    places = sorted({a.index for a, _ in found} | {0})
    assert max(np.diff(places)) <= 5
    assert len(found) <= 20


def test_a_graph_that_is_dense_gets_nothing():
    outlines = row("A", 12)
    every = list(itertools.combinations(frames("A", 12), 2))
    dense = [(a, b) for a, b in every if b.index - a.index <= 3]
    assert predicted(outlines, dense) == []


def test_a_view_with_few_pairs_gets_more_the_most_overlap_first():
    """Four squares; the last hangs on one edge: it gets the two others, the nearer one first."""
    outlines = row("A", 4, step_m=0.2)
    first, *_, last = frames("A", 4)
    accepted = [*itertools.combinations(frames("A", 3), 2), (first, last)]
    options = PredictedOptions(least_pairs=3, least_overlap=0.3)
    expected = [(FrameId("A", 2), FrameId("A", 3)), (FrameId("A", 1), FrameId("A", 3))]
    assert predicted(outlines, accepted, options=options) == expected


def test_what_was_tried_is_not_tried_again_and_limits_hold():
    outlines = row("A", 10, step_m=0.05)
    first = predicted(outlines, chain("A", 10))
    assert first
    again = predicted(outlines, chain("A", 10), [*chain("A", 10), *first])
    assert not set(first) & set(again)
    for most in (1, 2):
        options = PredictedOptions(num_frames=most, least_pairs=9)
        found = predicted(outlines, chain("A", 10), options=options)
        count = np.bincount([f.index for pair in found for f in pair], minlength=10)
        assert count.max() == most


@pytest.mark.parametrize(("apart_m", "enough"), [(0.49, True), (0.51, False)])
def test_the_least_overlap_is_of_the_smaller_view(apart_m, enough):
    """A small square that a large one covers in part."""
    a, b = FrameId("A", 0), FrameId("B", 0)
    outlines = {a: 5.0 * SQUARE, b: SQUARE + np.array([4.0 + apart_m, 2.0])}
    assert predicted(outlines, []) == ([(a, b)] if enough else [])


def test_components_and_frames_without_floor_are_left_alone():
    a, b, c = (FrameId(name, 0) for name in "ABC")
    outlines = {a: SQUARE, b: SQUARE + 0.01, c: np.zeros((0, 2))}
    assert predicted(outlines, [], component={a: 0, b: 1, c: 0}) == []
    assert predicted(outlines, [], component={a: 1, b: 1, c: 1}) == [(a, b)]
    assert predicted({c: outlines[c]}, []) == []
    assert predicted({}, []) == []


@given(seed=st.integers(0, 10_000), shift_m=st.floats(-1e5, 1e5), turn=st.floats(-3.0, 3.0))
def test_only_where_views_lie_to_each_other_matters(seed, shift_m, turn):
    rng = np.random.default_rng(seed)
    middle = rng.uniform(0, 3, (12, 2))
    outlines = {f: SQUARE + m for f, m in zip(frames("A", 12), middle, strict=True)}
    moved = Se2(shift_m, -shift_m, turn)
    there = {frame: moved.apply(outline) for frame, outline in outlines.items()}
    shares = {}
    for (a, one), (b, other) in itertools.combinations(outlines.items(), 2):
        common = np.clip(1.0 - np.abs(one[0] - other[0]), 0.0, None)
        shares[a, b] = float(np.prod(common))
    # Far away, doubles leave 1e-11 m; float32 about the middle 1e-7 of an overlap.
    unclear = any(abs(share - 0.5) < 1e-5 for share in shares.values())
    order = sorted(shares.values())
    unclear |= any(b - a < 1e-5 for a, b in itertools.pairwise(order) if b > 0.4)
    found = predicted(outlines, chain("A", 12))
    assert all(shares[pair] > 0.5 - 1e-5 for pair in found)
    assert unclear or predicted(there, chain("A", 12)) == found


def test_the_outline_is_the_floor_that_features_come_from():
    """The hull of the overhead view's cells, turned and moved with the pose."""
    cam, pose = camera(40.0), Se2(2.0, -1.0, 0.7)
    outline = floor_outline(cam, cam.mount.attitude, pose, OverheadOptions())
    grid = overhead_grid(cam, cam.mount.attitude)
    in_foot = pose.inverse().apply(outline)
    ends = grid.floor_from_overhead(
        np.array([[0.0, 0.0], [grid.width_px - 1.0, grid.height_px - 1.0]])
    )
    # The lattice of the outline is 13 px wide: a few centimetres on the floor, farthest ahead.
    np.testing.assert_allclose(in_foot.max(axis=0), ends.max(axis=0), atol=0.08)
    np.testing.assert_allclose(in_foot.min(axis=0), ends.min(axis=0), atol=0.08)
    edges = np.diff(outline, axis=0, append=outline[:1])
    after = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    assert (np.sign(turns) == np.sign(turns[0])).all()  # convex


def test_a_camera_that_sees_no_floor_has_no_outline():
    cam = camera(40.0)
    high = OverheadOptions(max_footprint_cells=1e-6)
    assert floor_outline(cam, cam.mount.attitude, Se2(0, 0, 0), high).shape == (0, 2)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"least_overlap": 0.0}, "least_overlap must lie within 0 to 1, got 0"),
        ({"least_overlap": math.nan}, "least_overlap must lie within 0 to 1, got nan"),
        ({"near_edges": 3}, "near_edges must be even and not negative, got 3"),
        ({"near_edges": -2}, "near_edges must be even and not negative, got -2"),
    ],
)
def test_options_without_sense_are_refused(values, text):
    with pytest.raises(ValueError, match=f"^{text}$"):
        PredictedOptions(**values)
