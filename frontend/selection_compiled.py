"""`selection.combined`, compiled: the same rule, a few cells at once in the processor's cache."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Picture32
from groundfuse.frontend.compiled import compiled
from groundfuse.frontend.selection import BITS, FEWEST_VIEWS, SURVIVING_SPREAD

LANES = 128
"""Cells worked on at once: the compiler turns loops over them into vector instructions."""

GONE = -7_000_000
"""Below -2 c S / n of any colours c and mean S / n: they are 1022 half levels at most."""
DEEPEST = 128
"""So many views at most keep all sums below 2**31."""
NOTHING = -(2**31)
LARGEST = 2**BITS - 1


@compiled
def _discard_half(c: Any, size: Any, alive: Any, total: Any) -> None:  # noqa: ANN401
    """The paper's rule; see `selection.discard_half`. All are whole numbers below 2**31.

    With n views of sum S left, |n c - S|^2 = n (n |c|^2 - 2 c S) + |S|^2: the bracket has the same
    order. A view that is gone gets a square so low that its bracket is below every other.
    """
    num_views = len(c)
    worst = np.zeros(LANES, np.int32)
    most = np.zeros(LANES, np.int32)
    coarsest = np.zeros(LANES, np.float32)
    square = np.zeros((num_views, LANES), np.int32)
    for k in range(num_views):
        for i in range(LANES):
            square[k, i] = c[k, 0, i] ** 2 + c[k, 1, i] ** 2 + c[k, 2, i] ** 2
    for gone in range(num_views // 2):
        left = np.int32(num_views - gone)
        most[:] = NOTHING
        for k in range(num_views):
            for i in range(LANES):
                product = c[k, 0, i] * total[0, i] + c[k, 1, i] * total[1, i]
                product += c[k, 2, i] * total[2, i]
                away = left * square[k, i] - product - product
                farther = (away > most[i]) | ((away == most[i]) & (size[k, i] >= coarsest[i]))
                most[i] = away if farther else most[i]
                coarsest[i] = size[k, i] if farther else coarsest[i]
                worst[i] = np.int32(k) if farther else worst[i]
        for i in range(LANES):
            k = worst[i]
            alive[k, i] = 0
            square[k, i] = GONE
            for channel in range(3):
                total[channel, i] -= c[k, channel, i]


@compiled
def _admit(c: Any, alive: Any, total: Any, noise2: Any, sigmas2: Any) -> None:  # noqa: ANN401
    """Mark the views that agree with the surviving half; see `selection.agreeing_views`."""
    num_views = len(c)
    survivors = num_views - num_views // 2
    share = np.float32(1.0 / survivors)
    third = np.float32(1.0 / 3.0)
    squared = np.zeros((num_views, LANES), np.float32)
    spread = np.zeros(LANES, np.float32)
    for k in range(num_views):
        for i in range(LANES):
            a = np.float32(c[k, 0, i]) - np.float32(total[0, i]) * share
            b = np.float32(c[k, 1, i]) - np.float32(total[1, i]) * share
            d = np.float32(c[k, 2, i]) - np.float32(total[2, i]) * share
            squared[k, i] = (a * a + b * b + d * d) * third
            spread[i] += squared[k, i] * np.float32(alive[k, i]) * share
    factor = sigmas2 * (np.float32(1.0) + share)
    for k in range(num_views):
        for i in range(LANES):
            limit = factor * max(spread[i] * np.float32(SURVIVING_SPREAD), noise2)
            alive[k, i] = 1 if squared[k, i] <= limit else alive[k, i]


@compiled
def _average(c: Any, alive: Any, share: Any, floor: Any, cells: Any) -> None:  # noqa: ANN401
    """Write the weighted means of the marked views."""
    total = np.zeros((4, LANES), np.float32)
    for k in range(len(c)):
        for i in range(LANES):
            used = share[k, i] * np.float32(alive[k, i])
            total[3, i] += used
            for channel in range(3):
                total[channel, i] += np.float32(c[k, channel, i]) * used
    for channel in range(3):
        for i in range(len(cells)):
            floor[channel, cells[i]] = total[channel, i] / total[3, i]


@compiled
def combine_cells(
    words: Any,  # noqa: ANN401 - arrays, typed when compiled
    footprint: Any,  # noqa: ANN401
    weight: Any,  # noqa: ANN401
    cells: Any,  # noqa: ANN401
    limits: tuple[Any, Any],
    floor: Any,  # noqa: ANN401
) -> None:
    """Fill the floor's colours; see `selection.combined`.

    Args:
        words: (n, all cells) colours; see `selection.BITS`.
        footprint: (all cells, n) for the tie rule.
        weight: (n, all cells) positive.
        cells: (m,) those to fill.
        limits: variance of one view in half levels, and the square of the number of sigmas.
        floor: (3, all cells) half levels.
    """
    num_views = len(words)
    c = np.zeros((num_views, 3, LANES), np.int32)
    size = np.zeros((num_views, LANES), np.float32)
    share = np.zeros((num_views, LANES), np.float32)
    alive = np.ones((num_views, LANES), np.int32)
    total = np.zeros((3, LANES), np.int32)
    for start in range(0, len(cells), LANES):
        some = cells[start : start + LANES]
        total[:] = 0
        alive[:] = 1
        for k in range(num_views):
            for i in range(len(some)):
                word = np.int32(words[k, some[i]])
                size[k, i], share[k, i] = footprint[some[i], k], weight[k, some[i]]
                c[k, 0, i] = word & LARGEST
                c[k, 1, i] = (word >> BITS) & LARGEST
                c[k, 2, i] = word >> (2 * BITS)
            for channel in range(3):
                for i in range(LANES):
                    total[channel, i] += c[k, channel, i]
        if num_views >= FEWEST_VIEWS:
            _discard_half(c, size, alive, total)
            _admit(c, alive, total, limits[0], limits[1])
        _average(c, alive, share, floor, some)


def combined(
    colours: NDArray[Any],
    footprint: Picture32,
    weight: Picture32,
    noise: float,
    num_sigmas: float,
) -> Picture32:
    """Return what `selection.combined` does, up to rounding; colours of any whole-number type."""
    blue, green, red = (colours[:, channel].astype(np.uint32) for channel in range(3))
    words = blue | green << np.uint32(BITS) | red << np.uint32(2 * BITS)
    floor: Picture32 = np.empty(colours.shape[1:], dtype=np.float32)
    cells, sizes = np.arange(floor.shape[1]), np.ascontiguousarray(footprint.T)
    limits = np.float32(noise**2), np.float32(num_sigmas**2)
    combine_cells(words, sizes, weight, cells, limits, floor)
    return floor
