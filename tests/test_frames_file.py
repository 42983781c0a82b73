# ruff: noqa: E501 (messages stay whole)
"""Frame lists and trajectories: what they say, and what is refused."""

import math

import numpy as np
import pytest
from small_team import make_robot, read, refusal

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.tools.frames_file import FrameRow, frames_text, read_frames
from groundfuse.tools.trajectory_file import read_trajectory, trajectory_text


@pytest.fixture
def robot(tmp_path):
    return make_robot(tmp_path / "team")


def test_frames_csv_gives_order_times_priors_and_odometry(robot):
    (robot / "frames.csv").write_text(
        "image, tilt_deg, time_s,height_m,tilt_sigma_deg,roll_deg,roll_sigma_deg,height_sigma_m,"
        "odom_x_m,odom_y_m,odom_theta_deg,odom_sigma_m,odom_sigma_deg\n"
        "img10.png,30,1.5,0.5,2,1,3,0.01,1,2,180,0.1,5\n"
        "\n"
        "img1.png,,2.5,,,,,,,,,,\n"
        "img2.png,,1e1,,,,,,,,,,\n"
    )
    first, second, third = read(robot).frames
    assert [f.path.name for f in (first, second, third)] == ["img10.png", "img1.png", "img2.png"]
    assert [f.time_s for f in (first, second, third)] == [1.5, 2.5, 10.0]
    assert first.attitude == Attitude(math.radians(30), math.radians(1), 0.5)
    assert first.sigma == Attitude(math.radians(2), math.radians(3), 0.01)
    assert first.odometry is not None
    assert first.odometry.map_from_base == Se2(1.0, 2.0, math.pi)
    assert first.odometry.sigma == Se2(0.1, 0.1, math.radians(5))
    mount = read(robot).camera.mount
    assert (second.attitude, second.sigma, second.odometry) == (mount.attitude, mount.sigma, None)


def test_ground_truth_is_matched_by_time(robot):
    (robot / "frames.csv").write_text("image,time_s\nimg1.png,5.5\nimg2.png,6.5\nimg10.png,9\n")
    half = math.sin(math.pi / 4)
    (robot / "groundtruth.tum").write_text(
        "# time x y z qx qy qz qw\n"
        "5.40 9 9 9 0 0 0 1\n"
        f"5.501 1 2 0.3 0 0 {half} {half}\n"
        "5.509 9 9 9 0 0 0 1\n"
        "9.0, 3, 4, 0, 0, 0, 0, 1\n"
    )
    truth = read(robot).truth
    assert truth is not None
    assert set(truth) == {FrameId("A", 0), FrameId("A", 2)}
    assert truth[FrameId("A", 0)].vector() == pytest.approx([1.0, 2.0, math.pi / 2])
    assert truth[FrameId("A", 2)] == Se2(3.0, 4.0, 0.0)


def test_ground_truth_counts_frames_where_there_is_no_time(robot):
    (robot / "groundtruth.tum").write_text("1 7 8 0 0 0 0 1\n")
    assert read(robot).truth == {FrameId("A", 1): Se2(7.0, 8.0, 0.0)}


def test_the_heading_of_a_leaning_robot_is_that_of_its_x_axis(robot):
    # yaw 40, pitch 10, roll -20 deg, built from the three turns and not by the reader's formula
    def turn(axis, degrees):
        half = math.radians(degrees) / 2
        return np.array([*(math.sin(half) * np.array(axis)), math.cos(half)])

    def product(p, q):
        vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
        return np.array([*vector, p[3] * q[3] - p[:3] @ q[:3]])

    leaning = product(product(turn((0, 0, 1), 40), turn((0, 1, 0), 10)), turn((1, 0, 0), -20))
    (robot / "groundtruth.tum").write_text("0 1 2 3 " + " ".join(map(str, leaning)) + "\n")
    truth = read(robot).truth
    assert truth is not None
    assert truth[FrameId("A", 0)].vector() == pytest.approx([1, 2, math.radians(40)], abs=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the first line must name the columns, image among them"),
        ("image;time_s\nimg1.png;1\n", "the first line must name the columns, image among them (separate columns by commas, not semicolons)"),
        ("image,tiem_s\n", "unknown column 'tiem_s' (did you mean 'time_s'?)"),
        ("image,image\n", "a column stands there twice"),
        ("image\n", "it lists no picture"),
        ("image,time_s\nimg1.png\n", "line 2: needs 2 cells, got 1"),
        ("image,time_s\n,1\n", "line 2: no picture's name"),
        ("image,time_s\nimg1.png,nan\n", "line 2: time_s must be finite, got nan"),
        ("image,height_m\nimg1.png,high\n", "line 2: height_m must be a number, got 'high'"),
        ("image,height_m\nimg1.png,-1\n", "img1.png: camera must be above the floor, got height_m -1"),
        ("image,tilt_deg\nimg1.png,91\n", "img1.png: tilt from nadir must lie within 90 deg, got 91"),
        ("image,tilt_sigma_deg\nimg1.png,0\n", "line 2: tilt_sigma_deg must be positive, got 0"),
        ("image\nimg1.png\n\nimg1.png\n", "line 4: img1.png stands on line 2 too"),
        ("image\nimg3.png\n", "no picture 'img3.png' in images/ (did you mean 'img2.png'?)"),
        ("image,time_s\nimg1.png,2\nimg2.png,2\n", "line 3: time_s must increase, got 2 after 2"),
        ("image,time_s\nimg1.png,2\nimg2.png,1.5\n", "line 3: time_s must increase, got 1.5 after 2"),
        ("image,time_s\nimg1.png,2\nimg2.png,\n", "line 3: time_s must stand on every line or on none"),
        ("image,odom_x_m\nimg1.png,2\n", "line 2: odometry needs all of its columns, odom_y_m is empty or missing"),
        ('image\n"img1.png\n', "unexpected end of data"),
    ],
)  # fmt: skip
def test_refused_frame_lists(robot, text, message):
    (robot / "frames.csv").write_text(text)
    assert refusal(robot) == f"A/frames.csv: {message}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty, no time of a frame (0 to 2 s)"),
        ("7 0 0 0 0 0 0 1\n8 0 0 0 0 0 0 1\n", "it covers 7 to 8 s, no time of a frame (0 to 2 s)"),
        ("# a\n0 0 0 0 0 0 1\n", "line 2: needs 8 numbers (time_s x y z qx qy qz qw), got 7"),
        ("0 0 inf 0 0 0 0 1\n", "line 1: y must be finite, got inf"),
        ("0 0 0 0 0 0 0 2\n", "line 1: the quaternion must have length 1, got 2"),
        ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "line 2: time must increase, got 0 after 1"),
    ],
)  # fmt: skip
def test_refused_ground_truth(robot, text, message):
    (robot / "groundtruth.tum").write_text(text)
    assert refusal(robot) == f"A/groundtruth.tum: {message}"


def test_written_frames_are_read_back(tmp_path):
    rows = (
        FrameRow("a, b.png", 0.1 + 0.2, tilt_deg=1 / 3),
        FrameRow("c.png", 1.0, None, None, None, None, None, None, 1.0, 2.0, 3.0, 0.1, 0.2),
    )
    (tmp_path / "frames.csv").write_text(frames_text(rows))
    assert read_frames(tmp_path / "frames.csv") == rows


def test_a_written_trajectory_is_read_back(tmp_path):
    """Headings go through half-angle sines: equal to some eps, 1e-15 rad."""
    rng = np.random.default_rng(3)
    poses = [
        (1.4e9 + i / 3, Se2(*rng.normal(size=2), rng.uniform(-math.pi, math.pi))) for i in range(50)
    ]
    (tmp_path / "t.tum").write_text(trajectory_text(poses))
    again = read_trajectory(tmp_path / "t.tum")
    assert [time_s for time_s, _ in again] == [time_s for time_s, _ in poses]
    expected = np.array([pose.vector() for _, pose in poses])
    assert np.array([pose.vector() for _, pose in again]) == pytest.approx(expected, abs=1e-14)
