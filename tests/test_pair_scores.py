"""Pairs are scored against the truth by the height of the camera."""

import math

import numpy as np
import pytest

from groundfuse.backend.measurement import FrameId, RelativePose, Se2
from groundfuse.tools.pair_scores import RIGHT_HEIGHTS, RIGHT_RAD, pair_scores

FRAMES = [FrameId("A", k) for k in range(4)]
TRUTH = {f: Se2(0.3 * f.index, -0.1 * f.index, 0.7 * f.index) for f in FRAMES}


def edge(a, b, error):
    motion = TRUTH[FRAMES[a]].inverse() @ TRUTH[FRAMES[b]] @ error
    return RelativePose(FRAMES[a], FRAMES[b], motion, np.eye(3))


@pytest.mark.parametrize("height_m", [0.1, 0.55, 70.0])
def test_right_within_the_limits_and_wrong_beyond(height_m):
    limit_m = RIGHT_HEIGHTS * height_m
    edges = [
        edge(0, 1, Se2(0.9 * limit_m, 0.0, 0.0)),
        edge(1, 2, Se2(0.0, -1.1 * limit_m, 0.0)),
        edge(2, 3, Se2(0.0, 0.0, -1.1 * RIGHT_RAD)),
        edge(0, 3, Se2(0.0, 0.0, 0.9 * RIGHT_RAD)),
    ]
    scores = pair_scores(edges, TRUTH, dict.fromkeys(FRAMES, height_m))
    assert scores["num_pairs"] == 4
    assert scores["num_right"] == 2


def test_medians_are_of_the_errors():
    edges = [edge(0, k, Se2(0.003 * k, 0.004 * k, 0.01 * k)) for k in (1, 2, 3)]
    scores = pair_scores(edges, TRUTH, dict.fromkeys(FRAMES, 0.55))
    assert math.isclose(scores["median_error_m"], 0.010, rel_tol=1e-9)
    assert math.isclose(scores["median_error_rad"], 0.02, rel_tol=1e-9)


def test_frames_without_truth_do_not_count():
    assert pair_scores([edge(0, 1, Se2(0.0, 0.0, 0.0))], {}, {}) is None
