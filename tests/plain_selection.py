"""The rule by which views of a cell are chosen, in numpy: what the compiled one is held against."""

import numpy as np

from groundfuse.frontend.selection_compiled import FEWEST_VIEWS, SURVIVING_SPREAD


def discard_half(colours, footprint):
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


def _most_deviating(colours, footprint, alive, total, left):
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


def agreeing_views(colours, alive, noise, num_sigmas):
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
    return alive | (squared <= limit)


def combined(colours, footprint, weight, noise, num_sigmas):
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
    return np.einsum("kcn,kn->cn", colours, used) / total
