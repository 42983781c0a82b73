"""The report of fuse_graphs: what was found, for people."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from groundfuse.backend.certificate import Certificate, Status
from groundfuse.backend.measurement import Anchor, EdgeKind, TeamEstimate
from groundfuse.backend.team_graph import TeamGraph
from groundfuse.backend.team_score import Score
from groundfuse.backend.team_shape import bridges, frames_by_robot
from groundfuse.backend.team_solution import Solution, consistency
from groundfuse.tools.graph_outputs import Relative, verdict_word

MOST = 40  # lines of one kind


@dataclass(frozen=True, slots=True, eq=False)
class GraphRun:
    """Everything that fuse_graphs found.

    Attributes:
        team: what was read.
        estimate: what it was fused to.
        parts: its components.
        certificates: of components with more than one frame.
        relative: pairs of frames that were asked for.
        score: against truth, where it is known.
    """

    team: TeamGraph
    estimate: TeamEstimate
    parts: tuple[Solution, ...]
    certificates: dict[int, Certificate]
    relative: tuple[Relative, ...]
    score: Score | None


def report(run: GraphRun, seconds: Mapping[str, float]) -> str:
    """Return the text that ends the command and is kept as report.txt."""
    parts = [
        _robot_lines(run),
        *(_component_lines(run, part) for part in run.parts[:MOST]),
        _left_out(run),
        _edge_lines(run),
        _warning_lines(run),
        _ambiguity_lines(run.estimate),
        [line for one in run.relative for line in relative_lines(one)],
        _score_lines(run.score),
        list(run.team.notes),
        _time_lines(seconds),
    ]
    return "\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"


def count(number: int, noun: str) -> str:
    """Return `1 frame`, `2 frames`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _robot_lines(run: GraphRun) -> list[str]:
    sizes = frames_by_robot(run.team.frames)
    pieces = Counter(anchor.robot for anchor in run.estimate.anchors)
    frames, edges = count(len(run.team.frames), "frame"), count(len(run.team.edges), "edge")
    parts = count(len(run.parts), "component")
    lines = [f"{count(len(sizes), 'robot')}, {frames}, {edges}: {parts}"]
    for robot, number in list(sizes.items())[:MOST]:
        inside = sorted({a.component for a in run.estimate.anchors if a.robot == robot})
        where = ", ".join(map(str, inside[:5])) + (", ..." if len(inside) > 5 else "")
        chain = f", trajectory in {count(pieces[robot], 'piece')}" if pieces[robot] > 1 else ""
        plural = "component" if len(inside) == 1 else "components"
        lines.append(f"  {robot}: {count(number, 'frame')}{chain}, {plural} {where}")
    if len(sizes) > MOST:
        lines.append(f"  and {len(sizes) - MOST} more")
    return lines


def _component_lines(run: GraphRun, part: Solution) -> list[str]:
    robots = len({frame.robot for frame in part.frames})
    size = f"{count(len(part.frames), 'frame')} of {count(robots, 'robot')}"
    lines = [f"component {part.component}: {size}, in the frame of {part.frames[0]}"]
    if len(part.frames) > 1:
        found = consistency(part)
        freedom = found.degrees_of_freedom
        each = f" ({found.chi2 / freedom:.3f} each)" if freedom else ""
        lines.append(f"  chi2 {found.chi2:.6g} over {freedom}{each}: {found.verdict}")
        lines.append(f"  {certificate_line(run.certificates[part.component])}")
    anchors = [a for a in run.estimate.anchors if a.component == part.component]
    lines += [_anchor_line(anchor) for anchor in anchors[:MOST]]
    if len(anchors) > MOST:
        lines.append(f"  and {len(anchors) - MOST} more anchors")
    return lines


def certificate_line(proof: Certificate) -> str:
    """Return what is proven, in words."""
    bound = f"chi2 {proof.chi2:.6g}, proven bound {proof.lower_bound:.6g}"
    match proof.status:
        case Status.CERTIFIED:
            return f"certified: no other solution is better ({bound})"
        case Status.SURROGATE:
            place = f"distance {proof.distance_m:.3g} m"
            return (
                f"certified surrogate, {place}: the optimum with even weights lies there ({bound})"
            )
        case _:
            return f"not certified: a better solution may exist ({bound})"


def _anchor_line(anchor: Anchor) -> str:
    pose = anchor.team_from_map
    where = f"x {pose.x_m:.4f} y {pose.y_m:.4f} m {math.degrees(pose.theta_rad):.3f} deg"
    name = f"{anchor.robot} from {anchor.first}"
    if anchor.covariance is None:
        return f"  anchor {name}: {where}, the reference"
    x, y, turn = (math.sqrt(anchor.covariance[k, k]) for k in range(3))
    sigma = f"+- {x:.4f} {y:.4f} m {math.degrees(turn):.3f} deg"
    tail = f", {count(anchor.num_overlaps, 'overlap')}"
    if anchor.rests_on_one:
        tail += ", RESTS ON A SINGLE EDGE"
    return f"  anchor {name}: {where} {sigma}{tail}"


def _left_out(run: GraphRun) -> list[str]:
    more = len(run.parts) - MOST
    return [f"and {count(more, 'smaller component')}, see poses.csv"] if more > 0 else []


def _edge_lines(run: GraphRun) -> list[str]:
    found = Counter((v.kind, verdict_word(v)) for v in run.estimate.verdicts)
    lines = []
    for kind, name in (
        (EdgeKind.CHAIN, "steps"),
        (EdgeKind.LOOP, "loops"),
        (EdgeKind.OVERLAP, "overlaps"),
    ):
        words = [f"{found[kind, w]} {w.replace('_', ' ')}" for w in ("accepted", "turned_down")]
        if found[kind, "open"]:
            words.append(f"{found[kind, 'open']} open")
        if any(found[kind, w] for w in ("accepted", "turned_down", "open")):
            lines.append(f"{name}: {', '.join(words)}")
    return lines


def _warning_lines(run: GraphRun) -> list[str]:
    lines = []
    single = [robot for robot, n in frames_by_robot(run.team.frames).items() if n == 1]
    if single:
        lines.append(f"robots with one frame: {_list(single)}")
    hanging = sorted({a.robot for a in run.estimate.anchors if a.rests_on_one})
    if hanging:
        lines.append(f"resting on a single edge, which nothing confirms: {_list(hanging)}")
    between = bridges(run.estimate)
    if between:
        lines.append(f"bridge robots, without which others part: {_list(between)}")
    return lines


def _list(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST]) + (f" and {len(names) - MOST} more" if len(names) > MOST else "")


def _ambiguity_lines(estimate: TeamEstimate) -> list[str]:
    lines: list[str] = []
    for ambiguity in estimate.ambiguities[:MOST]:
        one = ambiguity.answers[0]
        lines.append(f"AMBIGUOUS: {one.b} could lie in several ways in {one.a}; none was used")
        for answer in ambiguity.answers:
            z = answer.a_from_b
            where = f"x {z.x_m:.3f} y {z.y_m:.3f} m {math.degrees(z.theta_rad):.2f} deg"
            lines.append(f"  {where}, by {count(answer.support, 'overlap')}")
        if len(ambiguity.answers) == 1:
            lines.append("  or elsewhere, by overlaps with other robots")
    return lines


def relative_lines(one: Relative) -> list[str]:
    """Return the pose of one frame in another, with its covariance."""
    if one.a_from_b is None or one.covariance is None:
        return [f"{one.b} in {one.a}: unknown, their components are not connected"]
    z, sigma = one.a_from_b, one.covariance.diagonal() ** 0.5
    where = f"x {z.x_m:.6f} y {z.y_m:.6f} m {math.degrees(z.theta_rad):.5f} deg"
    spread = f"+- {sigma[0]:.6f} {sigma[1]:.6f} m {math.degrees(sigma[2]):.5f} deg"
    rows = [" ".join(f"{value: .6e}" for value in row) for row in one.covariance]
    head = "  covariance, order x y theta, m and rad, tangent at the second:"
    return [f"{one.b} in {one.a}: {where} {spread}", head, *(f"    {row}" for row in rows)]


def _score_lines(score: Score | None) -> list[str]:
    if score is None:
        return []
    lines = ["against truth"]
    for number, found in list(score.accuracy.items())[:MOST]:
        ate = f"ATE {found.ate_m:.4f} m ({found.ate_percent:.4f} % of {found.path_m:.1f} m)"
        line = f"  component {number}: {ate}, heading {math.degrees(found.heading_rad):.3f} deg"
        if number in score.between:
            apart = score.between[number]
            turn = math.degrees(apart.rms_rad)
            line += f"; between robots {apart.rms_m:.4f} m {turn:.3f} deg"
        lines.append(line)
    if score.anchors:
        lines.append(f"  anchors within 3 sigma: {score.anchors_right} of {score.anchors}")
    if score.judged:
        recall = f"{score.both} of {score.wrong} wrong edges kept out"
        lines.append(f"  {recall}; {score.both} of {score.refused} kept out are wrong")
    return lines


def _time_lines(seconds: Mapping[str, float]) -> list[str]:
    total = sum(seconds.values())
    stages = ", ".join(f"{name} {value:.2f}" for name, value in seconds.items())
    return [f"seconds {total:.2f}: {stages}"]
