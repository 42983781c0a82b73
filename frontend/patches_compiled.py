"""The loops of `patches`, compiled: reading a patch through a homography, and laying it on."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part

STEP_PX = 0.002
"""A patch that moves by less has come to rest: a tenth of what it can be known to."""
LONGEST_STEP_PX = 1.0
FAINTEST = 1.0
"""Least deviation of grey values in a patch, levels: below it is the camera's own noise."""


@part
def _between(picture: Any, x: Any, y: Any, right: Any, down: Any) -> Any:  # noqa: ANN401
    """Return the grey value (bilinear) so far right of and below a pixel."""
    upper, lower = np.float32(picture[y, x]), np.float32(picture[y + 1, x])
    upper += right * (np.float32(picture[y, x + 1]) - upper)
    lower += right * (np.float32(picture[y + 1, x + 1]) - lower)
    return upper + down * (lower - upper)


@compiled
def read_between(picture: Any, u: Any, v: Any) -> Any:  # noqa: ANN401 - arrays, typed when compiled
    """Return the grey value (bilinear) at a place between the picture's pixels."""
    x, y = np.int64(u), np.int64(v)
    return _between(picture, x, y, np.float32(u - x), np.float32(v - y))


@compiled
def fill_templates(
    picture: Any,  # noqa: ANN401
    rows: tuple[int, int],
    which: Any,  # noqa: ANN401
    places: Any,  # noqa: ANN401
    how: tuple[Any, Any],
    templates: Any,  # noqa: ANN401
) -> None:
    """Read patches of a picture as other pictures would show them; nan at the first pixel: none.

    Args:
        picture: (rows, columns) uint8 grey.
        rows: first and last row that may be read.
        which: (m,) numbers of the templates to fill.
        places: (m, 2) middle of each in the picture.
        how: (m, 3, 3) homographies from pixels (x, y) off the middle there to pixels off the middle
            here, and (m, 2, 3) what is added, of x x, x y and y y.
        templates: (n, side, side) float32 to fill.
    """
    side = templates.shape[1]
    reach, last_u = side // 2, picture.shape[1] - 1
    for k in range(len(which)):
        n, m, b = which[k], how[0][k], how[1][k]
        for i in range(side):
            for j in range(side):
                x, y = np.float64(j - reach), np.float64(i - reach)
                depth = m[2, 0] * x + m[2, 1] * y + m[2, 2]
                u = places[k, 0] + (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / depth
                v = places[k, 1] + (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / depth
                u += b[0, 0] * x * x + b[0, 1] * x * y + b[0, 2] * y * y
                v += b[1, 0] * x * x + b[1, 1] * x * y + b[1, 2] * y * y
                if not (u >= 0.0 and u < last_u and v >= rows[0] and v < rows[1]):
                    templates[n, 0, 0] = np.nan
                    break
                templates[n, i, j] = read_between(picture, u, v)
            if np.isnan(templates[n, 0, 0]):
                break


@compiled
def _standard(patch: Any, weight: Any, standard: Any) -> Any:  # noqa: ANN401
    """Fill the patch less its mean, over its deviation, and return the deviation."""
    mean, square = 0.0, 0.0
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            mean += weight[i, j] * patch[i, j]
            square += weight[i, j] * patch[i, j] * patch[i, j]
    deviation = np.sqrt(max(square - mean * mean, 0.0))
    one = 1.0 / max(deviation, 1e-6)
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            standard[i, j] = (patch[i, j] - mean) * one
    return deviation


@compiled
def _slopes(template: Any, weight: Any, deviation: float, slope: Any) -> tuple[float, float, float]:  # noqa: ANN401
    """Fill the slopes (side, side, 2) of a standardised template; return their squares' sums.

    Less their means: a patch's own level and contrast are free.

    Args:
        template: (side + 2, side + 2) with a border of one pixel.
        weight: (side, side) of sum one.
        deviation: of the template without its border.
        slope: to fill.
    """
    half, by_u, by_v = 0.5 / deviation, 0.0, 0.0
    side = slope.shape[0]
    for i in range(side):
        for j in range(side):
            slope[i, j, 0] = half * (template[i + 1, j + 2] - template[i + 1, j])
            slope[i, j, 1] = half * (template[i + 2, j + 1] - template[i, j + 1])
            by_u += weight[i, j] * slope[i, j, 0]
            by_v += weight[i, j] * slope[i, j, 1]
    a, b, c = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            slope[i, j, 0] -= by_u
            slope[i, j, 1] -= by_v
            a += weight[i, j] * slope[i, j, 0] * slope[i, j, 0]
            b += weight[i, j] * slope[i, j, 0] * slope[i, j, 1]
            c += weight[i, j] * slope[i, j, 1] * slope[i, j, 1]
    return a, b, c


@compiled
def _read_patch(picture: Any, rows: tuple[int, int], u: float, v: float, patch: Any) -> bool:  # noqa: ANN401
    """Read a patch with its middle at a place; False where it is not all in the picture."""
    reach = patch.shape[0] // 2
    inside = u - reach >= 0.0 and u + reach < picture.shape[1] - 1
    if not (inside and v - reach >= rows[0] and v + reach < rows[1]):
        return False
    x, y = np.int64(u) - reach, np.int64(v) - reach
    right, down = np.float32(u - np.int64(u)), np.float32(v - np.int64(v))
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            patch[i, j] = _between(picture, x + j, y + i, right, down)
    return True


@compiled
def _step(wanted: Any, seen: Any, weight: Any, slope: Any) -> tuple[float, float, float]:  # noqa: ANN401
    """Return what the slopes say of the difference, and the mean product of the two patches."""
    along_u, along_v, product = 0.0, 0.0, 0.0
    for i in range(seen.shape[0]):
        for j in range(seen.shape[1]):
            here = weight[i, j] * (wanted[i, j] - seen[i, j])
            along_u += here * slope[i, j, 0]
            along_v += here * slope[i, j, 1]
            product += weight[i, j] * wanted[i, j] * seen[i, j]
    return along_u, along_v, product


@compiled
def _resting(
    picture: Any,  # noqa: ANN401
    rows: tuple[int, int],
    begin: tuple[float, float],
    room: tuple[Any, Any, Any, Any, Any],
    sums: tuple[float, float, float],
    most: tuple[int, float],
) -> tuple[float, float, float]:
    """Return where a template rests, and its correlation there; -1 where it does not.

    Args:
        picture: see `lay_on`.
        rows: see `lay_on`.
        begin: column and row.
        room: weights, the template (standardised), its slopes, and two patches to work in.
        sums: of the slopes' squares; see `_slopes`.
        most: see `lay_on`.
    """
    weight, wanted, slope, patch, seen = room
    a, b, c = sums
    determinant, resting = a * c - b * b, False
    u, v = begin
    for _ in range(most[0]):
        if not _read_patch(picture, rows, u, v, patch):
            break
        if _standard(patch, weight, seen) < FAINTEST:
            break
        along_u, along_v, product = _step(wanted, seen, weight, slope)
        if resting:
            return u, v, product
        step_u = (c * along_u - b * along_v) / determinant
        step_v = (a * along_v - b * along_u) / determinant
        length = np.sqrt(step_u * step_u + step_v * step_v)
        share = min(1.0, LONGEST_STEP_PX / max(length, 1e-9))
        u, v = u + share * step_u, v + share * step_v
        if (u - begin[0]) ** 2 + (v - begin[1]) ** 2 > most[1] ** 2:
            break
        resting = length < STEP_PX
    return u, v, -1.0


@compiled
def lay_on(
    picture: Any,  # noqa: ANN401
    rows: tuple[int, int],
    places: Any,  # noqa: ANN401
    templates: Any,  # noqa: ANN401
    weight: Any,  # noqa: ANN401
    most: tuple[int, float],
    found: Any,  # noqa: ANN401
) -> None:
    """Move each template over a picture to where it fits best (Lucas and Kanade 1981).

    Args:
        picture: (rows, columns) uint8 grey.
        rows: first and last row that may be read.
        places: (n, 2) where to begin.
        templates: (n, side + 2, side + 2) float32, with a border of one pixel.
        weight: (side, side) of sum one.
        most: steps, and pixels from the beginning.
        found: (n, 4) to fill: column, row, correlation, and deviation of a place for residuals of
            one standard deviation each; a correlation of -1 says that there is none.
    """
    side = weight.shape[0]
    wanted, seen = np.empty((side, side)), np.empty((side, side))
    patch, slope = np.empty((side, side)), np.empty((side, side, 2))
    for n in range(len(places)):
        found[n, 0], found[n, 1], found[n, 2], found[n, 3] = places[n, 0], places[n, 1], -1.0, 0.0
        if np.isnan(templates[n, 0, 0]):
            continue
        deviation = _standard(templates[n, 1:-1, 1:-1], weight, wanted)
        if deviation < FAINTEST:
            continue
        a, b, c = _slopes(templates[n], weight, deviation, slope)
        if not a * c - b * b > 1e-12:
            continue
        begin, room = (places[n, 0], places[n, 1]), (weight, wanted, slope, patch, seen)
        u, v, product = _resting(picture, rows, begin, room, (a, b, c), most)
        found[n, 0], found[n, 1], found[n, 2] = u, v, product
        found[n, 3] = np.sqrt((a + c) / (2.0 * (a * c - b * b)))
