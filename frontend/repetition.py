"""Does the floor repeat itself? The highest second peak of one view's autocorrelation.

A floor that repeats lies to every matcher: views one period apart look the same. One view alone
shows it: identical tiles have a second peak near 1, floors that never repeat stay low.
"""

import functools
import math
from typing import NamedTuple

import cv2
import numpy as np

from groundfuse.frontend.arrays import Mask, Picture32
from groundfuse.frontend.repetition_compiled import best_shift

REPEATS = 0.5
"""A second peak above this marks a floor as repeating."""
WORKING_PX = 160
WHOLE = 0.99
"""Share of a shrunk cell that is floor, where it counts."""
MIN_OVERLAP = 0.3
MAIN_LOBE_SHARE = 0.06
FAINTEST = 0.05
"""Standard deviation below which a view holds no floor but rounding: a blank picture."""

FLOORS_KEPT = 16
"""Half a megabyte each; frames of one camera at one attitude show floor in the same places."""


class _Floor(NamedTuple):
    """Where a view has floor: shrunk, its spectrum, and the cells it shares with its shifts."""

    weight: Picture32
    spectrum: Picture32
    overlap: Picture32


def _spectrum(picture: Picture32) -> Picture32:
    """Return the transform of a picture with room for every shift."""
    rows, columns = (cv2.getOptimalDFTSize(2 * side - 1) for side in picture.shape)
    padded = np.zeros((rows, columns), dtype=np.float32)
    padded[: picture.shape[0], : picture.shape[1]] = picture
    return np.asarray(cv2.dft(padded), dtype=np.float32)


def _correlated(one: Picture32, two: Picture32) -> Picture32:
    """Return sums of products at all shifts, none in the corner, of two spectra of pictures."""
    product = cv2.mulSpectrums(one, two, 0, conjB=True)
    sums = cv2.idft(product, flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
    return np.asarray(sums, dtype=np.float32)


def repetition(normalised: Picture32, mask: Mask) -> float:
    """Return the correlation of a view with itself at its best shift, 0 to 1.

    Shifts within the main lobe, or with too little overlap, do not count.

    Args:
        normalised: (rows, columns) overhead view after local contrast normalisation.
        mask: (rows, columns) pixels with floor.
    """
    floor = _floor(np.packbits(mask).tobytes(), mask.shape)
    # A neighbourhood average removes noise that no repetition could survive.
    size = floor.weight.shape[::-1]
    shrunk = cv2.resize(normalised, size, interpolation=cv2.INTER_AREA)
    value = np.asarray(np.asarray(shrunk) * floor.weight, dtype=np.float32)
    of_value, of_square = _spectrum(value), _spectrum(value * value)
    product, power = _correlated(of_value, of_value), _correlated(of_square, floor.spectrum)
    limits = MIN_OVERLAP * float(floor.weight.sum()), MAIN_LOBE_SHARE * max(size), FAINTEST**2
    return float(best_shift(product, power, floor.overlap, value.shape, limits))


@functools.lru_cache(maxsize=FLOORS_KEPT)
def _floor(packed: bytes, shape: tuple[int, int]) -> _Floor:
    """Work out what depends on the mask alone, whose bits are packed."""
    mask = np.unpackbits(np.frombuffer(packed, np.uint8), count=shape[0] * shape[1]).reshape(shape)
    shrink = max(1.0, max(shape) / WORKING_PX)
    size = tuple(max(8, math.ceil(side / shrink)) for side in shape[::-1])
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    weight = (np.asarray(share) > WHOLE).astype(np.float32)
    spectrum = _spectrum(weight)
    return _Floor(weight, spectrum, _correlated(spectrum, spectrum))
