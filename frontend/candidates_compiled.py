"""Candidate matches of two views, and how the consensus' loops have them; compiled.

Each of these is a dozen short array operations in numpy, and after each of those a thread may wait
for the interpreter's lock.
"""

import math

import numpy as np

from groundfuse.backend.compiled import compiled
from groundfuse.frontend.arrays import Floats, Picture32, Points


@compiled
def of_like_size(
    nearest: np.ndarray, log_size_a: Floats, log_size_b: Floats, most: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nearest features that are of like size.

    Args:
        nearest: (n, k) features of b for each of a, the nearest first.
        log_size_a: (n,) log of their sizes.
        log_size_b: (m,) the same.
        most: largest difference of these.

    Returns:
        features of a, of b, and ranks, each (c,), by feature of a and then by rank.
    """
    count = 0
    for a in range(len(nearest)):
        for b in nearest[a]:
            count += int(abs(log_size_a[a] - log_size_b[b]) < most)
    index_a, index_b = np.empty(count, np.int64), np.empty(count, np.int64)
    rank = np.empty(count, np.int64)
    at = 0
    for a in range(len(nearest)):
        for k in range(nearest.shape[1]):
            if abs(log_size_a[a] - log_size_b[nearest[a, k]]) < most:
                index_a[at], index_b[at], rank[at] = a, nearest[a, k], k
                at += 1
    return index_a, index_b, rank


@compiled
def laid_out(
    floor_a: Points, floor_b: Points, index_a: np.ndarray, rank: np.ndarray, turn_rad: Floats
) -> tuple[Floats, Picture32, Floats, np.ndarray]:
    """Return places, turns, weights and starts of candidates; see `consensus_table.Table`."""
    count = len(index_a)
    places, turned = np.empty((count, 4)), np.empty((count, 2), np.float32)
    cumulative, starts = np.empty(count), np.empty(count + 1, np.int64)
    weight, num = 0.0, 0
    for i in range(count):
        places[i, 0], places[i, 1] = floor_a[i, 0], floor_a[i, 1]
        places[i, 2], places[i, 3] = floor_b[i, 0], floor_b[i, 1]
        turned[i, 0], turned[i, 1] = math.cos(turn_rad[i]), math.sin(turn_rad[i])
        weight += 1.0 / (1.0 + rank[i])
        cumulative[i] = weight
        if i == 0 or index_a[i] != index_a[i - 1]:
            starts[num] = i
            num += 1
    starts[num] = count
    return places, turned, cumulative, starts[: num + 1].copy()
