"""The PLY opens where it should, Open3D agrees with our optimum, and nothing needs Open3D."""

import math
import subprocess
import sys
import textwrap
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from map_world import circle, edge, small_mosaic, small_team

from groundfuse.backend.measurement import EdgeVerdict, FrameId, Se2, TeamEstimate
from groundfuse.tools import map_points as map_points_module
from groundfuse.tools import open3d_import, view3d
from groundfuse.tools.drawing_style import robot_colour
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.map_points import floor_points, map_points
from groundfuse.tools.open3d_check import Differences, chained, check_with_open3d
from groundfuse.tools.open3d_import import import_open3d, need_display
from groundfuse.tools.ply_file import EDGE, VERTEX, ply_bytes
from groundfuse.tools.view3d import main, open_window, view_ply, write_ply

# Both optimise the same cost up to terms of third order in the residuals; with residuals of 1 mm
# and 1 mrad over steps of 0.3 m those are below 1e-6 m; worst seen over 20 seeds 4e-7.
TOLERANCE_M = 5e-6
TOLERANCE_RAD = 5e-6


@pytest.fixture(scope="module")
def open3d():
    try:
        return import_open3d()
    except TeamError as error:
        pytest.skip(str(error))


def parsed(content):
    """Read our PLY as its header says."""
    head, _, body = content.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if "element" in line}
    vertices = np.frombuffer(body, VERTEX, counts["vertex"])
    edges = np.frombuffer(body[vertices.nbytes :], EDGE, counts.get("edge", 0))
    assert vertices.nbytes + edges.nbytes == len(body)
    return lines, vertices, edges


def test_ply_says_what_it_holds():
    points = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.5]])
    colours = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    content = ply_bytes(points, colours, np.array([[0, 1]]), colours[:1])
    lines, vertices, edges = parsed(content)
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line.split()[-1] for line in lines if line.startswith("property")] == [
        *("x", "y", "z", "red", "green", "blue"),
        *("vertex1", "vertex2", "red", "green", "blue"),
    ]
    assert vertices["xyz"].tolist() == points.tolist()
    assert vertices["rgb"].tolist() == colours.tolist()
    assert edges["ends"].tolist() == [[0, 1]]


@pytest.mark.parametrize(
    ("colours", "edges", "message"),
    [
        (1, [], "every point and edge needs a colour, got 1 for 2 and 0 for 0"),
        (2, [[0, 2]], "edges must name points 0 to 1, got 2"),
        (2, [[-1, 1]], "edges must name points 0 to 1, got -1"),
    ],
)
def test_ply_refuses_what_does_not_fit(colours, edges, message):
    joined = np.array(edges, np.int64).reshape(-1, 2)
    with pytest.raises(ValueError, match=message):
        ply_bytes(
            np.zeros((2, 3)),
            np.zeros((colours, 3), np.uint8),
            joined,
            np.zeros((len(joined), 3), np.uint8),
        )


def test_floor_points_are_the_seen_cells():
    mosaic = small_mosaic()
    found, spacing_m = floor_points(mosaic, 10**6)
    assert spacing_m == mosaic.m_per_px
    row, column = np.nonzero(mosaic.count)
    assert len(found.points) == len(row)
    np.testing.assert_allclose(found.points[:, 0], mosaic.x_min_m + (column + 0.5) * 0.01)
    np.testing.assert_allclose(found.points[:, 1], mosaic.y_max_m - (row + 0.5) * 0.01)
    assert (found.colours == mosaic.floor[row, column][:, ::-1]).all()


def test_thinned_floor_keeps_place_and_colour():
    mosaic = small_mosaic(rows=121, columns=203)
    found, spacing_m = floor_points(mosaic, 3000)
    assert 2000 < len(found.points) <= 3000
    assert spacing_m == pytest.approx(0.03)
    whole, _ = floor_points(mosaic, 10**6)
    np.testing.assert_allclose(found.points.mean(axis=0), whole.points.mean(axis=0), atol=0.01)
    assert found.colours.min() >= 85  # black of unseen cells is not mixed in
    assert abs(found.colours.mean() - whole.colours.mean()) < 0.5


def test_rows_thinned_together_change_nothing(monkeypatch):
    mosaic = small_mosaic(rows=121, columns=203)
    found, _ = floor_points(mosaic, 3000)
    monkeypatch.setattr(map_points_module, "ROWS_AT_ONCE", 7)
    again, _ = floor_points(mosaic, 3000)
    np.testing.assert_array_equal(again.points, found.points)
    np.testing.assert_array_equal(again.colours, found.colours)


def test_trajectories_float_over_the_floor_in_their_colours():
    estimate, _ = small_team()
    mosaic = small_mosaic()
    found = map_points(mosaic, estimate)
    assert len(found.edges) == 10
    ends = found.points[found.edges]
    assert (ends[..., 2] == ends[0, 0, 2]).all()
    assert ends[0, 0, 2] > 0.0
    a = [estimate.team_from_base[FrameId("A", i)] for i in range(6)]
    expected = [[pose.x_m, pose.y_m] for pose in a]
    np.testing.assert_allclose(ends[:5, 0, :2], expected[:5])
    np.testing.assert_allclose(ends[4, 1, :2], expected[5])
    floating = found.points[found.points[:, 2] > 0.0][:, :2]
    middle = (np.array(expected[0]) + expected[1]) / 2
    assert np.hypot(*(floating - middle).T).min() < 0.01  # the ribbon fills the way between
    blue, green, red = robot_colour(0)
    assert (found.edge_colours[:5] == [red, green, blue]).all()
    assert (found.colours[found.edges[:5, 0]] == [red, green, blue]).all()
    assert (found.edge_colours[5:] == robot_colour(1)[::-1]).all()


def test_a_single_frame_has_no_lines():
    frame = FrameId("A", 0)
    estimate = TeamEstimate({frame: Se2(0, 0, 0)}, {frame: 0}, {}, (), (), 0.0, 0)
    found = map_points(small_mosaic(), estimate)
    assert len(found.edges) == 0
    assert parsed(ply_bytes(found.points, found.colours, found.edges, found.edge_colours))


def test_open3d_reads_points_and_lines(open3d, tmp_path):
    estimate, _ = small_team()
    path = tmp_path / "team.ply"
    write_ply(path, small_mosaic(), estimate)
    found = map_points(small_mosaic(), estimate)
    cloud = open3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(cloud.points), found.points, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, found.colours, atol=0.01)
    lines = open3d.io.read_line_set(str(path))
    assert np.asarray(lines.lines).tolist() == found.edges.tolist()


def noisy_graph(seed, number=20, noise=1e-3):
    """A circle with noisy steps and chords, and its least-squares estimate by Gauss-Newton."""
    rng = np.random.default_rng(seed)
    truth = circle("A", number, 0.0, radius_m=0.05 * number)
    frames = list(truth)
    pairs = [*pairwise(frames), *zip(frames[::3], frames[7:], strict=False)]
    edges = []
    for a, b in pairs:
        lower = np.diag([noise, noise, noise]) @ (np.eye(3) + 0.3 * np.tril(np.ones((3, 3)), -1))
        error = Se2(*(lower @ rng.standard_normal(3)))
        edges.append(edge(truth, a, b, error, lower @ lower.T))
    return frames, edges, least_squares(frames, edges, truth)


def least_squares(frames, edges, start):
    """Gauss-Newton on dense numeric Jacobians: slow, plain and independent of gtsam and Open3D."""
    poses = dict(start)

    def residuals(poses):
        parts = []
        for e in edges:
            gap = e.a_from_b.inverse() @ poses[e.a].inverse() @ poses[e.b]
            root = np.linalg.cholesky(np.linalg.inv(e.covariance))
            parts.append(root.T @ gap.vector())
        return np.concatenate(parts)

    for _ in range(4):
        at, columns, step = residuals(poses), [], 1e-6
        for frame in frames[1:]:
            for axis in range(3):
                bumped = poses | {frame: poses[frame] @ Se2(*(step * np.eye(3)[axis]))}
                columns.append((residuals(bumped) - at) / step)
        delta, *_ = np.linalg.lstsq(np.column_stack(columns), -at, rcond=None)
        for frame, move in zip(frames[1:], delta.reshape(-1, 3), strict=True):
            poses[frame] = poses[frame] @ Se2(*move)
    return TeamEstimate(poses, dict.fromkeys(poses, 0), {}, (), (), 0.0, 0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_open3d_comes_to_the_same_optimum(open3d, seed):
    assert open3d
    frames, edges, estimate = noisy_graph(seed)
    found = check_with_open3d(frames, edges, estimate)
    assert (found.num_frames, found.num_edges) == (20, len(edges))
    assert found.max_m < TOLERANCE_M
    assert found.max_rad < TOLERANCE_RAD
    apart = [start_distance(frames, edges, estimate, frame) for frame in frames]
    assert max(apart) > 100 * TOLERANCE_M  # where Open3D began it was not


def start_distance(frames, edges, estimate, frame):
    start = chained(frames, edges)[frame]
    ours = estimate.team_from_base[frames[0]].inverse() @ estimate.team_from_base[frame]
    return math.hypot(start.x_m - ours.x_m, start.y_m - ours.y_m)


def test_a_wrong_estimate_is_told_and_the_worst_frame_named(open3d):
    assert open3d
    frames, edges, estimate = noisy_graph(4)
    moved = estimate.team_from_base | {
        frames[5]: estimate.team_from_base[frames[5]] @ Se2(0.01, 0, 0.02)
    }
    wrong = TeamEstimate(moved, estimate.component_of, {}, (), (), 0.0, 0)
    found = check_with_open3d(frames, edges, wrong)
    assert found.worst == frames[5]
    assert found.max_m == pytest.approx(0.01, abs=TOLERANCE_M)
    assert found.max_rad == pytest.approx(0.02, abs=TOLERANCE_RAD)


def test_edges_that_were_turned_down_take_no_part(open3d):
    assert open3d
    frames, edges, estimate = noisy_graph(5)
    lie = edge(estimate.team_from_base, frames[0], frames[9], Se2(0.5, 0.2, 1.0), np.eye(3) * 1e-8)
    verdict = EdgeVerdict(lie.a, lie.b, accepted=False, chi2=1e6, limit=11.3)
    judged = TeamEstimate(
        estimate.team_from_base, estimate.component_of, {}, (), (verdict,), 0.0, 0
    )
    found = check_with_open3d(frames, [*edges, lie], judged)
    assert found.num_edges == len(edges)
    assert found.max_m < TOLERANCE_M


def test_check_refuses_what_it_cannot_do():
    poses = circle("A", 600, 0.0)
    estimate = TeamEstimate(poses, dict.fromkeys(poses, 0), {}, (), (), 0.0, 0)
    with pytest.raises(TeamError, match="for small graphs: at most 500 frames, got 600"):
        check_with_open3d(list(poses), [], estimate)
    frames = list(poses)[:3]
    with pytest.raises(TeamError, match="no edge leads from A0 to A2: check one part at a time"):
        check_with_open3d(frames, [edge(poses, *frames[:2])], estimate)


def test_what_check_prints():
    found = Differences(26, 57, 1e-6, 2.5e-6, math.radians(0.001), FrameId("B", 7))
    assert found.line() == (
        "Open3D on 26 frames and 57 edges: positions differ by 0.0010 mm on average, "
        "0.0025 mm at B7; headings by 0.00100 deg at most"
    )


def refuse_import(monkeypatch, error):
    def fail(_):
        raise error

    monkeypatch.setattr(open3d_import.importlib, "import_module", fail)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            ModuleNotFoundError("No module named 'open3d'", name="open3d"),
            r"Open3D is not installed: pip install 'groundfuse\[view\]'",
        ),
        (
            ModuleNotFoundError("No module named 'dash'", name="dash"),
            "Open3D needs the package 'dash', which is missing",
        ),
        (
            ImportError("libusb-1.0.so.0: cannot open shared object file"),
            r"cannot start \(libusb-1.0.so.0: .*\); on Debian: apt-get install libegl1 libgl1 libx",
        ),
        (OSError("libGL.so.1"), r"Open3D cannot start \(libGL.so.1\)"),
    ],
)
def test_one_line_says_what_open3d_lacks(monkeypatch, error, message):
    refuse_import(monkeypatch, error)
    with pytest.raises(TeamError, match=message):
        import_open3d()


def test_a_window_needs_a_screen(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    message = "the 3D view needs a screen, but neither DISPLAY nor WAYLAND_DISPLAY is set"
    for look in (need_display, lambda: open_window(tmp_path), lambda: view_ply(tmp_path)):
        with pytest.raises(TeamError, match=message):
            look()
    assert main([str(tmp_path / "team.ply")]) == 2
    assert capsys.readouterr().err == f"view3d: {message}\n"
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    need_display()


def test_usage_of_the_viewer(capsys):
    assert main([]) == 2
    assert main(["--help"]) == 2
    assert "usage: python -m groundfuse.tools.view3d FILE.ply" in capsys.readouterr().err


def test_a_file_without_points_is_refused(open3d, monkeypatch, tmp_path):
    assert open3d
    monkeypatch.setenv("DISPLAY", ":0")
    path = tmp_path / "empty.ply"
    path.write_bytes(ply_bytes(*(np.zeros((0, n), np.uint8) for n in (3, 3, 2, 3))))
    with pytest.raises(DataError, match=r"empty.ply: no points to show"):
        open_window(path)


def test_a_viewer_that_dies_leaves_a_line(monkeypatch, tmp_path):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(view3d, "import_open3d", lambda: None)
    seen = []

    def run(command, *, check):
        seen.append((command[1:], check))
        return subprocess.CompletedProcess(command, -6)

    monkeypatch.setattr(view3d.subprocess, "run", run)
    with pytest.raises(TeamError, match=r"the 3D view ended with code -6; .*team.ply is there"):
        view_ply(tmp_path / "team.ply")
    assert seen == [(["-m", "groundfuse.tools.view3d", str(tmp_path / "team.ply")], False)]


WITHOUT_OPEN3D = textwrap.dedent("""
    import importlib, pathlib, pkgutil, sys
    asked = []
    class Blocked:
        def find_spec(self, name, path=None, target=None):
            if name.split(".")[0] == "open3d":
                asked.append(name)
                raise ModuleNotFoundError("blocked", name="open3d")
    sys.meta_path.insert(0, Blocked())
    sys.path.insert(0, sys.argv[2])
    import groundfuse.backend, groundfuse.frontend, groundfuse.tools
    names = []
    for package in (groundfuse.backend, groundfuse.frontend, groundfuse.tools):
        for module in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            importlib.import_module(module.name)
            names.append(module.name)
    from map_world import small_mosaic, small_team
    from groundfuse.tools.drawing import draw_location_graph
    from groundfuse.tools.errors import TeamError
    from groundfuse.tools.open3d_check import check_with_open3d
    from groundfuse.tools.view3d import write_ply
    estimate, edges = small_team()
    draw_location_graph(small_mosaic(), estimate, edges)
    write_ply(pathlib.Path(sys.argv[1]), small_mosaic(), estimate)
    before = list(asked)
    try:
        check_with_open3d(list(estimate.team_from_base), edges[:12], estimate)
    except TeamError as error:
        print(len(names), before, asked, error)
""")


def test_everything_else_works_without_open3d(tmp_path):
    path = tmp_path / "team.ply"
    command = [sys.executable, "-c", WITHOUT_OPEN3D, str(path), str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    count, _, rest = done.stdout.strip().partition(" ")
    assert int(count) > 30
    # Nothing asked for Open3D before the check did.
    assert rest == "[] ['open3d'] Open3D is not installed: pip install 'groundfuse[view]'"
    assert len(parsed(path.read_bytes())[1]) > 20_000
