"""The closing table: what the main job found, for people."""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

from groundfuse.backend.bundle_estimate import BundleEstimate, BundleRefusal
from groundfuse.backend.measurement import Anchor, Reason
from groundfuse.tools.pipeline import Fused, bundle_rejected, turned_down


def closing_table(fused: Fused, drift: Mapping[str, Any], seconds: Mapping[str, float]) -> str:
    """Return the text that ends the command and is kept as report.txt."""
    parts = [
        _drift_lines(drift),
        _anchor_lines(fused),
        _pair_lines(fused),
        _bundle_lines(fused),
        _warning_lines(fused),
        _time_lines(seconds),
    ]
    return "\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"


def _length(value_m: float) -> str:
    return f"{value_m * 1e3:.2f} mm" if value_m < 1.0 else f"{value_m:.3f} m"


def _drift_lines(drift: Mapping[str, Any]) -> list[str]:
    lines = [f"{'drift':<22}{'chained':>21}{'optimised':>21}{'bundled':>21}"]
    for name, stages in drift["robots"].items():
        path = stages["optimised"]["path_m"]
        rows = (
            (f"{name} closing error", "closing", "error_m", "percent"),
            (f"{name} ATE against truth", "against_truth", "ate_m", "ate_percent"),
        )
        for title, group, error, percent in rows:
            lines += _row(title, stages, group, error, percent)
        pieces = stages["chained"]["num_pieces"]
        lines.append(f"{name} path {path:.2f} m, chain in {_count(pieces, 'piece')}")
    lines += _row("team ATE", drift["team"], "against_truth", "ate_m", "ate_percent")
    lines += _row("between robots", drift["team"], "between_robots", "rms_m", None)
    pairs = drift.get("pairs")
    if pairs is not None:
        share = f"{pairs['num_right']} of {pairs['num_pairs']}"
        middle = (
            f"{_length(pairs['median_error_m'])}, {math.degrees(pairs['median_error_rad']):.3f} deg"
        )
        lines.append(f"accepted pairs right against truth {share}, median error {middle}")
    return lines


def _row(
    title: str, stages: Mapping[str, Any], group: str, error: str, percent: str | None
) -> list[str]:
    cells = []
    for stage in ("chained", "optimised", "bundled"):
        found = stages.get(stage, {}).get(group)
        cell = "-"
        if found is not None:
            cell = _length(found[error])
            if percent is not None and math.isfinite(found[percent]):
                cell += f" {found[percent]:.4f} %"
        cells.append(cell)
    if set(cells) == {"-"}:
        return []
    return [f"{title:<22}" + "".join(f"{cell:>21}" for cell in cells)]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _anchor_lines(fused: Fused) -> list[str]:
    best = fused.best
    components = len(set(best.component_of.values()))
    lines = [f"team in {_count(components, 'component')}; anchors (where each robot started)"]
    lines += [_anchor_line(anchor) for anchor in best.anchors]
    for k, ambiguity in enumerate(best.ambiguities):
        lines.append(f"ambiguous overlap {k + 1}: none of these answers was used")
        for answer in ambiguity.answers:
            z = answer.a_from_b
            lines.append(
                f"  {answer.b} in {answer.a}: {z.x_m:.3f} {z.y_m:.3f} m "
                f"{math.degrees(z.theta_rad):.2f} deg, {_count(answer.support, 'overlap')}"
            )
    return lines


def _anchor_line(anchor: Anchor) -> str:
    pose = anchor.team_from_map
    where = f"x {pose.x_m:9.4f} y {pose.y_m:9.4f} m {math.degrees(pose.theta_rad):9.3f} deg"
    sigma = "reference"
    if anchor.covariance is not None:
        x, y, turn = (math.sqrt(anchor.covariance[k, k]) for k in range(3))
        sigma = f"+- {x * 1e3:.2f} {y * 1e3:.2f} mm {math.degrees(turn):.3f} deg"
    name = f"{anchor.robot} from {anchor.first}"
    tail = f", {_count(anchor.num_overlaps, 'overlap')}"
    if anchor.rests_on_one:
        tail += ", RESTS ON ONE"
    frame = f" [component {anchor.component}]" if anchor.component else ""
    return f"  {name:<12} {where}  {sigma}{tail}{frame}"


def _pair_lines(fused: Fused) -> list[str]:
    accepted, rejected = fused.front_end.edges, fused.front_end.rejected
    between = sum(edge.a.robot != edge.b.robot for edge in accepted)
    tried = len(accepted) + len(rejected)
    head = f"pairs tried {tried}: accepted {len(accepted)} ({between} between robots)"
    lines = [f"{head}, rejected {len(rejected)}"]
    further = fused.front_end.num_further
    if further:
        lines.append(f"  {further} of them where poses told of shared floor and the graph was weak")
    down = turned_down(fused.team)
    reasons = Counter(r.reason.value for r in rejected)
    reasons.update(f"{r.reason.value} in the graph" for r in down)
    reasons.update(f"{r.reason.value} in the bundle" for r in bundle_rejected(fused))
    lines += [f"  {reason:<24} {number:5d}" for reason, number in sorted(reasons.items())]
    freedom = fused.team.degrees_of_freedom
    if freedom > 0:
        ratio = fused.team.chi2 / freedom
        lines.append(f"pose graph chi2 {fused.team.chi2:.1f} over {freedom} ({ratio:.2f} each)")
    return lines


def _bundle_lines(fused: Fused) -> list[str]:
    if isinstance(fused.bundled, BundleRefusal):
        return [f"no bundle ({fused.bundled.reason.value}): {fused.bundled.text}"]
    if not isinstance(fused.bundled, BundleEstimate):
        return []
    found = fused.bundled
    cut = found.num_links_cut
    head = (
        f"bundle: {found.num_points} floor points, residual {found.residual_px:.3f} px, "
        f"{cut} of {found.num_links + cut} correspondences cut"
    )
    return [head, *(f"  {finding.text}" for finding in found.findings)]


def _warning_lines(fused: Fused) -> list[str]:
    repeating = fused.repeating
    if not repeating:
        return []
    count = f"{len(repeating)} of {len(fused.front_end.repetition)} frames"
    ambiguous = sum(r.reason is Reason.AMBIGUOUS for r in fused.front_end.rejected)
    lines = [f"THE FLOOR REPEATS itself in {count}, first in {repeating[0]}"]
    if ambiguous:
        what = f"{_count(ambiguous, 'pair')} could lie in several ways and stayed out"
        lines.append(f"  {what}; odometry in frames.csv would settle them")
    return lines


def _time_lines(seconds: Mapping[str, float]) -> list[str]:
    total = sum(seconds.values())
    stages = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
    return [f"seconds {total:.1f}: {stages}"]
