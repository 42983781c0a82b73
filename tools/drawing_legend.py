"""The legend beside a location graph: robots with their anchors, and what each line means."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from groundfuse.backend.measurement import Anchor, TeamEstimate
from groundfuse.tools.canvas import Canvas, Colour, text_width_px
from groundfuse.tools.drawing_component import EdgeKind, Graph
from groundfuse.tools.drawing_graph import (
    NUM_SIGMAS,
    draw_cones,
    draw_edges,
    draw_ellipses,
    draw_marker,
)
from groundfuse.tools.drawing_style import FAINT, GRID, INK, length_text, robot_colour

LINE_PX = 19.0
WIDTH_PX = 270.0
SAMPLE_PX = 46.0
SMALL_PX = 12.5
EDGE_NAMES = {
    EdgeKind.NEIGHBOUR: "neighbour",
    EdgeKind.LOOP: "loop or skip, same robot",
    EdgeKind.OVERLAP: "overlap between robots",
    EdgeKind.REJECTED: "tried and rejected",
}


@dataclass(slots=True)
class _Pen:
    """Where the next line of the legend goes."""

    canvas: Canvas
    left_px: float
    y_px: float

    def say(
        self, words: str, size_px: float = SMALL_PX, colour: Colour = INK, indent_px: float = 0.0
    ) -> None:
        """Write a line, smaller where it would not fit."""
        room = (WIDTH_PX - indent_px) / max(text_width_px(words, size_px), 1.0)
        place = (self.left_px + indent_px, self.y_px)
        self.canvas.text(words, place, size_px * min(room, 1.0), colour)
        self.y_px += LINE_PX

    def rule(self) -> None:
        """Draw a line across."""
        self.y_px += 4.0
        right = self.left_px + WIDTH_PX
        ends = np.array([[self.left_px, self.y_px], [right, self.y_px]])
        self.canvas.line(ends, GRID, 1.0)
        self.y_px += LINE_PX


def draw_legend(
    canvas: Canvas,
    graph: Graph,
    estimate: TeamEstimate,
    anchors: Sequence[Anchor],
    corner_px: tuple[float, float],
    larger: float,
) -> None:
    """Write the legend.

    Args:
        canvas: to draw on.
        graph: the component.
        estimate: the team's.
        anchors: those of the component.
        corner_px: upper left.
        larger: how many times larger the ellipses are drawn.
    """
    pen = _Pen(canvas, *corner_px)
    for robot in graph.robots:
        frames = len(graph.track(robot))
        if frames:
            _draw_robot(pen, graph, robot, frames)
            for words in anchor_lines([a for a in anchors if a.robot == robot]):
                pen.say(words, SMALL_PX, FAINT, 28.0)
            pen.y_px += 6.0
    pen.rule()
    for kind in sorted(EDGE_NAMES, reverse=True):
        count = len(graph.edges[kind])
        if count:
            _draw_edge_sample(pen, kind, f"{EDGE_NAMES[kind]} ({count})")
    _draw_symbols(pen, graph, larger)
    if estimate.degrees_of_freedom > 0:
        pen.rule()
        ratio = estimate.chi2 / estimate.degrees_of_freedom
        pen.say(f"chi2 {estimate.chi2:.4g}, {ratio:.2f} per degree of freedom", SMALL_PX, FAINT)


def anchor_lines(anchors: Sequence[Anchor]) -> Iterator[str]:
    """Yield the lines that tell where a robot's own map lies, with standard deviations."""
    for anchor in anchors:
        if anchor.covariance is None:
            yield f"from {anchor.first}: the reference"
            continue
        pose, (x, y, theta) = anchor.team_from_map, np.sqrt(np.diag(anchor.covariance))
        heading = f"{math.degrees(pose.theta_rad):.2f}°"
        yield f"from {anchor.first} at ({pose.x_m:.3f}, {pose.y_m:.3f}) m, {heading}"
        spread = length_text(math.hypot(float(x), float(y)))
        overlaps = "1 overlap" if anchor.num_overlaps == 1 else f"{anchor.num_overlaps} overlaps"
        yield f"± {spread}, ± {math.degrees(theta):.2g}°, by {overlaps}"


def _draw_robot(pen: _Pen, graph: Graph, robot: str, frames: int) -> None:
    colour = robot_colour(graph.robots.index(robot))
    draw_marker(pen.canvas, np.array([pen.left_px + 9.0, pen.y_px]), 8.0, colour)
    track = [graph.poses[frame] for frame in graph.track(robot)]
    steps = pairwise(track)
    path = sum(math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in steps)
    count = f"{frames} frames, {length_text(path)}" if frames > 1 else "1 frame"
    pen.canvas.text(robot, (pen.left_px + 28.0, pen.y_px), 16.0, INK, bold=True)
    pen.canvas.text(count, (pen.left_px + WIDTH_PX, pen.y_px), SMALL_PX, FAINT, align=1.0)
    pen.y_px += LINE_PX + 1.0


def _draw_edge_sample(pen: _Pen, kind: EdgeKind, words: str) -> None:
    ends = np.array([[pen.left_px, pen.y_px], [pen.left_px + SAMPLE_PX - 10.0, pen.y_px]])
    if kind is EdgeKind.REJECTED:
        pen.canvas.line(ends, FAINT, 9.0)  # floor enough to see its light dashes on
    draw_edges(pen.canvas, ends[None], kind, robot_colour(0))
    pen.say(words, indent_px=SAMPLE_PX)


def _draw_symbols(pen: _Pen, graph: Graph, larger: float) -> None:
    middle = pen.left_px + (SAMPLE_PX - 10.0) / 2.0
    foot = np.array([[middle - 9.0, pen.y_px]])
    draw_cones(pen.canvas, foot, np.zeros(1), 20.0, robot_colour(0))
    pen.say("camera heading", indent_px=SAMPLE_PX)
    if graph.covariance:
        spread = np.diag([11.0**2, 6.0**2])
        draw_ellipses(pen.canvas, np.array([[middle, pen.y_px]]), spread[None], robot_colour(0))
        scale = "" if larger == 1.0 else f", enlarged {larger:g} times"
        pen.say(f"{NUM_SIGMAS:g}-sigma ellipse{scale}", indent_px=SAMPLE_PX)
