"""The loops of `gains`, compiled: normal equations and distances, cell by cell."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part

POWERS = 3
CHANNELS = 3


@compiled
def cell_sums(
    seen: tuple[Any, Any, Any, Any],
    begins: Any,  # noqa: ANN401 - arrays, typed when compiled
    weight: Any,  # noqa: ANN401
    cells: tuple[Any, Any],
    lenses: tuple[Any, Any],
) -> None:
    """Fill cells' sums of weights and weighted mean values, and add to the rows of the lenses.

    Args:
        seen: see `view_rows`.
        begins: (cells + 1,) first sample of each cell, and one past the last.
        weight: (n,) of the samples.
        cells: (cells,) sums of weights and (cells, 3) means, to fill.
        lenses: (columns, columns) and right side (columns, 3), to add to.
    """
    _, lens, radius2, values = seen
    whole, mean = cells
    normal, right = lenses
    total, present = np.zeros(len(normal)), np.empty(len(normal), np.int64)
    for cell in range(len(whole)):
        first, stop = begins[cell], begins[cell + 1]
        w, blue, green, red = 0.0, 0.0, 0.0, 0.0
        for k in range(first, stop):
            w += weight[k]
            blue += weight[k] * values[k, 0]
            green += weight[k] * values[k, 1]
            red += weight[k] * values[k, 2]
        blue, green, red = blue / w, green / w, red / w
        whole[cell], mean[cell, 0], mean[cell, 1], mean[cell, 2] = w, blue, green, red
        number = 0
        for k in range(first, stop):
            at, power = POWERS * lens[k], weight[k]
            if total[at] == 0.0:
                present[number] = at
                number += 1
            rest = values[k, 0] - blue, values[k, 1] - green, values[k, 2] - red
            for i in range(POWERS):
                power *= radius2[k]
                total[at + i] += power
                both = power
                for j in range(POWERS):
                    both *= radius2[k]
                    normal[at + i, at + j] += both
                for channel in range(CHANNELS):
                    right[at + i, channel] += power * rest[channel]
        _take_total(total, present[:number], w, normal)


@part
def _take_total(total: Any, present: Any, whole: float, normal: Any) -> None:  # noqa: ANN401
    """Subtract s s' / W of one cell, as far as it is of lenses, and empty s."""
    for one in present:
        for i in range(POWERS):
            share = total[one + i] / whole
            for other in present:
                for j in range(POWERS):
                    normal[one + i, other + j] -= share * total[other + j]
    for one in present:
        total[one : one + POWERS] = 0.0


@part
def _add(falloff: Any, lens: int, powers: tuple[float, float, float]) -> None:  # noqa: ANN401
    """Add to the columns of one lens."""
    at = POWERS * lens
    falloff[at] += powers[0]
    falloff[at + 1] += powers[1]
    falloff[at + 2] += powers[2]


@compiled
def view_rows(
    seen: tuple[Any, Any, Any, Any],
    places: tuple[Any, Any, Any, Any],
    weighted: tuple[Any, Any, Any],
    pattern: tuple[Any, Any],
    rows: tuple[Any, Any, Any],
    views: tuple[int, int],
) -> None:
    """Fill some views' rows of the normal equations with each cell's own colour eliminated.

    With a row a of the design for each of a cell's samples, their weights w of sum W, and s the
    sum of w a, the cell adds the sum of w a a' less s s' / W. The design has a column for each
    view, and then one for each power of r^2 of each lens.

    Args:
        seen: samples in order of their cells: views (n,), lenses (n,), r^2 (n,), values (n, 3).
        places: (cells + 1,) first sample of each cell, and the number of samples; (n,) cells;
            (n,) samples in order of their views; (views + 1,) first place of each view in that.
        weighted: (n,) weights, and what `cell_sums` fills of cells.
        pattern: compressed rows of the views that share a cell with each, itself among them:
            (views + 1,) and (m,).
        rows: to fill: (m,) views' columns; (views, columns) falloffs' columns and (views, 3) right
            side, which hold zeros.
        views: the first, and one past the last.
    """
    view, lens, radius2, values = seen
    begins, cell_of, order, begins_of_view = places
    weight, whole, mean = weighted
    starts, others = pattern
    between, falloff, right = rows
    row, fall = np.zeros(len(right)), np.zeros(falloff.shape[1])
    for number in range(views[0], views[1]):
        blue, green, red = 0.0, 0.0, 0.0
        for place in range(begins_of_view[number], begins_of_view[number + 1]):
            k = order[place]
            cell, w, r2 = cell_of[k], weight[k], radius2[k]
            row[number] += w
            blue += w * (values[k, 0] - mean[cell, 0])
            green += w * (values[k, 1] - mean[cell, 1])
            red += w * (values[k, 2] - mean[cell, 2])
            _add(fall, lens[k], (w * r2, w * r2 * r2, w * r2 * r2 * r2))
            share, same = w / whole[cell], lens[begins[cell]]
            c1, c2, c3 = 0.0, 0.0, 0.0  # a row's sums wait for each other, these do not
            for other in range(begins[cell], begins[cell + 1]):
                if lens[other] != same:
                    _add(fall, same, (c1, c2, c3))
                    same, c1, c2, c3 = lens[other], 0.0, 0.0, 0.0
                w, r2 = share * weight[other], radius2[other]
                row[view[other]] -= w
                w *= r2
                c1, w = c1 - w, w * r2
                c2, c3 = c2 - w, c3 - w * r2
            _add(fall, same, (c1, c2, c3))
        right[number, 0], right[number, 1], right[number, 2] = blue, green, red
        falloff[number], fall[:] = fall, 0.0
        for place in range(starts[number], starts[number + 1]):
            between[place] = row[others[place]]
            row[others[place]] = 0.0


@part
def _even(
    seen: tuple[Any, Any, Any, Any],
    k: int,
    gain: Any,  # noqa: ANN401
    falloff: Any,  # noqa: ANN401
) -> tuple[float, float, float]:
    """Return a sample's values as the usual exposure and a lens without falloff would have them."""
    view, lens, radius2, values = seen
    a, b, r2 = view[k], lens[k], radius2[k]
    fall = r2 * (falloff[b, 0] + r2 * (falloff[b, 1] + r2 * falloff[b, 2]))
    return (
        values[k, 0] - gain[a, 0] - fall,
        values[k, 1] - gain[a, 1] - fall,
        values[k, 2] - gain[a, 2] - fall,
    )


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
        seen: see `view_rows`.
        begins: see `cell_sums`.
        weight: see `cell_sums`.
        gain: (views, 3).
        falloff: (lenses, POWERS).
        found: (n,) to fill.
    """
    for cell in range(len(begins) - 1):
        whole, blue, green, red = 0.0, 0.0, 0.0, 0.0
        for k in range(begins[cell], begins[cell + 1]):
            b, g, r = _even(seen, k, gain, falloff)
            w = weight[k]
            whole, blue, green, red = whole + w, blue + w * b, green + w * g, red + w * r
        blue, green, red = blue / whole, green / whole, red / whole
        for k in range(begins[cell], begins[cell + 1]):
            b, g, r = _even(seen, k, gain, falloff)
            b, g, r = b - blue, g - green, r - red
            found[k] = np.sqrt((b * b + g * g + r * r) / CHANNELS)
