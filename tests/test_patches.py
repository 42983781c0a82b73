"""Patches laid on each other, on a floor that is a formula: every keypoint's truth is known."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from analytic_floor import floor_of_pixels, make_camera, picture, rounded, waves
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend import patches
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.patches import (
    PatchOptions,
    PatchView,
    _largest,
    _weight,
    aligned,
    empty_templates,
    fill_from,
    grey_picture,
    keypoints_of,
    patch_plan,
)
from groundfuse.frontend.patches_compiled import read_between

BARREL = (-0.15, 0.04, 1e-3, -1e-3)
OPTIONS = PatchOptions()
POSES = (Se2(0.0, 0.0, 0.0), Se2(0.06, 0.03, 0.4), Se2(-0.05, 0.04, -0.7))
WAVE_M = 0.045
# Wobble that is not told, interpolation, rounding to whole levels: nine in ten keypoints end
# within 0.032 px, half of them within 0.015.
EXACT_PX = 0.04


def attitude_of(number, expected):
    """The wobble of the pictures, which the alignment is not told of."""
    tilt, roll, height = np.random.default_rng(number).standard_normal(3).tolist()
    return Attitude(
        expected.tilt_rad + math.radians(0.5 * tilt),
        math.radians(0.15 * roll),
        expected.height_m + 0.002 * height,
    )


def colour(points):
    # Three grains: one alone repeats itself, and a wrong peak fits as well as the right one.
    grains = (1.0, 1.7, 0.6)
    return sum(waves(points, grain * WAVE_M) for grain in grains) / len(grains)


def as_it_is(_, image):
    return image


class World:
    """Pictures of floor points, with their true pixels and rays."""

    def __init__(self, coefficients=(), change=as_it_is, count=60, heights_m=(0.55, 0.55, 0.55)):
        self.camera = make_camera(coefficients=coefficients, size=(240, 180))
        tilted = self.camera.mount.attitude
        known = [replace(tilted, height_m=height_m) for height_m in heights_m]
        self.attitudes = [attitude_of(k, expected) for k, expected in enumerate(known)]
        images = [
            rounded(change(k, picture(self.camera, attitude, pose, colour)))
            for k, (attitude, pose) in enumerate(zip(self.attitudes, POSES, strict=True))
        ]
        self.views = [
            PatchView(self.camera, attitude, pose, lambda image=image: image)
            for attitude, pose, image in zip(known, POSES, images, strict=True)
        ]
        self.pictures = [grey_picture(view, OPTIONS) for view in self.views]
        self._place(count)

    def _place(self, count):
        lens, margin = self.camera.intrinsics, OPTIONS.radius_px + 5
        floor = floor_of_pixels(self.camera, self.attitudes[0], POSES[0])
        candidates = np.random.default_rng(5).permutation(floor[np.isfinite(floor[:, 0])])
        rays = np.stack(
            [
                rays_from_floor(attitude, pose.inverse().apply(candidates))
                for attitude, pose in zip(self.attitudes, POSES, strict=True)
            ]
        )
        px = np.stack([lens.px_from_rays(ray) for ray in rays])
        size = np.array([lens.width_px, lens.height_px])
        with np.errstate(invalid="ignore"):
            inside = ((px > margin) & (px < size - 1 - margin)).all(axis=(0, 2))
        some = np.flatnonzero(inside)[:count]
        assert len(some) == count
        self.view = np.repeat(np.arange(len(POSES)), count)
        self.point = np.tile(np.arange(count), len(POSES))
        self.px, self.rays = px[:, some].reshape(-1, 2), rays[:, some].reshape(-1, 2)

    def seen(self, spread_px, seed=1):
        """Rays as a detector has them: all but each point's finest are off."""
        lens = self.camera.intrinsics
        finest = keypoints_of(self.views, self.view, self.rays, self.point).finest
        off = spread_px * np.random.default_rng(seed).uniform(-1.0, 1.0, self.px.shape)
        off[finest == np.arange(len(off))] = 0.0
        rays = lens.rays_from_px(self.px + off)
        rays[finest == np.arange(len(off))] = self.rays[finest == np.arange(len(off))]
        return rays, finest

    def plan(self, rays, options=OPTIONS):
        """Numbers of all that are no finest, and how they are laid on."""
        points = keypoints_of(self.views, self.view, rays, self.point)
        which = np.flatnonzero(points.finest != np.arange(len(rays)))
        return which, patch_plan(self.views, points, which, options)

    def aligned(self, rays, options=OPTIONS):
        """Aligned keypoints: numbers, errors in pixels (nan where they don't fit), deviations."""
        numbers, plan = self.plan(rays, options)
        templates = empty_templates(len(numbers), options)
        for other in np.unique(plan.finest_view):
            some = np.flatnonzero(plan.finest_view == other)
            fill_from(plan, some, self.pictures[other], templates)
        px, sigma_px = np.empty((len(numbers), 2)), np.empty(len(numbers))
        lens = self.camera.intrinsics
        for number in np.unique(plan.view):
            some = np.flatnonzero(plan.view == number)
            exact = aligned(plan, some, self.pictures[number], templates, options)
            px[some], sigma_px[some] = lens.px_from_rays(exact.rays), exact.sigma * lens.focal_px
        return numbers, px - self.px[numbers], sigma_px


@pytest.fixture(scope="module", params=[(), BARREL], ids=["pinhole", "barrel"])
def world(request):
    return World(request.param)


def test_keypoints_come_back_to_where_they_are(world):
    rays, _ = world.seen(0.9)
    _, errors, sigmas = world.aligned(rays)
    assert np.isfinite(sigmas).mean() > 0.9
    error = np.hypot(*errors[np.isfinite(sigmas)].T)
    assert np.quantile(error, 0.9) < EXACT_PX
    assert np.median(error) < 0.5 * EXACT_PX


def test_a_much_finer_picture_is_halved_first(monkeypatch):
    """One camera hangs at 0.4 of the others' height: read at every third pixel, it shimmers."""
    near = World(heights_m=(0.55, 0.22, 0.55), count=25)
    rays, _ = near.seen(0.5)
    _, errors, _ = near.aligned(rays)
    assert np.isfinite(errors).mean() > 0.65  # others reach over the border: three times as far
    assert np.nanmedian(np.hypot(*errors.T)) < EXACT_PX
    which, plan = near.plan(rays)
    assert 0 < np.count_nonzero(plan.halvings == 1) < len(which)
    monkeypatch.setattr(patches, "MOST_HALVINGS", 0)
    _, plain, _ = near.aligned(rays)
    assert np.nanmedian(np.hypot(*errors.T)) < np.nanmedian(np.hypot(*plain.T))


def test_few_steps_are_enough(world):
    """Newton's steps: each leaves the square of what was left; a wrong one creeps."""
    rays, _ = world.seen(0.5)
    _, _, sigmas = world.aligned(rays, replace(OPTIONS, steps=5))
    _, _, patient = world.aligned(rays)
    assert np.isfinite(sigmas).sum() > 0.9 * np.isfinite(patient).sum()


def test_an_error_of_the_finest_is_shared_by_all_that_are_laid_on_it(world):
    """So the floor point moves, and nothing else does."""
    rays, finest = world.seen(0.0)
    own = finest == np.arange(len(finest))
    lens = world.camera.intrinsics
    rays[own] = lens.rays_from_px(world.px[own] + np.array([0.4, -0.3]))
    numbers, errors, _ = world.aligned(rays)
    _, plan = world.plan(rays)
    assert len(numbers) == len(plan.map)
    # The map carries a pixel of theirs to one of the finest.
    carried = (plan.map[:, :2, :2] @ errors[:, :, None])[:, :, 0]
    fits = np.isfinite(carried[:, 0])
    assert fits.mean() > 0.9
    off = np.hypot(*(carried[fits] - np.array([0.4, -0.3])).T)
    assert np.median(off) < 2.0 * EXACT_PX


def test_maps_agree_with_going_by_way_of_the_floor(world):
    """To the last bit without distortion; else to what is left after the second order."""
    numbers, plan = world.plan(world.rays)
    finest = keypoints_of(world.views, world.view, world.rays, world.point).finest
    lens, known = world.camera.intrinsics, world.camera.mount.attitude
    side = 2 * OPTIONS.radius_px + 1
    off = np.stack(np.meshgrid(*2 * [np.arange(side) - OPTIONS.radius_px]), axis=-1).reshape(-1, 2)
    weight = _weight(side).ravel()
    x, y = off.T
    for number in range(0, len(numbers), 5):
        mine, other = numbers[number], finest[numbers[number]]
        view, there = int(world.view[mine]), int(world.view[other])
        assert (plan.view[number], plan.finest_view[number]) == (view, there)
        # The attitudes told are not the true ones: where both think the point is differs.
        spots = [
            POSES[v].apply(floor_from_rays(known, world.rays[k][None]))
            for v, k in ((view, mine), (there, other))
        ]
        rays = lens.rays_from_px(plan.place[number] + off)
        floor = POSES[view].apply(floor_from_rays(known, rays)) + spots[1] - spots[0]
        seen = lens.px_from_rays(rays_from_floor(known, POSES[there].inverse().apply(floor)))
        mapped = np.column_stack([off, np.ones(len(off))]) @ plan.map[number].T
        mapped = mapped[:, :2] / mapped[:, 2:]
        mapped += np.column_stack([x * x, x * y, y * y]) @ plan.bend[number].T
        error = plan.finest_place[number] + mapped - seen
        if lens.is_pinhole:
            assert np.abs(error).max() < 1e-6
        else:  # worst seen 2e-5 and 0.009; without the bend 0.04 and 0.5
            assert np.abs(weight @ error).max() < 1e-4
            assert np.abs(error).max() < 0.02


def test_light_does_not_matter():
    plain = World()
    rays, _ = plain.seen(0.9)
    dark = World(change=lambda number, image: image * (1.0, 0.6, 1.3)[number] - 10.0 * number)
    _, errors, _ = dark.aligned(rays)
    assert np.isfinite(errors).mean() > 0.9
    assert np.nanquantile(np.hypot(*errors.T), 0.9) < 1.5 * EXACT_PX  # coarser levels


def test_deviations_are_those_of_the_errors():
    """With the noise of a camera; the bundle estimates a common factor, so a rough match does."""
    rng = np.random.default_rng(3)
    noisy = World(change=lambda _, image: image + rng.normal(0.0, 5.0, image.shape), count=120)
    rays, _ = noisy.seen(0.5)
    _, errors, sigmas = noisy.aligned(rays)
    fits = np.isfinite(sigmas)
    scaled = errors[fits] / sigmas[fits, None]
    assert fits.mean() > 0.9
    # Both pictures have noise; 1.3 to 2.0 over three seeds of noise of 3 to 12 levels.
    assert 0.7 < 1.4826 * np.median(np.abs(scaled)) / math.sqrt(2.0) < 2.5


def test_more_noise_makes_larger_deviations():
    quiet, loud = (
        World(
            change=lambda _, image, s=s: image + np.random.default_rng(4).normal(0, s, image.shape)
        )
        for s in (3.0, 12.0)
    )
    rays, _ = quiet.seen(0.3)
    assert np.nanmedian(loud.aligned(rays)[2]) > 1.8 * np.nanmedian(quiet.aligned(rays)[2])


@pytest.mark.parametrize(
    ("change", "options"),
    [
        (lambda n, image: image if n == 0 else np.full_like(image, 90.0), OPTIONS),
        (lambda n, image: image if n == 0 else image[::-1, ::-1], OPTIONS),
        (as_it_is, replace(OPTIONS, max_move_px=0.05)),
        (as_it_is, replace(OPTIONS, steps=1)),
        (as_it_is, replace(OPTIONS, min_correlation=1.1)),
    ],
    ids=["blank", "another floor", "too far", "not at rest", "not alike enough"],
)
def test_what_does_not_fit_is_left_out(change, options):
    world = World(change=change)
    rays, finest = world.seen(0.9)
    numbers, _, sigmas = world.aligned(rays, options)
    apart = world.view[numbers] != 0
    apart |= world.view[finest[numbers]] != 0
    assert np.isfinite(sigmas[apart]).mean() < 0.15


def test_patches_that_reach_over_the_border_are_left_out():
    world = World()
    world.camera = replace(world.camera, first_row=60)
    world.views = [replace(view, camera=world.camera) for view in world.views]
    rays, finest = world.seen(0.5)
    numbers, _, sigmas = world.aligned(rays)
    rows, reach = world.px[:, 1], OPTIONS.radius_px
    over = (rows[numbers] < 60 + reach - 1) | (rows[finest[numbers]] < 60 + reach - 5)
    assert over.sum() > 5
    assert not np.isfinite(sigmas[over]).any()
    assert np.isfinite(sigmas).any()


def test_the_finest_picture_is_the_one_that_is_nearest():
    near, far = make_camera(tilt_deg=10.0, height_m=0.3), make_camera(tilt_deg=10.0, height_m=0.6)
    views = [PatchView(c, c.mount.attitude, Se2(0.0, 0.0, 0.0), lambda: None) for c in (far, near)]
    floor = np.array([[0.02, 0.01], [0.05, -0.03]])
    rays = np.vstack([rays_from_floor(v.attitude, floor) for v in views])
    points = keypoints_of(views, np.array([0, 0, 1, 1]), rays, np.array([0, 1, 0, 1]))
    assert points.finest.tolist() == [2, 3, 2, 3]
    assert np.allclose(points.floor, np.vstack([floor, floor]))
    # At half the height pixels lie half as far apart.
    assert np.allclose(points.fineness[2:] / points.fineness[:2], 4.0, rtol=0.1)


@pytest.mark.parametrize("coefficients", [(), BARREL], ids=["pinhole", "barrel"])
def test_fineness_is_how_many_pixels_a_piece_of_floor_has(coefficients):
    """By the corners of small squares on the floor, sent through attitude and lens."""
    camera = make_camera(coefficients=coefficients)
    attitude, lens = camera.mount.attitude, camera.intrinsics
    view = PatchView(camera, attitude, Se2(0.0, 0.0, 0.0), lambda: None)
    across, down = np.meshgrid(np.linspace(20, lens.width_px - 20, 5), [15.0, 100.0])
    rays = lens.rays_from_px(np.column_stack([across.ravel(), down.ravel()]))
    middle = floor_from_rays(attitude, rays)
    found = keypoints_of([view], np.zeros(10, np.int64), rays, np.arange(10)).fineness

    def px(offset_m):
        return lens.px_from_rays(rays_from_floor(attitude, middle + offset_m))

    half_m = 1e-4
    by_x = px(np.array([half_m, 0.0])) - px(np.array([-half_m, 0.0]))
    by_y = px(np.array([0.0, half_m])) - px(np.array([0.0, -half_m]))
    area_px = np.abs(by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]) / (2.0 * half_m) ** 2
    # Fineness may have any unit; slopes are taken over a pixel.
    ratio = found / area_px
    np.testing.assert_allclose(ratio / ratio[0], 1.0, rtol=1e-3)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=40), st.randoms(use_true_random=False))
def test_the_largest_of_each_group_is_the_first_of_equal_ones(values, random):
    numbers = list(range(1 + max(1, len(values) // 4)))
    group = [random.choice(numbers) for _ in values]
    present = sorted(set(group))
    group = np.array([present.index(number) for number in group])
    found = _largest(np.array(values, np.float64), group)
    expected = [
        max(np.flatnonzero(group == k).tolist(), key=lambda place: (values[place], -place))
        for k in range(len(present))
    ]
    assert found.tolist() == expected


def test_reading_between_pixels_is_bilinear():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (20, 30)).astype(np.uint8)
    u, v = rng.uniform(0.0, 28.9, 50), rng.uniform(0.0, 18.9, 50)
    # OpenCV's places are multiples of 1/32 px.
    u, v = np.floor(u * 32) / 32, np.floor(v * 32) / 32
    known = cv2.remap(
        image.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
    ).ravel()
    found = [read_between(image, *place) for place in zip(u.tolist(), v.tolist(), strict=True)]
    assert np.allclose(found, known, atol=1e-3)


@pytest.mark.parametrize("name", ["radius_px", "blur_px", "noise", "max_move_px", "cache_bytes"])
def test_options_refuse_what_makes_no_sense(name):
    with pytest.raises(ValueError, match=name):
        PatchOptions(**{name: 0})
