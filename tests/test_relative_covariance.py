"""Relative covariances against gtsam's joint marginals, a dense inverse, and the gauge."""

import gtsam
import numpy as np
import pytest
from graph_world import random_problem

from groundfuse.backend import native, planar, solver
from groundfuse.backend.initial import held_poses
from groundfuse.backend.problem import Problem
from groundfuse.backend.relative_covariance import relative_covariances

# gtsam needs a prior of 1e-6 rad: (1e-6 x 30 m)^2 over 2e-4 m^2, as in test_covariance; the
# relative pose knows nothing of it: two inverses of condition 1e7; worst seen 2e-8.
RELATIVE = 1e-6
PAIRS = [(0, 25), (25, 0), (3, 39), (39, 4), (11, 12)]


def solved(seed):
    graph, _ = random_problem(np.random.default_rng(seed), 40, 30)
    return graph, solver.optimum(graph).poses


def close(one, two):
    return np.abs(one - two).max() <= RELATIVE * np.abs(two).max()


def test_they_are_those_of_gtsams_joint_marginals():
    graph, poses = solved(5)
    factors = native.factor_graph(graph, held_poses(graph), poses)
    marginals = gtsam.Marginals(factors, native.values(poses))
    for (a, b), found in zip(PAIRS, relative_covariances(graph, poses, PAIRS), strict=True):
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector([a, b]))
        blocks = np.block([[joint.at(i, j) for j in (a, b)] for i in (a, b)])
        one, two = (gtsam.Pose2(*poses[k]) for k in (a, b))
        by_a, by_b = np.zeros((3, 3), order="F"), np.zeros((3, 3), order="F")
        one.between(two, by_a, by_b)  # gtsam's own derivatives
        moves = np.hstack([by_a, by_b])
        assert close(found, moves @ blocks @ moves.T)


def test_the_other_way_round_is_the_same_seen_from_there():
    graph, poses = solved(6)
    there, back = relative_covariances(graph, poses, [(3, 30), (30, 3)])
    a_from_b = planar.between(poses[3], poses[30])
    assert close(planar.carried(planar.adjoint(a_from_b), there), back)


def test_which_pose_is_held_does_not_matter():
    """Relabelled so that another pose comes first."""
    graph, poses = solved(7)
    last = graph.num_poses - 1
    other = Problem(
        graph.num_poses, last - graph.a, last - graph.b, graph.a_from_b, graph.information
    )
    there = relative_covariances(graph, poses, PAIRS)
    flipped = relative_covariances(other, poses[::-1], [(last - a, last - b) for a, b in PAIRS])
    for one, two in zip(there, flipped, strict=True):
        assert close(one, two)


def test_a_single_edge_has_its_own_covariance():
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 1.0]]) * 1e-4
    step = np.array([[1.0, 2.0, 0.5]])
    graph = Problem(2, np.array([0]), np.array([1]), step, planar.inverted(covariance[None]))
    (found,) = relative_covariances(graph, np.vstack([np.zeros(3), step]), [(0, 1)])
    assert close(found, covariance)


def test_no_pair_is_no_answer():
    graph, poses = solved(8)
    assert relative_covariances(graph, poses, []) == []


def test_what_is_not_connected_has_none():
    empty = np.zeros((0, 3, 3))
    none = np.zeros(0, dtype=np.int64)
    graph = Problem(2, none, none, np.zeros((0, 3)), empty)
    with pytest.raises(ValueError, match=r"^poses 0 and 1 are not connected$"):
        relative_covariances(graph, np.zeros((2, 3)), [(0, 1)])
    with pytest.raises(ValueError, match=r"^poses 1 and 1 are the same pose$"):
        relative_covariances(graph, np.zeros((2, 3)), [(1, 1)])
