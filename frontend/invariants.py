"""The paper's colour invariants: six numbers per point that a turn of the view leaves (eq. 2-3).

Gaussian-filtered R, G, B over 255 and the magnitudes of their Gaussian gradients, each squashed by
s(t) = 1 / (1 + exp(-mu (t - t0))). The print leaves mu and t0 open: here they are the median and
the spread of each number over the view's own points, so that exposure and white balance drop out.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.normalise import local_contrast

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


def sigmoid(t: Floats, mu: Floats | float, t0: Floats | float) -> Floats:
    """Return 1 / (1 + exp(-mu (t - t0))) (paper eq. 3) without overflow."""
    squashed: Floats = 0.5 * (1.0 + np.tanh(0.5 * mu * (t - t0)))
    return squashed


def colour_planes(view: Image, mask: Mask, options: InvariantOptions) -> Picture32:
    """Return (rows, columns, 6): filtered R, G, B in 0 to 1, then their gradients per cell.

    Args:
        view: (rows, columns, 3) BGR overhead view, or (rows, columns) grey.
        mask: (rows, columns) floor; the filters do not reach beyond it.
        options: see there.
    """
    colours = _rgb(view, mask, options)
    weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), options.sigma_cells)
    inside = np.maximum(weight, 1e-3)[:, :, None]
    masked = colours * mask[:, :, None]
    smooth = cv2.GaussianBlur(masked, (0, 0), options.sigma_cells) / inside
    by_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1.0 / 8.0)
    by_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1.0 / 8.0)
    planes = np.concatenate([smooth, np.hypot(by_u, by_v)], axis=2)
    return np.asarray(planes, dtype=np.float32)


def invariants(
    view: Image, mask: Mask, points_px: Points, options: InvariantOptions | None = None
) -> Floats:
    """Return the six invariants (n, 6), each in 0 to 1, of points (n, 2) of an overhead view."""
    options = options or InvariantOptions()
    if len(points_px) == 0:
        return np.zeros((0, 6))
    values = sampled(colour_planes(view, mask, options), points_px)
    centre = np.median(values, axis=0)
    spread = np.maximum(values.std(axis=0), SMALLEST_SPREAD)
    return sigmoid(values, options.slope / spread, centre)


def sampled(planes: Picture32, points_px: Points) -> Floats:
    """Return the values (n, channels) of a picture at points (n, 2), bilinear."""
    u, v = (np.ascontiguousarray(points_px[:, k], dtype=np.float32)[None] for k in (0, 1))
    columns = [
        cv2.remap(np.ascontiguousarray(planes[:, :, k]), u, v, cv2.INTER_LINEAR)[0]
        for k in range(planes.shape[2])
    ]
    values: Floats = np.stack(columns, axis=1).astype(np.float64)
    return values


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
