"""Exposure of every picture and vignetting of every lens, from the floor that pictures share.

Model, in logarithms of the recorded values: picture = floor + gain(view, channel) + falloff, with
falloff = c1 r^2 + c2 r^4 + c3 r^6 of the robot's lens, r from the principal point in half
diagonals. A gamma curve keeps the model: powers of products are products of powers. The floor's
own colours are eliminated cell by cell; what stands on the floor is outvoted (Cauchy weights).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from groundfuse.frontend.arrays import Floats, Mask
from groundfuse.frontend.camera import Intrinsics

Numbers = NDArray[np.intp]
"""(n,) which cell, view or lens."""

POWERS = 3
ITERATIONS = 12
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
    _, cell = np.unique(cell[shared], return_inverse=True)
    view, radius2 = samples.view[shared], samples.radius2[shared]
    design = _design(view, radius2, lens_of_view, num_lenses)
    values = np.log(np.maximum(samples.colour[shared], 1.0))
    gain, falloff = _robust_fit(design, cell, values, num_views)
    per_view = falloff.reshape(num_lenses, POWERS)[lens_of_view]
    found = Exposure(gain, per_view, USUAL_NOISE_LEVELS)
    return Exposure(gain, per_view, _noise(samples, shared, cell, found))


def _design(
    view: Numbers, radius2: Floats, lens_of_view: Numbers, num_lenses: int
) -> sparse.csr_array:
    """Rows of the linear model: which gain, and the powers of r under the lens's columns."""
    rows = np.arange(len(view))
    first = len(lens_of_view) + POWERS * lens_of_view[view]
    columns = [view, *(first + power for power in range(POWERS))]
    entries = [np.ones(len(view)), *(radius2 ** (power + 1) for power in range(POWERS))]
    shape = (len(view), len(lens_of_view) + POWERS * num_lenses)
    places = (np.tile(rows, POWERS + 1), np.concatenate(columns))
    return sparse.csr_array((np.concatenate(entries), places), shape=shape)


def _robust_fit(
    design: sparse.csr_array, cell: Numbers, values: Floats, num_views: int
) -> tuple[Floats, Floats]:
    """Least squares, reweighted: log gains (views, 3) and the falloffs' coefficients."""
    members = sparse.csr_array((np.ones(len(cell)), (cell, np.arange(len(cell)))))
    weight = np.ones(len(values))
    gain, falloff = np.zeros((num_views, 3)), np.zeros(0)
    for _ in range(ITERATIONS):
        gain, falloff = _solve(design, members, values, weight, num_views)
        rest = values - (design[:, :num_views] @ gain) - (design[:, num_views:] @ falloff)[:, None]
        centre = (members @ (weight[:, None] * rest)) / (members @ weight)[:, None]
        distance = np.sqrt(np.mean((rest - centre[cell]) ** 2, axis=1))
        scale = max(MAD_TO_SIGMA * float(np.median(distance)), SMALLEST_SCALE)
        weight = 1.0 / (1.0 + (distance / scale) ** 2)
    return gain, falloff


def _solve(
    design: sparse.csr_array,
    members: sparse.csr_array,
    values: Floats,
    weight: Floats,
    num_views: int,
) -> tuple[Floats, Floats]:
    """Weighted least squares with each cell's own colour eliminated.

    The falloff is the same in all channels, so it follows from their mean, and then each channel's
    gains follow on their own.
    """
    weighted = design.multiply(weight[:, None]).tocsr()
    per_cell = members @ weighted
    share = per_cell.multiply(1.0 / (members @ weight)[:, None]).tocsr()
    normal = (design.T @ weighted - share.T @ per_cell).toarray()
    right = weighted.T @ values - share.T @ (members @ (weight[:, None] * values))
    prior = np.full(len(normal), FALLOFF_PRIOR)
    prior[:num_views] = GAIN_PRIOR * np.maximum(design[:, :num_views].T @ weight, 1.0)
    normal += np.diag(prior)
    falloff = np.linalg.solve(normal, right.mean(axis=1))[num_views:]
    known = (normal[:num_views, num_views:] @ falloff)[:, None]
    gain = np.linalg.solve(normal[:num_views, :num_views], right[:num_views] - known)
    return gain, falloff


def _noise(samples: Samples, shared: Mask, cell: Numbers, found: Exposure) -> float:
    """Standard deviation of one view of a cell: from differences between two views of it."""
    view, radius2 = samples.view[shared], samples.radius2[shared]
    fall = (found.falloff[view] * radius2[:, None] ** np.arange(1, POWERS + 1)).sum(axis=1)
    point = samples.point[shared] * np.exp(-fall[:, None] - found.log_gain[view])
    order = np.lexsort((view, cell))
    same = cell[order][1:] == cell[order][:-1]
    difference = np.abs(np.diff(point[order], axis=0))[same]
    sigma = MAD_TO_SIGMA * float(np.median(difference)) / np.sqrt(2.0)
    return max(float(sigma), SMALLEST_NOISE_LEVELS)
