"""Inner loops of the bundle, compiled: sums over sightings, and what fills a dense front.

Each sums in the order of the sightings, so that a result does not depend on the machine's threads.
The machine code is kept beside this file (or in the user's cache): only a first run compiles.
"""

from typing import Any

import numpy as np
from numba import njit

from groundfuse.backend.bundle_plan import BLOCK


def _frame_blocks(own: Any, out: Any, frame_start: Any, blocks: Any) -> None:  # noqa: ANN401
    """Add J'J less what the floor points take to each frame's block, in place.

    Args:
        own: (6, n, 2) whitened derivatives J.
        out: (6, n, d) Q'J.
        frame_start: (frames + 1,) first sighting of each frame.
        blocks: (m, 6, 6), the frames' first.
    """
    for frame in range(len(frame_start) - 1):
        first, stop = frame_start[frame], frame_start[frame + 1]
        for i in range(BLOCK):
            for j in range(i + 1):
                total = 0.0
                for s in range(first, stop):
                    for k in range(own.shape[2]):
                        total += own[i, s, k] * own[j, s, k]
                    for k in range(out.shape[2]):
                        total -= out[i, s, k] * out[j, s, k]
                blocks[frame, i, j] += total
                if i != j:
                    blocks[frame, j, i] += total


def _pair_blocks(out: Any, pairs: tuple[Any, Any], start: Any, place: Any, blocks: Any) -> None:  # noqa: ANN401
    """Write what frames have in common through the floor points they share.

    Args:
        out: (n, 6, d) Q'J of every sighting.
        pairs: sightings (k,) of the one and of the other frame.
        start: (pairs of frames + 1,) first of each pair of frames.
        place: (pairs of frames,) their blocks.
        blocks: (m, 6, 6).
    """
    one, other = pairs
    for index in range(len(place)):
        total = np.zeros((BLOCK, BLOCK))
        for s in range(start[index], start[index + 1]):
            a, b = out[one[s]], out[other[s]]
            for i in range(BLOCK):
                for k in range(out.shape[2]):
                    for j in range(BLOCK):
                        total[i, j] -= a[i, k] * b[j, k]
        blocks[place[index]] = total


def _right_sums(
    rows: tuple[Any, Any],
    error: Any,  # noqa: ANN401
    point: Any,  # noqa: ANN401
    by_points: Any,  # noqa: ANN401
    frame_start: Any,  # noqa: ANN401
    right: Any,  # noqa: ANN401
) -> None:
    """Add J'e less what the floor points take to each frame's right-hand side, in place.

    Args:
        rows: (6, n, 2) J and (6, n, d) Q'J.
        error: (n, 2) whitened.
        point: (n,) floor point of each sighting.
        by_points: (points, d) Q'e of each floor point.
        frame_start: as above.
        right: (frames or more, 6).
    """
    own, out = rows
    for frame in range(len(frame_start) - 1):
        for i in range(BLOCK):
            total = 0.0
            for s in range(frame_start[frame], frame_start[frame + 1]):
                for k in range(own.shape[2]):
                    total += own[i, s, k] * error[s, k]
                for k in range(out.shape[2]):
                    total -= out[i, s, k] * by_points[point[s], k]
            right[frame, i] += total


def _taken_steps(out: Any, step: Any, frame_start: Any, point: Any, rest: Any) -> None:  # noqa: ANN401
    """Take from each floor point (points, d) what a step (frames, 6) changes there, in place."""
    for frame in range(len(frame_start) - 1):
        for s in range(frame_start[frame], frame_start[frame + 1]):
            for k in range(out.shape[2]):
                for i in range(BLOCK):
                    rest[point[s], k] -= step[frame, i] * out[i, s, k]


def _assemble(
    blocks: Any,  # noqa: ANN401
    entry: Any,  # noqa: ANN401
    place: tuple[Any, Any],
    flip: Any,  # noqa: ANN401
    dense: Any,  # noqa: ANN401
) -> None:
    """Add some of the blocks (n, 6, 6) to a dense front, in place.

    Args:
        blocks: of the matrix.
        entry: (k,) which.
        place: block rows and block columns (k,) in the front.
        flip: (k,) whether a block is stored the other way round.
        dense: (6 f, 6 f).
    """
    row, column = place
    for e in range(len(entry)):
        block = blocks[entry[e]]
        for i in range(BLOCK):
            for j in range(BLOCK):
                value = block[j, i] if flip[e] else block[i, j]
                dense[BLOCK * row[e] + i, BLOCK * column[e] + j] += value


def _add_update(dense: Any, update: Any, place: Any) -> None:  # noqa: ANN401
    """Add the lower triangle of a child's update (k, k) to its parent's front, at `place` (k,)."""
    for i in range(len(place)):
        for j in range(i + 1):
            dense[place[i], place[j]] += update[i, j]


_compiled: Any = njit(cache=True, nogil=True)
frame_blocks: Any = _compiled(_frame_blocks)
pair_blocks: Any = _compiled(_pair_blocks)
right_sums: Any = _compiled(_right_sums)
taken_steps: Any = _compiled(_taken_steps)
assemble: Any = _compiled(_assemble)
add_update: Any = _compiled(_add_update)
