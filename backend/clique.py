"""The largest set of mutually agreeing things; pure Python on bit sets.

Exact branch and bound with a colouring bound (Tomita and Seki 2003). Listing all maximal cliques
would hang on dense agreement; this needs milliseconds there, because the bound is met at once.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

MAX_VISITS = 20_000  # nodes of the search; beyond it the best set found so far is returned


def largest_clique(adjacent: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the largest set of mutually adjacent nodes, ascending; (m, m) symmetric flags.

    The first set tried is greedy by degree, so an answer cut short at MAX_VISITS is no worse.
    """
    m = len(adjacent)
    if m == 0:
        return np.empty(0, dtype=np.int64)
    order = np.argsort(-adjacent.sum(axis=1), kind="stable")
    flags = adjacent[np.ix_(order, order)] & ~np.eye(m, dtype=bool)
    sets = [
        int.from_bytes(np.packbits(row, bitorder="little").tobytes(), "little") for row in flags
    ]
    best = _greedy(sets)
    stack: list[tuple[list[int], Iterator[tuple[int, int, int]]]] = [
        ([], _coloured(sets, (1 << m) - 1))
    ]
    visits = 0
    while stack and visits < MAX_VISITS:
        chosen, branches = stack[-1]
        branch = next(branches, None)
        if branch is None or len(chosen) + branch[1] <= len(best):
            stack.pop()
            continue
        visits += 1
        node, _, remaining = branch
        grown, remaining = [*chosen, node], remaining & sets[node]
        whole = [*grown, *_nodes(remaining)] if _is_clique(sets, remaining) else grown
        if len(whole) > len(best):
            best = whole
        if whole is grown:
            stack.append((grown, _coloured(sets, remaining)))
    return np.sort(order[np.array(best, dtype=np.int64)])


def _greedy(sets: list[int]) -> list[int]:
    """Return a maximal clique, taking nodes in their order."""
    chosen, candidates = [], (1 << len(sets)) - 1
    while candidates:
        node = (candidates & -candidates).bit_length() - 1
        chosen.append(node)
        candidates &= sets[node]
    return chosen


def _nodes(among: int) -> Iterator[int]:
    """Yield the nodes of a set, ascending."""
    while among:
        yield (among & -among).bit_length() - 1
        among &= among - 1


def _is_clique(sets: list[int], among: int) -> bool:
    """Return whether all nodes of a set are adjacent to each other."""
    return all(among & ~sets[node] == 1 << node for node in _nodes(among))


def _coloured(sets: list[int], candidates: int) -> Iterator[tuple[int, int, int]]:
    """Yield (node, bound, the candidates left when it is tried), the highest bound first.

    Nodes of one colour are mutually not adjacent, so no clique among the first c colours has more
    than c nodes.
    """
    coloured, uncoloured, colour = [], candidates, 0
    while uncoloured:
        colour += 1
        free = uncoloured
        while free:
            bit = free & -free
            node = bit.bit_length() - 1
            coloured.append((node, colour))
            uncoloured ^= bit
            free = (free ^ bit) & ~sets[node]
    for node, bound in reversed(coloured):
        yield node, bound, candidates
        candidates &= ~(1 << node)
