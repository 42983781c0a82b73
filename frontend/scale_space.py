"""Blurred pictures of growing scale, and their differences, in which blobs stand out.

Lowe, Distinctive image features from scale-invariant keypoints, 2004, section 3, but without
doubling the picture: an overhead view has one scale, and what is smaller than its cells tells
more about the noise than about the floor.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from groundfuse.frontend.arrays import Picture32

SIGMA_PX = 1.0
"""Blur of an octave's first level, pixels of the octave."""
ALREADY_PX = 0.5
"""Blur that a picture comes with."""
STEPS = 3
"""Levels from one scale to its double."""
OCTAVES = 3
TRUNCATED_SIGMAS = 3.5
SMALLEST_PX = 16
"""A smaller octave holds nothing but its border."""


@dataclass(frozen=True, slots=True, eq=False)
class Octave:
    """A picture at one size.

    Attributes:
        levels: `STEPS + 3` pictures (rows, columns), blurred by `sigma_px(k)` pixels.
        differences: (STEPS + 2, rows, columns) of each level and the one before.
    """

    levels: tuple[Picture32, ...]
    differences: Picture32


def sigma_px(level: float) -> float:
    """Return the blur of a level, which need not be whole, in pixels of its octave."""
    return SIGMA_PX * math.exp2(level / STEPS)


def scale_space(picture: Picture32) -> list[Octave]:
    """Return octaves; a pixel of each lies at twice its coordinates in the one before."""
    first = _blurred(picture, ALREADY_PX, SIGMA_PX)
    octaves: list[Octave] = []
    while len(octaves) < OCTAVES and min(first.shape) >= SMALLEST_PX:
        levels = [first]
        differences = np.empty((STEPS + 2, *first.shape), dtype=np.float32)
        for k in range(STEPS + 2):
            levels.append(_blurred(levels[k], sigma_px(k), sigma_px(k + 1)))
            np.subtract(levels[k + 1], levels[k], out=differences[k])
        octaves.append(Octave(tuple(levels), differences))
        first = np.ascontiguousarray(levels[STEPS][::2, ::2])
    return octaves


def _blurred(picture: Picture32, from_px: float, to_px: float) -> Picture32:
    """Blur a picture from one scale to another."""
    more_px = math.sqrt(to_px**2 - from_px**2)
    side = 2 * math.ceil(TRUNCATED_SIGMAS * more_px) + 1
    blurred = cv2.GaussianBlur(picture, (side, side), more_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float32)
