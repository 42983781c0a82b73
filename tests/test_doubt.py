"""Wrong steps of trajectories made from pictures alone, and floors that repeat, told apart."""

from dataclasses import replace

import numpy as np
import pytest
from graph_world import false_accepts, team

from groundfuse.backend.measurement import EdgeKind, FrameId, Se2
from groundfuse.backend.team import TeamOptions, fuse


def refused_steps(estimate):
    return [(v.a, v.b) for v in estimate.verdicts if v.kind == EdgeKind.CHAIN and not v.accepted]


def broken(seed, step):
    world = team(seed, frames=20, overlaps=12, loops=6)
    edges = list(world.edges)
    assert edges[step].a == FrameId("A", step)
    edges[step] = replace(edges[step], a_from_b=Se2(0.1, 0.5, 1.0))
    return world, edges


def untouched(world, one, two):
    """Whether no edge but the steps reaches the frames that lie between two steps of A."""
    between = {FrameId("A", k) for k in range(min(one, two) + 1, max(one, two) + 1)}
    return not any({e.a, e.b} & between for e in world.edges if abs(e.a.index - e.b.index) > 5
                   or e.a.robot != e.b.robot)  # fmt: skip


def test_most_wrong_steps_are_found_and_nothing_else_is_cut():
    found = 0
    for seed in range(12):
        step = 5 + seed % 9
        world, edges = broken(seed, step)
        for a, _ in refused_steps(fuse(world.frames, edges)):
            assert a.robot == "A"
            assert untouched(world, a.index, step)  # or the two could have been told apart
            found += 1
    assert 9 <= found <= 12


@pytest.mark.parametrize("seed", range(4))
def test_overlaps_that_repeat_do_not_cut_right_steps(seed):
    world = team(seed, frames=40, overlaps=15, wrong_overlaps=0.4, consistent=True, loops=8)
    estimate = fuse(world.frames, world.edges)
    assert refused_steps(estimate) == []
    assert false_accepts(world, estimate) == 0


def test_protected_odometry_is_never_cut():
    world, edges = broken(1, 6)
    assert len(refused_steps(fuse(world.frames, edges))) == 1
    assert refused_steps(fuse(world.frames, edges, TeamOptions(max_cuts=0))) == []


def test_right_teams_are_left_alone():
    for seed in range(6):
        world = team(seed, frames=25, overlaps=8, loops=6, wrong_loops=0.3, wrong_overlaps=0.25)
        estimate = fuse(world.frames, world.edges)
        assert refused_steps(estimate) == []
        assert np.isfinite(estimate.chi2)
