"""Normal equations of the bundle with the floor points eliminated.

Nodes are frames (x, y, theta, tilt, roll, height) and, after them, robots (mount offsets of tilt,
roll, height; focal length; distortion; a spare): 6 unknowns each. Residuals are whitened; with
Q the orthonormal basis of what a floor point explains in its sightings, eliminating it takes
Q'J out of J'J (Golub and Pereyra's variable projection, to first order the Schur complement).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_compiled import frame_blocks, pair_blocks, right_sums, taken_steps
from groundfuse.backend.bundle_plan import BLOCK
from groundfuse.backend.bundle_priors import Pattern, Priors
from groundfuse.backend.bundle_rows import Rows
from groundfuse.backend.bundle_rows_compiled import Lines, add_explained, point_roots, project
from groundfuse.backend.bundle_tracks import Observations
from groundfuse.backend.side_by_side import side_by_side

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """The system without floor points, and what brings them back.

    Attributes:
        rows: whitened derivatives.
        basis: (n, d, 2) Q' of every sighting: orthonormal over the sightings of a point.
        by_frame: (n, d, 6) Q'J of every sighting, by row of Q'.
        by_lens: (points, d, robots, 2) Q'K of every floor point; None where lenses are as filed.
        root: (d, d, points) lower Cholesky factor of every point's information.
        blocks: (n, 6, 6) of the reduced system by the pattern.
    """

    rows: Rows
    basis: Array
    by_frame: Array
    by_lens: Array | None
    root: Array
    blocks: Array


def reduce_rows(seen: Observations, rows: Rows, pattern: Pattern, priors: Priors) -> Reduced:
    """Accumulate the sightings and eliminate their floor points."""
    lines, (count, _, size) = rows.lines, rows.lines.by_point.shape
    root = np.zeros((size, size, seen.num_points))
    tiny = float(np.finfo(np.float64).tiny)
    point_roots(seen.point, lines.by_point, rows.relief[1], tiny, root)
    basis, by_frame = np.empty((count, size, 2)), np.empty((count, size, BLOCK))
    lens_rows = np.empty((len(lines.by_lens), size, 2))

    def projected(part: slice) -> None:
        mine = Lines(*(of[part] for of in lines))
        taken = Lines(by_frame[part], lines.by_point[:0], lens_rows[part])
        project(seen.point[part], mine, root, basis[part], taken)

    side_by_side(projected, count)
    blocks = np.zeros((len(pattern.rows), BLOCK, BLOCK))
    if size == 3:
        by_frame[seen.first, 2, 5] += rows.relief[1] * rows.relief[2] / root[2, 2]
        np.add.at(blocks[:, 5, 5], seen.frame[seen.first], rows.relief[2] ** 2)
    pairs = seen.pair_i, seen.pair_j

    def within(part: slice) -> None:
        start = seen.frame_start[part.start : part.stop + 1]
        frame_blocks(lines.by_frame, by_frame, start, blocks[part])

    def between(part: slice) -> None:
        start = seen.pair_start[part.start : part.stop + 1]
        pair_blocks(by_frame, pairs, start, pattern.pair_at[part], blocks)

    side_by_side(within, priors.num_frames)
    side_by_side(between, len(pattern.pair_at))
    by_lens = _lens_by_points(seen, lens_rows, priors) if lens_rows.size else None
    reduced = Reduced(rows, basis, by_frame, by_lens, root, blocks)
    if by_lens is not None:
        _add_lens(seen, reduced, by_lens, priors, pattern)
    return reduced


def frame_parts(seen: Observations) -> list[slice]:
    """Sightings of each frame."""
    bounds = seen.frame_start.tolist()
    return list(map(slice, bounds[:-1], bounds[1:]))


def right_side(
    seen: Observations, reduced: Reduced, error: Array, relief: Array, priors: Priors
) -> tuple[Array, Array]:
    """Right-hand side (frames + robots, 6), and Q'e of every floor point (points, d).

    `error` (n, 2) is whitened; where weights have changed since the rows were, by the old root.
    `relief` are the rows of the relief's prior at the same state.
    """
    size, lines = reduced.basis.shape[1], reduced.rows.lines
    explained = np.zeros((seen.num_points, size))
    add_explained(reduced.basis, error, seen.point, explained)
    right = np.zeros((priors.num_nodes, BLOCK))
    if size == 3:
        explained[:, 2] += relief[1] * relief[0] / reduced.root[2, 2]
        np.add.at(right[:, 5], seen.frame[seen.first], relief[2] * relief[0])
    rows = lines.by_frame, reduced.by_frame

    def summed(part: slice) -> None:
        start = seen.frame_start[part.start : part.stop + 1]
        right_sums(rows, error, seen.point, explained, start, right[part])

    side_by_side(summed, priors.num_frames)
    if reduced.by_lens is not None:
        lens = right[priors.num_frames :, 3:5]
        for frame, part in enumerate(frame_parts(seen)):
            k = lines.by_lens[part].reshape(-1, 2)
            lens[priors.robot_of[frame]] += k.T @ error[part].ravel()
        across = reduced.by_lens.reshape(-1, 2 * priors.num_robots)
        lens -= (across.T @ explained.ravel()).reshape(-1, 2)
    return right, explained


def _lens_by_points(seen: Observations, lens_rows: Array, priors: Priors) -> Array:
    """Q'K of every floor point, (points, d, robots, 2): by row, robot, unknown."""
    count, size, _ = lens_rows.shape
    place = seen.point * priors.num_robots + priors.robot_of[seen.frame]
    total = seen.num_points * priors.num_robots
    sums = [np.bincount(place, column, total) for column in lens_rows.reshape(count, -1).T]
    split = np.stack(sums, axis=1).reshape(seen.num_points, priors.num_robots, size, 2)
    return np.ascontiguousarray(split.transpose(0, 2, 1, 3), dtype=np.float64)


def _add_lens(
    seen: Observations, reduced: Reduced, by_lens: Array, priors: Priors, pattern: Pattern
) -> None:
    """Add the robots' focal lengths and distortions to the blocks, in place."""
    num_frames, num_robots = priors.num_frames, priors.num_robots
    across = by_lens.reshape(-1, 2 * num_robots)
    total = -(across.T @ across).reshape(num_robots, 2, num_robots, 2)
    border = reduced.blocks[pattern.border_at : pattern.shared_at].reshape(
        num_frames, num_robots, BLOCK, BLOCK
    )
    for frame, part in enumerate(frame_parts(seen)):
        robot = int(priors.robot_of[frame])
        own = reduced.rows.lines.by_frame[part].reshape(-1, BLOCK)
        k = reduced.rows.lines.by_lens[part].reshape(-1, 2)
        out = reduced.by_frame[part].reshape(-1, BLOCK)
        taken = out.T @ by_lens[seen.point[part]].reshape(-1, 2 * num_robots)
        border[frame, :, :, 3:5] -= taken.reshape(BLOCK, num_robots, 2).transpose(1, 0, 2)
        border[frame, robot, :, 3:5] += own.T @ k
        total[robot, :, robot, :] += k.T @ k
    robots = np.arange(num_robots)
    reduced.blocks[num_frames + robots, 3:5, 3:5] += total[robots, :, robots, :]
    first, second = np.triu_indices(num_robots, 1)
    at = pattern.shared_at + np.arange(len(first))
    reduced.blocks[at, 3:5, 3:5] += total[first, :, second, :]


def point_steps(
    seen: Observations, reduced: Reduced, explained: Array, step: Array, priors: Priors
) -> Array:
    """Steps (points, d) of the floor points that go with a step (frames + robots, 6)."""
    rest = explained.copy()
    taken_steps(reduced.by_frame, step, seen.frame_start, seen.point, rest)
    if reduced.by_lens is not None:
        flat = reduced.by_lens.reshape(*rest.shape, -1)
        rest = rest - flat @ step[priors.num_frames :, 3:5].ravel()
    for row in reversed(range(rest.shape[1])):
        for after in range(row + 1, rest.shape[1]):
            rest[:, row] -= reduced.root[after, row] * rest[:, after]
        rest[:, row] /= reduced.root[row, row]
    return rest
