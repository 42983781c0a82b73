"""The pair fit: exact without noise, honest covariance, indifferent to scale, order, start."""

import dataclasses
import math

import numpy as np
import pytest
from floor_pairs import (
    HALF_VIEW,
    RAY_SIGMA,
    drawn,
    error_of,
    geometric_pair,
    nees,
    prior,
    seen_by_both,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from groundfuse.backend.measurement import IDENTITY, Attitude, Correspondences, Se2
from groundfuse.frontend.fit import FitOptions, Prior, fit_pair
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor

WIDE_VIEW = np.array([3.0, 3.0])  # rays up to 72 deg off the axis: views that overlap at any turn

motions = st.builds(Se2, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-math.pi, math.pi))
tilts = st.floats(-50.0, 50.0)

# The fit stops after a step of a hundredth of a sigma, 5e-6 m; what is left is its square over the
# height, 5e-11 m. Worst seen over 300 draws 1.5e-15 (the last step is shorter by far).
EXACT = 1e-9


@given(motions, tilts, tilts, st.integers(0, 2**16))
@settings(max_examples=20)
def test_exact_without_noise(truth, tilt_a_deg, tilt_b_deg, seed):
    """Any motion, any tilts, from a start centimetres and degrees away."""
    priors = prior(tilt_a_deg, 0.55, roll_deg=1.5), prior(tilt_b_deg, 0.8)
    rng = np.random.default_rng(seed)
    pair = geometric_pair(
        rng, truth, priors, noise=0.0, wobbling=False, half_view=WIDE_VIEW, count=60
    )
    found = pair.fit(truth @ Se2(*rng.uniform(-0.03, 0.03, 3)))
    np.testing.assert_allclose(error_of(found.a_from_b, truth), 0.0, atol=EXACT)
    assert found.inliers.all()
    assert found.converged
    assert found.attitude_chi2 < 1e-9


@pytest.mark.parametrize(
    ("motion", "tilt_deg"),
    [
        (Se2(0.2, 0.0, 0.0), 33.0),
        (Se2(0.2, 0.05, 0.0), 0.0),
        (Se2(0.0, 0.0, 0.3), 33.0),
        (Se2(0.0, 0.0, 0.6), 0.0),
        (Se2(0.0, 0.0, math.pi), 0.0),
        (IDENTITY, 33.0),
        (IDENTITY, 0.0),
    ],
    ids=["straight", "nadir_straight", "turn", "nadir_turn", "nadir_about", "none", "nadir_none"],
)
def test_degenerate_motions_are_not_degenerate_for_the_fit(motion, tilt_deg):
    """The closed form divides by sin theta and sin tilt; the fit must not care."""
    rng = np.random.default_rng(3)
    priors = prior(tilt_deg), prior(tilt_deg)
    exact = geometric_pair(rng, motion, priors, noise=0.0, wobbling=False)
    found = exact.fit(motion @ Se2(0.02, -0.01, 0.02))
    np.testing.assert_allclose(error_of(found.a_from_b, motion), 0.0, atol=EXACT)
    scores = []
    for _ in range(8):
        fit = geometric_pair(rng, motion, priors).fit()
        assert fit.converged
        assert np.linalg.eigvalsh(fit.covariance)[0] > 0.0
        scores.append(nees(fit.a_from_b, fit.covariance, motion))
    assert sum(scores) < stats.chi2.ppf(0.9999, 3 * len(scores))


@pytest.mark.parametrize("noise", [0.5, 1.0, 2.0])
def test_covariance_is_honest(noise):
    """Wobble by the prior, noise by sigma (or a multiple, which the fit must find out)."""
    rng = np.random.default_rng([5, int(10 * noise)])
    scores, scatter, seen = [], [], []
    for _ in range(70):
        truth = Se2(*rng.uniform([-0.15, -0.15, -0.6], [0.25, 0.15, 0.6]))
        pair = geometric_pair(rng, truth, (prior(33.0), prior(45.0)), noise=noise, count=80)
        fit = pair.fit(truth @ Se2(*rng.normal(0.0, 0.01, 3)))
        assert fit.converged
        scores.append(nees(fit.a_from_b, fit.covariance, truth))
        error = error_of(fit.a_from_b, truth)
        scatter.append(np.linalg.solve(np.linalg.cholesky(fit.covariance), error))
        seen.append(fit.noise)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(scores))
    assert low < sum(scores) < high
    # No bias: a fit that whitens on the floor shrinks the height and with it every motion.
    assert np.abs(np.mean(scatter, axis=0)).max() < 4.0 / math.sqrt(len(scatter))
    # 160 coordinates less 3 parameters: 6 % each, 0.7 % for 70 of them; worst seen 1 %.
    assert np.mean(seen) == pytest.approx(noise, rel=0.03)


def test_the_noise_is_never_believed_to_be_nothing():
    pair = geometric_pair(
        np.random.default_rng(1), Se2(0.1, 0.0, 0.1), (prior(), prior()), noise=0.0
    )
    assert pair.fit(options=FitOptions(min_noise=0.4)).noise == 0.4


def test_wide_priors_are_filled_in_by_the_data():
    """8 deg and 6 % of wobble, as a drone has: still honest."""
    rng = np.random.default_rng(9)
    scores = []
    for _ in range(40):
        truth = Se2(*rng.uniform([-0.1, -0.1, -0.4], [0.15, 0.1, 0.4]))
        priors = prior(15.0, factor=16.0), prior(15.0, factor=16.0)
        pair = geometric_pair(rng, truth, priors, count=80)
        fit = pair.fit(truth @ Se2(*rng.normal(0.0, 0.03, 3)))
        scores.append(nees(fit.a_from_b, fit.covariance, truth))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(scores))
    assert low < sum(scores) < high


def test_attitudes_are_found_where_the_pair_shows_them():
    """The fitted attitudes of a wide prior are far nearer to the truth than the prior was."""
    rng = np.random.default_rng(2)
    before, after = [], []
    for _ in range(20):
        priors = prior(30.0, factor=8.0), prior(30.0, factor=8.0)
        pair = geometric_pair(rng, Se2(0.2, 0.1, 0.3), priors)
        fit = pair.fit()
        true_a, true_b = pair.attitudes
        # The sum of both tilts hardly shows; their difference does.
        wanted = true_b.tilt_rad - true_a.tilt_rad
        before.append(wanted)
        after.append(wanted - (fit.attitude_b.tilt_rad - fit.attitude_a.tilt_rad))
    assert np.std(after) < 0.1 * np.std(before)


def test_attitude_chi2_measures_both_attitudes():
    pair = geometric_pair(np.random.default_rng(4), Se2(0.1, 0.05, 0.2), (prior(), prior(45.0)))
    fit = pair.fit()
    total = 0.0
    for found, known in zip((fit.attitude_a, fit.attitude_b), pair.priors, strict=True):
        for name in ("tilt_rad", "roll_rad", "height_m"):
            pull = getattr(found, name) - getattr(known.mean, name)
            total += (pull / getattr(known.sigma, name)) ** 2
    assert fit.attitude_chi2 == pytest.approx(total)
    assert total > 0.1


def test_wrong_matches_change_nothing():
    """Three in ten wrong: the same motion as without them, and none of them is an inlier."""
    rng = np.random.default_rng(6)
    scores = []
    for _ in range(15):
        truth = Se2(*rng.uniform([-0.1, -0.1, -0.4], [0.2, 0.1, 0.4]))
        pair = geometric_pair(rng, truth, (prior(33.0), prior(45.0)), count=150, wrong=45)
        fit = pair.fit(truth @ Se2(*rng.normal(0.0, 0.01, 3)))
        scores.append(nees(fit.a_from_b, fit.covariance, truth))
        # By chance a wrong match may land within the gate: 12 px^2 of 320 x 240 for 45 of them.
        assert fit.inliers[105:].sum() <= 1
        assert fit.inliers[:105].mean() > 0.95
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(scores))
    assert low < sum(scores) < high


def test_points_behind_a_camera_are_no_inliers_and_do_no_harm():
    pair = geometric_pair(np.random.default_rng(7), Se2(0.1, 0.0, 0.2), (prior(), prior()))
    rays_a = pair.points.rays_a.copy()
    rays_a[:5] = [0.0, -2.5]  # above the horizon: a floor point there is behind the camera
    assert np.isnan(floor_from_rays(pair.priors[0].mean, rays_a[:5])).all()
    points = dataclasses.replace(pair.points, rays_a=rays_a)
    fit = dataclasses.replace(pair, points=points).fit()
    assert not fit.inliers[:5].any()
    rest = Correspondences(rays_a[5:], points.rays_b[5:], points.sigma_a[5:], points.sigma_b[5:])
    without = dataclasses.replace(pair, points=rest).fit()
    # The median over five more changes the annealed scale a little: worst seen 0.03 sigma.
    change = error_of(fit.a_from_b, without.a_from_b)
    assert change @ np.linalg.solve(fit.covariance, change) < 0.3**2


def test_one_point_leaves_the_motion_open():
    pair = geometric_pair(np.random.default_rng(8), Se2(0.1, 0.0, 0.2), (prior(), prior()))
    p = pair.points
    one = Correspondences(p.rays_a[:1], p.rays_b[:1], p.sigma_a[:1], p.sigma_b[:1])
    fit = dataclasses.replace(pair, points=one).fit()
    assert np.linalg.eigvalsh(fit.covariance)[-1] > 100.0


# Both directions whiten in their own picture: equal to first order only. Worst seen over 100 seeds
# a quarter of a sigma and 4 %; a match at the gate may be in one way and out the other.
SWAPPED_SIGMAS, SWAPPED_RATIO = 0.3, 1.15


@pytest.mark.parametrize("seed", range(8))
def test_swapping_the_views_inverts_the_motion(seed):
    rng = np.random.default_rng([20, seed])
    truth = Se2(*rng.uniform([-0.1, -0.1, -0.6], [0.2, 0.1, 0.6]))
    pair = geometric_pair(rng, truth, (prior(30.0), prior(40.0, 0.7, roll_deg=2.0)))
    there, back = pair.fit(), pair.swapped().fit()
    change = error_of(there.a_from_b, back.a_from_b.inverse())
    assert change @ np.linalg.solve(there.covariance, change) < SWAPPED_SIGMAS**2
    adjoint = back.a_from_b.adjoint()
    turned = adjoint @ back.covariance @ adjoint.T
    ratio = np.linalg.eigvals(np.linalg.solve(there.covariance, turned)).real
    assert 1.0 / SWAPPED_RATIO < ratio.min() <= ratio.max() < SWAPPED_RATIO
    for one, other in ((back.attitude_a, there.attitude_b), (back.attitude_b, there.attitude_a)):
        assert one.tilt_rad == pytest.approx(other.tilt_rad, abs=math.radians(0.05))
        assert one.height_m == pytest.approx(other.height_m, abs=0.0005)


@given(st.sampled_from([0.1, 3.0, 70.0]), st.integers(0, 2**16))
@settings(max_examples=15)
def test_metres_scale_with_the_height(height_m, seed):
    """The same pictures under a camera k times higher: the motion k times as long, no more."""
    k = height_m / 0.55
    truth = Se2(0.1, -0.05, 0.3)
    start = truth @ Se2(0.01, 0.01, 0.01)
    low = geometric_pair(np.random.default_rng(seed), truth, (prior(33.0), prior(45.0)))
    a, b = prior(33.0, height_m), prior(45.0, height_m)
    high = fit_pair(
        low.points, Se2(k * start.x_m, k * start.y_m, start.theta_rad), a, b, FitOptions()
    )
    small = low.fit(start)
    scale = np.array([k, k, 1.0])
    # Both stop within a hundredth of a sigma of their optimum; worst seen 2e-4 sigma.
    got = (high.a_from_b.vector() / scale) - small.a_from_b.vector()
    assert got @ np.linalg.solve(small.covariance, got) < 0.01**2
    np.testing.assert_allclose(
        high.covariance, small.covariance * np.outer(scale, scale), rtol=1e-3
    )
    np.testing.assert_array_equal(high.inliers, small.inliers)


def test_covariance_is_the_marginal_of_the_dense_numeric_hessian():
    """All nine parameters by finite differences through `overhead`, inverted, motion's block."""
    rng = np.random.default_rng(12)
    pair = geometric_pair(rng, Se2(0.12, -0.03, 0.25), (prior(33.0, roll_deg=2.0), prior(45.0)))
    fit = pair.fit()
    points, keep = pair.points, fit.inliers

    def predicted(change, rays_a):
        a, b = fit.attitude_a, fit.attitude_b
        pose = fit.a_from_b @ Se2(*change[:3])
        attitude_a = Attitude(
            a.tilt_rad + change[3], a.roll_rad + change[4], a.height_m + change[5]
        )
        attitude_b = Attitude(
            b.tilt_rad + change[6], b.roll_rad + change[7], b.height_m + change[8]
        )
        floor = floor_from_rays(attitude_a, rays_a)
        return rays_from_floor(attitude_b, pose.inverse().apply(floor))

    step, rays_a = 1e-6, points.rays_a[keep]
    none = np.zeros(9)
    by_parameters = np.stack(
        [
            (predicted(step * u, rays_a) - predicted(-step * u, rays_a)) / (2 * step)
            for u in np.eye(9)
        ],
        axis=2,
    )
    by_ray = np.stack(
        [
            (predicted(none, rays_a + step * u) - predicted(none, rays_a - step * u)) / (2 * step)
            for u in np.eye(2)
        ],
        axis=2,
    )
    hessian = np.zeros((9, 9))
    for k, (sigma_a, sigma_b) in enumerate(
        zip(points.sigma_a[keep], points.sigma_b[keep], strict=True)
    ):
        spread = sigma_a**2 * by_ray[k] @ by_ray[k].T + sigma_b**2 * np.eye(2)
        j = by_parameters[k]
        hessian += j.T @ np.linalg.solve(spread, j) / fit.noise**2
    for offset, known in zip((3, 6), pair.priors, strict=True):
        sigma = np.array([known.sigma.tilt_rad, known.sigma.roll_rad, known.sigma.height_m])
        hessian[offset : offset + 3, offset : offset + 3] += np.diag(sigma**-2)
    marginal = np.linalg.inv(hessian)[:3, :3]
    held = np.linalg.inv(hessian[:3, :3])
    # The whitening is frozen shortly before the end; worst seen 1.2e-4 of a sigma times a sigma.
    sigma = np.sqrt(np.diag(marginal))
    np.testing.assert_allclose(
        fit.covariance / np.outer(sigma, sigma), marginal / np.outer(sigma, sigma), atol=1e-3
    )
    # The truth of the marginal matters: attitudes held fixed would claim far more.
    assert np.trace(marginal[:2, :2]) > 5.0 * np.trace(held[:2, :2])


def test_a_fit_that_may_not_move_says_that_it_has_not_converged():
    priors = prior(), prior()
    pair = geometric_pair(np.random.default_rng(13), Se2(0.1, 0.0, 0.2), priors)
    hasty = FitOptions(robust_iterations=1, final_iterations=1)
    assert not pair.fit(pair.truth @ Se2(0.1, -0.1, 0.2), hasty).converged
    assert pair.fit(pair.truth @ Se2(0.1, -0.1, 0.2)).converged


def test_attitude_error_goes_to_chi2_not_to_the_motion():
    """A frame ten sigmas off its prior is not explained away."""
    rng = np.random.default_rng(14)
    known = prior(33.0), prior(33.0)
    off = Prior(
        Attitude(known[0].mean.tilt_rad + 10.0 * known[0].sigma.tilt_rad, 0.0, 0.55),
        known[0].sigma,
    )
    attitudes = off.mean, drawn(known[1], rng)
    truth = Se2(0.1, 0.02, 0.2)
    rays_a, rays_b = seen_by_both(rng, truth, attitudes, 120, HALF_VIEW)
    sigma = np.full(120, RAY_SIGMA)
    fit = fit_pair(Correspondences(rays_a, rays_b, sigma, sigma), truth, *known, FitOptions())
    assert fit.attitude_chi2 > 33.0
