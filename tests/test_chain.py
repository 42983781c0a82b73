"""Chained poses and covariances along chains against walking them edge by edge."""

import numpy as np
import pytest
from graph_world import random_problem

from groundfuse.backend import chain, planar
from groundfuse.backend.problem import Problem

# Up to 60 products of poses of size 30 in doubles; worst seen 2e-12 relative.
RELATIVE = 1e-9


def tree_with_gaps(seed):
    """Steps with some missing, skips over the gaps, side branches, two parts."""
    graph, _ = random_problem(np.random.default_rng(seed), 40, 30)
    gap = np.abs(graph.b - graph.a)
    lost = np.isin(np.arange(len(graph)), [1, 4, 20, 30]) | (gap > 3)
    return graph.of(~lost)


def walked(graph, forest, node):
    """Return pose and covariance (root's tangent) of a node by walking up its parents."""
    path = []
    while forest.edge[node] >= 0:
        k = forest.edge[node]
        path.append((k, graph.b[k] == node))
        node = graph.a[k] if graph.b[k] == node else graph.b[k]
    pose, spatial = np.zeros(3), np.zeros((3, 3))
    for k, forward in reversed(path):
        z, covariance = graph.a_from_b[k], np.linalg.inv(graph.information[k])
        if not forward:
            covariance = planar.adjoint(z) @ covariance @ planar.adjoint(z).T
            z = planar.inverse(z)
        pose = planar.compose(pose, z)
        spatial = spatial + planar.adjoint(pose) @ covariance @ planar.adjoint(pose).T
    return pose, spatial, [k for k, _ in path]


@pytest.mark.parametrize("seed", range(3))
def test_poses_and_covariances_are_those_of_the_walked_tree(seed):
    graph = tree_with_gaps(seed)
    forest = chain.spanning_forest(graph, np.abs(graph.b - graph.a).astype(float))
    for node in range(graph.num_poses):
        pose, spatial, path = walked(graph, forest, node)
        assert np.allclose(forest.poses[node], pose, rtol=RELATIVE, atol=RELATIVE)
        assert np.allclose(forest.spatial[node], spatial, rtol=RELATIVE)
        assert forest.depth[node] == len(path)


def test_the_covariance_between_two_frames_is_that_of_the_path():
    graph = tree_with_gaps(7)
    forest = chain.spanning_forest(graph, np.abs(graph.b - graph.a).astype(float))
    i, j = (k.ravel() for k in np.meshgrid(np.arange(40), np.arange(40)))
    same = forest.part[i] == forest.part[j]
    between = forest.between(i[same], j[same])
    for k, (one, two) in enumerate(zip(i[same], j[same], strict=True)):
        path = set(walked(graph, forest, one)[2]) ^ set(walked(graph, forest, two)[2])
        expected = np.zeros((3, 3))
        for number in path:
            node = int(np.flatnonzero(forest.edge == number)[0])
            above = forest.ancestors[0][node]
            expected += walked(graph, forest, node)[1] - walked(graph, forest, above)[1]
        assert np.allclose(between[k], expected, rtol=1e-6, atol=1e-9)


def test_the_chain_takes_the_shortest_skips():
    graph = tree_with_gaps(1)
    gap = np.abs(graph.b - graph.a).astype(float)
    forest = chain.spanning_forest(graph, gap)
    used = np.zeros(len(graph), dtype=bool)
    used[forest.edge[forest.edge >= 0]] = True
    steps = {(graph.a[k], graph.b[k]) for k in np.flatnonzero(gap == 1.0)}
    assert {(graph.a[k], graph.b[k]) for k in np.flatnonzero(used)} >= steps


def test_a_long_chain_without_loops_does_not_overflow_anything():
    n = 100_000
    number = np.arange(n - 1)
    steps = np.tile([1.0, 0.0, 0.0], (n - 1, 1))
    graph = Problem(n, number, number + 1, steps, np.tile(np.eye(3), (n - 1, 1, 1)))
    forest = chain.spanning_forest(graph, np.ones(n - 1))
    assert np.array_equal(forest.poses[:, 0], np.arange(n))
    assert forest.meeting(np.array([n - 1]), np.array([17])).tolist() == [17]


def test_frames_without_edges_are_roots():
    nothing = np.empty(0, dtype=np.int64)
    graph = Problem(3, nothing, nothing, np.empty((0, 3)), np.empty((0, 3, 3)))
    forest = chain.spanning_forest(graph, np.empty(0))
    assert forest.edge.tolist() == [-1, -1, -1]
    assert forest.part.tolist() == [0, 1, 2]
    assert not forest.poses.any()
