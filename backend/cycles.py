"""Cycles of maps: which hypotheses of different pairs of maps agree with each other.

Wrong overlaps that agree among themselves (a floor that repeats) outvote the right ones between two
maps, but the wrong displacement of one pair does not match those of the others: around a cycle of
three or more maps only right ones close, whatever their number.
"""

from collections import deque
from collections.abc import Sequence
from itertools import combinations, pairwise, product

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.chain import Forest
from groundfuse.backend.consistency import Links
from groundfuse.backend.hypotheses import Hypothesis
from groundfuse.backend.problem import Array, Indices

Cycle = tuple[int, ...]  # numbers of hypotheses around a closed walk of maps

MAX_TRIANGLES_PER_PAIR = 12
MAX_COMBINATIONS = 4096


def closed_cycles(
    found: Sequence[Hypothesis], edges: Links, chains: Forest, limit: float
) -> list[Cycle]:
    """Return the combinations of hypotheses that close around a cycle of maps.

    Triangles where a pair of maps has any, its shortest cycle otherwise.

    Args:
        found: hypotheses of all pairs.
        edges: all candidate edges as statements about maps, a-side in the lower map.
        chains: the chains of the maps alone.
        limit: chi2 above which a cycle does not close.
    """
    by_pair: dict[tuple[int, int], list[int]] = {}
    for k, hypothesis in enumerate(found):
        by_pair.setdefault(hypothesis.maps, []).append(k)
    strength = {pair: found[ks[0]].support for pair, ks in by_pair.items()}
    closed: list[Cycle] = []
    seeds = np.array([h.seed for h in found], dtype=np.int64)
    for length, walks in _by_length(_walks(strength)).items():
        combos: list[Cycle] = []
        turns: list[list[bool]] = []
        for walk in walks:
            hops = list(pairwise([*walk, walk[0]]))
            options = [by_pair[min(h), max(h)] for h in hops]
            while np.prod([len(o) for o in options]) > MAX_COMBINATIONS:
                options = [o[: max(1, len(o) - 1)] for o in options]
            some = list(product(*options))
            combos += some
            turns += [[f < g for f, g in hops]] * len(some)
        index = np.array(combos).reshape(-1, length)
        chi2 = cycle_chi2(edges, chains, seeds[index], np.array(turns).reshape(-1, length))
        closed += [tuple(row) for row in index[chi2 <= limit].tolist()]
    return closed


def _by_length(walks: list[tuple[int, ...]]) -> dict[int, list[tuple[int, ...]]]:
    grouped: dict[int, list[tuple[int, ...]]] = {}
    for walk in walks:
        grouped.setdefault(len(walk), []).append(walk)
    return grouped


def _walks(strength: dict[tuple[int, int], int]) -> list[tuple[int, ...]]:
    """Return cycles of maps (three or more), each once."""
    near: dict[int, list[int]] = {}
    for f, g in sorted(strength):
        near.setdefault(f, []).append(g)
        near.setdefault(g, []).append(f)
    walks: dict[frozenset[tuple[int, int]], tuple[int, ...]] = {}
    for f, g in sorted(strength):
        thirds = sorted(set(near[f]) & set(near[g]))
        thirds.sort(key=lambda h: -min(strength[_pair(f, h)], strength[_pair(g, h)]))
        for h in thirds[:MAX_TRIANGLES_PER_PAIR]:
            walk = tuple(sorted((f, g, h)))
            walks.setdefault(frozenset(combinations(walk, 2)), walk)
        path = [] if thirds else _around(near, f, g)
        if path:
            key = frozenset(_pair(i, j) for i, j in pairwise([*path, path[0]]))
            walks.setdefault(key, tuple(path))
    return list(walks.values())


def _pair(f: int, g: int) -> tuple[int, int]:
    return min(f, g), max(f, g)


def _around(near: dict[int, list[int]], f: int, g: int) -> list[int]:
    """Return the shortest path from f to g that does not take their direct link; empty if none."""
    before, queue = {f: f}, deque([f])
    while queue:
        here = queue.popleft()
        for there in near[here]:
            if there in before or (here == f and there == g):
                continue
            before[there] = here
            queue.append(there)
    path = [g] if g in before else []
    while path and path[-1] != f:
        path.append(before[path[-1]])
    return path


def cycle_chi2(edges: Links, chains: Forest, hops: Indices, forward: Array) -> Array:
    """Return (c,) chi2 of closed walks over maps.

    Args:
        edges: candidate edges.
        chains: the chains of the maps alone.
        hops: (c, length) edge of every hop.
        forward: (c, length) whether the hop goes from the edge's a to its b.
    """
    count, length = hops.shape
    first_from_here, noise = np.zeros((count, 3)), np.zeros((count, 3, 3))
    arrived = first_left = np.zeros(count, dtype=np.int64)
    for k in range(length):
        hop, ahead = edges.of(hops[:, k]), forward[:, k]
        left = np.where(ahead, hop.a, hop.b)
        if k:
            noise = noise + chains.between(arrived, left)
        else:
            first_left = left
        step = np.where(ahead[:, None], hop.f_from_g, planar.inverse(hop.f_from_g))
        turned = planar.carried(planar.adjoint(hop.f_from_g), hop.noise)
        added = np.where(ahead[:, None, None], hop.noise, turned)
        noise = planar.carried(planar.adjoint(planar.inverse(step)), noise) + added
        first_from_here = planar.compose(first_from_here, step)
        arrived = np.where(ahead, hop.b, hop.a)
    noise = noise + chains.between(arrived, first_left)
    return planar.mahalanobis2(planar.log(first_from_here), noise)
