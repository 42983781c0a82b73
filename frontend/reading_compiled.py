"""Reading a picture between its pixels, compiled: bicubic, four channels at once.

OpenCV's kernel (its cubic coefficient is -3/4) at 1/512 pixel. Numba has no vectors of its own:
the sixteen pixels around a place are multiplied as vectors of LLVM, which every machine has in
some width.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from groundfuse.backend.compiled import compiled

CHANNELS = 4
"""Bytes of a pixel: blue, green, red, and one that makes a row of four pixels sixteen bytes."""
PADDING_PX = 4
"""Pixels around a picture, as its border goes on: what is read two pixels outside needs four."""
PHASES = 512
MOST_PLACES = 8
"""Places a side of a cell that are read, at most."""
SHARPNESS = -0.75
"""Slope of the kernel one pixel off its middle."""


def _kernel(distance: np.ndarray) -> np.ndarray:
    """Weight of a pixel at a distance of 0 to 2 px: R. Keys, Cubic convolution, 1981, eq. 15."""
    d, a = np.abs(distance), SHARPNESS
    near = ((a + 2.0) * d - (a + 3.0)) * d * d + 1.0
    far = ((a * d - 5.0 * a) * d + 8.0 * a) * d - 4.0 * a
    weights: np.ndarray = np.where(d <= 1.0, near, far)
    return weights


WEIGHTS = _kernel(np.arange(PHASES + 1)[:, None] / PHASES - np.array([-1.0, 0.0, 1.0, 2.0])).astype(
    np.float32
)
"""(PHASES + 1, 4) weights of four pixels in a row for a place so far behind the second."""


def _weighted_code(_: Any, builder: Any, __: Any, arguments: Any) -> Any:  # noqa: ANN401
    """Write the weighted mean of 4 x 4 pixels, rows first: sixteen bytes are four pixels."""
    place, stride, down, across = arguments
    size = 4 * CHANNELS
    whole = ir.IntType(32)
    row_type, bytes_type = ir.VectorType(ir.FloatType(), size), ir.VectorType(ir.IntType(8), size)
    total, mean = _zeros(size), _zeros(CHANNELS)
    for row in range(4):
        address = builder.add(place, builder.mul(stride, ir.Constant(ir.IntType(64), row)))
        pixels = builder.load(builder.inttoptr(address, bytes_type.as_pointer()), align=1)
        levels = builder.uitofp(builder.zext(pixels, ir.VectorType(whole, size)), row_type)
        weight = _everywhere(builder, builder.extract_value(down, row), size)
        total = builder.fadd(total, builder.fmul(levels, weight))
    for column in range(4):
        lanes = list(range(CHANNELS * column, CHANNELS * (column + 1)))
        chosen = ir.Constant(ir.VectorType(whole, CHANNELS), lanes)
        pixel = builder.shuffle_vector(total, total, chosen)
        weight = _everywhere(builder, builder.extract_value(across, column), CHANNELS)
        mean = builder.fadd(mean, builder.fmul(pixel, weight))
    found = ir.Constant(ir.ArrayType(ir.FloatType(), CHANNELS), ir.Undefined)
    for channel in range(CHANNELS):
        level = builder.extract_element(mean, whole(channel))
        found = builder.insert_value(found, level, channel)
    return found


def _zeros(size: int) -> Any:  # noqa: ANN401
    return ir.Constant(ir.VectorType(ir.FloatType(), size), [0.0] * size)


def _everywhere(builder: Any, value: Any, size: int) -> Any:  # noqa: ANN401
    one = builder.insert_element(_zeros(size), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), size), 0))


def _declared(typing: Any, place: Any, stride: Any, down: Any, across: Any) -> Any:  # noqa: ANN401
    """Take an address, bytes per row, and the weights of rows and columns (four each)."""
    del typing, place, stride, down, across  # their types are fixed
    four = types.UniTuple(types.float32, 4)  # type: ignore[no-untyped-call]
    return four(types.uint64, types.uint64, four, four), _weighted_code


_weighted: Any = intrinsic(_declared)


@compiled
def _weights(phase: Any) -> Any:  # noqa: ANN401
    """Return the four weights of a phase 0 to 1."""
    k = np.uint64(phase * np.float32(PHASES) + np.float32(0.5))
    zero, one, two, three = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
    return WEIGHTS[k, zero], WEIGHTS[k, one], WEIGHTS[k, two], WEIGHTS[k, three]


@compiled
def bicubic(first: Any, stride: int, u: Any, v: Any) -> Any:  # noqa: ANN401
    """Return (blue, green, red, anything) at a place of a picture; it takes no arrays: faster.

    Args:
        first: address of the first pixel.
        stride: bytes per row.
        u: column, at most two pixels outside.
        v: row, likewise.
    """
    column, row = np.floor(u), np.floor(v)
    place = first + np.uint64((np.int64(row) - 1) * stride + (np.int64(column) - 1) * CHANNELS)
    return _weighted(place, np.uint64(stride), _weights(v - row), _weights(u - column))


@compiled
def _between(number: int, step: int) -> Any:  # noqa: ANN401
    """Return the lattice point before a place given in halves of a cell, how far behind it, next.

    Where the place is on a point, the next is that point: it may be the last that there is.
    """
    before = number // (2 * step)
    rest = number - before * 2 * step
    return before, np.float32(rest) / np.float32(2 * step), before + (rest > 0)


@compiled
def _columns(first: int, columns: int, step: int) -> Any:  # noqa: ANN401
    """Return `_between` of each of a row's cells: the points before, how far behind, the next."""
    before, after = np.empty(columns, np.int64), np.empty(columns, np.int64)
    behind = np.empty(columns, np.float32)
    for k in range(columns):
        before[k], behind[k], after[k] = _between(2 * (first + k) + 1 - step, step)
    return before, behind, after


@compiled
def _fill_line(lattice: Any, row: Any, ends: Any, line: Any) -> None:  # noqa: ANN401
    """Interpolate a row of the lattice, from one column to another, between two of its rows."""
    before, behind, after = row
    for j in range(ends[0], ends[1] + 1):
        for channel in range(4):
            value = lattice[before, j, channel]
            if after > before:
                value += behind * (lattice[after, j, channel] - value)
            line[j, channel] = value


@compiled
def _within(wanted: Any, wanted_places: Any, top: int) -> Any:  # noqa: ANN401
    """Return halvings and places a side where there are only so many halvings."""
    level, places = np.int64(wanted), np.int64(wanted_places)
    if level <= top:
        return level, places
    return top, min(places << (level - top), MOST_PLACES)


@compiled
def _level(value: Any) -> Any:  # noqa: ANN401
    """Return a value within the levels that there are: bicubic overshoots."""
    return min(max(value, np.float32(0.0)), np.float32(255.0))


@compiled
def find_cells(
    lattice: Any,  # noqa: ANN401
    step: int,
    window: tuple[int, int, int, int],
    limits: Any,  # noqa: ANN401
    found: tuple[Any, Any, Any],
) -> int:
    """Find all cells of a window that a picture shows; return how many there are.

    Args:
        lattice: see `Sight`.
        step: see `Sight`.
        window: first row and column, in cells from the lattice's first block, rows and columns.
        limits: (4,) see `Sight`.
        found: room for each cell's row and column in the window (n, 2), its nearest point of the
            lattice (n, 2), and its u, v, footprint and factor (n, 4).
    """
    cells, nearest, places = found
    row0, column0, rows, columns = window
    u_last, v_first, v_last, limit_cells = limits[0], limits[1], limits[2], limits[3]
    before, behind, after = _columns(column0, columns, step)
    line = np.empty((lattice.shape[1], 4), np.float32)
    number = 0
    for i in range(row0, row0 + rows):
        row = _between(2 * i + 1 - step, step)
        _fill_line(lattice, row, (before[0], after[-1]), line)
        for k in range(columns):
            share, left, right = behind[k], before[k], after[k]
            u, v, size, factor = line[left, 0], line[left, 1], line[left, 2], line[left, 3]
            if right > left:
                u += share * (line[right, 0] - u)
                v += share * (line[right, 1] - v)
                size += share * (line[right, 2] - size)
                factor += share * (line[right, 3] - factor)
            if not (u >= 0.0 and u <= u_last and v >= v_first and v <= v_last):
                continue
            if not size <= limit_cells:
                continue
            cells[number, 0], cells[number, 1] = i - row0, k
            nearest[number, 0], nearest[number, 1] = i // step, (column0 + k) // step
            places[number, 0], places[number, 1] = u, v
            places[number, 2], places[number, 3] = size, factor
            number += 1
    return number


@compiled
def read_cells(
    picture: tuple[Any, Any],
    known: tuple[Any, Any],
    nearest: Any,  # noqa: ANN401
    places: Any,  # noqa: ANN401
    colours: Any,  # noqa: ANN401
) -> None:
    """Fill colours (n, 3), levels: the mean of each cell.

    Args:
        picture: levels and table of `Pyramid`.
        known: slopes and reading of `Sight`.
        nearest: (n, 2) point of the lattice nearest to each cell.
        places: (n, 4) the pixel of its centre, and more.
        colours: to fill.
    """
    slopes, reading = known
    levels, table = picture
    start, top = np.uint64(levels.ctypes.data), len(table) - 1
    half = np.float32(0.5)
    for k in range(len(nearest)):
        i, j = nearest[k, 0], nearest[k, 1]
        level, samples = _within(reading[i, j, 0], reading[i, j, 1], top)
        scale, part = (
            np.float32(1.0) / np.float32(1 << level),
            np.float32(1.0) / np.float32(samples),
        )
        first, stride = start + np.uint64(table[level, 0]), table[level, 1]
        last_u, last_v = np.float32(table[level, 2] + 1), np.float32(table[level, 3] + 1)
        blue, green, red = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for y in range(samples):
            down = (np.float32(y) + half) * part - half
            for x in range(samples):
                across = (np.float32(x) + half) * part - half
                u = places[k, 0] + across * slopes[i, j, 0] + down * slopes[i, j, 2]
                v = places[k, 1] + across * slopes[i, j, 1] + down * slopes[i, j, 3]
                u = min(max(u * scale, np.float32(-2.0)), last_u)
                v = min(max(v * scale, np.float32(-2.0)), last_v)
                b, g, r, _ = bicubic(first, stride, u, v)
                blue, green, red = blue + b, green + g, red + r
        share = part * part
        colours[k, 0] = _level(blue * share)
        colours[k, 1] = _level(green * share)
        colours[k, 2] = _level(red * share)
