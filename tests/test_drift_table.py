"""Drift in numbers, of teams whose errors are known by construction."""

import math

import pytest
from fused_world import A, B, bundle_of, chain, edge, fused_of, robots_of, world

from groundfuse.backend.drift import path_length_m
from groundfuse.backend.measurement import IDENTITY, FrameId, Se2
from groundfuse.tools.drift_table import drift_record

# Sums of a few doubles of size 3, iterated to convergence; worst seen 2e-13 m.
EXACT = 1e-9
SLIP = Se2(0.001, 0.0, 0.0007)
"""Every step errs alike, well within its sigma: the chain bends away."""


@pytest.fixture
def truth():
    return world()


def loops(truth):
    return [edge(truth, A[0], A[5], sigma=0.1), edge(truth, A[0], A[3], sigma=0.1)]


def overlaps(truth):
    pairs = ((A[1], B[0]), (A[3], B[2]), (A[2], B[1]), (A[5], B[3]))
    return [edge(truth, a, b, sigma=0.1) for a, b in pairs]


def slipped(truth):
    return [*chain(truth, A, SLIP), *chain(truth, B, SLIP), *loops(truth), *overlaps(truth)]


def test_without_errors_every_error_is_zero(truth):
    edges = [*chain(truth, A), *chain(truth, B), *loops(truth), *overlaps(truth)]
    record = drift_record(fused_of(robots_of([*A, *B], truth), edges))
    assert record["has_ground_truth"] is True
    assert set(record["robots"]) == {"A", "B"}
    for name, frames in (("A", A), ("B", B)):
        assert set(record["robots"][name]) == {"chained", "optimised"}
        path_m = path_length_m({f: truth[f] for f in frames})
        for row in record["robots"][name].values():
            assert row["num_pieces"] == 1
            assert row["num_frames"] == row["num_frames_in_all"] == len(frames)
            assert row["path_m"] == pytest.approx(path_m)
            assert row["against_truth"]["ate_m"] < EXACT
            assert row["against_truth"]["num_frames"] == len(frames)
    loop = record["robots"]["A"]["chained"]["closing"]
    assert (loop["first"], loop["last"]) == ("A0", "A5")
    assert loop["error_m"] < EXACT
    assert record["robots"]["B"]["chained"]["closing"] is None
    whole = record["team"]["optimised"]
    assert whole["num_frames"] == len(A) + len(B)
    assert whole["against_truth"]["ate_m"] < EXACT
    assert whole["between_robots"]["rms_m"] < EXACT
    assert whole["between_robots"]["num_pairs"] == len(A) * len(B)


def test_the_chain_drifts_as_its_steps_err_and_the_loop_takes_it_back(truth):
    record = drift_record(fused_of(robots_of([*A, *B], truth), slipped(truth)))
    row = record["robots"]["A"]
    # The closing error of the chain, from the steps alone.
    pose = Se2(0.0, 0.0, 0.0)
    for a, b in zip(A, A[1:]):  # noqa: B905, RUF007
        pose = pose @ (truth[a].inverse() @ truth[b] @ SLIP)
    last = truth[A[0]].inverse() @ truth[A[5]]
    error_m = math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
    loop = row["chained"]["closing"]
    assert loop["error_m"] == pytest.approx(error_m, abs=EXACT)
    assert loop["error_rad"] == pytest.approx(5 * SLIP.theta_rad, abs=EXACT)
    assert loop["percent"] == pytest.approx(100.0 * error_m / loop["path_m"])
    assert loop["path_m"] == pytest.approx(row["chained"]["path_m"])
    # The loop is ten times surer than a step, and 100 times as heavy: little is left.
    assert row["optimised"]["closing"]["error_m"] < 0.05 * error_m
    for name in ("A", "B"):
        drift = record["robots"][name]
        ate = drift["optimised"]["against_truth"]["ate_m"]
        assert ate < 0.5 * drift["chained"]["against_truth"]["ate_m"]


def test_the_bundle_is_a_stage_where_there_is_one(truth):
    robots = robots_of([*A, *B], truth)
    plain = fused_of(robots, slipped(truth))
    start = truth[A[0]].inverse()
    poses = {f: start @ truth[f] for f in [*A, *B]}
    fused = fused_of(robots, slipped(truth), bundled=bundle_of(plain.team, poses=poses))
    record = drift_record(fused)
    assert list(record["robots"]["A"]) == ["chained", "optimised", "bundled"]
    assert list(record["team"]) == ["optimised", "bundled"]
    assert record["robots"]["A"]["bundled"]["against_truth"]["ate_m"] < EXACT
    assert record["team"]["bundled"]["against_truth"]["ate_m"] < EXACT
    assert record["team"]["bundled"]["between_robots"]["rms_m"] < EXACT
    before = drift_record(plain)
    assert record["team"]["optimised"] == before["team"]["optimised"]
    assert record["robots"]["A"]["optimised"] == before["robots"]["A"]["optimised"]
    assert list(before["team"]) == ["optimised"]


def test_accepted_pairs_are_scored_by_the_camera_height(truth):
    """Right within 30 mm at 0.55 m: the last two err by 25 and 35 mm."""
    edges = [*chain(truth, A), *chain(truth, B), *overlaps(truth)]
    shifts = {A[4]: Se2(0.0, 0.025, 0.0), A[5]: Se2(0.0, 0.035, 0.0)}
    off = [edge(truth, A[0], b, shift, sigma=30.0) for b, shift in shifts.items()]
    pairs = drift_record(fused_of(robots_of([*A, *B], truth), [*edges, *off]))["pairs"]
    assert (pairs["num_pairs"], pairs["num_right"]) == (len(edges) + 2, len(edges) + 1)
    assert pairs["median_error_m"] < EXACT
    assert drift_record(fused_of(robots_of([*A, *B]), edges))["pairs"] is None


def test_nothing_is_claimed_without_ground_truth(truth):
    record = drift_record(fused_of(robots_of([*A, *B]), slipped(truth)))
    assert record["has_ground_truth"] is False
    for stages in record["robots"].values():
        assert all(row["against_truth"] is None for row in stages.values())
    assert record["team"]["optimised"]["against_truth"] is None
    assert record["team"]["optimised"]["between_robots"] is None
    assert record["robots"]["A"]["chained"]["closing"] is not None


def test_truth_of_one_robot_scores_that_one(truth):
    known = {f: truth[f] for f in A}
    record = drift_record(fused_of(robots_of([*A, *B], known), slipped(truth)))
    assert record["has_ground_truth"] is True
    assert record["robots"]["A"]["chained"]["against_truth"]["num_frames"] == len(A)
    assert record["robots"]["B"]["chained"]["against_truth"] is None
    assert record["team"]["optimised"]["against_truth"]["num_frames"] == len(A)
    assert record["team"]["optimised"]["between_robots"] is None


def test_a_cut_chain_counts_its_pieces_and_scores_the_longest(truth):
    edges = [*chain(truth, A[:2]), *chain(truth, A[2:], SLIP)]
    row = drift_record(fused_of(robots_of(A, truth), edges))["robots"]["A"]["chained"]
    assert (row["num_pieces"], row["num_frames"], row["num_frames_in_all"]) == (2, 4, 6)
    assert row["against_truth"]["num_frames"] == 4
    assert row["against_truth"]["ate_m"] > 1e-4
    assert row["path_m"] == pytest.approx(path_length_m({f: truth[f] for f in A[2:]}), abs=0.02)
    assert row["closing"] is None


def test_the_team_that_falls_apart_is_scored_on_its_largest_part(truth):
    """B drove further, but A has more frames."""
    record = drift_record(
        fused_of(robots_of([*A, *B], truth), [*chain(truth, A), *chain(truth, B, SLIP)])
    )
    assert record["team"]["optimised"]["num_frames"] == len(A)
    assert record["team"]["optimised"]["against_truth"]["ate_m"] < EXACT
    assert record["team"]["optimised"]["between_robots"] is None
    assert record["robots"]["B"]["optimised"]["num_frames"] == len(B)
    assert record["robots"]["B"]["optimised"]["against_truth"]["ate_m"] > 1e-4


def test_a_turned_down_pair_closes_no_loop(truth):
    wrong = edge(truth, A[0], A[5], Se2(0.4, 0.1, 0.0))
    edges = [*chain(truth, A), edge(truth, A[1], A[4]), wrong]
    row = drift_record(fused_of(robots_of(A, truth), edges))["robots"]["A"]
    assert (row["chained"]["closing"]["first"], row["chained"]["closing"]["last"]) == ("A1", "A4")
    assert row["chained"]["closing"]["error_m"] < EXACT


def test_one_picture(truth):
    record = drift_record(fused_of(robots_of(A[:1], truth), []))
    for row in record["robots"]["A"].values():
        assert (row["num_pieces"], row["num_frames"], row["path_m"]) == (1, 1, 0.0)
        assert row["closing"] is row["against_truth"] is None
    assert record["team"]["optimised"]["path_m"] == 0.0


def test_a_robot_that_stood_still_has_no_percentage():
    poses = {FrameId("A", k): IDENTITY for k in range(3)}
    edges = [*chain(poses, list(poses)), edge(poses, A[0], A[2])]
    row = drift_record(fused_of(robots_of(list(poses), poses), edges))["robots"]["A"]["chained"]
    assert row["closing"]["error_m"] < EXACT
    assert math.isinf(row["closing"]["percent"])
    assert math.isinf(row["against_truth"]["ate_percent"])
