"""What rays make of a longer focal length, against closed forms and against lenses themselves."""

from dataclasses import replace

import numpy as np
import pytest

from groundfuse.backend.bundle_tracks import Sightings, gain_at, with_gains
from groundfuse.frontend.camera import Distortion, Intrinsics
from groundfuse.tools.focal_gain import focal_gains

BROWN = Intrinsics(
    640, 480, 525.0, 524.0, 321.0, 238.0, Distortion.PLUMB_BOB, (-0.105, 0.041, 6e-4, -4e-4, 0.0)
)
FISHEYE = Intrinsics(640, 480, 548.0, 549.5, 316.8, 243.0, Distortion.EQUIDISTANT, (0.0,) * 4)
BENT_FISHEYE = replace(FISHEYE, coefficients=(0.012, -0.004, 0.001, 0.0))
# 64 knots interpolate a curve that bends by 3 over a radius of 0.7 to 3 / 8 (0.7 / 63)^2 = 5e-5;
# worst seen 6e-5, where rays that OpenCV finds by iteration, to 1e-8, are differenced by 1e-3.
TOLERANCE_GAIN = 2e-4


def test_a_pinhole_needs_no_table():
    assert focal_gains(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)) == ()
    np.testing.assert_array_equal(gain_at(np.array([[0.5, 0.1], [0.0, 0.0]]), ()), [1.0, 1.0])


def test_an_ideal_fisheye_has_its_closed_form():
    rays = np.array([[0.1, 0.0], [0.3, 0.2], [-0.4, 0.4]])
    radius = np.hypot(*rays.T)
    wanted = (1 + radius**2) * np.arctan(radius) / radius
    np.testing.assert_allclose(gain_at(rays, focal_gains(FISHEYE)), wanted, atol=TOLERANCE_GAIN)
    assert wanted.max() > 1.2  # far from a pinhole's


@pytest.mark.parametrize("lens", [BROWN, BENT_FISHEYE], ids=["brown", "fisheye"])
def test_rays_move_as_the_table_says(lens):
    pixels = np.random.default_rng(3).uniform((0, 0), (639, 479), (100, 2))
    rays, by = lens.rays_from_px(pixels), 2e-3
    shorter = replace(lens, fx_px=lens.fx_px * (1 - by), fy_px=lens.fy_px * (1 - by))
    moved = shorter.rays_from_px(pixels)  # rays of the same pixels grow as f shrinks
    foretold = rays * (1 + by * gain_at(rays, focal_gains(lens)))[:, None]
    off_px = lens.fx_px * np.abs(foretold - moved).max()
    # Second order, by^2 |ray| fx = 2e-3 px, and what the tangential terms bend; worst seen 6e-3.
    assert off_px < 0.02
    pinhole_px = lens.fx_px * np.abs(rays * (1 + by) - moved).max()
    assert pinhole_px > 0.04


def test_every_robot_has_its_own_table():
    rays = np.array([[0.3, 0.2], [0.3, 0.2]])
    sightings = Sightings(np.array([0, 1]), rays, np.ones(2))
    found = with_gains(sightings, np.array([0, 1]), [(), focal_gains(FISHEYE)])
    assert found.gain[0] == 1.0
    assert found.gain[1] > 1.05
