"""Keypoints of an overhead view: where blobs stand out, spread over the floor, and described."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.describe_compiled import descriptors, orientations
from groundfuse.frontend.extrema_compiled import find_extrema, located
from groundfuse.frontend.scale_space import STEPS, Octave, scale_space, sigma_px

SURPLUS = 1.35
"""The strongest blobs per feature wanted: of them those are taken that cover the floor."""
PLACES = 0.85
"""Blobs described per feature wanted: some have a second direction, and count twice."""
SECOND = 0.8
"""A direction counts from this share of the strongest on."""
TURNING_LEVEL = 4
"""Directions are read from a level that is smoother than the blobs: they are steadier there."""
SIZES = 2
"""Sizes, each 1.2 times the next, at which corners are looked for: an overhead view has one scale,
and what heights and wobble add to it is less than the second size."""
BAND_PX, BANDS_APART = 16, 8
"""Rows of a band of a view, and every how many of them one is looked at beforehand."""
ENOUGH = 2.0
"""Corners per corner asked for that a threshold leaves. ORB looks at twice what it is asked for, at
little more than half of that in the larger size; what is over is for bands unlike the rest."""
MOST = 3.2
"""Brighter and darker than this many local standard deviations is cut: lamps, holes."""


class Keypoints(NamedTuple):
    """Keypoints of a raster.

    Attributes:
        points_px: (n, 2) u and v.
        size_px: (n,) diameter: two sigmas of a blob.
        angle_rad: (n,) direction, clockwise from u.
        descriptors: (n, ...) one row each.
    """

    points_px: Points
    size_px: Floats
    angle_rad: Floats
    descriptors: np.ndarray[Any, Any]


def blobs(normalised: Picture32, inner: Mask, wanted: int, least: float, cell_px: int) -> Keypoints:
    """Return the blobs of a view, described by RootSIFT rows (n, 128) float32.

    Args:
        normalised: (rows, columns) view after local contrast normalisation.
        inner: (rows, columns) where keypoints may lie.
        wanted: most that are returned.
        least: local standard deviations by which a blob stands out at least.
        cell_px: side of the cells over which they are spread.
    """
    octaves = scale_space(np.clip(normalised, -MOST, MOST))
    places = np.concatenate(
        [np.zeros((0, 5)), *(_places(o, octaves[o], inner, least) for o in range(len(octaves)))]
    )
    chosen = strongest(places[:, 4], round(SURPLUS * PLACES * wanted))
    places = places[chosen]
    points = places[:, 1:3] * 2.0 ** places[:, :1]
    chosen = spread(points, places[:, 4], round(PLACES * wanted), cell_px)
    index, angle, rows = _described(octaves, places[chosen])
    index, angle, rows = index[:wanted], angle[:wanted], rows[:wanted]
    kept = chosen[index]
    # A blob stands out most between two blurs whose geometric mean is its own.
    size = 2.0 * sigma_px(0.5) * 2.0 ** (places[kept, 3] / STEPS + places[kept, 0])
    return Keypoints(points[kept], size, angle, rows)


def _places(number: int, octave: Octave, inner: Mask, least: float) -> Floats:
    """Return octave, x, y, level and strength (n, 5) of blobs, pixels of the octave."""
    stack = octave.differences
    found = find_extrema(stack, inner, 2**number, 0.5 * least)
    places = located(stack, found, least)
    return np.column_stack([np.full(len(places), float(number)), places])


def _described(
    octaves: list[Octave], places: Floats
) -> tuple[NDArray[np.int64], Floats, Picture32]:
    """Return index into the places, direction and descriptor of keypoints, in order of places."""
    indices, angles, rows = [], [], []
    level = np.clip(np.rint(places[:, 3]), 1, STEPS)
    for number, octave in enumerate(octaves):
        turning = octave.levels[TURNING_LEVEL]
        here = np.flatnonzero(places[:, 0] == number)
        found = orientations(turning, places[here, 1:3], sigma_px(TURNING_LEVEL), SECOND)
        index, angle = here[found[:, 0].astype(np.int64)], found[:, 1]
        blur = sigma_px(0) * 2.0 ** (places[index, 3] / STEPS)
        table = np.column_stack([places[index, 1:3], angle, blur])
        for k in range(1, STEPS + 1):
            of_level = level[index] == k
            indices.append(index[of_level])
            angles.append(angle[of_level])
            rows.append(descriptors(octave.levels[k], table[of_level]))
    if not indices:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 128), np.float32)
    index = np.concatenate(indices)
    order = np.argsort(index, kind="stable")
    return index[order], np.concatenate(angles)[order], np.concatenate(rows)[order]


def corners(flat: Image, inner: Mask, wanted: int, least_grey: float, cell_px: int) -> Keypoints:
    """Return the corners of a view in grey values, described by ORB's bits (n, 32) uint8.

    Args:
        flat: (rows, columns) view after local contrast normalisation.
        inner: (rows, columns) where corners may lie.
        wanted: most that are returned.
        least_grey: grey values by which a corner's arc differs at least.
        cell_px: side of the cells over which they are spread.
    """
    asked = 2 * wanted + 1
    least = least_that_matters(flat, inner, asked, round(least_grey))
    orb = cv2.ORB.create(nfeatures=asked, fastThreshold=least, nlevels=SIZES)
    many = orb.detect(flat, inner.astype(np.uint8))
    points = _points(many)
    strength = np.array([k.response for k in many], dtype=np.float64)
    kept, bits = orb.compute(flat, [many[i] for i in spread(points, strength, wanted, cell_px)])
    return Keypoints(
        _points(kept),
        np.array([k.size for k in kept], dtype=np.float64),
        np.radians(np.array([k.angle for k in kept], dtype=np.float64)),
        np.zeros((0, 32), np.uint8) if bits is None else np.asarray(bits, dtype=np.uint8),
    )


def least_that_matters(flat: Image, inner: Mask, asked: int, least_grey: int) -> int:
    """Return the threshold above which a view has as many corners as ORB looks at.

    Of those that pass, ORB looks only at the ones whose arcs differ most, twice as many as it is
    asked for. So where a lively floor has far more, a higher threshold finds the same in less time;
    how many there are is seen from some bands of rows.

    Args:
        flat: (rows, columns) view in grey values.
        inner: (rows, columns) where corners may lie.
        asked: corners that ORB is asked for.
        least_grey: threshold that is never gone below.
    """
    apart = BANDS_APART * BAND_PX
    bands = [
        _arcs(flat, inner, k, least_grey) for k in range(apart // 2, len(flat) - apart // 2, apart)
    ]
    arcs = np.concatenate([np.zeros(0), *bands])
    enough = round(ENOUGH * asked / BANDS_APART)
    if len(arcs) <= enough:
        return least_grey
    return int(np.partition(arcs, -enough)[-enough])


def _arcs(flat: Image, inner: Mask, first: int, least_grey: int) -> Floats:
    """Return by how much the arcs differ at the corners of a band of rows, grey values (n,)."""
    beside = 4  # a corner's arc, and that of the pixel next to it, which may be the better one
    band = flat[first - beside : first + BAND_PX + beside]
    found = cv2.FastFeatureDetector.create(least_grey).detect(band)
    u, v = np.rint(_points(found)).astype(np.int64).T
    strength = np.array([k.response for k in found], dtype=np.float64)
    counts = (v >= beside) & (v < BAND_PX + beside) & inner[first - beside + v, u]
    arcs: Floats = strength[counts]
    return arcs


def _points(keypoints: Sequence[cv2.KeyPoint]) -> Points:
    """Return u and v of OpenCV's keypoints (n, 2)."""
    return np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64).reshape(-1, 2)


def strongest(strength: Floats, wanted: int) -> NDArray[np.int64]:
    """Return the indices of the strongest, ascending; of equals the first."""
    order = np.argsort(-strength, kind="stable")
    return np.sort(order[:wanted])


def spread(points_px: Points, strength: Floats, wanted: int, cell_px: int) -> NDArray[np.int64]:
    """Choose the strongest of every cell in turn, so that all of the floor is covered.

    Returns indices, ascending.
    """
    if len(points_px) <= wanted:
        return np.arange(len(points_px))
    cell = (points_px // cell_px).astype(np.int64)
    key = cell[:, 0] * 100_000 + cell[:, 1]
    order = np.lexsort((points_px[:, 1], points_px[:, 0], -strength, key))
    starts = np.flatnonzero(np.r_[True, key[order][1:] != key[order][:-1]])
    place = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    chosen = order[np.lexsort((-strength[order], place))[:wanted]]
    return np.sort(chosen)
