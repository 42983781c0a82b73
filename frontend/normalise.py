"""Local contrast normalisation: bare concrete becomes as lively as gravel."""

from typing import Any

import cv2
import numpy as np

from groundfuse.frontend.arrays import Image, Mask, Picture32


def local_contrast(grey: Image, mask: Mask, radius_px: float, floor_grey: float) -> Picture32:
    """Return (grey - local mean) / local standard deviation; 0 where the mask is false.

    Args:
        grey: (rows, columns) uint8.
        mask: (rows, columns) pixels that count.
        radius_px: sigma of the Gaussian neighbourhood.
        floor_grey: smallest standard deviation, so that noise is not blown up.
    """
    weight = mask.astype(np.float32)
    value = np.asarray(grey.astype(np.float32) * weight, dtype=np.float32)
    scale = np.maximum(_blurred(weight, radius_px), 1e-3)
    mean = _blurred(value, radius_px) / scale
    square = _blurred(value * value, radius_px) / scale
    deviation = np.sqrt(np.maximum(square - mean * mean, floor_grey**2))
    return np.asarray((value - mean) / deviation * weight, dtype=np.float32)


def _blurred(picture: Picture32, radius_px: float) -> Picture32:
    """Gaussian by three box filters of the same variance: cost does not grow with the radius."""
    width = 2 * round((np.sqrt(4.0 * radius_px**2 + 1.0) - 1.0) / 2.0) + 1
    blurred: Any = picture
    for _ in range(3):
        blurred = cv2.blur(blurred, (width, width), borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, dtype=np.float32)
