"""The closed form returns the motion that made the homography, in every corner case."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from groundfuse.backend.measurement import IDENTITY, Attitude, Se2
from groundfuse.frontend.decomposition import (
    DecompositionOptions,
    decompose,
    floor_homography,
    gamma,
    normalised,
    rays_from_plane,
)
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor

# Double precision: eps 2.2e-16 x condition of the homography (below 1e3: heights 0.3 to 3 m,
# motions to 2 m) x 1 / sin theta (4) = 9e-13; worst of 20,000 seen 1e-14.
TOLERANCE = 1e-12

tilts = st.floats(-1.2, 1.2)
rolls = st.floats(-0.3, 0.3)
heights = st.floats(0.3, 3.0)
attitudes = st.builds(Attitude, tilts, rolls, heights)
level = st.builds(Attitude, tilts, st.just(0.0), heights)
poses = st.builds(Se2, st.floats(-2, 2), st.floats(-2, 2), st.floats(-3.1, 3.1))
scales = st.sampled_from([1.0, -1.0, 7.5, -0.01])


def check(got, a, motion, b, tolerance=TOLERANCE):
    np.testing.assert_allclose(got.a_from_b.vector(), motion.vector(), atol=tolerance)
    assert got.tilt_a_rad == pytest.approx(a.tilt_rad, abs=tolerance)
    assert got.tilt_b_rad == pytest.approx(b.tilt_rad, abs=tolerance)
    assert got.rise_m == pytest.approx(b.height_m - a.height_m, abs=tolerance)


@given(attitudes, poses, attitudes, scales)
def test_any_motion_of_any_two_calibrated_cameras_comes_back(a, motion, b, scale):
    got = decompose(scale * floor_homography(a, motion, b), a, b)
    check(got, a, motion, b)
    assert got.tilts_recovered == (abs(math.sin(motion.theta_rad)) >= 0.25)


@given(level, poses, level, st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)))
def test_unknown_tilts_are_recovered_where_the_robot_turned(a, motion, b, off):
    assume(abs(math.sin(motion.theta_rad)) > 0.26)
    believed_a = Attitude(a.tilt_rad + off[0], 0.0, a.height_m)
    believed_b = Attitude(b.tilt_rad + off[1], 0.0, b.height_m)
    got = decompose(floor_homography(a, motion, b), believed_a, believed_b)
    check(got, a, motion, b)
    assert got.tilts_recovered


@given(attitudes, poses, attitudes)
def test_the_way_back_is_the_inverse(a, motion, b):
    homography = floor_homography(a, motion, b)
    back = decompose(np.linalg.inv(homography), b, a).a_from_b
    np.testing.assert_allclose((motion @ back).vector(), 0.0, atol=TOLERANCE)


DEGENERATE = {
    "straight on": (33.0, Se2(0.3, 0.0, 0.0), 33.0),
    "sideways": (33.0, Se2(0.0, -0.2, 0.0), 45.0),
    "pure rotation": (33.0, Se2(0.0, 0.0, 1.0), 45.0),
    "half turn": (33.0, Se2(0.1, 0.2, math.pi), 45.0),
    "no motion": (33.0, IDENTITY, 33.0),
    "nadir, straight on": (0.0, Se2(0.3, 0.1, 0.0), 0.0),
    "nadir, turned": (0.0, Se2(0.3, 0.1, 0.8), 0.0),
    "nadir and tilted": (0.0, Se2(0.3, 0.1, -0.8), 45.0),
    "nadir, no motion": (0.0, IDENTITY, 0.0),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_motions_are_exact(case):
    tilt_a, motion, tilt_b = DEGENERATE[case]
    a, b = Attitude(math.radians(tilt_a), 0.0, 0.55), Attitude(math.radians(tilt_b), 0.0, 0.6)
    got = decompose(floor_homography(a, motion, b), a, b)
    theta_off = math.remainder(got.a_from_b.theta_rad - motion.theta_rad, 2 * math.pi)
    assert theta_off == pytest.approx(0.0, abs=TOLERANCE)
    assert (got.a_from_b.x_m, got.a_from_b.y_m) == pytest.approx(
        (motion.x_m, motion.y_m), abs=TOLERANCE
    )
    assert got.rise_m == pytest.approx(0.05, abs=TOLERANCE)


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_motions_stand_noise(case):
    tilt_a, motion, tilt_b = DEGENERATE[case]
    a, b = Attitude(math.radians(tilt_a), 0.0, 0.55), Attitude(math.radians(tilt_b), 0.0, 0.55)
    rng = np.random.default_rng(5)
    for _ in range(50):
        noisy = floor_homography(a, motion, b) + rng.normal(scale=1e-3, size=(3, 3))
        off = decompose(noisy, a, b).a_from_b.inverse() @ motion
        # First order: each of x, y is off by some 4 entries x 1e-3 x h = 1.1 mm (1 sigma),
        # theta by 1.4e-3.  Five sigma; worst of 4,500 seen 3.2 mm and 4e-3.
        assert math.hypot(off.x_m, off.y_m) < 0.006
        assert abs(off.theta_rad) < 0.007


def test_the_limit_of_tilt_recovery_is_an_option():
    a, motion = Attitude(0.6, 0.0, 0.55), Se2(0.1, 0.1, 0.1)
    homography = floor_homography(a, motion, a)
    wrong = Attitude(0.65, 0.0, 0.55)
    kept = decompose(homography, wrong, wrong)
    found = decompose(homography, wrong, wrong, DecompositionOptions(min_sin_theta=0.05))
    assert (kept.tilts_recovered, kept.tilt_a_rad) == (False, 0.65)
    assert found.tilts_recovered
    check(found, a, motion, a)


@given(attitudes, poses, attitudes, st.integers(0, 99))
def test_the_homography_is_floor_then_image(a, motion, b, seed):
    floor_a = np.random.default_rng(seed).uniform(-1, 1, (20, 2))
    rays_a = rays_from_floor(a, floor_a)
    rays_b = rays_from_floor(b, motion.inverse().apply(floor_a))
    seen = np.isfinite(rays_a).all(axis=1) & (np.abs(rays_a) < 9).all(axis=1)
    seen &= np.isfinite(rays_b).all(axis=1) & (np.abs(rays_b) < 9).all(axis=1)
    mapped = np.column_stack([rays_a, np.ones(20)]) @ floor_homography(a, motion, b).T
    # Rays up to 9: depth is above a tenth of the distance, so a division amplifies a hundredfold.
    np.testing.assert_allclose(
        mapped[seen, :2] / mapped[seen, 2:], rays_b[seen], atol=1e-9, rtol=1e-9
    )


def test_the_plane_matrix_is_the_one_of_the_paper():
    tilt, height = 0.4, 0.8
    c, s = math.cos(tilt), math.sin(tilt)
    expected = [[0, -1, 0], [-c, 0, height * s], [s, 0, height * c]]
    got = rays_from_plane(Attitude(tilt, 0.0, height))
    np.testing.assert_allclose(got, expected, atol=1e-15)
    floor = np.array([[0.3, 0.2]])
    mapped = np.array([0.3, 0.2, 1.0]) @ got.T
    back = floor_from_rays(Attitude(tilt, 0.0, height), mapped[None, :2] / mapped[2])
    np.testing.assert_allclose(back, floor, atol=1e-15)


@given(poses)
def test_gamma_states_the_pose(motion):
    found = gamma(motion)
    assume(found.rho_m > 1e-6)
    there = [found.rho_m * math.cos(found.phi1_rad), found.rho_m * math.sin(found.phi1_rad)]
    np.testing.assert_allclose(there, [motion.x_m, motion.y_m], atol=1e-12)
    turn = found.phi1_rad + math.pi - found.phi2_rad - motion.theta_rad
    assert math.remainder(turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_a_homography_without_inverse_is_refused():
    with pytest.raises(ValueError, match="homography has no inverse, singular values"):
        normalised(np.diag([1.0, 1.0, 0.0]))


def test_a_homography_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="homography is not finite"):
        decompose(np.full((3, 3), np.nan), Attitude(0.5, 0, 1), Attitude(0.5, 0, 1))
