"""Exposure of every picture and vignetting of every lens, from the floor that pictures share.

Model, in logarithms of the recorded values: picture = floor + gain(view, channel) + falloff, with
falloff = c1 r^2 + c2 r^4 + c3 r^6 of the robot's lens, r from the principal point in half
diagonals. A gamma curve keeps the model: powers of products are products of powers. The floor's
own colours are eliminated cell by cell; what stands on the floor is outvoted (Cauchy weights).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from groundfuse.backend.ordering import stable_order
from groundfuse.backend.side_by_side import side_by_side
from groundfuse.frontend.arrays import Floats
from groundfuse.frontend.camera import Intrinsics
from groundfuse.frontend.gains_compiled import (
    CHANNELS,
    POWERS,
    cell_sums,
    differences,
    distances,
    view_rows,
)
from groundfuse.frontend.middle import middle

Numbers = NDArray[np.intp]
"""(n,) which cell, view or lens."""
Short = NDArray[np.uint32]
"""The same, in compiled loops."""

ITERATIONS = 12
STILL = 3e-4
"""Gains that change by less than 0.03 % have been found: a third of what a view with a thousand
samples, good to 3 % each, knows of its own, and a thirtieth of a level."""
SMALLEST_SCALE = 0.01
"""One per cent: below, differences are rounding, and weights would follow it."""
GAIN_PRIOR = 0.005
"""Weight of "the exposure was the usual one" against one sample of the view's, as if samples were
good to 3 % and exposures varied by 40 %: long chains don't wander off into light or dark, while a
difference between neighbours is evened out to less than 1 % of itself."""
FALLOFF_PRIOR = 0.01
"""Weight of "no falloff" in samples: decides only what overlaps leave open."""
SMALLEST_NOISE_LEVELS = 1.0
USUAL_NOISE_LEVELS = 3.0
PARTS = 8
"""Of the cells that add up on their own: so sums don't depend on the number of threads."""
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Floor cells seen by pictures, one row per cell and picture.

    Attributes:
        cell: (n,) number of the cell.
        view: (n,) number of the picture.
        radius2: (n,) squared distance from the principal point, half diagonals.
        colour: (n, 3) mean BGR over the cell.
        point: (n, 3) BGR at the cell's centre, as fine as the mosaic.
    """

    cell: Numbers
    view: Numbers
    radius2: Floats
    colour: Floats
    point: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """What pictures are divided by, and the noise that is left.

    Attributes:
        log_gain: (views, 3) BGR.
        falloff: (views, 3) coefficients of r^2, r^4, r^6 of each picture's lens.
        noise_levels: standard deviation of one view of one cell, 8-bit levels.
    """

    log_gain: Floats
    falloff: Floats
    noise_levels: float


def neutral_exposure(num_views: int) -> Exposure:
    """Return the exposure that changes nothing."""
    none = np.zeros((num_views, 3))
    return Exposure(none, none, USUAL_NOISE_LEVELS)


def radius_squared(lens: Intrinsics, px: Floats) -> Floats:
    """Return squared distances (...) of pixels (..., 2) from the centre, half diagonals."""
    offset = px - np.array([lens.cx_px, lens.cy_px])
    squared: Floats = (offset[..., 0] ** 2 + offset[..., 1] ** 2) / half_diagonal_px(lens) ** 2
    return squared


def half_diagonal_px(lens: Intrinsics) -> float:
    """Return half the length of a picture's diagonal."""
    return math.hypot(lens.width_px, lens.height_px) / 2.0


def estimate_exposure(samples: Samples, lens_of_view: Numbers) -> Exposure:
    """Fit gains and falloffs to the floor that pictures share.

    Args:
        samples: of all pictures; cells that only one picture sees tell nothing and may be there.
        lens_of_view: (views,) number of each picture's lens.
    """
    _, cell, seen = np.unique(samples.cell, return_inverse=True, return_counts=True)
    shared = seen[cell] > 1
    if not shared.any():
        return neutral_exposure(len(lens_of_view))
    by_cell_and_view = cell[shared] * len(lens_of_view) + samples.view[shared]
    order = np.flatnonzero(shared)[stable_order(by_cell_and_view)]
    floor = _floor(samples, order, seen[seen > 1], lens_of_view)
    gain, falloff = _robust_fit(floor)
    noise_levels = _noise(floor, samples.point[order], gain, falloff)
    return Exposure(gain, falloff[lens_of_view], noise_levels)


class _Floor(NamedTuple):
    """Samples in order of their cells, and of the views in a cell.

    Attributes:
        seen: see `cell_sums`; the values are logarithms.
        begins: see `cell_sums`.
        places: see `view_rows`.
        pattern: see `view_rows`.
        lens_of_view: (views,).
    """

    seen: tuple[Short, Short, Floats, Floats]
    begins: tuple[Short, Short, Short]
    places: tuple[Short, Short, Short]
    pattern: tuple[Short, Short]
    lens_of_view: Numbers


def _floor(samples: Samples, order: Numbers, number: Numbers, lens_of_view: Numbers) -> _Floor:
    """Return samples in their `order`, so many of each cell."""
    view, num_views = samples.view[order], len(lens_of_view)
    lens, values = lens_of_view[view], np.log(np.maximum(samples.colour[order], 1.0))
    begins, cell = _ends(number), np.repeat(np.arange(len(number)), number)
    is_first = np.append(True, (np.diff(cell) > 0) | (np.diff(lens) != 0))
    of_run = np.append(np.flatnonzero(is_first), len(view))
    runs_of_cell = np.searchsorted(of_run, begins)
    shape = len(number), num_views
    by_view = sparse.csc_array(sparse.csr_array((np.arange(len(view)), view, begins), shape))
    seen = sparse.csr_array((np.ones(len(view), np.bool_), view, begins), shape)
    together = sparse.csr_array(sparse.triu(seen.T @ seen))
    together.sort_indices()
    return _Floor(
        (_short(view), _short(lens), samples.radius2[order], values),
        (_short(begins), _short(runs_of_cell), _short(of_run)),
        (_short(cell), _short(by_view.data), _short(by_view.indptr)),
        (_short(together.indptr), _short(together.indices)),
        lens_of_view,
    )


def _ends(number: Numbers) -> Numbers:
    """Return the first of each group of so many, and the number of all."""
    return np.append(0, np.cumsum(number))


def _short(numbers: np.ndarray[Any, Any]) -> Short:
    """Return places that compiled loops need not check for counting from the end."""
    return numbers.astype(np.uint32)


def _robust_fit(floor: _Floor) -> tuple[Floats, Floats]:
    """Least squares, reweighted: log gains (views, 3), the falloffs' coefficients (lenses, 3)."""
    weight, distance = np.ones(len(floor.seen[0])), np.empty(len(floor.seen[0]))
    gain = np.zeros((len(floor.lens_of_view), CHANNELS))
    falloff = np.zeros((int(floor.lens_of_view.max()) + 1, POWERS))
    for _ in range(ITERATIONS):
        before = gain
        gain, falloff = _solve(floor, weight)
        if np.abs(gain - before).max() < STILL:
            break
        _fill_distances(floor, weight, (gain, falloff), distance)
        scale = max(MAD_TO_SIGMA * float(middle(distance)), SMALLEST_SCALE)
        weight = 1.0 / (1.0 + (distance / scale) ** 2)
    return gain, falloff


def _fill_distances(
    floor: _Floor, weight: Floats, found: tuple[Floats, Floats], distance: Floats
) -> None:
    """Fill how far samples lie off their cells' means, with these gains and falloffs."""
    begins = floor.begins[0]

    def fill(cells: slice) -> None:
        distances(floor.seen, begins[cells.start : cells.stop + 1], weight, *found, distance)

    side_by_side(fill, len(begins) - 1)


def _solve(floor: _Floor, weight: Floats) -> tuple[Floats, Floats]:
    """Weighted least squares with each cell's own colour eliminated.

    The falloff is the same in all channels, so it follows from their mean, and then each channel's
    gains follow on their own. Few pairs of views share floor: the gains' block is sparse.
    """
    normal = _normal_equations(floor, weight)
    samples = np.bincount(floor.seen[0], weight, len(floor.lens_of_view))
    prior = sparse.diags_array(GAIN_PRIOR * np.maximum(samples, 1.0))
    symmetric = {"SymmetricMode": True}  # positive definite: it needs no pivots
    block = sparse.csc_array(normal.of_gain + prior)
    solved = splu(block, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric).solve
    # Block elimination: the falloff of the mean channel first.
    both, of_falloff = normal.both, normal.of_falloff - normal.both.T @ solved(normal.both)
    of_falloff += FALLOFF_PRIOR * np.eye(len(of_falloff))
    mean, falloff_mean = normal.right.mean(axis=1), normal.right_of_falloff.mean(axis=1)
    falloff = np.linalg.solve(of_falloff, falloff_mean - both.T @ solved(mean))
    gain: Floats = solved(normal.right - (both @ falloff)[:, None])
    return gain, falloff.reshape(-1, POWERS)


class _Normal(NamedTuple):
    """Normal equations in blocks.

    Attributes:
        of_gain: (views, views), sparse.
        both: (views, columns) between gains and falloffs.
        right: (views, 3).
        of_falloff: (columns, columns).
        right_of_falloff: (columns, 3).
    """

    of_gain: sparse.csr_array
    both: Floats
    right: Floats
    of_falloff: Floats
    right_of_falloff: Floats


def _normal_equations(floor: _Floor, weight: Floats) -> _Normal:
    """Return them, each cell's own colour eliminated."""
    (of_cell, runs_of_cell, of_run), num_views = floor.begins, len(floor.lens_of_view)
    num_cells, columns = len(of_cell) - 1, POWERS * (int(floor.lens_of_view.max()) + 1)
    whole, mean = np.empty(num_cells), np.empty((num_cells, CHANNELS))
    sums = np.empty((len(of_run) - 1, POWERS))
    of_falloff, right_of_falloff = (np.zeros((PARTS, columns, n)) for n in (columns, CHANNELS))
    ends = [num_cells * k // PARTS for k in range(PARTS + 1)]

    def add(parts: slice) -> None:
        for k in range(parts.start, parts.stop):
            some, ended = slice(ends[k], ends[k + 1]), slice(ends[k], ends[k + 1] + 1)
            begins, cells = (of_cell[ended], runs_of_cell[ended], of_run), (whole[some], mean[some])
            cell_sums(floor.seen, begins, weight, cells, sums, (of_falloff[k], right_of_falloff[k]))

    between, both = np.empty(len(floor.pattern[1])), np.zeros((num_views, columns))
    right = np.zeros((num_views, CHANNELS))

    def fill(views: slice) -> None:
        weighted, rows = (weight, whole, mean, sums), (between, both, right)
        some = views.start, views.stop
        view_rows(floor.seen, floor.places, floor.begins, weighted, floor.pattern, rows, some)

    side_by_side(add, PARTS, least_items=PARTS)
    side_by_side(fill, num_views)
    starts, others = floor.pattern
    upper = sparse.csr_array((between, others, starts), shape=(num_views, num_views))
    of_gain = upper + sparse.triu(upper, 1).T
    return _Normal(of_gain, both, right, of_falloff.sum(axis=0), right_of_falloff.sum(axis=0))


def _noise(floor: _Floor, point: Floats, gain: Floats, falloff: Floats) -> float:
    """Standard deviation of one view of a cell: from differences between two views of it."""
    begins = floor.begins[0]
    difference = np.empty((len(point) - len(begins) + 1, CHANNELS))

    def fill(cells: slice) -> None:
        some = cells.start, begins[cells.start : cells.stop + 1]
        differences(floor.seen, some, point, np.exp(-gain), falloff, difference)

    side_by_side(fill, len(begins) - 1)
    sigma = MAD_TO_SIGMA * float(middle(difference.ravel())) / np.sqrt(2.0)
    return max(float(sigma), SMALLEST_NOISE_LEVELS)
