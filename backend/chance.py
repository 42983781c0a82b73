"""How many overlaps agree by chance: what tells a second answer from a coincidence.

Among many wrong overlaps some few agree although nothing made them. Two wrong overlaps agree where
one falls into the gate around the other: the gate's volume over that of all places where the second
map could lie. The expected number of agreeing sets of s among m is then (m choose s) p^(s - 1).
"""

import math

import numpy as np

from groundfuse.backend.chain import Forest
from groundfuse.backend.consistency import Links, noise_between
from groundfuse.backend.problem import Array

FULL_TURN_RAD = 2.0 * math.pi


def coincidence(edges: Links, chains: Forest, limit: float) -> float:
    """Return the mean probability that two unrelated overlaps of a pair of maps agree.

    Args:
        edges: all overlaps between the two maps.
        chains: the chains of the maps alone.
        limit: chi2 up to which overlaps agree.
    """
    row, column = np.triu_indices(len(edges.a), 1)
    if not len(row):
        return 0.0
    noise = noise_between(edges.of(row), edges.of(column), chains)
    radius = math.sqrt(limit)
    gate = 4.0 / 3.0 * math.pi * radius**3 * np.sqrt(np.linalg.det(noise))
    # A disc of the same spread as the places of both ends: its variance is a quarter of radius^2
    # along each axis, so the area is 2 pi times the sum over the axes.
    spread = _spread(chains.poses[edges.a]) + _spread(chains.poses[edges.b])
    room = 2.0 * math.pi * spread * FULL_TURN_RAD
    return float(np.minimum(gate, room).mean() / room) if room > 0.0 else 1.0


def _spread(poses: Array) -> float:
    return float(poses[:, :2].var(axis=0).sum())


def expected_sets(num_edges: int, size: int, probability: float) -> float:
    """Return how many agreeing sets of `size` to expect by chance among unrelated edges."""
    return math.comb(num_edges, size) * probability ** (size - 1)
