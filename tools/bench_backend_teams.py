"""Teams with wrong overlaps: what is accepted, where the anchors end, what is told as ambiguous."""

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from groundfuse.backend import g2o, initial, planar, solver
from groundfuse.backend.covariance import marginals
from groundfuse.backend.measurement import FrameId, RelativePose, TeamEstimate
from groundfuse.backend.problem import chi2, from_edges
from groundfuse.backend.relative_covariance import relative_covariances
from groundfuse.backend.team import fuse
from groundfuse.tools.bench_backend_graphs import GRID
from groundfuse.tools.simulate_graphs import TeamGraphs, TeamShape, simulate
from groundfuse.tools.simulate_grid import simulate_grid

THREE_SIGMA = 14.156  # chi2 of 3 degrees of freedom with the probability of 3 sigma, 99.73 %
CSAIL_CLEAN = 40.3188  # published
CSAIL_SECOND = 523  # first pose of the second robot
CSAIL_FOLDER = "csail_2robots/pose_graph_datasets/CSAIL_dataset"
PAIRS = 1000


def false_accepts(world: TeamGraphs, found: TeamEstimate) -> int:
    """Count wrong edges in the solution."""
    return sum(v.accepted and w for v, w in zip(found.verdicts, world.wrong, strict=True))


def anchors_fit(world: TeamGraphs, found: TeamEstimate) -> bool:
    """Return whether all robots lie in one frame, every anchor within 3 sigma of the truth."""
    if len(found.anchors) != len({f.robot for f in world.frames}):
        return False
    reference = world.truth[found.anchors[0].first]
    for anchor in found.anchors[1:]:
        if anchor.component != found.anchors[0].component or anchor.covariance is None:
            return False
        truth = planar.between(reference, world.truth[anchor.first])
        error = planar.log(planar.between(truth, anchor.team_from_map.vector()))
        if planar.mahalanobis2(error, anchor.covariance) > THREE_SIGMA:
            return False
    return True


def outcome(world: TeamGraphs, found: TeamEstimate) -> str:
    """Return right, ambiguous, incomplete (nothing wrong, not all joined) or wrong."""
    if false_accepts(world, found):
        return "wrong"
    if found.ambiguities:
        return "ambiguous"
    return "right" if anchors_fit(world, found) else "incomplete"


def _counted(shape: TeamShape, seeds: int) -> tuple[Counter[str], float]:
    """Return the outcomes of the seeds, and the seconds per team."""
    outcomes = Counter[str]()
    spent_s = 0.0
    for seed in range(seeds):
        world = simulate(shape, np.random.default_rng(seed))
        begin = time.perf_counter()
        found = fuse(world.frames, world.edges)
        spent_s += time.perf_counter() - begin
        outcomes[outcome(world, found)] += 1
    return outcomes, spent_s / seeds


HEAD = (
    "| robots | overlaps per pair | wrong | right | ambiguous | incomplete | wrong | s per team |"
)


def _rows(shapes: list[TeamShape], seeds: int) -> Iterator[str]:
    yield HEAD
    yield "| --- " * 8 + "|"
    for shape in shapes:
        outcomes, spent_s = _counted(shape, seeds)
        kinds = ("right", "ambiguous", "incomplete", "wrong")
        cells = " | ".join(f"{outcomes[kind]} / {seeds}" for kind in kinds)
        wrong = f"{shape.wrong_overlaps:.0%}"
        yield f"| {shape.robots} | {shape.overlaps} | {wrong} | {cells} | {spent_s:.2f} |"


def random_overlaps(seeds: int) -> Iterator[str]:
    """Yield lines: two robots, any wrong overlaps, a growing share of them."""
    shares = [k / 10 for k in range(1, 10)]
    return _rows([TeamShape(overlaps=40, wrong_overlaps=share) for share in shares], seeds)


def consistent_overlaps(seeds: int) -> Iterator[str]:
    """Yield lines: in every pair of robots the wrong overlaps agree and outnumber the right."""
    shapes = [
        TeamShape(robots=n, frames=50, overlaps=15, wrong_overlaps=share, consistent=True)
        for n in (3, 4, 6)
        for share in (0.6, 0.7, 0.8)
    ]
    return _rows(shapes, seeds)


def two_robots(seeds: int) -> Iterator[str]:
    """Yield lines: two robots only, wrong overlaps that agree; half the support is a share of 2/3.

    The last row is beyond what two robots can know.
    """
    shapes = [
        TeamShape(overlaps=24, wrong_overlaps=share, consistent=True)
        for share in (1 / 4, 1 / 2, 7 / 12, 2 / 3, 5 / 6)
    ]
    return _rows(shapes, seeds)


def read_csail(folder: Path) -> tuple[list[FrameId], list[RelativePose], list[bool]]:
    """Read the graph that was split into two robots; with which edges are wrong."""
    here = folder / CSAIL_FOLDER
    names = ("CSAIL_robot1.g2o", "CSAIL_robot2.g2o", "CSAIL_interrobot_loop_closures_outliers.g2o")
    edges = [e for name in names for e in g2o.parsed((here / name).read_text()).edges]
    clean = set(g2o.parsed((here / "CSAIL.g2o").read_text()).edges)
    frames = [FrameId("A" if k < CSAIL_SECOND else "B", k) for k in range(1045)]
    poses = [g2o.relative_pose(e, dict(enumerate(frames))) for e in edges]
    return frames, poses, [e not in clean for e in edges]


def csail(folder: Path) -> Iterator[str]:
    """Yield lines: CSAIL as two robots with 250 wrong overlaps."""
    frames, edges, wrong = read_csail(folder)
    begin = time.perf_counter()
    found = fuse(frames, edges)
    spent_s = time.perf_counter() - begin
    right = [e for e, w in zip(edges, wrong, strict=True) if not w]
    problem = from_edges({f: k for k, f in enumerate(frames)}, right)
    optimum = solver.optimum(problem).chi2
    ours = chi2(problem, planar.stacked([found.team_from_base[f] for f in frames]))
    refused = [not v.accepted for v in found.verdicts]
    caught = sum(r and w for r, w in zip(refused, wrong, strict=True))
    yield f"- {len(frames)} poses, {len(edges)} edges, {sum(wrong)} wrong; {spent_s:.2f} s"
    yield f"- clean optimum {optimum:.4f} (published {CSAIL_CLEAN}); our poses {ours:.4f}, "
    yield f"  {ours / optimum - 1.0:+.3%}; components {1 + max(found.component_of.values())}"
    yield f"- wrong edges: {caught} of {sum(refused)} refused are wrong (precision), "
    yield f"  {caught} of {sum(wrong)} wrong are refused (recall)"


def large_team() -> Iterator[str]:
    """Yield lines: 20 robots of 1000 poses, end to end."""
    yield "| encounters | wrong | false accepts | false refusals | fits | ambiguities | s |"
    yield "| --- " * 7 + "|"
    for encounters in (200, 2000):
        shape = TeamShape(
            robots=20, frames=1000, overlaps=0, loops=50, wrong_overlaps=0.2, encounters=encounters
        )
        world = simulate(shape, np.random.default_rng(0))
        begin = time.perf_counter()
        found = fuse(world.frames, world.edges)
        spent_s = time.perf_counter() - begin
        refused = [not v.accepted for v in found.verdicts]
        missed = sum(r and not w for r, w in zip(refused, world.wrong, strict=True))
        between = sum(e.a.robot != e.b.robot for e in world.edges)
        counts = f"{between} | {sum(world.wrong)} | {false_accepts(world, found)} | {missed}"
        fits = "yes" if anchors_fit(world, found) else "no"
        yield f"| {counts} | {fits} | {len(found.ambiguities)} | {spent_s:.2f} |"


def covariances() -> Iterator[str]:
    """Yield lines: every pose's covariance, and relative ones, on the grid of 10,000 poses."""
    problem, _ = simulate_grid(GRID, np.random.default_rng(0))
    poses = solver.optimum(problem).poses
    layout = initial.layout_of(problem)
    begin = time.perf_counter()
    every = marginals(problem, poses, layout)
    alone_s = time.perf_counter() - begin
    rng = np.random.default_rng(1)
    drawn = rng.permuted(np.tile(np.arange(problem.num_poses), (PAIRS, 1)), axis=1)[:, :2]
    pairs = [(int(a), int(b)) for a, b in drawn]
    begin = time.perf_counter()
    relative_covariances(problem, poses, pairs)
    pairs_s = time.perf_counter() - begin
    yield f"- {len(every)} covariances of poses: {alone_s:.2f} s"
    yield f"- {PAIRS} relative covariances of any two: {pairs_s:.2f} s"
