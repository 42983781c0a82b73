"""From matches to a motion of the base: every way to be turned down, and honest mounts."""

import dataclasses
import math

import numpy as np
import pytest
from floor_pairs import RAY_SIGMA, camera, error_of, geometric_pair, nees, prior
from scipy import stats

from groundfuse.backend.measurement import (
    IDENTITY,
    Attitude,
    Correspondences,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
)
from groundfuse.frontend import motion
from groundfuse.frontend.fit import FitOptions, Prior
from groundfuse.frontend.matches import Matches, Miss
from groundfuse.frontend.motion import MotionOptions, View, relative_pose
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.photometric import Alignment, GreyView

A, B = FrameId("A", 3), FrameId("B", 7)
TRUTH = Se2(0.12, -0.03, 0.3)


def views(pair, mounts=(IDENTITY, IDENTITY), greys=(None, None)):
    return tuple(
        View(name, known, mount, grey)
        for name, known, mount, grey in zip((A, B), pair.priors, mounts, greys, strict=True)
    )


def simulated(seed=0, **changes):
    rng = np.random.default_rng([31, seed])
    return geometric_pair(rng, TRUTH, (prior(33.0), prior(45.0)), **changes)


def measured(pair, *, ambiguity=0.1, start=None, options=None, mounts=(IDENTITY, IDENTITY)):
    found = Matches(pair.points, start or pair.truth @ Se2(0.005, -0.005, 0.01), ambiguity)
    return relative_pose(*views(pair, mounts), found, options or MotionOptions())


def refused(result, reason):
    assert isinstance(result, Rejected)
    assert (result.a, result.b, result.reason) == (A, B, reason)
    return result


def test_a_good_pair_is_accepted_with_all_that_belongs_to_it():
    pair = simulated(count=150, wrong=30)
    result = measured(pair, ambiguity=0.25)
    assert isinstance(result, RelativePose)
    assert (result.a, result.b, result.ambiguity) == (A, B, 0.25)
    assert nees(result.a_from_b, result.covariance, TRUTH) < stats.chi2.ppf(0.999, 3)
    kept = result.correspondences
    assert len(kept) == result.num_inliers > 110
    rows = {tuple(r) for r in pair.points.rays_a[:120]}
    assert sum(tuple(r) in rows for r in kept.rays_a) >= len(kept) - 1


def test_the_inliers_carry_the_noise_that_was_found():
    """Twice the noise of the model: sigmas of the kept matches are twice the detector's."""
    pair = simulated(noise=2.0)
    kept = measured(pair).correspondences
    known = {tuple(r): s for r, s in zip(pair.points.rays_b, pair.points.sigma_b, strict=True)}
    factors = [s / known[tuple(r)] for r, s in zip(kept.rays_b, kept.sigma_b, strict=True)]
    np.testing.assert_allclose(factors, factors[0], rtol=1e-12)
    assert factors[0] == pytest.approx(2.0, rel=0.2)  # 240 coordinates: 5 %
    known_a = {tuple(r): s for r, s in zip(pair.points.rays_a, pair.points.sigma_a, strict=True)}
    assert kept.sigma_a[0] / known_a[tuple(kept.rays_a[0])] == pytest.approx(factors[0])


@pytest.mark.parametrize(
    "reason", [Reason.FEW_FEATURES, Reason.FEW_INLIERS, Reason.FEW_CANDIDATES, Reason.DEGENERATE]
)
def test_what_a_matcher_missed_is_passed_on(reason):
    result = relative_pose(*views(simulated()), Miss(reason, 3.0, 20.0), MotionOptions())
    assert (result.value, result.limit) == (3.0, 20.0)
    refused(result, reason)


def test_an_ambiguous_motion_is_turned_down():
    result = refused(measured(simulated(), ambiguity=0.61), Reason.AMBIGUOUS)
    assert (result.value, result.limit) == (0.61, 0.6)
    assert isinstance(measured(simulated(), ambiguity=0.6), RelativePose)


def test_few_matches_are_turned_down_before_the_fit():
    result = refused(measured(simulated(count=11)), Reason.FEW_INLIERS)
    assert (result.value, result.limit) == (11.0, 12.0)


def test_few_inliers_are_turned_down_after_the_fit():
    """Eleven that agree among matches that do not."""
    pair = simulated(count=20, wrong=9, wobbling=False)
    result = refused(measured(pair), Reason.FEW_INLIERS)
    assert 0.0 < result.value < result.limit == 12.0


def test_matches_noisier_than_any_detector_are_turned_down():
    result = refused(measured(simulated(noise=6.0)), Reason.RESIDUAL)
    assert result.value == pytest.approx(6.0, rel=0.25)
    assert result.limit == 4.0


def test_a_camera_that_cannot_have_stood_so_is_turned_down():
    """The right matches of a frame tilted ten sigmas beyond its prior."""
    pair = simulated(noise=0.5)
    a = pair.priors[0]
    far = Attitude(a.mean.tilt_rad - 10.0 * a.sigma.tilt_rad, a.mean.roll_rad, a.mean.height_m)
    wrong = dataclasses.replace(pair, priors=(Prior(far, a.sigma), pair.priors[1]))
    result = refused(measured(wrong), Reason.ATTITUDE)
    assert result.value > result.limit == 33.0


def test_matches_in_one_spot_do_not_tell_the_motion():
    """Plenty of matches, all within a fifth of a millimetre: the heading is anyone's guess."""
    pair = simulated(noise=0.0, wobbling=False)
    a, b = pair.attitudes
    middle = floor_from_rays(a, pair.points.rays_a[:1])
    spot = middle + np.random.default_rng(5).uniform(-2e-4, 2e-4, (20, 2))
    rays_b = rays_from_floor(b, TRUTH.inverse().apply(spot))
    sigma = np.full(20, RAY_SIGMA)
    points = Correspondences(rays_from_floor(a, spot), rays_b, sigma, sigma)
    result = refused(
        measured(dataclasses.replace(pair, points=points), start=TRUTH), Reason.DEGENERATE
    )
    assert result.value > result.limit == 0.1


def test_the_limit_of_the_position_is_in_camera_heights():
    """The same pair at 0.1 m and 70 m is accepted or turned down alike."""
    options = MotionOptions(max_sigma_heights=1e-4)
    pair = simulated()
    values = []
    for k in (0.1 / 0.55, 1.0, 70.0 / 0.55):
        scaled = dataclasses.replace(
            pair,
            truth=Se2(k * TRUTH.x_m, k * TRUTH.y_m, TRUTH.theta_rad),
            priors=tuple(
                Prior(
                    dataclasses.replace(p.mean, height_m=k * p.mean.height_m),
                    dataclasses.replace(p.sigma, height_m=k * p.sigma.height_m),
                )
                for p in pair.priors
            ),
        )
        values.append(refused(measured(scaled, options=options), Reason.DEGENERATE).value)
        assert isinstance(measured(scaled), RelativePose)
    assert values == pytest.approx([values[1]] * 3, rel=1e-3)


def test_a_fit_that_was_cut_short_is_turned_down():
    options = MotionOptions(fit=FitOptions(robust_iterations=2, final_iterations=1), max_noise=1e9)
    pair = simulated(noise=0.0, wobbling=False)
    result = refused(
        measured(pair, start=TRUTH @ Se2(0.05, -0.08, 0.2), options=options), Reason.NOT_CONVERGED
    )
    assert (result.value, result.limit) == (1.0, 0.5)


MOUNTS = (Se2(0.3, -0.1, math.pi / 2), Se2(-0.5, 0.4, -2.0))


def test_mounts_are_honoured():
    """Feet beside the robots, turned: the motion of the bases, exactly."""
    pair = simulated(noise=0.0, wobbling=False)
    result = measured(pair, mounts=MOUNTS)
    mount_a, mount_b = MOUNTS
    wanted = mount_a @ TRUTH @ mount_b.inverse()
    np.testing.assert_allclose(error_of(result.a_from_b, wanted), 0.0, atol=1e-9)


def test_the_covariance_is_that_of_the_base():
    """A foot 0.64 m off the base: an error of the heading swings the base. Honest all the same."""
    mount_a, mount_b = MOUNTS
    wanted = mount_a @ TRUTH @ mount_b.inverse()
    scores, scatter = [], []
    for seed in range(60):
        result = measured(simulated(seed, count=80), mounts=MOUNTS)
        scores.append(nees(result.a_from_b, result.covariance, wanted))
        error = error_of(result.a_from_b, wanted)
        scatter.append(np.linalg.solve(np.linalg.cholesky(result.covariance), error))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(scores))
    assert low < sum(scores) < high
    # Each of the three whitened components by itself: variance 1, +- 18 % for 60 of them.
    np.testing.assert_allclose(np.var(scatter, axis=0), 1.0, atol=0.65)


def blank_views(pair):
    view = GreyView(np.zeros((240, 320), np.float16), camera())
    return views(pair, greys=(view, view))


def light(pair, monkeypatch, alignment):
    """The result with a photometric stage that finds what it is told to."""
    monkeypatch.setattr(motion, "align", lambda *_: alignment)
    found = Matches(pair.points, pair.truth, 0.1)
    return relative_pose(*blank_views(pair), found, MotionOptions())


def found_by_light(change, residual=0.2):
    fit = simulated().fit()
    attitudes = fit.attitude_a, fit.attitude_b
    return Alignment(fit.a_from_b @ change, fit.covariance / 4.0, *attitudes, 500, residual)


def test_light_refines_the_motion(monkeypatch):
    pair = simulated()
    plain = measured(pair)
    shift = Se2(0.0004, 0.0, 0.0)
    refined = light(pair, monkeypatch, found_by_light(shift))
    # Both fits end within a hundredth of a sigma of the same place.
    np.testing.assert_allclose(
        error_of(refined.a_from_b, plain.a_from_b), shift.vector(), atol=2e-5
    )
    np.testing.assert_allclose(refined.covariance, plain.covariance / 4.0, rtol=0.01, atol=1e-9)


@pytest.mark.parametrize(
    "alignment",
    [
        None,
        found_by_light(Se2(0.05, 0.0, 0.0)),
        found_by_light(Se2(0.0, 0.0, 0.05)),
        found_by_light(IDENTITY, residual=1.81),
    ],
    ids=["nothing", "far", "turned", "unlike"],
)
def test_light_that_contradicts_the_features_is_not_believed(monkeypatch, alignment):
    pair = simulated()
    kept, plain = light(pair, monkeypatch, alignment), measured(pair, start=pair.truth)
    assert kept.a_from_b == plain.a_from_b
    np.testing.assert_array_equal(kept.covariance, plain.covariance)


def test_a_view_without_picture_goes_without_light(monkeypatch):
    def never(*_):
        raise AssertionError("aligned a frame that has no picture")

    monkeypatch.setattr(motion, "align", never)
    pair = simulated()
    first, second = blank_views(pair)
    found = Matches(pair.points, pair.truth, 0.1)
    for a, b in ((dataclasses.replace(first, grey=None), second), (first, views(pair)[1])):
        assert isinstance(relative_pose(a, b, found, MotionOptions()), RelativePose)
