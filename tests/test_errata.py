"""The print of the paper against geometry: as printed wrong, as corrected right, row by row.

Its camera axes are x right, y up, z along the axis, its plane normal is (0, -sin a, cos a): its
homography is F A F of ours with F = diag(1, -1, 1), and A = R - T n^T in units of the height.
"""

import math

import numpy as np
import pytest

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.decomposition import (
    decompose,
    floor_homography,
    gamma,
    normalised,
    rays_from_plane,
)
from groundfuse.frontend.overhead import rays_from_floor

UP = np.diag([1.0, -1.0, 1.0])
TILT_I, TILT_J = math.radians(33.0), math.radians(45.0)
CAMERA_I, CAMERA_J = Attitude(TILT_I, 0.0, 0.55), Attitude(TILT_J, 0.0, 0.55)
MOTION = Se2(0.21, -0.13, math.radians(-43.0))
# Closed forms of a dozen double precision operations on numbers near 1; worst seen 4e-16.
TOLERANCE = 1e-13
# What is wrong is wrong by far more than any measurement.
WRONG = 0.01


def paper_homography(camera_i=CAMERA_I, motion=MOTION, camera_j=CAMERA_J):
    """A of the paper's eq. 9 (y up), normalised, and its inverse."""
    matrix = UP @ normalised(floor_homography(camera_i, motion, camera_j)) @ UP
    return matrix, np.linalg.inv(matrix)


def paper_translation():
    """T of the paper's eq. 9 from geometry: minus camera i in the axes (y up) of camera j."""
    i_in_j = MOTION.inverse()
    ci, si = math.cos(TILT_J), math.sin(TILT_J)
    right, forward = -i_in_j.y_m / 0.55, i_in_j.x_m / 0.55
    return -np.array([right, forward * ci, forward * si])


def test_eq_1_second_column():
    f, u0, v0 = 500.0, 320.0, 240.0
    lens_up = np.array([[f, 0, u0], [0, f, v0], [0, 0, 1]])

    def mapped(column, tilt):
        c, s = math.cos(tilt), math.sin(tilt)
        first, third = (f, 0, 0), (u0 * c, v0 * c - f * s, c)
        point = np.stack([first, column(c, s), third], axis=1) @ np.array([-0.2, 0.3, 0.55])
        return point[:2] / point[2]

    def printed(c, s):
        return u0 * c, f * s + v0 * c, c

    def corrected(c, s):
        return u0 * s, f * c + v0 * s, s

    for degrees, printed_is_right in ((20.0, False), (33.0, False), (45.0, True), (60.0, False)):
        tilt = math.radians(degrees)
        ray = rays_from_floor(Attitude(tilt, 0.0, 0.55), np.array([[0.3, 0.2]]))[0]
        truth = (lens_up @ UP @ [*ray, 1.0])[:2]
        np.testing.assert_allclose(mapped(corrected, tilt), truth, atol=1e-9)
        assert np.allclose(mapped(printed, tilt), truth, atol=1.0) == printed_is_right


def test_eq_6_direction_of_the_overhead_homography():
    image_from_overhead_i, image_from_overhead_j = map(rays_from_plane, (CAMERA_I, CAMERA_J))
    isometry = MOTION.inverse().matrix()
    printed = np.linalg.inv(image_from_overhead_j) @ isometry @ image_from_overhead_i
    corrected = image_from_overhead_j @ isometry @ np.linalg.inv(image_from_overhead_i)
    truth = normalised(floor_homography(CAMERA_I, MOTION, CAMERA_J))
    np.testing.assert_allclose(normalised(corrected), truth, atol=TOLERANCE)
    assert np.abs(normalised(printed) - truth).max() > WRONG


@pytest.mark.parametrize("scale", [2.0, -1.0, 0.01])
def test_4_1_a_measured_homography_must_be_normalised_first(scale):
    measured = scale * floor_homography(CAMERA_I, MOTION, CAMERA_J)
    c_theta = normalised(measured)[0, 0]
    assert c_theta == pytest.approx(math.cos(MOTION.theta_rad), abs=TOLERANCE)
    assert abs(measured[0, 0] - math.cos(MOTION.theta_rad)) > WRONG
    got = decompose(measured, CAMERA_I, CAMERA_J).a_from_b
    np.testing.assert_allclose(got.vector(), MOTION.vector(), atol=TOLERANCE)


def second_lines(matrix, theta, tilt_i, tilt_j):
    """T_y by the first line and by the printed and corrected second line of eq. 13 (or 16)."""
    ci, si, cj, sj = math.cos(tilt_i), math.sin(tilt_i), math.cos(tilt_j), math.sin(tilt_j)
    e, f = float(matrix[1, 1]), float(matrix[1, 2])
    first = (e - math.cos(theta) * cj * ci - sj * si) / si
    printed = (-f - math.cos(theta) * sj * ci - cj * si) / ci
    corrected = (-f + math.cos(theta) * cj * si - sj * ci) / ci
    return first, printed, corrected


def test_eq_13_second_line():
    matrix, _ = paper_homography()
    first, printed, corrected = second_lines(matrix, MOTION.theta_rad, TILT_I, TILT_J)
    truth = paper_translation()[1]
    assert (first, corrected) == pytest.approx((truth, truth), abs=TOLERANCE)
    assert abs(printed - truth) > WRONG


def test_eq_16_second_line():
    _, inverse = paper_homography()
    first, printed, corrected = second_lines(inverse, MOTION.theta_rad, TILT_J, TILT_I)
    truth = -MOTION.x_m / 0.55 * math.cos(TILT_I)  # minus camera j in the axes of camera i
    assert (first, corrected) == pytest.approx((truth, truth), abs=TOLERANCE)
    assert abs(printed - truth) > WRONG


def test_eq_12_to_17_divide_by_zero_at_nadir():
    nadir = Attitude(0.0, 0.0, 0.55)
    matrix, _ = paper_homography(nadir, MOTION, nadir)
    with pytest.raises(ZeroDivisionError):
        second_lines(matrix, MOTION.theta_rad, nadir.tilt_rad, nadir.tilt_rad)
    got = decompose(UP @ matrix @ UP, nadir, nadir).a_from_b
    np.testing.assert_allclose(got.vector(), MOTION.vector(), atol=TOLERANCE)


def test_the_tilt_is_undefined_where_the_robot_drives_straight():
    matrix, _ = paper_homography()
    assert math.atan(matrix[2, 0] / matrix[1, 0]) == pytest.approx(TILT_J, abs=TOLERANCE)
    straight = Se2(0.3, 0.0, 0.0)
    d, g = paper_homography(CAMERA_I, straight, CAMERA_J)[0][1:, 0]
    assert max(abs(d), abs(g)) < TOLERANCE  # 0 / 0: any tilt at all
    got = decompose(floor_homography(CAMERA_I, straight, CAMERA_J), CAMERA_I, CAMERA_J)
    assert (got.tilt_a_rad, got.tilt_b_rad) == (TILT_I, TILT_J)
    np.testing.assert_allclose(got.a_from_b.vector(), straight.vector(), atol=TOLERANCE)


def test_the_arc_cosine_loses_the_sign_of_the_turn():
    matrix, _ = paper_homography()
    assert math.acos(matrix[0, 0]) == pytest.approx(-MOTION.theta_rad, abs=TOLERANCE)
    got = decompose(UP @ matrix @ UP, CAMERA_I, CAMERA_J).a_from_b.theta_rad
    assert got == pytest.approx(MOTION.theta_rad, abs=TOLERANCE)


def test_4_2_the_translation_is_in_camera_j():
    _, ty, tz = paper_translation()

    def forward_and_up(tilt):
        return (
            ty * math.cos(tilt) + tz * math.sin(tilt),
            ty * math.sin(tilt) - tz * math.cos(tilt),
        )

    truth = -MOTION.inverse().x_m / 0.55
    assert forward_and_up(TILT_J) == pytest.approx((truth, 0.0), abs=TOLERANCE)
    printed = forward_and_up(TILT_I)
    assert abs(printed[0] - truth) > WRONG / 2
    assert abs(printed[1]) > WRONG


def example(tx):
    """Gamma of the worked example, axes x along the picture and y forward; cm and degrees."""
    ty, tz, height_cm, tilt = 0.21, 0.14, 80.0, math.radians(34.3)
    forward = ty * math.cos(tilt) + tz * math.sin(tilt)
    found = gamma(Se2(-tx * height_cm, forward * height_cm, math.radians(43.0)))
    up = -ty * math.sin(tilt) + tz * math.cos(tilt)
    return found.rho_m, math.degrees(found.phi1_rad), math.degrees(found.phi2_rad), up


def test_4_2_worked_example():
    rho, phi1, phi2, up = example(-0.60)
    assert rho == pytest.approx(52.07, abs=0.005)
    assert phi1 == pytest.approx(22.8, abs=0.05)
    assert phi2 == pytest.approx(159.8, abs=0.05)
    assert abs(up) < 0.005  # 0 to the two digits of T
    rho, phi1, _, _ = example(-0.66)
    assert abs(rho - 52.0) > 4.0
    assert abs(phi1 - 22.7) > 1.0


def test_each_camera_has_its_own_height():
    camera_j = Attitude(TILT_J, 0.0, 0.80)
    homography = floor_homography(CAMERA_I, MOTION, camera_j)
    got = decompose(homography, CAMERA_I, camera_j)
    np.testing.assert_allclose(got.a_from_b.vector(), MOTION.vector(), atol=TOLERANCE)
    assert got.rise_m == pytest.approx(0.25, abs=TOLERANCE)
    one_height = floor_homography(CAMERA_I, MOTION, CAMERA_J)
    assert np.abs(normalised(one_height) - normalised(homography)).max() > WRONG
