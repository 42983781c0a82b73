"""Inner loops of the bundle, compiled: sums over sightings, and what fills a dense front.

Each sums in the order of the sightings, so that a result does not depend on the machine's threads.
"""

from typing import Any

import numpy as np

from groundfuse.backend.bundle_plan import BLOCK
from groundfuse.backend.compiled import compiled, part


@part
def _add_square(line: Any, sign: float, total: Any) -> None:  # noqa: ANN401
    """Add a line's (6,) outer product with itself, in place."""
    for i in range(BLOCK):
        factor = sign * line[i]
        for j in range(BLOCK):
            total[i, j] += factor * line[j]


@compiled
def frame_blocks(own: Any, out: Any, frame_start: Any, blocks: Any) -> None:  # noqa: ANN401
    """Add J'J less what the floor points take to each frame's block, in place.

    Args:
        own: (n, 2, 6) whitened derivatives J.
        out: (n, d, 6) Q'J.
        frame_start: (frames + 1,) first sighting of each frame.
        blocks: (m, 6, 6), the frames' first.
    """
    total = np.zeros((BLOCK, BLOCK))
    for frame in range(len(frame_start) - 1):
        total[:] = 0.0
        for s in range(frame_start[frame], frame_start[frame + 1]):
            for k in range(own.shape[1]):
                _add_square(own[s, k], 1.0, total)
            for k in range(out.shape[1]):
                _add_square(out[s, k], -1.0, total)
        for i in range(BLOCK):
            for j in range(BLOCK):
                blocks[frame, i, j] += total[i, j]


@compiled
def pair_blocks(out: Any, pairs: tuple[Any, Any], start: Any, place: Any, blocks: Any) -> None:  # noqa: ANN401
    """Write what frames have in common through the floor points they share.

    Args:
        out: (n, d, 6) Q'J of every sighting.
        pairs: sightings (k,) of the one and of the other frame.
        start: (pairs of frames + 1,) first of each pair of frames.
        place: (pairs of frames,) their blocks.
        blocks: (m, 6, 6).
    """
    one, other = pairs
    total = np.zeros((BLOCK, BLOCK))
    for index in range(len(place)):
        total[:] = 0.0
        for s in range(start[index], start[index + 1]):
            a, b = one[s], other[s]
            for k in range(out.shape[1]):
                for i in range(BLOCK):
                    factor = out[a, k, i]
                    for j in range(BLOCK):
                        total[i, j] -= factor * out[b, k, j]
        blocks[place[index]] = total


@compiled
def right_sums(
    rows: tuple[Any, Any],
    error: Any,  # noqa: ANN401
    point: Any,  # noqa: ANN401
    by_points: Any,  # noqa: ANN401
    frame_start: Any,  # noqa: ANN401
    right: Any,  # noqa: ANN401
) -> None:
    """Add J'e less what the floor points take to each frame's right-hand side, in place.

    Args:
        rows: (n, 2, 6) J and (n, d, 6) Q'J.
        error: (n, 2) whitened.
        point: (n,) floor point of each sighting.
        by_points: (points, d) Q'e of each floor point.
        frame_start: as above.
        right: (frames or more, 6).
    """
    own, out = rows
    total = np.zeros(BLOCK)
    for frame in range(len(frame_start) - 1):
        total[:] = 0.0
        for s in range(frame_start[frame], frame_start[frame + 1]):
            for k in range(own.shape[1]):
                for i in range(BLOCK):
                    total[i] += own[s, k, i] * error[s, k]
            for k in range(out.shape[1]):
                for i in range(BLOCK):
                    total[i] -= out[s, k, i] * by_points[point[s], k]
        for i in range(BLOCK):
            right[frame, i] += total[i]


@compiled
def taken_steps(out: Any, step: Any, frame_start: Any, point: Any, rest: Any) -> None:  # noqa: ANN401
    """Take from each floor point (points, d) what a step (frames, 6) changes there, in place."""
    for frame in range(len(frame_start) - 1):
        for s in range(frame_start[frame], frame_start[frame + 1]):
            for k in range(out.shape[1]):
                total = 0.0
                for i in range(BLOCK):
                    total += step[frame, i] * out[s, k, i]
                rest[point[s], k] -= total


@compiled
def assemble(
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


@compiled
def take_square(matrix: Any, place: Any, square: Any) -> None:  # noqa: ANN401
    """Write rows and columns `place` (k,) of a matrix, (k, k)."""
    for i in range(len(place)):
        row = matrix[place[i]]
        for j in range(len(place)):
            square[i, j] = row[place[j]]


@compiled
def add_update(dense: Any, update: Any, place: Any) -> None:  # noqa: ANN401
    """Add the lower triangle of a child's update (k, k) to its parent's front, at `place` (k,)."""
    for i in range(len(place)):
        for j in range(i + 1):
            dense[place[i], place[j]] += update[i, j]
