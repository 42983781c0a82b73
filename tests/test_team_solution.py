"""Components as arrays, consistency, who holds a team together, names with gaps, scores."""

from itertools import pairwise

import numpy as np
import pytest
from graph_world import edge, team

from groundfuse.backend import planar
from groundfuse.backend.certificate import Status
from groundfuse.backend.measurement import Answer, FrameId, Se2
from groundfuse.backend.problem import chi2_per_edge
from groundfuse.backend.renamed import fuse_counted
from groundfuse.backend.report import distinct_answers
from groundfuse.backend.team import fuse
from groundfuse.backend.team_score import score
from groundfuse.backend.team_shape import bridges, frames_by_robot
from groundfuse.backend.team_solution import as_rows, consistency, residuals_of, solutions

# chi2 of the same poses summed in another order; worst seen 3e-15 relative.
SAME = 1e-10


def straight(robot, count):
    names = [FrameId(robot, k) for k in range(count)]
    return [edge(a, b, Se2(1.0, 0.0, 0.0)) for a, b in pairwise(names)]


def meet(one, two, k=0, y_m=1.0):
    return edge(FrameId(one, k), FrameId(two, k), Se2(0.0, y_m, 0.0))


def fused(edges):
    return fuse(sorted({f for e in edges for f in (e.a, e.b)}), edges)


def test_components_add_up_to_the_estimate():
    world = team(3, robots=3, frames=20, overlaps=6, wrong_overlaps=0.34)
    lone = straight("Z", 4)
    edges = [*world.edges, *lone]
    estimate = fuse([*world.frames, *(FrameId("Z", k) for k in range(4))], edges)
    parts = solutions(edges, estimate)
    assert [p.component for p in parts] == [0, 1]
    assert sum(len(p.frames) for p in parts) == len(estimate.team_from_base)
    assert sum(p.chi2 for p in parts) == pytest.approx(estimate.chi2, rel=SAME)
    assert sum(p.degrees_of_freedom for p in parts) == estimate.degrees_of_freedom
    assert parts[0].certificate().status is Status.CERTIFIED
    accepted = [v.chi2 for v in estimate.verdicts if v.accepted]
    found = np.concatenate([chi2_per_edge(p.problem, p.poses) for p in parts])
    assert sorted(found) == pytest.approx(sorted(accepted), rel=SAME, abs=1e-12)


def test_residuals_are_the_misclosure_at_the_second_frame():
    edges = [*straight("A", 2), edge(FrameId("A", 0), FrameId("A", 1), Se2(1.0, 0.02, 0.0))]
    edges += straight("B", 2)
    estimate = fused(edges)
    first, second, other = residuals_of(edges, estimate)
    # Two equal measurements meet half way; the heading moves with y by nothing (diagonal noise).
    assert first == pytest.approx([0.0, 0.01, 0.0], abs=1e-6)
    assert second == pytest.approx([0.0, -0.01, 0.0], abs=1e-6)
    assert other == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    assert residuals_of([], estimate) == []


def test_an_edge_between_components_has_no_residual():
    lie = edge(FrameId("A", 0), FrameId("A", 9), Se2(0.0, 5.0, 2.0))
    edges = [*straight("A", 10), lie, meet("A", "B"), meet("A", "B", 0, 4.0)]
    estimate = fused(edges)
    assert set(estimate.component_of.values()) == {0, 1}
    error = residuals_of(edges, estimate)
    assert [e is None for e in error[-2:]] == [True, True]
    assert error[-3] is not None


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1.0, "consistent with the covariances"),
        (0.1, "residuals only 0."),
        (10.0, "INCONSISTENT: residuals "),
    ],
)
def test_consistency_is_told_by_chi2(scale, words):
    world = team(5, frames=60, loops=40, overlaps=30)
    estimate = fuse(world.frames, world.edges)
    (part,) = solutions(world.edges, estimate)
    wider = part.problem.weighted(np.full(len(part.problem), scale**2))
    (scaled,) = (type(part)(0, part.frames, wider, part.poses),)
    found = consistency(scaled)
    assert found.verdict.startswith(words)
    assert found.chi2 == pytest.approx(scale**2 * estimate.chi2, rel=1e-6)
    assert found.below + found.above == pytest.approx(1.0)


def test_a_chain_has_nothing_to_compare():
    edges = straight("A", 3)
    (part,) = solutions(edges, fused(edges))
    assert consistency(part).verdict == "nothing to compare"


def test_bridges_are_the_robots_that_others_hang_on():
    edges = [e for robot in "ABCD" for e in straight(robot, 4)]
    links = [meet("A", "B"), meet("A", "B", 3), meet("B", "C"), meet("B", "C", 3)]
    assert bridges(fused([*edges, *links])) == ("B",)
    chain = [*links, meet("C", "D"), meet("C", "D", 3)]
    assert bridges(fused([*edges, *chain])) == ("B", "C")
    ring = [*chain, meet("D", "A", 0, -3.0), meet("D", "A", 3, -3.0)]
    assert bridges(fused([*edges, *ring])) == ()
    assert frames_by_robot([FrameId("B", 0), FrameId("A", 0), FrameId("A", 1)]) == {"A": 2, "B": 1}


def test_gaps_in_the_numbers_do_not_matter():
    world = team(2, frames=15, loops=3, overlaps=6, wrong_overlaps=0.34)
    plain = fuse(world.frames, world.edges)

    def far(f):
        return FrameId(f.robot, 5 + 10 * f.index)

    edges = [type(e)(far(e.a), far(e.b), e.a_from_b, e.covariance) for e in world.edges]
    other = fuse_counted([far(f) for f in world.frames], edges)
    assert other.team_from_base == {far(f): p for f, p in plain.team_from_base.items()}
    assert [a.first for a in other.anchors] == [far(a.first) for a in plain.anchors]
    assert [(v.a, v.chi2) for v in other.verdicts] == [(far(v.a), v.chi2) for v in plain.verdicts]
    assert other.component_of == {far(f): n for f, n in plain.component_of.items()}
    assert other.covariance.keys() == {far(f) for f in plain.covariance}


def test_names_with_gaps_come_back_in_ambiguous_answers():
    world = team(1, frames=40, overlaps=12, wrong_overlaps=0.5, consistent=True)

    def far(f):
        return FrameId(f.robot, 7 * f.index)

    edges = [type(e)(far(e.a), far(e.b), e.a_from_b, e.covariance) for e in world.edges]
    (found,) = fuse_counted([far(f) for f in world.frames], edges).ambiguities
    assert {w.a for w in found.answers} | {w.b for w in found.answers} <= set(
        map(far, world.frames)
    )
    assert len(found.answers) == 2


def answer(support, x_m):
    return Answer(FrameId("A", 0), FrameId("B", 0), Se2(x_m, 0.0, 0.0), support)


def test_answers_by_the_same_overlaps_are_one():
    """A rival that takes a few overlaps less lies in the same place; the larger one speaks."""
    few, many, other = answer(3, 1.0), answer(5, 1.01), answer(4, 7.0)
    found = [
        (np.array([1, 2, 3]), few),
        (np.array([0, 1, 2, 3, 4]), many),
        (np.array([4, 6, 7, 8]), other),
    ]
    assert distinct_answers(found) == (many, other)
    assert distinct_answers(found[:2]) == (many,)
    assert distinct_answers([]) == ()


def test_scores_count_what_is_wrong_and_what_was_refused():
    world = team(4, robots=3, frames=40, overlaps=12, wrong_overlaps=0.34, wrong_loops=0.2)
    estimate = fuse(world.frames, world.edges)
    truth = {f: planar.pose(p) for f, p in world.truth.items()}
    unknown = score(world.edges, estimate, truth, [None] * len(world.edges))
    known = score(world.edges, estimate, truth, world.wrong)
    assert unknown == known
    assert known.wrong == sum(world.wrong) > 0
    assert known.judged == len(world.edges)
    refused = [not v.accepted for v in estimate.verdicts]
    assert known.refused == sum(refused)
    assert known.both == sum(w and r for w, r in zip(world.wrong, refused, strict=True))
    # 40 steps of 2 cm and 0.3 deg dead reckoned are some 0.3 m off; fused less; worst seen 0.04.
    assert known.accuracy[0].ate_m < 0.1
    assert (known.anchors_right, known.anchors) == (2, 2)


def test_a_displaced_truth_is_seen_by_anchors_and_errors():
    world = team(4, robots=2, frames=30, overlaps=12)
    estimate = fuse(world.frames, world.edges)
    truth = {f: planar.pose(p) for f, p in world.truth.items()}
    moved = {f: Se2(p.x_m + 3.0 * (f.robot == "B"), p.y_m, p.theta_rad) for f, p in truth.items()}
    found = score(world.edges, estimate, moved, [None] * len(world.edges))
    assert (found.anchors_right, found.anchors) == (0, 1)
    assert found.wrong == 12
    assert found.between[0].rms_m == pytest.approx(3.0, abs=0.2)


def test_labels_need_no_truth():
    edges = straight("A", 3)
    found = score(edges, fused(edges), {}, [True, None])
    assert (found.wrong, found.judged, found.accuracy, found.anchors) == (1, 1, {}, 0)


def test_covariances_are_told_by_their_upper_triangle():
    assert as_rows(np.arange(9.0).reshape(3, 3)) == [0, 1, 2, 4, 5, 8]
