"""Covariances against the dense inverse and against gtsam's marginals."""

import gtsam
import numpy as np
import pytest
from graph_world import random_problem

from groundfuse.backend import chain, covariance, initial, native, planar, solver
from groundfuse.backend.problem import Problem

# A dense inverse of condition 1e7 in doubles; worst seen 4e-9 of the largest entry.
RELATIVE = 1e-6
# gtsam needs a prior of 1e-6 rad: (1e-6 x 30 m)^2 over 2e-4 m^2; worst seen 3e-6.
PRIOR = 1e-5


def solved(seed, num_poses=40, num_loops=30):
    graph, _ = random_problem(np.random.default_rng(seed), num_poses, num_loops)
    layout = initial.layout_of(graph)
    return graph, layout, solver.minimise(graph, initial.chordal(graph, layout).poses, layout).poses


def close(one, two, relative=RELATIVE):
    return np.abs(one - two).max() <= relative * np.abs(two).max()


@pytest.mark.parametrize("seed", range(4))
def test_marginals_are_blocks_of_the_dense_inverse(seed):
    graph, layout, poses = solved(seed)
    found = covariance.marginals(graph, poses, layout)
    matrix, _ = solver.normal_equations(graph, poses, layout)
    dense = np.linalg.inv(matrix.toarray())
    for pose in range(1, graph.num_poses):
        k = 3 * layout.rank[pose]
        assert close(found[pose], dense[k : k + 3, k : k + 3])
    assert not found[0].any()


def test_marginals_are_those_of_gtsam():
    graph, layout, poses = solved(9)
    found = covariance.marginals(graph, poses, layout)
    factors = native.factor_graph(graph, initial.held_poses(graph), poses)
    marginals = gtsam.Marginals(factors, native.values(poses))
    for pose in range(1, graph.num_poses):
        assert close(found[pose], marginals.marginalCovariance(pose), PRIOR)


def test_a_chain_has_the_covariance_of_its_composition():
    n = 50
    number = np.arange(n - 1)
    steps = np.tile([1.0, 0.0, 0.1], (n - 1, 1))
    graph = Problem(n, number, number + 1, steps, np.tile(np.diag([1e4, 2e4, 4e4]), (n - 1, 1, 1)))
    forest = chain.spanning_forest(graph, np.ones(n - 1))
    found = covariance.marginals(graph, forest.poses, initial.layout_of(graph))
    expected = planar.carried(planar.adjoint(planar.inverse(forest.poses)), forest.spatial)
    assert close(found, expected)


def test_parts_do_not_know_of_each_other():
    graph, _, _ = solved(3)
    apart = graph.of((graph.a < 20) == (graph.b < 20))
    layout = initial.layout_of(apart)
    poses = solver.minimise(apart, initial.chordal(apart, layout).poses, layout).poses
    found = covariance.marginals(apart, poses, layout)
    assert not found[[0, 20]].any()
    assert (np.linalg.eigvalsh(found[[1, 19, 21, 39]])[:, 0] > 0.0).all()
    first = apart.of(apart.a < 20)
    alone = Problem(20, first.a, first.b, first.a_from_b, first.information)
    assert close(found[:20], covariance.marginals(alone, poses[:20], initial.layout_of(alone)))


def test_a_lone_pose_has_no_covariance():
    nothing = np.empty(0, dtype=np.int64)
    graph = Problem(1, nothing, nothing, np.empty((0, 3)), np.empty((0, 3, 3)))
    assert not covariance.marginals(graph, np.zeros((1, 3)), initial.layout_of(graph)).any()
