"""Drawn pairs are as wanted, and one picture lies on the other by the stated motion."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from world_cameras import BARREL, camera

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.tools.floors import make_floor
from groundfuse.tools.overlap import true_overlap
from groundfuse.tools.photometry import PLAIN
from groundfuse.tools.render import World
from groundfuse.tools.view_pairs import PairOptions, draw_views, render_pair


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
@settings(max_examples=10)
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
