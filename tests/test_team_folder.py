"""A team folder is read whole or refused with one line."""

import logging

import pytest
from small_team import HEIGHT, WIDTH, make_robot, read, refusal, store

from groundfuse.backend.measurement import FrameId
from groundfuse.tools.errors import DataError
from groundfuse.tools.team_folder import list_robots, load_image, read_team


@pytest.fixture
def robot(tmp_path):
    return make_robot(tmp_path / "team")


def test_a_team_is_read_in_natural_order(robot):
    make_robot(robot.parent, "B", ["b.jpg"])
    team = read_team(robot.parent, ["B", "A"])
    assert [member.name for member in team] == ["B", "A"]
    frames = team[1].frames
    assert [frame.path.name for frame in frames] == ["img1.png", "img2.png", "img10.png"]
    assert [frame.id for frame in frames] == [FrameId("A", i) for i in range(3)]
    assert [frame.time_s for frame in frames] == [0.0, 1.0, 2.0]
    assert len(team[0].frames) == 1
    assert team[0].truth is None
    assert frames[0].odometry is None


def test_pictures_that_the_list_omits_stay_out_and_are_counted(robot, caplog):
    (robot / "frames.csv").write_text("image\nimg2.png\n")
    with caplog.at_level(logging.WARNING):
        assert [frame.path.name for frame in read(robot).frames] == ["img2.png"]
    assert caplog.messages == [f"{robot}/frames.csv: 2 of 3 pictures are not listed and stay out"]


def test_spaces_and_unicode_in_names(tmp_path):
    robot = make_robot(tmp_path / "my team ü", "Röbi 1", ["Bild 1 Fußboden.jpg", "画像2.png"])
    member = read(robot)
    assert [frame.path.name for frame in member.frames] == ["Bild 1 Fußboden.jpg", "画像2.png"]
    assert all(load_image(f, member.camera).shape == (HEIGHT, WIDTH, 3) for f in member.frames)


def test_robots_are_listed_and_hidden_files_left_alone(robot):
    make_robot(robot.parent, "robot10")
    make_robot(robot.parent, "robot9")
    make_robot(robot.parent, ".hidden")
    (robot.parent / "notes").mkdir()
    (robot / "images" / "._img1.png").write_bytes(b"resource fork")
    (robot / "images" / "Thumbs.db").write_bytes(b"x")
    assert list_robots(robot.parent) == ("A", "robot9", "robot10")
    assert len(read(robot).frames) == 3


def test_folders(robot, tmp_path):
    with pytest.raises(DataError, match=r"nowhere: no such folder, needed a team folder$"):
        read_team(tmp_path / "nowhere", ["A"])
    with pytest.raises(DataError, match=r"camera\.yaml: is a file, needed a team folder$"):
        read_team(robot / "camera.yaml", ["A"])
    make_robot(robot.parent, "B")
    assert refusal(robot, ["C"]) == "team: no robot 'C', found A, B"
    assert refusal(robot, ["b"]) == "team: no robot 'b' (did you mean 'B'?), found A, B"
    assert read_team(robot.parent, ["A/"])[0].name == "A"  # as shells complete it
    assert refusal(robot, ["A", "B", "A"]) == "team: robot 'A' is named 2 times"
    assert refusal(robot, []) == "team: no robot named, found A, B"
    (robot.parent / "D").mkdir()
    assert refusal(robot, ["D"]) == "team: robot 'D' has no folder 'images'"
    with pytest.raises(DataError) as caught:
        read_team(robot, ["A"])
    above = robot.parent.resolve()
    assert str(caught.value) == (
        f"{robot}: this is a robot's folder, needed the folder above it ({above})"
    )
    with pytest.raises(DataError, match=r"no robot 'A', found no folder that has images/$"):
        read_team(robot / "images", ["A"])
    with pytest.raises(DataError, match=r"no robot named, found none$"):
        read_team(robot / "images", [])


def test_no_pictures(robot):
    store(robot, "film.mp4", b"x")
    (robot / "images" / "README").write_bytes(b"x")
    assert refusal(robot) == "A/images: no pictures (jpg, png, tif), found .mp4, README"
    for path in (robot / "images").iterdir():
        path.unlink()
    assert refusal(robot) == "A/images: no pictures (jpg, png, tif), the folder is empty"


def test_no_camera_file(robot):
    (robot / "camera.yaml").rename(robot / "calib.yml")
    assert refusal(robot) == "A/camera.yaml: no such file, found calib.yml"
    (robot / "calib.yml").unlink()
    assert refusal(robot) == "A/camera.yaml: no such file"
