"""The closing table says in lines for people what the records say in numbers."""

import math
import re

import pytest
from fused_world import (
    A,
    B,
    bundle_of,
    chain,
    edge,
    fused_of,
    rejected,
    robots_of,
    world,
)

from groundfuse.backend.bundle_estimate import BundleRefusal, Finding, FindingKind, Illposed
from groundfuse.backend.measurement import FrameId, Reason, Se2
from groundfuse.tools.closing_table import closing_table
from groundfuse.tools.drift_table import drift_record

SLIP = Se2(0.001, 0.0, 0.0007)
SECONDS = {"reading": 0.25, "pairs": 1.5}


@pytest.fixture
def truth():
    return world()


def table_of(fused, seconds=None):
    text = closing_table(fused, drift_record(fused), SECONDS if seconds is None else seconds)
    assert text.endswith("\n")
    assert all(len(line) <= 110 for line in text.splitlines())
    return text


def line_of(text, start):
    (line,) = [line for line in text.splitlines() if line.strip().startswith(start)]
    return line


def met(truth, error=SLIP):
    edges = [*chain(truth, A, error), *chain(truth, B, error), edge(truth, A[0], A[5])]
    return [*edges, *(edge(truth, a, b) for a, b in ((A[1], B[0]), (A[3], B[2]), (A[2], B[1])))]


def cells(line):
    """The columns of a drift line: metres and per cent, None for a dash."""
    found = []
    for cell in re.findall(r"(?:([\d.]+) (mm|m)(?: ([\d.]+) %)?|(-))(?:\s|$)", line[22:]):
        number, unit, percent, dash = cell
        if dash:
            found.append(None)
        else:
            metres = float(number) * (1e-3 if unit == "mm" else 1.0)
            found.append((metres, float(percent) if percent else None))
    assert len(found) == 3
    return found


def test_the_drift_lines_are_the_record(truth):
    robots = robots_of([*A, *B], truth)
    plain = fused_of(robots, met(truth))
    fused = fused_of(robots, met(truth), bundled=bundle_of(plain.team))
    text, record = table_of(fused), drift_record(fused)
    assert line_of(text, "drift").split() == ["drift", "chained", "optimised", "bundled"]
    for name, title, group, number, percent in (
        ("A", "A closing error", "closing", "error_m", "percent"),
        ("A", "A ATE against truth", "against_truth", "ate_m", "ate_percent"),
        ("B", "B ATE against truth", "against_truth", "ate_m", "ate_percent"),
    ):
        found = cells(line_of(text, title))
        for cell, stage in zip(found, ("chained", "optimised", "bundled"), strict=True):
            wanted = record["robots"][name][stage][group]
            assert cell[0] == pytest.approx(wanted[number], abs=0.0051e-3)
            assert cell[1] == pytest.approx(wanted[percent], abs=0.000051)
    assert "B closing error" not in text  # it closes no loop
    chained, optimised, bundled = cells(line_of(text, "team ATE"))
    ate_m = record["team"]["optimised"]["against_truth"]["ate_m"]
    assert chained is None
    assert optimised == bundled
    assert optimised[0] == pytest.approx(ate_m, abs=0.0051e-3)
    between = record["team"]["optimised"]["between_robots"]["rms_m"]
    assert cells(line_of(text, "between robots"))[1] == (pytest.approx(between, abs=6e-6), None)
    path = record["robots"]["A"]["optimised"]["path_m"]
    assert line_of(text, "A path") == f"A path {path:.2f} m, chain in 1 piece"


def test_right_pairs_are_counted_where_the_truth_is_known(truth):
    fused = fused_of(robots_of([*A, *B], truth), met(truth))
    pairs = drift_record(fused)["pairs"]
    line = line_of(table_of(fused), "accepted pairs right")
    form = (
        r"accepted pairs right against truth (\d+) of (\d+), median error ([\d.]+) mm, ([\d.]+) deg"
    )
    right, count, error_mm, error_deg = map(float, re.fullmatch(form, line).groups())
    assert (right, count) == (pairs["num_right"], pairs["num_pairs"])
    assert error_mm == pytest.approx(1e3 * pairs["median_error_m"], abs=0.0051)
    assert error_deg == pytest.approx(math.degrees(pairs["median_error_rad"]), abs=0.00051)


def test_without_truth_and_bundle_there_is_nothing_to_say_of_them(truth):
    text = table_of(fused_of(robots_of([*A, *B]), met(truth)))
    for word in ("truth", "team ATE", "between robots ", "bundle:"):
        assert word not in text
    assert cells(line_of(text, "A closing error"))[2] is None


def test_long_errors_are_in_metres(truth):
    far = {f: Se2(20.0 * p.x_m, 20.0 * p.y_m, p.theta_rad) for f, p in truth.items()}
    fused = fused_of(robots_of(A, truth), chain(far, A))
    found = cells(line_of(table_of(fused), "A ATE"))[0]
    assert found[0] == pytest.approx(
        drift_record(fused)["robots"]["A"]["chained"]["against_truth"]["ate_m"], abs=0.0005
    )
    assert 1.0 < found[0] < 9.0
    assert "mm" not in line_of(table_of(fused), "A ATE")[:43]


def test_anchors_stand_with_their_sigmas(truth):
    fused = fused_of(robots_of([*A, *B]), met(truth))
    text = table_of(fused)
    assert "team in 1 component; anchors (where each robot started)" in text
    reference, other = line_of(text, "A from A0"), line_of(text, "B from B0")
    assert reference.endswith("reference, 3 overlaps")
    anchor = fused.best.anchors[1]
    pose, sigma = anchor.team_from_map, [math.sqrt(anchor.covariance[k, k]) for k in range(3)]
    number = r"(-?[\d.]+)"
    form = rf"x +{number} y +{number} m +{number} deg  \+- {number} {number} mm {number} deg"
    found = [float(word) for word in re.search(form, other).groups()]
    turn, turn_sigma = math.degrees(pose.theta_rad), math.degrees(sigma[2])
    assert found == pytest.approx(
        [pose.x_m, pose.y_m, turn, 1e3 * sigma[0], 1e3 * sigma[1], turn_sigma], abs=0.0051
    )
    assert found[2] == pytest.approx(math.degrees(1.1 - 0.4), abs=0.5)
    assert other.endswith(", 3 overlaps")


def test_an_anchor_that_rests_on_one_overlap_says_so(truth):
    edges = [*chain(truth, A), *chain(truth, B), edge(truth, A[1], B[0])]
    text = table_of(fused_of(robots_of([*A, *B]), edges))
    assert line_of(text, "B from B0").endswith(", 1 overlap, RESTS ON ONE")


def test_parts_that_never_meet_are_all_named(truth):
    edges = [*chain(truth, A[:4]), *chain(truth, A[4:]), *chain(truth, B)]
    text = table_of(fused_of(robots_of([*A, *B]), edges))
    assert "team in 3 components" in text
    assert "component" not in line_of(text, "A from A0")
    assert line_of(text, "B from B0").endswith("reference, 0 overlaps [component 1]")
    assert line_of(text, "A from A4").endswith("reference, 0 overlaps [component 2]")
    assert line_of(text, "A path").endswith("chain in 2 pieces")


def test_answers_of_equal_support_are_listed_and_none_is_used(truth):
    """Two overlaps say here, two others say half a metre further: as on a floor that repeats."""
    shift = Se2(0.5, 0.0, 0.0)
    here = [edge(truth, A[1], B[0]), edge(truth, A[3], B[2])]
    moved = truth | {f: shift @ truth[f] for f in B}
    there = [edge(moved, a, b) for a, b in ((A[2], B[1]), (A[4], B[3]))]
    edges = [*chain(truth, A), *chain(truth, B), *here, *there]
    text = table_of(fused_of(robots_of([*A, *B]), edges))
    assert "team in 2 components" in text
    lines = text.splitlines()
    at = lines.index("ambiguous overlap 1: none of these answers was used")
    form = r"  B0 in A0: (-?[\d.]+) (-?[\d.]+) m (-?[\d.]+) deg, 2 overlaps"
    answers = (re.fullmatch(form, line) for line in lines[at + 1 : at + 3])
    found = sorted(tuple(map(float, answer.groups())) for answer in answers)
    wanted = []
    for poses in (truth, moved):
        pose = truth[A[0]].inverse() @ poses[B[0]]
        wanted.append((pose.x_m, pose.y_m, math.degrees(pose.theta_rad)))
    for one, two in zip(found, sorted(wanted), strict=True):
        assert one == pytest.approx(two, abs=0.0051)
    assert line_of(text, "undecided in the graph").split()[-1] == "4"


def test_pairs_are_counted_by_reason(truth):
    turned = [rejected(A[0], B[3]), rejected(A[0], B[2]), rejected(A[0], A[3], Reason.AMBIGUOUS)]
    wrong = edge(truth, A[4], B[3], Se2(0.5, 0.2, 0.3))
    robots, edges = robots_of([*A, *B]), [*met(truth), wrong]
    late = rejected(A[3], B[2], Reason.RESIDUAL, 0.1, 0.3)
    plain = fused_of(robots, edges, turned)
    fused = fused_of(robots, edges, turned, bundled=bundle_of(plain.team, rejected=[late]))
    text = table_of(fused)
    count = len(edges)
    assert f"pairs tried {count + 3}: accepted {count} (4 between robots), rejected 3" in text
    listed = {}
    for line in text.splitlines():
        found = re.fullmatch(r"  (\w+(?: in the \w+)?) +(\d+)", line)
        if found:
            listed[found[1]] = int(found[2])
    assert listed == {
        "few_inliers": 2,
        "ambiguous": 1,
        "inconsistent in the graph": 1,
        "residual in the bundle": 1,
    }
    freedom = fused.team.degrees_of_freedom
    ratio = fused.team.chi2 / freedom
    assert f"pose graph chi2 {fused.team.chi2:.1f} over {freedom} ({ratio:.2f} each)" in text


def test_a_graph_without_freedom_has_no_chi2(truth):
    assert "chi2" not in table_of(fused_of(robots_of(A), chain(truth, A)))


def test_the_bundle_tells_its_findings_or_why_there_is_none(truth):
    robots, edges = robots_of([*A, *B]), met(truth)
    finding = Finding(FindingKind.SCALE, ("A",), 0.007, "the scale comes from the heights")
    bundled = bundle_of(fused_of(robots, edges).team, findings=[finding])
    text = table_of(fused_of(robots, edges, bundled=bundled))
    assert "bundle: 42 floor points, residual 0.123 px, 2 of 60 correspondences cut" in text
    assert "  the scale comes from the heights" in text
    refusal = BundleRefusal(Illposed.NO_POINTS, 3.0, 8.0, "3 correspondences in all")
    text = table_of(fused_of(robots, edges, bundled=refusal))
    assert "no bundle (no_points): 3 correspondences in all" in text


def test_a_floor_that_repeats_is_said_aloud(truth):
    share = {A[2]: 0.9, B[1]: 0.51, A[3]: 0.49}
    fused = fused_of(
        robots_of([*A, *B]), met(truth), [rejected(A[0], A[4], Reason.AMBIGUOUS)], share
    )
    text = table_of(fused)
    assert "THE FLOOR REPEATS itself in 2 of 10 frames, first in A2" in text
    assert "  1 pair could lie in several ways and stayed out; odometry in frames.csv" in text
    quiet = fused_of(robots_of([*A, *B]), met(truth), repetition=share)
    assert "several ways" not in table_of(quiet)
    assert "REPEATS" not in table_of(fused_of(robots_of([*A, *B]), met(truth)))


def test_one_picture_makes_a_table():
    text = table_of(fused_of(robots_of([FrameId("A", 0)]), []))
    assert "pairs tried 0: accepted 0 (0 between robots), rejected 0" in text
    assert line_of(text, "A from A0").endswith("reference, 0 overlaps")
    assert line_of(text, "A path") == "A path 0.00 m, chain in 1 piece"


def test_seconds_stand_at_the_end(truth):
    text = table_of(fused_of(robots_of(A), chain(truth, A)))
    assert text.splitlines()[-1] == "seconds 1.8: reading 0.2, pairs 1.5"
