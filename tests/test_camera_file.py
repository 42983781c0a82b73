# ruff: noqa: E501 (messages stay whole)
"""A camera file is read as ROS means it, or refused with one line."""

import math

import pytest
from small_team import CAMERA, change, make_robot, read, refusal

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.tools.camera_file import camera_text, read_camera


@pytest.fixture
def robot(tmp_path):
    return make_robot(tmp_path / "team")


def test_the_camera_is_what_the_file_says(robot):
    change(
        robot,
        "tilt_deg: 33.0",
        "tilt_deg: 33.0\n  roll_deg: -2\n  x_m: 0.1\n  y_m: -0.2\n  yaw_deg: 90\n  first_row: 8\n"
        "  last_row: 40\n  tilt_sigma_deg: 1\n  roll_sigma_deg: 2\n  height_sigma_m: 3e-3",
    )
    camera = read(robot).camera
    lens, mount = camera.intrinsics, camera.mount
    assert (lens.width_px, lens.height_px) == (64, 48)
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (50.0, 52.0, 31.5, 23.5)
    assert lens.coefficients == (0.01, -0.002, 0.0003, 0.0001, 0.0)
    assert mount.attitude == Attitude(math.radians(33), math.radians(-2), 0.55)
    assert mount.sigma == Attitude(math.radians(1), math.radians(2), 0.003)
    assert mount.base_from_foot == Se2(0.1, -0.2, math.pi / 2)
    assert camera.used_rows == (8, 40)
    assert camera.name == "front"


def test_wobble_has_defaults_and_height_wobble_scales(robot):
    sigma = read(robot).camera.mount.sigma
    expected = (math.radians(0.5), math.radians(0.15), 0.004 * 0.55)
    assert (sigma.tilt_rad, sigma.roll_rad, sigma.height_m) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("given", "expected", "numbers"),
    [
        ("equidistant", "equidistant", [0.1, 0.01, 0.001, 0.0001]),
        ("fisheye", "equidistant", [0.1, 0.01, 0.001, 0.0001]),
        ("rational_polynomial", "rational_polynomial", [0.1, 0, 0, 0, 0, 0.1, 0, 0]),
        ("plumb_bob", "plumb_bob", [0.1, 0.01, 0.001, 0.0001]),
        ("none", "plumb_bob", []),
    ],
)
def test_distortion_models(robot, given, expected, numbers):
    change(robot, "distortion_model: plumb_bob", f"distortion_model: {given}")
    change(robot, "[0.01, -0.002, 0.0003, 0.0001, 0.0]", str(numbers))
    lens = read(robot).camera.intrinsics
    assert lens.model == expected
    assert lens.coefficients == tuple(numbers)


@pytest.mark.parametrize(("d", "k"), [("d", "k"), ("D", "K")])
def test_an_echoed_camera_info_message_is_read(robot, d, k):
    """ROS 2 writes small letters, ROS 1 capitals."""
    (robot / "camera.yaml").write_text(
        "header:\n  frame_id: camera\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\n"
        f"{d}: [0.01, -0.002, 0.0003, 0.0001, 0.0]\n"
        f"{k}: [50.0, 0.0, 31.5, 0.0, 52.0, 23.5, 0.0, 0.0, 1.0]\n"
        "r: [1, 0, 0, 0, 1, 0, 0, 0, 1]\np: [50, 0, 31, 0, 0, 52, 23, 0, 0, 0, 1, 0]\n"
        "binning_x: 0\nbinning_y: 0\nroi:\n  x_offset: 0\n"
        "mount: {height_m: 0.55, tilt_deg: 33.0}\n---\n"
    )
    echoed = read(robot).camera
    (robot / "camera.yaml").write_text(CAMERA)
    assert echoed == read(robot).camera


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("height_m: 0.55", "height_m: -0.5", "camera must be above the floor, got height_m -0.5"),
        ("height_m: 0.55", "height_m: 0", "camera must be above the floor, got height_m 0"),
        ("height_m: 0.55", "height_m: .nan", "height_m must be finite, got nan"),
        ("height_m: 0.55", "height_m: .inf", "height_m must be finite, got inf"),
        ("height_m: 0.55", "height_m: 0,55", "height_m must be a number, got '0,55' (write a decimal point)"),
        ("height_m: 0.55", "height_m: yes", "height_m must be a number, got True"),
        ("height_m: 0.55", "height_m: 55 cm", "height_m must be a number, got '55 cm'"),
        ("height_m: 0.55", "height_m: [1]", "height_m must be a number, got [1]"),
        ("height_m: 0.55", "hieght_m: 0.55", "unknown key in mount 'hieght_m' (did you mean 'height_m'?)"),
        ("  height_m: 0.55\n", "", "mount: missing key 'height_m' (needed: height_m, tilt_deg)"),
        ("height_m: 0.55", "height_m:", "mount: missing key 'height_m' (needed: height_m, tilt_deg)"),
        ("tilt_deg: 33.0", "tilt_deg: 95", "tilt from nadir must lie within 90 deg, got 95"),
        ("tilt_deg: 33.0", "tilt_deg: 33\n  tilt_sigma_deg: 0", "wobble sigmas must be positive: no camera stands perfectly still"),
        ("tilt_deg: 33.0", "tilt_deg: 33\n  height_sigma_m: -1", "wobble sigmas must be positive: no camera stands perfectly still"),
        ("tilt_deg: 33.0", "tilt_deg: 33\n  first_row: 2.5", "first_row must be a whole number, got 2.5"),
        ("tilt_deg: 33.0", "tilt_deg: 33\n  first_row: 47", "rows 47 to -1 are no part of a picture of 48 rows"),
        ("tilt_deg: 33.0", "tilt_deg: 33\n  last_row: 48", "rows 0 to 48 are no part of a picture of 48 rows"),
        ("tilt_deg: 33.0", "tilt_deg: 33\n  zzz: 48", "unknown key in mount 'zzz' (known: first_row, height_m, height_sigma_m, last_row, roll_deg, roll_sigma_deg, tilt_deg, tilt_sigma_deg, x_m, y_m, yaw_deg)"),
        ("image_width: 64", "image_widht: 64", "unknown key 'image_widht' (did you mean 'image_width'?)"),
        ("image_width: 64", "IMAGE_WIDTH: 64", "unknown key 'IMAGE_WIDTH' (did you mean 'image_width'?)"),
        ("image_width: 64\n", "", "missing key 'image_width' (needed: image_width, image_height, camera_matrix, distortion_model, mount)"),
        ("image_width: 64", "image_width: 0", "image size must be positive, got 0 x 48"),
        ("image_width: 64", "image_width: 64.5", "image_width must be a whole number, got 64.5"),
        ("image_width: 64", "image_width: 64\nimage_width: 65", "line 2: key 'image_width' stands there twice"),
        ("mount:\n", "mount: high\nbinning_y:\n", "mount must have keys of its own (height_m, tilt_deg, ...)"),
        ("mount:\n", "roi:\n", "missing key 'mount' (needed: image_width, image_height, camera_matrix, distortion_model, mount)"),
        ("plumb_bob", "plum_bob", "unknown distortion_model 'plum_bob' (did you mean 'plumb_bob'?)"),
        ("plumb_bob", "xyz", "unknown distortion_model 'xyz' (known: equidistant, plumb_bob, rational_polynomial)"),
        ("plumb_bob", "equidistant", "distortion_coefficients of equidistant must have 0 or 4 numbers, got 5"),
        ("plumb_bob", "rational_polynomial", "distortion_coefficients of rational_polynomial must have 8 numbers, got 5"),
        ("-0.002, 0.0003, 0.0001, 0.0]", "0.0]", "distortion_coefficients of plumb_bob must have 0 or 4 or 5 numbers, got 2"),
        ("[0.01, -0.002,", "[0.01, .nan,", "distortion_coefficients of plumb_bob[1] must be finite, got nan"),
        ("[0.01, -0.002, 0.0003, 0.0001, 0.0]", "7", "distortion_coefficients of plumb_bob must hold a list of numbers (data: [...]), got 7"),
        ("[0.01, -0.002, 0.0003, 0.0001, 0.0]", "[-9, 0, 0, 0, 0]", "distortion_coefficients can't be undone in 94 % of the picture, check them and distortion_model"),
        ("[50.0, 0.0, 31.5, 0.0,", "[50.0, 0.0, 31.5, 0.0, 0.0,", "camera_matrix must have 9 numbers, got 10"),
        ("[50.0, 0.0, 31.5, 0.0, 52.0, 23.5, 0.0", "[50.0, 0.5, 31.5, 0.0, 52.0, 23.5, 0.0", "camera_matrix must be [fx 0 cx; 0 fy cy; 0 0 1], got (50.0, 0.5, 31.5, 0.0, 52.0, 23.5, 0.0, 0.0, 1.0)"),
        ("[50.0, 0.0, 31.5, 0.0, 52.0, 23.5, 0.0", "[-50.0, 0.0, 31.5, 0.0, 52.0, 23.5, 0.0", "focal lengths must be positive, got -50 and 52 px"),
        (CAMERA, "K: !!opencv-matrix\n  rows: 3\n", "not YAML: line 1: could not determine a constructor for the tag 'tag:yaml.org,2002:opencv-matrix' (an OpenCV FileStorage file; a ROS camera_info file is needed)"),
        (CAMERA, "{", "not YAML: line 1: expected the node content, but found '<stream end>'"),
        (CAMERA, "just a text", "must hold one mapping (key: value), got str"),
        (CAMERA, "", "must hold one mapping (key: value), got 0 documents"),
        (CAMERA, "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n", "not YAML: line 1: expected alphabetic or numeric character, but found ':' (an OpenCV FileStorage file; a ROS camera_info file is needed)"),
    ],
)  # fmt: skip
def test_refused_camera_files(robot, old, new, message):
    change(robot, old, new)
    assert refusal(robot) == f"A/camera.yaml: {message}"


def test_a_camera_file_that_is_no_text(robot):
    (robot / "camera.yaml").write_bytes(b"ab\xff\xfe")
    assert refusal(robot) == "A/camera.yaml: not a text file in UTF-8 (byte 2)"


def test_a_written_camera_is_read_back(robot):
    """Angles go through degrees: equal but for the last bits (3 eps of each value)."""
    change(robot, "tilt_deg: 33.0", "tilt_deg: 33\n  roll_deg: 1.7\n  yaw_deg: 77\n  first_row: 3")
    camera = read(robot).camera
    (robot / "camera.yaml").write_text(camera_text(camera))
    again = read_camera(robot / "camera.yaml")
    assert again.intrinsics == camera.intrinsics
    assert (again.first_row, again.last_row, again.name) == (3, -1, "front")
    for old, new in (
        (camera.mount.attitude, again.mount.attitude),
        (camera.mount.sigma, again.mount.sigma),
    ):
        expected = (old.tilt_rad, old.roll_rad, old.height_m)
        assert (new.tilt_rad, new.roll_rad, new.height_m) == pytest.approx(expected, rel=1e-15)
    pose = camera.mount.base_from_foot.vector()
    assert again.mount.base_from_foot.vector() == pytest.approx(pose, rel=1e-15)
