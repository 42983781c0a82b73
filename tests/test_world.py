"""The team world: what it says of poses, attitudes and overlaps is what the pictures show."""

import itertools
import math
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend.measurement import IDENTITY, Attitude, FrameId, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.tools.floors import FLOORS, TILE, make_floor
from groundfuse.tools.noise import Rect, smooth, uniform, white
from groundfuse.tools.overlap import RANGE_PER_HEIGHT, View, counted_floor, in_view, true_overlap
from groundfuse.tools.photometry import PLAIN, Photometry, photograph
from groundfuse.tools.render import World
from groundfuse.tools.trajectories import count_places, loop, meetings, plan_team
from groundfuse.tools.view_pairs import PairOptions, draw_views, render_pair
from groundfuse.tools.world import RobotSpec, make_team, set_scene, wobbled

SIGMA = Attitude(math.radians(0.5), math.radians(0.15), 0.002)
LENS = Intrinsics(160, 120, 131.0, 131.0, 79.5, 59.5)
BARREL = Intrinsics(
    200, 150, 164.0, 163.0, 97.0, 76.0, Distortion.PLUMB_BOB, (-0.15, 0.04, 1e-3, -1e-3)
)


def camera(tilt_deg=33.0, height_m=0.55, lens=LENS, place=IDENTITY, roll_deg=0.0, rows=(0, -1)):
    attitude = Attitude(math.radians(tilt_deg), math.radians(roll_deg), height_m)
    sigma = Attitude(SIGMA.tilt_rad, SIGMA.roll_rad, SIGMA.height_m * height_m / 0.55)
    return Camera(lens, Mount(attitude, sigma, place), *rows)


def view(cam, pose=IDENTITY):
    return View(cam, cam.mount.attitude, pose)


# --- noise and floors


def test_fields_have_mean_0_and_deviation_1_and_depend_on_the_key():
    rect = Rect(-700, 300, 800, 800)
    for field in (white((1,), rect), smooth((1,), rect, 2, 2), smooth((1,), rect, 3, 9)):
        # 2.4e4 independent nodes or more, whose mean counts 315/151 times in a smooth field:
        # deviations of 0.014 and below 0.006; five times that
        assert abs(field.mean()) < 0.07
        assert abs(field.std() - 1.0) < 0.03
    other = white((2,), rect)
    assert abs((white((1,), rect) * other).mean()) < 0.01


def test_random_numbers_are_uniform_and_the_same_on_every_machine():
    numbers = uniform((5, 6), np.arange(-50_000, 50_000))
    share = np.histogram(numbers, bins=10, range=(0, 1))[0] / len(numbers)
    np.testing.assert_allclose(share, 0.1, atol=0.005)  # 5 deviations of 0.00095
    # SplitMix64's published first outputs for the seed 1234567 check the mixing itself.
    state = np.array([1234567], dtype=np.uint64) + np.array([0x9E3779B97F4A7C15], dtype=np.uint64)
    from groundfuse.tools.noise import _mixed

    assert int(_mixed(state)[0]) == 6457827717110365317


@given(
    st.sampled_from(["wood", "tiles", "varied_tiles"]),
    st.integers(-3000, 3000),
    st.integers(-3000, 3000),
    st.integers(1, 60),
)
@settings(max_examples=20, deadline=None)
def test_a_part_of_a_floor_is_the_same_made_alone(name, x0, y0, size):
    whole = FLOORS[name](3, Rect(x0, y0, 80, 70))
    part = FLOORS[name](3, Rect(x0 + 20, y0 + 10, size, size))
    both = whole[10 : 10 + size, 20 : 20 + size]
    # One more or less where a float32 sum ends near a half.
    np.testing.assert_allclose(part.astype(int), both, atol=1)


@pytest.mark.parametrize("name", ["terrazzo", "gravel", "grass", "concrete"])
def test_chunks_fit_their_neighbours(name):
    whole = FLOORS[name](3, Rect(-100, -40, 200, 100)).astype(int)
    halves = [FLOORS[name](3, Rect(x, -40, 100, 100)) for x in (-100, 0)]
    differs = np.abs(np.hstack(halves) - whole).max(axis=2)
    # Only the anti-aliased edges of stones may be cut differently at a border.
    assert (differs > 8).mean() < 0.02


@pytest.mark.parametrize("name", FLOORS)
def test_only_identical_tiles_repeat(name):
    first = FLOORS[name](1, Rect(5, 7, 150, 150)).astype(float)
    moved = FLOORS[name](1, Rect(5 + 3 * TILE, 7 - 2 * TILE, 150, 150)).astype(float)
    if name == "tiles":
        np.testing.assert_array_equal(first, moved)
        return
    assert np.abs(first - moved).mean() > 2.0
    a, b = (np.sort(p.reshape(-1)) for p in (first, moved))
    assert np.abs(a - b).mean() < 25.0  # the same material all the same


def test_floors_follow_from_their_seed():
    rect = Rect(0, 0, 40, 40)
    for texture in FLOORS.values():
        np.testing.assert_array_equal(texture(1, rect), texture(1, rect))
        assert (texture(1, rect) != texture(2, rect)).mean() > 0.2


def test_bare_concrete_has_low_contrast():
    deviations = {name: FLOORS[name](1, Rect(0, 0, 512, 512)).std() for name in FLOORS}
    assert 3.0 < deviations["concrete"] < 8.0
    assert min(v for k, v in deviations.items() if k != "concrete") > 15.0


def test_levels_of_a_floor_are_means_of_the_finer_ones():
    floor = make_floor("terrazzo", 1)
    fine = floor.patch(Rect(-40, 500, 64, 32), 0).astype(float)
    coarse = floor.patch(Rect(-10, 125, 16, 8), 2)
    means = fine.reshape(8, 4, 16, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(coarse, means, atol=1.01)  # each level is rounded


def test_an_unknown_floor_is_refused_with_the_nearest():
    with pytest.raises(ValueError, match=r"no floor is called 'terazzo' \(did you mean 'terrazzo'"):
        make_floor("terazzo", 1)
    with pytest.raises(ValueError, match="positive cell size, got -"):
        make_floor("tiles", 1, -1.0)


# --- overlaps


def test_overlap_of_nadir_views_is_that_of_rectangles():
    cam = camera(tilt_deg=0.0)
    long_m, wide_m = 0.55 * 120 / 131, 0.55 * 160 / 131  # the picture's rows lie along x
    for dx, dy in [(0.1, 0.0), (0.0, 0.2), (0.2, -0.3), (-0.3, 0.1)]:
        expected = (1 - abs(dx) / long_m) * (1 - abs(dy) / wide_m)
        found = true_overlap(view(cam), view(cam, Se2(dx, dy, 0.0)))
        # A grid of 0.02 heights cuts a border of length L to 0.003 L: 1 % of the area
        assert found == pytest.approx(expected, abs=0.02)
    assert true_overlap(view(cam), view(cam, Se2(long_m + 0.02, 0.0, 0.0))) == 0.0
    assert true_overlap(view(cam), view(cam, Se2(0.0, 0.0, math.pi))) == pytest.approx(1, abs=0.02)


poses = st.builds(Se2, st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1))


@given(poses, poses, st.sampled_from([LENS, BARREL]), st.floats(0.3, 0.9))
@settings(max_examples=30, deadline=None)
def test_overlap_is_symmetric_and_moves_with_the_world(pose_a, pose_b, lens, height_m):
    a, b = view(camera(), pose_a), view(camera(45.0, height_m, lens), pose_b)
    share = true_overlap(a, b)
    assert share == true_overlap(b, a)
    assert 0.0 <= share <= 1.0
    assert true_overlap(a, a) == 1.0
    moved = Se2(0.3, -2.0, 0.5)
    again = true_overlap(view(a.camera, moved @ pose_a), view(b.camera, moved @ pose_b))
    assert again == pytest.approx(share, abs=0.03)


def test_the_counted_floor_ends_at_the_range_and_at_the_used_rows():
    far = camera(70.0, place=Se2(0.3, 0.1, 0.4))
    foot = far.mount.base_from_foot
    reach = np.hypot(*(counted_floor(view(far)) - (foot.x_m, foot.y_m)).T)
    assert RANGE_PER_HEIGHT * 0.55 - 0.02 < reach.max() <= RANGE_PER_HEIGHT * 0.55
    upper, lower = camera(rows=(0, 59)), camera(rows=(60, 119))
    counts = [len(counted_floor(view(cam))) for cam in (camera(), upper, lower)]
    assert counts[0] == counts[1] + counts[2]
    assert true_overlap(view(upper), view(lower)) == 0.0
    assert true_overlap(view(camera()), view(lower)) == 1.0


def test_floor_behind_the_camera_or_folded_by_the_lens_is_not_seen():
    strong = Intrinsics(160, 120, 131.0, 131.0, 79.5, 59.5, Distortion.PLUMB_BOB, (-0.3, 0, 0, 0))
    seen = in_view(view(camera(45.0, lens=strong)), np.array([[-3.0, 0.0], [0.5, 0.0], [0.0, 1.2]]))
    assert seen.tolist() == [False, True, False]


# --- pictures


def test_a_plain_photograph_is_the_light():
    light = np.linspace(0, 255, 3 * 20 * 30).reshape(20, 30, 3).astype(np.float32)
    np.testing.assert_array_equal(
        photograph(light, PLAIN, np.random.default_rng(0)), np.rint(light)
    )


def test_vignetting_noise_and_exposure_are_as_asked():
    light = np.full((101, 201, 3), 128.0, dtype=np.float32)
    still = {"exposure_sigma": 0.0, "white_balance_sigma": 0.0}
    rng = np.random.default_rng(4)
    dim = photograph(light, Photometry(vignetting=0.25, noise=0.0, **still), rng).astype(float)
    assert dim[50, 100, 0] == 128
    np.testing.assert_allclose(dim[[0, 0, -1, -1], [0, -1, 0, -1]], 0.75 * 128, atol=2.0)
    noisy = photograph(light, Photometry(vignetting=0.0, noise=3.0, **still), rng).astype(float)
    assert noisy.std() == pytest.approx(3.0, rel=0.03)  # 6e4 numbers: 0.3 %, five times that
    only = Photometry(exposure_sigma=0.1, white_balance_sigma=0.05, vignetting=0.0, noise=0.0)
    means = np.array([photograph(light[:2, :2], only, rng)[0, 0] for _ in range(600)])
    logs = np.log(means / 128.0)
    assert logs.mean(axis=1).std() == pytest.approx(math.hypot(0.1, 0.05 / 3**0.5), rel=0.15)
    assert (logs[:, 0] - logs[:, 1]).std() == pytest.approx(0.05 * 2**0.5, rel=0.15)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [({"noise": -1.0}, "not be negative, got -1"), ({"vignetting": 1.0}, "below 1, got 1")],
)
def test_impossible_photometry_is_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        Photometry(**wrong)


# --- trajectories


@given(st.integers(2, 60), st.floats(0.05, 30.0), st.integers(0, 999), st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_a_loop_starts_at_the_origin_goes_in_even_steps_and_comes_back(views, step_m, seed, laps):
    poses = loop(views * laps, step_m, np.random.default_rng(seed), laps)
    assert poses[0] == IDENTITY
    places = np.array([[p.x_m, p.y_m] for p in poses])
    steps = np.hypot(*np.diff(places, axis=0).T)
    assert steps.max() <= step_m * 1.001  # a chord is no longer than its arc
    assert steps.min() >= step_m * 0.95
    if views >= 13:
        assert np.hypot(*places[-1]) <= step_m


def test_a_loop_needs_views_and_a_step():
    for views, step, laps in [(0, 0.1, 1), (3, 0.0, 1), (3, 0.1, 0), (3, math.nan, 1)]:
        with pytest.raises(ValueError, match=f"{views} views, {laps} laps, step {step:g} m"):
            loop(views, step, np.random.default_rng(0), laps)


def test_meeting_places_are_counted_around_the_loops():
    assert count_places([], (13, 13)) == 0
    assert count_places([(0, 0), (12, 12), (1, 0)], (13, 13)) == 1
    assert count_places([(0, 0), (2, 0), (4, 4), (5, 3)], (13, 13)) == 3
    assert count_places([(3, 0), (3, 12), (3, 2)], (13, 13)) == 2


def test_a_planned_team_meets_and_each_robot_sees_its_neighbours():
    cameras = [("A", camera()), ("B", camera(45.0)), ("C", camera(30.0, 0.7))]
    team = plan_team(cameras, 13, np.random.default_rng(11))
    views = [[view(robot.camera, pose) for pose in robot.world_from_base] for robot in team]
    for of_robot in views:
        shares = [true_overlap(*pair) for pair in itertools.pairwise(of_robot)]
        assert len(of_robot) == 13
        assert min(shares) > 0.2
        assert 0.35 < np.mean(shares) < 0.7
        assert true_overlap(of_robot[0], of_robot[-1]) > 0.4
    places = np.array(
        [[count_places(meetings(a, b), (13, 13)) for a in views[:k]] for k, b in enumerate(views)][
            2
        ]
    )
    assert count_places(meetings(views[0], views[1]), (13, 13)) in (2, 3)
    assert set(places) & {2, 3}


# --- the team


SPECS = (
    RobotSpec("A", camera(place=Se2(0.1, 0.02, 0.1)), (Se2(0, 0, 0), Se2(0.3, 0.0, 0.4))),
    RobotSpec("B", camera(45.0, lens=BARREL, roll_deg=1.0), (Se2(1.2, 0.3, 3.0),)),
)


@pytest.fixture(scope="module")
def team():
    return make_team("terrazzo", 5, SPECS, PLAIN, num_obstacles=3)


def test_a_team_has_every_picture_and_its_truth(team):
    assert [str(frame.id) for frame in team.frames] == ["A0", "A1", "B0"]
    assert [frame.image.shape for frame in team.frames] == [(120, 160, 3)] * 2 + [(150, 200, 3)]
    assert team.frames[1].world_from_base == Se2(0.3, 0.0, 0.4)
    a, b = FrameId("A", 1), FrameId("B", 0)
    reached = Se2(0.3, 0.0, 0.4) @ team.true_motion(a, b)
    np.testing.assert_allclose(reached.vector(), (1.2, 0.3, 3.0), atol=1e-12)
    assert team.overlaps()[a, b] == team.true_overlap(a, b) == team.true_overlap(b, a) > 0.0
    assert pickle.loads(pickle.dumps(team)).frames[0].attitude == team.frames[0].attitude  # noqa: S301


def test_everything_follows_from_the_seed(team):
    again = make_team("terrazzo", 5, SPECS, PLAIN, num_obstacles=3)
    other = make_team("terrazzo", 6, SPECS[:1], PLAIN)
    assert again.obstacles == team.obstacles
    for frame, same in zip(team.frames, again.frames, strict=True):
        np.testing.assert_array_equal(frame.image, same.image)
        assert frame.attitude == same.attitude
    assert other.frames[0].attitude != team.frames[0].attitude
    assert (other.frames[0].image != team.frames[0].image).mean() > 0.5


def test_obstacles_stand_in_view_and_out_of_the_way():
    many = tuple(Se2(0.3 * k, 0.0, 0.3 * k) for k in range(6))
    scene = set_scene("tiles", 2, [RobotSpec("A", camera(), many)], 5)
    assert len(scene.world.obstacles) == 5
    for solid in scene.world.obstacles:
        at = np.array([[solid.world_from_solid.x_m, solid.world_from_solid.y_m]])
        assert any(in_view(of, at)[0] or true_overlap(of, of) == 0 for of in scene.views[0])
        feet = np.array([[v.world_from_foot.x_m, v.world_from_foot.y_m] for v in scene.views[0]])
        assert np.hypot(*(feet - at).T).min() > 0.3 * 0.55 + solid.radius_m
        assert solid.height_m < 0.55
    assert set_scene("tiles", 2, [RobotSpec("A", camera(), many)], 0).world.obstacles == ()


def test_wobble_is_gaussian_with_the_mounts_sigmas():
    cam, rng = camera(), np.random.default_rng(8)
    drawn = [wobbled(cam, rng) for _ in range(2000)]
    table = np.array([[a.tilt_rad, a.roll_rad, a.height_m] for a in drawn])
    nominal = np.array([math.radians(33.0), 0.0, 0.55])
    sigma = np.array([SIGMA.tilt_rad, SIGMA.roll_rad, SIGMA.height_m])
    scaled = (table - nominal) / sigma
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=0.1)  # 4.5 deviations of 0.022
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.08)  # 5 of 0.016
    assert np.abs(np.corrcoef(scaled.T) - np.eye(3)).max() < 0.1


def test_a_team_needs_a_robot():
    with pytest.raises(ValueError, match="at least one robot, got none"):
        make_team("tiles", 1, [])


# --- pairs


def carried(pair):
    """Picture b as a would see it, and where, by the stated truth alone."""
    a, b = pair.a, pair.b
    lens_a, lens_b = a.view.camera.intrinsics, b.view.camera.intrinsics
    v, u = np.mgrid[0 : lens_a.height_px, 0 : lens_a.width_px].astype(float)
    floor = floor_from_rays(
        a.attitude, lens_a.rays_from_px(np.column_stack([u.ravel(), v.ravel()]))
    )
    foot_a, foot_b = (f.view.camera.mount.base_from_foot for f in (a, b))
    b_from_a = (foot_a.inverse() @ pair.a_from_b @ foot_b).inverse()
    pixels = lens_b.px_from_rays(rays_from_floor(b.attitude, b_from_a.apply(floor)))
    columns, rows = (p.reshape(u.shape).astype(np.float32) for p in pixels.T)
    size = np.array([lens_b.width_px, lens_b.height_px])
    inside = ((pixels > 1) & (pixels < size - 2)).all(axis=1).reshape(u.shape)
    grey = cv2.cvtColor(b.image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    return cv2.remap(grey, columns, rows, cv2.INTER_LINEAR), inside


@pytest.mark.parametrize("height_m", [0.1, 0.55, 70.0])
def test_the_stated_motion_lays_one_picture_on_the_other(height_m):
    place = Se2(0.2 * height_m, -0.1 * height_m, 0.3)
    cameras = (camera(25.0, height_m), camera(35.0, height_m * 1.1, BARREL, place, 1.5))
    world = World(make_floor("gravel", 1, height_m))
    rng = np.random.default_rng(3)
    pair = render_pair(world, cameras, PairOptions(least_overlap=0.6, most_overlap=0.9), rng, PLAIN)
    assert 0.6 <= pair.overlap <= 0.9
    other, inside = carried(pair)
    own = cv2.cvtColor(pair.a.image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    smoothed = [cv2.GaussianBlur(picture, (0, 0), 2.0) for picture in (own, other)]
    inside = cv2.erode(inside.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    gv, gu = np.gradient(smoothed[0])
    design = np.column_stack([-gu[inside], -gv[inside], np.ones(inside.sum())])
    moved = np.linalg.lstsq(design, (smoothed[1] - smoothed[0])[inside], rcond=None)[0][:2]
    # Pictures of different sharpness of one floor; worst seen 0.02 px.  A wrong half pixel, mount
    # offset or attitude is 0.3 px and more.
    assert np.abs(moved).max() < 0.06
    assert np.corrcoef(smoothed[0][inside], smoothed[1][inside])[0, 1] > 0.95


@given(st.integers(0, 9999))
@settings(max_examples=10, deadline=None)
def test_drawn_pairs_are_as_wanted(seed):
    options = PairOptions(least_overlap=0.45, most_overlap=0.7, max_turn_rad=0.5)
    a, b = draw_views((camera(), camera(45.0)), options, np.random.default_rng(seed))
    assert 0.45 <= true_overlap(a, b) <= 0.7
    assert abs((a.world_from_base.inverse() @ b.world_from_base).theta_rad) <= 0.5


def test_an_impossible_pair_is_refused():
    with pytest.raises(ValueError, match=r"within 0 to 1 and in order, got 0.5 to 0.4"):
        PairOptions(least_overlap=0.5, most_overlap=0.4)
    options = PairOptions(least_overlap=0.5, most_overlap=0.5)
    with pytest.raises(ValueError, match=r"overlap between 0.5 and 0.5 in 200 tries"):
        draw_views((camera(), camera()), options, np.random.default_rng(0))
