"""A picture of the location graph over the mosaic, for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from groundfuse.backend.measurement import Rejected, RelativePose, Se2, TeamEstimate
from groundfuse.frontend.arrays import Floats, Image
from groundfuse.frontend.mosaic import Mosaic
from groundfuse.tools.canvas import SUPER, Canvas
from groundfuse.tools.drawing_component import Graph, graph_of
from groundfuse.tools.drawing_graph import Placing, draw_graph, exaggeration
from groundfuse.tools.drawing_legend import draw_legend
from groundfuse.tools.drawing_style import (
    FAINT,
    GRID,
    INK,
    PAPER,
    WHITE,
    length_text,
    round_below,
    tick_text,
)

LEGEND_PX = 294
LEFT_PX = 58
TOP_PX = 64
BOTTOM_PX = 44
RIGHT_PX = 24
LEAST_HEIGHT_PX = 420
MARGIN_SHARE = 0.03
"""Free border around mosaic and trajectories, of the longer side."""
TICKS = 7.0
FULL = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawingOptions:
    """How the location graph is drawn."""

    longest_px: int = 1240
    """Longer side of the map, px; the legend comes beside it."""
    paleness: float = 0.18
    """How far the mosaic is faded towards the paper, 0 to 1, so that lines stand out."""


def draw_location_graph(
    mosaic: Mosaic,
    estimate: TeamEstimate,
    edges: Sequence[RelativePose | Rejected],
    component: int = 0,
    base_from_foot: Mapping[str, Se2] | None = None,
    options: DrawingOptions | None = None,
) -> Image:
    """Draw one component of the team over its mosaic; return BGR.

    Args:
        mosaic: of the component.
        estimate: of the team; its verdicts say which edges were turned down.
        edges: all that were measured or tried, of all components.
        component: which one.
        base_from_foot: where each robot's camera is and looks; straight ahead where not given.
        options: sizes.

    Raises:
        ValueError: the component has no frame.
    """
    options = options or DrawingOptions()
    graph = graph_of(estimate, edges, component, base_from_foot or {})
    placing, width, height = _placed(mosaic, graph, options)
    total = (LEFT_PX + width + RIGHT_PX + LEGEND_PX, TOP_PX + height + BOTTOM_PX)
    canvas = Canvas(total[0], max(total[1], LEAST_HEIGHT_PX), PAPER)
    _draw_axes(canvas, placing, width, height)
    _draw_mosaic(canvas, mosaic, placing, options.paleness)
    draw_graph(canvas, graph, placing)
    _draw_scale_bar(canvas, placing, height)
    _draw_title(canvas, mosaic, graph, component, len(set(estimate.component_of.values())))
    anchors = [anchor for anchor in estimate.anchors if anchor.component == component]
    corner = (float(LEFT_PX + width + RIGHT_PX), TOP_PX + 10.0)
    larger = exaggeration(graph, placing.px_per_m)
    draw_legend(canvas, graph, estimate, anchors, corner, larger)
    return canvas.finished()


def _placed(mosaic: Mosaic, graph: Graph, options: DrawingOptions) -> tuple[Placing, int, int]:
    """Fit mosaic and trajectories; return the placing and the map's width and height in px."""
    low, high = _bounds(mosaic, graph)
    margin = MARGIN_SHARE * float((high - low).max())
    low, high = low - margin, high + margin
    scale = options.longest_px / float((high - low).max())
    width, height = (max(1, round(float(side) * scale)) for side in high - low)
    return Placing(float(low[0]), float(high[1]), scale, LEFT_PX, TOP_PX), width, height


def _bounds(mosaic: Mosaic, graph: Graph) -> tuple[Floats, Floats]:
    rows, columns = mosaic.count.shape
    size = np.array([columns, rows]) * mosaic.m_per_px
    corner = np.array([mosaic.x_min_m, mosaic.y_max_m - size[1]])
    points = np.vstack([graph.places(), corner, corner + size])
    return points.min(axis=0), points.max(axis=0)


def _draw_mosaic(canvas: Canvas, mosaic: Mosaic, placing: Placing, paleness: float) -> None:
    """Put the floor where it belongs, its unseen cells left as paper."""
    rows, columns = mosaic.count.shape
    corner = np.array([[mosaic.x_min_m, mosaic.y_max_m]])
    size = np.array([columns, rows]) * mosaic.m_per_px * placing.px_per_m
    left, top = (round(value) for value in (placing.px(corner)[0] * SUPER).tolist())
    wide, tall = (max(1, round(value)) for value in (size * SUPER).tolist())
    # The canvas is halved at the end: down to half its size, a mosaic needs no means of areas here.
    how = cv2.INTER_AREA if SUPER * wide < columns else cv2.INTER_LINEAR
    seen = np.uint8(FULL) * (mosaic.count > 0).view(np.uint8)
    cover = np.asarray(cv2.resize(seen, (wide, tall), interpolation=how), dtype=np.uint8)
    floor = np.asarray(cv2.resize(mosaic.floor, (wide, tall), interpolation=how), dtype=np.uint8)
    window = canvas.image[top : top + tall, left : left + wide]
    partly = np.nonzero((cover > 0) & (cover < FULL))
    # Unseen cells are black in the floor: where some were averaged in, paper fills what is missing.
    share = cover[partly][:, None] / FULL
    paper = np.array(PAPER) * paleness
    lit = floor[partly] * (1.0 - paleness) + share * paper + (1.0 - share) * window[partly]
    table = np.rint(np.arange(256.0)[:, None] * (1.0 - paleness) + paper).astype(np.uint8)
    pale = cv2.LUT(floor, table[None])
    cv2.copyTo(pale, (cover == FULL).view(np.uint8), window)
    window[partly] = np.clip(np.rint(lit), 0, FULL).astype(np.uint8)


def _draw_axes(canvas: Canvas, placing: Placing, width: int, height: int) -> None:
    """Draw a grid with metres along the left and lower side."""
    step = round_below(max(width, height) / placing.px_per_m / TICKS * 1.4)
    right, bottom = LEFT_PX + width, TOP_PX + height
    x_max = placing.x_min_m + width / placing.px_per_m
    y_min = placing.y_max_m - height / placing.px_per_m
    for x in np.arange(np.ceil(placing.x_min_m / step), x_max / step) * step:
        at = float(placing.px(np.array([[x, 0.0]]))[0, 0])
        canvas.line(np.array([[at, TOP_PX], [at, bottom]]), GRID, 1.0)
        canvas.text(tick_text(float(x), step), (at, bottom + 14.0), 12.0, FAINT, align=0.5)
    for y in np.arange(np.ceil(y_min / step), placing.y_max_m / step) * step:
        at = float(placing.px(np.array([[0.0, y]]))[0, 1])
        canvas.line(np.array([[LEFT_PX, at], [right, at]]), GRID, 1.0)
        canvas.text(tick_text(float(y), step), (LEFT_PX - 8.0, at), 12.0, FAINT, align=1.0)
    frame = np.array([[LEFT_PX, TOP_PX], [right, TOP_PX], [right, bottom], [LEFT_PX, bottom]])
    canvas.line(frame, GRID, 1.0, closed=True)
    canvas.text("x m", (float(right), bottom + 32.0), 12.0, FAINT, align=1.0)
    canvas.text("y m", (LEFT_PX - 8.0, TOP_PX - 12.0), 12.0, FAINT, align=1.0)


def _draw_scale_bar(canvas: Canvas, placing: Placing, height: int) -> None:
    length_m = round_below(220.0 / placing.px_per_m)
    left, y = LEFT_PX + 18.0, TOP_PX + height - 20.0
    ends = np.array([[left, y], [left + length_m * placing.px_per_m, y]])
    canvas.line(ends, INK, 4.0, casing=WHITE)
    place = (left, y - 15.0)
    canvas.text(length_text(length_m), place, 14.0, INK, bold=True, halo=WHITE)


def _draw_title(
    canvas: Canvas, mosaic: Mosaic, graph: Graph, component: int, components: int
) -> None:
    robots = sorted({frame.robot for frame in graph.poses})
    who = f"robots {', '.join(robots)}" if len(robots) > 1 else f"robot {robots[0]}"
    part = "" if components == 1 else f", part {component + 1} of {components}"
    canvas.text(f"Team map of {who}{part}", (LEFT_PX, 24.0), 21.0, INK, bold=True)
    rows, columns = mosaic.count.shape
    size = f"{columns * mosaic.m_per_px:.3g} x {rows * mosaic.m_per_px:.3g} m"
    words = f"{len(graph.poses)} frames, {size}, cells of {length_text(mosaic.m_per_px)}"
    canvas.text(words, (LEFT_PX, 46.0), 13.0, FAINT)
