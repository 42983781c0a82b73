"""A canvas with smooth lines and text, drawn by OpenCV at twice the size.

Coordinates are pixels of the finished picture, x right and y down, and may have fractions. Colours
are BGR. Text uses OpenCV's own TrueType face where it has one (from version 5), else its strokes.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats, Image

Colour = tuple[int, int, int]
"""BGR."""
Fixed = NDArray[np.int32]
"""(n, 2) points in fixed-point numbers."""
SUPER = 2
SHIFT = 4
STROKE_HEIGHT_PX = 21.0
"""Height of a capital letter of the stroke font at scale 1."""
REGULAR_WEIGHT = 400
BOLD_WEIGHT = 600
PLAIN_TEXT = str.maketrans({"±": "+/-", "°": " deg"})
"""What the stroke font can't show."""


class Canvas:
    """A picture under construction."""

    def __init__(self, width_px: int, height_px: int, background: Colour) -> None:
        """Fill a new picture with one colour."""
        rows, columns = height_px * SUPER, width_px * SUPER
        flat = np.empty((rows, columns * 3), dtype=np.uint8)
        flat[:] = np.tile(np.array(background, dtype=np.uint8), columns)
        self.image: Image = flat.reshape(rows, columns, 3)
        self.width_px, self.height_px = width_px, height_px

    def finished(self) -> Image:
        """Return the picture at its own size."""
        size = (self.width_px, self.height_px)
        smooth = cv2.resize(self.image, size, interpolation=cv2.INTER_AREA)
        return np.asarray(smooth, dtype=np.uint8)

    def line(
        self,
        points: Floats,
        colour: Colour,
        width_px: float = 1.5,
        *,
        closed: bool = False,
        casing: Colour | None = None,
    ) -> None:
        """Draw a line through points (n, 2), with a border of another colour if wanted."""
        self.lines([points], colour, width_px, closed=closed, casing=casing)

    def lines(
        self,
        lines: Sequence[Floats] | Floats,
        colour: Colour,
        width_px: float = 1.5,
        *,
        closed: bool = False,
        casing: Colour | None = None,
    ) -> None:
        """Draw lines, each through points (n, 2), one after the other with its border."""
        if not len(lines):
            return
        ends = np.cumsum([len(points) for points in lines])[:-1]
        fixed = np.split(_fixed(np.concatenate(lines)), ends)
        for some in [fixed] if casing is None else [[one] for one in fixed]:
            if casing is not None:
                self._polylines(some, casing, width_px + 2.0, closed=closed)
            self._polylines(some, colour, width_px, closed=closed)

    def _polylines(
        self, lines: Sequence[Fixed], colour: Colour, width_px: float, *, closed: bool
    ) -> None:
        """Draw lines at twice the size, where their steps are as fine as can be seen.

        Smooth ones, `LINE_AA`, take four times as long and look the same.
        """
        thickness = max(1, round(width_px * SUPER))
        cv2.polylines(self.image, lines, closed, colour, thickness, cv2.LINE_8, SHIFT)

    def dashes(
        self,
        points: Floats,
        colour: Colour,
        width_px: float,
        dash_px: float,
        gap_px: float,
        casing: Colour | None = None,
    ) -> None:
        """Draw a dashed line through points (n, 2)."""
        pieces = dash_pieces(points, dash_px, gap_px)
        self.lines(pieces, colour, width_px, casing=casing)

    def disc(
        self, centre: Floats, radius_px: float, colour: Colour, casing: Colour | None = None
    ) -> None:
        """Draw a filled circle."""
        rings = [(radius_px, colour)] if casing is None else [(radius_px + 1.5, casing)]
        rings += [] if casing is None else [(radius_px, colour)]
        for radius, fill in rings:
            x, y = (int(value) for value in _fixed(np.asarray(centre)[None])[0])
            size = round(radius * SUPER * 2**SHIFT)
            cv2.circle(self.image, (x, y), size, fill, -1, cv2.LINE_AA, SHIFT)

    def polygon(self, points: Floats, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a polygon (n, 2), see-through where `opacity` is below 1."""
        fixed = _fixed(points)
        low = np.maximum(np.floor(np.min(points, axis=0) * SUPER).astype(int) - 2, 0)
        high = np.ceil(np.max(points, axis=0) * SUPER).astype(int) + 3
        window = self.image[low[1] : high[1], low[0] : high[0]]
        if window.size == 0:
            return
        filled = window.copy()
        offset = (-int(low[0]), -int(low[1]))
        moved = fixed + np.array(offset) * 2**SHIFT
        cv2.fillPoly(filled, [moved.astype(np.int32)], colour, cv2.LINE_AA, SHIFT)
        window[:] = cv2.addWeighted(filled, opacity, window, 1.0 - opacity, 0.0)

    def text(
        self,
        words: str,
        place: tuple[float, float],
        size_px: float,
        colour: Colour,
        *,
        align: float = 0.0,
        bold: bool = False,
        halo: Colour | None = None,
    ) -> None:
        """Write one line.

        Args:
            words: the text.
            place: x of the alignment point, y of the middle of a capital letter.
            size_px: height of a capital letter is about 0.7 of it.
            colour: of the letters.
            align: 0 begins at `place`, 0.5 is centred there, 1 ends there.
            bold: heavier letters.
            halo: colour around the letters.
        """
        width = text_width_px(words, size_px, bold=bold)
        x = (place[0] - align * width) * SUPER
        y = (place[1] + CAPITAL * size_px / 2.0) * SUPER
        origin = (round(x), round(y))
        if halo is not None:
            for angle in np.arange(8) * math.pi / 4:
                away = (HALO_PX * SUPER * math.cos(angle), HALO_PX * SUPER * math.sin(angle))
                moved = (round(x + away[0]), round(y + away[1]))
                _write(self.image, words, moved, size_px, halo, bold=bold)
        _write(self.image, words, origin, size_px, colour, bold=bold)


CAPITAL = 0.7
HALO_PX = 1.5


def dash_pieces(points: Floats, dash_px: float, gap_px: float) -> list[Floats]:
    """Cut a line (n, 2) into dashes, each (m, 2); bends stay."""
    points = np.asarray(points, dtype=np.float64)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    starts = np.arange(0.0, along[-1], dash_px + gap_px)
    stops = np.minimum(starts + dash_px, along[-1])
    first, last = (
        np.column_stack([np.interp(at, along, axis) for axis in points.T]) for at in (starts, stops)
    )
    if len(points) == 2:  # thousands of straight edges have no bends to look for
        return list(np.stack([first, last], axis=1))
    return [
        np.vstack([first[k], points[(along > starts[k]) & (along < stops[k])], last[k]])
        for k in range(len(starts))
    ]


def _fixed(points: Floats) -> Fixed:
    """Return points as OpenCV's fixed-point integers, (n, 2) int32, pixel centres at integers."""
    scaled = (np.asarray(points, dtype=np.float64) * SUPER + (SUPER - 1) / 2.0) * 2**SHIFT
    fixed: Fixed = np.rint(scaled).astype(np.int32)
    return fixed


@functools.lru_cache(maxsize=1)
def _face() -> Any:  # noqa: ANN401 - OpenCV 4 has no such class
    """OpenCV's TrueType face, or None where it has none."""
    maker = getattr(cv2, "FontFace", None)
    return None if maker is None else maker("sans")


def text_width_px(words: str, size_px: float, *, bold: bool = False) -> float:
    """Return the width of a line of text."""
    face = _face()
    if face is None:
        scale, thickness = _stroke(size_px, bold=bold)
        (width, _), _ = cv2.getTextSize(
            words.translate(PLAIN_TEXT), cv2.FONT_HERSHEY_SIMPLEX, scale, thickness
        )
        return width / SUPER
    weight = BOLD_WEIGHT if bold else REGULAR_WEIGHT
    measure: Any = cv2.getTextSize
    _, _, width, _ = measure((1, 1), words, (0, 0), face, round(size_px * SUPER), weight)
    return float(width) / SUPER


def _write(
    image: Image, words: str, origin: tuple[int, int], size_px: float, colour: Colour, *, bold: bool
) -> None:
    face, write = _face(), cv2.putText
    if face is None:
        scale, thickness = _stroke(size_px, bold=bold)
        plain, font = words.translate(PLAIN_TEXT), cv2.FONT_HERSHEY_SIMPLEX
        write(image, plain, origin, font, scale, colour, thickness, cv2.LINE_AA)
        return
    any_write: Any = write
    weight = BOLD_WEIGHT if bold else REGULAR_WEIGHT
    any_write(image, words, origin, colour, face, round(size_px * SUPER), weight)


def _stroke(size_px: float, *, bold: bool) -> tuple[float, int]:
    """Scale and thickness of the stroke font."""
    scale = 0.9 * CAPITAL * size_px * SUPER / STROKE_HEIGHT_PX  # its letters are wide
    return scale, max(1, round((0.13 if bold else 0.07) * size_px * SUPER * CAPITAL))
