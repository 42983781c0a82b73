"""Resample a picture so that each output cell is the mean of the picture over that cell."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.area_compiled import fill_means, quads_of
from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32
from groundfuse.frontend.plan_compiled import samples_of_cells

MAX_SUPERSAMPLING = 8
PX_PER_SAMPLE = 1.25
"""Samples reach two pixels each (bilinear), so that none in between is passed over."""
JACOBIAN_STEP = 4
"""The scale of the picture is looked at in every fourth cell of every fourth row."""
OUTSIDE_PX = -1e4
"""Stands for a cell without a place in the picture, which remap cannot take as nan."""
REMAPPED = 30_000
"""Cells per call of remap, which takes no picture of 32767 px or more."""
MEAN_TO_POINT = np.array([-1.0, 26.0, -1.0], dtype=np.float32) / np.float32(24.0)
"""A pixel is the mean m of the light over its square; the light at its middle is m - m'' / 24 to
fourth order, along each axis (the finite-volume methods' rule)."""


def singular_values(by_u: Floats, by_v: Floats) -> tuple[Floats, Floats]:
    """Largest and smallest singular value of 2x2 Jacobians given by their columns (..., 2)."""
    plus = np.hypot(by_u[..., 0] + by_v[..., 1], by_u[..., 1] - by_v[..., 0])
    minus = np.hypot(by_u[..., 0] - by_v[..., 1], by_u[..., 1] + by_v[..., 0])
    return (plus + minus) / 2.0, np.abs(plus - minus) / 2.0


class AreaPlan(NamedTuple):
    """Where each wanted cell of an output picture reads, worked out once for many pictures.

    Attributes:
        level: halvings of the picture that lose nothing.
        samples: samples per side of a cell.
        cells: (n, 2) uint32 rows and columns of the wanted cells.
        places: (n, samples ** 2, 2) float32 picture columns and rows at that level.
        starts: (n, samples ** 2) uint32 first of the four pixels around a place; see `fill_means`.
        parts: (n, samples ** 2) uint16 place behind it; see `fill_means`.
    """

    level: int
    samples: int
    cells: NDArray[np.uint32]
    places: Picture32
    starts: NDArray[np.uint32]
    parts: NDArray[np.uint16]


def area_plan(source_px: Floats, wanted: Mask, size_px: tuple[int, int]) -> AreaPlan:
    """Plan the reading of cells.

    Args:
        source_px: (rows + 2, columns + 2, 2) picture coordinates of the cells' centres, with a
            margin of one cell; nan where a cell has none.
        wanted: (rows, columns) cells that matter; the others are not read.
        size_px: columns and rows of the picture, at least two.
    """
    level, samples = _level_and_factor(source_px, wanted)
    level = min(level, int(math.log2(min(size_px) - 1)))
    maps = np.nan_to_num(source_px / 2.0**level, nan=OUTSIDE_PX)
    cells = np.argwhere(wanted).astype(np.uint32)
    if samples == 1:
        places = maps[1:-1, 1:-1][wanted].astype(np.float32)[:, None]
        nothing = np.zeros((0, 1), np.uint32), np.zeros((0, 1), np.uint16)
        return AreaPlan(level, samples, cells, places, *nothing)
    last = tuple(-(-side // 2**level) - 1 for side in size_px)
    found = samples_of_cells(maps, cells, samples, last)
    return AreaPlan(level, samples, cells, np.zeros((0, 1, 2), np.float32), *found)


def point_values(image: Image) -> Image:
    """Return the light at the middles of a picture's pixels, whose values are means.

    Interpolation joins points. Joining means as if they were points and then averaging over cells
    would average over a pixel twice: at a cell of one pixel, details four cells long would lose a
    fifth of their energy.
    """
    points = cv2.sepFilter2D(
        image, -1, MEAN_TO_POINT, MEAN_TO_POINT, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(points, dtype=image.dtype)


@dataclass(slots=True, eq=False)
class Halvings:
    """A picture to read from, and what reading has made of it so far.

    Attributes:
        pictures: the picture, then halvings of it; grows where more are needed.
        quads: those of each channel, by level; see `quads_of`.
    """

    pictures: list[Image]
    quads: dict[int, list[NDArray[np.uint32]]] = field(default_factory=dict)

    def picture(self, level: int) -> Image:
        """Return the picture after so many halvings."""
        while len(self.pictures) <= level:
            halved = cv2.pyrDown(self.pictures[-1])
            self.pictures.append(np.asarray(halved, dtype=self.pictures[0].dtype))
        return self.pictures[level]

    def quads_at(self, level: int) -> list[NDArray[np.uint32]]:
        """Return the quads of each channel after so many halvings."""
        if level not in self.quads:
            planes = cv2.split(self.picture(level))
            self.quads[level] = [quads_of(np.ascontiguousarray(plane)) for plane in planes]
        return self.quads[level]


def area_read(halvings: Halvings, plan: AreaPlan, view: Image) -> None:
    """Average the picture over each cell: the pyramid level that loses nothing, supersampled.

    Where the picture is coarser than the cells it is interpolated (bicubic).

    Args:
        halvings: of the picture.
        plan: where each cell reads.
        view: (rows, columns, ...) output picture; only the planned cells are written.
    """
    if plan.samples > 1:
        quads = halvings.quads_at(plan.level)
        deep = view.reshape(*view.shape[:2], len(quads))
        for channel, of_channel in enumerate(quads):
            fill_means(of_channel, plan.starts, plan.parts, plan.cells, deep, channel)
        return
    picture = halvings.picture(plan.level)
    for first in range(0, len(plan.cells), REMAPPED):
        some = slice(first, first + REMAPPED)
        u, v = (np.ascontiguousarray(plan.places[some, :, axis]) for axis in (0, 1))
        read = cv2.remap(picture, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        view[plan.cells[some, 0], plan.cells[some, 1]] = np.asarray(read)[:, 0]


def _level_and_factor(source_px: Floats, wanted: Mask) -> tuple[int, int]:
    """Return the halvings that still leave two pixels per cell, and samples per cell side."""
    some = slice(None, None, JACOBIAN_STEP)
    by_u = (source_px[1:-1, 2:] - source_px[1:-1, :-2])[some, some] / 2.0
    by_v = (source_px[2:, 1:-1] - source_px[:-2, 1:-1])[some, some] / 2.0
    most, least = singular_values(by_u, by_v)
    kept = wanted[some, some] & np.isfinite(most)
    most, least = most[kept], least[kept]
    level = math.floor(math.log2(max(least.min(), 2.0) / 2.0)) if least.size else 0
    longest = float(most.max(initial=1.0)) / 2.0**level
    samples = 1 if longest <= 1.0 + 1e-9 else max(2, math.ceil(longest / PX_PER_SAMPLE - 1e-9))
    return level, min(MAX_SUPERSAMPLING, samples)
