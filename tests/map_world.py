"""A small team with a mosaic, made up, for the tests of drawings and 3D files."""

import math
from itertools import pairwise

import numpy as np

from groundfuse.backend.measurement import (
    IDENTITY,
    Anchor,
    EdgeVerdict,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
    TeamEstimate,
)
from groundfuse.frontend.mosaic import Mosaic

COVARIANCE = np.diag([4e-6, 1e-6, 1e-6])


def small_mosaic(rows=120, columns=200, cell_m=0.01, x_min_m=-0.4, y_max_m=0.6):
    rng = np.random.default_rng(1)
    floor = rng.integers(90, 110, (rows, columns, 3)).astype(np.uint8)
    count = np.full((rows, columns), 4, np.uint16)
    count[:20, :30] = 0
    floor[count == 0] = 0
    return Mosaic(floor, floor, count, count == 9, x_min_m, y_max_m, cell_m)


def circle(robot, number, centre_x_m, radius_m=0.3):
    turns = 2 * math.pi * np.arange(number) / number
    return {
        FrameId(robot, i): Se2(
            centre_x_m + radius_m * math.cos(t), radius_m * math.sin(t), t + math.pi / 2
        )
        for i, t in enumerate(turns)
    }


def edge(poses, a, b, noise=IDENTITY, covariance=COVARIANCE):
    return RelativePose(a, b, poses[a].inverse() @ poses[b] @ noise, covariance)


def small_team(number=6):
    """Estimate and edges: two circles, a loop each, two overlaps of which one was turned down."""
    poses = circle("A", number, 0.0) | circle("B", number, 0.8)
    a = [FrameId("A", i) for i in range(number)]
    b = [FrameId("B", i) for i in range(number)]
    edges = [edge(poses, *pair) for robot in (a, b) for pair in pairwise(robot)]
    edges += [edge(poses, a[0], a[-1]), edge(poses, a[0], b[3 % number])]
    down = edge(poses, a[1], b[2 % number])
    tried = Rejected(a[2 % number], b[4 % number], Reason.FEW_INLIERS, 5.0, 20.0)
    verdicts = [EdgeVerdict(e.a, e.b, accepted=True, chi2=2.0, limit=11.3) for e in edges]
    verdicts.append(EdgeVerdict(down.a, down.b, accepted=False, chi2=99.0, limit=11.3))
    anchors = (
        Anchor("A", 0, 0, a[0], IDENTITY, None, 1),
        Anchor("B", 0, 0, b[0], poses[b[0]], np.diag([1e-6, 1e-6, 1e-6]), 1),
    )
    estimate = TeamEstimate(
        poses,
        dict.fromkeys(poses, 0),
        {frame: COVARIANCE for frame in poses if frame != a[0]},
        anchors,
        tuple(verdicts),
        30.0,
        12,
    )
    return estimate, [*edges, down, tried]
