"""The loops of `gains`, compiled: normal equations and distances, cell by cell."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part

POWERS = 3
CHANNELS = 3


@part
def _mean(weight: Any, values: Any, ends: tuple[int, int]) -> Any:  # noqa: ANN401
    """Return the weights' sum and the values' weighted means."""
    whole, blue, green, red = 0.0, 0.0, 0.0, 0.0
    for k in range(ends[0], ends[1]):
        whole += weight[k]
        blue += weight[k] * values[k, 0]
        green += weight[k] * values[k, 1]
        red += weight[k] * values[k, 2]
    return whole, (blue / whole, green / whole, red / whole)


@part
def _add_sample(
    place: tuple[int, int, int],
    weighted: tuple[float, float],
    rest: tuple[float, float, float],
    total: Any,  # noqa: ANN401
    equations: tuple[Any, Any],
) -> None:
    """Add w a a' of one sample, a times its weighted rest, and the powers' part of w a."""
    normal, right = equations
    (view, first, lens), (w, radius2) = place, weighted
    of_view = normal[view]
    of_view[view] += w
    for channel in range(CHANNELS):
        right[view, channel] += rest[channel]
    product = 1.0
    for i in range(POWERS):
        product *= radius2
        total[lens + i] += w * product
        of_view[first + lens + i] += w * product
        both, of_power = w * product * product, normal[first + lens + i]
        for j in range(i, POWERS):
            of_power[first + lens + j] += both
            both *= radius2
        for channel in range(CHANNELS):
            right[first + lens + i, channel] += product * rest[channel]


@part
def _take_cell(
    view: Any,  # noqa: ANN401 - arrays, typed when compiled
    weight: Any,  # noqa: ANN401
    ends: tuple[int, int],
    sums: tuple[float, Any],
    normal: Any,  # noqa: ANN401
) -> None:
    """Subtract s s' / W of one cell; the sums are W and the powers' part of s."""
    whole, total = sums
    first = len(normal) - len(total)
    for k in range(ends[0], ends[1]):
        row, share = normal[view[k]], weight[k] / whole
        for other in range(k, ends[1]):
            row[view[other]] -= share * weight[other]
        for i in range(len(total)):
            row[first + i] -= share * total[i]
    for i in range(len(total)):
        row, share = normal[first + i], total[i] / whole
        for j in range(i, len(total)):
            row[first + j] -= share * total[j]


@compiled
def add_normal(
    seen: tuple[Any, Any, Any, Any],
    begins: Any,  # noqa: ANN401 - arrays, typed when compiled
    weight: Any,  # noqa: ANN401
    first: int,
    equations: tuple[Any, Any],
) -> None:
    """Add samples to the normal equations with each cell's own colour eliminated.

    With a row a of the design for each of a cell's samples, their weights w of sum W, and s the
    sum of w a, the cell adds the sum of w a a' less s s' / W. The design has a column for each
    view, and then one for each power of r^2 of each lens.

    Args:
        seen: samples in order of their cells, and of the views in a cell: views (n,), lenses (n,),
            r^2 (n,), values (n, 3).
        begins: (cells + 1,) first sample of each cell, and the number of samples.
        weight: (n,) of the samples.
        first: column of the first lens.
        equations: matrix (columns, columns), of which only what is on and over the diagonal is
            filled, and right side (columns, 3) to add to.
    """
    view, lens, radius2, values = seen
    normal, _ = equations
    total = np.zeros(len(normal) - first)
    for cell in range(len(begins) - 1):
        ends = begins[cell], begins[cell + 1]
        whole, mean = _mean(weight, values, ends)
        total[:] = 0.0
        for k in range(ends[0], ends[1]):
            w, b = weight[k], POWERS * lens[k]
            rest = (
                w * (values[k, 0] - mean[0]),
                w * (values[k, 1] - mean[1]),
                w * (values[k, 2] - mean[2]),
            )
            _add_sample((view[k], first, b), (w, radius2[k]), rest, total, equations)
        _take_cell(view, weight, ends, (whole, total), normal)


@compiled
def distances(
    seen: tuple[Any, Any, Any, Any],
    begins: Any,  # noqa: ANN401 - arrays, typed when compiled
    weight: Any,  # noqa: ANN401
    gain: Any,  # noqa: ANN401
    falloff: Any,  # noqa: ANN401
    found: Any,  # noqa: ANN401
) -> None:
    """Fill how far samples lie off their cells' weighted means, root mean square of the channels.

    Args:
        seen: see `add_normal`.
        begins: see `add_normal`.
        weight: see `add_normal`.
        gain: (views, 3).
        falloff: (lenses, POWERS).
        found: (n,) to fill.
    """
    view, lens, radius2, values = seen
    most = 0
    for cell in range(len(begins) - 1):
        most = max(most, begins[cell + 1] - begins[cell])
    rest = np.empty((most, CHANNELS))
    for cell in range(len(begins) - 1):
        start, number = begins[cell], begins[cell + 1] - begins[cell]
        whole, blue, green, red = 0.0, 0.0, 0.0, 0.0
        for i in range(number):
            k = start + i
            a, b, r2, w = view[k], lens[k], radius2[k], weight[k]
            fall = r2 * (falloff[b, 0] + r2 * (falloff[b, 1] + r2 * falloff[b, 2]))
            for channel in range(CHANNELS):
                rest[i, channel] = values[k, channel] - gain[a, channel] - fall
            whole += w
            blue, green, red = blue + w * rest[i, 0], green + w * rest[i, 1], red + w * rest[i, 2]
        blue, green, red = blue / whole, green / whole, red / whole
        for i in range(number):
            b, g, r = rest[i, 0] - blue, rest[i, 1] - green, rest[i, 2] - red
            found[start + i] = np.sqrt((b * b + g * g + r * r) / CHANNELS)
