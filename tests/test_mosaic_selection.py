"""The paper's discard-half rule, against a plain reading of it, and the mean that follows."""

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from plain_selection import agreeing_views, combined, discard_half

levels = st.integers(0, 510)
colour = st.tuples(levels, levels, levels)
few_levels = st.tuples(*[st.integers(0, 2)] * 3)
footprints = st.integers(1, 3)


def views(colours):
    """A cell of views: colours (n, 3) and footprints of 1 to 3."""
    return st.lists(st.tuples(colours, footprints), min_size=1, max_size=16)


def read_literally(cell):
    """Discard the view farthest from the mean of those left, until half are gone."""
    left = list(range(len(cell)))
    while len(left) > len(cell) - len(cell) // 2:
        mean = [Fraction(sum(cell[k][0][c] for k in left), len(left)) for c in range(3)]

        def rank(k, mean=mean):
            away = sum(
                (value - middle) ** 2 for value, middle in zip(cell[k][0], mean, strict=True)
            )
            return away, cell[k][1], k

        left.remove(max(left, key=rank))
    return left


def arrays(cell):
    colours = np.array([c for c, _ in cell], dtype=np.float32)[:, :, None]
    return colours, np.array([[f] for _, f in cell], dtype=np.float32)


@given(st.one_of(views(colour), views(few_levels)))
def test_discard_half_is_the_paper_rule_with_its_ties(cell):
    colours, footprint = arrays(cell)
    alive = discard_half(colours, footprint)
    assert np.flatnonzero(alive[:, 0]).tolist() == read_literally(cell)


@given(st.lists(views(few_levels), min_size=2, max_size=6).filter(lambda c: len(c[0]) >= 1))
def test_cells_do_not_touch_each_other(cells):
    fewest = min(len(cell) for cell in cells)
    stacked = [arrays(cell[:fewest]) for cell in cells]
    colours = np.concatenate([c for c, _ in stacked], axis=2)
    footprint = np.concatenate([f for _, f in stacked], axis=1)
    together = discard_half(colours, footprint)
    apart = np.concatenate([discard_half(c, f) for c, f in stacked], axis=1)
    assert (together == apart).all()


def test_free_floor_averages_all_views_and_an_obstacle_is_left_out():
    rng = np.random.default_rng(2)
    colours = np.rint(rng.normal(200.0, 4.0, (9, 3, 4000))).astype(np.float32)
    footprint = np.ones((9, 4000), np.float32)
    alive = discard_half(colours, footprint)
    # 3 sigma in the root mean square of three channels: 1 in 10,000 is outside, and `noise` is a
    # lower bound of sigma.
    assert agreeing_views(colours, alive, 4.0, 3.0).mean() > 0.999
    colours[[1, 4, 6]] += 60.0
    alive = discard_half(colours, footprint)
    agreeing = agreeing_views(colours, alive, 4.0, 3.0)
    assert not agreeing[[1, 4, 6]].any()
    assert agreeing[[0, 2, 3, 5, 7, 8]].mean() > 0.999


def test_mean_of_agreeing_views_is_less_noisy_than_the_surviving_half():
    rng = np.random.default_rng(3)
    grey = rng.normal(200.0, 4.0, (8, 1, 20_000)) * np.ones((1, 3, 1))
    colours, ones = np.rint(grey).astype(np.float32), np.ones((8, 20_000), np.float32)
    floor = combined(colours, ones, ones, 4.0, 3.0)
    alive = discard_half(colours, ones)
    half = (colours * alive[:, None]).sum(axis=0) / 4
    # The mean of 8 has 4 / sqrt(8) = 1.41; the surviving half about 4 sqrt(0.39) = 2.5.
    assert floor.std() < 1.55
    assert half.std() > 2.2


def test_weights_count_and_two_views_are_averaged():
    colours = np.array([[100.0] * 3, [200.0] * 3], np.float32)[:, :, None]
    footprint = np.ones((2, 1), np.float32)
    weight = np.array([[3.0], [1.0]], np.float32)
    assert combined(colours, footprint, weight, 4.0, 3.0).tolist() == [[125.0]] * 3


def test_spread_of_the_half_widens_the_limit():
    colours = np.array([0.0, 40.0, 80.0, 120.0, 160.0], np.float32)[:, None, None]
    colours = np.repeat(colours, 3, axis=1)
    alive = np.array([[False, True, True, True, False]]).T
    assert agreeing_views(colours, alive, 1.0, 3.0).all()
    assert agreeing_views(colours, alive, 1.0, 0.5)[:, 0].tolist() == alive[:, 0].tolist()


def test_limit_allows_for_the_noise_of_the_mean_itself():
    # Two survivors: their mean has half a view's variance, so sigma is sqrt(1.5) of the noise.
    limit = 3.0 * 4.0 * np.sqrt(1.5)
    colours = np.zeros((4, 3, 2), np.float32)
    colours[3] = [limit * 0.999, limit * 1.001]
    alive = np.array([[True] * 2, [True] * 2, [False] * 2, [False] * 2])
    assert agreeing_views(colours, alive, 4.0, 3.0)[3].tolist() == [True, False]
