"""Residuals, derivatives and cost of the arrays against gtsam's factors."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from graph_world import edge, random_problem

from groundfuse.backend import native, planar, problem
from groundfuse.backend.measurement import FrameId, Se2

# Sums of some 60 squares of size up to 1e6 in doubles; worst seen 4e-13 relative.
RELATIVE = 1e-10
# Central differences, step 1e-6, of residuals of size 10; worst seen 2e-8.
NUMERIC = 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_chi2_is_twice_the_error_of_gtsams_factors(seed):
    rng = np.random.default_rng(seed)
    graph, truth = random_problem(rng, 30, 30)
    poses = planar.compose(truth, planar.exp(rng.normal(0.0, 0.3, truth.shape)))
    factors = native.factor_graph(graph, np.empty(0, dtype=np.int64), poses)
    expected = 2.0 * factors.error(native.values(poses))
    assert problem.chi2(graph, poses) == pytest.approx(expected, rel=RELATIVE)


@pytest.mark.parametrize("metric", list(problem.Metric))
def test_derivatives_are_numeric_derivatives(metric):
    rng = np.random.default_rng(5)
    graph, truth = random_problem(rng, 6, 6)
    graph = replace(graph, metric=metric)
    poses = planar.compose(truth, planar.exp(rng.normal(0.0, 0.3, truth.shape)))
    linear = problem.linearised(graph, poses)
    assert np.array_equal(linear.residual, problem.residuals(graph, poses))
    step = 1e-6
    for pose in range(graph.num_poses):
        for axis in range(3):
            ends = []
            for sign in (1.0, -1.0):
                moved = poses.copy()
                tangent = np.eye(3)[axis] * sign * step
                moved[pose] = planar.compose(poses[pose], planar.exp(tangent))
                ends.append(problem.residuals(graph, moved))
            numeric = (ends[0] - ends[1]) / (2.0 * step)
            by = np.where((graph.a == pose)[:, None], linear.by_a[:, :, axis], 0.0)
            by += np.where((graph.b == pose)[:, None], linear.by_b[:, :, axis], 0.0)
            assert np.allclose(numeric, by, atol=NUMERIC)


def test_components_are_numbered_by_first_appearance():
    index_of = {FrameId("A", k): k for k in range(6)}
    edges = [edge(FrameId("A", 5), FrameId("A", 1), Se2(1, 0, 0)),
             edge(FrameId("A", 2), FrameId("A", 4), Se2(1, 0, 0))]  # fmt: skip
    graph = problem.from_edges(index_of, edges)
    assert problem.components(graph).tolist() == [0, 1, 2, 3, 2, 1]


def test_no_edges_make_an_empty_problem():
    graph = problem.from_edges({FrameId("A", 0): 0}, [])
    assert len(graph) == 0
    assert problem.components(graph).tolist() == [0]
    assert problem.chi2(graph, np.zeros((1, 3))) == 0.0


def test_weights_multiply_the_cost_of_their_edges():
    graph, truth = random_problem(np.random.default_rng(1), 10, 4)
    weights = np.arange(len(graph), dtype=float)
    expected = problem.chi2_per_edge(graph, truth) * weights
    assert np.allclose(problem.chi2_per_edge(graph.weighted(weights), truth), expected)


def test_gtsam_reads_our_covariance_order():
    a, b = FrameId("A", 0), FrameId("A", 1)
    measured = edge(a, b, Se2(1.0, 2.0, 0.3))
    graph = problem.from_edges({a: 0, b: 1}, [measured])
    poses = np.array([[0.0, 0.0, 0.0], [1.5, 2.5, 0.4]])
    factor = gtsam.BetweenFactorPose2(
        0, 1, gtsam.Pose2(1.0, 2.0, 0.3), gtsam.noiseModel.Gaussian.Covariance(measured.covariance)
    )
    expected = 2.0 * factor.error(native.values(poses))
    assert problem.chi2(graph, poses) == pytest.approx(expected, rel=RELATIVE)


def test_g2o_takes_the_plain_components():
    a, b = FrameId("A", 0), FrameId("A", 1)
    graph = problem.from_edges({a: 0, b: 1}, [edge(a, b, Se2(1.0, 2.0, 0.3), sigma=1.0)])
    poses = np.array([[0.0, 0.0, 0.0], [1.5, 2.5, 0.4]])
    error = Se2(1.0, 2.0, 0.3).inverse() @ Se2(1.5, 2.5, 0.4)
    plain = replace(graph, metric=problem.Metric.PLAIN)
    assert problem.chi2(plain, poses) == pytest.approx(error.vector() @ error.vector())


def test_gtsams_factors_are_not_made_of_g2os_metric():
    graph, truth = random_problem(np.random.default_rng(1), 5, 0)
    plain = replace(graph, metric=problem.Metric.PLAIN)
    with pytest.raises(ValueError, match="gtsam's factors have gtsam's metric, got g2o"):
        native.factor_graph(plain, np.empty(0, dtype=np.int64), truth)
