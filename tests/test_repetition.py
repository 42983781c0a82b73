"""A floor that repeats has a second peak near one; a floor that does not has none."""

import numpy as np
import pytest
from floor_pairs import camera, features_of, photo
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.repetition import REPEATS, repetition

WHOLE = np.ones((120, 160), dtype=np.bool_)


def white(seed=0, shape=(120, 160)):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def tiled(period_v, period_u, seed=0, shape=(120, 160)):
    one = white(seed, (period_v, period_u))
    rows, columns = np.arange(shape[0]) % period_v, np.arange(shape[1]) % period_u
    return one[rows[:, None], columns[None, :]]


@given(st.integers(12, 60), st.integers(12, 80), st.integers(0, 2**16))
@settings(max_examples=15)
def test_any_period_that_fits_twice_is_found(period_v, period_u, seed):
    assert repetition(tiled(period_v, period_u, seed), WHOLE) > 0.99


@given(st.integers(0, 2**16))
@settings(max_examples=10)
def test_noise_does_not_repeat(seed):
    # The highest of some 2e4 correlations over 30 % of 2e4 pixels: 4.5 / sqrt(6e3) = 0.06.
    assert repetition(white(seed), WHOLE) < 0.1


def test_a_view_that_is_livelier_on_one_side_is_judged_alike():
    """Contrast that grows twentyfold across the view: shares of the overlap's own power."""
    ramp = np.exp(np.linspace(0.0, np.log(20.0), 160)).astype(np.float32)
    assert repetition(tiled(30, 40) * ramp, WHOLE) > 0.99
    # Fewer pixels carry the power; worst seen of four seeds 0.07.
    assert repetition(white(5) * ramp, WHOLE) < 0.12


def test_noise_on_the_tiles_lowers_the_peak_by_its_share():
    """Signal of variance 1 in noise of variance 0.25: correlation 0.8."""
    picture = tiled(30, 40) + 0.5 * white(1)
    assert repetition(picture, WHOLE) == pytest.approx(0.8, abs=0.03)


def test_stripes_repeat_along_themselves():
    """Nothing tells places along a stripe apart."""
    stripes = np.broadcast_to(white(2, (120, 1)), (120, 160)).copy()
    assert repetition(stripes, WHOLE) > 0.99


def test_a_period_beyond_the_view_does_not_show():
    assert repetition(tiled(100, 140), WHOLE) < 0.2


def test_masked_pixels_have_no_say():
    mask = WHOLE.copy()
    mask[:, 80:] = False
    picture = tiled(25, 25)
    spoilt = picture.copy()
    spoilt[:, 80:] = white(3)[:, 80:]
    assert repetition(spoilt, mask) > 0.99
    half_random = white(4)
    half_random[:, 80:] = picture[:, 80:]
    assert repetition(half_random, mask) < 0.12


def test_a_large_view_is_worked_on_small():
    """A megapixel takes milliseconds and tells the same."""
    small = tiled(30, 40, shape=(120, 160))
    large = np.kron(small, np.ones((6, 6), dtype=np.float32))
    assert repetition(large, np.ones(large.shape, np.bool_)) > 0.98


def test_a_blank_or_masked_view_does_not_repeat():
    assert repetition(np.zeros((120, 160), np.float32), WHOLE) == 0.0
    assert repetition(white(), np.zeros_like(WHOLE)) == 0.0
    assert repetition(white(0, (3, 4)), np.ones((3, 4), np.bool_)) <= 1.0


@pytest.mark.parametrize(("floor", "repeats"), [("tiles", True), ("speckle", False)])
@pytest.mark.parametrize("tilt_deg", [33.0, 50.0])
def test_floors_are_told_apart_by_one_view(floor, repeats, tilt_deg):
    # Seen: tiles 0.94 and above, speckle 0.10 and below.
    frame = photo(camera(tilt_deg), Se2(0.1, 0.2, 0.7), floor, FrameId("R", int(tilt_deg)))
    found = features_of(frame).repetition
    assert (found > REPEATS + 0.2) if repeats else (found < REPEATS - 0.2)
