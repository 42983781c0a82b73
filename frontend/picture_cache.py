"""Pictures loaded when they are needed and forgotten when others need the room."""

import threading
from collections import OrderedDict
from collections.abc import Callable

import cv2
import numpy as np

from groundfuse.frontend.area_remap import point_values
from groundfuse.frontend.arrays import Image

SMALLEST_PX = 32


class PictureCache:
    """The most recently used pictures with their halvings, within a budget; safe with threads."""

    def __init__(self, loads: list[Callable[[], Image]], budget_bytes: int) -> None:
        """Take what loads each picture; nothing is loaded yet."""
        self._loads = loads
        self._budget_bytes = budget_bytes
        self._held: OrderedDict[int, tuple[Image, ...]] = OrderedDict()
        self._lock = threading.Lock()

    def pyramid(self, index: int) -> list[Image]:
        """Return a picture (BGR point values) and its halvings, in a list of the caller's own."""
        with self._lock:
            if index in self._held:
                self._held.move_to_end(index)
                return list(self._held[index])
        levels = _pyramid(self._loads[index]())
        with self._lock:
            self._held[index] = levels
            while len(self._held) > 1 and self._bytes() > self._budget_bytes:
                self._held.popitem(last=False)
        return list(levels)

    def _bytes(self) -> int:
        return sum(level.nbytes for levels in self._held.values() for level in levels)


def _pyramid(image: Image) -> tuple[Image, ...]:
    """A colour picture's point values and its halvings.

    Halving a pixel's coordinates gives its place in each.
    """
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    levels = [point_values(image)]
    while min(levels[-1].shape[:2]) > SMALLEST_PX:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    return tuple(levels)
