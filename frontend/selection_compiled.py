"""The colour of a floor cell from several views of it, some of which show something else.

The paper's rule (§5.1): discard the view that deviates most from the mean of those that are left,
until half are gone; of equal deviations the view with the larger footprint goes, of equal
footprints the later one. Here the rule selects; then every view that agrees with the surviving
half counts, because on free floor half the views would be thrown away for nothing: a view agrees
within so many sigmas of the half's mean, where a sigma is what the half spreads, allowing for its
having been selected, or the noise where that is larger, and the half's mean has its own share.

Compiled, a few cells at once in the processor's cache.
"""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled

LEVEL = 2.0
"""Colours are whole numbers of half levels: sums are exact, so that equal deviations are equal
on every machine and the tie rule decides, not rounding."""
BITS = 10
"""Of a colour's half levels: blue, green and red fit into one word, blue lowest."""
FEWEST_VIEWS = 3
"""With fewer views no majority shows the floor."""
SURVIVING_SPREAD = 4.0
"""Variance of views over that of their surviving half. Grey noise gives 8 to 12 from five views on
(the half is selected for its small spread), noise that differs between channels about 2.5. Too
small a value averages fewer views; too large a one lets obstacles in."""
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
    """The paper's rule. All are whole numbers below 2**31.

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
                product = np.int32(c[k, 0, i] * total[0, i])  # without the word it has 64 bits
                product += np.int32(c[k, 1, i] * total[1, i])
                product += np.int32(c[k, 2, i] * total[2, i])
                away = np.int32(np.int32(left * square[k, i]) - np.int32(2 * product))
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
    """Mark the views that agree with the surviving half."""
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
    """Fill the floor's colours: the weighted means of the views that agree.

    Fewer than three views can't outvote anything: their plain weighted mean.

    Args:
        words: (n, all cells) colours; see `BITS`.
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
