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
from groundfuse.backend.bundle_tracks import Integers, Observations
from groundfuse.backend.side_by_side import side_by_side

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """The system without floor points, and what brings them back.

    Attributes:
        rows: whitened derivatives.
        basis: (d, n, 2) Q' of every sighting: orthonormal over the sightings of a point.
        by_frame: (6, n, d) Q'J of every sighting, by row of Q'.
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


def _by_points(values: Array, point: Integers, num_points: int) -> Array:
    """Sum values (n, k) over the sightings of each point: (points, k)."""
    sums = [np.bincount(point, column, num_points) for column in values.T]
    return np.stack(sums, axis=1).astype(np.float64, copy=False)


def _projected(basis: Array, derivative: Array) -> Array:
    """Q'D of some sightings: (k, n, d) from derivatives (k, n, 2)."""
    result = np.empty((*derivative.shape[:2], len(basis)))
    for row in range(len(basis)):
        x, y = basis[row, :, 0], basis[row, :, 1]
        result[:, :, row] = x * derivative[:, :, 0] + y * derivative[:, :, 1]
    return result


def _root(by_point: Array, seen: Observations, relief: Array) -> Array:
    """Lower Cholesky factor (d, d, points) of each point's information.

    A direction that no sighting tells gets a tiny pivot instead of zero: no step goes there,
    because no derivative does.
    """
    size, tiny = len(by_point), np.finfo(np.float64).tiny
    root = np.zeros((size, size, seen.num_points))
    for i in range(size):
        for j in range(i + 1):
            product = by_point[i, :, 0] * by_point[j, :, 0] + by_point[i, :, 1] * by_point[j, :, 1]
            total = _by_points(product[:, None], seen.point, seen.num_points)[:, 0]
            total += relief[1] ** 2 if i == j == 2 else 0.0
            rest = total - np.sum(root[i, :j] * root[j, :j], axis=0)
            root[i, j] = (
                np.sqrt(np.maximum(rest, 1e-12 * total + tiny)) if i == j else rest / root[j, j]
            )
    return root


def _basis(by_point: Array, root: Array) -> Array:
    """Rows Q' (d, n, 2) of some sightings from the factors (d, d, n) of their points."""
    basis = np.empty_like(by_point)
    for row in range(len(by_point)):
        rest = by_point[row].copy()
        for before in range(row):
            rest -= root[row, before][:, None] * basis[before]
        basis[row] = rest / root[row, row][:, None]
    return basis


def reduce_rows(seen: Observations, rows: Rows, pattern: Pattern, priors: Priors) -> Reduced:
    """Accumulate the sightings and eliminate their floor points."""
    root = _root(rows.by_point, seen, rows.relief)
    basis, size = np.empty_like(rows.by_point), len(rows.by_point)
    by_frame = np.empty((*rows.by_frame.shape[:2], size))
    lens_rows = np.empty((*rows.by_lens.shape[:2], size))
    for part in seen.parts:
        basis[:, part] = _basis(rows.by_point[:, part], root[:, :, seen.point[part]])
        by_frame[:, part] = _projected(basis[:, part], rows.by_frame[:, part])
        if lens_rows.size:
            lens_rows[:, part] = _projected(basis[:, part], rows.by_lens[:, part])
    blocks = np.zeros((len(pattern.rows), BLOCK, BLOCK))
    if size == 3:
        by_frame[5, seen.first, 2] += rows.relief[1] * rows.relief[2] / root[2, 2]
        np.add.at(blocks[:, 5, 5], seen.frame[seen.first], rows.relief[2] ** 2)
    frame_blocks(rows.by_frame, by_frame, seen.frame_start, blocks)
    beside = np.ascontiguousarray(by_frame.transpose(1, 2, 0))
    pairs = seen.pair_i, seen.pair_j

    def between(part: slice) -> None:
        start = seen.pair_start[part.start : part.stop + 1]
        pair_blocks(beside, pairs, start, pattern.pair_at[part], blocks)

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
    explained = np.empty((len(error), len(reduced.basis)))
    for part in seen.parts:
        explained[part] = _projected(reduced.basis[:, part], error[None, part])[0]
    by_points = _by_points(explained, seen.point, seen.num_points)
    right = np.zeros((priors.num_nodes, BLOCK))
    if len(reduced.basis) == 3:
        by_points[:, 2] += relief[1] * relief[0] / reduced.root[2, 2]
        np.add.at(right[:, 5], seen.frame[seen.first], relief[2] * relief[0])
    rows = reduced.rows.by_frame, reduced.by_frame
    right_sums(rows, error, seen.point, by_points, seen.frame_start, right)
    if reduced.by_lens is not None:
        lens = right[priors.num_frames :, 3:5]
        for frame, part in enumerate(frame_parts(seen)):
            k = reduced.rows.by_lens[:, part].reshape(2, -1)
            lens[priors.robot_of[frame]] += k @ error[part].ravel()
        across = reduced.by_lens.reshape(-1, 2 * priors.num_robots)
        lens -= (across.T @ by_points.ravel()).reshape(-1, 2)
    return right, by_points


def _lens_by_points(seen: Observations, lens_rows: Array, priors: Priors) -> Array:
    """Q'K of every floor point, (points, d, robots, 2): by row, robot, unknown."""
    place = seen.point * priors.num_robots + priors.robot_of[seen.frame]
    flat = lens_rows.transpose(1, 2, 0).reshape(lens_rows.shape[1], -1)
    sums = _by_points(flat, place, seen.num_points * priors.num_robots)
    split = sums.reshape(seen.num_points, priors.num_robots, -1, 2)
    return np.ascontiguousarray(split.transpose(0, 2, 1, 3))


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
        own = reduced.rows.by_frame[:, part].reshape(BLOCK, -1)
        k = reduced.rows.by_lens[:, part].reshape(2, -1)
        out = reduced.by_frame[:, part].reshape(BLOCK, -1)
        taken = out @ by_lens[seen.point[part]].reshape(-1, 2 * num_robots)
        border[frame, :, :, 3:5] -= taken.reshape(BLOCK, num_robots, 2).transpose(1, 0, 2)
        border[frame, robot, :, 3:5] += own @ k.T
        total[robot, :, robot, :] += k @ k.T
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
