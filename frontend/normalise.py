"""Local contrast normalisation: bare concrete becomes as lively as gravel."""

import cv2
import numpy as np

from groundfuse.frontend.arrays import Image, Mask, Picture32

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
    rows, columns = grey.shape
    # Whole blocks: what is added has no weight.
    shape = [-(-side // step) * step for side in grey.shape]
    weight, value = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    weight[:rows, :columns] = mask
    # Squares of differences from a middle grey are small enough for single precision.
    middle = np.float32(round(cv2.mean(grey, mask.astype(np.uint8))[0]))
    np.subtract(grey, middle, out=value[:rows, :columns])
    value *= weight
    scale = np.maximum(_around(weight, radius_px, step), 1e-3)
    mean = _around(value, radius_px, step) / scale
    square = _around(value * value, radius_px, step) / scale
    deviation = np.sqrt(np.maximum(square - mean * mean, floor_grey**2))
    size = (shape[1], shape[0])
    value -= cv2.resize(mean, size, interpolation=cv2.INTER_LINEAR)
    value *= cv2.resize(1.0 / deviation, size, interpolation=cv2.INTER_LINEAR)
    value *= weight
    return value[:rows, :columns]


def _around(picture: Picture32, radius_px: float, step: int) -> Picture32:
    """Gaussian means of blocks of `step` x `step` pixels: so smooth a picture needs no more."""
    rows, columns = picture.shape
    size = (columns // step, rows // step)
    coarse = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(coarse, (0, 0), radius_px / step, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, dtype=np.float32)
