"""Floors: endless, seamless, never repeating unless they should."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.tools.floors import FLOORS, TILE, make_floor
from groundfuse.tools.noise import Rect, smooth, uniform, white


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
@settings(max_examples=20)
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
