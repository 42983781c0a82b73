"""The paper's matcher, whole: pictures in, correspondences and a start for the motion out."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from flat_world import SIDE_PX, painted_floor, photograph

from groundfuse.backend.measurement import IDENTITY, Attitude, Reason, Se2
from groundfuse.frontend import paper_matcher
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.decomposition import floor_homography
from groundfuse.frontend.matches import Matches, Miss
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.overhead_view import OverheadOptions
from groundfuse.frontend.paper_matcher import PaperOptions, ambiguity, detect, match
from groundfuse.frontend.refine import Guided, transferred
from groundfuse.frontend.segments import voted

SIGMA = Attitude(math.radians(0.5), math.radians(0.15), 0.002)
DISTORTED = (-0.12, 0.03, 5e-4, -5e-4, 0.0)
# The bar of the project for this matcher; the motion fit does the rest. Worst of the cases 13 mm.
START_M, START_RAD = 0.030, math.radians(3.0)


def camera_of(tilt_deg, focal_px=420.0, height_m=0.55, coefficients=()):
    lens = Intrinsics(
        480, 360, focal_px, focal_px, 238.0, 181.0, Distortion.PLUMB_BOB, coefficients
    )
    return Camera(lens, Mount(Attitude(math.radians(tilt_deg), 0.0, height_m), SIGMA))


CAMERA_A, CAMERA_B = camera_of(33, 420.0, 0.55, DISTORTED), camera_of(45, 450.0)
FLOOR = painted_floor(100)


def seen(camera, world_from_foot, wobble=(0.0, 0.0, 0.0), floor=FLOOR, **light):
    nominal = camera.mount.attitude
    truth = Attitude(
        nominal.tilt_rad + wobble[0], nominal.roll_rad + wobble[1], nominal.height_m + wobble[2]
    )
    image = photograph(floor, camera, truth, world_from_foot, **light)
    return detect(image, camera, nominal)


def check_start(got, truth):
    assert isinstance(got, Matches), got
    error = truth.inverse() @ got.a_from_b
    assert math.hypot(error.x_m, error.y_m) < START_M
    assert abs(error.theta_rad) < START_RAD


WOBBLE_A, WOBBLE_B = (0.009, -0.002, 0.002), (-0.008, 0.003, -0.002)
MOTIONS = {
    "straight on": (CAMERA_A, Se2(0.2, 0.0, 0.0), CAMERA_A),
    "a curve": (CAMERA_A, Se2(0.2, 0.05, 0.4), CAMERA_A),
    "turning in place": (CAMERA_A, Se2(0.0, 0.0, 0.6), CAMERA_A),
    "another robot": (CAMERA_A, Se2(0.15, -0.1, 0.8), CAMERA_B),
    "another robot from ahead": (CAMERA_B, Se2(1.0, 0.1, math.pi), CAMERA_A),
    "nadir": (camera_of(0), Se2(0.15, 0.1, -0.3), camera_of(0)),
}


@pytest.mark.parametrize("case", MOTIONS)
def test_the_motion_and_the_matches_are_right(case):
    camera_a, motion, camera_b = MOTIONS[case]
    pose = Se2(0.1, -0.2, 0.7)
    a = seen(camera_a, pose, WOBBLE_A, noise=1.5)
    b = seen(camera_b, pose @ motion, WOBBLE_B, gain=(0.9, 1.1, 1.0), noise=1.5)
    got = match(a, b, rng=np.random.default_rng(0))
    check_start(got, motion)
    nominal_a, nominal_b = camera_a.mount.attitude, camera_b.mount.attitude
    true_a = Attitude(*np.add((nominal_a.tilt_rad, 0.0, nominal_a.height_m), WOBBLE_A))
    true_b = Attitude(*np.add((nominal_b.tilt_rad, 0.0, nominal_b.height_m), WOBBLE_B))
    points = got.correspondences
    expected = transferred(floor_homography(true_a, motion, true_b), points.rays_a)
    off_px = np.linalg.norm(expected - points.rays_b, axis=1) * camera_b.intrinsics.focal_px
    assert len(points) >= 40
    assert (off_px < 3.0).mean() > 0.9
    # The stated noise of both ends explains what is seen, within a factor of three.
    sigma_px = np.hypot(points.sigma_a, points.sigma_b) * camera_b.intrinsics.focal_px
    assert 1 / 3 < np.median(off_px / sigma_px) / 1.18 < 3.0
    assert got.ambiguity < 0.5


def test_no_motion_at_all():
    a = seen(CAMERA_A, IDENTITY)
    got = match(a, a, rng=np.random.default_rng(0))
    assert len(got.correspondences) == len(a)
    error = got.a_from_b.vector()
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


def test_heights_only_set_the_scale():
    def at(height_m):
        camera = camera_of(33, height_m=height_m)
        motion = Se2(0.2, 0.05, 0.4)
        a, b = (
            photograph(FLOOR, camera_of(33), camera_of(33).mount.attitude, pose)
            for pose in (IDENTITY, motion)
        )
        attitude = camera.mount.attitude
        return match(detect(a, camera, attitude), detect(b, camera, attitude))

    low, high = at(0.55), at(70.0)
    assert len(low.correspondences) == pytest.approx(len(high.correspondences), abs=5)
    scaled = high.a_from_b.vector() * (0.55 / 70.0, 0.55 / 70.0, 1.0)
    np.testing.assert_allclose(scaled, low.a_from_b.vector(), atol=1e-3)


def test_views_without_common_floor_are_a_miss():
    a, b = seen(CAMERA_A, IDENTITY), seen(CAMERA_B, IDENTITY, floor=painted_floor(101))
    got = match(a, b, rng=np.random.default_rng(0))
    assert isinstance(got, Miss)
    assert got.reason in {Reason.FEW_CANDIDATES, Reason.FEW_INLIERS}
    assert got.value < got.limit


def test_too_few_corners_that_agree_are_a_miss():
    a, b = seen(CAMERA_A, IDENTITY), seen(CAMERA_B, IDENTITY, floor=painted_floor(101))
    got = match(a, b, replace(PaperOptions(), min_segments=1), np.random.default_rng(0))
    assert isinstance(got, Miss)
    assert (got.reason, got.limit) == (
        Reason.FEW_INLIERS,
        max(24.0, math.ceil(0.08 * min(len(a), len(b)))),
    )
    assert got.value < got.limit


def test_the_motion_with_most_corners_wins_whatever_its_segments(monkeypatch):
    motion = Se2(0.1, 0.05, 0.4)
    a, b = seen(CAMERA_A, IDENTITY), seen(CAMERA_B, motion)

    def worst_first(*args):
        return [vote._replace(num_segments=9) for vote in voted(*args)[::-1]]

    monkeypatch.setattr(paper_matcher, "voted", worst_first)
    check_start(match(a, b, rng=np.random.default_rng(0)), motion)


def test_an_even_floor_is_a_miss():
    even = np.full((SIDE_PX, SIDE_PX, 3), 90.0, np.float32)
    a, b = seen(CAMERA_A, IDENTITY), seen(CAMERA_A, IDENTITY, floor=even)
    assert match(a, b) == Miss(Reason.FEW_FEATURES, 0.0, 20.0)


def test_no_equal_segments_are_a_miss():
    a = seen(CAMERA_A, IDENTITY)
    options = PaperOptions()
    strict = replace(options, segments=replace(options.segments, min_correlation=1.1))
    assert match(a, a, strict) == Miss(Reason.FEW_CANDIDATES, 0.0, 3.0)


def test_tiles_are_ambiguous():
    tile = painted_floor(102)[:60, :60]
    tiles = np.tile(tile, (SIDE_PX // 60, SIDE_PX // 60, 1))
    a, b = (seen(CAMERA_A, pose, floor=tiles) for pose in (IDENTITY, Se2(0.1, 0.03, 0.2)))
    got = match(a, b, rng=np.random.default_rng(0))
    assert isinstance(got, Matches)
    assert got.ambiguity > 0.7


def test_the_same_seed_gives_the_same_answer():
    a, b = seen(CAMERA_A, IDENTITY), seen(CAMERA_B, Se2(0.1, 0.05, 0.4))
    first, second = (match(a, b, rng=np.random.default_rng(3)) for _ in range(2))
    assert first.a_from_b == second.a_from_b
    np.testing.assert_array_equal(first.correspondences.rays_b, second.correspondences.rays_b)


def test_features_survive_pickling_and_describe_the_floor():
    a = seen(CAMERA_A, IDENTITY)
    copy = pickle.loads(pickle.dumps(a))  # noqa: S301
    assert len(copy) == len(a)
    np.testing.assert_array_equal(copy.invariants, a.invariants)
    assert ((a.invariants >= 0.0) & (a.invariants <= 1.0)).all()
    attitude = CAMERA_A.mount.attitude
    np.testing.assert_allclose(floor_from_rays(attitude, a.rays), a.floor_m, atol=1e-12)
    np.testing.assert_allclose(rays_from_floor(attitude, a.floor_m), a.rays, atol=1e-12)


def test_grey_pictures_work():
    motion = Se2(0.15, 0.0, 0.2)
    grey = [
        photograph(FLOOR, CAMERA_A, CAMERA_A.mount.attitude, pose)[:, :, 1].copy()
        for pose in (IDENTITY, motion)
    ]
    a, b = (detect(image, CAMERA_A, CAMERA_A.mount.attitude) for image in grey)
    check_start(match(a, b, rng=np.random.default_rng(0)), motion)


def test_views_of_different_cells_are_refused_and_a_common_cell_helps():
    high = camera_of(33, 700.0, 0.85)
    motion = Se2(0.1, 0.05, 0.3)
    pictures = [
        (photograph(FLOOR, camera, camera.mount.attitude, pose), camera)
        for camera, pose in ((CAMERA_A, IDENTITY), (high, motion))
    ]
    a, b = (detect(image, camera, camera.mount.attitude) for image, camera in pictures)
    with pytest.raises(ValueError, match=r"cells of 0\.00198 m and 0\.00306 m: detect both with"):
        match(a, b)
    options = PaperOptions(overhead=OverheadOptions(m_per_px=0.002))
    a, b = (detect(image, camera, camera.mount.attitude, options) for image, camera in pictures)
    check_start(match(a, b, options, np.random.default_rng(0)), motion)


def guided(homography, index_a, index_b):
    return Guided(homography, np.array(index_a), np.array(index_b))


def test_rivals_count_by_their_share_of_what_is_in_common():
    line = np.stack([np.linspace(-0.5, 0.5, 101), np.zeros(101)], axis=1)
    rays = line, line
    best = guided(np.eye(3), range(80), range(80))
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # 59 in common
    rival = guided(half, range(20), range(50, 70))
    assert ambiguity([best, rival], rays) == pytest.approx((20 / 59) / (80 / 101))
    assert ambiguity([best], rays) == 0.0
    same = guided(np.eye(3), range(70), range(70))
    assert ambiguity([best, same], rays) == 0.0
    away = np.array([[1.0, 0.0, 0.9], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # 19 in common
    assert ambiguity([best, guided(away, range(15), range(80, 95))], rays) == 0.0
    full = guided(half, range(50), range(50, 100))
    assert ambiguity([best, full], rays) == 1.0
