"""The pair fit: motion and both attitudes from correspondences, by maximum a posteriori.

Nine parameters: x, y, theta of foot b in foot a, and tilt, roll, height of both cameras with the
mount's wobble as prior. Residuals are transfer errors in the image of b, whitened with weights that
are fixed before the fit: weights on the floor that depend on the parameters would make the fit
shrink the height. Method: iteratively reweighted Gauss-Newton with Cauchy weights and an annealed
scale, then a gate and plain least squares over the gate's inliers.
"""

from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, Correspondences, Se2
from groundfuse.backend.reprojection import transfer
from groundfuse.frontend.arrays import Floats, Mask

MAD_TO_SIGMA = 1.0 / 1.1774  # median of a Rayleigh-distributed length, in sigmas

CONVERGED = 1e-4  # squared length of a step in sigmas: a hundredth of a sigma


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """Options of the pair fit.

    Attributes:
        robust_iterations: reweighted steps with annealed scale.
        final_iterations: plain steps over the gated inliers.
        cauchy_sigmas: Cauchy kernel's width, in estimated sigmas.
        gate_sigmas: residual length above which a correspondence is dropped.
        min_noise: smallest factor by which a pair's noise may fall below the detector's model.
    """

    robust_iterations: int = 15
    final_iterations: int = 4
    cauchy_sigmas: float = 2.0
    gate_sigmas: float = 3.5
    min_noise: float = 0.28


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of a frame's camera before any matching: mean and standard deviation."""

    mean: Attitude
    sigma: Attitude


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """The fitted pair.

    Attributes:
        a_from_b: pose of foot b in foot a.
        covariance: (3, 3), tangent at b, the attitudes marginalised.
        attitude_a: fitted attitude of a.
        attitude_b: fitted attitude of b.
        inliers: (n,) which correspondences were used in the end.
        noise: estimated noise as a multiple of the detector's model.
        attitude_chi2: squared Mahalanobis distance of both attitudes from their priors, 6 dof.
        converged: whether the last step was below a hundredth of a sigma.
    """

    a_from_b: Se2
    covariance: Floats
    attitude_a: Attitude
    attitude_b: Attitude
    inliers: Mask
    noise: float
    attitude_chi2: float
    converged: bool


def _vector(attitude: Attitude) -> Floats:
    return np.array([attitude.tilt_rad, attitude.roll_rad, attitude.height_m])


@dataclass(slots=True)
class _State:
    pose: Se2
    attitude: Floats  # (6,) a then b

    def moved(self, step: Floats) -> "_State":
        turn = Se2(float(step[0]), float(step[1]), float(step[2]))
        return _State(self.pose @ turn, self.attitude + step[3:])


def _linearised(points: Correspondences, state: _State) -> tuple[Floats, Floats, Floats]:
    """Residuals (n, 2), Jacobian (n, 2, 9) and derivative by the ray in a (n, 2, 2)."""
    got = transfer(points.rays_a, state.attitude[:3], state.pose.vector(), state.attitude[3:])
    jacobian = np.concatenate([got.by_pose, got.by_attitude_a, got.by_attitude_b], axis=2)
    return got.rays_b - points.rays_b, jacobian, got.by_rays_a


def _whitening(points: Correspondences, by_rays_a: Floats) -> Floats:
    """Inverse Cholesky factors (n, 2, 2) of the transfer error's covariance."""
    spread = by_rays_a @ by_rays_a.transpose(0, 2, 1) * (points.sigma_a**2)[:, None, None]
    spread += np.eye(2) * (points.sigma_b**2)[:, None, None]
    spread = np.where(np.isfinite(spread), spread, np.eye(2))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), dtype=np.float64)


def fit_pair(
    points: Correspondences, start: Se2, prior_a: Prior, prior_b: Prior, options: FitOptions
) -> PairFit:
    """Fit motion and attitudes to correspondences of which some may be wrong.

    Args:
        points: candidate correspondences, the better part of them right.
        start: pose of foot b in foot a.
        prior_a: attitude of camera a.
        prior_b: attitude of camera b.
        options: see `FitOptions`.
    """
    mean = np.concatenate([_vector(prior_a.mean), _vector(prior_b.mean)])
    information = 1.0 / np.concatenate([_vector(prior_a.sigma), _vector(prior_b.sigma)]) ** 2
    state = _State(start, mean.copy())
    whitening = _whitening(points, _linearised(points, state)[2])
    noise = np.inf
    hessian, step = np.eye(9), np.zeros(9)
    for _ in range(options.robust_iterations):
        residual, jacobian = _whitened(points, state, whitening)
        length = np.linalg.norm(residual, axis=1)
        noise = min(noise, _noise(length, options))
        weight = 1.0 / (1.0 + (length / (options.cauchy_sigmas * noise)) ** 2) / noise**2
        hessian, step = _step(residual, jacobian, weight, information, mean - state.attitude)
        state = state.moved(step)
        if step @ hessian @ step < CONVERGED:
            break
    # The weights follow the fitted geometry once, then stay.
    whitening = _whitening(points, _linearised(points, state)[2])
    residual, _ = _whitened(points, state, whitening)
    length = np.linalg.norm(residual, axis=1)
    noise = _noise(length[length < options.gate_sigmas * noise], options)
    inliers: Mask = length < options.gate_sigmas * noise
    # Tails are heavier than a Gaussian's: what counts for the covariance is the mean square.
    noise = max(noise, float(np.sqrt((length[inliers] ** 2).sum() / _freedom(inliers))))
    weight = inliers / noise**2
    for _ in range(options.final_iterations):
        residual, jacobian = _whitened(points, state, whitening)
        hessian, step = _step(residual, jacobian, weight, information, mean - state.attitude)
        state = state.moved(step)
        if step @ hessian @ step < CONVERGED:
            break
    pull = state.attitude - mean
    converged = bool(step @ hessian @ step < CONVERGED)
    return _result(
        state, hessian, inliers, noise, float(pull @ (information * pull)), converged=converged
    )


def _result(
    state: _State, hessian: Floats, inliers: Mask, noise: float, chi2: float, *, converged: bool
) -> PairFit:
    covariance = np.linalg.inv(hessian)[:3, :3]
    return PairFit(
        state.pose,
        (covariance + covariance.T) / 2.0,
        Attitude(*map(float, state.attitude[:3])),
        Attitude(*map(float, state.attitude[3:])),
        inliers,
        noise,
        chi2,
        converged,
    )


def _whitened(points: Correspondences, state: _State, whitening: Floats) -> tuple[Floats, Floats]:
    residual, jacobian, _ = _linearised(points, state)
    bad = ~np.isfinite(residual).all(axis=1)
    residual[bad], jacobian[bad] = 1e9, 0.0  # behind a camera: no pull, never an inlier
    return (whitening @ residual[:, :, None])[:, :, 0], whitening @ jacobian


def _noise(length: Floats, options: FitOptions) -> float:
    """Noise as a multiple of the model, from the median residual length."""
    median = float(np.median(length)) if len(length) else np.inf
    return max(options.min_noise, median * MAD_TO_SIGMA)


def _freedom(inliers: Mask) -> float:
    """Residual coordinates less the parameters that they determine, at least one."""
    return max(1.0, 2.0 * float(inliers.sum()) - 9.0)


def _step(
    residual: Floats, jacobian: Floats, weight: Floats, information: Floats, pull: Floats
) -> tuple[Floats, Floats]:
    """Normal equations (9, 9) with the prior, and their Gauss-Newton step."""
    weighted = jacobian * weight[:, None, None]
    hessian = np.einsum("nik,nil->kl", weighted, jacobian)
    gradient = np.einsum("nik,ni->k", weighted, residual)
    hessian[3:, 3:] += np.diag(information)
    gradient[3:] -= information * pull
    # The motion alone can be singular (one point): a prior wider than any floor keeps it solvable.
    scale = np.trace(hessian[:3, :3]) * 1e-15 + 1e-12
    hessian[:3, :3] += np.eye(3) * scale
    return hessian, -np.linalg.solve(hessian, gradient)
