"""Simulated cities: as large as asked for, on streets, measured with the noise that is stated."""

import numpy as np
import pytest

from groundfuse.backend import planar
from groundfuse.backend.problem import chi2, components, residuals
from groundfuse.tools.simulate_grid import MIN_GAP, GridShape, simulate_grid

SHAPE = GridShape(poses=2000, edges=4000)


def drawn(seed=0, shape=SHAPE):
    return simulate_grid(shape, np.random.default_rng(seed))


def test_it_has_the_size_asked_for_and_hangs_together():
    graph, truth = drawn()
    assert (graph.num_poses, len(graph), truth.shape) == (2000, 4000, (2000, 3))
    assert not components(graph).any()
    assert not truth[0].any()


def test_it_drives_along_streets_and_turns_at_crossings():
    _, truth = drawn()
    step = planar.between(truth[:-1], truth[1:])
    # A step is taken in the old heading, then the heading is that of the next.
    assert np.hypot(step[:, 0], step[:, 1]) == pytest.approx(1.0, abs=1e-9)
    assert np.abs(step[:, 1]).max() < 1e-9
    turns = np.abs(step[:, 2]) / (np.pi / 2)
    assert np.abs(turns - np.round(turns)).max() < 1e-9
    assert 0.01 < (turns > 0.5).mean() < 0.2


def test_loops_join_near_poses_and_no_pair_twice():
    graph, truth = drawn()
    loop = graph.b - graph.a > 1
    assert loop.sum() == 4000 - 1999
    assert (graph.b - graph.a)[loop].min() > MIN_GAP
    apart = planar.between(truth[graph.a], truth[graph.b])[loop]
    assert np.hypot(apart[:, 0], apart[:, 1]).max() <= 1.5 + 1e-9
    assert len(np.unique(graph.a * 2000 + graph.b)) == 4000


def test_the_noise_is_as_stated():
    graph, truth = drawn()
    # Means of 4000 squares: 1 +- 5 sqrt(2 / 4000).
    sigma = np.sqrt((residuals(graph, truth) ** 2).mean(axis=0))
    assert sigma == pytest.approx([0.05, 0.05, 0.01], rel=0.06)
    assert chi2(graph, truth) == pytest.approx(12_000, rel=0.07)


def test_seeds_decide():
    one, two, other = drawn(1)[0], drawn(1)[0], drawn(2)[0]
    assert np.array_equal(one.a_from_b, two.a_from_b)
    assert not np.array_equal(one.a_from_b, other.a_from_b)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="2000 poses need 1999 steps, got 100"):
        drawn(0, GridShape(poses=2000, edges=100))
    with pytest.raises(ValueError, match=r"97991 loops asked for, only \d+ pairs"):
        drawn(0, GridShape(poses=2010, edges=100_000))
