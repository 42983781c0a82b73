"""The colour of a floor cell from several views of it, some of which show something else.

The paper's rule (§5.1): discard the view that deviates most from the mean of those that are left,
until half are gone. Here the rule selects; then every view that agrees with the surviving half
counts, because on free floor half the views would be thrown away for nothing.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Mask, Picture32

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


def discard_half(colours: Picture32, footprint: Picture32) -> Mask:
    """Return the views (n, cells) that survive the paper's rule.

    Of equal deviations the view with the larger footprint goes, of equal footprints the later one.

    Args:
        colours: (n, 3, cells) whole numbers below 2**20.
        footprint: (n, cells) length of a pixel on the floor, any unit.
    """
    num_views, _, num_cells = colours.shape
    alive = np.ones((num_views, num_cells), dtype=np.bool_)
    total = colours.sum(axis=0)
    cells = np.arange(num_cells)
    for left in range(num_views, num_views - num_views // 2, -1):
        worst = _most_deviating(colours, footprint, alive, total, left)
        alive[worst, cells] = False
        total -= colours[worst, :, cells].T
    return alive


def _most_deviating(
    colours: Picture32, footprint: Picture32, alive: Mask, total: Picture32, left: int
) -> np.ndarray:
    """Return (cells,) the living view farthest from the mean of the living."""
    worst = np.zeros(colours.shape[2], dtype=np.intp)
    most = np.full(colours.shape[2], -1.0, dtype=np.float32)
    coarsest = np.zeros(colours.shape[2], dtype=np.float32)
    count = np.float32(left)
    for k in range(len(colours)):
        away = count * colours[k] - total
        away *= away
        deviation = away[0] + away[1] + away[2]
        farther = (deviation > most) | ((deviation == most) & (footprint[k] >= coarsest))
        farther &= alive[k]
        np.copyto(most, deviation, where=farther)
        np.copyto(coarsest, footprint[k], where=farther)
        worst[farther] = k
    return worst


def agreeing_views(colours: Picture32, alive: Mask, noise: float, num_sigmas: float) -> Mask:
    """Return the views (n, cells) within `num_sigmas` of the surviving half's mean, and that half.

    A view's sigma is what the half spreads, allowing for its having been selected, or `noise`
    where that is larger; the half's mean has its own share of it.

    Args:
        colours: (n, 3, cells).
        alive: (n, cells) the surviving half.
        noise: standard deviation of one view, same unit as the colours.
        num_sigmas: how far a view may lie from the mean.
    """
    num_views = len(colours)
    survivors = num_views - num_views // 2
    kept = alive.astype(np.float32)
    mean = np.einsum("kcn,kn->cn", colours, kept) / np.float32(survivors)
    squared = np.square(colours - mean).mean(axis=1)
    spread = np.einsum("kn,kn->n", squared, kept) / np.float32(survivors)
    variance = np.maximum(spread * np.float32(SURVIVING_SPREAD), np.float32(noise**2))
    limit = np.float32(num_sigmas**2 * (1.0 + 1.0 / survivors)) * variance
    agreeing: Mask = alive | (squared <= limit)
    return agreeing


def combined(
    colours: NDArray[Any],
    footprint: Picture32,
    weight: Picture32,
    noise: float,
    num_sigmas: float,
) -> Picture32:
    """Return the floor's colour (3, cells): the weighted mean of the views that agree.

    Fewer than three views can't outvote anything: their plain weighted mean.

    Args:
        colours: (n, 3, cells) whole numbers, 0 to 1022 half levels.
        footprint: (n, cells) for the tie rule.
        weight: (n, cells) positive.
        noise: standard deviation of one view, same unit as the colours.
        num_sigmas: see `agreeing_views`.
    """
    used, colours = weight, colours.astype(np.float32, copy=False)
    if len(colours) >= FEWEST_VIEWS:
        alive = discard_half(colours, footprint)
        used = weight * agreeing_views(colours, alive, noise, num_sigmas)
    total = used.sum(axis=0)
    mean: Picture32 = np.einsum("kcn,kn->cn", colours, used) / total
    return mean
