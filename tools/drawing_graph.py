"""The location graph as lines on a canvas: trajectories, edges, headings, ellipses, numbers."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from groundfuse.backend.measurement import IDENTITY, FrameId, Se2
from groundfuse.frontend.arrays import Floats
from groundfuse.tools.canvas import Canvas, Colour
from groundfuse.tools.drawing_component import EdgeKind, Graph
from groundfuse.tools.drawing_style import (
    INK,
    OVERLAP,
    REJECTED,
    WHITE,
    mixed,
    robot_colour,
    round_below,
)

NUM_SIGMAS = 3.0
ELLIPSE_MARKERS = 5.0
"""The largest ellipse is drawn with a half axis of up to this many markers' radii."""
CHORD_PX = 0.1
"""How far the corners of an ellipse are apart: its sides are off the curve by no more."""
FEWEST_CORNERS = 12
LARGEST_MARKER_PX = 11.0
SMALLEST_MARKER_PX = 3.0
STEP_SHARE = 0.24
CROWD_SHARE = 0.12
NUMBERED_FROM_PX = 8.0
"""Markers as large as this carry their frame's number inside."""
NAMES_PER_ROBOT = 10


@dataclass(frozen=True, slots=True)
class Placing:
    """Where the team's frame lies on a canvas, y up becoming y down."""

    x_min_m: float
    y_max_m: float
    px_per_m: float
    left_px: float
    top_px: float

    def px(self, points_m: Floats) -> Floats:
        """Turn points (n, 2) of the team's frame into canvas coordinates."""
        x = self.left_px + (points_m[:, 0] - self.x_min_m) * self.px_per_m
        y = self.top_px + (self.y_max_m - points_m[:, 1]) * self.px_per_m
        return np.column_stack([x, y])

    def of(self, pose: Se2) -> Floats:
        """Return the canvas place (2,) of a pose."""
        place: Floats = self.px(np.array([[pose.x_m, pose.y_m]]))[0]
        return place


def draw_graph(canvas: Canvas, graph: Graph, placing: Placing) -> None:
    """Draw edges, ellipses, trajectories, headings and numbers, the important last."""
    at = dict(zip(graph.poses, placing.px(graph.places()), strict=True))
    colour = {frame: _colour(graph, frame) for frame in graph.poses}
    for kind in EdgeKind:
        for a, b in graph.edges[kind]:
            draw_edge(canvas, np.array([at[a], at[b]]), kind, colour[a])
    _draw_gaps(canvas, graph, placing)
    radius = marker_px(graph, placing.px_per_m)
    for frame in graph.poses:
        _draw_heading(canvas, graph, placing, frame, radius)
    scale = (NUM_SIGMAS * exaggeration(graph, placing.px_per_m) * placing.px_per_m) ** 2
    for frame, covariance in graph.covariance.items():
        draw_ellipse(canvas, at[frame], covariance * scale, colour[frame])
    if radius < NUMBERED_FROM_PX:
        _draw_dots(canvas, graph, placing, radius)
    else:
        _draw_numbers(canvas, graph, placing, radius)


def marker_px(graph: Graph, px_per_m: float) -> float:
    """Return the radius of a frame's marker: as large as steps and number of frames allow."""
    size_px = np.ptp(graph.places(), axis=0) * px_per_m
    crowd = CROWD_SHARE * math.sqrt(float(size_px.prod()) / len(graph.poses))
    step = STEP_SHARE * graph.usual_step_m() * px_per_m
    wanted = min((r for r in (crowd, step) if r > 0.0), default=LARGEST_MARKER_PX)
    return min(max(wanted, SMALLEST_MARKER_PX), LARGEST_MARKER_PX)


def exaggeration(graph: Graph, px_per_m: float) -> float:
    """Return the round number, at least 1, that makes the largest ellipse easily seen."""
    every = np.array(list(graph.covariance.values())).reshape(-1, 2, 2)
    radius_m = NUM_SIGMAS * math.sqrt(float(np.linalg.eigvalsh(every).max(initial=0.0)))
    wanted_m = ELLIPSE_MARKERS * marker_px(graph, px_per_m) / px_per_m
    return round_below(wanted_m / radius_m) if wanted_m > radius_m > 0.0 else 1.0


def draw_edge(canvas: Canvas, ends: Floats, kind: EdgeKind, colour: Colour) -> None:
    """Draw one edge from point to point (2, 2) in the style of its kind."""
    if kind is EdgeKind.NEIGHBOUR:
        canvas.line(ends, colour, 3.5, casing=WHITE)
    elif kind is EdgeKind.LOOP:
        canvas.line(ends, mixed(colour, WHITE, 0.35), 1.5, casing=mixed(colour, INK, 0.5))
    elif kind is EdgeKind.OVERLAP:
        canvas.line(ends, OVERLAP, 1.0, casing=INK)
    else:
        canvas.dashes(ends, REJECTED, 1.0, 3.0, 6.0)


def draw_marker(canvas: Canvas, centre: Floats, radius_px: float, colour: Colour) -> None:
    """Draw a frame's disc."""
    canvas.disc(centre, radius_px, colour, casing=WHITE)


def draw_cone(
    canvas: Canvas, foot: Floats, heading_rad: float, length_px: float, colour: Colour
) -> None:
    """Draw where a camera looks: a cone that opens along its heading (x right, y up)."""
    angles = heading_rad + np.linspace(-0.42, 0.42, 5)
    arc = foot + length_px * np.column_stack([np.cos(angles), -np.sin(angles)])
    outline = np.vstack([foot, arc])
    canvas.polygon(outline, mixed(colour, WHITE, 0.25), opacity=0.55)
    canvas.line(outline, WHITE, 1.0, closed=True)


def draw_ellipse(canvas: Canvas, centre: Floats, covariance_px: Floats, colour: Colour) -> None:
    """Draw the outline where x' C^-1 x = 1 around a point, y up."""
    values, axes = np.linalg.eigh(covariance_px)
    radii = np.sqrt(np.maximum(values, 0.0))
    # A chord of n in a circle is off it by r (1 - cos(pi / n)), about r pi^2 / (2 n^2).
    corners = math.ceil(math.pi * math.sqrt(float(radii.max()) / (2.0 * CHORD_PX)))
    turn = np.arange(max(corners, FEWEST_CORNERS)) * (2.0 * math.pi / max(corners, FEWEST_CORNERS))
    round_ = np.column_stack([np.cos(turn), np.sin(turn)]) * radii
    outline = centre + (round_ @ axes.T) * (1.0, -1.0)
    canvas.polygon(outline, colour, opacity=0.22)
    canvas.line(outline, mixed(colour, INK, 0.25), 1.5, closed=True, casing=WHITE)


def _colour(graph: Graph, frame: FrameId) -> Colour:
    return robot_colour(graph.robots.index(frame.robot))


def _draw_gaps(canvas: Canvas, graph: Graph, placing: Placing) -> None:
    """Dot the way between frames that follow each other without an edge of their own."""
    joined = {frozenset(pair) for pair in graph.edges[EdgeKind.NEIGHBOUR]}
    for robot in graph.robots:
        track = graph.track(robot)
        for a, b in pairwise(track):
            if frozenset((a, b)) not in joined:
                ends = np.array([placing.of(graph.poses[a]), placing.of(graph.poses[b])])
                canvas.dashes(ends, _colour(graph, a), 2.0, 2.0, 6.0, casing=WHITE)


def _draw_heading(
    canvas: Canvas, graph: Graph, placing: Placing, frame: FrameId, radius_px: float
) -> None:
    foot = graph.poses[frame] @ graph.base_from_foot.get(frame.robot, IDENTITY)
    colour = _colour(graph, frame)
    draw_cone(canvas, placing.of(foot), foot.theta_rad, 3.0 * radius_px, colour)


def _draw_numbers(canvas: Canvas, graph: Graph, placing: Placing, radius_px: float) -> None:
    """Draw a disc per frame with its number inside; a track's beginning lies on top."""
    for frame in reversed(list(graph.poses)):
        centre = placing.of(graph.poses[frame])
        draw_marker(canvas, centre, radius_px, _colour(graph, frame))
        size_px = (1.15 if frame.index < 100 else 0.95) * radius_px
        place = (float(centre[0]), float(centre[1]))
        canvas.text(str(frame.index), place, size_px, WHITE, align=0.5, bold=True)


def _draw_dots(canvas: Canvas, graph: Graph, placing: Placing, radius_px: float) -> None:
    """Draw a disc per frame, and the names of some ten per robot beside theirs."""
    for frame, pose in graph.poses.items():
        draw_marker(canvas, placing.of(pose), radius_px, _colour(graph, frame))
    for robot in graph.robots:
        track = graph.track(robot)
        for frame in track[:: max(1, round(len(track) / NAMES_PER_ROBOT))]:
            x, y = placing.of(graph.poses[frame]).tolist()
            beside = (x + radius_px + 3.0, y - radius_px - 3.0)
            colour = mixed(_colour(graph, frame), INK, 0.35)
            canvas.text(str(frame), beside, 11.0, colour, bold=True, halo=WHITE)
