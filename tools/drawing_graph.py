"""The location graph as lines on a canvas: trajectories, edges, headings, ellipses, numbers."""

import functools
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
    colours = {robot: robot_colour(number) for number, robot in enumerate(graph.robots)}
    for kind in EdgeKind:
        for robot, colour in colours.items():
            ends = [(at[a], at[b]) for a, b in graph.edges[kind] if a.robot == robot]
            draw_edges(canvas, np.array(ends).reshape(-1, 2, 2), kind, colour)
    _draw_gaps(canvas, graph, placing)
    radius = marker_px(graph, placing.px_per_m)
    scale = (NUM_SIGMAS * exaggeration(graph, placing.px_per_m) * placing.px_per_m) ** 2
    for robot, colour in colours.items():
        track = graph.track(robot)
        mounted = graph.base_from_foot.get(robot, IDENTITY)
        feet = np.array([(graph.poses[frame] @ mounted).vector() for frame in track])
        feet = feet.reshape(-1, 3)
        draw_cones(canvas, placing.px(feet[:, :2]), feet[:, 2], 3.0 * radius, colour)
    for robot, colour in colours.items():
        known = [frame for frame in graph.track(robot) if frame in graph.covariance]
        spread = np.array([graph.covariance[frame] for frame in known]).reshape(-1, 2, 2)
        places = np.array([at[frame] for frame in known]).reshape(-1, 2)
        draw_ellipses(canvas, places, spread * scale, colour)
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


def draw_edges(canvas: Canvas, ends: Floats, kind: EdgeKind, colour: Colour) -> None:
    """Draw edges from point to point (n, 2, 2) in the style of their kind."""
    if kind is EdgeKind.NEIGHBOUR:
        canvas.lines(ends, colour, 3.5, casing=WHITE)
    elif kind is EdgeKind.LOOP:
        canvas.lines(ends, mixed(colour, WHITE, 0.35), 1.5, casing=mixed(colour, INK, 0.5))
    elif kind is EdgeKind.OVERLAP:
        canvas.lines(ends, OVERLAP, 1.0, casing=INK)
    else:
        for way in ends:
            canvas.dashes(way, REJECTED, 1.0, 3.0, 6.0)


def draw_marker(canvas: Canvas, centre: Floats, radius_px: float, colour: Colour) -> None:
    """Draw a frame's disc."""
    canvas.disc(centre, radius_px, colour, casing=WHITE)


def draw_cones(
    canvas: Canvas, feet: Floats, headings_rad: Floats, length_px: float, colour: Colour
) -> None:
    """Draw where cameras look: cones from (n, 2) that open along (n,) headings (x right, y up)."""
    angles = headings_rad[:, None] + np.linspace(-0.42, 0.42, 5)
    arcs = feet[:, None] + length_px * np.stack([np.cos(angles), -np.sin(angles)], axis=-1)
    outlines = np.concatenate([feet[:, None], arcs], axis=1)
    for outline in outlines:
        canvas.polygon(outline, mixed(colour, WHITE, 0.25), opacity=0.55)
    canvas.lines(outlines, WHITE, 1.0, closed=True)


def draw_ellipses(canvas: Canvas, centres: Floats, covariances_px: Floats, colour: Colour) -> None:
    """Draw the outlines where x' C^-1 x = 1 around points (n, 2), y up; C is (n, 2, 2)."""
    values, axes = np.linalg.eigh(covariances_px)
    radii = np.sqrt(np.maximum(values, 0.0))
    outlines = []
    for centre, radius, axis in zip(centres, radii, axes, strict=True):
        # A chord of n in a circle is off it by r (1 - cos(pi / n)), about r pi^2 / (2 n^2).
        sides = math.ceil(math.pi * math.sqrt(float(radius.max()) / (2.0 * CHORD_PX)))
        round_ = _circle(max(sides, FEWEST_CORNERS)) * radius
        outlines.append(centre + (round_ @ axis.T) * (1.0, -1.0))
        canvas.polygon(outlines[-1], colour, opacity=0.22)
    canvas.lines(outlines, mixed(colour, INK, 0.25), 1.5, closed=True, casing=WHITE)


@functools.lru_cache(maxsize=1024)
def _circle(corners: int) -> Floats:
    """Return so many points (n, 2) of the unit circle."""
    turn = np.arange(corners) * (2.0 * math.pi / corners)
    return np.column_stack([np.cos(turn), np.sin(turn)])


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
