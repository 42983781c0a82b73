"""One robot alone: chained and optimised poses."""

from itertools import pairwise

import numpy as np
import pytest
from graph_world import edge, errors, team

from groundfuse.backend import drift
from groundfuse.backend.graph import robot_estimate
from groundfuse.backend.measurement import FrameId, Se2


def test_loops_improve_on_the_chain():
    # Of 20 trajectories of 60 frames: optimising is worse in a few, by chance, but not in the mean.
    chained, optimised = [], []
    for seed in range(20):
        world = team(seed, robots=2, frames=60, loops=12, overlaps=2)
        truth = {f: Se2(*map(float, p)) for f, p in world.truth.items()}
        result = robot_estimate("B", world.frames, world.edges)
        assert {f.robot for f in result.chained} == {"B"}
        for poses, out in ((result.chained, chained), (result.optimised.team_from_base, optimised)):
            measured = drift.accuracy(poses, truth)
            assert measured is not None
            out.append(measured.ate_m)
    assert np.mean(optimised) < 0.7 * np.mean(chained)


def test_a_chain_alone_is_already_optimal():
    world = team(1, robots=1, frames=20, loops=0)
    result = robot_estimate("A", world.frames, world.edges)
    for f, pose in result.chained.items():
        assert result.optimised.team_from_base[f].vector() == pytest.approx(pose.vector(), abs=1e-9)
    assert result.optimised.degrees_of_freedom == 0
    assert max(np.abs(e).max() for e in errors(world, result.optimised).values()) < 1.0


def test_pieces_have_frames_of_their_own():
    names = [FrameId("A", k) for k in range(12)]
    steps = [edge(a, b, Se2(1.0, 0.0, 0.0)) for a, b in pairwise(names)]
    del steps[4]
    result = robot_estimate("A", names, steps)
    assert [result.fragment_of[f] for f in names] == [0] * 5 + [1] * 7
    assert result.chained[names[5]] == Se2(0.0, 0.0, 0.0)
    assert result.chained[names[11]].x_m == pytest.approx(6.0)


def test_a_robot_without_frames_is_refused():
    with pytest.raises(ValueError, match="robot C has no frame"):
        robot_estimate("C", [FrameId("A", 0)], [])


def test_one_frame_is_a_trajectory():
    result = robot_estimate("A", [FrameId("A", 7)], [])
    assert result.chained == {FrameId("A", 7): Se2(0.0, 0.0, 0.0)}
