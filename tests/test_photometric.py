"""The photometric stage: from a pixel or two off to half a millimetre, whatever the light."""

import dataclasses
import math

import numpy as np
import pytest
from floor_pairs import (
    camera,
    error_of,
    geometric_pair,
    nees,
    photo,
    prior,
    true_foot_motion,
    true_motion,
    view_of,
)
from scipy import stats

from groundfuse.backend.measurement import IDENTITY, Attitude, FrameId, RelativePose, Se2
from groundfuse.frontend import photometric
from groundfuse.frontend.matches import Matches
from groundfuse.frontend.motion import MotionOptions, relative_pose
from groundfuse.frontend.photometric import PhotometricOptions, align, grey_view
from groundfuse.frontend.photometric_compiled import Lens, Slopes, linearise, weigh
from groundfuse.tools.photometry import PLAIN, Photometry

BARREL = (-0.2, 0.05, 1e-3, -8e-4, 0.0)
OPTIONS = PhotometricOptions()
CAMERAS = {
    "alike": (camera(33.0), camera(33.0)),
    "nadir": (camera(0.0), camera(0.0)),
    "tilts": (camera(25.0), camera(40.0)),
    "lenses": (camera(33.0, coefficients=BARREL), camera(33.0, focal_px=200.0)),
    "bent": (camera(33.0), camera(33.0, coefficients=BARREL)),
}
OFF = (Se2(0.004, -0.003, 0.004), Se2(-0.004, 0.004, -0.003), Se2(0.0, -0.005, 0.0))
"""A pixel or two: at 33 deg a pixel covers 2.1 mm below the camera and 4 mm in the middle."""


def pair_of(cameras, number=30, light=None):
    at = Se2(0.0, 0.0, 0.2), Se2(0.15, 0.05, 0.5)
    return tuple(
        photo(cam, pose, frame=FrameId(name, number), light=light or Photometry())
        for cam, pose, name in zip(cameras, at, "AB", strict=True)
    )


def prepared(frame, image=None):
    return grey_view(frame.image if image is None else image, frame.view.camera, OPTIONS)


def aligned(pair, off=IDENTITY, *, images=(None, None), options=OPTIONS, attitudes=None):
    """From the true attitudes, as the fit to features finds them to within a tenth of a pixel."""
    views = [view_of(frame) for frame in pair]
    greys = [prepared(frame, image) for frame, image in zip(pair, images, strict=True)]
    start = true_foot_motion(*pair) @ off
    known = attitudes or tuple(frame.attitude for frame in pair)
    return align(*greys, start, views[0].prior, views[1].prior, known, options)


# Grey values fix the pair to 0.1 mm; what is left is the wobble that a pair cannot show (0.4 mm, as
# the covariance says). Worst seen over these pairs 0.7 mm, 0.08 deg.
NEAR_M, NEAR_RAD = 0.001, math.radians(0.1)


@pytest.mark.parametrize("cameras", CAMERAS.values(), ids=CAMERAS)
def test_a_start_a_pixel_or_two_off_ends_below_a_millimetre(cameras):
    pair = pair_of(cameras)
    truth = true_foot_motion(*pair)
    ends = []
    for off in OFF:
        found = aligned(pair, off)
        error = error_of(found.a_from_b, truth)
        assert np.hypot(*error[:2]) < NEAR_M
        assert abs(error[2]) < NEAR_RAD
        assert found.residual < 0.3
        assert found.num_points > 100
        ends.append(error)
    # All end at one place: steps below a hundredth of a sigma are not taken; worst seen 0.02 mm.
    np.testing.assert_allclose(ends, np.broadcast_to(ends[0], (3, 3)), atol=1e-4)


def test_covariance_is_honest():
    scores, pulls = [], []
    for number in range(30, 42):
        pair = pair_of(CAMERAS["alike"], number)
        found = aligned(pair, OFF[0])
        scores.append(nees(found.a_from_b, found.covariance, true_foot_motion(*pair)))
        pulls.append(found.attitude_b.tilt_rad - found.attitude_a.tilt_rad)
        pulls[-1] -= pair[1].attitude.tilt_rad - pair[0].attitude.tilt_rad
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(scores))
    assert low < sum(scores) < high
    # The difference of the tilts, drawn to 0.7 deg, is found as well.
    assert np.std(pulls) < math.radians(0.1)


LIGHTS = {
    "dim": lambda image: image * 0.45,
    "bright": lambda image: image * 1.2 + 25.0,
    "uneven": lambda image: image * np.linspace(0.5, 1.3, image.shape[1])[None, :, None],
}


@pytest.mark.parametrize("change", LIGHTS.values(), ids=LIGHTS)
def test_light_does_not_move_the_floor(change):
    pair = pair_of(CAMERAS["alike"])
    lit = np.clip(np.rint(change(pair[1].image.astype(float))), 0, 255).astype(np.uint8)
    found = aligned(pair, OFF[0], images=(None, lit))
    error = error_of(found.a_from_b, true_foot_motion(*pair))
    assert np.hypot(*error[:2]) < NEAR_M
    assert abs(error[2]) < NEAR_RAD


def test_too_little_common_floor_is_nothing():
    cam = camera(33.0)
    a = photo(cam, Se2(0.0, 0.0, 0.2), frame=FrameId("A", 30))
    far = photo(cam, Se2(3.0, 2.0, 0.4), frame=FrameId("B", 30))
    assert aligned((a, far)) is None
    beside = photo(cam, Se2(-0.1, -0.95, 0.2), frame=FrameId("B", 30))
    few = aligned((a, beside), options=dataclasses.replace(OPTIONS, min_points=1))
    assert few is None or few.num_points < OPTIONS.min_points
    assert aligned((a, beside)) is None


def test_views_of_very_different_resolution_share_no_points():
    """Seen from beside, near floor becomes far floor; straight down nothing changes its size."""

    def num_points(name, most):
        options = dataclasses.replace(OPTIONS, max_stretch=most)
        found = aligned(pair_of(CAMERAS[name]), options=options)
        return found.num_points if found else 0

    assert num_points("alike", 1.05) == 0
    assert 0.4 < num_points("alike", 1.3) / num_points("alike", 3.0) < 0.9
    assert num_points("nadir", 1.05) == num_points("nadir", 3.0)


def test_a_finer_and_a_coarser_view_are_left_out_alike():
    """From twice the height everything is half as large, whichever of the two is a."""
    low, high = (
        photo(camera(0.0, h), Se2(0.0, 0.0, 0.2), frame=FrameId(name, 30), grain_m=0.55)
        for h, name in ((0.4, "A"), (0.8, "B"))
    )
    strict = dataclasses.replace(OPTIONS, max_stretch=1.7)
    for pair in ((low, high), (high, low)):
        assert aligned(pair, options=strict) is None
        assert aligned(pair).num_points > OPTIONS.min_points


def test_points_are_the_steepest_of_their_cells():
    frame = pair_of(CAMERAS["alike"])[0]
    grey = prepared(frame)
    blurred = photometric._pictured(grey, 1.5).picture
    attitude = np.tile(photometric._vector(frame.attitude), 2)
    all_points = photometric._steepest(grey, 1.5, OPTIONS.cell_px)
    found = photometric._shared(all_points, grey, grey, IDENTITY, attitude, OPTIONS)
    points = found.points_px.astype(int)
    np.testing.assert_array_equal(found.grey, blurred[points[:, 1], points[:, 0]])
    back_px = frame.view.camera.intrinsics.px_from_rays(found.rays)
    np.testing.assert_allclose(back_px, found.points_px, atol=1e-6)
    by_v, by_u = np.gradient(blurred)
    steep = np.hypot(by_u, by_v)
    assert len(points) > 800
    cells = points // OPTIONS.cell_px
    assert len(set(map(tuple, cells))) == len(points)
    rank = []
    for (u, v), (column, row) in zip(points, cells * OPTIONS.cell_px, strict=True):
        cell = steep[row : row + OPTIONS.cell_px, column : column + OPTIONS.cell_px]
        rank.append((cell > steep[v, u]).sum())
    # Of 81 pixels; another kernel for the slope may prefer a neighbour.
    assert np.mean(rank) < 2.0


def test_pictures_that_do_not_fit_say_so():
    """A wrong start far off: the residual is that of any two pictures."""
    limit = OPTIONS.max_residual
    for number in (30, 31, 32):
        pair = pair_of(CAMERAS["alike"], number)
        lost = aligned(pair, Se2(0.06, -0.05, 0.2))
        assert lost.residual > limit
        assert aligned(pair).residual < 0.2 * limit


def test_blank_pictures_do_not_fit_either():
    pair = pair_of(CAMERAS["alike"])
    blank = np.full_like(pair[0].image, 128)
    for images in ((blank, blank), (None, blank), (blank, None)):
        found = aligned(pair, images=images)
        assert found is None or found.residual > OPTIONS.max_residual


def test_a_lone_motion_start_is_refined_by_relative_pose():
    """Matches with noise of a pixel and a half, then light: the motion is light's, and good."""
    pair = pair_of(CAMERAS["alike"])
    truth = true_foot_motion(*pair)
    rng = np.random.default_rng(2)
    priors = tuple(view_of(frame).prior for frame in pair)
    exact = geometric_pair(
        rng,
        truth,
        tuple(dataclasses.replace(p, mean=f.attitude) for p, f in zip(priors, pair, strict=True)),
        wobbling=False,
        noise=5.0,
        count=60,
    )
    points = dataclasses.replace(
        exact.points, sigma_a=5.0 * exact.points.sigma_a, sigma_b=5.0 * exact.points.sigma_b
    )
    found = Matches(points, truth, 0.1)
    plain = relative_pose(*map(view_of, pair), found, MotionOptions())
    views = [view_of(frame, prepared(frame)) for frame in pair]
    lit = relative_pose(*views, found, MotionOptions())
    assert isinstance(plain, RelativePose)
    assert isinstance(lit, RelativePose)
    assert np.linalg.det(lit.covariance) < 0.1 * np.linalg.det(plain.covariance)
    error = error_of(lit.a_from_b, true_motion(*pair))
    assert np.hypot(*error[:2]) < NEAR_M
    assert abs(error[2]) < NEAR_RAD
    # The matches stay for the bundle.
    assert len(lit.correspondences) == len(plain.correspondences)


def test_used_rows_alone_are_used():
    cam = camera(33.0, rows=(0, 150))
    frame = photo(cam, Se2(0.0, 0.0, 0.2), frame=FrameId("A", 30))
    spoilt = frame.image.copy()
    spoilt[151:] = 255 - spoilt[151:]
    one, two = prepared(frame), prepared(frame, spoilt)
    np.testing.assert_array_equal(one.normalised, two.normalised)
    assert not one.normalised[151:].any()
    assert one.normalised[:151].astype(np.float32).std() == pytest.approx(1.0, abs=0.1)
    other = photo(camera(33.0), Se2(0.15, 0.05, 0.5), frame=FrameId("B", 30))
    found = aligned((frame, other), OFF[0])
    error = error_of(found.a_from_b, true_foot_motion(frame, other))
    assert nees(found.a_from_b, found.covariance, true_foot_motion(frame, other)) < 16.0
    assert np.hypot(*error[:2]) < 2 * NEAR_M


@pytest.mark.parametrize("cameras", CAMERAS.values(), ids=CAMERAS)
def test_the_jacobian_is_the_slope_of_the_residual(cameras):
    """All eleven columns against finite differences, on pictures that are smooth."""
    pair = pair_of(cameras, light=PLAIN)
    greys = [prepared(frame) for frame in pair]
    pose = true_foot_motion(*pair)
    attitude = np.concatenate([photometric._vector(frame.attitude) for frame in pair])
    all_points = photometric._steepest(greys[0], 6.0, OPTIONS.cell_px)
    points = photometric._shared(all_points, *greys, pose, attitude, OPTIONS)
    pictured = photometric._pictured(greys[1], 6.0)
    rays_b = photometric._rows(points.rays, pose, attitude)[:, :, 11]
    lens = photometric._lens(pair[1].view.camera.intrinsics, rays_b)

    def linearised(change):
        return photometric._linearised(
            points,
            pictured,
            lens,
            pose @ Se2(*change[:3]),
            attitude + change[3:9],
            np.array([1.0, 0.0]) + change[9:],
        )

    jacobian = linearised(np.zeros(11))[1]
    # A pixel or two: slopes are those of whole pixels.
    step = np.array([4e-3] * 9 + [0.01, 0.01])
    for k in range(11):
        change = step[k] * np.eye(11)[k]
        numeric = (linearised(change)[0] - linearised(-change)[0]) / (2 * step[k])
        scale = np.sqrt(np.mean(jacobian[:, k] ** 2))
        # Slopes come from a 3 x 3 kernel on a picture of 6 px blur, differences from 3 px and more;
        # worst seen 2.4 %.
        assert np.sqrt(np.mean((numeric - jacobian[:, k]) ** 2)) < 0.06 * scale, k


def test_a_lens_is_linear_over_a_pixel_or_two():
    lens = CAMERAS["bent"][1].intrinsics
    rng = np.random.default_rng(3)
    px = rng.uniform(0.0, 1.0, (200, 2)) * (lens.width_px, lens.height_px)
    rays, moved = (lens.rays_from_px(at) for at in (px, px + rng.uniform(-1.5, 1.5, px.shape)))
    near = photometric._lens(lens, rays)
    linear = near.places_px + np.einsum("nij,nj->ni", near.by_ray, moved - rays)
    # Worst seen 0.0043 px; the fine pass moves by less than that.
    np.testing.assert_allclose(linear, lens.px_from_rays(moved), atol=0.01)


def test_a_sum_of_normal_equations_is_that_of_matrices():
    """Weights of Cauchy's kernel, on top of what is known beforehand."""
    rng = np.random.default_rng(5)
    error, jacobian = rng.standard_normal(40), rng.standard_normal((40, 11))
    hessian, gradient = np.diag(np.arange(11.0)), np.arange(11.0)
    weight = 1.0 / (1.0 + (error / (2.0 * 0.7)) ** 2) / 0.7**2
    wanted = hessian + (jacobian.T * weight) @ jacobian, gradient + jacobian.T @ (weight * error)
    weigh(error, jacobian, 0.7, 2.0, (hessian, gradient))
    np.testing.assert_allclose(hessian, wanted[0], atol=1e-12)
    np.testing.assert_allclose(gradient, wanted[1], atol=1e-12)


def test_points_that_are_not_seen_say_nothing():
    picture = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    slopes = Slopes(picture, np.ones_like(picture), 4.0 * np.ones_like(picture))
    places = np.array([[0.875, -0.125], [np.nan, 1.0], [9.0, -3.0]])
    lens = Lens(np.zeros((3, 2)), places, np.tile([[1.0, 0.5], [0.25, 2.0]], (3, 1, 1)))
    rows, error, jacobian = np.zeros((3, 2, 12)), np.empty(3), np.full((3, 11), 7.0)
    rows[0, :, 11] = 0.5, 0.25  # of the lens, 0.625 px right and down
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    linearise(slopes, lens, rows, np.array([3.0, 1.0, 2.0]), np.array([1.0, 0.5]), error, jacobian)
    # Between pixels bilinear, outside as the border is: 3.5 and 3 are read.
    np.testing.assert_allclose(error, [3.5 - 3.0 - 0.5, 0.0, 3.0 - 2.0 - 0.5])
    np.testing.assert_allclose(jacobian[0], [2.0, 8.5, *[0.0] * 7, -3.0, -1.0])
    assert not jacobian[1].any()


def test_the_priors_hold_what_the_pictures_do_not_show():
    """Both heights and the motion may grow together: only the prior says how high."""
    pair = pair_of(CAMERAS["alike"])
    free = [dataclasses.replace(view_of(f).prior, sigma=Attitude(0.05, 0.05, 0.05)) for f in pair]
    greys = [prepared(f) for f in pair]
    truth, known = true_foot_motion(*pair), tuple(f.attitude for f in pair)
    tight = align(*greys, truth, *(view_of(f).prior for f in pair), known, OPTIONS)
    loose = align(*greys, truth, *free, known, OPTIONS)
    assert loose.covariance[0, 0] > 4.0 * tight.covariance[0, 0]
    assert prior().sigma.height_m < 0.05


def test_stretches_are_singular_values():
    """Of a few mirrored, singular and unknown ones too."""
    matrices = np.random.default_rng(4).standard_normal((50, 2, 2))
    matrices[0], matrices[1], matrices[2, 1] = 0.0, [[1.0, 2.0], [2.0, 4.0]], [0.0, 0.0]
    found = np.stack(photometric._stretches(matrices), axis=1)
    np.testing.assert_allclose(found, np.linalg.svd(matrices, compute_uv=False), atol=1e-14)
    assert np.isnan(photometric._stretches(np.full((1, 2, 2), np.nan))).all()
