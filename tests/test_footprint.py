"""The floor under a lattice of pixels: how long a pixel is there, and how far the floor reaches."""

import math

import numpy as np
import pytest
from world_cameras import BARREL, LENS, camera

from groundfuse.backend.measurement import IDENTITY, Se2
from groundfuse.frontend.footprint import (
    BEYOND,
    LATTICE_COLUMNS,
    LATTICE_ROWS,
    Footprint,
    footprint,
)
from groundfuse.frontend.overhead import floor_from_rays

# Both are the same few operations on doubles, in another order; worst seen 3e-14.
TOLERANCE = 1e-12
CASES = [
    {"tilt_deg": 33.0},
    {"tilt_deg": 75.0, "roll_deg": 4.0},  # with a horizon
    {"tilt_deg": 50.0, "lens": BARREL, "rows": (20, 140)},
]


def seen(**how):
    cam = camera(**how)
    return cam, footprint(cam, cam.mount.attitude, IDENTITY)


@pytest.mark.parametrize("how", CASES)
def test_pixels_are_as_long_as_the_largest_stretch_of_the_lattice(how):
    cam, found = seen(**how)
    lens, (first, last) = cam.intrinsics, cam.used_rows
    u, v = (
        np.linspace(0.0, lens.width_px - 1.0, LATTICE_COLUMNS),
        np.linspace(first, last, LATTICE_ROWS),
    )
    rays = lens.rays_from_px(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    floor = floor_from_rays(cam.mount.attitude, rays).reshape(LATTICE_ROWS, LATTICE_COLUMNS, 2)
    by_px = np.stack([np.gradient(floor, u, axis=1), np.gradient(floor, v, axis=0)], axis=-1)
    there = np.isfinite(by_px).all(axis=(2, 3))
    longest = np.linalg.norm(np.where(there[..., None, None], by_px, 0.0), 2, axis=(2, 3))
    assert np.array_equal(np.isfinite(found.m_per_px), there)
    assert there.all() == (how["tilt_deg"] < 60.0)
    np.testing.assert_allclose(found.floor_m, floor, rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(found.m_per_px[there], longest[there], rtol=TOLERANCE)


def test_straight_down_every_pixel_is_as_long():
    _, found = seen(tilt_deg=0.0, height_m=0.7)
    np.testing.assert_allclose(found.m_per_px, 0.7 / LENS.fx_px, rtol=TOLERANCE)


@pytest.mark.parametrize("how", CASES)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_bounds_hold_what_is_resolved_and_its_neighbours_a_little_beyond(how, share):
    cam, shown = seen(**how)
    shown = footprint(cam, cam.mount.attitude, Se2(1.0, -2.0, 0.4))
    limit_m = shown.finest_m_per_px(share)
    wanted = []
    for i, j in np.ndindex(shown.m_per_px.shape):
        around = shown.m_per_px[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
        length_m = shown.m_per_px[i, j]
        if length_m <= limit_m or (length_m <= limit_m * BEYOND and (around <= limit_m).any()):
            wanted.append(shown.floor_m[i, j])
    low, high = shown.bounds(limit_m)
    assert np.array_equal(low, np.min(wanted, axis=0))
    assert np.array_equal(high, np.max(wanted, axis=0))


def test_floor_beyond_the_limit_has_no_bounds():
    _, shown = seen(tilt_deg=33.0)
    assert shown.bounds(0.999 * shown.finest_m_per_px(0.0)) is None
    sky = Footprint(shown.floor_m, np.full_like(shown.m_per_px, np.nan))
    assert sky.bounds(math.inf) is None
