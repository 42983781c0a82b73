"""Resample a picture so that each output cell is the mean of the picture over that cell."""

import math

import cv2
import numpy as np

from groundfuse.frontend.arrays import Floats, Image, Mask

MAX_SUPERSAMPLING = 8
JACOBIAN_STEP = 4
"""The scale of the picture is looked at in every fourth cell of every fourth row."""
OUTSIDE_PX = -1e4
"""Stands for a cell without a place in the picture, which remap cannot take as nan."""


def singular_values(by_u: Floats, by_v: Floats) -> tuple[Floats, Floats]:
    """Largest and smallest singular value of 2x2 Jacobians given by their columns (..., 2)."""
    plus = np.hypot(by_u[..., 0] + by_v[..., 1], by_u[..., 1] - by_v[..., 0])
    minus = np.hypot(by_u[..., 0] - by_v[..., 1], by_u[..., 1] + by_v[..., 0])
    return (plus + minus) / 2.0, np.abs(plus - minus) / 2.0


def area_remap(pyramid: list[Image], source_px: Floats, wanted: Mask) -> Image:
    """Average the picture over each cell: the pyramid level that loses nothing, supersampled.

    Where the picture is coarser than the cells it is interpolated (bicubic).

    Args:
        pyramid: the picture, then halvings of it; grows where more are needed.
        source_px: (rows + 2, columns + 2, 2) picture coordinates of the cells' centres, with a
            margin of one cell; nan where a cell has none.
        wanted: (rows, columns) cells that matter; the others hold anything.
    """
    level, factor = _level_and_factor(source_px, wanted)
    while len(pyramid) <= level:
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), dtype=pyramid[0].dtype))
    maps = np.nan_to_num(source_px / 2.0**level, nan=OUTSIDE_PX).astype(np.float32)
    fine = cv2.resize(maps, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
    map_u, map_v = cv2.split(fine[factor:-factor, factor:-factor])
    interpolation = cv2.INTER_CUBIC if factor == 1 else cv2.INTER_LINEAR
    sampled = cv2.remap(
        pyramid[level], map_u, map_v, interpolation, borderMode=cv2.BORDER_REPLICATE
    )
    size = (wanted.shape[1], wanted.shape[0])
    averaged = cv2.resize(sampled, size, interpolation=cv2.INTER_AREA)
    return np.asarray(averaged, dtype=pyramid[0].dtype)


def _level_and_factor(source_px: Floats, wanted: Mask) -> tuple[int, int]:
    """Return the halvings that still leave two pixels per cell, and samples per cell side."""
    some = slice(None, None, JACOBIAN_STEP)
    by_u = (source_px[1:-1, 2:] - source_px[1:-1, :-2])[some, some] / 2.0
    by_v = (source_px[2:, 1:-1] - source_px[:-2, 1:-1])[some, some] / 2.0
    most, least = singular_values(by_u, by_v)
    kept = wanted[some, some] & np.isfinite(most)
    most, least = most[kept], least[kept]
    level = math.floor(math.log2(max(least.min(), 2.0) / 2.0)) if least.size else 0
    samples = math.ceil(most.max(initial=1.0) / 2.0**level - 1e-9)
    return level, min(MAX_SUPERSAMPLING, samples)
