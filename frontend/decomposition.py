"""Closed-form motion from a floor homography (paper §4, eq. 7-18, in their corrected form).

Homographies here take undistorted rays of camera a to rays of camera b: A = K_b^-1 H_ba K_a. With
tilt a from nadir and no roll, A = R + t n^T / h_a, n = (0, sin a_a, cos a_a), once its middle
singular value is 1 and its determinant positive. What the print gets wrong, and proof of it, is in
`tests/test_errata.py`.
"""

import math
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, Se2, wrap_rad
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Matrix
from groundfuse.frontend.overhead import foot_from_cam


@dataclass(frozen=True, slots=True, kw_only=True)
class DecompositionOptions:
    """When the tilts are taken from the homography."""

    min_sin_theta: float = 0.25
    """Recover both tilts where |sin theta| is at least this; below, keep the calibrated ones."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("min_sin_theta",), shares=("min_sin_theta",))


@dataclass(frozen=True, slots=True)
class Decomposition:
    """What a floor homography says about the two cameras.

    Attributes:
        a_from_b: foot of b in the foot frame of a.
        tilt_a_rad: tilt of a, recovered or as calibrated.
        tilt_b_rad: tilt of b, the same.
        rise_m: height of camera b over camera a.
        tilts_recovered: whether the tilts come from the homography.
    """

    a_from_b: Se2
    tilt_a_rad: float
    tilt_b_rad: float
    rise_m: float
    tilts_recovered: bool


@dataclass(frozen=True, slots=True)
class Gamma:
    """A relative location as the paper states it (eq. 18).

    Attributes:
        rho_m: distance.
        phi1_rad: bearing of b seen from a, counter-clockwise from a's x axis, in [-pi, pi].
        phi2_rad: bearing of a seen from b, counter-clockwise from b's x axis, in [-pi, pi].
    """

    rho_m: float
    phi1_rad: float
    phi2_rad: float


def gamma(a_from_b: Se2) -> Gamma:
    """Return distance and both bearings of a relative pose (paper eq. 18)."""
    b_from_a = a_from_b.inverse()
    return Gamma(
        math.hypot(a_from_b.x_m, a_from_b.y_m),
        math.atan2(a_from_b.y_m, a_from_b.x_m),
        math.atan2(b_from_a.y_m, b_from_a.x_m),
    )


def rays_from_plane(attitude: Attitude) -> Matrix:
    """Return G: floor points (x, y, 1) in `foot` to homogeneous rays (paper eq. 1, any roll)."""
    axes = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    homography: Matrix = axes.T @ np.diag([1.0, 1.0, -attitude.height_m])
    return homography


def floor_homography(attitude_a: Attitude, a_from_b: Se2, attitude_b: Attitude) -> Matrix:
    """Return rays of b from rays of a over the floor: G_b S_ab^-1 G_a^-1 (paper eq. 6)."""
    b_from_a = a_from_b.inverse().matrix()
    homography: Matrix = (
        rays_from_plane(attitude_b) @ b_from_a @ np.linalg.inv(rays_from_plane(attitude_a))
    )
    return homography


def normalised(homography: Matrix) -> Matrix:
    """Scale a measured homography to middle singular value 1 and positive determinant.

    Raises:
        ValueError: the homography is not finite or has no inverse.
    """
    if not np.isfinite(homography).all():
        raise ValueError("homography is not finite")
    values = np.linalg.svd(homography, compute_uv=False)
    if not values[2] > 1e-12 * values[0]:
        raise ValueError(f"homography has no inverse, singular values {values}")
    scaled: Matrix = homography * (np.sign(np.linalg.det(homography)) / values[1])
    return scaled


def decompose(
    homography: Matrix,
    attitude_a: Attitude,
    attitude_b: Attitude,
    options: DecompositionOptions | None = None,
) -> Decomposition:
    """Recover the motion, the tilts where they show, and the height difference (paper §4.1).

    Exact for noise-free input where the calibrated rolls are true and either the tilts are
    recovered or the calibrated ones are true. Roll is taken out with the calibrated tilt.

    Args:
        homography: (3, 3) rays of b from rays of a, any scale and sign.
        attitude_a: calibration of a; its height is the unit of length.
        attitude_b: calibration of b; its height is not used.
        options: see there.

    Raises:
        ValueError: the homography is not finite or has no inverse.
    """
    options = options or DecompositionOptions()
    level_b, level_a = _level_from_cam(attitude_b), _level_from_cam(attitude_a)
    b_by_a = normalised(level_b @ homography @ level_a.T)
    tilt_a, tilt_b = attitude_a.tilt_rad, attitude_b.tilt_rad
    sine = math.copysign(math.hypot(b_by_a[1, 0], b_by_a[2, 0]), b_by_a[1, 0])
    recovered = abs(sine) >= options.min_sin_theta
    if recovered:
        a_by_b: Matrix = np.asarray(np.linalg.inv(b_by_a), dtype=np.float64)
        tilt_b, tilt_a = _tilt(b_by_a), _tilt(a_by_b)
    else:
        sine = b_by_a[1, 0] * math.cos(tilt_b) - b_by_a[2, 0] * math.sin(tilt_b)
    theta = math.atan2(sine, b_by_a[0, 0])
    step = _step(b_by_a, tilt_a, tilt_b, theta) * attitude_a.height_m
    return Decomposition(
        Se2(float(step[0]), float(step[1]), wrap_rad(theta)),
        tilt_a,
        tilt_b,
        float(step[2]),
        recovered,
    )


def _level_from_cam(attitude: Attitude) -> Matrix:
    """Return the rotation that turns a camera with roll into one without."""
    level = foot_from_cam(attitude.tilt_rad, 0.0)
    rotation: Matrix = level.T @ foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    return rotation


def _tilt(b_by_a: Matrix) -> float:
    """Tilt of b (paper eq. 11): its first column is (cos th, sin th cos a_b, -sin th sin a_b)."""
    return math.atan(-b_by_a[2, 0] / b_by_a[1, 0])


def _step(b_by_a: Matrix, tilt_a: float, tilt_b: float, theta: float) -> Floats:
    """Camera b seen from camera a, axes of foot a, in heights of a (paper eq. 12-18).

    t = (A - R) n weighs both of the paper's solutions by least squares and never divides. R takes
    the plumb line n of camera a to that of camera b, whatever the heading.
    """
    c, s = math.cos(theta), math.sin(theta)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    plumb_a = np.array([0.0, math.sin(tilt_a), math.cos(tilt_a)])
    plumb_b = np.array([0.0, math.sin(tilt_b), math.cos(tilt_b)])
    step: Floats = -turn @ foot_from_cam(tilt_b, 0.0) @ (b_by_a @ plumb_a - plumb_b)
    return step
