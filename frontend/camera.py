"""A camera on a robot: intrinsics with distortion, and how it is mounted over the floor.

Frames: `px` pixels (u right, v down, centres at integers); a *ray* is (x/z, y/z) in `cam` (OpenCV:
x right, y down, z along the axis), free of distortion; `foot` is on the floor straight below the
camera, x along the camera's heading, y left, z up; `base` is the robot's (REP 103). Tilt is
measured from nadir (0 looks straight down). Roll is the lean about the heading, positive where the
left side goes up; unlike a turn about the optical axis it is apart from the heading at every tilt.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum

import cv2
import numpy as np

from groundfuse.backend.measurement import IDENTITY, Attitude, Se2
from groundfuse.frontend.arrays import Points
from groundfuse.frontend.lens_compiled import fisheye_px, plumb_bob_px

MOST_COEFFICIENTS = 8
NEWTON_STEPS = 5
RAY_STEP = 1e-6
SOLVED_PX = 1e-6


class Distortion(StrEnum):
    """Distortion models by their ROS names."""

    PLUMB_BOB = "plumb_bob"
    RATIONAL = "rational_polynomial"
    EQUIDISTANT = "equidistant"


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole with distortion, as in a ROS `camera_info`.

    Attributes:
        width_px: columns of the picture.
        height_px: rows of the picture.
        fx_px: focal length along u.
        fy_px: focal length along v.
        cx_px: principal point u.
        cy_px: principal point v.
        model: distortion model.
        coefficients: in OpenCV's order for the model; () for none.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    model: Distortion = Distortion.PLUMB_BOB
    coefficients: tuple[float, ...] = ()

    @property
    def focal_px(self) -> float:
        """Geometric mean of both focal lengths."""
        return math.sqrt(self.fx_px * self.fy_px)

    @property
    def is_pinhole(self) -> bool:
        """Whether nothing bends the rays; a fisheye bends them with all coefficients zero too."""
        return self.model is not Distortion.EQUIDISTANT and not any(self.coefficients)

    @property
    def _at_least_four(self) -> tuple[float, ...]:
        """Coefficients as OpenCV takes them."""
        return (*self.coefficients, *(0.0,) * (4 - len(self.coefficients)))

    def _matrix(self) -> Points:
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    def rays_from_px(self, points_px: Points) -> Points:
        """Undistort pixels (n, 2) to rays (n, 2); a pixel without a ray becomes nan."""
        if len(points_px) == 0:
            return np.zeros((0, 2))
        if self.is_pinhole:
            return self._pinhole_rays(points_px)
        points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
        matrix, coefficients = self._matrix(), np.array(self._at_least_four)
        if self.model is Distortion.EQUIDISTANT:
            start = cv2.fisheye.undistortPoints(points, matrix, coefficients)
        else:
            start = cv2.undistortPoints(points, matrix, coefficients)
        return self._polished(np.asarray(start, dtype=np.float64).reshape(-1, 2), points[:, 0])

    def _polished(self, rays: Points, points_px: Points) -> Points:
        """Newton on the forward model: OpenCV 4 stops after five fixed-point steps."""
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # no ray: becomes nan
            return self._newton(rays, points_px)

    def _newton(self, rays: Points, points_px: Points) -> Points:
        for _ in range(NEWTON_STEPS):
            error = self.px_from_rays(rays) - points_px
            ju = (
                self.px_from_rays(rays + np.array([RAY_STEP, 0.0])) - points_px - error
            ) / RAY_STEP
            jv = (
                self.px_from_rays(rays + np.array([0.0, RAY_STEP])) - points_px - error
            ) / RAY_STEP
            determinant = ju[:, 0] * jv[:, 1] - jv[:, 0] * ju[:, 1]
            step_x = (jv[:, 1] * error[:, 0] - jv[:, 0] * error[:, 1]) / determinant
            step_y = (ju[:, 0] * error[:, 1] - ju[:, 1] * error[:, 0]) / determinant
            rays = rays - np.stack([step_x, step_y], axis=1)
        residual_px = np.hypot(*(self.px_from_rays(rays) - points_px).T)
        found: Points = np.where((residual_px < SOLVED_PX)[:, None], rays, np.nan)
        return found

    def _pinhole_rays(self, points_px: Points) -> Points:
        centre = np.array([self.cx_px, self.cy_px])
        rays: Points = (points_px - centre) / (self.fx_px, self.fy_px)
        return rays

    def px_from_rays(self, rays: Points) -> Points:
        """Project rays (n, 2) to distorted pixels (n, 2); nan stays nan."""
        scale = np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px])
        coefficients = np.zeros(MOST_COEFFICIENTS)
        coefficients[: len(self.coefficients)] = self.coefficients
        rays, px = np.ascontiguousarray(rays, dtype=np.float64), np.empty(rays.shape)
        project = fisheye_px if self.model is Distortion.EQUIDISTANT else plumb_bob_px
        project(rays, scale, coefficients, px)
        return px


@dataclass(frozen=True, slots=True)
class Mount:
    """How a camera sits on its robot.

    Attributes:
        attitude: nominal tilt, roll and height.
        sigma: standard deviation of the per-frame wobble of the three.
        base_from_foot: planar offset and yaw of the camera on the robot.
    """

    attitude: Attitude
    sigma: Attitude
    base_from_foot: Se2 = IDENTITY

    def __post_init__(self) -> None:
        """Refuse a camera that is not above the floor or looks away from it (ValueError)."""
        if not self.attitude.height_m > 0.0:
            raise ValueError(
                f"camera must be above the floor, got height_m {self.attitude.height_m:g}"
            )
        if not abs(self.attitude.tilt_rad) < math.pi / 2:
            raise ValueError(
                "tilt from nadir must lie within 90 deg, "
                f"got {math.degrees(self.attitude.tilt_rad):g}"
            )
        if min(self.sigma.tilt_rad, self.sigma.roll_rad, self.sigma.height_m) <= 0.0:
            raise ValueError("wobble sigmas must be positive: no camera stands perfectly still")


@dataclass(frozen=True, slots=True)
class Camera:
    """A robot's camera.

    Attributes:
        intrinsics: projection.
        mount: place on the robot.
        first_row: first picture row that is used (all columns).
        last_row: last picture row that is used, inclusive; -1 for the last one.
    """

    intrinsics: Intrinsics
    mount: Mount
    first_row: int = 0
    last_row: int = -1
    name: str = field(default="camera", compare=False)

    @property
    def used_rows(self) -> tuple[int, int]:
        """First and last used row, both inclusive."""
        last = self.last_row if self.last_row >= 0 else self.intrinsics.height_px - 1
        return self.first_row, last
