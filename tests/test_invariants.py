"""Six numbers per point that neither a turn of the view nor the light changes."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.frontend.invariants import InvariantOptions, colour_values, invariants, sigmoid

OPTIONS = InvariantOptions()
EVERYWHERE = np.ones((120, 160), bool)
# Rounding to 8 bits moves a filtered colour by 0.3 / sqrt(4 pi sigma^2 = 50) = 0.04 grey of a
# spread of some 10: 0.4 % of it, times the sigmoid's slope 1.7 / 4; gradients are ten times
# smaller, so ten times more; worst seen 0.014.
TOLERANCE_LIGHT = 0.03


def picture(seed=0, rows=120, columns=160):
    noise = np.random.default_rng(seed).normal(size=(rows, columns, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(90 + 30 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def points(count=60, seed=1, margin=20):
    low, high = (margin, margin), (160 - margin, 120 - margin)
    return np.random.default_rng(seed).integers(low, high, (count, 2)).astype(float)


@given(st.floats(-1e6, 1e6), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_the_sigmoid_is_the_one_of_the_paper(t, mu, t0):
    got = sigmoid(np.array(t), mu, t0)
    exponent = np.clip(-mu * (t - t0), -700, 700)
    # tanh is good to a few eps; the printed form cancels to the same.
    assert got == pytest.approx(1.0 / (1.0 + np.exp(exponent)), abs=1e-12)


def test_a_turn_of_the_view_changes_nothing():
    view, at = picture(), points()
    turned = np.ascontiguousarray(np.rot90(view))
    moved = np.stack([at[:, 1], 159.0 - at[:, 0]], axis=1)
    values = invariants(view, EVERYWHERE, at)
    np.testing.assert_allclose(
        invariants(turned, np.rot90(EVERYWHERE), moved),
        values,
        atol=1e-5,  # single precision
    )
    assert values.std(axis=0).min() > 0.1


def test_light_and_white_balance_change_nothing():
    view, at = picture(), points()
    dimmed = np.rint(view * np.array([0.7, 0.8, 0.9]) + 10.0).astype(np.uint8)
    difference = invariants(dimmed, EVERYWHERE, at) - invariants(view, EVERYWHERE, at)
    assert np.abs(difference).max() < TOLERANCE_LIGHT


def test_colours_come_as_red_green_blue_over_255():
    view = np.zeros((120, 160, 3), np.uint8)
    view[:] = (51, 102, 204)  # OpenCV: blue, green, red
    values = colour_values(view, EVERYWHERE, points(), OPTIONS)
    np.testing.assert_allclose(values[:, :3], [[0.8, 0.4, 0.2]] * 60, atol=1e-6)
    np.testing.assert_allclose(values[:, 3:], 0.0, atol=1e-6)


def test_gradients_are_magnitudes_per_cell():
    ramp = np.zeros((120, 160, 3), np.uint8)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    ramp[:, :, 2] = (3 * u + 4 * v) / 4.0  # red rises by 5 / 4 grey values per cell
    values = colour_values(ramp, EVERYWHERE, points(), OPTIONS)
    # Rounding down to whole grey values leaves 0.3 / (sigma sqrt(8 pi sigma^2)) = 0.02 grey.
    np.testing.assert_allclose(values[:, 3] * 255, 1.25, atol=0.05)
    np.testing.assert_allclose(values[:, 4:], 0.0, atol=1e-6)


def test_what_is_not_floor_has_no_say():
    view, at = picture(), points()
    mask = EVERYWHERE.copy()
    mask[:, 90:] = False
    other = view.copy()
    other[:, 90:] = 255
    kept = at[at[:, 0] < 88]
    options = InvariantOptions(contrast_radius_cells=8.0)
    for chosen in (OPTIONS, options):
        np.testing.assert_allclose(
            invariants(other, mask, kept, chosen), invariants(view, mask, kept, chosen), atol=1e-5
        )


def test_vignetting_goes_with_the_contrast_option():
    view, at = picture(), points()
    shade = np.linspace(1.0, 0.4, 160)[None, :, None]
    shaded = np.rint(view * shade).astype(np.uint8)

    def change(options):
        before, after = (invariants(v, EVERYWHERE, at, options) for v in (view, shaded))
        return np.abs(after - before).mean()

    plain = change(OPTIONS)
    assert plain > 0.1
    assert change(InvariantOptions(contrast_radius_cells=15.0)) < plain / 4


def test_a_grey_view_counts_as_colourless():
    grey, at = picture()[:, :, 0], points()
    coloured = np.repeat(grey[:, :, None], 3, axis=2)
    got = invariants(np.ascontiguousarray(grey), EVERYWHERE, at)
    np.testing.assert_array_equal(got, invariants(coloured, EVERYWHERE, at))


def test_an_even_floor_is_no_error():
    even = np.full((120, 160, 3), 80, np.uint8)
    got = invariants(even, EVERYWHERE, points())
    np.testing.assert_allclose(got, 0.5, atol=0.3)
    assert invariants(even, EVERYWHERE, np.zeros((0, 2))).shape == (0, 6)
