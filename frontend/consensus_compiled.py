"""The motions most candidates agree on: drawn, voted for, climbed from; compiled, in one call.

Motions are rows `s cos, s sin, x, y` that take floor points of b to a. Motions that pairs of
candidates define are drawn until there are enough, and every feature of a votes. From those with
most votes a least-squares fit to the voters climbs to where no step brings more. Distances to
voters are in single precision, the sums of the least squares in double.
"""

import math

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Mask, Picture32
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


@part
def _distinct(motion: Floats, other: Floats, limits: Limits) -> bool:
    """Return whether two motions are not one and the same."""
    far, turn = _apart(motion, other, limits)
    return far > limits.distinct_m or turn > limits.distinct_rad


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


@part
def _slots(table: Table) -> Picture32:
    """Return the first candidate of every feature of a, the second of every, ... (k, 6, f).

    Six rows: x and y in a, x and y in b, cosine and sine of the turn; nan where there is none. So
    features, not candidates, are next to each other, and counting them is a vector operation.
    """
    depth = 0
    for f in range(len(table.starts) - 1):
        depth = max(depth, table.starts[f + 1] - table.starts[f])
    slots = np.empty((depth, 6, len(table.starts) - 1), np.float32)
    for f in range(len(table.starts) - 1):
        for k in range(depth):
            i = table.starts[f] + k
            for row in range(6):
                if i >= table.starts[f + 1]:
                    slots[k, row, f] = math.nan
                else:
                    slots[k, row, f] = table.places[i, row] if row < 4 else table.turned[i, row - 4]
    return slots


@compiled
def count_votes(table: Table, motions: Floats, limits: Limits, votes: np.ndarray) -> None:
    """Count the features of a with a candidate that a motion explains.

    Args:
        table: candidates.
        motions: (m, 4).
        limits: see there.
        votes: (m,) are written.
    """
    slots = _slots(table)
    nearest, least = np.float32(limits.tolerance_m**2), np.float32(limits.least_cos)
    hit = np.empty(slots.shape[2], np.int32)
    for m in range(len(motions)):
        c, s = np.float32(motions[m, 0]), np.float32(motions[m, 1])
        x, y = np.float32(motions[m, 2]), np.float32(motions[m, 3])
        length = np.float32(math.hypot(motions[m, 0], motions[m, 1]))
        for f in range(len(hit)):
            hit[f] = 0
        for k in range(len(slots)):
            for f in range(len(hit)):
                bx, by = slots[k, 2, f], slots[k, 3, f]
                dx = c * bx - s * by + (x - slots[k, 0, f])
                dy = s * bx + c * by + (y - slots[k, 1, f])
                near = dx * dx + dy * dy < nearest
                against = c * slots[k, 4, f] + s * slots[k, 5, f] < least * length
                hit[f] |= np.int32(near & (not against))
        total = 0
        for f in range(len(hit)):
            total += hit[f]
        votes[m] = total


@part
def _elect(table: Table, motion: Floats, limits: Limits, best_of: np.ndarray, chosen: Mask) -> int:
    """Return the votes for one motion, and mark the nearest voters.

    Of each feature of a the nearest, unless another is nearer to the same feature of b; of equals
    the first. Squared distances of these are left in `best_of[1]`, by feature of b.
    """
    nearest, least = np.float32(limits.tolerance_m**2), np.float32(limits.least_cos)
    c, s = np.float32(motion[0]), np.float32(motion[1])
    x, y = np.float32(motion[2]), np.float32(motion[3])
    length = np.float32(math.hypot(motion[0], motion[1]))
    for i in range(len(chosen)):
        chosen[i] = False
    for b in range(best_of.shape[1]):
        best_of[0, b], best_of[1, b] = -1.0, np.inf
    votes = 0
    for f in range(len(table.starts) - 1):
        best, closest = -1, nearest
        for i in range(table.starts[f], table.starts[f + 1]):
            bx, by = np.float32(table.places[i, 2]), np.float32(table.places[i, 3])
            dx = c * bx - s * by + (x - np.float32(table.places[i, 0]))
            dy = s * bx + c * by + (y - np.float32(table.places[i, 1]))
            squared = dx * dx + dy * dy
            against = c * table.turned[i, 0] + s * table.turned[i, 1] < least * length
            if squared < closest and not against:
                best, closest = i, squared
        if best >= 0:
            votes += 1
            b = table.index_b[best]
            if closest < best_of[1, b]:
                best_of[0, b], best_of[1, b] = best, closest
    for b in range(best_of.shape[1]):
        if best_of[0, b] >= 0.0:
            chosen[int(best_of[0, b])] = True
    return votes


@part
def _fit(table: Table, chosen: Mask, limits: Limits, motion: Floats) -> bool:
    """Write the motion by least squares (Umeyama 1991); false if fewer than two are chosen."""
    places = table.places
    count, ax, ay, bx, by = 0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(chosen)):
        if chosen[i]:
            count, ax, ay = count + 1, ax + places[i, 0], ay + places[i, 1]
            bx, by = bx + places[i, 2], by + places[i, 3]
    if count < 2:
        return False
    ax, ay, bx, by = ax / count, ay / count, bx / count, by / count
    c, s, square = 0.0, 0.0, 0.0
    for i in range(len(chosen)):
        if chosen[i]:
            dx, dy = places[i, 2] - bx, places[i, 3] - by
            c += (places[i, 0] - ax) * dx + (places[i, 1] - ay) * dy
            s += (places[i, 1] - ay) * dx - (places[i, 0] - ax) * dy
            square += dx * dx + dy * dy
    length = math.hypot(c, s)
    if length == 0.0:
        c, length = 1.0, 1.0
    scale = min(max(length / square, 1.0 / limits.max_scale), limits.max_scale)
    motion[0], motion[1] = scale * c / length, scale * s / length
    motion[2] = ax - (motion[0] * bx - motion[1] * by)
    motion[3] = ay - (motion[1] * bx + motion[0] * by)
    return True


@compiled
def climb(table: Table, motion: Floats, limits: Limits, steps: int, chosen: Mask) -> int:
    """Refine a motion (4,) on its voters while its votes do not fall; return them.

    Args:
        table: candidates.
        motion: the start; the refined one is written over it.
        limits: see there.
        steps: most steps.
        chosen: (n,) becomes true for the voters of the last motion.
    """
    best_of = np.empty((2, table.num_b))
    changed, trial = np.empty(4), np.empty_like(chosen)
    votes = _elect(table, motion, limits, best_of, chosen)
    for _ in range(steps):
        if not _fit(table, chosen, limits, changed):
            break
        count = _elect(table, changed, limits, best_of, trial)
        if count < votes:
            break
        votes = count
        for k in range(4):
            motion[k] = changed[k]
        for i in range(len(chosen)):
            chosen[i] = trial[i]
    return votes


@part
def _most(votes: np.ndarray, left: Mask) -> int:
    """Return the first place of those left with most votes; -1 where none is left."""
    best = -1
    for m in range(len(votes)):
        if left[m] and (best < 0 or votes[m] > votes[best]):
            best = m
    return best


@compiled
def search(
    table: Table,
    draws: Floats,
    limits: Limits,
    most: int,
    steps: int,
    found: Floats,
    votes: np.ndarray,
    voters: Mask,
) -> int:
    """Write the distinct motions that climb highest; return how many.

    Args:
        table: candidates.
        draws: see `draw`.
        limits: see there.
        most: motions that are drawn.
        steps: see `climb`.
        found: (k, 4) are written; no more than these are looked for.
        votes: (k,) are written.
        voters: (k, n) are written.
    """
    motions = np.empty((most, 4))
    motions = motions[: draw(table, draws, limits, motions)]
    counts, left = np.empty(len(motions), np.int64), np.ones(len(motions), np.bool_)
    count_votes(table, motions, limits, counts)
    best, known = np.empty(4), 0
    while known < len(found):
        start = _most(counts, left)
        if start < 0:
            break
        for k in range(4):
            best[k] = motions[start, k]
        votes[known] = climb(table, best, limits, steps, voters[known])
        # A start on the slope of a known mode climbs back to it: no rival. One at the edge of the
        # gate may climb out of it.
        new = _inside(best, limits)
        for k in range(known):
            new = new and _distinct(found[k], best, limits)
        for m in range(len(motions)):
            apart = _distinct(motions[m], best, limits)
            left[m] = left[m] and apart and _distinct(motions[m], motions[start], limits)
        if new:
            found[known] = best
            known += 1
    return known
