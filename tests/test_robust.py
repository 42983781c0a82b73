"""Graduated non-convexity from a start that is believed, and which edges end in or out."""

import numpy as np
import pytest
from graph_world import random_problem

from groundfuse.backend import chain, initial, planar, solver
from groundfuse.backend.problem import Problem, chi2_per_edge
from groundfuse.backend.robust import RobustOptions, _weights, plausible, settle

OPTIONS = RobustOptions()


def spoiled(seed, share):
    """A chain with loops, a share of which is wrong; the flags say which edges are."""
    rng = np.random.default_rng(seed)
    graph, truth = random_problem(rng, 60, 40)
    wrong = (np.abs(graph.b - graph.a) > 1) & (rng.random(len(graph)) < share)
    lies = planar.exp(rng.uniform(-3.0, 3.0, (len(graph), 3)))
    measured = np.where(wrong[:, None], planar.compose(graph.a_from_b, lies), graph.a_from_b)
    return Problem(60, graph.a, graph.b, measured, graph.information), truth, wrong


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_wrong_loops_end_outside_and_the_rest_at_its_optimum(seed, share):
    graph, _, wrong = spoiled(seed, share)
    steps = np.abs(graph.b - graph.a) == 1
    start = chain.spanning_forest(graph.of(steps), np.ones(int(steps.sum()))).poses
    layout = initial.layout_of(graph)
    result = settle(graph, start, layout, steps, steps, options=OPTIONS)
    assert not (result.accepted & wrong).any()
    assert (~result.accepted & ~wrong).sum() <= 2  # of 40 right loops, 20 seeds: once 2
    kept = graph.of(result.accepted)
    clean = solver.minimise(kept, initial.chordal(kept, initial.layout_of(kept)).poses)
    assert chi2_per_edge(kept, result.poses).sum() == pytest.approx(clean.chi2, rel=1e-6)


def test_what_is_plausible_depends_on_how_well_its_poses_are_tied():
    graph, _, wrong = spoiled(1, 0.3)
    steps = np.abs(graph.b - graph.a) == 1
    start = chain.spanning_forest(graph.of(steps), np.ones(int(steps.sum()))).poses
    flags = plausible(graph, start, steps, OPTIONS.limit)
    error = chi2_per_edge(graph, start)
    right = ~wrong & ~steps
    assert flags[right].mean() > 0.95
    assert (error[right] > 10 * OPTIONS.limit).any()  # far beyond their own noise
    assert flags[wrong].mean() < 0.5


def test_weights_are_those_of_truncated_least_squares():
    limit = 16.0
    error = np.linspace(0.0, 1e3, 2001)
    for control in (1e-3, 0.1, 1.0, 100.0):
        weights = _weights(error, control, limit)
        assert ((weights >= 0.0) & (weights <= 1.0)).all()
        assert (np.diff(weights) <= 1e-12).all()
    hard = _weights(error, 1e9, limit)
    off = np.abs(error - limit) > 0.1
    assert np.array_equal((hard > 0.5)[off], (error <= limit)[off])


def test_a_part_that_loses_all_its_edges_stays_where_it_is():
    """Two chains tied by one absurd pair of edges that no solution can satisfy."""
    number = np.array([0, 1, 3, 4, 0, 2])
    ends = np.array([1, 2, 4, 5, 3, 5])
    measured = np.array([[1, 0, 0]] * 4 + [[50.0, 0, 0], [-50.0, 0, 1.0]], dtype=float)
    graph = Problem(6, number, ends, measured, np.tile(np.eye(3) * 1e4, (6, 1, 1)))
    steps = np.arange(6) < 4
    start = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 9, 0], [1, 9, 0], [2, 9, 0]], float)
    result = settle(graph, start, initial.layout_of(graph), steps, np.ones(6, dtype=bool),
                    options=OPTIONS)  # fmt: skip
    assert np.isfinite(result.poses).all()
    assert result.accepted[:4].all()
    assert not result.accepted[4:].all()
