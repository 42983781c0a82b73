"""Team graphs with known truth: trajectories, loops, overlaps, and a chosen share of wrong ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from groundfuse.backend import planar
from groundfuse.backend.graph_keys import robot_name
from groundfuse.backend.measurement import Array, FrameId, RelativePose

Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

MAX_DRAWS = 200
WHOLE_DRAWS = 20  # of all paths at once, before each is drawn anew until it meets those before it


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamShape:
    """What is simulated.

    Attributes:
        robots: how many.
        frames: frames per robot.
        world: "free" (smooth curves) or "manhattan" (a grid of streets).
        step_m: distance between frames.
        area_m: side of the square that the robots stay in; 0 chooses one that is well covered.
        loops: edges within each robot between frames far apart in time.
        overlaps: edges between each two robots.
        encounters: further edges between robots, drawn over the whole team.
        reach_m: frames further apart than this have no edge; 0 means two steps.
        wrong_loops: share of the loops that are wrong.
        wrong_overlaps: share of the overlaps and encounters that are wrong.
        consistent: wrong edges of a pair agree with each other, as on a floor that repeats.
        sigma_m: noise of every edge, along x and y.
        sigma_rad: noise of every edge's heading.
    """

    robots: int = 2
    frames: int = 100
    world: str = "free"
    step_m: float = 1.0
    area_m: float = 0.0
    loops: int = 20
    overlaps: int = 20
    encounters: int = 0
    reach_m: float = 0.0
    wrong_loops: float = 0.0
    wrong_overlaps: float = 0.0
    consistent: bool = False
    sigma_m: float = 0.02
    sigma_rad: float = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class TeamGraphs:
    """A simulated team.

    Attributes:
        frames: of all robots, in order.
        edges: steps, then loops, of robot after robot, then overlaps of pair after pair.
        truth: true poses.
        wrong: per edge, whether it is wrong.
    """

    frames: tuple[FrameId, ...]
    edges: tuple[RelativePose, ...]
    truth: dict[FrameId, Array]
    wrong: tuple[bool, ...]


Pairs = tuple[int, int, Indices, Indices, Flags]  # robots, their frames, which pairs are wrong


def simulate(shape: TeamShape, rng: np.random.Generator) -> TeamGraphs:
    """Simulate a team.

    Raises:
        ValueError: an unknown world, no robot or no frame, a share outside 0 to 1, or robots that
            do not meet often enough.
    """
    _check(shape)
    area_m = shape.area_m or shape.step_m * float(np.sqrt(shape.robots * shape.frames))
    reach_m = shape.reach_m or 2.0 * shape.step_m
    paths = _meeting_paths(shape, area_m, reach_m, rng)
    pairs: list[Pairs] = []
    for r, path in enumerate(paths):
        number = np.arange(shape.frames - 1)
        pairs.append((r, r, number, number + 1, np.zeros(len(number), dtype=bool)))
        near = KDTree(path[:, :2]).query_pairs(reach_m, output_type="ndarray").astype(np.int64)
        near = near[near[:, 1] - near[:, 0] > 10]
        pairs.append((r, r, *_chosen(near, path, path, shape.loops, shape.wrong_loops, rng)))
    for r, s in combinations(range(shape.robots), 2):
        near = _near(paths[r], paths[s], reach_m)
        chosen = _chosen(near, paths[r], paths[s], shape.overlaps, shape.wrong_overlaps, rng)
        pairs.append((r, s, *chosen))
    pairs += _encounters(shape, paths, reach_m, rng)
    return _measured(shape, paths, pairs, area_m, rng)


def _check(shape: TeamShape) -> None:
    if shape.world not in {"free", "manhattan"}:
        raise ValueError(f"a world is free or manhattan, got {shape.world}")
    if shape.robots < 1 or shape.frames < 1:
        raise ValueError(f"needs robots and frames, got {shape.robots} and {shape.frames}")
    for share in (shape.wrong_loops, shape.wrong_overlaps):
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"a share lies in 0 to 1, got {share}")


def _meeting_paths(
    shape: TeamShape, area_m: float, reach_m: float, rng: np.random.Generator
) -> list[Array]:
    """Draw trajectories until every two robots have the right overlaps that are asked for."""
    walk = _manhattan if shape.world == "manhattan" else _free
    needed = shape.overlaps - round(shape.wrong_overlaps * shape.overlaps)

    def meets(path: Array, others: Sequence[Array]) -> bool:
        return all(len(_near(other, path, reach_m)) >= needed for other in others)

    paths: list[Array] = []
    for _ in range(WHOLE_DRAWS):
        paths = [walk(shape.frames, shape.step_m, area_m, rng) for _ in range(shape.robots)]
        if all(meets(path, paths[:r]) for r, path in enumerate(paths)):
            return paths
    for r in range(shape.robots):
        for _ in range(MAX_DRAWS):
            if meets(paths[r], paths[:r]):
                break
            paths[r] = walk(shape.frames, shape.step_m, area_m, rng)
        else:
            raise ValueError(
                f"in {area_m:.3g} m two robots never had {needed} pairs of frames "
                f"within {reach_m:.3g} m"
            )
    return paths


def _free(frames: int, step_m: float, area_m: float, rng: np.random.Generator) -> Array:
    """Return (n, 3) a smooth random walk that turns back at the border."""
    poses = np.empty((frames, 3))
    x, y = rng.uniform(0.2 * area_m, 0.8 * area_m, 2)
    theta, bend = rng.uniform(-np.pi, np.pi), 0.0
    for k in range(frames):
        poses[k] = x, y, theta
        bend = 0.8 * bend + rng.normal(0.0, 0.1)
        if not (0.0 <= x <= area_m and 0.0 <= y <= area_m):
            home = np.arctan2(area_m / 2 - y, area_m / 2 - x)
            bend = float(np.clip(np.remainder(home - theta + np.pi, 2 * np.pi) - np.pi, -0.5, 0.5))
        theta += bend
        x, y = x + step_m * np.cos(theta), y + step_m * np.sin(theta)
    poses[:, 2] = planar.wrapped(poses[:, 2])
    return poses


def _manhattan(frames: int, step_m: float, area_m: float, rng: np.random.Generator) -> Array:
    """Return (n, 3) a random walk along streets one step apart."""
    size = max(1, int(area_m / step_m))
    moves = ((1, 0), (0, 1), (-1, 0), (0, -1))
    x, y = (int(v) for v in rng.integers(0, size + 1, 2))
    heading = int(rng.integers(4))
    poses = np.empty((frames, 3))
    for k in range(frames):
        poses[k] = x * step_m, y * step_m, heading * np.pi / 2
        if rng.random() < 0.25:
            heading = (heading + int(rng.choice([1, 3]))) % 4
        while not (0 <= x + moves[heading][0] <= size and 0 <= y + moves[heading][1] <= size):
            heading = (heading + int(rng.choice([1, 3]))) % 4
        x, y = x + moves[heading][0], y + moves[heading][1]
    poses[:, 2] = planar.wrapped(poses[:, 2])
    return poses


def _near(one: Array, two: Array, reach_m: float) -> Indices:
    """Return (m, 2) pairs of frames within reach."""
    found = KDTree(one[:, :2]).query_ball_tree(KDTree(two[:, :2]), reach_m)
    pairs = [(i, j) for i, js in enumerate(found) for j in sorted(js)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _chosen(
    near: Indices, one: Array, two: Array, count: int, share: float, rng: np.random.Generator
) -> tuple[Indices, Indices, Flags]:
    """Draw true pairs among the near ones, and any frames for the wrong ones."""
    num_wrong = round(share * count)
    right = near[rng.permutation(len(near))[: count - num_wrong]]
    if len(one) < 2:
        num_wrong = 0 if one is two else num_wrong
    wrong = np.stack([rng.integers(0, len(p), num_wrong) for p in (one, two)], axis=1)
    if one is two:
        wrong.sort(axis=1)
        wrong[:, 1] += wrong[:, 0] == wrong[:, 1]
        wrong[wrong[:, 1] == len(one)] -= [2, 1]
    both = np.concatenate([right, wrong])
    flags = np.arange(len(both)) >= len(right)
    return both[:, 0], both[:, 1], flags


def _encounters(
    shape: TeamShape, paths: Sequence[Array], reach_m: float, rng: np.random.Generator
) -> list[Pairs]:
    """Draw meetings over the whole team, so that some robots meet often and others never."""
    robots = list(combinations(range(shape.robots), 2))
    if not shape.encounters or not robots:
        return []
    num_wrong = round(shape.wrong_overlaps * shape.encounters)
    near = [_near(paths[r], paths[s], reach_m) for r, s in robots]
    found = np.concatenate([
        np.column_stack([np.full(len(some), k), some]) for k, some in enumerate(near)
    ])  # fmt: skip
    right = found[rng.permutation(len(found))[: shape.encounters - num_wrong]]
    wrong = np.column_stack([
        rng.integers(0, len(robots), num_wrong),
        *rng.integers(0, shape.frames, (2, num_wrong)),
    ])  # fmt: skip
    drawn = np.concatenate([right, wrong])
    flags = np.arange(len(drawn)) >= len(right)
    return [
        (*robots[k], drawn[here, 1], drawn[here, 2], flags[here])
        for k in np.unique(drawn[:, 0]).tolist()
        for here in [np.flatnonzero(drawn[:, 0] == k)]
    ]


def _measured(
    shape: TeamShape,
    paths: Sequence[Array],
    pairs: Sequence[Pairs],
    area_m: float,
    rng: np.random.Generator,
) -> TeamGraphs:
    """Measure the chosen pairs with noise."""
    sigma = np.array([shape.sigma_m, shape.sigma_m, shape.sigma_rad])
    covariance = np.diag(sigma**2)
    edges: list[RelativePose] = []
    wrong: list[bool] = []
    for r, s, i, j, flags in pairs:
        exact = planar.between(paths[r][i], paths[s][j])
        lie = _lies(paths[r], paths[s], i, j, area_m, shape, rng)
        measured = planar.compose(
            np.where(flags[:, None], lie, exact), planar.exp(rng.normal(size=(len(i), 3)) * sigma)
        )
        for k in range(len(i)):
            a, b = FrameId(robot_name(r), int(i[k])), FrameId(robot_name(s), int(j[k]))
            edges.append(RelativePose(a, b, planar.pose(measured[k]), covariance))
            wrong.append(bool(flags[k]))
    truth = {
        FrameId(robot_name(r), k): pose
        for r, path in enumerate(paths)
        for k, pose in enumerate(path)
    }
    return TeamGraphs(tuple(sorted(truth)), tuple(edges), truth, tuple(wrong))


def _lies(
    one: Array,
    two: Array,
    i: Indices,
    j: Indices,
    area_m: float,
    shape: TeamShape,
    rng: np.random.Generator,
) -> Array:
    """Return (m, 3) wrong measurements: anything, or the second map displaced as a whole."""
    if shape.consistent:
        length, bearing = rng.uniform(0.1, 0.3) * area_m, rng.uniform(-np.pi, np.pi)
        turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, np.pi)
        shift = np.array([length * np.cos(bearing), length * np.sin(bearing), turn])
        return planar.between(one[i], planar.compose(np.broadcast_to(shift, (len(j), 3)), two[j]))
    reach = 2.0 * shape.step_m
    distance, bearings = rng.uniform(0.0, reach, len(i)), rng.uniform(-np.pi, np.pi, len(i))
    turned = rng.uniform(-np.pi, np.pi, len(i))
    return np.stack([distance * np.cos(bearings), distance * np.sin(bearings), turned], axis=1)
