"""Coincidence is told from a second answer: expected numbers, and what becomes of teams."""

import math

import numpy as np
import pytest
from graph_world import edge, false_accepts, team

from groundfuse.backend import chain, planar
from groundfuse.backend.chance import coincidence, expected_sets
from groundfuse.backend.consistency import agreement, links
from groundfuse.backend.measurement import FrameId
from groundfuse.backend.problem import Problem
from groundfuse.backend.team import fuse

LIMIT = 16.27


def unrelated(seed, count=120, frames=60, side_m=20.0):
    """Overlaps between two maps that put the second anywhere."""
    rng = np.random.default_rng(seed)
    number = np.arange(frames - 1)
    a = np.concatenate([number, number + frames])
    places = rng.uniform(0.0, side_m, (2 * frames, 2))
    truth = np.column_stack([places, rng.uniform(-math.pi, math.pi, 2 * frames)])
    steps = planar.between(truth[a], truth[a + 1])
    chains = Problem(2 * frames, a, a + 1, steps, np.tile(np.eye(3) * 1e4, (len(a), 1, 1)))
    ends = rng.integers(0, frames, count), frames + rng.integers(0, frames, count)
    lies = np.column_stack([np.zeros((count, 2)), rng.uniform(-math.pi, math.pi, count)])
    sigma = np.diag([0.2, 0.2, 0.1])
    overlaps = Problem(2 * frames, *ends, lies, np.tile(np.linalg.inv(sigma**2), (count, 1, 1)))
    forest = chain.spanning_forest(chains, np.ones(len(chains)))
    return links(overlaps, forest), forest


def test_the_probability_is_that_of_overlaps_that_say_anything():
    found, expected = [], []
    for seed in range(8):
        edges, forest = unrelated(seed)
        agrees = agreement(edges, forest, LIMIT)
        found.append(agrees[np.triu_indices(len(agrees), 1)].mean())
        expected.append(coincidence(edges, forest, LIMIT))
    # A disc instead of what two squares add up to, and large gates: a factor of two is enough to
    # tell 0.05 from the thousandths of true rivals; worst seen 0.8 over 8 seeds.
    assert 0.5 < np.mean(found) / np.mean(expected) < 2.0


def test_wider_gates_are_met_more_often():
    edges, forest = unrelated(1)
    assert coincidence(edges, forest, 2 * LIMIT) == pytest.approx(
        2**1.5 * coincidence(edges, forest, LIMIT), rel=0.05
    )


def test_one_overlap_or_one_place_is_no_base_for_probabilities():
    edges, forest = unrelated(1)
    assert coincidence(edges.of(np.arange(1)), forest, LIMIT) == 0.0
    assert coincidence(edges.of(np.zeros(2, dtype=np.int64)), forest, LIMIT) == 1.0


def test_expected_sets_are_binomial():
    assert expected_sets(10, 1, 0.01) == 10.0
    assert expected_sets(10, 2, 0.01) == pytest.approx(45 * 0.01)
    assert expected_sets(10, 3, 0.01) == pytest.approx(120 * 1e-4)
    assert expected_sets(1, 2, 0.01) == 0.0


@pytest.mark.parametrize("seed", [118, 124, 126])
def test_few_wrong_overlaps_that_agree_by_chance_among_many_are_no_rival(seed):
    world = team(seed, overlaps=40, wrong_overlaps=0.9)
    estimate = fuse(world.frames, world.edges)
    assert not estimate.ambiguities
    assert set(estimate.component_of.values()) == {0}
    assert false_accepts(world, estimate) == 0


@pytest.mark.parametrize("seed", [100, 101, 102])
def test_the_same_numbers_without_others_stay_open(seed):
    """Two against four, nothing else wrong: that nobody made them agree can't be said."""
    world = team(seed, overlaps=6, wrong_overlaps=4 / 6, consistent=True)
    estimate = fuse(world.frames, world.edges)
    (ambiguity,) = estimate.ambiguities
    assert [answer.support for answer in ambiguity.answers] == [4, 2]
    assert false_accepts(world, estimate) == 0


def test_a_step_that_fits_after_all_is_not_cut():
    world = team(2, overlaps=40, wrong_overlaps=0.8)
    estimate = fuse(world.frames, world.edges)
    assert [a.robot for a in estimate.anchors] == ["A", "B"]
    assert sum(v.accepted for v in estimate.verdicts if v.kind == "chain") == 198
    assert estimate.map_of[FrameId("A", 99)] == 0
    assert {f.robot for f, m in estimate.map_of.items() if m == 1} == {"B"}


def test_two_against_one_stays_open():
    a, b = ([FrameId(robot, k) for k in range(6)] for robot in "AB")
    step = planar.pose(np.array([1.0, 0.0, 0.0]))
    edges = [edge(r[k], r[k + 1], step) for r in (a, b) for k in range(5)]
    right, wrong = (planar.pose(np.array(p)) for p in ([0.0, 1.0, 0.0], [2.0, 1.0, 0.0]))
    edges += [edge(a[0], b[0], wrong), edge(a[3], b[3], wrong), edge(a[1], b[1], right)]
    estimate = fuse([*a, *b], edges)
    (ambiguity,) = estimate.ambiguities
    assert [answer.support for answer in ambiguity.answers] == [2, 1]


def test_answers_that_share_overlaps_leave_none_unrelated():
    """The first team where two answers together had more overlaps than there are."""
    world = team(1, robots=3, frames=50, overlaps=15, wrong_overlaps=0.8, consistent=True)
    estimate = fuse(world.frames, world.edges)
    assert false_accepts(world, estimate) == 0


def test_cutting_a_step_that_fits_does_not_let_the_majority_win():
    """Wrong overlaps outnumber right ones four to one in every pair; closures decide."""
    world = team(10, robots=3, frames=50, overlaps=15, wrong_overlaps=0.8, consistent=True)
    estimate = fuse(world.frames, world.edges)
    assert false_accepts(world, estimate) == 0
    assert set(estimate.component_of.values()) == {0}
