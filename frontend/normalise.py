"""Local contrast normalisation: bare concrete becomes as lively as gravel."""

import cv2
import numpy as np

from groundfuse.frontend.arrays import Image, Mask, Picture32
from groundfuse.frontend.normalise_compiled import against_means, block_sums, centred_means

PIXELS_PER_RADIUS = 3.0
COARSEST_PX = 4


def local_contrast(grey: Image, mask: Mask, radius_px: float, floor_grey: float) -> Picture32:
    """Return (grey - local mean) / local standard deviation; 0 where the mask is false.

    Args:
        grey: (rows, columns) uint8.
        mask: (rows, columns) pixels that count.
        radius_px: sigma of the Gaussian neighbourhood.
        floor_grey: smallest standard deviation, so that noise is not blown up.
    """
    step = min(COARSEST_PX, max(1, int(radius_px / PIXELS_PER_RADIUS)))
    counted = np.ascontiguousarray(mask).view(np.uint8)
    grey = np.ascontiguousarray(grey)
    sums = block_sums(grey, counted, step)
    count, total = (int(sums[kind].sum(dtype=np.int64)) for kind in (0, 1))
    # Squares of differences from a middle grey are small enough for single precision.
    middle = round(total / max(1, count))
    means = centred_means(sums, middle, step)
    weight, value, square = (_blurred(blocks, radius_px / step) for blocks in means)
    scale = np.maximum(weight, 1e-3)
    mean = np.asarray(value / scale, dtype=np.float32)
    deviation = np.sqrt(np.maximum(square / scale - mean * mean, floor_grey**2))
    inverse = np.asarray(1.0 / deviation, dtype=np.float32)
    found: Picture32 = against_means(
        grey, counted, _across(mean, step), _across(inverse, step), step, middle
    )
    return found


def _blurred(blocks: Picture32, sigma: float) -> Picture32:
    """Gaussian means of blocks: so smooth a picture needs no more."""
    blurred = cv2.GaussianBlur(blocks, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, dtype=np.float32)


def _across(blocks: Picture32, step: int) -> Picture32:
    """Blocks as wide as pixels, linear in between; they stay as high as they are."""
    size = (blocks.shape[1] * step, blocks.shape[0])
    wide = cv2.resize(blocks, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, dtype=np.float32)
