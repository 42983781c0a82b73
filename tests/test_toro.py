"""TORO text: exact round trips, gtsam's own reader, g2o's graph in other words, every fault."""

import gtsam
import numpy as np
import pytest
from graph_texts import graphs, rows, spoiled, told
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend import g2o, toro
from groundfuse.backend.graph_lines import Edge, Graph, matrix
from groundfuse.backend.measurement import Se2

WORDS = ["EDGE2", "VERTEX2", "EDGE_SE2", "EQUIV", "nan", "inf", "1_0", "-3", "1e999", "A7", "0", ""]
EDGE = "EDGE2 0 1 1 0 0 4 1 5 6 2 3"


@given(graphs())
def test_every_digit_survives(graph):
    assert toro.parsed(toro.text_of(graph)) == graph


@given(graphs())
def test_it_says_the_same_as_g2o(graph):
    assert toro.parsed(toro.text_of(g2o.parsed(g2o.text_of(graph)))) == graph


def test_the_order_of_the_information_is_forward_sideward_rotation():
    """Against the definition: inf_ff inf_fs inf_ss inf_rr inf_fr inf_sr."""
    (edge,) = toro.parsed(EDGE).edges
    assert matrix(edge.information).tolist() == [[4, 1, 2], [1, 5, 3], [2, 3, 6]]


def test_gtsam_reads_what_we_write(tmp_path):
    """A second implementation, with its own constant for the order."""
    edges = (
        Edge(3, 7, Se2(1.0, -0.5, 0.25), (10.0, 1.0, 2.0, 20.0, 3.0, 30.0)),
        Edge(7, 3, Se2(-1.0, 0.5, -0.75), (40.0, -1.0, 0.5, 50.0, 4.0, 60.0)),
    )
    graph = Graph({3: Se2(0.5, 0.25, 0.0), 7: Se2(1.0, 2.0, 0.5)}, edges, (3,))
    path = tmp_path / "team.graph"
    path.write_text(toro.text_of(graph))
    order = gtsam.NoiseFormat.NoiseFormatTORO
    factors, values = gtsam.load2D(str(path), None, 0, False, True, order)  # noqa: FBT003
    assert (factors.size(), values.size()) == (2, 2)
    for k, edge in enumerate(edges):
        factor = factors.at(k)
        assert factor.keys() == [edge.a, edge.b]
        z = factor.measured()
        assert (z.x(), z.y()) == (edge.a_from_b.x_m, edge.a_from_b.y_m)
        # A matrix through its square root and back: some 1e-15 relative; worst seen 4e-16.
        information = factor.noiseModel().information()
        assert np.allclose(information, matrix(edge.information), rtol=1e-12)


@settings(max_examples=60)
@given(graphs(), st.data())
def test_a_spoiled_file_is_refused_with_its_line_or_wholly_read(graph, data):
    text = data.draw(spoiled(toro.text_of(graph), WORDS))
    refusal = told(toro.parsed, text)
    if refusal is not None:
        assert refusal.startswith("line ")
        return
    read = toro.parsed(text)
    tags = [words[0] for words in rows(text)]
    assert tags.count("VERTEX2") == len(read.vertices)
    assert tags.count("EDGE2") == len(read.edges)
    assert sum(len(words) - 1 for words in rows(text) if words[0] == "FIX") == len(read.fixed)
    assert set(tags) <= {"VERTEX2", "EDGE2", "FIX"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX2 0 0 0", "^line 1: needs VERTEX2 id x y theta, got 4 fields$"),
        (
            "EDGE2 0 1 1 0 0 1",
            "^line 1: needs EDGE2 id_a id_b x y theta I11 I12 I22 I33 I13 I23, got 7 fields$",
        ),
        ("\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "^line 2: unknown tag EDGE_SE2: it is g2o's$"),
        ("VERTEX_SE2 0 0 0 0", "^line 1: unknown tag VERTEX_SE2: it is g2o's$"),
        ("EQUIV 1 2", "^line 1: unknown tag EQUIV: equal vertices are not merged"),
        ("VERTEX3 0 0 0 0 0 0 0", "^line 1: unknown tag VERTEX3: it is three-dimensional"),
        ("EDGE3 0 1 0", "^line 1: unknown tag EDGE3: it is three-dimensional"),
        ("EDGE 0 1 0", "^line 1: unknown tag EDGE; VERTEX2, EDGE2 and FIX are read$"),
        (
            "EDGE2 0 1 1 0 0 4 0 0 5 0 6",
            "^line 1: information must be positive .* is -4; it would be in the order of g2o",
        ),
        ("EDGE2 0 1 1 0 0 -4 0 5 6 0 0", "^line 1: .* its smallest eigenvalue is -4$"),
        ("VERTEX2 0 0 0 0\n" + EDGE, "^line 2: edge names vertex 1, which the file lacks$"),
    ],
)
def test_faults_are_told_with_their_line(text, message):
    with pytest.raises(ValueError, match=message):
        toro.parsed(text)
