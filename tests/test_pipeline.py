"""The stages in order: what each is given, what is kept, and how long it took."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from fused_world import (
    A,
    B,
    bundle_of,
    chain,
    edge,
    fused_of,
    odometry,
    rejected,
    robots_of,
    world,
)
from painted_team import PAIR, QUICK, SIGMA, painted_pair

from groundfuse.backend.bundle_estimate import BundleEstimate, BundleRefusal, Illposed
from groundfuse.backend.drift import accuracy
from groundfuse.backend.measurement import Attitude, FrameId, Reason, Se2
from groundfuse.tools import pipeline
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.pipeline import Stopwatch, fuse_robots
from groundfuse.tools.settings import with_settings
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.team_graphs import accepted_edges, odometry_edges
from groundfuse.tools.workers import silent

# a^-1 b of two poses of size 3 and back: a few eps; worst seen 4e-16.
EXACT = 1e-12
# Painted views at a third of the usual features: worst ATE over seeds 1 to 8 0.50 mm, heading
# 0.036 deg, tilt 0.063 deg; three times that.
PAINTED_M = 0.0015
PAINTED_RAD = math.radians(0.11)
PAINTED_TILT_RAD = math.radians(0.19)


@pytest.fixture
def truth():
    return world()


@pytest.fixture(scope="module")
def painted():
    options = with_settings(RunOptions(), QUICK)
    robots = read_team(painted_pair(), ["A", "B"])
    watch = Stopwatch()
    return fuse_robots(robots, options, 2, silent, watch), watch


# Time


def test_a_stopwatch_adds_and_keeps_the_order(monkeypatch):
    ticks = iter([0.0, 1.0, 10.0, 12.0, 20.0, 24.0])
    monkeypatch.setattr(pipeline.time, "perf_counter", lambda: next(ticks))
    watch = Stopwatch()
    for name in ("one", "two", "one"):
        with watch.stage(name):
            pass
    assert list(watch.seconds.items()) == [("one", 5.0), ("two", 2.0)]


def test_a_stage_within_another_counts_for_itself_only(monkeypatch):
    ticks = iter([0.0, 1.0, 4.0, 5.0, 6.0, 10.0])
    monkeypatch.setattr(pipeline.time, "perf_counter", lambda: next(ticks))
    watch = Stopwatch()
    with watch.stage("outer"):
        for name in ("inner", "other"):
            with watch.stage(name):
                pass
    assert watch.seconds == {"inner": 3.0, "other": 1.0, "outer": 6.0}


def test_a_stage_that_fails_is_timed_too():
    watch = Stopwatch()
    with pytest.raises(ValueError, match="no"), watch.stage("bad"):
        raise ValueError("no")
    assert watch.seconds["bad"] >= 0.0


# Odometry


def test_odometry_gives_the_steps_between_frames_that_both_have_it(truth):
    start = Se2(5.0, 1.0, -2.0)  # odometry has an origin of its own
    known = {f: odometry(start @ truth[f], 0.02, 0.003) for f in [*A[:3], *A[4:], B[0]]}
    edges = odometry_edges(robots_of([*A, *B], odometry=known))
    assert [(e.a, e.b) for e in edges] == [(A[0], A[1]), (A[1], A[2]), (A[4], A[5])]
    for e in edges:
        motion = truth[e.a].inverse() @ truth[e.b]
        assert e.a_from_b.vector() == pytest.approx(motion.vector(), abs=EXACT)
        assert e.covariance == pytest.approx(np.diag([4e-4, 4e-4, 9e-6]))
        assert e.correspondences is None
        assert e.num_inliers == 0


def test_a_steps_sigma_is_the_later_frames(truth):
    known = {A[0]: odometry(truth[A[0]], 0.5, 0.5), A[1]: odometry(truth[A[1]], 0.02, 0.003)}
    (step,) = odometry_edges(robots_of(A[:2], odometry=known))
    assert step.covariance[0, 0] == pytest.approx(4e-4)


def test_no_odometry_no_edges(truth):
    assert odometry_edges(robots_of([*A, *B])) == ()
    assert odometry_edges(robots_of(A[:1], odometry={A[0]: odometry(truth[A[0]])})) == ()


# What was used


def met(truth):
    pairs = ((A[0], A[5]), (A[1], B[0]), (A[3], B[2]), (A[2], B[1]))
    return [*chain(truth, A), *chain(truth, B), *(edge(truth, a, b) for a, b in pairs)]


def test_edges_are_used_or_turned_down(truth):
    wrong = edge(truth, A[4], B[3], Se2(0.5, 0.2, 0.3))
    edges = [wrong, *met(truth)]
    fused = fused_of(robots_of([*A, *B]), edges)
    assert accepted_edges(fused.team, fused.edges) == edges[1:]
    assert pipeline.used_edges(fused) == edges[1:]
    (down,) = pipeline.turned_down(fused.team)
    assert (down.a, down.b, down.reason) == (A[4], B[3], Reason.INCONSISTENT)
    assert down.value > down.limit > 0.0


def test_the_bundle_has_the_last_word_on_pictures_but_not_on_odometry(truth):
    known = {f: odometry(truth[f]) for f in A[:2]}
    robots, edges = robots_of([*A, *B], odometry=known), met(truth)
    plain = fused_of(robots, edges)
    assert pipeline.bundle_rejected(plain) == ()
    late = [rejected(A[0], A[1], Reason.RESIDUAL), rejected(A[3], B[2], Reason.RESIDUAL)]
    fused = fused_of(robots, edges, bundled=bundle_of(plain.team, rejected=late))
    used = pipeline.used_edges(fused)
    step = fused.edges[-1]
    assert step.correspondences is None
    assert step in used
    gone = {(r.a, r.b) for r in late}
    assert used == [e for e in fused.edges if e is step or (e.a, e.b) not in gone]


def test_the_best_is_the_bundle_where_there_is_one(truth):
    robots, edges = robots_of([*A, *B]), met(truth)
    plain = fused_of(robots, edges)
    assert plain.best is plain.team
    refusal = BundleRefusal(Illposed.SINGULAR, 0.0, 1.0, "no")
    refused = fused_of(robots, edges, bundled=refusal)
    assert refused.best is refused.team
    bundled = bundle_of(plain.team, attitude={A[1]: Attitude(0.5, 0.1, 0.6)})
    fused = fused_of(robots, edges, bundled=bundled)
    assert fused.best is bundled.team
    assert fused.attitude(A[1]) == Attitude(0.5, 0.1, 0.6)
    nominal = robots[0].frames[2].attitude
    assert fused.attitude(A[2]) == plain.attitude(A[1]) == nominal


def test_frames_know_their_robots_and_floors_that_repeat(truth):
    robots = robots_of([*B, *A])
    fused = fused_of(robots, met(truth), repetition={A[4]: 0.51, B[0]: 0.9, A[1]: 0.5})
    assert set(fused.frames) == {*A, *B}
    assert fused.frames[B[2]] == (robots[0], robots[0].frames[2])
    assert fused.repeating == [A[4], B[0]]


# From pictures


def test_two_painted_robots_become_one_map(painted):
    fused, watch = painted
    assert list(watch.seconds) == ["features", "retrieval", "pairs", "graphs", "patches", "bundle"]
    assert isinstance(fused.bundled, BundleEstimate)
    frames = {FrameId(n, k) for n, m in PAIR.items() for k in range(len(m.poses))}
    assert set(fused.best.team_from_base) == set(fused.front_end.repetition) == frames
    assert set(fused.best.component_of.values()) == {0}
    truth = {FrameId(n, k): p for n, m in PAIR.items() for k, p in enumerate(m.poses)}
    for estimate in (fused.team, fused.best):
        score = accuracy(estimate.team_from_base, truth)
        assert score.ate_m < PAINTED_M
        assert score.heading_rad < PAINTED_RAD
    for name in PAIR:
        assert accuracy(fused.alone[name].chained, truth).ate_m < PAINTED_M
    tried = [(r.a, r.b) for r in (*fused.front_end.edges, *fused.front_end.rejected)]
    assert len(set(tried)) == len(tried)
    steps = [(a, b) for a, b in itertools.pairwise(sorted(frames)) if a.robot == b.robot]
    assert set(steps) <= set(tried)
    assert fused.edges == fused.front_end.edges


def test_the_bundle_finds_the_attitudes_that_were_drawn(painted):
    fused, _ = painted
    for number, name in enumerate(PAIR):
        rng = np.random.default_rng([1, number])
        for k in range(len(PAIR[name].poses)):
            tilt, _, _ = rng.standard_normal(3).tolist()
            nominal = fused.frames[FrameId(name, k)][1].attitude.tilt_rad
            drawn = nominal + tilt * SIGMA.tilt_rad
            assert fused.attitude(FrameId(name, k)).tilt_rad == pytest.approx(
                drawn, abs=PAINTED_TILT_RAD
            )


def test_odometry_comes_after_the_pictures_edges():
    """The writer of pairs.csv takes the verdicts in this order."""
    robots = read_team(painted_pair(), ["A"])
    poses = dict(zip(robots[0].frames, PAIR["A"].poses, strict=True))
    frames = [replace(f, odometry=odometry(p)) for f, p in list(poses.items())[:2]]
    options = with_settings(RunOptions(), QUICK)
    robot = replace(robots[0], frames=tuple(frames))
    fused = fuse_robots([robot], options, 1, silent, Stopwatch(), bundled=False)
    (seen,) = fused.front_end.edges
    assert fused.edges[0] is seen
    assert seen.correspondences is not None
    assert [e.correspondences for e in fused.edges[1:]] == [None]
    assert [(v.a, v.b, v.accepted) for v in fused.team.verdicts] == [(A[0], A[1], True)] * 2


def test_no_bundle_where_none_is_wanted_or_none_is_possible():
    options = with_settings(RunOptions(), QUICK)
    robots = read_team(painted_pair(), ["A"])
    one = (replace(robots[0], frames=robots[0].frames[:1]),)
    watch = Stopwatch()
    assert fuse_robots(one, options, 1, silent, watch, bundled=False).bundled is None
    assert "bundle" not in watch.seconds
    refused = fuse_robots(one, options, 1, silent, Stopwatch()).bundled
    assert isinstance(refused, BundleRefusal)
    assert refused.reason is Illposed.NO_POINTS


def test_a_second_round_tries_what_the_poses_say_and_retrieval_did_not():
    """Retrieval names one frame each; every view shares floor with some that it did not name."""
    few = ("front_end.pairs.retrieval.num_frames=1", "front_end.pairs.retrieval.num_others=1")
    robots = read_team(painted_pair(), ["A", "B"])
    found = {}
    for rounds, most in (("one", 0), ("two", 3)):
        second = (
            f"front_end.pairs.predicted.num_frames={most}",
            "front_end.pairs.predicted.least_pairs=6",
            "front_end.pairs.predicted.least_overlap=0.25",
        )
        options = with_settings(RunOptions(), (*QUICK, *few, *second))
        found[rounds] = fuse_robots(robots, options, 2, silent, Stopwatch(), bundled=False)
    one, two = (
        {(e.a, e.b): e.a_from_b for e in found[rounds].front_end.edges} for rounds in ("one", "two")
    )
    assert found["one"].front_end.num_further == 0
    assert found["two"].front_end.num_further > 0
    assert set(one) < set(two)
    assert all(two[pair] == motion for pair, motion in one.items())
    assert list(two) == sorted(two)
    assert len(found["two"].edges) == len(found["two"].team.verdicts) == len(two)
    assert found["one"].key != found["two"].key
