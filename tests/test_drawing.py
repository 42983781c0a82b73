"""The location graph is drawn where it is, with every edge in its style."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from map_world import circle, edge, small_mosaic, small_team

from groundfuse.backend.measurement import FrameId, Se2, TeamEstimate
from groundfuse.tools import canvas as canvas_module
from groundfuse.tools import drawing
from groundfuse.tools.canvas import SUPER, Canvas, dash_pieces, text_width_px
from groundfuse.tools.drawing import LEFT_PX, TOP_PX, DrawingOptions, draw_location_graph
from groundfuse.tools.drawing_component import EdgeKind, graph_of
from groundfuse.tools.drawing_graph import (
    ELLIPSE_MARKERS,
    NUM_SIGMAS,
    Placing,
    draw_cones,
    draw_ellipses,
    exaggeration,
    marker_px,
)
from groundfuse.tools.drawing_legend import anchor_lines
from groundfuse.tools.drawing_style import (
    PAPER,
    length_text,
    robot_colour,
    round_below,
    tick_text,
)

# OpenCV fills to half a pixel of the doubled size, one side more than the other: worst seen 0.23.
TOLERANCE_PX = 0.3
WHITE = (255, 255, 255)


def centroid(image, background):
    weight = np.abs(image.astype(float) - background).sum(axis=2)
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("place", [(20.0, 30.0), (20.5, 30.25), (33.1, 12.7)])
def test_shapes_lie_where_they_are_asked_for(place):
    place = np.array(place)
    disc, box, line = (Canvas(60, 50, WHITE) for _ in range(3))
    disc.disc(place, 6.0, (0, 0, 0))
    box.polygon(place + np.array([[-5, -4], [5, -4], [5, 4], [-5, 4]]), (0, 0, 0), opacity=0.5)
    line.line(place + np.array([[-5.0, 4.0], [5.0, -4.0]]), (10, 20, 30), 2.0, casing=(0, 0, 0))
    for canvas in (disc, box, line):
        image = canvas.finished()
        assert image.shape == (50, 60, 3)
        assert np.abs(centroid(image, WHITE) - place).max() < TOLERANCE_PX


def test_disc_has_its_area_and_opacity_its_share():
    disc, half = Canvas(60, 60, WHITE), Canvas(60, 60, WHITE)
    disc.disc(np.array([30.0, 30.0]), 20.0, (0, 0, 0))
    area = (255 - disc.finished()[..., 0].astype(float)).sum() / 255
    assert area == pytest.approx(math.pi * 20**2, rel=0.05)
    half.polygon(
        np.array([[10.0, 10.0], [50.0, 10.0], [50.0, 50.0], [10.0, 50.0]]), (0, 0, 0), 0.25
    )
    assert abs(int(half.finished()[30, 30, 0]) - 255 * 0.75) <= 1


def test_what_lies_outside_the_canvas_does_no_harm():
    canvas = Canvas(40, 30, WHITE)
    far = np.array([[-100.0, -50.0], [-80.0, -50.0], [-80.0, -20.0]])
    canvas.polygon(far, (0, 0, 0))
    canvas.line(far, (0, 0, 0))
    canvas.disc(far[0], 5.0, (0, 0, 0))
    assert (canvas.finished() == 255).all()


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=6),
    st.floats(1, 20),
    st.floats(1, 20),
)
def test_dashes_cover_their_share_of_the_line(points, dash, gap):
    line = np.array(points)
    total = np.hypot(*np.diff(line, axis=0).T).sum()
    drawn = sum(np.hypot(*np.diff(p, axis=0).T).sum() for p in dash_pieces(line, dash, gap))
    whole, rest = divmod(total, dash + gap)
    assert drawn == pytest.approx(whole * dash + min(rest, dash), abs=1e-6 + 2e-6 * dash)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(1, 20), st.floats(1, 20))
def test_dashes_of_a_straight_line_know_no_more_of_its_middle_than_ends(x, y, dash, gap):
    """A bend that is none changes no dash's ends, and only those that it lies in have it."""
    ends = np.array([[0.0, 0.0], [x, y]])
    plain = dash_pieces(ends, dash, gap)
    bent = dash_pieces(np.insert(ends, 1, ends.mean(axis=0), axis=0), dash, gap)
    assert sum(len(piece) for piece in bent) - sum(len(piece) for piece in plain) <= 1
    for one, other in zip(plain, bent, strict=True):
        # Half the way and the other half make the whole but for rounding: worst seen 2e-14.
        np.testing.assert_allclose(one, other[[0, -1]], atol=1e-12)


def test_a_canvas_begins_in_its_colour():
    assert (Canvas(7, 5, (1, 20, 250)).finished() == (1, 20, 250)).all()


def text_image(words, monkeypatch=None, **how):
    if monkeypatch is not None:
        monkeypatch.setattr(canvas_module, "_face", lambda: None)
    canvas = Canvas(300, 40, WHITE)
    canvas.text(words, (150.0, 20.0), 20.0, (0, 0, 0), **how)
    return canvas.finished()


@pytest.mark.parametrize("strokes", [False, True])
@pytest.mark.parametrize("align", [0.0, 0.5, 1.0])
def test_text_is_aligned_at_its_place(align, strokes, monkeypatch):
    image = text_image("HOMO", monkeypatch if strokes else None, align=align)
    columns = np.flatnonzero((image < 128).any(axis=(0, 2)))
    rows = np.flatnonzero((image < 128).any(axis=(1, 2)))
    left = 150.0 - align * text_width_px("HOMO", 20.0)
    assert abs(columns[0] - left) < 4
    assert abs(columns[-1] - left - text_width_px("HOMO", 20.0)) < 4
    assert abs((rows[0] + rows[-1]) / 2 - 20.0) <= 1.5
    assert 11 <= rows[-1] - rows[0] <= 17


def test_strokes_stand_in_for_signs_they_lack(monkeypatch):
    shown = text_image("± 1°", monkeypatch)
    assert (shown == text_image("+/- 1 deg", monkeypatch)).all()


def test_bold_is_heavier_and_a_halo_surrounds():
    plain, bold = text_image("map"), text_image("map", bold=True)
    assert (bold < 128).sum() > (plain < 128).sum()
    canvas = Canvas(100, 40, (0, 0, 0))
    canvas.text("map", (50.0, 20.0), 20.0, (0, 0, 0), align=0.5, halo=WHITE)
    assert (canvas.finished() > 200).any()


@given(st.floats(1e-6, 1e6))
def test_round_below_is_round_and_below(value):
    found = round_below(value)
    assert found <= value * (1 + 1e-6)
    assert found > value / 2.5 * (1 - 1e-6)
    assert f"{found:.0e}"[0] in "125"
    assert found == pytest.approx(float(f"{found:.0e}"))


@pytest.mark.parametrize(
    ("length", "text"),
    [(3126.4, "3126 m"), (12.34, "12.3 m"), (1.0, "1 m"), (0.55, "55 cm"), (0.0013, "1.3 mm"),
     (0.00045, "0.45 mm")],
)  # fmt: skip
def test_lengths_have_fitting_units(length, text):
    assert length_text(length) == text


@pytest.mark.parametrize(
    ("value", "step", "text"),
    [(2.0, 1.0, "2"), (-0.5, 0.5, "-0.5"), (-1e-17, 0.2, "0.0"), (300.0, 100.0, "300"),
     (0.05, 0.05, "0.05")],
)  # fmt: skip
def test_ticks_have_the_decimals_of_their_step(value, step, text):
    assert tick_text(value, step) == text


def test_robots_have_colours_of_their_own():
    colours = [robot_colour(number) for number in range(12)]
    apart = [np.abs(np.subtract(a, b)).sum() for i, a in enumerate(colours) for b in colours[:i]]
    assert min(apart) > 30


def test_edges_are_sorted_by_kind_and_verdict():
    estimate, edges = small_team()
    graph = graph_of(estimate, edges, 0, {})
    counts = {kind: len(pairs) for kind, pairs in graph.edges.items()}
    assert counts == {
        EdgeKind.NEIGHBOUR: 10,
        EdgeKind.LOOP: 1,
        EdgeKind.OVERLAP: 1,
        EdgeKind.REJECTED: 2,
    }


def test_only_the_component_is_drawn():
    estimate, edges = small_team()
    parts = {frame: 0 if frame.robot == "A" else 1 for frame in estimate.team_from_base}
    apart = TeamEstimate(estimate.team_from_base, parts, {}, (), (), 0.0, 0)
    graph = graph_of(apart, edges, 1, {})
    assert {frame.robot for frame in graph.poses} == {"B"}
    assert len(graph.edges[EdgeKind.NEIGHBOUR]) == 5
    assert not graph.edges[EdgeKind.OVERLAP]
    assert graph.robots == ["A", "B"]  # colours stay the same in all parts
    with pytest.raises(ValueError, match="no frame belongs to component 2"):
        graph_of(apart, edges, 2, {})


def test_covariance_is_turned_to_the_axes_of_the_map():
    estimate, edges = small_team()
    graph = graph_of(estimate, edges, 0, {})
    # Forward 2 mm, sideways 1 mm: forward is along the heading.
    for frame in (FrameId("B", 0), FrameId("B", 1)):
        heading = estimate.team_from_base[frame].theta_rad
        ahead = np.array([math.cos(heading), math.sin(heading)])
        expected = 1e-6 * np.eye(2) + 3e-6 * np.outer(ahead, ahead)
        np.testing.assert_allclose(graph.covariance[frame], expected, atol=1e-18)


@pytest.mark.parametrize("size", [1.0, 0.1, 0.03])
def test_ellipse_is_as_large_as_its_covariance(size):
    canvas = Canvas(200, 200, WHITE)
    axis, angle = size * np.array([60.0, 20.0]), 0.5
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    draw_ellipses(
        canvas, np.array([[100.0, 100.0]]), (turn @ np.diag(axis**2) @ turn.T)[None], (0, 0, 0)
    )
    drawn = np.argwhere((canvas.finished() < 250).any(axis=2)) - 100.0
    along = drawn @ np.array([-math.sin(angle), math.cos(angle)])  # rows count downwards
    across = drawn @ np.array([math.cos(angle), math.sin(angle)])
    assert along.max() == pytest.approx(axis[0], abs=3.0)
    assert across.max() == pytest.approx(axis[1], abs=3.0)


@pytest.mark.parametrize(("heading_rad", "way"), [(0.0, (1, 0)), (math.pi / 2, (0, -1))])
def test_cone_opens_along_the_heading(heading_rad, way):
    canvas = Canvas(100, 100, WHITE)
    draw_cones(canvas, np.array([[50.0, 50.0]]), np.array([heading_rad]), 30.0, (0, 0, 0))
    ahead = centroid(canvas.finished(), WHITE) - 50.0
    # The centre of a sector's area lies at about two thirds of its radius.
    assert np.abs(ahead - 20.0 * np.array(way)).max() < 3.0


@pytest.mark.parametrize("sigma_m", [1e-5, 1e-3, 0.5])
def test_exaggeration_makes_ellipses_visible_and_no_larger(sigma_m):
    poses = circle("A", 6, 0.0)
    covariance = np.diag([sigma_m**2, 1e-12, 1e-12])
    frames = list(poses)
    estimate = TeamEstimate(
        poses, dict.fromkeys(poses, 0), dict.fromkeys(frames[1:], covariance), (), (), 0.0, 0
    )
    graph = graph_of(estimate, [edge(poses, *frames[:2])], 0, {})
    factor = exaggeration(graph, 500.0)
    drawn_px = NUM_SIGMAS * sigma_m * 500.0 * factor
    limit_px = ELLIPSE_MARKERS * marker_px(graph, 500.0)
    assert factor >= 1.0
    if factor > 1.0:
        assert limit_px / 2.6 < drawn_px <= limit_px * 1.001
    else:
        assert drawn_px * 2 > limit_px


@given(st.floats(-5, 5), st.floats(-5, 5))
def test_placing_points_up(x, y):
    placing = Placing(-6.0, 6.0, 80.0, 50.0, 60.0)
    u, v = placing.of(Se2(x, y, 0.0))
    assert u == pytest.approx(50 + 80 * (x + 6))
    assert v == pytest.approx(60 + 80 * (6 - y))


def test_mosaic_and_graph_share_one_place():
    estimate, edges = small_team()
    mosaic = small_mosaic()
    pink, place = (255, 0, 255), Se2(0.55, -0.33, 0.0)
    row = int((mosaic.y_max_m - place.y_m) / mosaic.m_per_px)
    column = int((place.x_m - mosaic.x_min_m) / mosaic.m_per_px)
    mosaic.floor[row - 3 : row + 4, column - 3 : column + 4] = pink
    image = draw_location_graph(mosaic, estimate, edges, options=DrawingOptions(paleness=0.0))
    found = (np.abs(image.astype(int) - pink).sum(axis=2) < 60).nonzero()
    # The map's corner is the union of mosaic and trajectories with 3 % of its longer side around.
    low_x, high_y = min(mosaic.x_min_m, -0.3), max(mosaic.y_max_m, 0.3)
    high_x = max(mosaic.x_min_m + 2.0, 1.1)
    scale = 1240 / ((high_x - low_x) * 1.06)
    margin = 0.03 * (high_x - low_x)
    centre = mosaic.x_min_m + (column + 0.5) * 0.01, mosaic.y_max_m - (row + 0.5) * 0.01
    u = LEFT_PX + (centre[0] - low_x + margin) * scale
    v = TOP_PX + (high_y + margin - centre[1]) * scale
    assert np.mean(found[1]) == pytest.approx(u, abs=1.0)
    assert np.mean(found[0]) == pytest.approx(v, abs=1.0)


# Cover, floor and their sum are rounded to whole levels: three halves. Worst seen 1.
FLAT_LEVELS = 2


@pytest.mark.parametrize("longest_px", [60, 150, 900])  # much smaller, smaller and larger cells
def test_no_dark_border_lies_around_floor_that_was_seen(longest_px):
    mosaic, (team, edges) = small_mosaic(rows=121, columns=400), small_team()
    seen = np.random.default_rng(2).random(mosaic.count.shape) < 0.5
    mosaic.count[:] = seen
    mosaic.floor[:] = np.where(seen[..., None], np.array(PAPER), 0)
    canvas = Canvas(1000, 600, PAPER)
    graph = graph_of(team, edges, 0, {})
    placing, _, _ = drawing._placed(mosaic, graph, DrawingOptions(longest_px=longest_px))
    drawing._draw_mosaic(canvas, mosaic, placing, 0.3)
    assert np.abs(canvas.image.astype(int) - PAPER).max() <= FLAT_LEVELS
    mosaic.floor[seen] = 0  # black floor is faded by as much as was asked for, and shows its share
    drawing._draw_mosaic(canvas, mosaic, placing, 0.3)
    shown = (PAPER - canvas.image.astype(float)).sum() / (0.7 * sum(PAPER) * SUPER**2)
    area = seen.sum() * (mosaic.m_per_px * placing.px_per_m) ** 2
    assert shown == pytest.approx(area, rel=0.05)


def pixels_of(image, colour, tolerance=40):
    return (np.abs(image.astype(int) - colour).max(axis=2) < tolerance).sum()


def test_everything_is_on_the_picture_and_the_same_every_time():
    estimate, edges = small_team()
    image = draw_location_graph(small_mosaic(), estimate, edges)
    again = draw_location_graph(small_mosaic(), estimate, edges)
    assert (image == again).all()
    for robot in (0, 1):
        assert pixels_of(image, robot_colour(robot)) > 1000
    assert pixels_of(image, PAPER, 3) > 0.2 * image.shape[0] * image.shape[1]
    fewer = draw_location_graph(small_mosaic(), estimate, edges[:-3])
    assert (image != fewer).any()


@pytest.mark.parametrize("number", [1, 2, 60])
def test_any_number_of_frames(number):
    estimate, edges = small_team(number) if number > 1 else (None, [])
    if estimate is None:
        frame = FrameId("solo", 0)
        estimate = TeamEstimate({frame: Se2(0, 0, 0)}, {frame: 0}, {}, (), (), 0.0, 0)
    options = DrawingOptions(longest_px=500)
    image = draw_location_graph(small_mosaic(), estimate, edges, options=options)
    assert image.dtype == np.uint8
    assert max(image.shape) > 500
    encoded, data = cv2.imencode(".png", image)
    assert encoded
    assert len(data) > 1000


def test_without_a_truetype_face(monkeypatch):
    monkeypatch.setattr(canvas_module, "_face", lambda: None)
    estimate, edges = small_team()
    image = draw_location_graph(small_mosaic(), estimate, edges)
    legend = image[:200, -280:]
    assert (legend.max(axis=2) < 150).sum() > 100  # letters; none are there without them


def test_anchor_lines_tell_place_and_deviation():
    estimate, _ = small_team()
    lines = list(anchor_lines(estimate.anchors))
    assert lines == [
        "from A0: the reference",
        "from B0 at (1.100, 0.000) m, 90.00°",
        "± 1.4 mm, ± 0.057°, by 1 overlap",
    ]
