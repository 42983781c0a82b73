"""The stated overlap of two views is the floor they share."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from world_cameras import BARREL, LENS, camera, view

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.camera import Distortion, Intrinsics
from groundfuse.tools.overlap import (
    RANGE_PER_HEIGHT,
    all_overlaps,
    counted_floor,
    in_view,
    true_overlap,
)


def test_overlap_of_nadir_views_is_that_of_rectangles():
    cam = camera(tilt_deg=0.0)
    long_m, wide_m = 0.55 * 120 / 131, 0.55 * 160 / 131  # the picture's rows lie along x
    for dx, dy in [(0.1, 0.0), (0.0, 0.2), (0.2, -0.3), (-0.3, 0.1)]:
        expected = (1 - abs(dx) / long_m) * (1 - abs(dy) / wide_m)
        found = true_overlap(view(cam), view(cam, Se2(dx, dy, 0.0)))
        # A grid of 0.02 heights cuts a border of length L to 0.003 L: 1 % of the area
        assert found == pytest.approx(expected, abs=0.02)
    assert true_overlap(view(cam), view(cam, Se2(long_m + 0.02, 0.0, 0.0))) == 0.0
    assert true_overlap(view(cam), view(cam, Se2(0.0, 0.0, math.pi))) == pytest.approx(1, abs=0.02)


poses = st.builds(Se2, st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1))


@given(poses, poses, st.sampled_from([LENS, BARREL]), st.floats(0.3, 0.9))
@settings(max_examples=30)
def test_overlap_is_symmetric_and_moves_with_the_world(pose_a, pose_b, lens, height_m):
    a, b = view(camera(), pose_a), view(camera(45.0, height_m, lens), pose_b)
    share = true_overlap(a, b)
    assert share == true_overlap(b, a)
    assert 0.0 <= share <= 1.0
    assert true_overlap(a, a) == 1.0
    moved = Se2(0.3, -2.0, 0.5)
    again = true_overlap(view(a.camera, moved @ pose_a), view(b.camera, moved @ pose_b))
    assert again == pytest.approx(share, abs=0.03)


def test_the_counted_floor_ends_at_the_range_and_at_the_used_rows():
    far = camera(70.0, place=Se2(0.3, 0.1, 0.4))
    pose = Se2(2.0, -1.0, 1.2)
    foot = pose @ far.mount.base_from_foot
    reach = np.hypot(*(counted_floor(view(far, pose)) - (foot.x_m, foot.y_m)).T)
    assert RANGE_PER_HEIGHT * 0.55 - 0.02 < reach.max() <= RANGE_PER_HEIGHT * 0.55
    upper, lower = camera(rows=(0, 59)), camera(rows=(60, 119))
    counts = [len(counted_floor(view(cam))) for cam in (camera(), upper, lower)]
    assert counts[0] == counts[1] + counts[2]
    assert true_overlap(view(upper), view(lower)) == 0.0
    assert true_overlap(view(camera()), view(lower)) == 1.0


def test_floor_behind_the_camera_or_folded_by_the_lens_is_not_seen():
    strong = Intrinsics(160, 120, 131.0, 131.0, 79.5, 59.5, Distortion.PLUMB_BOB, (-0.3, 0, 0, 0))
    seen = in_view(view(camera(45.0, lens=strong)), np.array([[-3.0, 0.0], [0.5, 0.0], [0.0, 1.2]]))
    assert seen.tolist() == [False, True, False]


@given(st.lists(poses, max_size=6))
@settings(max_examples=20)
def test_all_overlaps_are_those_of_all_pairs(places):
    """Views whose boxes do not meet are left out, and nothing else."""
    views = {FrameId("A", k): view(camera(), pose) for k, pose in enumerate(places)}
    expected = {
        (a, b): true_overlap(views[a], views[b]) for a, b in itertools.combinations(views, 2)
    }
    assert all_overlaps(views) == {pair: share for pair, share in expected.items() if share > 0.0}
