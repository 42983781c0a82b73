"""The default matcher on photographs: right matches, honest refusals, rivals seen."""

import dataclasses
import math

import numpy as np
import pytest
from floor_pairs import (
    camera,
    error_of,
    features_of,
    photo,
    true_foot_motion,
    true_motion,
    view_of,
)
from scipy import stats

from groundfuse.backend.measurement import Attitude, FrameId, Reason, RelativePose, Se2
from groundfuse.frontend.consensus import Gate, Mode
from groundfuse.frontend.features import FeatureOptions
from groundfuse.frontend.matches import Matches, Miss
from groundfuse.frontend.motion import MotionOptions, relative_pose
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.sift_matcher import (
    MatchOptions,
    candidates,
    found_by_homography,
    match,
)

BARREL = (-0.2, 0.05, 1e-3, -8e-4, 0.0)
NAMES = [FrameId("A", 0), FrameId("B", 0)]


def shot(cam, pose, name, floor="speckle"):
    return photo(cam, pose, floor, NAMES[name])


PLAIN = shot(camera(33.0), Se2(0.0, 0.0, 0.2), 0), shot(camera(33.0), Se2(0.2, 0.03, 0.4), 1)
ON_TILES = (
    shot(camera(33.0), Se2(0.0, 0.0, 0.2), 0, "tiles"),
    shot(camera(33.0), Se2(0.2, 0.03, 0.25), 1, "tiles"),
)


def matched(pair, options=None, gate=None, kind="sift", seed=0):
    a, b = (features_of(frame, FeatureOptions(kind=kind)) for frame in pair)
    return match(a, b, options or MatchOptions(), np.random.default_rng(seed), gate)


def misfit_px(found, pair):
    """How far the matches (n,) are from the truth, pixels of b."""
    a, b = (frame.view.attitude for frame in pair)
    floor = floor_from_rays(a, found.correspondences.rays_a)
    rays = rays_from_floor(b, true_foot_motion(*pair).inverse().apply(floor))
    apart = np.hypot(*(rays - found.correspondences.rays_b).T)
    return apart * pair[1].view.camera.intrinsics.focal_px


@pytest.mark.parametrize("kind", ["sift", "orb"])
@pytest.mark.parametrize("turn_rad", [0.4, math.pi])
def test_matches_are_right(kind, turn_rad):
    """The other view may come from the far side."""
    a = shot(camera(33.0), Se2(0.0, 0.0, 0.0), 0)
    b = shot(camera(33.0), Se2(0.2 if turn_rad < 1 else 0.8, 0.02, turn_rad), 1)
    found = matched((a, b), kind=kind)
    assert isinstance(found, Matches)
    assert found.ambiguity < 0.3
    assert len(found.correspondences) > 60
    off = misfit_px(found, (a, b))
    # SIFT is good to 0.3 px, ORB to a pixel of its pyramid.
    assert np.median(off) < (0.5 if kind == "sift" else 1.2)
    assert np.mean(off < 4.0) > 0.9
    # The start is as good as an isometry can be under 0.5 deg of wobble: a few per cent of h.
    error = error_of(found.a_from_b, true_foot_motion(a, b))
    assert np.hypot(*error[:2]) < 0.03
    assert abs(error[2]) < 0.05


CAMERA_PAIRS = {
    "tilts": (camera(20.0), camera(45.0)),
    "lenses": (camera(33.0, coefficients=BARREL), camera(33.0, focal_px=200.0)),
    "heights": (camera(33.0, 0.45), camera(33.0, 0.65)),
    "rolls": (camera(33.0, roll_deg=3.0), camera(33.0, roll_deg=-3.0)),
    "mounts": (
        camera(33.0, base_from_foot=Se2(0.1, 0.02, 0.3)),
        camera(33.0, base_from_foot=Se2(-0.2, 0.05, -1.0)),
    ),
}


@pytest.mark.parametrize("cameras", CAMERA_PAIRS.values(), ids=CAMERA_PAIRS)
def test_robots_may_differ_in_everything(cameras):
    """Two robots whose views overlap: the measured motion of the bases is the true one."""
    first, second = cameras
    foot_b = Se2(0.15, -0.05, 0.5)
    pair = (
        photo(first, first.mount.base_from_foot.inverse(), frame=NAMES[0], grain_m=0.55),
        photo(second, foot_b @ second.mount.base_from_foot.inverse(), frame=NAMES[1], grain_m=0.55),
    )
    found = relative_pose(*map(view_of, pair), matched(pair), MotionOptions())
    assert isinstance(found, RelativePose)
    error = error_of(found.a_from_b, true_motion(*pair))
    assert np.hypot(*error[:2]) < 0.01
    assert abs(error[2]) < 0.01
    assert error @ np.linalg.solve(found.covariance, error) < stats.chi2.ppf(0.9999, 3)


def test_a_drone_that_sways_needs_the_wider_model():
    """8 deg and 10 % of wobble at 70 m: a similarity, a homography, then the same fit."""
    sway = Attitude(math.radians(8.0), math.radians(8.0), 7.0)
    cam = camera(0.0, 70.0, sigma=sway)
    stiff = MatchOptions(rigid_tolerance_heights=10.0)
    scores, right, stiff_right = [], 0, 0
    for k in (10, 11, 13):
        pair = (
            photo(cam, Se2(0.0, 0.0, 0.1), frame=FrameId("A", k)),
            photo(cam, Se2(20.0, 5.0, 0.9), frame=FrameId("B", k)),
        )
        found = matched(pair)
        assert isinstance(found, Matches)
        assert found.ambiguity < 0.3
        good = misfit_px(found, pair) < 2.0
        assert good.mean() > 0.97
        right += good.sum()
        result = relative_pose(*map(view_of, pair), found, MotionOptions())
        assert isinstance(result, RelativePose), result
        error = error_of(result.a_from_b, true_motion(*pair))
        scores.append(float(error @ np.linalg.solve(result.covariance, error)))
        # The heights are known to 10 % and no better; the heading is not touched by that.
        assert np.hypot(*error[:2]) < 0.1 * 20.6
        assert abs(error[2]) < math.radians(0.5)
        held = matched(pair, stiff)
        if isinstance(held, Matches):
            stiff_right += (misfit_px(held, pair) < 2.0).sum()
    assert sum(scores) < stats.chi2.ppf(0.999, 9)
    assert right > 1.5 * stiff_right  # seen 289 and 124


def test_views_without_common_floor_do_not_match():
    a, _ = PLAIN
    far = shot(camera(33.0), Se2(3.0, 2.0, 0.4), 1)
    found = matched((a, far))
    assert isinstance(found, Miss)
    assert found.reason is Reason.FEW_INLIERS
    assert 0.0 <= found.value < found.limit == MatchOptions().min_votes


@pytest.mark.parametrize("grey", [0, 120])
def test_a_blank_picture_has_too_few_features(grey):
    a, b = PLAIN
    blank = dataclasses.replace(b, image=np.full_like(b.image, grey))
    for pair in ((a, blank), (blank, a), (blank, blank)):
        found = matched(pair)
        assert found == Miss(Reason.FEW_FEATURES, 0.0, MatchOptions().min_features)


def test_identical_tiles_show_a_rival():
    found = matched(ON_TILES)
    assert isinstance(found, Matches)
    assert found.ambiguity > MotionOptions().max_ambiguity


def test_a_gate_below_half_the_period_makes_tiles_unique():
    """Tiles repeat after 150 mm; odometry knows the motion to 50 mm."""
    truth = true_foot_motion(*ON_TILES)
    for off in (Se2(0.03, -0.02, 0.02), Se2(-0.03, 0.03, -0.02)):
        found = matched(ON_TILES, gate=Gate(truth @ off, 0.05, 0.1))
        assert isinstance(found, Matches)
        assert found.ambiguity < 0.6
        result = relative_pose(*map(view_of, ON_TILES), found, MotionOptions())
        assert isinstance(result, RelativePose)
        error = error_of(result.a_from_b, true_motion(*ON_TILES))
        assert np.hypot(*error[:2]) < 0.005


def test_matches_carry_each_features_own_ray_and_sigma():
    found = matched(PLAIN).correspondences
    sides = (found.rays_a, found.sigma_a), (found.rays_b, found.sigma_b)
    for frame, (rays, sigma) in zip(PLAIN, sides, strict=True):
        features = features_of(frame, FeatureOptions())
        known = {tuple(r): s for r, s in zip(features.rays, features.sigma, strict=True)}
        assert [known[tuple(r)] for r in rays] == list(sigma)


def test_the_same_seed_gives_the_same_matches():
    one, two = matched(PLAIN, seed=5), matched(PLAIN, seed=5)
    np.testing.assert_array_equal(one.correspondences.rays_a, two.correspondences.rays_a)
    assert one.a_from_b == two.a_from_b
    other = matched(PLAIN, seed=6)
    assert len(other.correspondences) == pytest.approx(len(one.correspondences), rel=0.1)


def test_swapping_the_views_swaps_the_matches():
    there, back = matched(PLAIN), matched(PLAIN[::-1])
    error = error_of(there.a_from_b, back.a_from_b.inverse())
    assert np.hypot(*error[:2]) < 0.005
    assert abs(error[2]) < 0.01
    rays = {tuple(r) for r in there.correspondences.rays_a}
    again = {tuple(r) for r in back.correspondences.rays_b}
    assert len(rays & again) > 0.8 * len(rays)


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_candidates_are_the_nearest_descriptors_of_like_size(kind):
    """Against a plain loop."""
    options = MatchOptions(num_neighbours=3)
    a, b = (features_of(frame, FeatureOptions(kind=kind)) for frame in PLAIN)
    found = candidates(a, b, options)
    assert (np.diff(found.index_a) >= 0).all()
    for i in range(0, len(a), 37):
        if kind == "orb":
            apart = np.unpackbits(a.descriptors[i] ^ b.descriptors, axis=1).sum(axis=1)
        else:
            apart = np.linalg.norm(b.descriptors - a.descriptors[i], axis=1)
        mine = found.index_a == i
        third = np.sort(apart)[2]
        assert (apart[found.index_b[mine]] <= third + 1e-3).all()
        assert set(found.rank[mine]) <= {0, 1, 2}
        assert len(set(found.rank[mine])) == mine.sum()
        order = apart[found.index_b[mine]]
        assert (np.diff(order[np.argsort(found.rank[mine])]) >= -1e-3).all()
        alike = np.abs(a.log_size[i] - b.log_size) < options.max_log_size
        assert alike[found.index_b[mine]].all()
        wanted = (apart < third - 1e-3) & alike
        assert set(np.flatnonzero(wanted)) <= set(found.index_b[mine])
        np.testing.assert_allclose(
            found.turn_rad[mine], a.angle_rad[i] - b.angle_rad[found.index_b[mine]]
        )
        np.testing.assert_array_equal(found.floor_b[mine], b.floor_m[found.index_b[mine]])
        np.testing.assert_array_equal(found.floor_a[mine], np.tile(a.floor_m[i], (mine.sum(), 1)))


def test_fewer_features_than_neighbours_are_all_candidates():
    a, b = (features_of(frame) for frame in PLAIN)
    few = dataclasses.replace(
        b,
        **{
            name: getattr(b, name)[:3]
            for name in ("floor_m", "rays", "sigma", "log_size", "angle_rad", "descriptors")
        },
    )
    found = candidates(a, few, MatchOptions(max_log_size=100.0))
    assert len(found.index_a) == 3 * len(a)


def test_the_homography_drops_what_no_plane_explains():
    """Voters of which a quarter are pushed off by a few overhead pixels."""
    a, b = (features_of(frame) for frame in PLAIN)
    options = MatchOptions()
    found = candidates(a, b, options)
    rng = np.random.default_rng(3)
    truth = true_foot_motion(*PLAIN)
    # Exact rays of b for the first candidate of 80 features of a.
    first = np.unique(found.index_a, return_index=True)[1][:80]
    floor = truth.inverse().apply(floor_from_rays(PLAIN[0].attitude, a.rays))
    rays_b = rays_from_floor(PLAIN[1].attitude, floor)
    index_b = np.arange(len(a))
    exact = dataclasses.replace(b, rays=rays_b)
    pushed = first[60:]
    exact.rays[found.index_a[pushed]] += rng.choice([-1, 1], (20, 2)) * 12.0 / 257.0
    linked = found._replace(index_b=index_b[found.index_a])
    voters = np.zeros(len(found.index_a), dtype=bool)
    voters[first] = True
    kept = found_by_homography(a, exact, linked, Mode(truth, 1.0, voters, 80), options)
    assert kept.votes == kept.voters.sum() == 60
    assert kept.voters[first[:60]].all()
    few = np.zeros_like(voters)
    few[first[:5]] = True
    assert found_by_homography(a, exact, linked, Mode(truth, 1.0, few, 5), options).votes == 0
