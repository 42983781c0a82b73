"""No picture with sky in its used part gets through, and the advice is right."""

import math

import numpy as np
import pytest
from small_team import CAMERA, HEIGHT, WIDTH, change, make_robot, read, refusal


@pytest.fixture
def robot(tmp_path):
    return make_robot(tmp_path / "team")


PINHOLE = CAMERA.replace("[0.01, -0.002, 0.0003, 0.0001, 0.0]", "[]")


def first_floor_row(tilt_deg, roll_deg=0.0):
    """The first row all of whose pixels see the floor: n . (x, y, 1) > 0, n = down in cam."""
    tilt, roll = math.radians(tilt_deg), math.radians(roll_deg)
    down = (math.sin(roll), math.cos(roll) * math.sin(tilt), math.cos(roll) * math.cos(tilt))
    for row in range(HEIGHT):
        ends = [((u - 31.5) / 50.0, (row - 23.5) / 52.0) for u in (0, WIDTH - 1)]
        if all(down[0] * x + down[1] * y + down[2] > 0 for x, y in ends):
            return row
    return HEIGHT


@pytest.mark.parametrize(("tilt", "roll"), [(75, 0), (70, 10), (75, -10)])
def test_the_horizon_in_the_picture_is_refused_with_its_row(robot, tilt, roll):
    row = first_floor_row(tilt, roll)
    assert 3 < row < 30  # the case is a real one
    (robot / "camera.yaml").write_text(PINHOLE)
    change(robot, "tilt_deg: 33.0", f"tilt_deg: {tilt}\n  roll_deg: {roll}")
    assert refusal(robot) == (
        f"A/camera.yaml: with tilt {tilt} and roll {roll} deg the horizon is in the used part of "
        f"the picture: rows 0 to {row - 1} have sky; set first_row to {row}, "
        "or check tilt_deg (0 looks straight down)"
    )
    change(robot, "mount:", f"mount:\n  first_row: {row}")
    assert read(robot).camera.first_row == row
    change(robot, f"first_row: {row}", f"first_row: {row - 1}")
    assert f"rows {row - 1} to {row - 1} have sky; set first_row to {row}," in refusal(robot)


def test_the_horizon_of_a_camera_that_looks_back(robot):
    (robot / "camera.yaml").write_text(PINHOLE)
    change(robot, "tilt_deg: 33.0", "tilt_deg: -75")
    row = HEIGHT - 1 - first_floor_row(75)  # the picture upside down
    assert f"rows {row + 1} to 47 have sky; set last_row to {row}, or" in refusal(robot)
    change(robot, "mount:", f"mount:\n  last_row: {row}")
    read(robot)


def test_the_horizon_on_all_rows_has_no_advice_on_rows(robot):
    change(robot, "tilt_deg: 33.0", "tilt_deg: 33\n  roll_deg: 80")
    assert refusal(robot).endswith("have sky; check tilt_deg (0 looks straight down) and roll_deg")


def test_the_horizon_allows_for_distortion(robot):
    """Barrel distortion squeezes the sky in: a tilt legal for a pinhole isn't for the lens."""
    (robot / "camera.yaml").write_text(PINHOLE)
    change(robot, "tilt_deg: 33.0", "tilt_deg: 64")
    read(robot)
    change(robot, "data: []", "data: [-0.3, 0.0, 0.0, 0.0, 0.0]")
    assert "the horizon is in the used part of the picture: rows 0 to" in refusal(robot)


@pytest.mark.parametrize("roll", [64, -64])
def test_the_horizon_at_a_bulging_side(robot, roll):
    """With k1 = 1 a side's middle has x = 0.50, its corners 0.47; the sky begins at 0.49."""
    (robot / "camera.yaml").write_text(PINHOLE)
    change(robot, "data: []", "data: [1.0, 0.0, 0.0, 0.0, 0.0]")
    change(robot, "tilt_deg: 33.0", f"tilt_deg: 0\n  roll_deg: {roll}")
    assert refusal(robot).endswith("have sky; check tilt_deg (0 looks straight down) and roll_deg")
    change(robot, f"roll_deg: {roll}", "roll_deg: 62")
    read(robot)


def test_the_horizon_in_a_round_picture_with_a_black_border(robot):
    """The whole border is beyond 90 deg off the axis, only the inside can tell."""
    change(robot, "distortion_model: plumb_bob", "distortion_model: equidistant")
    change(robot, "[0.01, -0.002, 0.0003, 0.0001, 0.0]", "[1.0e-9, 0.0, 0.0, 0.0]")
    change(robot, "50.0, 0.0, 31.5, 0.0, 52.0", "14.5, 0.0, 31.5, 0.0, 14.5")
    change(robot, "tilt_deg: 33.0", "tilt_deg: 0")
    read(robot)
    change(robot, "tilt_deg: 0", "tilt_deg: 10")
    assert "the horizon is in the used part of the picture" in refusal(robot)


def test_the_horizon_of_one_frame(robot):
    (robot / "frames.csv").write_text("image,tilt_deg\nimg1.png,33\nimg2.png,85\n")
    assert refusal(robot).startswith(
        "A/frames.csv: img2.png: with tilt 85 and roll 0 deg the horizon is in the used part"
    )


def test_black_corners_of_a_fisheye_lens_are_legal(robot):
    change(robot, "distortion_model: plumb_bob", "distortion_model: equidistant")
    change(robot, "[0.01, -0.002, 0.0003, 0.0001, 0.0]", "[0.0, 0.0, 0.0, 0.0001]")
    change(robot, "50.0, 0.0, 31.5, 0.0, 52.0", "24.0, 0.0, 31.5, 0.0, 24.0")  # 93 deg in corners
    change(robot, "tilt_deg: 33.0", "tilt_deg: 0")
    assert np.isnan(read(robot).camera.intrinsics.rays_from_px(np.zeros((1, 2)))).all()
