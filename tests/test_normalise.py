"""Local contrast: light and paint go, texture stays, and what is masked has no say."""

import numpy as np
import pytest

from groundfuse.frontend.normalise import local_contrast
from groundfuse.frontend.normalise_compiled import block_sums, halves

RADIUS_PX, FLOOR_GREY = 8.0, 1.5
WHOLE = np.ones((120, 160), dtype=np.bool_)


def noise(deviation, seed=0, mean=128.0):
    picture = mean + deviation * np.random.default_rng(seed).standard_normal((120, 160))
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def test_a_constant_picture_becomes_nothing():
    for grey in (0, 90, 255):
        flat = np.full((120, 160), grey, dtype=np.uint8)
        # Sums of 255 squared in float32: 6e4 x 6e-8 x a few hundred terms; worst seen 0.02.
        assert np.abs(local_contrast(flat, WHOLE, RADIUS_PX, FLOOR_GREY)).max() < 0.05


def test_texture_gets_zero_mean_and_unit_deviation():
    found = local_contrast(noise(20.0), WHOLE, RADIUS_PX, FLOOR_GREY)
    # A Gaussian of 8 px averages 4 pi 8^2 = 800 pixels: 4 % of mean and deviation.
    assert abs(found.mean()) < 0.01
    assert found.std() == pytest.approx(1.0, abs=0.02)


def test_gain_and_offset_go():
    plain = noise(10.0, mean=60.0)
    lit = np.rint(plain * 2.0 + 30.0).astype(np.uint8)
    one, two = (local_contrast(p, WHOLE, RADIUS_PX, FLOOR_GREY) for p in (plain, lit))
    np.testing.assert_allclose(one, two, atol=1e-3)


def test_a_step_of_light_goes_but_for_its_edge():
    half = noise(8.0, mean=60.0).astype(int)
    half[:, 80:] += 100
    step = local_contrast(half.astype(np.uint8), WHOLE, RADIUS_PX, FLOOR_GREY)
    for part in (step[:, :40], step[:, 120:]):
        assert part.std() == pytest.approx(1.0, abs=0.05)
        assert abs(part.mean()) < 0.05


def test_noise_below_the_floor_is_not_blown_up():
    found = local_contrast(noise(0.6), WHOLE, RADIUS_PX, 3.0)
    assert found.std() == pytest.approx(np.hypot(0.6, 1 / np.sqrt(12)) / 3.0, rel=0.05)


@pytest.mark.parametrize("radius_px", [3.0, 8.0, 12.0])
def test_the_neighbourhood_has_the_radius(radius_px):
    """One bright pixel: the dip around it has the second moment of a Gaussian of that sigma."""
    side = 161
    picture = np.full((side, side), 100, dtype=np.uint8)
    picture[80, 80] = 101
    # The floor keeps the deviation constant, so the answer is linear: grey - mean, over the floor.
    answer = local_contrast(picture, np.ones((side, side), np.bool_), radius_px, 50.0) * 50.0
    dip = -answer.astype(np.float64)
    dip[80, 80] += 1.0
    v, u = np.mgrid[0:side, 0:side] - 80
    assert dip.sum() == pytest.approx(1.0, abs=0.02)
    # Three boxes of odd width w have a variance of (w^2 - 1) / 4: sigmas half a pixel apart.
    for axis in (u, v):
        assert np.sqrt((dip * axis**2).sum() / dip.sum()) == pytest.approx(radius_px, abs=0.51)


def test_masked_pixels_are_zero_and_have_no_say():
    mask = WHOLE.copy()
    mask[:, 100:] = False
    dark, bright = noise(10.0), noise(10.0)
    dark[:, 100:], bright[:, 100:] = 0, 255
    one, two = (local_contrast(p, mask, RADIUS_PX, FLOOR_GREY) for p in (dark, bright))
    np.testing.assert_array_equal(one, two)
    assert not one[:, 100:].any()
    # Nor does the mask's edge darken the floor beside it: still zero mean, unit deviation.
    assert abs(one[:, 92:100].mean()) < 0.1
    assert one[:, 92:100].std() == pytest.approx(1.0, abs=0.1)


def test_nothing_to_see_is_no_error():
    found = local_contrast(noise(10.0), np.zeros_like(WHOLE), RADIUS_PX, FLOOR_GREY)
    assert not found.any()
    assert found.dtype == np.float32


@pytest.mark.parametrize("radius_px", [3.0, 8.0, 9.0, 12.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_ramp_of_light_goes(radius_px, axis):
    """Its local mean is the ramp itself, between the middles of blocks too."""
    ramp = np.moveaxis(np.broadcast_to(np.arange(200, dtype=np.uint8), (200, 200)), axis, 0).copy()
    found = local_contrast(ramp, np.ones(ramp.shape, np.bool_), radius_px, 1.0)
    # Over a deviation of one radius. Far from the border: the kernel is cut at 4 sigmas.
    inner = found[60:-60, 60:-60]
    assert np.abs(inner).max() < 1e-4  # single precision, greys of 200; worst seen 4e-6


@pytest.mark.parametrize("step", [1, 2, 3, 4])
@pytest.mark.parametrize("shape", [(12, 24), (13, 27), (3, 2)])
def test_sums_are_of_blocks(shape, step):
    rng = np.random.default_rng(step)
    grey = rng.integers(0, 256, shape).astype(np.uint8)
    mask = (rng.random(shape) < 0.7).astype(np.uint8)
    rows, columns = (-(-side // step) for side in shape)
    value, counted = np.zeros((2, rows * step, columns * step), np.int64)
    value[: shape[0], : shape[1]], counted[: shape[0], : shape[1]] = grey, mask
    expected = [
        (value**power * counted).reshape(rows, step, columns, step).sum(axis=(1, 3))
        for power in range(3)
    ]
    np.testing.assert_array_equal(block_sums(grey, mask, step), expected)


def test_halves_are_the_nearest_numbers_of_half_precision():
    rng = np.random.default_rng(0)
    size = np.exp2(rng.uniform(-13.9, 15.9, (50, 80))).astype(np.float32)
    picture = np.where(rng.random(size.shape) < 0.5, size, -size)
    halfway = np.array([[2049.0, 2051.0, 1.0 + 2.0**-11, 1.0 + 3 * 2.0**-11]], np.float32)
    for numbers in (picture, halfway):
        np.testing.assert_array_equal(halves(numbers).view(np.float16), numbers.astype(np.float16))


def test_halves_have_a_largest_and_a_smallest():
    picture = np.array([[1e9, -1e9, 65504.0, 2.0**-14, 6e-5, -1e-30, 0.0]], np.float32)
    found = halves(picture).view(np.float16)
    np.testing.assert_array_equal(found, [[65504, -65504, 65504, 2.0**-14, 0, 0, 0]])
