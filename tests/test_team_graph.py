"""Teams out of files: who is meant by an id, every edge once, every fault with file and line."""

import numpy as np
import pytest
from graph_world import team
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend import g2o, jrl, jrl_reader, planar
from groundfuse.backend.graph_keys import key_of_symbol, parsed_scheme, symbol_name
from groundfuse.backend.graph_lines import Graph
from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.backend.team_graph import poses_of, shared_keys, team_graph
from groundfuse.backend.team_jrl import dataset_of_team, letters_of
from groundfuse.backend.team_source import source_of_dataset, source_of_graph

STEP = "1 0 0 1 0 0 1 0 1"
# Inverse of an inverse of condition 1e2: 1e-16 x 1e2 x a few; worst seen 4e-16.
INVERSE = 1e-12


def source(name, text, *, overlaps=False, frame_of=None):
    graph, places = g2o.parsed_with_places(text)
    return source_of_graph(name, name.split(".")[0], graph, places, frame_of, overlaps=overlaps)


def frames(*names):
    return tuple(FrameId(name[0], int(name[1:])) for name in names)


def ends(read):
    return [(str(e.a), str(e.b)) for e in read.edges]


def test_plain_ids_belong_to_their_file_and_overlaps_find_them():
    read = team_graph(
        [
            source("p.g2o", f"EDGE_SE2 0 1 {STEP}"),
            source("q.g2o", f"EDGE_SE2 2 3 {STEP}"),
            source("o.g2o", f"EDGE_SE2 1 2 {STEP}\nEDGE_SE2 0 1 {STEP}", overlaps=True),
        ]
    )
    assert read.frames == frames("p0", "p1", "q2", "q3")
    assert ends(read) == [("p0", "p1"), ("q2", "q3"), ("p1", "q2"), ("p0", "p1")][:3]
    assert read.places == ("p.g2o: line 1", "q.g2o: line 1", "o.g2o: line 1")
    assert read.notes == ("1 edges stand in two files and count once",)
    assert not shared_keys(read.key_of)


def test_an_edge_given_twice_in_one_file_is_two_measurements():
    read = team_graph([source("p.g2o", f"EDGE_SE2 0 1 {STEP}\nEDGE_SE2 0 1 {STEP}")])
    assert len(read.edges) == 2


def test_letters_name_frames_of_files_with_plain_ids():
    read = team_graph(
        [
            source("A.g2o", "VERTEX_SE2 0 0 0 0"),
            source("B.g2o", "VERTEX_SE2 0 5 0 0"),
            source("o.g2o", f"EDGE_SE2 A0 B0 {STEP}", overlaps=True),
        ]
    )
    assert ends(read) == [("A0", "B0")]
    assert read.start == dict(zip(frames("A0", "B0"), [Se2(0, 0, 0), Se2(5, 0, 0)], strict=True))
    assert shared_keys(read.key_of)


def test_files_with_each_others_edges_as_distributed_mapper_has_them():
    a0, a1, b0 = (key_of_symbol(r, k) for r, k in (("a", 0), ("a", 1), ("b", 0)))
    link = f"EDGE_SE2 {a1} {b0} {STEP}"
    read = team_graph(
        [
            source("0.g2o", f"VERTEX_SE2 {a0} 0 0 0\nVERTEX_SE2 {a1} 1 0 0\n{link}"),
            source("1.g2o", f"VERTEX_SE2 {b0} 0 0 0\n{link}"),
        ]
    )
    assert read.frames == frames("a0", "a1", "b0")
    assert ends(read) == [("a1", "b0")]


def test_one_file_of_all_with_offsets():
    text = f"EDGE_SE2 0 1 {STEP}\nEDGE_SE2 100 101 {STEP}\nEDGE_SE2 1 100 {STEP}"
    read = team_graph([source("team.g2o", text)], parsed_scheme("offset=100"))
    assert read.frames == frames("A0", "A1", "B0", "B1")
    assert ends(read)[2] == ("A1", "B0")
    assert read.key_of[FrameId("B", 1)] == 101


def test_a_sidecar_says_who_is_who():
    named = {0: FrameId("left", 4), 1: FrameId("right", 7)}
    text = f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 {STEP}"
    read = team_graph([source("team.g2o", text, frame_of=named)])
    assert read.frames == (FrameId("left", 4), FrameId("right", 7))


def test_overlaps_may_bring_a_robot_of_their_own():
    b9 = key_of_symbol("B", 9)
    read = team_graph(
        [
            source("A.g2o", "VERTEX_SE2 A0 0 0 0"),
            source("o.g2o", f"VERTEX_SE2 {b9} 0 0 0\nEDGE_SE2 A0 B9 {STEP}", overlaps=True),
        ]
    )
    assert read.frames == frames("A0", "B9")


def test_overlaps_may_repeat_vertices_elsewhere():
    read = team_graph(
        [
            source("A.g2o", "VERTEX_SE2 A0 0 0 0\nVERTEX_SE2 A1 1 0 0"),
            source("o.g2o", f"VERTEX_SE2 A0 9 9 0\nEDGE_SE2 A0 A1 {STEP}", overlaps=True),
        ]
    )
    assert read.start[FrameId("A", 0)] == Se2(0, 0, 0)


def test_fix_and_priors_are_told():
    (note,) = team_graph([source("A.g2o", "VERTEX_SE2 0 0 0 0\nFIX 0")]).notes
    assert note == (
        "A.g2o: 1 FIX read and not used: a component's frame is that of its first frame"
    )


@pytest.mark.parametrize(
    ("one", "two", "overlaps", "scheme", "message"),
    [
        (
            "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 0 0 0 0", f"EDGE_SE2 0 5 {STEP}", "auto",
            r"^o.g2o: line 1: edge: id 0 is a frame of p, q alike; name robots by letters",
        ),
        (
            "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 0 0 0", f"\nEDGE_SE2 0 5 {STEP}", "auto",
            "^o.g2o: line 2: edge: names vertex 5, which no file has$",
        ),
        (
            "VERTEX_SE2 A0 0 0 0", "VERTEX_SE2 B0 0 0 0", f"EDGE_SE2 A0 C0 {STEP}", "auto",
            "^o.g2o: line 1: edge: names frame C0, which no file has$",
        ),
        (
            f"VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 7 {STEP}", "VERTEX_SE2 1 0 0 0", "", "auto",
            "^p.g2o: line 2: edge: names vertex 7, which no file has$",
        ),
        (
            "VERTEX_SE2 A0 0 0 0", "VERTEX_SE2 A0 1 0 0", "", "auto",
            "^q.g2o: line 1: vertex A0 is another file's, elsewhere$",
        ),
        (
            "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 A0 1 0 0", "", "gtsam",
            "^p.g2o: line 1: id 0 has no robot's letter in its top byte$",
        ),
        (
            "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 0 0 0", "VERTEX_SE2 9 0 0 0", "auto",
            "^o.g2o: line 1: vertex 9 belongs to no robot$",
        ),
        (
            "VERTEX_SE2 0 1e10 0 0", "VERTEX_SE2 1 0 0 0", "", "auto",
            r"^p.g2o: line 1: a number is beyond 1e\+09$",
        ),
        (
            f"EDGE_SE2 0 1 1e300 0 0 {STEP[6:]}", "VERTEX_SE2 1 0 0 0", "", "plain",
            r"^p.g2o: line 1: a number is beyond 1e\+09$",
        ),
        (
            "EDGE_SE2 0 1 1 0 0 1e-200 0 0 1 0 1", "VERTEX_SE2 1 0 0 0", "", "plain",
            r"^p.g2o: line 1: a variance is beyond 1e-24 to 1e\+24$",
        ),
    ],
)  # fmt: skip
def test_faults_are_told_with_file_and_line(one, two, overlaps, scheme, message):
    sources = [source("p.g2o", one), source("q.g2o", two)]
    sources.append(source("o.g2o", overlaps, overlaps=True))
    with pytest.raises(ValueError, match=message):
        team_graph(sources, parsed_scheme(scheme))


def test_two_files_of_one_name_with_plain_ids_are_refused():
    two = [source("A.g2o", "VERTEX_SE2 0 0 0 0"), source("A.graph", "VERTEX_SE2 1 0 0 0")]
    with pytest.raises(ValueError, match=r"^A.graph: robot A is that of A.g2o too, rename one"):
        team_graph(two)


def test_an_empty_team_is_refused():
    with pytest.raises(ValueError, match=r"^A.g2o: holds no vertex and no edge$"):
        team_graph([source("A.g2o", "")])


def test_a_covariance_that_is_none_after_inversion_is_told():
    bad = source("A.g2o", f"EDGE_SE2 0 1 {STEP}")
    bad.covariance[0, 0, 1] = 0.5
    with pytest.raises(ValueError, match=r"^A.g2o: line 1: covariance of edge A0-A1 is not symm"):
        team_graph([bad])


def written(world, key):
    """A simulated team as text per robot, and its overlaps."""
    key_of = {f: key(f) for f in world.frames}
    truth = {f: planar.pose(p) for f, p in world.truth.items()}
    texts = {}
    for robot in sorted({f.robot for f in world.frames}):
        own = {f: p for f, p in truth.items() if f.robot == robot}
        texts[robot] = g2o.keyed(key_of, own, world.edges)
    outer = [e for e in world.edges if e.a.robot != e.b.robot]
    texts["o"] = Graph({}, g2o.keyed(key_of, truth, outer).edges)
    return texts, truth


@settings(max_examples=25)
@given(st.integers(0, 30), st.sampled_from(["symbols", "gtsam", "plain", "offset=1000"]))
def test_a_team_survives_its_files_in_every_scheme(seed, scheme):
    world = team(seed, robots=3, frames=7, loops=1, overlaps=2)
    number = {robot: k for k, robot in enumerate("ABC")}
    key = {
        "symbols": lambda f: key_of_symbol(f.robot, f.index),
        "gtsam": lambda f: key_of_symbol(f.robot, f.index),
        "plain": lambda f: 7 * number[f.robot] + f.index,
        "offset=1000": lambda f: 1000 * number[f.robot] + f.index,
    }[scheme]
    name_of = symbol_name if scheme == "symbols" else str
    texts, truth = written(world, key)
    sources = [
        source(f"{stem}.g2o", g2o.text_of(graph, name_of), overlaps=stem == "o")
        for stem, graph in texts.items()
    ]
    read = team_graph(sources, parsed_scheme("auto" if scheme == "symbols" else scheme))
    back = {f: FrameId(f.robot, key(f)) if scheme == "plain" else f for f in world.frames}
    assert set(read.frames) == set(back.values())
    assert read.start == {back[f]: truth[f] for f in world.frames}
    found = {(e.a, e.b, e.a_from_b): e.covariance for e in read.edges}
    wanted = {(back[e.a], back[e.b], e.a_from_b): e.covariance for e in world.edges}
    assert found.keys() == wanted.keys()
    assert all(np.allclose(found[k], wanted[k], rtol=INVERSE) for k in wanted)


@settings(max_examples=15)
@given(st.integers(0, 30))
def test_a_team_survives_jrl_with_truth_and_labels(seed):
    world = team(seed, robots=3, frames=7, loops=2, overlaps=2, wrong_loops=0.5)
    truth = {f: planar.pose(p) for f, p in world.truth.items()}
    letter = letters_of("ABC")
    labels = [not w for w in world.wrong]
    made = dataset_of_team("t", truth, world.edges, letter, truth, world.wrong, labels)
    read = team_graph([source_of_dataset("t.jrl", jrl_reader.parsed(jrl.text_of(made)))])
    assert read.frames == world.frames
    assert read.truth == read.start == truth
    found = {(e.a, e.b, e.a_from_b): w for e, w in zip(read.edges, read.wrong, strict=True)}
    wanted = {(e.a, e.b, e.a_from_b): w for e, w in zip(world.edges, world.wrong, strict=True)}
    assert found == wanted
    for e in read.edges:
        assert e.covariance.tobytes() == world.edges[0].covariance.tobytes()
    assert sum(map(len, made.potential_outlier_factors.values())) == sum(labels)


def test_a_pose_that_two_robots_give_is_its_owners():
    a0, mine, yours = key_of_symbol("a", 0), Se2(1, 0, 0), Se2(2, 0, 0)
    for robots in ("ab", "ba"):
        values = {"a": {a0: mine}, "b": {a0: yours}}
        dataset = jrl.Dataset("", tuple(robots), {}, None, {r: values[r] for r in robots})
        assert source_of_dataset("t", dataset).start == {a0: mine}


def test_measurements_stand_at_the_later_frame_of_their_robot():
    world = team(2, robots=2, frames=4, loops=0, overlaps=1)
    truth = {f: planar.pose(p) for f, p in world.truth.items()}
    made = dataset_of_team("t", truth, world.edges, letters_of("AB"))
    for robot, entries in made.measurements.items():
        assert [entry.stamp for entry in entries] == [0, 1, 2, 3]
        for entry in entries:
            for m in entry.measurements:
                own = [k & 0xFF for k in (m.a, m.b) if chr(k >> 56) == robot]
                assert max(own) == entry.stamp


def test_robots_without_a_letter_get_one():
    assert letters_of(["left", "right"]) == {"left": "a", "right": "b"}
    assert letters_of("BA") == {"A": "A", "B": "B"}
    with pytest.raises(ValueError, match="keys have 52 letters, got 53 robots"):
        letters_of([f"r{k}" for k in range(53)])


def test_truth_of_other_frames_is_left_out():
    sources = [source("A.g2o", "VERTEX_SE2 0 0 0 0"), source("B.g2o", "VERTEX_SE2 0 0 0 0")]
    read = team_graph(sources)
    values = {key_of_symbol("A", 0): Se2(1, 2, 3), key_of_symbol("C", 0): Se2(0, 0, 0)}
    found = poses_of(values | {0: Se2(9, 9, 9)}, sources[0], read.names)
    assert found == {FrameId("A", 0): Se2(1, 2, 3)}


def test_a_jrl_key_without_a_letter_needs_a_single_robot():
    measured = (
        '{"type": "BetweenFactorPose2", "key1": 0, "key2": 1, "covariance": [1,0,0,0,1,0,0,0,1],'
        ' "measurement": {"x": 1, "y": 0, "theta": 0}}'
    )
    text = (
        '{"name": "", "robots": ["a"%s], '
        '"measurements": {"a": [{"stamp": 0, "measurements": [%s]}]}}'
    )
    alone = jrl_reader.parsed(text % ("", measured))
    assert team_graph([source_of_dataset("t", alone)]).frames == frames("a0", "a1")
    both = jrl_reader.parsed(text % (', "b"', measured))
    with pytest.raises(ValueError, match=r"^t: id 0 has no robot's letter$"):
        team_graph([source_of_dataset("t", both)])
