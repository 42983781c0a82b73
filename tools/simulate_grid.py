"""City-sized pose graphs of one robot: a walk along the streets of a grid, with many loops.

The shape of the well-known Manhattan graphs at any size. Everything is drawn in bulk, so 100,000
poses take a second.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from groundfuse.backend import planar
from groundfuse.backend.problem import Array, Indices, Problem

BLOCK_STEPS = 5  # steps between two crossings, where the walk may turn
MIN_GAP = 10  # edges over fewer frames are no loops


@dataclass(frozen=True, slots=True, kw_only=True)
class GridShape:
    """What is simulated.

    Attributes:
        poses: how many.
        edges: steps and loops together.
        side_m: side of the city; 0 lets every street be driven some four times.
        step_m: distance between poses.
        reach_m: loops join poses within this distance.
        sigma_m: noise of every edge, along x and y.
        sigma_rad: noise of every edge's heading.
    """

    poses: int = 10_000
    edges: int = 20_000
    side_m: float = 0.0
    step_m: float = 1.0
    reach_m: float = 1.5
    sigma_m: float = 0.05
    sigma_rad: float = 0.01


def simulate_grid(shape: GridShape, rng: np.random.Generator) -> tuple[Problem, Array]:
    """Return the measured graph and its true poses (n, 3).

    Raises:
        ValueError: fewer edges than steps, or more loops than there are near poses.
    """
    num_loops = shape.edges - shape.poses + 1
    if num_loops < 0:
        raise ValueError(f"{shape.poses} poses need {shape.poses - 1} steps, got {shape.edges}")
    truth = _walk(shape, rng)
    near = KDTree(truth[:, :2]).query_pairs(shape.reach_m * shape.step_m, output_type="ndarray")
    near = np.sort(near.astype(np.int64), axis=1)
    near = near[near[:, 1] - near[:, 0] > MIN_GAP]
    if len(near) < num_loops:
        raise ValueError(f"{num_loops} loops asked for, only {len(near)} pairs of poses are near")
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    loops = near[np.sort(rng.permutation(len(near))[:num_loops])]
    number = np.arange(shape.poses - 1)
    a = np.concatenate([number, loops[:, 0]])
    b = np.concatenate([number + 1, loops[:, 1]])
    return _measured(shape, truth, a, b, rng), truth


def _walk(shape: GridShape, rng: np.random.Generator) -> Array:
    """Return (n, 3) a walk that turns, or not, at crossings and never leaves the city."""
    side_m = shape.side_m or np.sqrt(shape.poses * BLOCK_STEPS / 8.0) * shape.step_m
    blocks = max(2, round(side_m / (BLOCK_STEPS * shape.step_m)))
    moves = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    count = -(-shape.poses // BLOCK_STEPS)
    turns = rng.choice([0, 1, 3], size=count, p=[0.5, 0.25, 0.25]).tolist()
    sides = rng.choice([1, 3], size=count).tolist()
    x = y = blocks // 2
    heading, crossings = 0, []
    for turn, side in zip(turns, sides, strict=True):
        heading = (heading + turn) % 4
        while not (0 <= x + moves[heading][0] <= blocks and 0 <= y + moves[heading][1] <= blocks):
            heading = (heading + side) % 4
        crossings.append((x, y, heading))
        x, y = x + int(moves[heading][0]), y + int(moves[heading][1])
    corner = np.repeat(np.array(crossings), BLOCK_STEPS, axis=0)[: shape.poses]
    along = np.tile(np.arange(BLOCK_STEPS), count)[: shape.poses, None]
    place = (corner[:, :2] * BLOCK_STEPS + along * moves[corner[:, 2]]) * shape.step_m
    theta_rad = planar.wrapped(corner[:, 2] * np.pi / 2.0)
    truth: Array = np.column_stack([place, theta_rad]).astype(np.float64)
    return planar.between(truth[:1], truth)


def _measured(
    shape: GridShape, truth: Array, a: Indices, b: Indices, rng: np.random.Generator
) -> Problem:
    sigma = np.array([shape.sigma_m, shape.sigma_m, shape.sigma_rad])
    exact = planar.between(truth[a], truth[b])
    measured = planar.compose(exact, planar.exp(rng.normal(size=(len(a), 3)) * sigma))
    information = np.tile(np.diag(sigma**-2), (len(a), 1, 1))
    return Problem(len(truth), a, b, measured, information)
