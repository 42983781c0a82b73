"""Small team folders on disk, for the tests of what is read and what is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from groundfuse.tools.errors import DataError
from groundfuse.tools.team_folder import load_image, read_team

WIDTH, HEIGHT = 64, 48
CAMERA = """\
image_width: 64
image_height: 48
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [50.0, 0.0, 31.5, 0.0, 52.0, 23.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.01, -0.002, 0.0003, 0.0001, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [50.0, 0.0, 31.5, 0.0, 0.0, 52.0, 23.5, 0.0, 0.0, 0.0, 1.0, 0.0]
mount:
  height_m: 0.55
  tilt_deg: 33.0
"""
"""As `camera_calibration` writes it, plus the mount."""


def picture(seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def encoded(image, suffix=".png"):
    done, data = cv2.imencode(suffix, image)
    assert done
    return data.tobytes()


def make_robot(team: Path, name="A", pictures=("img1.png", "img2.png", "img10.png")) -> Path:
    folder = team / name
    (folder / "images").mkdir(parents=True)
    for i, image in enumerate(pictures):
        (folder / "images" / image).write_bytes(encoded(picture(i), Path(image).suffix))
    (folder / "camera.yaml").write_text(CAMERA)
    return folder


def read(robot: Path):
    return read_team(robot.parent, [robot.name])[0]


def refusal(robot: Path, robots=("A",)) -> str:
    """The one line, without the folder that the test made."""
    with pytest.raises(DataError) as caught:
        read_team(robot.parent, robots)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(str(robot.parent))
    return text.replace(f"{robot.parent}/", "").replace(str(robot.parent), "team")


def change(robot: Path, old: str, new: str) -> None:
    text = (robot / "camera.yaml").read_text()
    assert old in text
    (robot / "camera.yaml").write_text(text.replace(old, new))


def store(robot: Path, name: str, data: bytes) -> Path:
    """Make this the robot's only picture."""
    for old in (robot / "images").iterdir():
        old.unlink()
    (robot / "images" / name).write_bytes(data)
    return robot


def loaded(robot: Path):
    member = read(robot)
    return load_image(member.frames[0], member.camera)
