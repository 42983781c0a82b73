"""The loops of `gains`, compiled: normal equations and distances, cell by cell."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part

POWERS = 3
CHANNELS = 3


@compiled
def cell_sums(
    seen: tuple[Any, Any, Any, Any],
    begins: tuple[Any, Any, Any],
    weight: Any,  # noqa: ANN401 - arrays, typed when compiled
    cells: tuple[Any, Any],
    sums: Any,  # noqa: ANN401
    lenses: tuple[Any, Any],
) -> None:
    """Fill cells' sums of weights and weighted mean values, and add to the rows of the lenses.

    Args:
        seen: samples in order of their cells, and of the views in a cell: views (n,), lenses (n,),
            r^2 (n,), values (n, 3).
        begins: (cells + 1,) first sample of each cell; (cells + 1,) its first run of samples of
            one lens; (runs + 1,) first sample of each; and the number of all.
        weight: (n,) of the samples.
        cells: (cells,) sums of weights and (cells, 3) means, to fill.
        sums: (runs, POWERS) of the weighted powers of r^2, to fill.
        lenses: (columns, columns) and right side (columns, 3), to add to.
    """
    _, lens, radius2, values = seen
    of_cell, runs_of_cell, of_run = begins
    whole, mean = cells
    normal, right = lenses
    for cell in range(len(whole)):
        w, blue, green, red = 0.0, 0.0, 0.0, 0.0
        for k in range(of_cell[cell], of_cell[cell + 1]):
            w += weight[k]
            blue += weight[k] * values[k, 0]
            green += weight[k] * values[k, 1]
            red += weight[k] * values[k, 2]
        blue, green, red = blue / w, green / w, red / w
        whole[cell], mean[cell, 0], mean[cell, 1], mean[cell, 2] = w, blue, green, red
        first, stop = runs_of_cell[cell], runs_of_cell[cell + 1]
        for run in range(first, stop):
            at = POWERS * lens[of_run[run]]
            sums[run, 0], sums[run, 1], sums[run, 2] = 0.0, 0.0, 0.0
            for k in range(of_run[run], of_run[run + 1]):
                rest = values[k, 0] - blue, values[k, 1] - green, values[k, 2] - red
                _add_sample(weight[k], radius2[k], rest, sums[run], normal[at:, at:], right[at:])
        for one in range(first, stop):
            for other in range(first, stop):
                rows, columns = POWERS * lens[of_run[one]], POWERS * lens[of_run[other]]
                for i in range(POWERS):
                    for j in range(POWERS):
                        normal[rows + i, columns + j] -= sums[one, i] * sums[other, j] / w


@part
def _add_sample(
    power: float,
    radius2: float,
    rest: tuple[float, float, float],
    sums: Any,  # noqa: ANN401
    normal: Any,  # noqa: ANN401
    right: Any,  # noqa: ANN401
) -> None:
    """Add a sample's powers of r^2, `power` being its weight, and their products."""
    for i in range(POWERS):
        power *= radius2
        sums[i] += power
        both = power
        for j in range(POWERS):
            both *= radius2
            normal[i, j] += both
        for channel in range(CHANNELS):
            right[i, channel] += power * rest[channel]


@compiled
def view_rows(
    seen: tuple[Any, Any, Any, Any],
    places: tuple[Any, Any, Any],
    begins: tuple[Any, Any, Any],
    weighted: tuple[Any, Any, Any, Any],
    pattern: tuple[Any, Any],
    rows: tuple[Any, Any, Any],
    views: tuple[int, int],
) -> None:
    """Fill some views' rows of the normal equations with each cell's own colour eliminated.

    With a row a of the design for each of a cell's samples, their weights w of sum W, and s the
    sum of w a, the cell adds the sum of w a a' less s s' / W. The design has a column for each
    view, and then one for each power of r^2 of each lens. Of the views' columns those from each
    view itself on are filled.

    Args:
        seen: see `cell_sums`.
        places: (n,) cells of the samples; (n,) samples in order of their views; (views + 1,) first
            place of each view in that.
        begins: see `cell_sums`.
        weighted: (n,) weights, and what `cell_sums` fills of cells and runs.
        pattern: compressed rows of the views from each on that share a cell with it, itself among
            them: (views + 1,) and (m,).
        rows: to fill: (m,) views' columns; (views, columns) falloffs' columns and (views, 3) right
            side, which hold zeros.
        views: the first, and one past the last.
    """
    view, lens, radius2, values = seen
    cell_of, order, begins_of_view = places
    of_cell, runs_of_cell, of_run = begins
    weight, whole, mean, sums = weighted
    starts, others = pattern
    between, falloff, right = rows
    row = np.zeros(len(right))
    for number in range(views[0], views[1]):
        blue, green, red = 0.0, 0.0, 0.0
        for place in range(begins_of_view[number], begins_of_view[number + 1]):
            k = order[place]
            cell, w = cell_of[k], weight[k]
            row[number] += w
            blue += w * (values[k, 0] - mean[cell, 0])
            green += w * (values[k, 1] - mean[cell, 1])
            red += w * (values[k, 2] - mean[cell, 2])
            share = w / whole[cell]
            for run in range(runs_of_cell[cell], runs_of_cell[cell + 1]):
                at = POWERS * lens[of_run[run]]
                for i in range(POWERS):
                    falloff[number, at + i] -= share * sums[run, i]
            at = POWERS * lens[k]
            for i in range(POWERS):
                w *= radius2[k]
                falloff[number, at + i] += w
            for other in range(k, of_cell[cell + 1]):
                row[view[other]] -= share * weight[other]
        right[number, 0], right[number, 1], right[number, 2] = blue, green, red
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
        seen: see `cell_sums`.
        begins: (cells + 1,) first sample of each cell, and the number of samples.
        weight: (n,) of the samples.
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


@compiled
def differences(
    seen: tuple[Any, Any, Any, Any],
    begins: tuple[int, Any],
    point: Any,  # noqa: ANN401 - arrays, typed when compiled
    factor: Any,  # noqa: ANN401
    falloff: Any,  # noqa: ANN401
    found: Any,  # noqa: ANN401
) -> None:
    """Fill how far each cell's views are off those before them, as evenly exposed values.

    Args:
        seen: see `cell_sums`.
        begins: number of the first of these cells; (cells + 1,) first sample of each of them, and
            one past the last.
        point: (n, 3) values at the cells' centres.
        factor: (views, 3) of each view, that takes its gain out.
        falloff: (lenses, POWERS).
        found: (n - all cells, 3) to fill: a cell's first view has none before it.
    """
    view, lens, radius2, _ = seen
    first, of_cell = begins
    for cell in range(len(of_cell) - 1):
        blue, green, red = 0.0, 0.0, 0.0
        for k in range(of_cell[cell], of_cell[cell + 1]):
            a, b, r2 = view[k], lens[k], radius2[k]
            dark = np.exp(-r2 * (falloff[b, 0] + r2 * (falloff[b, 1] + r2 * falloff[b, 2])))
            to_blue, to_green, to_red = point[k, 0], point[k, 1], point[k, 2]
            to_blue *= dark * factor[a, 0]
            to_green *= dark * factor[a, 1]
            to_red *= dark * factor[a, 2]
            if k > of_cell[cell]:
                at = np.int64(k) - first - cell - 1
                found[at, 0] = abs(to_blue - blue)
                found[at, 1] = abs(to_green - green)
                found[at, 2] = abs(to_red - red)
            blue, green, red = to_blue, to_green, to_red
