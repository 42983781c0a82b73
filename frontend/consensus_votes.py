"""Who votes for a motion, and the motion that suits its voters best; compiled.

Motions are rows `s cos, s sin, x, y` that take floor points of b to a. Distances to voters are in
single precision, the sums of the least squares in double.
"""

import math

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Mask, Picture32
from groundfuse.frontend.consensus_table import Limits, Table


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
