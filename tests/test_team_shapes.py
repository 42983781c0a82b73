"""Teams of every shape: one robot to a hundred, bridges, lone frames, long chains without loops."""

from itertools import pairwise

import numpy as np
import pytest
from graph_world import edge, errors, false_accepts, team

from groundfuse.backend import chain, initial, planar, solver
from groundfuse.backend.certificate import Status, certificate
from groundfuse.backend.measurement import EdgeKind, FrameId, Reason, Se2
from groundfuse.backend.problem import Metric, Problem, chi2
from groundfuse.backend.team import fuse

# Two solutions of one optimum, as in test_team.
SAME_M = 1e-6


def line(robot, count):
    names = [FrameId(robot, k) for k in range(count)]
    return names, [edge(a, b, Se2(1.0, 0.0, 0.0)) for a, b in pairwise(names)]


def side(k):
    """Beside each other, a metre apart."""
    return Se2(0.0, float(k), 0.0)


def test_a_hundred_robots_in_a_row_become_one_component():
    frames, edges = [], []
    for r in range(100):
        names, steps = line(f"r{r:02d}.", 3)
        frames += names
        edges += steps
        if r:
            before = frames[-6:-3]
            edges += [edge(a, b, side(1)) for a, b in zip(before, names, strict=True)]
    estimate = fuse(frames, edges)
    assert set(estimate.component_of.values()) == {0}
    assert len(estimate.anchors) == 100
    assert not any(a.rests_on_one for a in estimate.anchors)
    last = estimate.team_from_base[FrameId("r99.", 2)]
    assert last.vector() == pytest.approx([2.0, 99.0, 0.0], abs=1e-6)


def test_a_bridge_robot_joins_two_that_never_meet():
    (a, steps_a), (b, steps_b), (c, steps_c) = line("A", 5), line("B", 5), line("C", 5)
    bridge = [edge(a[k], b[k], side(1)) for k in (0, 1)]
    bridge += [edge(b[k], c[k], side(1)) for k in (3, 4)]
    frames = a + b + c
    estimate = fuse(frames, steps_a + steps_b + steps_c + bridge)
    assert set(estimate.component_of.values()) == {0}
    assert estimate.anchors[2].team_from_map.vector() == pytest.approx([0, 2, 0], abs=1e-6)
    without = fuse(a + c, steps_a + steps_c)
    assert [x.component for x in without.anchors] == [0, 1]


def test_what_lies_behind_a_bridge_on_a_single_edge_is_flagged_too():
    (a, steps_a), (b, steps_b), (c, steps_c) = line("A", 5), line("B", 5), line("C", 5)
    joins = [edge(a[2], b[2], side(1))] + [edge(b[k], c[k], side(1)) for k in (0, 4)]
    estimate = fuse(a + b + c, steps_a + steps_b + steps_c + joins)
    assert {x.robot: x.rests_on_one for x in estimate.anchors} == {
        "A": False,
        "B": True,
        "C": True,
    }


def test_robots_with_one_frame_each_are_a_team():
    names = [FrameId(robot, 0) for robot in "ABCD"]
    edges = [edge(names[i], names[j], side(j - i)) for i in range(4) for j in range(i + 1, 4)]
    estimate = fuse(names, edges)
    assert set(estimate.component_of.values()) == {0}
    assert estimate.team_from_base[names[3]].vector() == pytest.approx([0, 3, 0], abs=1e-9)


def test_every_edge_has_a_verdict_with_residual_limit_and_reason():
    world = team(5, frames=40, loops=10, overlaps=12, wrong_overlaps=0.5, wrong_loops=0.2)
    estimate = fuse(world.frames, world.edges)
    assert [(v.a, v.b) for v in estimate.verdicts] == [(e.a, e.b) for e in world.edges]
    assert false_accepts(world, estimate) == 0
    for verdict in estimate.verdicts:
        assert verdict.accepted == (verdict.reason is None)
        assert verdict.accepted == (verdict.chi2 <= verdict.limit)
        assert verdict.reason in {None, Reason.INCONSISTENT}
        assert (verdict.kind == EdgeKind.OVERLAP) == (verdict.a.robot != verdict.b.robot)


def test_a_chain_of_100000_poses_without_a_loop_is_solved():
    n = 100_000
    number = np.arange(n - 1)
    turns = np.random.default_rng(1).normal(0.0, 0.1, n - 1)
    steps = np.column_stack([np.ones(n - 1), np.zeros(n - 1), turns])
    graph = Problem(n, number, number + 1, steps, np.tile(np.diag([4e2, 4e2, 1e4]), (n - 1, 1, 1)))
    found = solver.optimum(graph, options=solver.SolverOptions(max_iterations=2))
    # Nothing contradicts. Two steps leave 4e-9, a millionth of a sigma per edge.
    assert found.chi2 < 1e-6
    chained = chain.spanning_forest(graph, np.ones(n - 1)).poses
    assert chi2(graph, chained) < 1e-12


@pytest.mark.parametrize("metric", list(Metric))
@pytest.mark.parametrize("seed", range(3))
def test_the_cost_does_not_depend_on_where_the_world_begins(metric, seed):
    rng = np.random.default_rng(seed)
    world = team(seed, robots=1, frames=30, loops=10)
    truth = np.array([world.truth[f] for f in world.frames])
    a = np.array([e.a.index for e in world.edges])
    b = np.array([e.b.index for e in world.edges])
    measured = planar.stacked([e.a_from_b for e in world.edges])
    information = planar.inverted(np.array([e.covariance for e in world.edges]))
    graph = Problem(30, a, b, measured, information, metric)
    moved = planar.compose(rng.uniform(-3.0, 3.0, 3) * [1e3, 1e3, 1.0], truth)
    # Places of 3 km in doubles: 1e-12 m over a sigma of 2 cm, squared and summed.
    assert chi2(graph, moved) == pytest.approx(chi2(graph, truth), rel=1e-7)
    one, two = solver.optimum(graph, truth), solver.optimum(graph, moved)
    assert two.chi2 == pytest.approx(one.chi2, rel=1e-8)
    assert np.abs(planar.log(planar.between(one.poses, two.poses))).max() < SAME_M


@pytest.mark.parametrize("seed", range(3))
def test_which_pose_is_held_and_how_poses_are_numbered_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    world = team(seed, robots=1, frames=40, loops=15)
    a = np.array([e.a.index for e in world.edges])
    b = np.array([e.b.index for e in world.edges])
    measured = planar.stacked([e.a_from_b for e in world.edges])
    information = planar.inverted(np.array([e.covariance for e in world.edges]))
    plain = Problem(40, a, b, measured, information)
    new, order = rng.permutation(40), rng.permutation(len(a))
    other = Problem(40, new[a][order], new[b][order], measured[order], information[order])
    one, two = solver.optimum(plain), solver.optimum(other)
    assert two.chi2 == pytest.approx(one.chi2, rel=1e-8)
    back = two.poses[new]
    error = planar.log(planar.between(one.poses, planar.between(back[:1], back)))
    assert np.abs(error).max() < SAME_M
    assert certificate(other, two.poses).status == certificate(plain, one.poses).status
    assert certificate(plain, one.poses).status == Status.CERTIFIED
    assert not one.poses[0].any()
    assert not initial.held_poses(plain).any()


def test_encounters_over_a_team_are_spread_and_the_robots_that_met_are_joined():
    world = team(3, robots=4, frames=40, overlaps=0, loops=5, encounters=40, wrong_overlaps=0.2)
    between = [e for e in world.edges if e.a.robot != e.b.robot]
    assert len(between) == 40
    assert sum(world.wrong) == 8
    estimate = fuse(world.frames, world.edges)
    assert false_accepts(world, estimate) == 0
    assert set(estimate.component_of.values()) == {0}
    error = np.array(list(errors(world, estimate).values()))
    assert np.abs(error[:, :2]).max() < 0.5
