"""What the out folder says is what was found, to the last digit, each thing once."""

import csv
import io
import json
import math
import os

import gtsam
import numpy as np
import pytest
from fused_world import (
    SIGMA_M,
    SIGMA_RAD,
    A,
    B,
    bundle_of,
    chain,
    edge,
    fused_of,
    odometry,
    rejected,
    robots_of,
    world,
)
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend import g2o
from groundfuse.backend.measurement import Attitude, FrameId, Reason, Se2
from groundfuse.backend.trajectory import parsed_tum
from groundfuse.tools import outputs
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.trajectory_file import read_trajectory

# Edges without noise: sums of a few doubles of size 3, and gtsam's iterations; worst seen 4e-13.
EXACT = 1e-9
# 1 / (1 / covariance) of a well-conditioned 3x3; worst seen 3e-16 of the value.
INVERSE = 1e-9

NAMES = st.text(st.sampled_from('Ar1._-Ü "'), min_size=1, max_size=4)


@pytest.fixture
def truth():
    return world()


def met(truth):
    """Two robots that meet at three places, a loop, and a pair that was turned down at once."""
    edges = [*chain(truth, A), *chain(truth, B), edge(truth, A[0], A[5])]
    edges += [edge(truth, A[1], B[0]), edge(truth, A[3], B[2]), edge(truth, A[2], B[1])]
    return edges


def rows_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def same_poses(found, wanted):
    assert set(found) == set(wanted)
    return all(np.allclose(found[f].vector(), wanted[f].vector(), atol=EXACT) for f in found)


# Names


@given(st.tuples(NAMES, st.integers(0, 200)), st.tuples(NAMES, st.integers(0, 200)))
def test_no_two_frames_are_written_alike(one, two):
    assert (str(FrameId(*one)) == str(FrameId(*two))) == (one == two)


def test_frames_read_as_people_write_them():
    assert str(FrameId("A", 12)) == "A12"
    assert str(FrameId("robot1", 2)) == "robot1.2"
    assert str(FrameId("robot", 12)) == "robot12"


@pytest.mark.parametrize(
    ("names", "name", "other"),
    [
        (["A", "team"], "team", "team"),
        (["team_2"], "team_2", "team"),
        (["A", "A_1"], "A_1", "A"),
        (["A_chained", "A"], "A_chained", "A"),
        (["A_chained_3", "A"], "A_chained_3", "A"),
        (["A", "B", "B_groundtruth"], "B_groundtruth", "B"),
    ],
)
def test_robots_whose_files_would_collide_are_refused(names, name, other):
    message = f"robot '{name}': its files would be taken for {other}'s, rename it"
    with pytest.raises(TeamError) as caught:
        outputs.check_names(names)
    assert str(caught.value) == message


def test_names_that_only_look_alike_pass():
    outputs.check_names(["A", "A1", "A_b", "AA", "a", "teams", "my_team", "A.1", "A_1_b", "x(1)"])


# Text


@given(st.lists(st.floats(), min_size=1, max_size=5))
def test_a_number_in_a_csv_keeps_every_digit(values):
    text = outputs.csv_text([f"c{k}" for k in range(len(values))], [values, values[::-1]])
    _, first, second = csv.reader(io.StringIO(text))
    for found, wanted in ((first, values), (second, values[::-1])):
        read = [float(cell) for cell in found]
        assert all(r == w or (math.isnan(r) and math.isnan(w)) for r, w in zip(read, wanted))  # noqa: B905


def test_cells_of_a_csv():
    rows = [[np.float64(0.1), None, 'a, "b"', 3, FrameId("A", 1)]]
    text = outputs.csv_text(("x", "y", "z", "n", "f"), rows)
    assert text == 'x,y,z,n,f\n0.1,,"a, ""b""",3,A1\n'


def test_json_has_no_word_that_json_lacks(tmp_path):
    content = {"a": math.inf, "b": [1.5, -math.inf, (math.nan, None)], 3: {"deep": math.nan}}
    outputs.write_json(tmp_path / "x.json", content)

    def refuse(word):
        pytest.fail(f"{word} is no JSON")

    text = (tmp_path / "x.json").read_text()
    assert json.loads(text, parse_constant=refuse) == {
        "a": None,
        "b": [1.5, None, [None, None]],
        "3": {"deep": None},
    }
    assert text.endswith("}\n")


# Pairs


def test_every_tried_pair_stands_once_with_its_numbers(tmp_path, truth):
    turned = [rejected(A[0], B[3]), rejected(A[0], A[3], Reason.AMBIGUOUS, 0.75, 0.6)]
    edges = met(truth)
    outputs.write_pairs(tmp_path, fused_of(robots_of([*A, *B]), edges, turned))
    rows = rows_of(tmp_path / "pairs.csv")
    assert tuple(rows[0]) == outputs.PAIR_COLUMNS
    tried = sorted((e.a, e.b) for e in [*edges, *turned])
    assert [(r["a"], r["b"]) for r in rows] == [(str(a), str(b)) for a, b in tried]
    by_pair = {(r["a"], r["b"]): r for r in rows}
    for e in edges:
        row = by_pair[str(e.a), str(e.b)]
        assert row["verdict"] == "used"
        assert row["reason"] == row["value"] == row["limit"] == ""
        pose = [float(row[name]) for name in ("x_m", "y_m", "theta_deg")]
        assert pose == [e.a_from_b.x_m, e.a_from_b.y_m, math.degrees(e.a_from_b.theta_rad)]
        sigma = [float(row[name]) for name in outputs.SIGMAS]
        assert sigma == pytest.approx([SIGMA_M, 1.5 * SIGMA_M, math.degrees(SIGMA_RAD)])
        assert (row["inliers"], row["ambiguity"]) == ("50", "0.25")
        # The paper's Gamma: b seen from a at distance and bearing, a seen from b (eq. 18).
        rho_m, phi1, phi2 = (float(row[name]) for name in outputs.GAMMA)
        back = e.a_from_b.inverse()
        for bearing, seen in ((phi1, e.a_from_b), (phi2, back)):
            turn = math.radians(bearing)
            ends = [rho_m * math.cos(turn), rho_m * math.sin(turn)]
            assert ends == pytest.approx([seen.x_m, seen.y_m], abs=EXACT)
        assert 0.0 <= float(row["chi2"]) < EXACT
    few = by_pair["A0", "B3"]
    assert (few["verdict"], few["reason"]) == ("rejected", "few_inliers")
    assert (float(few["value"]), float(few["limit"])) == (7.0, 12.0)
    assert few["x_m"] == few["inliers"] == few["chi2"] == ""
    assert by_pair["A0", "A3"]["reason"] == "ambiguous"


def test_a_wrong_pair_says_that_the_graph_turned_it_down(tmp_path, truth):
    wrong = edge(truth, A[4], B[3], Se2(0.5, 0.2, 0.3))
    outputs.write_pairs(tmp_path, fused_of(robots_of([*A, *B]), [*met(truth), wrong]))
    rows = {(r["a"], r["b"]): r for r in rows_of(tmp_path / "pairs.csv")}
    row = rows.pop(("A4", "B3"))
    assert (row["verdict"], row["reason"]) == ("turned_down", "inconsistent")
    assert float(row["value"]) == float(row["chi2"]) > float(row["limit"]) > 0.0
    assert {r["verdict"] for r in rows.values()} == {"used"}


def test_odometry_and_picture_of_one_pair_keep_their_own_verdicts(tmp_path, truth):
    """The picture is right, odometry slipped by 0.3 m on the same step."""
    slip = Se2(0.3, 0.0, 0.0)
    drawn = {A[0]: truth[A[0]], A[1]: truth[A[1]] @ slip}
    robots = robots_of(A, odometry={f: odometry(p, 0.001, 0.001) for f, p in drawn.items()})
    edges = [*chain(truth, A), edge(truth, A[0], A[2]), edge(truth, A[0], A[3])]
    fused = fused_of(robots, edges)
    assert len(fused.edges) == len(edges) + 1
    assert not fused.team.verdicts[-1].accepted
    outputs.write_pairs(tmp_path, fused)
    rows = rows_of(tmp_path / "pairs.csv")
    assert len(rows) == len(edges)
    assert {r["verdict"] for r in rows} == {"used"}
    assert all(float(r["chi2"]) < EXACT for r in rows)


def test_what_the_bundle_turned_down_is_not_called_used(tmp_path, truth):
    robots, edges = robots_of([*A, *B]), met(truth)
    late = rejected(A[3], B[2], Reason.RESIDUAL, 0.1, 0.3)
    plain = fused_of(robots, edges)
    fused = fused_of(robots, edges, bundled=bundle_of(plain.team, rejected=[late]))
    outputs.write_pairs(tmp_path, fused)
    rows = {(r["a"], r["b"]): r for r in rows_of(tmp_path / "pairs.csv")}
    row = rows.pop(("A3", "B2"))
    assert (row["verdict"], row["reason"]) == ("turned_down", "residual")
    assert (float(row["value"]), float(row["limit"])) == (0.1, 0.3)
    assert {r["verdict"] for r in rows.values()} == {"used"}
    outputs.write_graphs(tmp_path, fused)
    graph = g2o.parsed((tmp_path / "team.g2o").read_text())
    frames = sorted([*A, *B])
    named = {(frames[e.a], frames[e.b]) for e in graph.edges}
    assert named == {(e.a, e.b) for e in edges} - {(A[3], B[2])}


def test_no_pair_at_all(tmp_path):
    outputs.write_pairs(tmp_path, fused_of(robots_of(A[:1]), []))
    assert (tmp_path / "pairs.csv").read_text() == ",".join(outputs.PAIR_COLUMNS) + "\n"


# Graphs


def graph_of(folder, stem):
    """A g2o file and its sidecar, as poses by frame and edges by pair of frames."""
    graph = g2o.parsed((folder / f"{stem}.g2o").read_text())
    frame_of = g2o.parsed_ids((folder / f"{stem}.ids.json").read_text())
    assert list(graph.vertices) == list(range(len(graph.vertices))) == sorted(frame_of)
    poses = {frame_of[key]: pose for key, pose in graph.vertices.items()}
    return poses, {(frame_of[e.a], frame_of[e.b]): e for e in graph.edges}


def test_graphs_hold_the_poses_and_the_measurements(tmp_path, truth):
    edges = met(truth)
    fused = fused_of(robots_of([*A, *B]), edges)
    outputs.write_graphs(tmp_path, fused)
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {f"{s}.{e}" for s in ("A", "B", "team") for e in ("g2o", "ids.json")}
    for stem, frames in (("A", A), ("B", B), ("team", [*A, *B])):
        poses, named = graph_of(tmp_path, stem)
        start = truth[frames[0]]
        assert same_poses(poses, {f: start.inverse() @ truth[f] for f in frames})
        inner = {(e.a, e.b): e for e in edges if e.a in frames and e.b in frames}
        assert set(named) == set(inner)
        for pair, e in inner.items():
            assert named[pair].a_from_b == e.a_from_b
            information = g2o.matrix(named[pair].information)
            assert information @ e.covariance == pytest.approx(np.eye(3), abs=INVERSE)


def test_gtsam_reads_the_graphs(tmp_path, truth):
    fused = fused_of(robots_of([*A, *B]), met(truth))
    outputs.write_graphs(tmp_path, fused)
    for stem in ("A", "B", "team"):
        poses, edges = graph_of(tmp_path, stem)
        graph, values = gtsam.readG2o(str(tmp_path / f"{stem}.g2o"), is3D=False)
        assert (graph.size(), values.size()) == (len(edges), len(poses))
        assert graph.error(values) < EXACT


def test_a_wrong_edge_stays_out_of_the_graphs(tmp_path, truth):
    wrong = [edge(truth, A[4], B[3], Se2(0.5, 0.2, 0.3)), edge(truth, A[1], A[5], Se2(0, 0.4, 0))]
    fused = fused_of(robots_of([*A, *B]), [*met(truth), *wrong])
    outputs.write_graphs(tmp_path, fused)
    assert (A[4], B[3]) not in graph_of(tmp_path, "team")[1]
    assert (A[1], A[5]) not in graph_of(tmp_path, "team")[1]
    assert (A[1], A[5]) not in graph_of(tmp_path, "A")[1]
    assert len(graph_of(tmp_path, "team")[1]) == len(met(truth))


def test_components_have_files_of_their_own_the_largest_without_a_number(tmp_path, truth):
    """A's chain is cut after A3, and B met nobody."""
    edges = [*chain(truth, A[:4]), *chain(truth, A[4:]), *chain(truth, B)]
    fused = fused_of(robots_of([*A, *B]), edges)
    outputs.write_graphs(tmp_path, fused)
    found = {
        s: set(graph_of(tmp_path, s)[0]) for s in ("team", "team_1", "team_2", "A", "A_1", "B")
    }
    assert found["team"] == found["A"] == set(A[:4])
    assert found["team_1"] == found["B"] == set(B)
    assert found["team_2"] == found["A_1"] == set(A[4:])
    assert len(list(tmp_path.iterdir())) == 12


def test_a_lone_frame_is_a_graph_without_edges(tmp_path):
    outputs.write_graphs(tmp_path, fused_of(robots_of(A[:1]), []))
    assert (tmp_path / "team.g2o").read_text() == "VERTEX_SE2 0 0.0 0.0 0.0\n"


# Trajectories and poses


def test_trajectories_are_in_the_teams_frame_the_robots_own_and_the_worlds(tmp_path, truth):
    fused = fused_of(robots_of([*A, *B], truth), met(truth))
    outputs.write_trajectories(tmp_path, fused)
    for name, frames in (("A", A), ("B", B)):
        times = [10.0 + 0.5 * f.index for f in frames]
        wanted = {
            name: [truth[A[0]].inverse() @ truth[f] for f in frames],
            f"{name}_chained": [truth[frames[0]].inverse() @ truth[f] for f in frames],
            f"{name}_groundtruth": [truth[f] for f in frames],
        }
        for stem, poses in wanted.items():
            stamped = parsed_tum((tmp_path / f"{stem}.tum").read_text())
            assert [t for t, _ in stamped] == times
            for (_, found), pose in zip(stamped, poses, strict=True):
                assert found.vector() == pytest.approx(pose.vector(), abs=EXACT)
        # Our own reader of ground truth takes them too.
        assert len(read_trajectory(tmp_path / f"{name}.tum")) == len(frames)
    assert len(list(tmp_path.iterdir())) == 6


def test_no_truth_no_true_trajectory(tmp_path, truth):
    outputs.write_trajectories(tmp_path, fused_of(robots_of(A), chain(truth, A)))
    assert {p.name for p in tmp_path.iterdir()} == {"A.tum", "A_chained.tum"}


def test_a_cut_chain_has_a_trajectory_per_piece(tmp_path, truth):
    """The loop A0-A11 joins the optimised pieces, which the steps alone leave apart."""
    later = [FrameId("A", 10), FrameId("A", 11)]
    truth |= {later[0]: Se2(2.0, 1.0, 0.3), later[1]: Se2(2.2, 1.0, 0.3)}
    frames = [*A[:3], *later]
    edges = [*chain(truth, A[:3]), *chain(truth, later), edge(truth, A[0], later[1])]
    fused = fused_of(robots_of(frames), edges)
    outputs.write_trajectories(tmp_path, fused)
    sizes = {p.name: len(parsed_tum(p.read_text())) for p in tmp_path.iterdir()}
    assert sizes == {"A.tum": 5, "A_chained.tum": 3, "A_chained_1.tum": 2}


def test_a_robot_in_two_components_has_a_trajectory_in_each(tmp_path, truth):
    outputs.write_trajectories(tmp_path, fused_of(robots_of(A), [*chain(truth, A[:4])]))
    sizes = {p.name: len(parsed_tum(p.read_text())) for p in tmp_path.iterdir()}
    assert sizes["A.tum"] == 4
    assert sizes["A_1.tum"] == sizes["A_2.tum"] == 1


def test_poses_stand_with_their_sigmas(tmp_path, truth):
    fused = fused_of(robots_of([*B, *A]), met(truth))
    outputs.write_poses(tmp_path, fused)
    rows = rows_of(tmp_path / "poses.csv")
    assert tuple(rows[0]) == outputs.POSE_COLUMNS
    assert [(r["robot"], int(r["index"])) for r in rows] == [(f.robot, f.index) for f in [*A, *B]]
    assert {r["component"] for r in rows} == {"0"}
    assert rows[7]["image"] == "img_01.png"
    for frame, row in zip([*A, *B], rows, strict=True):
        pose = truth[A[0]].inverse() @ truth[frame]
        found = [float(row["x_m"]), float(row["y_m"]), math.radians(float(row["theta_deg"]))]
        assert found == pytest.approx(pose.vector(), abs=EXACT)
    assert [rows[0][name] for name in outputs.SIGMAS] == ["", "", ""]
    for frame, row in list(zip([*A, *B], rows, strict=True))[1:]:
        variance = np.diag(fused.best.covariance[frame])
        sigma = [float(row[name]) for name in outputs.SIGMAS]
        assert sigma[:2] == pytest.approx(np.sqrt(variance[:2]))
        assert math.radians(sigma[2]) == pytest.approx(math.sqrt(variance[2]))


def test_estimated_attitudes_stand_in_degrees_and_metres(tmp_path, truth):
    robots, edges = robots_of([*A, *B]), met(truth)
    plain = fused_of(robots, edges)
    outputs.write_attitudes(tmp_path, plain)
    assert not list(tmp_path.iterdir())  # nothing was estimated
    attitude = {f: Attitude(0.5 + 0.01 * f.index, -0.02, 0.56) for f in [*A, *B]}
    sigma = {f: Attitude(0.001, 0.002, 0.003) for f in [*A, *B]}
    bundled = bundle_of(plain.team, attitude=attitude, sigma=sigma)
    outputs.write_attitudes(tmp_path, fused_of(robots, edges, bundled=bundled))
    rows = rows_of(tmp_path / "frames_estimated.csv")
    assert tuple(rows[0]) == outputs.ATTITUDE_COLUMNS
    assert [(r["robot"], int(r["index"])) for r in rows] == [(f.robot, f.index) for f in [*A, *B]]
    row = rows[2]
    assert row["image"] == "img_02.png"
    degrees = [float(row[n]) for n in ("tilt_deg", "tilt_sigma_deg", "roll_deg", "roll_sigma_deg")]
    assert np.radians(degrees) == pytest.approx([0.52, 0.001, -0.02, 0.002])
    assert (float(row["height_m"]), float(row["height_sigma_m"])) == (0.56, 0.003)


def test_poses_and_graph_are_the_bundles_where_there_is_one(tmp_path, truth):
    robots, edges = robots_of([*A, *B]), met(truth)
    plain = fused_of(robots, edges).team
    moved = {f: Se2(p.x_m + 0.25, p.y_m, p.theta_rad) for f, p in plain.team_from_base.items()}
    fused = fused_of(robots, edges, bundled=bundle_of(plain, poses=moved))
    outputs.write_poses(tmp_path, fused)
    outputs.write_graphs(tmp_path, fused)
    outputs.write_trajectories(tmp_path, fused)
    found = {f: float(r["x_m"]) for f, r in zip([*A, *B], rows_of(tmp_path / "poses.csv"))}  # noqa: B905
    assert found == {f: p.x_m for f, p in moved.items()}
    assert graph_of(tmp_path, "team")[0] == moved
    assert parsed_tum((tmp_path / "B.tum").read_text())[0][1].x_m == moved[B[0]].x_m


def test_an_out_folder_that_vanished_is_one_line(tmp_path, truth):
    (tmp_path / "file").write_text("x")
    fused = fused_of(robots_of(A), chain(truth, A))
    for write in (
        outputs.write_pairs,
        outputs.write_poses,
        outputs.write_graphs,
        outputs.write_trajectories,
    ):
        with pytest.raises(DataError, match=r"cannot write: a file stands where a folder is need"):
            write(tmp_path / "file", fused)


def test_files_of_an_earlier_run_are_found(tmp_path):
    for name, age_s in (("team_1.g2o", 100.0), ("notes.txt", 50.0), ("team.g2o", 0.0)):
        (tmp_path / name).write_text("x")
        os.utime(tmp_path / name, (1000.0 - age_s, 1000.0 - age_s))
    (tmp_path / "overhead").mkdir()
    os.utime(tmp_path / "overhead", (1.0, 1.0))
    assert outputs.files_before(tmp_path, 1000.0) == ["notes.txt", "team_1.g2o"]
    assert outputs.files_before(tmp_path, 1.0) == []
