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


def _residuals(
    sightings: tuple[Any, Any, Any, Any],
    frames: tuple[Any, Any, Any, Any],
    points: Any,  # noqa: ANN401
    near: float,
    residual: Any,  # noqa: ANN401
    unseen: Any,  # noqa: ANN401
) -> None:
    """Compare rays with where their floor points appear; see `bundle_model`.

    Args:
        sightings: frame and point (n,), ray (n, 2) and the focal length's gain (n,).
        frames: poses (frames, 3), cosines and sines (frames, 6) of heading, tilt and roll, heights
            (frames,), lens corrections (frames, 2).
        points: (points, 3).
        near: least depth in heights.
        residual: (n, 2) measured minus predicted, written.
        unseen: (n,) whether a point is behind its camera, written.
    """
    frame_of, point_of, ray, gain = sightings
    poses, turns, heights, lenses = frames
    for s in range(len(frame_of)):
        f = frame_of[s]
        turn_c, turn_s, tilt_c, tilt_s, roll_c, roll_s = turns[f]
        p = point_of[s]
        dx, dy = points[p, 0] - poses[f, 0], points[p, 1] - poses[f, 1]
        height = heights[f] - points[p, 2]
        qx, qy = turn_c * dx + turn_s * dy, turn_c * dy - turn_s * dx
        leaning = roll_s * qy + roll_c * height
        depth = tilt_s * qx + tilt_c * leaning
        unseen[s] = not depth > near * height
        if unseen[s]:
            residual[s, 0] = residual[s, 1] = 0.0
            continue
        x, y = (roll_s * height - roll_c * qy) / depth, (tilt_s * leaning - tilt_c * qx) / depth
        factor = (1.0 + lenses[f, 0] * gain[s]) * (1.0 + lenses[f, 1] * (x * x + y * y))
        residual[s, 0], residual[s, 1] = ray[s, 0] - factor * x, ray[s, 1] - factor * y


def _meeting_chi2(
    ends: tuple[Any, Any],
    landing: tuple[Any, Any, Any],
    relief_m: Any,  # noqa: ANN401
    chi2: Any,  # noqa: ANN401
) -> None:
    """Squared distances on the floor over their variance; inf where a ray meets no floor.

    Args:
        ends: sightings (n,) of both ends of each correspondence.
        landing: points (m, 2), covariances (m, 2, 2), ways per height (m, 2) of the sightings.
        relief_m: (m,) deviation of the floor's heights where each sighting is; 0 if flat.
        chi2: (n,) written.
    """
    one, other = ends
    point, spread, slope = landing
    for n in range(len(one)):
        a, b = one[n], other[n]
        x, y = point[a, 0] - point[b, 0], point[a, 1] - point[b, 1]
        px = relief_m[a] * (slope[a, 0] - slope[b, 0])
        py = relief_m[a] * (slope[a, 1] - slope[b, 1])
        xx = spread[a, 0, 0] + spread[b, 0, 0] + px * px
        xy = spread[a, 0, 1] + spread[b, 0, 1] + px * py
        yy = spread[a, 1, 1] + spread[b, 1, 1] + py * py
        found = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        chi2[n] = found if np.isfinite(found) else np.inf


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


_compiled: Any = njit(cache=True, nogil=True, error_model="numpy")
frame_blocks: Any = _compiled(_frame_blocks)
pair_blocks: Any = _compiled(_pair_blocks)
right_sums: Any = _compiled(_right_sums)
taken_steps: Any = _compiled(_taken_steps)
residuals_of: Any = _compiled(_residuals)
meeting_chi2: Any = _compiled(_meeting_chi2)
assemble: Any = _compiled(_assemble)
add_update: Any = _compiled(_add_update)
