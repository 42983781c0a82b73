"""The bundle's bench: its teams are what it says, and its tables can be printed."""

import math

import numpy as np
import pytest

from groundfuse.backend.measurement import Attitude
from groundfuse.tools import bench_bundle
from groundfuse.tools.bench_bundle import bench_nadir, main, rendered
from groundfuse.tools.bench_bundle_teams import FILES, averages, with_files, with_wobble

SMALL = ("--views", "2", "--width", "160", "--obstacles", "0")


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    return rendered(tmp_path_factory.mktemp("teams") / "team", "terrazzo", 5, SMALL)[0]


def test_wrong_files_are_wrong_by_what_the_table_says(robots):
    """And only the files: pictures, places and truth stay."""
    a, b = with_files(robots, FILES["mounts"])
    was = [robot.camera.mount.attitude for robot in robots]
    now = [robot.camera.mount.attitude for robot in (a, b)]
    assert math.degrees(now[0].tilt_rad - was[0].tilt_rad) == pytest.approx(1.0)
    assert math.degrees(now[0].roll_rad - was[0].roll_rad) == pytest.approx(0.5)
    assert now[0].height_m == was[0].height_m
    assert now[1] == Attitude(was[1].tilt_rad, was[1].roll_rad, 1.01 * was[1].height_m)
    for robot, changed in zip(robots, (a, b), strict=True):
        assert [f.attitude for f in changed.frames] == [changed.camera.mount.attitude] * 2
        assert [f.path for f in changed.frames] == [f.path for f in robot.frames]
        assert changed.truth == robot.truth
        assert changed.camera.intrinsics == robot.camera.intrinsics
    longer = with_files(robots, FILES["focal"])
    for robot, changed in zip(robots, longer, strict=True):
        ratio = changed.camera.intrinsics.focal_px / robot.camera.intrinsics.focal_px
        assert ratio == pytest.approx(1.002)
        assert changed.camera.mount == robot.camera.mount
    assert with_files(robots, FILES["as filed"]) == robots


def test_a_stated_wobble_is_every_frames(robots):
    wobble = Attitude(0.001, 0.002, 0.003)
    for robot, changed in zip(robots, with_wobble(robots, wobble), strict=True):
        assert changed.camera.mount.sigma == wobble
        assert [f.sigma for f in changed.frames] == [wobble] * 2
        assert [f.attitude for f in changed.frames] == [f.attitude for f in robot.frames]


def test_teams_straight_down(capsys, monkeypatch):
    """On terrazzo the bundle does better than the Pose2 graph; its row holds what was measured."""
    some = []

    def noted(found):
        some.append(averages(found))
        return some[-1]

    monkeypatch.setattr(bench_bundle, "averages", noted)
    bench_nadir([100], 2)
    said = capsys.readouterr().out.splitlines()
    assert said[0] == bench_bundle.HEAD
    rows = [
        said.index(bench_bundle.row(f"mean of 1 {floor}", found))
        for floor, found in zip(("terrazzo", "wood"), some, strict=True)
    ]
    assert said[rows[0] + 1] == "  bundled worse than the Pose2 graph, rigid: 0 of 1"
    assert [found.num_frames for found in some] == [6, 6]
    (pose2_m, _), (bundled_m, _) = some[0].errors_m
    assert bundled_m < pose2_m < 1e-3
    assert np.isfinite(some[0].nees).all()


def test_growing_simulated_teams(capsys):
    assert main(["--teams", "0", "--grow", "36"]) == 0
    frames, pairs, sightings, error_mm, *_ = capsys.readouterr().out.splitlines()[1].split()
    assert frames == "36"
    assert int(pairs) > 18
    assert int(sightings) > 36 * 20
    assert float(error_mm) < 5.0


def test_what_is_no_team_is_named(tmp_path, capsys):
    assert main(["--teams", "0", "--real", str(tmp_path / "nowhere")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("bench_bundle.py: ")
    assert "nowhere" in said
    assert said.count("\n") == 1
