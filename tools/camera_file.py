"""A robot's `camera.yaml`: ROS `camera_info` intrinsics, and the mount on the robot.

The intrinsics are those of the pictures as the sensor gave them: a `rectification_matrix` and a
`projection_matrix` may stand there and aren't used. Both forms that people have are read: the file
that `camera_calibration` saves (`image_width`, `camera_matrix`, ...) and an echoed message
(`width`, `K` or `k`, ...). `mount` is ours; angles are in degrees.
"""

import math
from pathlib import Path
from typing import Any

import yaml

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.tools.checks import finite_number, refuse_unknown, whole_number
from groundfuse.tools.errors import DataError
from groundfuse.tools.yaml_file import read_mapping

TILT_SIGMA_DEG = 0.5
ROLL_SIGMA_DEG = 0.15
HEIGHT_SIGMA_SHARE = 0.004
"""Wobble where the mount states none: of a small wheeled robot on a smooth floor."""

NUM_COEFFICIENTS = {
    Distortion.PLUMB_BOB: (0, 4, 5),
    Distortion.RATIONAL: (8,),
    Distortion.EQUIDISTANT: (0, 4),
}
OTHER_NAMES = {"fisheye": "equidistant", "none": "plumb_bob", "": "plumb_bob"}
MESSAGE_KEYS = {
    "width": "image_width",
    "height": "image_height",
    "K": "camera_matrix",
    "k": "camera_matrix",
    "D": "distortion_coefficients",
    "d": "distortion_coefficients",
}
NEEDED = ("image_width", "image_height", "camera_matrix", "distortion_model", "mount")
UNUSED = (
    *("rectification_matrix", "projection_matrix", "R", "r", "P", "p", "header", "binning_x"),
    "estimated",  # what a bundle knew of the numbers
)
KNOWN = (*NEEDED, "distortion_coefficients", "camera_name", *UNUSED, "binning_y", "roi")
MOUNT_NEEDED = ("height_m", "tilt_deg")
MOUNT_OPTIONAL = (
    *("roll_deg", "x_m", "y_m", "yaw_deg", "tilt_sigma_deg", "roll_sigma_deg"),
    *("height_sigma_m", "first_row", "last_row"),
)


def read_camera(path: Path) -> Camera:
    """Return the camera that a file describes.

    Raises:
        DataError: the file is missing, isn't YAML, or has a missing, unknown or impossible entry.
    """
    document = read_mapping(path)
    try:
        return _camera({MESSAGE_KEYS.get(key, key): value for key, value in document.items()})
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def camera_text(camera: Camera) -> str:
    """Return the text of a `camera.yaml` from which `read_camera` gives back the camera."""
    lens, mount = camera.intrinsics, camera.mount
    matrix = [lens.fx_px, 0.0, lens.cx_px, 0.0, lens.fy_px, lens.cy_px, 0.0, 0.0, 1.0]
    coefficients = list(lens.coefficients)
    document = {
        "image_width": lens.width_px,
        "image_height": lens.height_px,
        "camera_name": camera.name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": matrix},
        "distortion_model": str(lens.model),
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": coefficients},
        "mount": {
            "height_m": mount.attitude.height_m,
            "tilt_deg": math.degrees(mount.attitude.tilt_rad),
            "roll_deg": math.degrees(mount.attitude.roll_rad),
            "x_m": mount.base_from_foot.x_m,
            "y_m": mount.base_from_foot.y_m,
            "yaw_deg": math.degrees(mount.base_from_foot.theta_rad),
            "tilt_sigma_deg": math.degrees(mount.sigma.tilt_rad),
            "roll_sigma_deg": math.degrees(mount.sigma.roll_rad),
            "height_sigma_m": mount.sigma.height_m,
            "first_row": camera.first_row,
            "last_row": camera.last_row,
        },
    }
    text: str = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    return text


def _camera(document: dict[str, Any]) -> Camera:
    refuse_unknown(document, KNOWN, "key")
    _need(document, NEEDED, "")
    mount = document["mount"]
    if not isinstance(mount, dict):
        raise ValueError(f"mount must have keys of its own ({', '.join(MOUNT_NEEDED)}, ...)")  # noqa: TRY004 (file content)
    refuse_unknown(mount, (*MOUNT_NEEDED, *MOUNT_OPTIONAL), "key in mount")
    _need(mount, MOUNT_NEEDED, "mount: ")
    intrinsics = _intrinsics(document)
    first, last = whole_number(mount.get("first_row", 0), "first_row"), -1
    if mount.get("last_row", -1) != -1:
        last = whole_number(mount["last_row"], "last_row")
    if not 0 <= first < (intrinsics.height_px - 1 if last == -1 else last) < intrinsics.height_px:
        raise ValueError(
            f"rows {first} to {last} are no part of a picture of {intrinsics.height_px} rows"
        )
    return Camera(intrinsics, _mount(mount), first, last, str(document.get("camera_name", "")))


def _need(entries: dict[str, Any], needed: tuple[str, ...], where: str) -> None:
    missing = [key for key in needed if entries.get(key) is None]
    if missing:
        raise ValueError(f"{where}missing key {missing[0]!r} (needed: {', '.join(needed)})")


def _intrinsics(document: dict[str, Any]) -> Intrinsics:
    size = [whole_number(document[key], key) for key in ("image_width", "image_height")]
    if min(size) < 1:
        raise ValueError(f"image size must be positive, got {size[0]} x {size[1]}")
    matrix = _numbers(document["camera_matrix"], "camera_matrix", (9,))
    fx, skew, cx, below, fy, cy, *last = matrix
    if (skew, below, *last) != (0.0, 0.0, 0.0, 0.0, 1.0):
        raise ValueError(f"camera_matrix must be [fx 0 cx; 0 fy cy; 0 0 1], got {matrix}")
    if min(fx, fy) <= 0.0:
        raise ValueError(f"focal lengths must be positive, got {fx:g} and {fy:g} px")
    name = str(document["distortion_model"]).strip().casefold()
    name = OTHER_NAMES.get(name, name)
    refuse_unknown([name], [model.value for model in Distortion], "distortion_model")
    model = Distortion(name)
    coefficients = _numbers(
        document.get("distortion_coefficients") or [],
        f"distortion_coefficients of {model}",
        NUM_COEFFICIENTS[model],
    )
    return Intrinsics(size[0], size[1], fx, fy, cx, cy, model, coefficients)


def _numbers(entry: object, name: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the numbers of `{rows, cols, data: [...]}` or of a plain list."""
    data = entry.get("data") if isinstance(entry, dict) else entry
    if not isinstance(data, list):
        raise ValueError(f"{name} must hold a list of numbers (data: [...]), got {data!r}")  # noqa: TRY004 (file content)
    if len(data) not in counts:
        needed = " or ".join(map(str, counts))
        raise ValueError(f"{name} must have {needed} numbers, got {len(data)}")
    return tuple(finite_number(value, f"{name}[{i}]") for i, value in enumerate(data))


def _mount(entries: dict[str, Any]) -> Mount:
    def number(name: str, default: float = 0.0) -> float:
        return finite_number(entries.get(name, default), name)

    def radians(name: str, default: float = 0.0) -> float:
        return math.radians(number(name, default))

    attitude = Attitude(radians("tilt_deg"), radians("roll_deg"), number("height_m"))
    sigma = Attitude(
        radians("tilt_sigma_deg", TILT_SIGMA_DEG),
        radians("roll_sigma_deg", ROLL_SIGMA_DEG),
        number("height_sigma_m", HEIGHT_SIGMA_SHARE * attitude.height_m),
    )
    return Mount(attitude, sigma, Se2(number("x_m"), number("y_m"), radians("yaw_deg")))
