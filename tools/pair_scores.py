"""Accepted pairs against ground truth: how many are right, and how far off."""

import math
from collections.abc import Iterable, Mapping
from statistics import median
from typing import Any

from groundfuse.backend.measurement import FrameId, RelativePose, Se2

RIGHT_HEIGHTS = 0.03 / 0.55
"""A pair is right within this many camera heights: 30 mm at 0.55 m."""
RIGHT_RAD = math.radians(3.0)


def pair_scores(
    edges: Iterable[RelativePose],
    truth: Mapping[FrameId, Se2],
    height_m: Mapping[FrameId, float],
) -> dict[str, Any] | None:
    """Return counts and medians over the edges between frames of known truth; None without any.

    Args:
        edges: measured pairs.
        truth: true poses in one world.
        height_m: camera height of every frame.
    """
    errors = []
    for edge in edges:
        if edge.a in truth and edge.b in truth:
            error = edge.a_from_b.inverse() @ truth[edge.a].inverse() @ truth[edge.b]
            limit_m = RIGHT_HEIGHTS * min(height_m[edge.a], height_m[edge.b])
            distance_m, turn_rad = math.hypot(error.x_m, error.y_m), abs(error.theta_rad)
            errors.append((distance_m, turn_rad, distance_m < limit_m and turn_rad < RIGHT_RAD))
    if not errors:
        return None
    return {
        "num_pairs": len(errors),
        "num_right": sum(right for _, _, right in errors),
        "median_error_m": median(distance for distance, _, _ in errors),
        "median_error_rad": median(turn for _, turn, _ in errors),
    }
