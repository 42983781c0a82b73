"""Exposure of every picture and vignetting of every lens, from the floor that pictures share.

Model, in logarithms of the recorded values: picture = floor + gain(view, channel) + falloff, with
falloff = c1 r^2 + c2 r^4 + c3 r^6 of the robot's lens, r from the principal point in half
diagonals. A gamma curve keeps the model: powers of products are products of powers. The floor's
own colours are eliminated cell by cell; what stands on the floor is outvoted (Cauchy weights).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from groundfuse.frontend.arrays import Floats
from groundfuse.frontend.camera import Intrinsics
from groundfuse.frontend.gains_compiled import POWERS, add_normal, distances
from groundfuse.frontend.middle import middle

Numbers = NDArray[np.intp]
"""(n,) which cell, view or lens."""

ITERATIONS = 12
STILL = 1e-4
"""Gains that change by less than 0.01 %, a hundredth of a level, have been found."""
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
    num_views, num_lenses = len(lens_of_view), int(lens_of_view.max()) + 1
    _, cell, seen = np.unique(samples.cell, return_inverse=True, return_counts=True)
    shared = seen[cell] > 1
    if not shared.any():
        return neutral_exposure(num_views)
    by_cell_and_view = cell[shared] * num_views + samples.view[shared]
    order = np.flatnonzero(shared)[np.argsort(by_cell_and_view, kind="stable")]
    view, begins = samples.view[order], np.append(0, np.cumsum(seen[seen > 1]))
    values = np.log(np.maximum(samples.colour[order], 1.0))
    floor = _Floor(view, lens_of_view[view], samples.radius2[order], values, begins)
    gain, falloff = _robust_fit(floor, num_views, num_lenses)
    noise_levels = _noise(floor, samples.point[order], gain, falloff)
    return Exposure(gain, falloff[lens_of_view], noise_levels)


class _Floor(NamedTuple):
    """Samples in order of their cells, and of the views in a cell.

    Attributes:
        view: (n,) number of the picture.
        lens: (n,) number of its lens.
        radius2: (n,) see `Samples`.
        values: (n, 3) logarithms of the colours.
        begins: (cells + 1,) first sample of each cell, and the number of samples.
    """

    view: Numbers
    lens: Numbers
    radius2: Floats
    values: Floats
    begins: Numbers

    @property
    def seen(self) -> tuple[Numbers, Numbers, Floats, Floats]:
        """As the compiled loops take them."""
        return self.view, self.lens, self.radius2, self.values


def _robust_fit(floor: _Floor, num_views: int, num_lenses: int) -> tuple[Floats, Floats]:
    """Least squares, reweighted: log gains (views, 3), the falloffs' coefficients (lenses, 3)."""
    weight, distance = np.ones(len(floor.view)), np.empty(len(floor.view))
    gain, falloff = np.zeros((num_views, 3)), np.zeros((num_lenses, POWERS))
    for _ in range(ITERATIONS):
        before = gain
        gain, falloff = _solve(floor, weight, num_views, num_lenses)
        if np.abs(gain - before).max() < STILL:
            break
        distances(floor.seen, floor.begins, weight, gain, falloff, distance)
        scale = max(MAD_TO_SIGMA * float(middle(distance)), SMALLEST_SCALE)
        weight = 1.0 / (1.0 + (distance / scale) ** 2)
    return gain, falloff


def _solve(floor: _Floor, weight: Floats, num_views: int, num_lenses: int) -> tuple[Floats, Floats]:
    """Weighted least squares with each cell's own colour eliminated.

    The falloff is the same in all channels, so it follows from their mean, and then each channel's
    gains follow on their own. Few pairs of views share floor: the gains' block is sparse.
    """
    size = num_views + POWERS * num_lenses
    upper, right = np.zeros((size, size)), np.zeros((size, 3))
    add_normal(floor.seen, floor.begins, weight, num_views, (upper, right))
    normal = upper + np.triu(upper, 1).T
    samples = np.bincount(floor.view, weight, num_views)
    prior = np.full(size, FALLOFF_PRIOR)
    prior[:num_views] = GAIN_PRIOR * np.maximum(samples, 1.0)
    normal += np.diag(prior)
    gains, both = slice(0, num_views), normal[:num_views, num_views:]
    block = sparse.csc_array(normal[gains, gains])  # positive definite: it needs no pivots
    symmetric = {"SymmetricMode": True}
    solved = splu(block, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric).solve
    # Block elimination: the falloff of the mean channel first.
    of_falloff = normal[num_views:, num_views:] - both.T @ solved(both)
    mean = right.mean(axis=1)
    falloff = np.linalg.solve(of_falloff, mean[num_views:] - both.T @ solved(mean[gains]))
    gain: Floats = solved(right[gains] - (both @ falloff)[:, None])
    return gain, falloff.reshape(num_lenses, POWERS)


def _noise(floor: _Floor, point: Floats, gain: Floats, falloff: Floats) -> float:
    """Standard deviation of one view of a cell: from differences between two views of it."""
    c1, c2, c3 = falloff.T[:, floor.lens]
    fall = floor.radius2 * (c1 + floor.radius2 * (c2 + floor.radius2 * c3))
    even = point * np.exp(-fall)[:, None] * np.exp(-gain)[floor.view]
    difference = np.abs(np.diff(even, axis=0))
    across = floor.begins[1:-1] - 1  # from the last view of a cell to the first of the next
    difference = np.delete(difference, across, axis=0)
    sigma = MAD_TO_SIGMA * float(middle(difference.ravel())) / np.sqrt(2.0)
    return max(float(sigma), SMALLEST_NOISE_LEVELS)
