"""Other solvers on the same graph from the same start: gtsam, g2o, Open3D, scipy.

Every solver is timed from its own objects: what it takes to build them from arrays (seconds in
Python for some) is stated apart. Costs are chi2 in gtsam's metric and in g2o's, whatever the solver
minimises: on graphs with very uneven information the two have different optima.
"""

import importlib
import time
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_array

from groundfuse.backend import initial, native, planar
from groundfuse.backend.measurement import FrameId, RelativePose
from groundfuse.backend.problem import Array, Metric, Problem, chi2, linearised, residuals
from groundfuse.tools.open3d_check import optimised_by_open3d

ENOUGH = 1e-8  # relative decrease at which gtsam's loop ends, as ours does
MAX_STEPS = 100
SCIPY_STEPS = 30


@dataclass(frozen=True, slots=True)
class Peer:
    """What another solver came to.

    Attributes:
        name: of the solver.
        build_s: making its objects.
        solve_s: solving.
        chi2: at its result, in gtsam's metric.
        chi2_plain: in g2o's.
    """

    name: str
    build_s: float
    solve_s: float
    chi2: float
    chi2_plain: float


def peer(name: str, build_s: float, solve_s: float, problem: Problem, poses: Array) -> Peer:
    """Return what a solver came to, its result judged in both metrics."""
    costs = (chi2(replace(problem, metric=metric), poses) for metric in (Metric.LOG, Metric.PLAIN))
    return Peer(name, build_s, solve_s, *costs)


def gtsam_gauss_newton(problem: Problem, start: Array) -> Peer:
    """Loop over `iterate()` until the cost is at rest."""
    begin = time.perf_counter()
    graph = native.factor_graph(problem, initial.held_poses(problem), start)
    values = native.values(start)
    built = time.perf_counter()
    optimizer = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams())
    before = optimizer.error()
    for _ in range(MAX_STEPS):
        optimizer.iterate()
        error = optimizer.error()
        if abs(before - error) <= ENOUGH * error:
            break
        before = error
    done = time.perf_counter()
    poses = gtsam.utilities.extractPose2(optimizer.values())
    return peer("gtsam Gauss-Newton", built - begin, done - built, problem, poses)


def gtsam_levenberg(problem: Problem, start: Array) -> Peer:
    """Run Levenberg-Marquardt as it comes, with 100 iterations at most."""
    begin = time.perf_counter()
    graph = native.factor_graph(problem, initial.held_poses(problem), start)
    values = native.values(start)
    built = time.perf_counter()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(MAX_STEPS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    done = time.perf_counter()
    poses = gtsam.utilities.extractPose2(result)
    return peer("gtsam Levenberg-Marquardt", built - begin, done - built, problem, poses)


def g2o_gauss_newton(problem: Problem, start: Array) -> Peer:
    """Run g2o step by step until the cost is at rest.

    Raises:
        ImportError: g2opy is not installed.
    """
    g2opy: Any = importlib.import_module("g2opy")
    begin = time.perf_counter()
    graph = g2opy.SparseOptimizer()
    blocks = g2opy.BlockSolverSE2(g2opy.LinearSolverEigenSE2())
    graph.set_algorithm(g2opy.OptimizationAlgorithmGaussNewton(blocks))
    for k, pose in enumerate(start.tolist()):
        vertex = g2opy.VertexSE2()
        vertex.set_id(k)
        vertex.set_estimate(g2opy.SE2(*pose))
        vertex.set_fixed(k == 0)
        graph.add_vertex(vertex)
    rows = zip(problem.a.tolist(), problem.b.tolist(), problem.a_from_b.tolist(), strict=True)
    for (a, b, measured), information in zip(rows, problem.information, strict=True):
        edge = g2opy.EdgeSE2()
        edge.set_vertex(0, graph.vertex(a))
        edge.set_vertex(1, graph.vertex(b))
        edge.set_measurement(g2opy.SE2(*measured))
        edge.set_information(information)
        graph.add_edge(edge)
    built = time.perf_counter()
    graph.initialize_optimization()
    before = np.inf
    for step in range(MAX_STEPS):
        graph.optimize(1, step > 0)
        error = graph.active_chi2()
        if abs(before - error) <= ENOUGH * error:
            break
        before = error
    done = time.perf_counter()
    found = [graph.vertex(k).estimate().to_vector() for k in range(problem.num_poses)]
    return peer("g2o Gauss-Newton", built - begin, done - built, problem, np.array(found))


def scipy_least_squares(problem: Problem, start: Array) -> Peer:
    """Run the trust-region solver of scipy with our sparse derivatives; the first pose held."""
    optimize: Any = importlib.import_module(
        "scipy.optimize"
    )  # its stubs know no sparse derivatives
    begin = time.perf_counter()
    white = np.swapaxes(np.linalg.cholesky(problem.information), 1, 2)
    row = np.arange(3 * len(problem)).reshape(-1, 3, 1)

    def moved(step: Array) -> Array:
        return planar.compose(start, planar.exp(np.vstack([np.zeros(3), step.reshape(-1, 3)])))

    def whitened(step: Array) -> Array:
        error: Array = (white @ residuals(problem, moved(step))[:, :, None]).ravel()
        return error

    def derivative(step: Array) -> Any:  # noqa: ANN401 - scipy's sparse types
        poses = moved(step)
        linear = linearised(problem, poses)
        # poses move by exp(step), the derivative is by a further motion: Jr of the step between.
        right = np.linalg.inv(planar.by_right(np.vstack([np.zeros(3), step.reshape(-1, 3)])))
        values, rows, columns = [], [], []
        for by, end in ((linear.by_a, problem.a), (linear.by_b, problem.b)):
            column = 3 * (end[:, None, None] - 1) + np.arange(3)
            values.append((white @ by @ right[end])[end > 0].ravel())
            rows.append(np.broadcast_to(row, by.shape)[end > 0].ravel())
            columns.append(np.broadcast_to(column, by.shape)[end > 0].ravel())
        whole = (np.concatenate(rows), np.concatenate(columns))
        shape = (3 * len(problem), 3 * problem.num_poses - 3)
        return coo_array((np.concatenate(values), whole), shape=shape).tocsr()

    zero = np.zeros(3 * problem.num_poses - 3)
    result = optimize.least_squares(whitened, zero, derivative, x_scale="jac", max_nfev=SCIPY_STEPS)
    done = time.perf_counter()
    return peer("scipy least_squares", 0.0, done - begin, problem, moved(result.x))


def open3d_global(problem: Problem, start: Array) -> Peer:
    """Run Open3D's Levenberg-Marquardt on the graph lifted into space, its criteria tightened.

    Its normal equations are dense, 6 numbers per pose.
    """
    order = [FrameId("A", k) for k in range(problem.num_poses)]
    covariance = planar.inverted(problem.information)
    ends = zip(problem.a.tolist(), problem.b.tolist(), strict=True)
    edges = [
        RelativePose(order[a], order[b], planar.pose(problem.a_from_b[k]), covariance[k])
        for k, (a, b) in enumerate(ends)
    ]
    begin = time.perf_counter()
    found = optimised_by_open3d(order, {f: planar.pose(start[f.index]) for f in order}, edges)
    done = time.perf_counter()
    poses = planar.stacked([found[f] for f in order])
    return peer("Open3D (with its objects)", 0.0, done - begin, problem, poses)
