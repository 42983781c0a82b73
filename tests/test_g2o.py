"""g2o text: exact round trips, gtsam's own reader, and a clear line for every fault."""

import math

import gtsam
import numpy as np
import pytest
from graph_texts import graphs, rows, spoiled, told
from graph_world import GRAPHS, team
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend import g2o
from groundfuse.backend.graph_keys import key_of_symbol, symbol_name
from groundfuse.backend.measurement import FrameId, Se2

# inverse of an inverse of condition 1e4: 1e-16 x 1e4 x a few; worst seen 3e-13.
INVERSE = 1e-9

WORDS = ["EDGE_SE2", "VERTEX_SE2", "EDGE2", "nan", "inf", "1_0", "-3", "1e999", "A7", "0", ""]


@given(graphs())
def test_every_digit_survives(graph):
    assert g2o.parsed(g2o.text_of(graph)) == graph


@given(graphs())
def test_every_digit_survives_letters_as_ids(graph):
    assert g2o.parsed(g2o.text_of(graph, symbol_name)) == graph


@settings(max_examples=150)
@given(st.text(alphabet="VERTEX_SED2 FIX#0123456789.-+einfa\n\t", max_size=200))
def test_anything_is_read_or_refused_with_a_line(text):
    refusal = told(g2o.parsed, text)
    assert refusal is None or refusal.startswith("line ")


@settings(max_examples=80)
@given(graphs(), st.data())
def test_a_spoiled_file_is_refused_with_its_line_or_wholly_read(graph, data):
    text = data.draw(spoiled(g2o.text_of(graph), WORDS))
    refusal = told(g2o.parsed, text)
    if refusal is not None:
        assert refusal.startswith("line ")
        return
    read = g2o.parsed(text)
    tags = [words[0] for words in rows(text)]
    assert tags.count("VERTEX_SE2") == len(read.vertices)
    assert tags.count("EDGE_SE2") == len(read.edges)
    assert sum(len(words) - 1 for words in rows(text) if words[0] == "FIX") == len(read.fixed)
    assert set(tags) <= {"VERTEX_SE2", "EDGE_SE2", "FIX"}


@settings(max_examples=100)
@given(graphs(), st.data())
def test_a_file_cut_anywhere_is_refused_or_a_whole_graph(graph, data):
    """No cut makes a number shorter without notice, except in the last field of a line."""
    text = g2o.text_of(graph)
    cut = text[: data.draw(st.integers(0, len(text)))]
    refusal = told(g2o.parsed, cut)
    if refusal is not None:
        assert "line " in refusal
        return
    read = g2o.parsed(cut)
    kept = max(0, len(read.edges) - 1)
    assert read.edges[:kept] == graph.edges[:kept]


def test_a_team_survives_with_its_names():
    world = team(3, frames=6, loops=0, overlaps=3)
    poses = {f: Se2(*map(float, p)) for f, p in world.truth.items()}
    graph = g2o.parsed(g2o.text_of(g2o.numbered(poses, world.edges)))
    frame_of = g2o.parsed_ids(g2o.ids_text(poses))
    assert {frame_of[k]: p for k, p in graph.vertices.items()} == poses
    assert sorted(graph.vertices) == list(range(len(poses)))
    assert len(graph.edges) == len(world.edges)
    for written, edge in zip(graph.edges, world.edges, strict=True):
        read = g2o.relative_pose(written, frame_of)
        assert (read.a, read.b, read.a_from_b) == (edge.a, edge.b, edge.a_from_b)
        assert np.allclose(read.covariance, edge.covariance, rtol=INVERSE)


def test_edges_to_other_robots_are_left_out_of_a_robots_file():
    world = team(3, frames=6, loops=0, overlaps=3)
    own = {f: Se2(*map(float, p)) for f, p in world.truth.items() if f.robot == "B"}
    assert len(g2o.numbered(own, world.edges).edges) == 5


def test_gtsam_reads_what_we_write(tmp_path):
    world = team(5, frames=8, loops=2, overlaps=3)
    poses = {f: Se2(*map(float, p)) for f, p in world.truth.items()}
    ours = g2o.numbered(poses, world.edges)
    path = tmp_path / "team.g2o"
    path.write_text(g2o.text_of(ours))
    graph, values = gtsam.readG2o(str(path), is3D=False)
    assert graph.size() == len(ours.edges)
    assert values.size() == len(poses)
    for key, pose in ours.vertices.items():
        read = values.atPose2(key)
        assert (read.x(), read.y()) == (pose.x_m, pose.y_m)
        assert read.theta() == pytest.approx(pose.theta_rad, abs=1e-15)
    for k, edge in enumerate(ours.edges):
        factor = graph.at(k)
        assert factor.keys() == [edge.a, edge.b]
        z = factor.measured()
        assert [z.x(), z.y()] == [edge.a_from_b.x_m, edge.a_from_b.y_m]
        information = factor.noiseModel().information()
        assert np.allclose(information, g2o.matrix(edge.information), rtol=1e-12)


def test_a_file_without_vertices_and_with_fix_and_comments_is_read():
    text = "# made by hand\n\nFIX 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1  # step\n"
    graph = g2o.parsed(text)
    assert graph.fixed == (0,)
    assert [(e.a, e.b) for e in graph.edges] == [(0, 1)]
    assert graph.vertices == {}
    assert g2o.text_of(graph).splitlines()[-1] == "FIX 0"  # gtsam reads no edge after it


VERTICES = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n"
EDGE = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 1 0 0", "line 2: vertex 0 is given twice"),
        ("VERTEX_SE2 0 0 0", "line 1: needs VERTEX_SE2 id x y theta, got 4 fields"),
        ("VERTEX_SE2 0 0 0 0 0", "line 1: needs VERTEX_SE2 id x y theta, got 6 fields"),
        ("VERTEX_SE2 0 0 nan 0", "line 1: every number must be finite, got nan"),
        ("VERTEX_SE2 0 0 inf 0", "line 1: every number must be finite, got inf"),
        ("VERTEX_SE2 -1 0 0 0", "line 1: an id must be a whole number from 0, or like A12, got -1"),
        (
            "VERTEX_SE2 1.0 0 0 0",
            "line 1: an id must be a whole number from 0, or like A12, got 1.0",
        ),
        ("VERTEX_SE2 0 x 0 0", "line 1: could not convert string to float: 'x'"),
        ("VERTEX_XY 0 0 0", "line 1: unknown tag VERTEX_XY; VERTEX_SE2, EDGE_SE2 and FIX are read"),
        ("VERTEX_SE3:QUAT 0", "line 1: unknown tag VERTEX_SE3:QUAT: it is three-dimensional"),
        (
            "\n\nEDGE_SE2 0 1 1 0 0",
            "line 3: needs EDGE_SE2 id_a id_b x y theta I11 .*, got 6 fields",
        ),
        ("EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1", "line 1: an edge needs two different vertices, got 1"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1", "line 1: information must be positive definite, .* -1"),
        ("EDGE_SE2 0 1 1 0 0 1 2 0 1 0 1", "smallest eigenvalue is -1"),
        ("EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0", "smallest eigenvalue is 0"),
        ("FIX", "^line 1: FIX needs an id$"),
        (VERTICES + "FIX 1\nFIX 2", "^line 4: FIX names vertex 2, which the file lacks$"),
        ("VERTEX_SE2 0 1_0 0 0", "line 1: could not read the number 1_0"),
        ("EDGE2 0 1", "line 1: unknown tag EDGE2: it is TORO's"),
        ("EDGE_SE3:QUAT 0 1", "line 1: unknown tag EDGE_SE3:QUAT: it is three-dimensional"),
        ("VERTEX_TRACKXYZ 0 1", "unknown tag VERTEX_TRACKXYZ: it is three-dimensional"),
        ("EDGE_SE2_XY 0 1 1 1", "line 1: unknown tag EDGE_SE2_XY; VERTEX_SE2, EDGE_SE2"),
        ("VERTEX_SE2 18446744073709551616 0 0 0", "line 1: an id must be below 2.64"),
        (VERTICES + EDGE.replace(" 1 1 ", " 7 1 ", 1), "line 3: edge names vertex 7, which"),
        ("FIX zero", "line 1: an id must be a whole number from 0, or like A12, got zero"),
    ],
)
def test_faults_are_told_with_their_line(text, message):
    with pytest.raises(ValueError, match=message):
        g2o.parsed(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", 'needs a list "vertices"'),
        ('{"vertices": [["A", 0], ["A"]]}', r"vertex 1 needs \[robot, index\], got \['A'\]"),
        ('{"vertices": [["A", true]]}', r"vertex 0 needs \[robot, index\]"),
        ('{"vertices": [["A", 1], ["A", 1]]}', "a frame is given twice"),
        ('{"ids": [1], "vertices": []}', "needs one id per vertex, got 1 for 0"),
        ('{"ids": [1, 1], "vertices": [["A", 0], ["A", 1]]}', "needs one id per vertex"),
        ('{"ids": ["1"], "vertices": [["A", 0]]}', "an id must be a whole number from 0, got 1"),
        ('{"vertices": [["A", -1]]}', r"vertex 0 needs \[robot, index\]"),
        ("{", "line 1"),
    ],
)
def test_faults_of_the_sidecar_are_told(text, message):
    with pytest.raises(ValueError, match=message):
        g2o.parsed_ids(text)


def test_headings_are_kept_as_they_are():
    graph = g2o.Graph({0: Se2(0.0, 0.0, 3 * math.pi)}, ())
    assert g2o.parsed(g2o.text_of(graph)).vertices[0].theta_rad == 3 * math.pi


@pytest.mark.parametrize("name", ["manhattan.g2o", "CSAIL.g2o", "intel.g2o", "MIT.g2o"])
def test_public_graphs_survive(name):
    path = GRAPHS / name
    if not path.exists():
        pytest.skip(f"{path} is not on this machine; its licence keeps it out of the repository")
    graph = g2o.parsed(path.read_text())
    assert g2o.parsed(g2o.text_of(graph)) == graph


def test_ids_are_sorted_frames():
    frames = [FrameId("B", 1), FrameId("A", 3), FrameId("B", 0)]
    assert g2o.parsed_ids(g2o.ids_text(frames)) == dict(enumerate(sorted(frames)))


def test_frames_keep_ids_of_their_own():
    world = team(3, frames=6, loops=0, overlaps=3)
    poses = {f: Se2(*map(float, p)) for f, p in world.truth.items()}
    key_of = {f: key_of_symbol(f.robot, f.index) for f in poses}
    graph = g2o.parsed(g2o.text_of(g2o.keyed(key_of, poses, world.edges)))
    frame_of = g2o.parsed_ids(g2o.keyed_ids_text(key_of))
    assert {frame_of[k]: p for k, p in graph.vertices.items()} == poses
    assert [(frame_of[e.a], frame_of[e.b]) for e in graph.edges] == [
        (e.a, e.b) for e in world.edges
    ]


def test_letters_stand_for_gtsams_keys():
    (edge,) = g2o.parsed("EDGE_SE2 A12 b7 1 0 0 1 0 0 1 0 1").edges
    assert (edge.a, edge.b) == (gtsam.symbol("A", 12), gtsam.symbol("b", 7))
