"""Solving by the factor of a similar matrix: the same answer, or none at all."""

import numpy as np
import pytest
from graph_world import random_problem

from groundfuse.backend import initial, normal, planar, solver, sparse
from groundfuse.backend.problem import Problem, chi2, linearised


def system(graph, poses):
    layout = initial.layout_of(graph)
    matrix, gradient = solver.normal_equations(graph, poses, layout)
    return matrix, -gradient.ravel()


def moved(poses, length, seed):
    rng = np.random.default_rng(seed)
    return planar.compose(poses, planar.exp(rng.normal(size=poses.shape) * length))


@pytest.mark.parametrize("seed", range(5))
def test_a_near_factor_gives_the_solution(seed):
    graph, truth = random_problem(np.random.default_rng(seed), 40, 40)
    matrix, right = system(graph, moved(truth, 1e-3, seed))
    near, _ = system(graph, moved(truth, 1e-3, seed + 100))
    best = sparse.factorised(matrix).solve(right)
    promised = right @ best
    found = normal.by_known_factor(matrix, right, sparse.factorised(near), 1e-9 * promised)
    assert found is not None
    # What is missing of the promised decrease is the sum of the rounds not done: each is smaller
    # by the rate, so less than twice the last; rounding (condition 1e6) comes in from both sides.
    reached = 2.0 * right @ found - found @ (matrix @ found)
    assert abs(promised - reached) < 1e-8 * promised


def test_the_own_factor_gives_it_at_once():
    graph, truth = random_problem(np.random.default_rng(1), 40, 40)
    matrix, right = system(graph, truth)
    factor = sparse.factorised(matrix)
    found = normal.by_known_factor(matrix, right, factor, 1e-12)
    assert found == pytest.approx(factor.solve(right), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_a_far_factor_is_given_up(seed):
    graph, truth = random_problem(np.random.default_rng(seed), 60, 60)
    matrix, right = system(graph, truth)
    far, _ = system(graph, np.random.default_rng(seed).uniform(-3.0, 3.0, truth.shape))
    assert normal.by_known_factor(matrix, right, sparse.factorised(far), 0.0) is None


def test_the_minimum_is_the_same_with_any_known_factor():
    graph, truth = random_problem(np.random.default_rng(4), 40, 30)
    layout = initial.layout_of(graph)
    plain = solver.minimise(graph, truth, layout)
    far, _ = system(graph, np.random.default_rng(5).uniform(-3.0, 3.0, truth.shape))
    other = solver.minimise(graph, truth, layout, known=sparse.factorised(far))
    assert other.converged
    assert other.chi2 == pytest.approx(plain.chi2, rel=1e-8)


def test_the_gradient_is_half_the_slope_of_chi2():
    graph, truth = random_problem(np.random.default_rng(2), 12, 8)
    layout = initial.layout_of(graph)
    _, gradient = normal.of_linear(linearised(graph, truth), graph.information, layout)
    slope = sparse.spread(layout, gradient)
    for pose, axis in [(1, 0), (5, 1), (11, 2)]:
        step = np.zeros_like(truth)
        step[pose, axis] = 1e-6
        up, down = (chi2(graph, planar.compose(truth, planar.exp(s))) for s in (step, -step))
        # Central differences: 1e-16 x chi2 (60) / 1e-6, relative to slopes of some 100.
        assert (up - down) / 4e-6 == pytest.approx(slope[pose, axis], rel=1e-5, abs=1e-4)


def test_edges_between_held_poses_leave_nothing_to_solve():
    nobody = np.empty(0, dtype=np.int64)
    one = Problem(1, nobody, nobody, np.empty((0, 3)), np.empty((0, 3, 3)))
    start = initial.chordal(one, initial.layout_of(one))
    assert start.factor is None
    assert not start.poses.any()
