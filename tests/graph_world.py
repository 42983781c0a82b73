"""Small graphs with known truth for the back-end's tests."""

from pathlib import Path

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.measurement import Array, FrameId, RelativePose, Se2, TeamEstimate
from groundfuse.backend.problem import Problem
from groundfuse.tools.simulate_graphs import TeamGraphs, TeamShape, simulate

GRAPHS = Path(__file__).resolve().parents[2] / "shared" / "real" / "graphs"
"""Public graphs, kept out of the repository because of their licences."""


def random_problem(
    rng: np.random.Generator, num_poses: int, num_loops: int, sigma: float = 0.02
) -> tuple[Problem, Array]:
    """A chain with loops, full random covariances, and noise drawn from them; with the truth."""
    walk = [np.zeros(3)]
    for _ in range(num_poses - 1):
        step = np.array([1.0, 0.0, rng.normal(0.0, 0.5)])
        walk.append(planar.compose(walk[-1], step))
    truth = np.array(walk)
    loops = np.sort(rng.integers(0, num_poses, (num_loops, 2)), axis=1)
    loops = loops[loops[:, 1] > loops[:, 0]]
    a = np.concatenate([np.arange(num_poses - 1), loops[:, 0]])
    b = np.concatenate([np.arange(1, num_poses), loops[:, 1]])
    root = rng.normal(size=(len(a), 3, 3)) * sigma / 2 + np.eye(3) * sigma
    covariance = root @ np.swapaxes(root, 1, 2)
    noise = (np.linalg.cholesky(covariance) @ rng.normal(size=(len(a), 3, 1)))[:, :, 0]
    measured = planar.compose(planar.between(truth[a], truth[b]), planar.exp(noise))
    return Problem(num_poses, a, b, measured, planar.inverted(covariance)), truth


def team(seed: int, **shape: object) -> TeamGraphs:
    return simulate(TeamShape(**shape), np.random.default_rng(seed))  # type: ignore[arg-type]


def edge(a: FrameId, b: FrameId, a_from_b: Se2, sigma: float = 0.01) -> RelativePose:
    return RelativePose(a, b, a_from_b, np.eye(3) * sigma**2)


def errors(world: TeamGraphs, estimate: TeamEstimate, component: int = 0) -> dict[FrameId, Array]:
    """Errors of the poses of a component in their own tangents, relative to its reference."""
    members = [f for f in world.frames if estimate.component_of[f] == component]
    reference = world.truth[members[0]]
    return {
        f: planar.log(
            planar.between(
                planar.between(reference, world.truth[f]), estimate.team_from_base[f].vector()
            )
        )
        for f in members
    }


def false_accepts(world: TeamGraphs, estimate: TeamEstimate) -> int:
    return sum(v.accepted and w for v, w in zip(estimate.verdicts, world.wrong, strict=True))


def false_rejects(world: TeamGraphs, estimate: TeamEstimate) -> int:
    pairs = zip(estimate.verdicts, world.wrong, strict=True)
    return sum(not v.accepted and not w for v, w in pairs)
