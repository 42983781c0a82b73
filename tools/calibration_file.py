"""A robot's camera as the bundle found it: a `camera.yaml` to use from now on, with sigmas.

Numbers that the pictures contradict are replaced by the estimates, the others stay as filed. The
block `estimated` tells of every number what the file said, what the pictures say, how sure they
are, and whether it was replaced; where they do not tell, there is no value. Absolute heights rest
on the files: a robot's height is estimated against the others', at the team's mean scale.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from groundfuse.backend.bundle_estimate import BundleEstimate, Estimated, MountEstimate
from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.arrays import Points
from groundfuse.frontend.camera import Camera, Intrinsics
from groundfuse.tools.camera_file import camera_text
from groundfuse.tools.files import write_atomic
from groundfuse.tools.robot import Robot

GRID = 25
"""Pixels along and across a picture on which a lens is fitted."""
FIXED_POINT_STEPS = 20


def calibrated_camera(camera: Camera, found: MountEstimate) -> Camera:
    """Return the camera with the numbers that the bundle replaced."""
    mount = replace(camera.mount, attitude=calibrated_attitude(camera.mount.attitude, found))
    focal, term = correction(found.focal), correction(found.distortion)
    return replace(camera, mount=mount, intrinsics=corrected_lens(camera.intrinsics, focal, term))


def calibrated_attitude(filed: Attitude, found: MountEstimate) -> Attitude:
    """Return a mount's or a picture's expected attitude with the numbers that were replaced."""
    return Attitude(
        filed.tilt_rad + correction(found.tilt_rad),
        filed.roll_rad + correction(found.roll_rad),
        filed.height_m * (1.0 + correction(found.height)),
    )


def correction(found: Estimated | None) -> float:
    """Return what the bundle adds to a file's number; 0 where it left it."""
    if found is None or not found.used or found.value is None:
        return 0.0
    return found.value


def corrected_lens(lens: Intrinsics, focal: float, term: float) -> Intrinsics:
    """Return the lens with its focal length longer by a fraction, and its first term larger.

    The term is that of rays without distortion, `(1 + term |true|^2) true = filed`: what comes
    nearest to it is fitted to the pixels of a grid, good to a hundredth of a pixel for the usual
    lenses and corrections.
    """
    longer = 1.0 + focal
    lens = replace(lens, fx_px=lens.fx_px * longer, fy_px=lens.fy_px * longer)
    if term == 0.0:
        return lens
    u, v = np.meshgrid(
        np.linspace(0.0, lens.width_px - 1.0, GRID), np.linspace(0.0, lens.height_px - 1.0, GRID)
    )
    pixels = np.column_stack([u.ravel(), v.ravel()])
    filed = lens.rays_from_px(pixels)
    seen = np.isfinite(filed).all(axis=1)
    true = _true_rays(filed[seen], term)
    centre = np.array([lens.cx_px, lens.cy_px])
    straight = (_with_first_term(lens, 0.0).px_from_rays(true) - centre).ravel()
    bent = (_with_first_term(lens, 1.0).px_from_rays(true) - centre).ravel() - straight
    (scale, scaled_term), *_ = np.linalg.lstsq(
        np.stack([straight, bent], axis=1), (pixels[seen] - centre).ravel(), rcond=None
    )
    better = _with_first_term(lens, float(scaled_term / scale))
    return replace(better, fx_px=lens.fx_px * float(scale), fy_px=lens.fy_px * float(scale))


def _true_rays(filed: Points, term: float) -> Points:
    rays = filed
    for _ in range(FIXED_POINT_STEPS):
        rays = filed / (1.0 + term * np.sum(rays**2, axis=1, keepdims=True))
    return rays


def _with_first_term(lens: Intrinsics, term: float) -> Intrinsics:
    others = lens.coefficients[1:] or (0.0, 0.0, 0.0)
    return replace(lens, coefficients=(term, *others))


def calibration_text(camera: Camera, found: MountEstimate, scale_sigma: float) -> str:
    """Return the text of the file; `read_camera` reads it as the calibrated camera."""
    better = calibrated_camera(camera, found)
    filed, lens = camera.mount.attitude, camera.intrinsics
    degree = math.degrees(1.0)
    first = lens.coefficients[0] if lens.coefficients else 0.0
    rows = {
        "tilt_deg": _entry(found.tilt_rad, filed.tilt_rad * degree, degree),
        "roll_deg": _entry(found.roll_rad, filed.roll_rad * degree, degree),
        "height_m": _entry(found.height, filed.height_m, filed.height_m),
        "focal_px": _entry(found.focal, lens.focal_px, lens.focal_px),
        "first_distortion": _entry(found.distortion, first, 1.0),
    }
    known = {name: row for name, row in rows.items() if row is not None}
    block = {"estimated": {**known, "scale_sigma": float(scale_sigma)}}
    text: str = yaml.safe_dump(block, sort_keys=False, default_flow_style=None, width=100)
    return camera_text(better) + text


def _entry(found: Estimated | None, filed: float, unit: float) -> dict[str, Any] | None:
    """One number: `value` and `file` in the file's unit; `unit` is what a correction counts in."""
    if found is None:
        return None
    entry: dict[str, Any] = {"file": float(filed), "used": found.used and found.value is not None}
    if found.value is None:
        return {**entry, "value": None, "sigma": None}
    return {**entry, "value": float(filed + unit * found.value), "sigma": float(unit * found.sigma)}


def write_calibrations(out: Path, robots: tuple[Robot, ...], bundled: BundleEstimate) -> None:
    """Write `<robot>_calibration.yaml` for every robot of the bundle.

    Raises:
        DataError: it can't be written.
    """
    cameras = {robot.name: robot.camera for robot in robots}
    for found in bundled.mounts:
        text = calibration_text(cameras[found.robot], found, bundled.scale_sigma)
        write_atomic(out / f"{found.robot}_calibration.yaml", text)
