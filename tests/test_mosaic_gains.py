"""Exposure and vignetting are found from shared floor, whatever stands on it."""

import os

import numpy as np
from analytic_floor import centres, make_camera, ring, rounded, view_of, waves

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend import gains
from groundfuse.frontend.gains import (
    Samples,
    estimate_exposure,
    neutral_exposure,
    radius_squared,
)
from groundfuse.frontend.gains_compiled import differences, distances
from groundfuse.frontend.mosaic import MosaicOptions, build_mosaic

# Samples are good to 2 % each, some 300 per view; 20 % of them are of obstacles.
TOLERANCE_LOG_GAIN = 0.015
VIEWS, CELLS = 12, 1500


def made_samples(rng, gain, falloff, noise=0.02, obstacles=0.2):
    """Views of random subsets of cells; view k of lens k % 2."""
    floor = rng.uniform(3.5, 4.8, (CELLS, 3))
    cell, view = np.nonzero(rng.random((CELLS, VIEWS)) < 0.25)
    radius2 = rng.random(len(cell))
    powers = radius2[:, None] ** np.array([1, 2, 3])
    log = floor[cell] + gain[view] + (powers * falloff[view % 2]).sum(axis=1)[:, None]
    log += rng.normal(0, noise, log.shape)
    spoiled = rng.random(len(cell)) < obstacles
    log[spoiled] += rng.uniform(-1.0, 1.0, (spoiled.sum(), 3))
    colour = np.exp(log)
    return Samples(cell, view, radius2, colour, colour)


def test_gains_and_falloffs_are_found_among_obstacles():
    rng = np.random.default_rng(4)
    gain = rng.normal(0, 0.15, (VIEWS, 3))
    gain -= gain.mean(axis=0)
    falloff = np.array([[-0.3, -0.1, 0.0], [-0.1, 0.0, -0.2]])
    samples = made_samples(rng, gain, falloff)
    found = estimate_exposure(samples, np.arange(VIEWS) % 2)
    # The floor's own brightness is free: only differences between views are known.
    error = found.log_gain - gain
    assert np.abs(error - error.mean(axis=0)).max() < TOLERANCE_LOG_GAIN
    radius2 = np.linspace(0, 1, 11)
    for lens in (0, 1):
        expected = radius2[:, None] ** np.array([1, 2, 3]) @ falloff[lens]
        shape = radius2[:, None] ** np.array([1, 2, 3]) @ found.falloff[lens]
        # A constant may hide in the gains of all views of a lens.
        difference = shape - expected
        assert np.abs(difference - difference.mean()).max() < 2 * TOLERANCE_LOG_GAIN


def test_the_solution_is_that_of_least_squares_with_every_cells_colour():
    """The last view and its lens share no floor; nothing is eliminated, there are two priors."""
    rng = np.random.default_rng(8)
    samples = made_samples(rng, rng.normal(0, 0.2, (VIEWS, 3)), rng.normal(0, 0.2, (2, 3)))
    order = np.argsort(samples.cell, kind="stable")[:400]
    order = order[samples.view[order] < VIEWS - 1]
    lens_of_view = np.append(np.arange(VIEWS - 1) % 2, 2)
    view, lens = samples.view[order], samples.view[order] % 2
    _, cell, number = np.unique(samples.cell[order], return_inverse=True, return_counts=True)
    values, radius2 = np.log(samples.colour[order]), samples.radius2[order]
    weight = rng.uniform(0.1, 1.0, len(view))
    gain, falloff = gains._solve(gains._floor(samples, order, number, lens_of_view), weight)

    size = VIEWS + 9 + len(number)
    design = np.zeros((len(view), size))
    rows = np.arange(len(view))
    design[rows, view] = 1.0
    design[rows, VIEWS + 9 + cell] = 1.0
    for i in range(3):
        design[rows, VIEWS + 3 * lens + i] = radius2 ** (i + 1)
    prior = np.zeros(size)
    prior[:VIEWS] = gains.GAIN_PRIOR * np.maximum(np.bincount(view, weight, VIEWS), 1.0)
    prior[VIEWS : VIEWS + 9] = gains.FALLOFF_PRIOR
    normal = design.T @ (weight[:, None] * design) + np.diag(prior)
    mean = np.linalg.solve(normal, design.T @ (weight * values.mean(axis=1)))
    expected = mean[VIEWS : VIEWS + 9].reshape(3, 3)
    # Two ways of elimination, of a matrix whose condition is about 1e5: 1e5 x 2.2e-16 x 20.
    np.testing.assert_allclose(falloff, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(gain.mean(axis=1), mean[:VIEWS], rtol=0.0, atol=1e-9)
    fall = design[:, VIEWS : VIEWS + 9] @ expected.ravel()
    others = np.r_[:VIEWS, VIEWS + 9 : size]
    right = design[:, others].T @ (weight[:, None] * (values - fall[:, None]))
    each = np.linalg.solve(normal[np.ix_(others, others)], right)
    np.testing.assert_allclose(gain, each[:VIEWS], rtol=0.0, atol=1e-9)


def test_the_order_of_the_samples_does_not_matter():
    rng = np.random.default_rng(10)
    samples = made_samples(rng, rng.normal(0, 0.2, (VIEWS, 3)), rng.normal(0, 0.2, (2, 3)))
    order = rng.permutation(len(samples.cell))
    parts = (samples.cell, samples.view, samples.radius2, samples.colour, samples.point)
    mixed = Samples(*(part[order] for part in parts))
    lens_of_view = np.arange(VIEWS) % 2
    expected, found = (estimate_exposure(each, lens_of_view) for each in (samples, mixed))
    np.testing.assert_array_equal(found.log_gain, expected.log_gain)
    np.testing.assert_array_equal(found.falloff, expected.falloff)
    assert found.noise_levels == expected.noise_levels


def test_the_number_of_cores_does_not_matter(monkeypatch):
    rng, views = np.random.default_rng(11), 300
    cell, view = np.nonzero(rng.random((CELLS, views)) < 0.02)
    colour = rng.uniform(30.0, 200.0, (len(cell), 3))
    samples = Samples(cell, view, rng.random(len(cell)), colour, colour)
    lens_of_view, found = np.arange(views) // 100, []
    for cores in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        found.append(estimate_exposure(samples, lens_of_view))
    np.testing.assert_array_equal(found[0].log_gain, found[1].log_gain)
    np.testing.assert_array_equal(found[0].falloff, found[1].falloff)


def test_distances_are_from_the_weighted_mean_of_a_cell():
    rng = np.random.default_rng(9)
    view, lens = np.arange(20) % 5, np.arange(20) % 5 % 2
    radius2, values = rng.random(20), rng.normal(0, 1, (20, 3))
    weight, gain, falloff = rng.uniform(0.1, 1, 20), rng.normal(0, 1, (5, 3)), rng.random((2, 3))
    found = np.empty(20)
    begins = np.array([0, 2, 7, 20])
    distances((view, lens, radius2, values), begins, weight, gain, falloff, found)
    fall = (falloff[lens] * radius2[:, None] ** np.array([1, 2, 3])).sum(axis=1)
    rest = values - gain[view] - fall[:, None]
    for part in np.split(np.arange(20), begins[1:-1]):
        away = rest[part] - np.average(rest[part], axis=0, weights=weight[part])
        np.testing.assert_allclose(found[part], np.sqrt((away**2).mean(axis=1)), rtol=1e-12)


def test_noise_is_that_of_one_view():
    rng = np.random.default_rng(5)
    none = np.zeros((VIEWS, 3))
    samples = made_samples(rng, none, np.zeros((2, 3)), noise=0.0, obstacles=0.1)
    point = np.full_like(samples.colour, 100.0) + rng.normal(0, 6.0, samples.colour.shape)
    samples = Samples(samples.cell, samples.view, samples.radius2, samples.colour, point)
    found = estimate_exposure(samples, np.arange(VIEWS) % 2)
    assert 5.5 < found.noise_levels < 6.5


def test_differences_are_between_evenly_exposed_views_of_a_cell():
    """All of them in one go, and the last two cells' in a go of their own."""
    rng = np.random.default_rng(6)
    begins = np.array([0, 3, 5, 9], np.uint32)
    view, lens = rng.integers(0, 4, 9).astype(np.uint32), rng.integers(0, 2, 9).astype(np.uint32)
    radius2, point = rng.random(9), rng.uniform(10.0, 200.0, (9, 3))
    gain, falloff = rng.normal(0, 0.2, (4, 3)), rng.normal(0, 0.2, (2, 3))
    powers = radius2[:, None] ** np.array([1, 2, 3])
    even = point / np.exp(gain[view] + (powers * falloff[lens]).sum(axis=1)[:, None])
    expected = np.abs(np.vstack([np.diff(part, axis=0) for part in np.split(even, [3, 5])]))
    seen = view, lens, radius2, np.zeros((9, 3))
    for first in (0, 1):
        found = np.full((6, 3), -1.0)
        differences(seen, (first, begins[first:]), point, np.exp(-gain), falloff, found)
        untouched = 2 * first
        assert (found[:untouched] == -1.0).all()
        np.testing.assert_allclose(found[untouched:], expected[untouched:], rtol=1e-12)


def test_views_that_share_nothing_stay_as_they_are():
    samples = Samples(
        np.arange(50), np.arange(50) % 2, np.zeros(50), np.full((50, 3), 90.0), np.zeros((50, 3))
    )
    found = estimate_exposure(samples, np.array([0, 0]))
    assert (found.log_gain == 0.0).all()
    assert (found.falloff == 0.0).all()
    assert found.noise_levels == neutral_exposure(2).noise_levels


def test_radius_is_one_half_diagonal_from_the_principal_point():
    lens = make_camera().intrinsics
    px = np.array([[lens.cx_px, lens.cy_px], [lens.cx_px + 60.0, lens.cy_px - 80.0]])
    # 160 x 120: half a diagonal is 100.
    np.testing.assert_allclose(radius_squared(lens, px), [0.0, 1.0], atol=1e-12)


def test_patchwork_goes_and_the_floor_stays():
    camera = make_camera(15.0)
    length = 60 * 0.55 / camera.intrinsics.focal_px

    def colour(points):
        return waves(points, length)

    lens = camera.intrinsics
    v, u = np.mgrid[0:120, 0:160]
    radius2 = radius_squared(lens, np.stack([u, v], axis=-1).astype(float))[..., None]
    rng = np.random.default_rng(6)
    gains = np.exp(rng.normal(0, 0.12, (8, 1, 1, 3)))
    views = [
        view_of(frame, camera, pose, rounded(image * gains[i] * np.exp(-0.35 * radius2)))
        for i, (frame, pose, image) in enumerate(ring(8, camera, colour))
    ]

    def deviation(options):
        mosaic = build_mosaic(views, options)
        inner = mosaic.count >= 2
        ratio = mosaic.floor[inner] / colour(centres(mosaic)[inner])
        return (ratio / ratio.mean(axis=0)).std()

    raw, evened = deviation(MosaicOptions(compensate=False)), deviation(MosaicOptions())
    assert raw > 0.04
    assert evened < 0.012  # rounding is 0.4 / 130, the rest is gains; worst seen 0.008


def test_dark_and_cut_off_values_do_not_vote():
    camera = make_camera(0.0)
    grey = np.full((120, 160, 3), 100, np.uint8)
    cut_off = np.full((120, 160, 3), 255, np.uint8)
    cut_off[:, :80] = 150
    views = [
        view_of(FrameId("A", 0), camera, Se2(0, 0, 0), grey),
        view_of(FrameId("A", 1), camera, Se2(0, 0, 0), cut_off),
    ]
    mosaic = build_mosaic(views)
    both = mosaic.count == 2
    # The uncut half says 1.5 between the views, shared about evenly: sqrt(1.5) x 100.
    uncut = np.abs(mosaic.floor[both].astype(int) - 122) <= 3
    assert uncut.mean() > 0.48
