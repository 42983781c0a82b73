"""Motions that pairs of candidates define, drawn until there are enough; compiled.

Motions are rows `s cos, s sin, x, y` that take floor points of b to a.
"""

import math

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Mask
from groundfuse.frontend.consensus_table import Limits, Table

PARTS = 8
"""Parts of the weight per candidate: most begin at the candidate they end at."""


@part
def _apart(motion: Floats, other: Floats, limits: Limits) -> tuple[float, float]:
    """Return how far two motions differ at the view's centre (m), and in turn (rad)."""
    c, s = motion[0] - other[0], motion[1] - other[1]
    dx = c * limits.centre_x_m - s * limits.centre_y_m + (motion[2] - other[2])
    dy = s * limits.centre_x_m + c * limits.centre_y_m + (motion[3] - other[3])
    cosine = motion[0] * other[0] + motion[1] * other[1]
    sine = motion[1] * other[0] - motion[0] * other[1]
    return math.sqrt(dx * dx + dy * dy), abs(math.atan2(sine, cosine))


@part
def _inside(motion: Floats, limits: Limits) -> bool:
    """Return whether the gate allows a motion.

    Judged at the view's centre, where a motion is known best; a turn swings it about foot b.
    """
    if limits.gate_m == math.inf:
        return True
    far, turn = _apart(motion, limits.gate, limits)
    return far <= limits.gate_m + turn * limits.gate_m_per_rad and turn <= limits.gate_rad


@compiled
def distinct(motions: Floats, other: Floats, limits: Limits) -> Mask:
    """Return which motions (m, 4) are not one and the same as another."""
    mask = np.empty(len(motions), np.bool_)
    for m in range(len(motions)):
        far, turn = _apart(motions[m], other, limits)
        mask[m] = far > limits.distinct_m or turn > limits.distinct_rad
    return mask


@compiled
def allowed(motion: Floats, limits: Limits) -> bool:
    """Return whether a motion is inside the gate."""
    return _inside(motion, limits)


@part
def _guide(cumulative: Floats) -> np.ndarray:
    """For each part of the weight, the first candidate that reaches it (Chen and Asau 1974)."""
    count = PARTS * len(cumulative)
    guide = np.empty(count, np.int32)
    at = 0
    for k in range(count):
        while cumulative[at] < cumulative[-1] * k / count:
            at += 1
        guide[k] = at
    return guide


@part
def _picked(share: float, cumulative: Floats, guide: np.ndarray) -> int:
    """Return the first candidate at which the running weight reaches a share of the whole."""
    # Rounding may carry the share into the part above its own: begin a part further down.
    at = guide[max(0, int(share * len(guide)) - 1)]
    while cumulative[at] < share * cumulative[-1]:
        at += 1
    return int(at)


@part
def _define(table: Table, one: int, two: int, limits: Limits, motion: Floats) -> bool:
    """Write the motion that two candidates define; false if they contradict each other."""
    places = table.places
    ax, ay = places[two, 0] - places[one, 0], places[two, 1] - places[one, 1]
    bx, by = places[two, 2] - places[one, 2], places[two, 3] - places[one, 3]
    length_a, length_b = math.sqrt(ax * ax + ay * ay), math.sqrt(bx * bx + by * by)
    slack = 2.0 * limits.tolerance_m + (limits.max_scale - 1.0) * length_b
    if length_a <= limits.shortest_m or length_b <= limits.shortest_m:
        return False
    if abs(length_a - length_b) >= slack:
        return False
    c = (ax * bx + ay * by) / (length_a * length_b)
    s = (ay * bx - ax * by) / (length_a * length_b)
    if c * table.turned[one, 0] + s * table.turned[one, 1] < limits.least_cos:
        return False
    if c * table.turned[two, 0] + s * table.turned[two, 1] < limits.least_cos:
        return False
    scale = min(max(length_a / length_b, 1.0 / limits.max_scale), limits.max_scale)
    c, s = scale * c, scale * s
    bx, by = (places[one, 2] + places[two, 2]) / 2.0, (places[one, 3] + places[two, 3]) / 2.0
    motion[0], motion[1] = c, s
    motion[2] = (places[one, 0] + places[two, 0]) / 2.0 - c * bx + s * by
    motion[3] = (places[one, 1] + places[two, 1]) / 2.0 - s * bx - c * by
    return True


@compiled
def draw(table: Table, draws: Floats, limits: Limits, motions: Floats) -> int:
    """Write motions of drawn pairs of candidates that agree, inside the gate; return how many.

    Args:
        table: candidates.
        draws: (2, num_draws) from 0 to 1, for the one and the other candidate.
        limits: see there.
        motions: (m, 4) are written; drawing ends when all are.
    """
    guide = _guide(table.cumulative)
    found = 0
    for k in range(draws.shape[1]):
        if found == len(motions):
            break
        one = _picked(draws[0, k], table.cumulative, guide)
        two = _picked(draws[1, k], table.cumulative, guide)
        if _define(table, one, two, limits, motions[found]) and _inside(motions[found], limits):
            found += 1
    return found
