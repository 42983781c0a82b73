"""Simulated teams on disk: what they hold, what they call wrong, and every wrong option."""

import csv
import io
from contextlib import redirect_stderr, redirect_stdout
from itertools import pairwise

import numpy as np
import pytest

from groundfuse.backend import g2o, jrl_reader, planar, toro
from groundfuse.backend.graph_keys import key_of_symbol
from groundfuse.backend.measurement import FrameId
from groundfuse.tools import simulate_team
from groundfuse.tools.graph_files import read_team_graph

SHAPE = ("--robots", 3, "--frames", 30, "--overlaps", 10, "--loops", 6)
# Eight sigma of 0.02 m and 0.3 deg: once in 1e14 numbers.
SIGMA = np.array([0.02, 0.02, np.radians(0.286)])
FAR = 8.0


def run(*arguments):
    stdout, stderr = io.StringIO(), io.StringIO()
    with redirect_stdout(stdout), redirect_stderr(stderr):
        try:
            code = simulate_team.main([str(a) for a in arguments])
        except SystemExit as stop:
            code = stop.code
    return code, stdout.getvalue(), stderr.getvalue()


def wrong_edges(folder):
    rows = csv.DictReader((folder / "wrong_edges.csv").read_text().splitlines())
    return [(r["a"], r["b"], r["kind"]) for r in rows]


def off(read, edge):
    """An edge's error against the truth, in sigmas."""
    true = read.truth[edge.a].inverse() @ read.truth[edge.b]
    return np.abs(planar.log((edge.a_from_b.inverse() @ true).vector()) / SIGMA).max()


@pytest.mark.parametrize("world", ["free", "manhattan"])
def test_what_is_called_wrong_is_wrong_and_nothing_else(tmp_path, world):
    shape = (*SHAPE, "--wrong-overlaps", 0.3, "--wrong-loops", 0.5, "--world", world)
    code, stdout, _ = run(*shape, "--format", "jrl", "--out", tmp_path)
    assert code == 0
    assert "3 robots x 30 frames" in stdout
    assert ", 18 wrong\n" in stdout
    read = read_team_graph([tmp_path / "team.jrl"])
    fewer = 3 * 29 + 3 * 6 + 3 * 10 - len(read.edges)
    told = f"{fewer} loops fewer than asked for: paths come back too seldom\n"
    assert (told in stdout) == (fewer > 0) == (world == "manhattan")
    for edge, wrong in zip(read.edges, read.wrong, strict=True):
        assert (off(read, edge) > FAR) == wrong
    listed = wrong_edges(tmp_path)
    found = [(str(e.a), str(e.b)) for e, w in zip(read.edges, read.wrong, strict=True) if w]
    assert sorted((a, b) for a, b, _ in listed) == sorted(found)
    assert [kind for _, _, kind in listed] == ["loop"] * 9 + ["overlap"] * 9


def test_every_format_holds_the_same_team(tmp_path):
    made = {}
    for form, ending in (("g2o", ".g2o"), ("toro", ".graph"), ("jrl", ".jrl")):
        out = tmp_path / form
        assert run(*SHAPE, "--seed", 4, "--format", form, "--out", out)[0] == 0
        if form == "jrl":
            made[form] = read_team_graph([out / "team.jrl"])
            continue
        files = [out / f"{robot}{ending}" for robot in "ABC"]
        made[form] = read_team_graph(files, [out / f"overlaps{ending}"])
    one, two, three = made.values()
    assert one.frames == two.frames == three.frames
    assert one.start == two.start == three.start
    edges = [{(e.a, e.b, e.a_from_b) for e in read.edges} for read in made.values()]
    assert edges[0] == edges[1] == edges[2]
    truth = g2o.parsed((tmp_path / "g2o" / "truth.g2o").read_text()).vertices
    assert {key_of_symbol(f.robot, f.index): p for f, p in three.truth.items()} == truth
    assert toro.parsed((tmp_path / "toro" / "truth.graph").read_text()).vertices == truth


def test_start_poses_are_dead_reckoned_from_each_robots_first_frame(tmp_path):
    run(*SHAPE, "--out", tmp_path)
    for robot in "ABC":
        graph = g2o.parsed((tmp_path / f"{robot}.g2o").read_text())
        keys = [key_of_symbol(robot, k) for k in range(30)]
        assert list(graph.vertices) == keys
        assert graph.vertices[keys[0]].vector().tolist() == [0.0, 0.0, 0.0]
        steps = {(e.a, e.b): e.a_from_b for e in graph.edges}
        for a, b in pairwise(keys):
            step = graph.vertices[a].inverse() @ graph.vertices[b]
            # A pose composed and taken apart: 1e-16 x 30 m; worst seen 7e-15.
            assert step.vector() == pytest.approx(steps[a, b].vector(), abs=1e-12)


def test_ids_follow_the_scheme(tmp_path):
    wanted = {
        "symbols": ["C0", "C29"],
        "gtsam": [str(key_of_symbol("C", k)) for k in (0, 29)],
        "plain": ["60", "89"],
        "offset=500": ["1000", "1029"],
    }
    for keys, (first, last) in wanted.items():
        assert run(*SHAPE, "--keys", keys, "--out", tmp_path)[0] == 0
        names = [line.split()[1] for line in (tmp_path / "C.g2o").read_text().splitlines()]
        assert (names[0], names[29]) == (first, last)


def test_consistent_wrong_overlaps_agree_with_each_other(tmp_path):
    shape = ("--frames", 60, "--overlaps", 20, "--wrong-overlaps", 0.5, "--seed", 3)
    spread = {}
    for kind in ("random", "consistent"):
        run(*shape, "--kind", kind, "--format", "jrl", "--out", tmp_path / kind)
        read = read_team_graph([tmp_path / kind / "team.jrl"])
        says = []
        for edge, wrong in zip(read.edges, read.wrong, strict=True):
            if wrong:  # where B's map would lie in A's
                says.append(read.truth[edge.a] @ edge.a_from_b @ read.truth[edge.b].inverse())
        spread[kind] = np.ptp([[p.x_m, p.y_m] for p in says], axis=0).max()
    # 0.02 m and 0.3 deg over an area of 11 m: 0.1 m; random ones cover it.
    assert spread["consistent"] < 0.6
    assert spread["random"] > 3.0


def test_the_seed_decides_everything(tmp_path):
    def text(name, *more):
        run(*SHAPE, "--out", tmp_path / name, *more)
        return (tmp_path / name / "A.g2o").read_text()

    assert text("1") == text("2", "--seed", 1) != text("3", "--seed", 2)


def test_many_robots_have_plain_ids_and_letters_in_jrl(tmp_path):
    shape = ("--robots", 28, "--frames", 3, "--loops", 0, "--overlaps", 1, "--area", 3)
    assert run(*shape, "--keys", "plain", "--out", tmp_path / "p")[0] == 0
    names = sorted(p.stem for p in (tmp_path / "p").glob("*.g2o"))
    assert {"R26", "R27", "A", "Z"} <= set(names)
    assert run(*shape, "--wrong-overlaps", 1, "--format", "jrl", "--out", tmp_path / "j")[0] == 0
    dataset = jrl_reader.parsed((tmp_path / "j" / "team.jrl").read_text())
    assert len(dataset.robots) == 28
    read = read_team_graph([tmp_path / "j" / "team.jrl"])
    ends = {(str(e.a), str(e.b)) for e, w in zip(read.edges, read.wrong, strict=True) if w}
    assert ends == {(a, b) for a, b, _ in wrong_edges(tmp_path / "j")}


def test_one_robot_alone_has_no_overlaps(tmp_path):
    assert run("--robots", 1, "--frames", 5, "--loops", 0, "--out", tmp_path)[0] == 0
    read = read_team_graph([tmp_path / "A.g2o"], [tmp_path / "overlaps.g2o"])
    assert (len(read.frames), len(read.edges)) == (5, 4)
    assert FrameId("A", 4) in read.frames


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--robots", 0), "needs robots and frames, got 0 and 100"),
        (("--frames", -1), "needs robots and frames, got 2 and -1"),
        (("--robots", "two"), "argument --robots: invalid int value: 'two'"),
        (("--wrong-overlaps", 1.5), "a share lies in 0 to 1, got 1.5"),
        (("--wrong-loops", "nan"), "a share lies in 0 to 1, got nan"),
        (("--sigma-m", 0), "--sigma-m must be positive, got 0"),
        (("--sigma-deg", "inf"), "--sigma-deg must be positive, got inf"),
        (("--step", -1), "--step must be positive, got -1"),
        (("--loops", -1), "--loops must be 0 or more, got -1"),
        (("--overlaps", -1), "--overlaps must be 0 or more, got -1"),
        (("--seed", -1), "--seed must be 0 or more, got -1"),
        (("--area", "nan"), "--area must be 0 or more, got nan"),
        (("--reach", -2), "--reach must be 0 or more, got -2"),
        (("--area", 9000), "in 9e+03 m two robots never had 20 pairs of frames within 2 m"),
        (("--world", "sea"), "argument --world: invalid choice: 'sea'"),
        (("--kind", "sly"), "argument --kind: invalid choice: 'sly'"),
        (("--format", "ply"), "argument --format: invalid choice: 'ply'"),
        (("--keys", "letters"), "keys are auto, gtsam, plain or offset=N (N from 1), got letters"),
        (("--keys", "offset=50"), "--keys offset=50: is below the frames per robot, 100"),
        (("--robots", 27, "--frames", 3), "letters name 26 robots, got 27: --keys plain"),
    ],
)
def test_wrong_options_are_one_line_and_exit_code_two(tmp_path, arguments, message):
    code, stdout, stderr = run(*arguments, "--out", tmp_path / "out")
    assert (code, stdout) == (2, "")
    assert stderr.startswith(f"simulate_team: {message}")
    assert stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_stopping_it_is_one_line(tmp_path, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulate_team, "simulate", stopped)
    assert run("--out", tmp_path) == (130, "", "simulate_team: interrupted\n")
