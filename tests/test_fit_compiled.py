"""The compiled fit: its rows are those of the shared model, its result that of plain numpy."""

import dataclasses
import math

import numpy as np
import pytest
from floor_pairs import error_of, geometric_pair, prior
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.backend.reprojection import transfer
from groundfuse.frontend.fit import FitOptions
from groundfuse.frontend.fit_compiled import (
    CONVERGED,
    MAD_TO_SIGMA,
    _median,
    _solve,
    transfer_rows,
)
from groundfuse.frontend.overhead import floor_from_rays

cameras = st.tuples(st.floats(-0.9, 0.9), st.floats(-0.3, 0.3), st.floats(0.2, 2.0)).map(np.array)
motions = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1)).map(np.array)


def plain(function):
    """Return what was compiled as Python sees it."""
    return function.py_func


def rows_of(rays_a, motion, camera_a, camera_b):
    rows = np.empty((len(rays_a), 2, 12))
    transfer_rows(rays_a, np.concatenate([motion, camera_a, camera_b]), rows)
    return rows


@given(cameras, motions, cameras, st.integers(0, 2**16))
def test_rows_are_those_of_the_shared_model(camera_a, motion, camera_b, seed):
    """Points behind a camera included; relative to the largest of a point's rows.

    A point farther off than ten camera heights is left out, and one within 0.06 deg of the horizon
    of the other camera, whose ray is longer than 1000: places and rays are rounded by so much.
    Worst seen over 210 000 points 3e-13; up to rays of 1e5, 3e-12.
    """
    rays = np.random.default_rng(seed).uniform(-1.0, 1.0, (40, 2))
    rows = rows_of(rays, motion, camera_a, camera_b)
    got = transfer(rays, camera_a, motion, camera_b)
    parts = [got.by_pose, got.by_attitude_a, got.by_attitude_b, got.by_rays_a]
    wanted = np.concatenate([*parts, got.rays_b[:, :, None]], axis=2)
    wanted[np.isnan(got.rays_b).any(axis=1)] = np.nan
    scale = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    np.testing.assert_array_equal(np.isnan(rows), np.isnan(wanted))
    place = np.hypot(*floor_from_rays(Attitude(*camera_a), rays).T)
    far = (place > 10.0 * camera_a[2]) | (np.hypot(*got.rays_b.T) > 1000.0)
    rows, wanted, scale = (part[~far] for part in (rows, wanted, scale))
    np.testing.assert_allclose(rows / scale, wanted / scale, rtol=0.0, atol=1e-12)


def test_rows_are_the_slopes_of_the_ray_in_b():
    """Against differences: the motion perturbed on the right, everything else added to."""
    rays = np.random.default_rng(3).uniform(-0.5, 0.5, (30, 2))
    motion = Se2(0.1, -0.2, 0.7)
    cameras_ab = np.array([0.6, 0.05, 0.5, 0.4, -0.02, 0.7])

    def ray_b(change):
        moved = (motion @ Se2(*change[:3])).vector()
        attitudes = cameras_ab + change[3:9]
        return rows_of(rays + change[9:], moved, attitudes[:3], attitudes[3:])[:, :, 11]

    rows = rows_of(rays, motion.vector(), cameras_ab[:3], cameras_ab[3:])
    for k in range(11):
        change = 1e-5 * np.eye(11)[k]
        numeric = (ray_b(change) - ray_b(-change)) / 2e-5
        # Second differences: 1e-10 times a third derivative of at most some hundreds.
        np.testing.assert_allclose(rows[:, :, k], numeric, atol=1e-6)


@given(st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=30), st.integers(0, 5))
def test_the_median_is_numpys(values, more):
    count = len(values)
    work = np.array(values + [math.nan] * more)
    assert plain(_median)(work, count) == np.median(values)
    assert sorted(work[:count]) == sorted(values)


def test_the_median_of_nothing_is_beyond_all():
    assert plain(_median)(np.empty(3), 0) == math.inf


@given(st.integers(0, 2**16))
def test_the_step_solves_its_equations(seed):
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((9, 12)) * 10.0 ** rng.uniform(-3, 3, (9, 1))
    matrix, right = factor @ factor.T, rng.standard_normal(9)
    found = right.copy()
    plain(_solve)(matrix, found)
    # In units of the diagonal, or the scale of each parameter counts as conditioning.
    scale = np.sqrt(np.diag(matrix))
    wanted = np.linalg.solve(matrix / np.outer(scale, scale), right / scale)
    np.testing.assert_allclose(found * scale, wanted, rtol=0.0, atol=1e-9 * np.abs(wanted).max())


def test_a_singular_system_gives_no_nan():
    found = np.ones(9)
    plain(_solve)(np.ones((9, 9)), found)
    assert np.isfinite(found).all()


def vector(attitude):
    return [attitude.tilt_rad, attitude.roll_rad, attitude.height_m]


class Plain:
    """The fit by arrays: motion and attitudes as they stand, and what a step needs."""

    def __init__(self, points, start, priors):
        self.points, self.pose = points, start
        self.mean = np.array([*vector(priors[0].mean), *vector(priors[1].mean)])
        self.known = np.array([*vector(priors[0].sigma), *vector(priors[1].sigma)]) ** -2.0
        self.attitude = self.mean.copy()
        self.whiten()

    def carried(self):
        a, b = self.attitude[:3], self.attitude[3:]
        return transfer(self.points.rays_a, a, self.pose.vector(), b)

    def whiten(self):
        by_rays = self.carried().by_rays_a
        spread = by_rays @ by_rays.transpose(0, 2, 1) * (self.points.sigma_a**2)[:, None, None]
        spread += np.eye(2) * (self.points.sigma_b**2)[:, None, None]
        self.white = np.linalg.inv(np.linalg.cholesky(spread))

    def residual(self):
        return (self.white @ (self.carried().rays_b - self.points.rays_b)[:, :, None])[:, :, 0]

    def length(self):
        return np.linalg.norm(self.residual(), axis=1)

    def step(self, weight):
        got = self.carried()
        jacobian = np.concatenate([got.by_pose, got.by_attitude_a, got.by_attitude_b], axis=2)
        rows = (self.white @ jacobian).reshape(-1, 9)
        weighted = rows * np.repeat(weight, 2)[:, None]
        self.hessian = rows.T @ weighted + np.diag([*(0.0,) * 3, *self.known])
        pull = np.array([*(0.0,) * 3, *self.known * (self.attitude - self.mean)])
        step = -np.linalg.solve(self.hessian, weighted.T @ self.residual().ravel() + pull)
        self.pose, self.attitude = self.pose @ Se2(*step[:3]), self.attitude + step[3:]
        return bool(step @ self.hessian @ step < CONVERGED)


def plainly(points, start, priors, options):
    """Return the fit by arrays, its inliers, its noise, and whether it converged."""

    def noise_of(lengths):
        return max(options.min_noise, np.median(lengths) * MAD_TO_SIGMA)

    fit, noise = Plain(points, start, priors), np.inf
    for _ in range(options.robust_iterations):
        length = fit.length()
        noise = min(noise, noise_of(length))
        weight = 1.0 / (1.0 + (length / (options.cauchy_sigmas * noise)) ** 2) / noise**2
        if fit.step(weight):
            break
    fit.whiten()
    length = fit.length()
    noise = noise_of(length[length < options.gate_sigmas * noise])
    inliers = length < options.gate_sigmas * noise
    noise = max(noise, math.sqrt((length[inliers] ** 2).sum() / max(1, 2 * inliers.sum() - 9)))
    for _ in range(options.final_iterations):
        converged = fit.step(inliers / noise**2)
        if converged:
            break
    return fit, inliers, noise, converged


# Sums in another order: 1e-16 per term, over the condition of the equations (1e6 in their own
# units), and over all steps. Worst seen 2e-12.
CLOSE = 1e-9


@pytest.mark.parametrize("change", [{}, {"robust_iterations": 2}, {"final_iterations": 1}])
@pytest.mark.parametrize("count", [13, 60, 201])
def test_the_fit_is_the_one_by_arrays(count, change):
    """With one wrong match in four, and cut short."""
    options = dataclasses.replace(FitOptions(), **change)
    for seed in range(4):
        rng = np.random.default_rng([seed, count])
        truth = Se2(*rng.uniform([-0.15, -0.15, -3.0], [0.25, 0.15, 3.0]))
        priors = prior(33.0), prior(45.0)
        pair = geometric_pair(rng, truth, priors, half_view=np.array([2.0, 2.0]), count=count)
        wrong = rng.random(count) < 0.25
        rays_b = pair.points.rays_b + wrong[:, None] * rng.normal(0.0, 0.1, (count, 2))
        points = dataclasses.replace(pair.points, rays_b=rays_b)
        start = truth @ Se2(*rng.normal(0.0, 0.01, 3))
        pair = dataclasses.replace(pair, points=points)
        found = pair.fit(start, options=options)
        plain_fit, inliers, noise, converged = plainly(points, start, priors, options)
        np.testing.assert_array_equal(found.inliers, inliers)
        assert found.noise == pytest.approx(noise, rel=CLOSE)
        assert found.converged == converged
        np.testing.assert_allclose(error_of(found.a_from_b, plain_fit.pose), 0.0, atol=CLOSE)
        attitudes = [*vector(found.attitude_a), *vector(found.attitude_b)]
        np.testing.assert_allclose(attitudes, plain_fit.attitude, atol=CLOSE)
        wanted = np.linalg.inv(plain_fit.hessian)[:3, :3]
        np.testing.assert_allclose(found.covariance, wanted, rtol=1e-6)
