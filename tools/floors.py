"""Floors that look like floors and never repeat a patch (identical tiles excepted).

Every texture is a function of a seed and a rectangle of cells. Sizes are in cells: with the usual
cell of 0.75 mm a view from 0.55 m is meant; other heights scale the cell (`floor`).
"""

import cv2
import numpy as np

from groundfuse.frontend.arrays import Floats, Image, Picture32
from groundfuse.tools.checks import nearest
from groundfuse.tools.chips import SUBPIXEL_BITS, ChipLayer, draw_chips
from groundfuse.tools.floor_raster import FloorRaster, Texture
from groundfuse.tools.noise import Rect, octaves, smooth, uniform, white

CELL_PER_HEIGHT = 0.75e-3 / 0.55
TILE = 200
GROUT = 4
PLANK_WIDTH = 120
PLANK_LENGTH = 1200
GROOVE = 2

_GREYS = ((78, 84, 88), (120, 128, 132), (165, 172, 176), (208, 214, 216), (48, 50, 54))
_WARM = ((92, 116, 158), (70, 92, 128), (140, 164, 190), (176, 190, 204), (60, 66, 96))


def _finished(picture: Picture32 | Floats) -> Image:
    clipped: Image = np.clip(np.rint(picture), 0.0, 255.0).astype(np.uint8)
    return clipped


def terrazzo(seed: int, rect: Rect) -> Image:
    """Polished stone chips of three sizes in cement."""
    cement = 150.0 + octaves((seed, 1), rect, {128: 4.0, 16: 4.0, 4: 5.0, 1: 6.0})
    base = _finished(cement[..., None] * np.array([0.93, 0.98, 1.0], dtype=np.float32))
    palette = (*_GREYS, *_WARM)
    for index, layer in enumerate(
        (
            ChipLayer(pitch=6, smallest=0.9, largest=2.4, share=0.75),
            ChipLayer(pitch=14, smallest=2.5, largest=6.0, share=0.55),
            ChipLayer(pitch=34, smallest=5.0, largest=13.0, share=0.5),
        )
    ):
        draw_chips(base, (seed, 2, index), rect, layer, palette)
    veins = octaves((seed, 3), rect, {64: 3.0, 8: 4.0, 3: 5.0, 1: 3.0})
    return _finished(base + veins[..., None])


def gravel(seed: int, rect: Rect) -> Image:
    """Pebbles on sand, lit from one side."""
    sand = 92.0 + octaves((seed, 1), rect, {64: 6.0, 6: 8.0, 2: 10.0, 1: 9.0})
    base = _finished(sand[..., None] * np.array([0.78, 0.9, 1.0], dtype=np.float32))
    palette = tuple((0.8 * b + 12, 0.8 * g + 10, 0.8 * r + 6) for b, g, r in (*_GREYS[:4], *_WARM))
    for index, layer in enumerate(
        (
            ChipLayer(pitch=8, smallest=1.5, largest=3.6, share=0.9, corners=9, relief=0.30),
            ChipLayer(pitch=13, smallest=3.0, largest=6.0, share=0.75, corners=11, relief=0.30),
            ChipLayer(pitch=22, smallest=5.0, largest=10.0, share=0.6, corners=12, relief=0.35),
            ChipLayer(pitch=37, smallest=8.0, largest=15.0, share=0.35, corners=13, relief=0.35),
        )
    ):
        draw_chips(base, (seed, 2, index), rect, layer, palette)
    rough = octaves((seed, 3), rect, {24: 5.0, 6: 5.0, 2: 6.0, 1: 5.0})
    return _finished(base + rough[..., None])


def concrete(seed: int, rect: Rect) -> Image:
    """Bare and grey: soft blotches, faint grain, a few pores."""
    blotches = octaves((seed, 1), rect, {512: 3.5, 128: 3.0, 32: 2.0, 10: 1.6, 4: 1.8, 2: 1.8})
    base = 148.0 + blotches + white((seed, 2), rect) * np.float32(1.2)
    grey = _finished(base[..., None] * np.array([0.97, 0.99, 1.0], dtype=np.float32))
    pores = ChipLayer(pitch=24, smallest=0.5, largest=1.6, share=0.35, corners=8)
    palette = ((118, 120, 121), (128, 130, 132), (136, 138, 140), (158, 160, 162))
    draw_chips(grey, (seed, 3), rect, pores, palette)
    return grey


def _grout(rect: Rect) -> Picture32:
    """Return 1 on tiles and 0 in the joints (height, width)."""
    columns = np.arange(rect.x0, rect.x0 + rect.width) % TILE
    rows = np.arange(rect.y0, rect.y0 + rect.height) % TILE
    on_tile = (columns >= GROUT)[None, :] & (rows >= GROUT)[:, None]
    return on_tile.astype(np.float32)


def _printed(seed: int) -> Picture32:
    """One printed tile (TILE, TILE, 3), every copy the same; its pattern wraps at the edges."""
    one = Rect(0, 0, TILE, TILE)
    marble = octaves((seed, 1), one, {40: 10.0, 12: 6.0, 5: 5.0, 2: 4.0, 1: 3.0})
    tile = _finished((168.0 + marble)[..., None] * np.array([0.9, 0.96, 1.0], dtype=np.float32))
    speckles = ChipLayer(pitch=12, smallest=1.0, largest=3.0, share=0.4)
    draw_chips(tile, (seed, 2), one, speckles, _WARM)
    return tile.astype(np.float32)


def tiles(seed: int, rect: Rect) -> Image:
    """Identical tiles: the floor repeats exactly every TILE cells both ways."""
    columns = np.arange(rect.x0, rect.x0 + rect.width) % TILE
    rows = np.arange(rect.y0, rect.y0 + rect.height) % TILE
    printed = _printed(seed)[rows[:, None], columns[None, :]]
    joint = np.array([92.0, 98.0, 102.0], dtype=np.float32)
    share = _grout(rect)[..., None]
    return _finished(share * printed + (1.0 - share) * joint)


def varied_tiles(seed: int, rect: Rect) -> Image:
    """Tiles with one print and joints, each with a tone and veins of its own."""
    columns = np.arange(rect.x0, rect.x0 + rect.width)
    rows = np.arange(rect.y0, rect.y0 + rect.height)
    printed = _printed(seed)[(rows % TILE)[:, None], (columns % TILE)[None, :]]
    tone = uniform((seed, 3), columns[None, :] // TILE, rows[:, None] // TILE) - 0.5
    veins = octaves((seed, 4), rect, {60: 3.0, 15: 3.0, 6: 3.0, 3: 3.0})
    own = printed + (14.0 * tone + veins)[..., None]
    worn = 97.0 + octaves((seed, 5), rect, {30: 5.0, 3: 4.0, 1: 4.0})
    share = _grout(rect)[..., None]
    return _finished(share * own + (1.0 - share) * worn[..., None])


def _plank(key: tuple[int, ...], rect: Rect) -> Picture32:
    """Grain of one plank along x over a rectangle of it."""
    tone, figure, red = (float(uniform((*key, k), np.array([0]))[0]) for k in range(3))
    bend = smooth((*key, 4), rect, 260, 34) + 0.25 * smooth((*key, 5), rect, 60, 14)
    across = np.arange(rect.y0, rect.y0 + rect.height, dtype=np.float32)[:, None]
    rings = np.sin(across * np.float32(0.10 + 0.22 * figure) + np.float32(2.4) * bend)
    streaks = 6.0 * smooth((*key, 6), rect, 120, 5) + 6.0 * smooth((*key, 7), rect, 40, 2)
    pores = np.minimum(smooth((*key, 8), rect, 24, 2) + 1.1, 0.0)
    light = 148.0 + 34.0 * (tone - 0.5) + 11.0 * rings + streaks + 22.0 * pores
    light += octaves((*key, 9), rect, {6: 2.5, 2: 3.0, 1: 3.0})
    tint = np.array([0.50 + 0.06 * red, 0.70 + 0.05 * red, 1.0], dtype=np.float32)
    return np.asarray(light[..., None] * tint, dtype=np.float32)


def wood(seed: int, rect: Rect) -> Image:
    """Planks along x, each with a grain of its own, staggered row by row."""
    out = np.zeros((rect.height, rect.width, 3), dtype=np.float32)
    for row in range(rect.y0 // PLANK_WIDTH, (rect.y0 + rect.height - 1) // PLANK_WIDTH + 1):
        shift = int(uniform((seed, 1), np.array([row]))[0] * PLANK_LENGTH)
        first = (rect.x0 + shift) // PLANK_LENGTH
        last = (rect.x0 + rect.width - 1 + shift) // PLANK_LENGTH
        for column in range(first, last + 1):
            x0 = max(column * PLANK_LENGTH - shift, rect.x0)
            x1 = min((column + 1) * PLANK_LENGTH - shift, rect.x0 + rect.width)
            y0 = max(row * PLANK_WIDTH, rect.y0)
            y1 = min((row + 1) * PLANK_WIDTH, rect.y0 + rect.height)
            part = _plank((seed, 2, row, column), Rect(x0, y0, x1 - x0, y1 - y0))
            columns, rows = np.arange(x0, x1), np.arange(y0, y1)
            joint = ((rows % PLANK_WIDTH) < GROOVE)[:, None] | (
                (columns + shift) % PLANK_LENGTH < GROOVE
            )[None, :]
            part[joint] *= np.float32(0.35)
            out[y0 - rect.y0 : y1 - rect.y0, x0 - rect.x0 : x1 - rect.x0] = part
    return _finished(out)


BLADE_PITCH = 8
BLADES = ((26, 62, 44), (34, 84, 62), (44, 104, 80), (58, 126, 100), (78, 148, 128), (96, 160, 156))
LONGEST_BLADE = 52.0


def _blades(key: tuple[int, ...], rect: Rect) -> tuple[Floats, Floats]:
    """Blades as bent lines (n, 4, 2) in cells of the rectangle and a number (n,) in [0, 1)."""
    reach = int(LONGEST_BLADE) + BLADE_PITCH
    wide = rect.grown(reach)
    i = np.arange(wide.x0 // BLADE_PITCH, (wide.x0 + wide.width) // BLADE_PITCH + 1)[None, :]
    j = np.arange(wide.y0 // BLADE_PITCH, (wide.y0 + wide.height) // BLADE_PITCH + 1)[:, None]
    x, y, turn, length, bend, shade = (uniform((*key, k), i, j).ravel() for k in range(6))
    column, row = (a.ravel() for a in np.broadcast_arrays(i, j))
    root = np.stack([(column + x) * BLADE_PITCH - rect.x0, (row + y) * BLADE_PITCH - rect.y0], 1)
    steps = np.arange(4)
    angle = 2 * np.pi * turn[:, None] + (bend[:, None] - 0.5) * 0.8 * steps
    stride = (0.35 + 0.65 * length[:, None]) * LONGEST_BLADE / 3.0
    ahead = np.stack([np.cos(angle), np.sin(angle)], axis=2) * stride[..., None]
    ahead[:, 0] = 0.0
    return root[:, None, :] + np.cumsum(ahead, axis=1), shade


def grass(seed: int, rect: Rect) -> Image:
    """Blades of grass over soil, dark below and light above."""
    soil = 40.0 + octaves((seed, 1), rect, {32: 6.0, 4: 7.0, 1: 6.0})
    base = _finished(soil[..., None] * np.array([0.7, 1.1, 0.95], dtype=np.float32))
    for index, colour in enumerate(BLADES):
        lines, shade = _blades((seed, 2, index), rect)
        points = np.rint(lines * 2**SUBPIXEL_BITS).astype(np.int32)
        for part in range(3):
            group = list(points[(shade * 3).astype(int) == part])
            tone = tuple(float(c * (0.8 + 0.2 * part)) for c in colour)
            cv2.polylines(
                base, group, isClosed=False, color=tone, lineType=cv2.LINE_AA, shift=SUBPIXEL_BITS
            )
    meadow = octaves((seed, 3), rect, {400: 7.0, 90: 5.0, 2: 4.0, 1: 4.0})
    return _finished(base + meadow[..., None])


FLOORS: dict[str, Texture] = {
    "terrazzo": terrazzo,
    "gravel": gravel,
    "grass": grass,
    "wood": wood,
    "concrete": concrete,
    "tiles": tiles,
    "varied_tiles": varied_tiles,
}


def make_floor(name: str, seed: int, height_m: float = 0.55) -> FloorRaster:
    """Return an endless floor whose grain suits cameras at `height_m`.

    Raises:
        ValueError: no floor has this name; the height is not positive.
    """
    if name not in FLOORS:
        hint = nearest(name, FLOORS) or f" (known: {', '.join(FLOORS)})"
        raise ValueError(f"no floor is called {name!r}{hint}")
    return FloorRaster(FLOORS[name], seed, CELL_PER_HEIGHT * height_m)
