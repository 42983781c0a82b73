"""The scale bench: its fits and counts are right, and every table of it can be printed."""

import math

import numpy as np
import pytest

from groundfuse.tools.bench_scale import exponent, growth_table, main
from groundfuse.tools.bench_scale_fleets import fleet, fleet_path, twice_mown
from groundfuse.tools.bench_scale_runs import Growth, _hits, recalls, reruns


def test_exponents_are_those_of_powers():
    sizes = [100, 200, 400]
    assert exponent(sizes, [3.0 * n**1.5 for n in sizes]) == pytest.approx(1.5)
    assert exponent(sizes, [7.0] * 3) == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(exponent([100], [1.0]))
    assert math.isnan(exponent(sizes, [1.0, 0.0, 1.0]))


def test_the_table_of_growth_states_exponents_of_tried_pairs_stages_and_all():
    rows = [
        Growth(n, 5 * n, 4 * n, 1, {"features": n**2 / 1e4, "pairs": n / 10}, 0.5, 1.25)
        for n in (100, 200)
    ]
    lines = growth_table(rows).splitlines()
    assert lines[1].split()[:5] == ["100", "500", "400", "1", "1.00"]
    assert lines[2].split()[-3:] == ["24.00", "0.50", "1.25"]
    total = math.log2(24.0 / 11.0)
    expected = ["exponent", "1.00", "2.00", "nan", "1.00", *["nan"] * 4, f"{total:.2f}"]
    assert lines[3].split() == expected
    assert len(growth_table(rows[:1]).splitlines()) == 2


def test_guesses_count_where_there_is_a_partner():
    overlap = np.array([[0.9, 0.35, 0.0, 0.0, 0.0, 0.0, 0.0], [0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    first = np.array([[1.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0], [9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert list(_hits(first, overlap)) == [(True, True)]  # the second shares too little to be asked
    late = np.array([[1.0, 0.0, 5.0, 4.0, 3.0, 2.0, 1.5]] * 2)
    assert list(_hits(late, overlap)) == [(False, False)]
    in_five = np.array([[1.6, 0.0, 5.0, 4.0, 3.0, 1.5, 1.5]] * 2)
    assert list(_hits(in_five, overlap)) == [(False, True)]


def test_two_robots_mow_the_same_field_and_find_each_other():
    team = twice_mown("terrazzo", 2, 10)
    assert len(team.frames) == 20
    assert {frame.id.robot for frame in team.frames[:10]} == {"A"}
    assert (team.overlap.max(axis=1) > 0.45).sum() >= 4
    found = recalls(team, "sift")
    assert found.num_asked >= 8
    assert found.at_5 >= 0.9


def test_a_fleet_that_was_half_rendered_is_rendered_anew(tmp_path):
    half = fleet_path(tmp_path, 4, 3).with_name("fleet_4_3.half")
    (half / "A" / "images").mkdir(parents=True)
    assert [len(robot.frames) for robot in fleet(tmp_path, 4, 3)] == [1, 1, 1, 1]
    assert [path.name for path in tmp_path.iterdir()] == ["fleet_4_3"]


def test_the_bench_runs_on_a_fleet_and_names_what_cannot_be(tmp_path, capsys):
    keep = ["--keep", str(tmp_path), "--workers", "2"]
    assert main(["--frames", "8", "--workers-gain", "8", *keep]) == 0
    said = capsys.readouterr().out
    assert "8 frames, pairs: " in said
    frames, tried, used, parts, *_ = said.splitlines()[-1].split()
    assert frames == "8"
    assert int(tried) >= int(used) >= 4
    assert int(parts) <= 3
    found = reruns(tmp_path, 8, 1, 2)
    again = ["first run", "nothing changed", "one picture added"]
    assert list(found) == [*again, "three robots of four", "the fourth added"]
    assert main(["--frames", "15", *keep]) == 2
    assert "a fleet needs a multiple of 4 frames, got 15" in capsys.readouterr().err
