"""The paper's colour invariants: six numbers per point that a turn of the view leaves (eq. 2-3).

Gaussian-filtered R, G, B over 255 and the magnitudes of their Gaussian gradients, each squashed by
s(t) = 1 / (1 + exp(-mu (t - t0))). The print leaves mu and t0 open: here they are the median and
the spread of each number over the view's own points, so that exposure and white balance drop out.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.normalise import local_contrast

SMALLEST_WEIGHT = np.float32(1e-3)
SMALLEST_SPREAD = 1e-6
"""Of a number that is the same at all points, over 255 grey values."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InvariantOptions:
    """What the invariants see."""

    sigma_cells: float = 2.0
    """Sigma of the Gaussian of colours and gradients, overhead cells."""
    slope: float = 1.7
    """mu times the standard deviation; 1.7 makes the sigmoid nearly a normal distribution's."""
    contrast_radius_cells: float = 0.0
    """Normalise the contrast of each colour within this sigma first; 0 for none, as printed."""
    contrast_floor_grey: float = 1.5
    """Smallest standard deviation that the contrast is normalised by, grey values."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("contrast_radius_cells",))


def sigmoid(t: Floats, mu: Floats | float, t0: Floats | float) -> Floats:
    """Return 1 / (1 + exp(-mu (t - t0))) (paper eq. 3) without overflow."""
    squashed: Floats = 0.5 * (1.0 + np.tanh(0.5 * mu * (t - t0)))
    return squashed


def colour_values(view: Image, mask: Mask, points_px: Points, options: InvariantOptions) -> Floats:
    """Return (n, 6): filtered R, G, B in 0 to 1, then their gradients per cell (paper eq. 2).

    Args:
        view: (rows, columns, 3) BGR overhead view, or (rows, columns) grey.
        mask: (rows, columns) floor; the filters do not reach beyond it.
        points_px: (n, 2) where.
        options: see there.
    """
    weight = mask.astype(np.float32)
    inside = np.maximum(cv2.GaussianBlur(weight, (0, 0), options.sigma_cells), SMALLEST_WEIGHT)
    masked = _rgb(view, mask, options) * weight[:, :, None]
    blurred = cv2.GaussianBlur(masked, (0, 0), options.sigma_cells) / inside[:, :, None]
    smooth = np.asarray(blurred, dtype=np.float32)

    def at(du: float, dv: float) -> Floats:
        return _sampled(smooth, points_px + np.array([du, dv]))

    by_u, by_v = (at(1, 0) - at(-1, 0)) / 2.0, (at(0, 1) - at(0, -1)) / 2.0
    values: Floats = np.hstack([at(0, 0), np.hypot(by_u, by_v)])
    return values


def invariants(
    view: Image, mask: Mask, points_px: Points, options: InvariantOptions | None = None
) -> Floats:
    """Return the six invariants (n, 6), each in 0 to 1, of points (n, 2) of an overhead view."""
    options = options or InvariantOptions()
    if len(points_px) == 0:
        return np.zeros((0, 6))
    values = colour_values(view, mask, points_px, options)
    centre = np.median(values, axis=0)
    spread = np.maximum(values.std(axis=0), SMALLEST_SPREAD)
    return sigmoid(values, options.slope / spread, centre)


def _sampled(picture: Picture32, points_px: Points) -> Floats:
    """Return the values (n, channels) of a picture at points (n, 2), bilinear."""
    u, v = (np.ascontiguousarray(points_px[:, k], dtype=np.float32)[None] for k in (0, 1))
    values = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values[0], dtype=np.float64)


def _rgb(view: Image, mask: Mask, options: InvariantOptions) -> Picture32:
    """Colours in the paper's order; OpenCV keeps blue first."""
    bgr = view if view.ndim == 3 else np.repeat(view[:, :, None], 3, axis=2)
    rgb = bgr[:, :, ::-1]
    if options.contrast_radius_cells <= 0.0:
        plain: Picture32 = rgb.astype(np.float32) / np.float32(255.0)
        return plain
    radius, floor = options.contrast_radius_cells, options.contrast_floor_grey
    return np.stack(
        [local_contrast(np.ascontiguousarray(rgb[:, :, k]), mask, radius, floor) for k in range(3)],
        axis=2,
    )
