"""The command writes team folders that our own reader reads, with the truth it rendered from."""

import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundfuse.backend.measurement import FrameId
from groundfuse.frontend.camera import Distortion
from groundfuse.tools import render_team
from groundfuse.tools.lawn import plan_lawn
from groundfuse.tools.overlap import View, true_overlap
from groundfuse.tools.photometry import Photometry
from groundfuse.tools.render_files import picture_name
from groundfuse.tools.render_team import LENSES, main, parser, plan_scene, resized
from groundfuse.tools.team_folder import load_image, read_team
from groundfuse.tools.world import photographs

SAMPLE = Path(__file__).parent.parent / "data" / "team"
SAMPLE_COMMAND = (
    *("--out", "data/team", "--floor", "terrazzo", "--seed", "3"),
    *("--robots", "A:33", "B:45", "--obstacles", "12", "--quality", "92"),
)
ARGUMENTS = (
    *("--seed", "7", "--floor", "tiles", "--robots", "left:33", "r2:20:0.7", "--views", "2"),
    *("--obstacles", "1"),
)


def rows(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def scene_of(arguments):
    return plan_scene(parser().parse_args(arguments))


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    folder = tmp_path_factory.mktemp("render") / "team"
    assert main(["--out", str(folder), *ARGUMENTS]) == 0
    return folder


def test_our_reader_reads_the_team_and_its_truth(team):
    scene = scene_of(["--out", "x", *ARGUMENTS])
    robots = read_team(team, ["left", "r2"])
    for robot, spec in zip(robots, scene.robots, strict=True):
        assert robot.camera == spec.camera
        assert [frame.path.name for frame in robot.frames] == ["img_00.jpg", "img_01.jpg"]
        for frame, pose in zip(robot.frames, spec.world_from_base, strict=True):
            # Through the half angle and back: a few units in the last place
            np.testing.assert_allclose(robot.truth[frame.id].vector(), pose.vector(), atol=1e-14)
    assert robots[1].camera.mount.attitude.height_m == 0.7
    assert robots[0].camera.intrinsics.model is Distortion.PLUMB_BOB


def test_the_pictures_are_those_of_the_scene(team):
    scene = scene_of(["--out", "x", *ARGUMENTS])
    frame = next(photographs(scene, Photometry()))
    robot = read_team(team, ["left"])[0]
    written = load_image(robot.frames[0], robot.camera).astype(float)
    assert np.abs(written - frame.image).mean() < 3.0  # what JPEG of quality 90 loses


def test_more_threads_take_the_same_pictures():
    scene = scene_of(["--out", "x", *ARGUMENTS])
    one, three = (list(photographs(scene, Photometry(), threads)) for threads in (1, 3))
    assert [frame.id for frame in three] == list(scene.by_frame())
    for alone, beside in zip(one, three, strict=True):
        np.testing.assert_array_equal(alone.image, beside.image)


def test_the_sidecars_state_what_was_rendered(team):
    views = scene_of(["--out", "x", *ARGUMENTS]).by_frame()
    found = rows(team / "truth_attitude.csv")
    assert [(row["robot"], row["image"]) for row in found] == [
        (frame.robot, picture_name(frame)) for frame in views
    ]
    for row, view in zip(found, views.values(), strict=True):
        assert math.radians(float(row["tilt_deg"])) == pytest.approx(view.attitude.tilt_rad)
        assert math.radians(float(row["roll_deg"])) == pytest.approx(view.attitude.roll_rad)
        assert float(row["height_m"]) == view.attitude.height_m
    names = {str(frame): frame for frame in views}
    shares = {
        (row["a"], row["b"]): float(row["overlap"]) for row in rows(team / "truth_overlaps.csv")
    }
    assert ("left0", "left1") in shares
    for (a, b), share in shares.items():
        assert share == pytest.approx(true_overlap(views[names[a]], views[names[b]]), abs=1e-4)
    assert len(rows(team / "truth_obstacles.csv")) == 1


def test_pictures_are_not_written_over(team, capsys):
    assert main(["--out", str(team), *ARGUMENTS]) == 2
    said = capsys.readouterr().err
    assert (
        said
        == f"render_team.py: {team}/left/images: there already, choose a new folder or remove it\n"
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--robots", "A"], "a robot is NAME:TILT or NAME:TILT:HEIGHT, like A:33, got 'A'"),
        (
            ["--robots", "../A:3"],
            "a robot is NAME:TILT or NAME:TILT:HEIGHT, like A:33, got '../A:3'",
        ),
        (["--robots", "A:x"], "tilt of A must be a number, got 'x'"),
        (["--robots", "A:33", "A:45"], "robot 'A' is named 2 times"),
        (["--robots", "A:33:-1"], "camera must be above the floor, got height_m -1"),
        (["--robots", "A:70"], "robot A: tilt 70 deg looks over the horizon"),
        (["--robots", "A:95"], "tilt from nadir must lie within 90 deg, got 95"),
        (["--floor", "woood"], "no floor is called 'woood' (did you mean 'wood'?)"),
        (["--views", "0"], "--views must be at least 1, got 0"),
        (["--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--obstacles", "-1"], "--obstacles must be at least 0, got -1"),
        (["--width", "79"], "--width must be at least 80, got 79"),
        (["--workers", "0"], "--workers must be at least 1, got 0"),
        (["--quality", "101"], "--quality must be at most 100, got 101"),
        (["--step", "0"], "--step must be positive, got 0"),
        (["--noise", "-2"], "photometry must not be negative, got -2"),
        (["--tilt-sigma", "0"], "wobble sigmas must be positive: no camera stands perfectly still"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, text, tmp_path, capsys):
    assert main(["--out", str(tmp_path / "team"), "--views", "1", *arguments]) == 2
    assert capsys.readouterr().err == f"render_team.py: {text}\n"
    assert not (tmp_path / "team").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "the following arguments are required: --out"),
        (["--out", "x", "--views", "many"], "argument --views: invalid int value: 'many'"),
    ],
)
def test_a_bad_command_line_is_one_line_and_exit_code_2(arguments, text, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert capsys.readouterr().err == f"render_team.py: {text}\n"


def test_stopping_it_is_one_line(tmp_path, capsys, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(render_team, "render", stopped)
    assert main(["--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "render_team.py: interrupted\n"


def test_help_names_every_floor(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "terrazzo, gravel, grass, wood, concrete, tiles, varied_tiles" in said


# --- the sample in data/


@pytest.fixture(scope="module")
def sample_scene():
    return scene_of(SAMPLE_COMMAND)


def test_the_sample_is_what_its_command_makes(sample_scene):
    """Sines may differ in the last place from one machine to another, so do these numbers."""
    robots = read_team(SAMPLE, ["A", "B"])
    for robot, spec in zip(robots, sample_scene.robots, strict=True):
        assert robot.camera == spec.camera
        assert len(robot.frames) == 13
        for frame, pose in zip(robot.frames, spec.world_from_base, strict=True):
            np.testing.assert_allclose(robot.truth[frame.id].vector(), pose.vector(), atol=1e-9)
    attitudes = rows(SAMPLE / "truth_attitude.csv")
    for row, view in zip(attitudes, sample_scene.by_frame().values(), strict=True):
        assert float(row["tilt_deg"]) == pytest.approx(math.degrees(view.attitude.tilt_rad))
        assert float(row["height_m"]) == pytest.approx(view.attitude.height_m)
    assert len(rows(SAMPLE / "truth_obstacles.csv")) == 12
    assert " ".join(SAMPLE_COMMAND) in (SAMPLE.parent / "README.md").read_text()


def test_the_samples_first_picture_is_what_its_command_makes(sample_scene):
    frame = next(photographs(sample_scene, Photometry()))
    written = cv2.imread(str(SAMPLE / "A" / "images" / "img_00.jpg")).astype(float)
    # JPEG of quality 92 loses 2.4 grey on average; another floor or pose differs by 30.
    assert np.abs(written - frame.image).mean() < 4.0


def test_the_sample_is_as_the_paper_has_it(sample_scene):
    files = [path for path in SAMPLE.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 6e6
    shares = {
        (row["a"], row["b"]): float(row["overlap"]) for row in rows(SAMPLE / "truth_overlaps.csv")
    }
    views = sample_scene.by_frame()
    for robot, tilt_deg in (("A", 33.0), ("B", 45.0)):
        view: View = views[FrameId(robot, 0)]
        assert math.degrees(view.camera.mount.attitude.tilt_rad) == pytest.approx(tilt_deg)
        assert view.camera.mount.attitude.height_m == 0.55
        assert min(shares[f"{robot}{i}", f"{robot}{i + 1}"] for i in range(12)) > 0.35
        assert shares[f"{robot}0", f"{robot}12"] > 0.5
    between = [pair for pair, share in shares.items() if pair[0][0] != pair[1][0] and share >= 0.4]
    assert 4 <= len(between) <= 16


def test_a_smaller_sensor_sees_the_same_floor():
    """A pixel in the middle of 2 x 2 pixels has their mean ray; distortion is in rays anyway."""
    for lens in LENSES:
        small = resized(lens, 320)
        assert (small.width_px, small.height_px) == (320, 240)
        pixels = np.array([[10.0, 20.0], [160.0, 119.0], [300.0, 200.0]])
        rays = lens.rays_from_px(2.0 * pixels + 0.5)
        np.testing.assert_allclose(small.rays_from_px(pixels), rays, atol=1e-9)
        assert resized(lens, 640) == lens


def test_a_fleet_mows_a_field_in_small_pictures(tmp_path):
    """Small pictures of a coarser floor, in rows."""
    words = ["--out", str(tmp_path / "fleet"), "--way", "lawn", "--width", "160", "--views", "3"]
    assert main([*words, "--obstacles", "0"]) == 0
    robots = read_team(tmp_path / "fleet", ["A", "B"])
    assert [len(robot.frames) for robot in robots] == [3, 3]
    assert load_image(robots[0].frames[0], robots[0].camera).shape == (120, 160, 3)
    scene = scene_of([*words, "--obstacles", "0"])
    cameras = [(robot.name, robot.camera) for robot in scene.robots]
    assert scene.robots == plan_lawn(cameras, 3, np.random.default_rng([1, 99]))
    plain = scene_of(["--out", "x", "--views", "3"])
    assert scene.world.floor.cell_m == pytest.approx(4.0 * plain.world.floor.cell_m)
