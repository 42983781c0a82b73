"""The lens models agree with OpenCV's, and going back is the inverse of going there."""

import math
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from groundfuse.backend.measurement import IDENTITY, Attitude
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount

# The same polynomial in another order of operations: pixels up to 4e3, 20 operations of 2.2e-16:
# 2e-11 px. Worst seen over 20,000 lenses 1.8e-12 px.
TOLERANCE_PX = 1e-10
# Going back stops at rounding of the forward model. Worst seen over 20,000 lenses 1.8e-12 px.
ROUND_TRIP_PX = 1e-10

FOCAL = st.floats(200.0, 2000.0)
CENTRE = st.floats(100.0, 1000.0)
# Monotone over |x|, |y| <= 0.6: slope 1 + 3 k1 r2 + 5 k2 r4 + 7 k3 r6 > 0.15 for r2 <= 0.72.
SMALL = st.floats(-0.01, 0.01)
PLUMB_BOB = st.tuples(
    st.floats(-0.2, 0.3), st.floats(-0.05, 0.1), SMALL, SMALL, st.floats(-0.02, 0.05)
)
RATIONAL = st.tuples(
    *(st.floats(-0.1, 0.2), st.floats(-0.05, 0.05), SMALL, SMALL),
    *(st.floats(-0.02, 0.02), st.floats(-0.1, 0.1), SMALL, SMALL),
)
# 1 + 3 k1 t2 + 5 k2 t4 + 7 k3 t6 + 9 k4 t8 > 0.35 up to t = atan(3) = 1.25.
TINY = st.floats(-0.004, 0.004)
FISHEYE = st.tuples(st.floats(-0.05, 0.05), TINY, TINY, TINY)
LENSES = st.one_of(
    st.tuples(st.just(Distortion.PLUMB_BOB), st.one_of(PLUMB_BOB, PLUMB_BOB.map(lambda k: k[:4]))),
    st.tuples(st.just(Distortion.RATIONAL), RATIONAL),
    st.tuples(st.just(Distortion.EQUIDISTANT), FISHEYE),
    st.tuples(st.sampled_from(Distortion), st.just(())),
)


@st.composite
def lenses(draw):
    model, coefficients = draw(LENSES)
    size = (draw(FOCAL), draw(FOCAL), draw(CENTRE), draw(CENTRE))
    return Intrinsics(1280, 960, *size, model, coefficients)


def rays_of(seed, lens):
    """Rays over the field that the model is for: up to 72 deg off the axis for a fisheye."""
    rng = np.random.default_rng(seed)
    wide = 3.0 if lens.model is Distortion.EQUIDISTANT else 0.6
    rays = rng.uniform(-0.6, 0.6, (40, 2))
    rays = rays / np.hypot(*rays.T)[:, None] * rng.uniform(0.0, wide, (40, 1))
    return np.concatenate([rays, np.zeros((1, 2))])


def opencv_pixels(lens, rays):
    points = np.column_stack([rays, np.ones(len(rays))]).reshape(-1, 1, 3)
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    still = np.zeros(3)
    if lens.model is Distortion.EQUIDISTANT:
        pixels, _ = cv2.fisheye.projectPoints(
            points,
            still.reshape(1, 1, 3),
            still.reshape(1, 1, 3),
            matrix,
            np.array(lens.coefficients or (0.0,) * 4),
        )
    else:
        coefficients = np.array(lens.coefficients) if lens.coefficients else np.zeros(5)
        pixels, _ = cv2.projectPoints(points, still, still, matrix, coefficients)
    return pixels.reshape(-1, 2)


@given(lenses(), st.integers(0, 2**32 - 1))
def test_pixels_are_those_of_opencv(lens, seed):
    rays = rays_of(seed, lens)
    assert lens.px_from_rays(rays) == pytest.approx(opencv_pixels(lens, rays), abs=TOLERANCE_PX)


@given(lenses(), st.integers(0, 2**32 - 1))
def test_rays_undo_pixels(lens, seed):
    rays = rays_of(seed, lens)
    pixels = lens.px_from_rays(rays)
    again = lens.rays_from_px(pixels)
    assert lens.px_from_rays(again) == pytest.approx(pixels, abs=ROUND_TRIP_PX)
    # a wide ray is moved by up to 1 + r2 = 10 times its pixel's error over the focal length
    assert again == pytest.approx(rays, abs=100 * ROUND_TRIP_PX / 200.0)


def lens_with(model, *coefficients):
    return Intrinsics(640, 480, 300.0, 300.0, 319.5, 239.5, model, coefficients)


def test_a_pixel_without_a_ray_is_nan():
    """Strong barrel distortion folds back at r = 0.577: 0.385 f is the farthest pixel there is."""
    lens = lens_with(Distortion.PLUMB_BOB, -1.0, 0.0, 0.0, 0.0)
    axis = np.array([319.5, 239.5])
    inside, outside = lens.rays_from_px(axis + 300.0 * np.array([[0.36, 0.0], [0.42, 0.0]]))
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()
    assert np.isnan(lens.px_from_rays(np.array([[np.nan, np.nan]]))).all()


def test_a_fisheye_has_no_rays_beyond_the_side():
    """(x/z, y/z) ends at 90 deg off the axis, where an equidistant pixel is at f pi / 2."""
    lens = lens_with(Distortion.EQUIDISTANT, 1e-9, 0.0, 0.0, 0.0)
    at = 300.0 * np.radians([[0.0, 85.0], [0.0, 95.0]])
    rays = lens.rays_from_px(at + np.array([319.5, 239.5]))
    assert rays[0] == pytest.approx([0.0, math.tan(math.radians(85.0))], abs=1e-6)
    assert np.isnan(rays[1]).all()


@given(lenses())
def test_no_points_are_no_points(lens):
    assert lens.rays_from_px(np.zeros((0, 2))).shape == (0, 2)
    assert lens.px_from_rays(np.zeros((0, 2))).shape == (0, 2)


@given(FOCAL, FOCAL)
def test_the_focal_length_is_the_geometric_mean(fx, fy):
    assume(fx != fy)
    lens = Intrinsics(640, 480, fx, fy, 0.0, 0.0)
    assert lens.focal_px**2 == pytest.approx(fx * fy)


GOOD = Attitude(0.1, 0.1, 0.1)


@pytest.mark.parametrize(
    ("attitude", "sigma", "message"),
    [
        (Attitude(0.5, 0.0, -0.5), GOOD, r"^camera must be above the floor, got height_m -0\.5$"),
        (Attitude(0.5, 0.0, 0.0), GOOD, r"^camera must be above the floor, got height_m 0$"),
        (Attitude(0.5, 0.0, math.nan), GOOD, r"^camera must be above the floor, got height_m nan$"),
        (Attitude(1.6, 0.0, 1.0), GOOD, r"^tilt from nadir must lie within 90 deg, got 91\.67"),
        (Attitude(-1.6, 0.0, 1.0), GOOD, r"^tilt from nadir must lie within 90 deg, got -91\.67"),
        (GOOD, Attitude(0.0, 0.1, 0.1), r"^wobble sigmas must be positive"),
        (GOOD, Attitude(0.1, -0.1, 0.1), r"^wobble sigmas must be positive"),
        (GOOD, Attitude(0.1, 0.1, 0.0), r"^wobble sigmas must be positive"),
    ],
)
def test_mounts_that_cannot_be(attitude, sigma, message):
    with pytest.raises(ValueError, match=message):
        Mount(attitude, sigma)


def test_used_rows_and_pickling():
    lens = lens_with(Distortion.EQUIDISTANT, 0.1, 0.0, 0.0, 0.0)
    camera = Camera(lens, Mount(GOOD, GOOD, IDENTITY), 12)
    assert camera.used_rows == (12, 479)
    assert Camera(lens, camera.mount, 12, 400).used_rows == (12, 400)
    assert pickle.loads(pickle.dumps(camera)) == camera  # noqa: S301 (our own)


def test_an_ideal_fisheye_is_no_pinhole():
    for coefficients in ((), (0.0,) * 4):
        lens = Intrinsics(
            640, 480, 500.0, 500.0, 320.0, 240.0, Distortion.EQUIDISTANT, coefficients
        )
        ray = np.array([[1.0, 0.0], [0.0, 0.0]])
        pixels = np.array([[320.0 + 500.0 * math.pi / 4, 240.0], [320.0, 240.0]])
        np.testing.assert_allclose(lens.px_from_rays(ray), pixels, atol=1e-9)
        np.testing.assert_allclose(lens.rays_from_px(pixels), ray, atol=1e-8)


def test_a_single_coefficient_is_enough():
    lens = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, Distortion.PLUMB_BOB, (-0.1,))
    rays = np.array([[0.4, -0.2]])
    wanted = np.array([[320.0, 240.0]]) + 500.0 * rays * (1 - 0.1 * 0.2)
    np.testing.assert_allclose(lens.px_from_rays(rays), wanted, atol=1e-9)
    np.testing.assert_allclose(lens.rays_from_px(wanted), rays, atol=1e-8)
