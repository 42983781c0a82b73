"""Extrema in a stack of differences of Gaussians, and where exactly they lie; compiled.

Lowe 2004, sections 3.1 and 4. The parabola through the three nearest pixels misplaces a small blob
by up to a tenth of a pixel; another one through points half as far apart does not.
"""

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Mask, Picture32

BORDER_PX = 5
"""Extrema this near to a picture's border are not looked for."""
MOVES = 5
FARTHEST = 100.0
REACH, LAYER_REACH = 0.6, 0.75
"""Pixels and layers; more than half, or what lies halfway between two would go to and fro, and a
blob between two octaves would be found in neither."""
EDGE = 12.1
"""(r + 1)^2 / r for principal curvatures of a ratio r = 10."""
HALF = 0.5
"""Distance of the points of the last parabola, pixels."""


@part
def _mark_row(row: np.ndarray, stack: Picture32, k: int, y: int, least: np.float32) -> None:
    """Mark what is beyond six neighbours, one step away along each axis: a vector operation."""
    here, up, down = stack[k, y], stack[k, y - 1], stack[k, y + 1]
    finer, coarser = stack[k - 1, y], stack[k + 1, y]
    for x in range(1, len(row) - 1):
        v, left, right = here[x], here[x - 1], here[x + 1]
        high = (v > least) & (v > left) & (v >= right) & (v > up[x]) & (v >= down[x])
        low = (v < -least) & (v < left) & (v <= right) & (v < up[x]) & (v <= down[x])
        high &= (v > finer[x]) & (v >= coarser[x])
        low &= (v < finer[x]) & (v <= coarser[x])
        row[x] = np.uint8(high | low)


@part
def _is_extremum(stack: Picture32, k: int, y: int, x: int) -> bool:
    """Compare with all 26 neighbours; of equals the first in memory wins."""
    v = stack[k, y, x]
    sign = np.float32(1.0) if v > 0.0 else np.float32(-1.0)
    v *= sign
    for dk in range(-1, 2):
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                other = sign * stack[k + dk, y + dy, x + dx]
                before = 9 * dk + 3 * dy + dx < 0
                if other > v or (before and other == v):
                    return False
    return True


@compiled
def find_extrema(stack: Picture32, inner: Mask, stride: int, least: float) -> np.ndarray:
    """Return layer, row and column (n, 3) of extrema.

    Args:
        stack: (layers, rows, columns) differences of Gaussians.
        inner: mask of the first octave, in which extrema count.
        stride: pixels of the mask per pixel of the stack.
        least: absolute value that they are above.
    """
    layers, rows, columns = stack.shape
    row = np.zeros(columns, np.uint8)
    found = np.empty((layers * (rows // 2 + 1) * (columns // 2 + 1), 3), np.int32)
    count = 0
    for k in range(1, layers - 1):
        for y in range(BORDER_PX, rows - BORDER_PX):
            _mark_row(row, stack, k, y, np.float32(least))
            for x in range(BORDER_PX, columns - BORDER_PX):
                if row[x] and inner[y * stride, x * stride] and _is_extremum(stack, k, y, x):
                    found[count, 0], found[count, 1], found[count, 2] = k, y, x
                    count += 1
    return found[:count].copy()


@part
def _vertex(stack: Picture32, k: int, y: int, x: int, out: Floats) -> bool:
    """Write offset (x, y, layer), value and edge number of the parabola through 27 values."""
    v = np.float64(stack[k, y, x])
    gx = 0.5 * (stack[k, y, x + 1] - stack[k, y, x - 1])
    gy = 0.5 * (stack[k, y + 1, x] - stack[k, y - 1, x])
    gs = 0.5 * (stack[k + 1, y, x] - stack[k - 1, y, x])
    xx = stack[k, y, x + 1] + stack[k, y, x - 1] - 2.0 * v
    yy = stack[k, y + 1, x] + stack[k, y - 1, x] - 2.0 * v
    ss = stack[k + 1, y, x] + stack[k - 1, y, x] - 2.0 * v
    a, b = stack[k, y + 1], stack[k, y - 1]
    xy = 0.25 * (a[x + 1] - a[x - 1] - b[x + 1] + b[x - 1])
    a, b = stack[k + 1, y], stack[k - 1, y]
    xs = 0.25 * (a[x + 1] - a[x - 1] - b[x + 1] + b[x - 1])
    ys = 0.25 * (stack[k + 1, y + 1, x] - stack[k + 1, y - 1, x])
    ys -= 0.25 * (stack[k - 1, y + 1, x] - stack[k - 1, y - 1, x])
    c_xx, c_xy, c_xs = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    c_yy, c_ys, c_ss = xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy
    determinant = xx * c_xx + xy * c_xy + xs * c_xs
    if determinant == 0.0 or c_ss <= 0.0:
        return False
    out[0] = -(c_xx * gx + c_xy * gy + c_xs * gs) / determinant
    out[1] = -(c_xy * gx + c_yy * gy + c_ys * gs) / determinant
    out[2] = -(c_xs * gx + c_ys * gy + c_ss * gs) / determinant
    out[3] = v + 0.5 * (gx * out[0] + gy * out[1] + gs * out[2])
    out[4] = (xx + yy) ** 2 / c_ss
    return True


@part
def _lagrange(at: float, weights: Floats) -> int:
    """Write weights of six pixels for a point between the middle ones; return the first."""
    first = int(np.floor(at)) - 2
    t = at - first
    for i in range(6):
        weight = 1.0
        for j in range(6):
            if j != i:
                weight *= (t - j) / (i - j)
        weights[i] = weight
    return first


@part
def _nine(layer: Picture32, x: float, y: float, out: Floats) -> None:
    """Write values (3, 3) around a point, `HALF` a pixel apart."""
    rows, columns = layer.shape
    across, down = np.empty((3, 6)), np.empty(6)
    first_x = np.empty(3, np.int64)
    for i in range(3):
        first_x[i] = _lagrange(x + (i - 1) * HALF, across[i])
    for j in range(3):
        first_y = _lagrange(y + (j - 1) * HALF, down)
        for i in range(3):
            total = 0.0
            for q in range(6):
                line = layer[min(max(first_y + q, 0), rows - 1)]
                part_sum = 0.0
                for p in range(6):
                    part_sum += across[i, p] * line[min(max(first_x[i] + p, 0), columns - 1)]
                total += down[q] * part_sum
            out[j, i] = total


@part
def _polish(layer: Picture32, place: Floats, values: Floats) -> None:
    """Move x and y of a place to the vertex of a parabola through near points."""
    _nine(layer, place[0], place[1], values)
    gx, gy = 0.5 * (values[1, 2] - values[1, 0]), 0.5 * (values[2, 1] - values[0, 1])
    xx = values[1, 2] + values[1, 0] - 2.0 * values[1, 1]
    yy = values[2, 1] + values[0, 1] - 2.0 * values[1, 1]
    xy = 0.25 * (values[2, 2] - values[2, 0] - values[0, 2] + values[0, 0])
    determinant = xx * yy - xy * xy
    if determinant <= 0.0:
        return
    dx = (xy * gy - yy * gx) / determinant * HALF
    dy = (xy * gx - xx * gy) / determinant * HALF
    if max(abs(dx), abs(dy)) < HALF:
        place[0] += dx
        place[1] += dy


@compiled
def located(stack: Picture32, found: np.ndarray, least: float) -> Floats:
    """Return x, y, layer and absolute value (m, 4) of extrema that are no edges.

    Args:
        stack: (layers, rows, columns) differences of Gaussians.
        found: (n, 3) layers, rows and columns of extrema.
        least: absolute value of the vertex that they reach.
    """
    layers, rows, columns = stack.shape
    places = np.empty((len(found), 4))
    out, values = np.zeros(5), np.zeros((3, 3))
    count = 0
    for n in range(len(found)):
        k, y, x = found[n, 0], found[n, 1], found[n, 2]
        good = False
        for _ in range(MOVES):
            if not _vertex(stack, k, y, x, out):
                break
            away = max(abs(out[0]), abs(out[1]))
            good = away < REACH and abs(out[2]) < LAYER_REACH
            if good or max(away, abs(out[2])) > FARTHEST:
                break
            x, y, k = x + int(np.rint(out[0])), y + int(np.rint(out[1])), k + int(np.rint(out[2]))
            if k < 1 or k > layers - 2 or y < BORDER_PX or y >= rows - BORDER_PX:
                break
            if x < BORDER_PX or x >= columns - BORDER_PX:
                break
        if good and abs(out[3]) >= least and out[4] < EDGE:
            place = places[count]
            place[0], place[1], place[2], place[3] = x + out[0], y + out[1], k + out[2], abs(out[3])
            _polish(stack[k], place, values)
            count += 1
    return places[:count].copy()
