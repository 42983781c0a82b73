"""Stones scattered on an endless lattice, drawn as anti-aliased polygons."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from groundfuse.frontend.arrays import Floats, Image
from groundfuse.tools.noise import Rect, uniform

SHADES = 5
LIGHT_TURN = -0.7  # cells of picture x, y towards the light: up and left
SUBPIXEL_BITS = 4

Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipLayer:
    """Stones of one size class.

    Attributes:
        pitch: cells between lattice nodes; one stone at most per node.
        smallest: radius of the smallest, cells.
        largest: radius of the largest, cells.
        share: of the nodes that bear a stone.
        corners: of a stone; many make it round.
        relief: 0 for cut and polished; above, a bright and a dark side of that contrast.
    """

    pitch: int
    smallest: float
    largest: float
    share: float
    corners: int = 6
    relief: float = 0.0


def _stones(
    key: tuple[int, ...], rect: Rect, layer: ChipLayer
) -> tuple[Floats, Floats, Floats, Floats]:
    """Centres (n, 2), radii (n,), outlines (n, corners, 2) of size 1 and colour numbers (n, 2)."""
    wide = rect.grown(int(1.5 * layer.largest) + layer.pitch + 2)
    i = np.arange(wide.x0 // layer.pitch, (wide.x0 + wide.width) // layer.pitch + 1)[None, :]
    j = np.arange(wide.y0 // layer.pitch, (wide.y0 + wide.height) // layer.pitch + 1)[:, None]
    there, x, y, size, hue, shade, turn = (uniform((*key, k), i, j).ravel() for k in range(7))
    column, row = (a.ravel() for a in np.broadcast_arrays(i, j))
    kept = there < layer.share
    column, row = column[kept], row[kept]
    centre = np.stack([column + x[kept], row + y[kept]], axis=1) * layer.pitch
    radius = layer.smallest + (layer.largest - layer.smallest) * size[kept] ** 2
    corner = np.arange(layer.corners)[None, :]
    wobble = uniform((*key, 9), column[:, None], row[:, None], corner)
    reach = (0.55 + 0.65 * wobble) if layer.relief == 0.0 else (0.85 + 0.25 * wobble)
    angle = 2 * np.pi * (corner + 0.7 * wobble + turn[kept, None]) / layer.corners
    squash = 0.65 + 0.35 * uniform((*key, 10), column, row)[:, None]
    unit = np.stack([reach * np.cos(angle), reach * squash * np.sin(angle)], axis=2)
    lean = 2 * np.pi * uniform((*key, 11), column, row)
    c, s = np.cos(lean), np.sin(lean)
    turned = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    centre -= np.array([rect.x0, rect.y0])
    return centre, radius, unit @ turned, np.stack([hue[kept], shade[kept]], axis=1)


def draw_chips(
    canvas: Image, key: tuple[int, ...], rect: Rect, layer: ChipLayer, palette: Sequence[Colour]
) -> None:
    """Scatter stones over a picture of `rect`, in place; the later colour covers the earlier."""
    centre, radius, outline, numbers = _stones(key, rect, layer)
    hue = (numbers[:, 0] * len(palette)).astype(int)
    shade = (numbers[:, 1] * SHADES).astype(int)
    # Rim, body and sun-lit cap: (size, move towards the light in radii, brightness).
    cuts = [(1.0, 0.0, 0.0)]
    if layer.relief > 0.0:
        cuts = [(1.0, 0.0, -1.6), (0.86, 0.10, -0.3), (0.66, 0.22, 0.35), (0.38, 0.36, 0.9)]
    for index, colour in enumerate(palette):
        for level in range(SHADES):
            chosen = (hue == index) & (shade == level)
            if not chosen.any():
                continue
            bright = 0.82 + 0.36 * level / (SHADES - 1)
            for size, move, lift in cuts:
                moved = centre[chosen] + LIGHT_TURN * move * radius[chosen, None]
                shape = moved[:, None, :] + outline[chosen] * (size * radius[chosen, None, None])
                points = np.rint(shape * 2**SUBPIXEL_BITS).astype(np.int32)
                tone = tuple(c * bright * (1.0 + layer.relief * lift) for c in colour)
                _fill(canvas, points, tone)


def _fill(canvas: Image, polygons: np.ndarray, colour: tuple[float, ...]) -> None:
    cv2.fillPoly(canvas, list(polygons), colour, lineType=cv2.LINE_AA, shift=SUBPIXEL_BITS)
