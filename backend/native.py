"""The graph in gtsam's own factors, and gtsam's own Gauss-Newton as the last word."""

import gtsam
import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.problem import Array, Indices, Metric, Problem

PRIOR_SIGMA = 1e-6  # m and rad; the prior only fixes the frame, its residual is 0 at the optimum
MAX_STEPS = 10
RELATIVE_DECREASE = 1e-9


def factor_graph(problem: Problem, held: Indices, poses: Array) -> gtsam.NonlinearFactorGraph:
    """Return BetweenFactorPose2 for every edge and one PriorFactorPose2 per held pose.

    Keys are the numbers of the poses.

    Raises:
        ValueError: the problem is not in gtsam's metric.
    """
    if problem.metric != Metric.LOG:
        raise ValueError(f"gtsam's factors have gtsam's metric, got {problem.metric}")
    graph = gtsam.NonlinearFactorGraph()
    information = np.ascontiguousarray(problem.information)
    rows = zip(problem.a.tolist(), problem.b.tolist(), problem.a_from_b.tolist(), strict=True)
    for (a, b, measured), weight in zip(rows, information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(weight)
        graph.push_back(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*measured), noise))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)
    for k in held.tolist():
        graph.push_back(gtsam.PriorFactorPose2(k, gtsam.Pose2(*poses[k].tolist()), tight))
    return graph


def values(poses: Array) -> gtsam.Values:
    """Return the poses (n, 3) under the keys 0 .. n - 1."""
    whole = gtsam.Values()
    for k, pose in enumerate(poses.tolist()):
        whole.insert(k, gtsam.Pose2(*pose))
    return whole


def refined(problem: Problem, held: Indices, start: Array) -> Array:
    """Iterate gtsam's Gauss-Newton from `start` and return the best point (n, 3) seen.

    `GaussNewtonOptimizer.optimize()` would stop at the first rise of the cost and return the worse
    point; the loop over `iterate()` does not.
    """
    graph = factor_graph(problem, held, start)
    optimizer = gtsam.GaussNewtonOptimizer(graph, values(start), gtsam.GaussNewtonParams())
    best, best_error = start, optimizer.error()
    for _ in range(MAX_STEPS):
        optimizer.iterate()
        error = optimizer.error()
        gain = best_error - error
        if gain > 0.0:
            best, best_error = gtsam.utilities.extractPose2(optimizer.values()), error
        if gain <= RELATIVE_DECREASE * best_error:
            break
    return _regauged(best, start, held)


def _regauged(poses: Array, start: Array, held: Indices) -> Array:
    """Put held poses back to the bit (the prior leaves them at rounding error)."""
    exact = np.column_stack([poses[:, :2], planar.wrapped(poses[:, 2])])
    exact[held] = start[held]
    return exact
