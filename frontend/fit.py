"""The pair fit: motion and both attitudes from correspondences, by maximum a posteriori.

Nine parameters: x, y, theta of foot b in foot a, and tilt, roll, height of both cameras with the
mount's wobble as prior. Residuals are transfer errors in the image of b, whitened with weights that
are fixed before the fit: weights on the floor that depend on the parameters would make the fit
shrink the height. Method: iteratively reweighted Gauss-Newton with Cauchy weights and an annealed
scale, then a gate and plain least squares over the gate's inliers.
"""

from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, Correspondences, Se2, wrap_rad
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Mask
from groundfuse.frontend.fit_compiled import Asked, Pairs, fit_rows


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

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_inf=("cauchy_sigmas", "gate_sigmas"))


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
    mean = np.concatenate([np.zeros(3), _vector(prior_a.mean), _vector(prior_b.mean)])
    sigma = np.concatenate([_vector(prior_a.sigma), _vector(prior_b.sigma)])
    information = np.concatenate([np.zeros(3), 1.0 / sigma**2])
    found = np.concatenate([start.vector(), mean[3:]])
    inliers = np.zeros(len(points), dtype=np.bool_)
    asked = Asked(
        options.robust_iterations,
        options.final_iterations,
        options.cauchy_sigmas,
        options.gate_sigmas,
        options.min_noise,
    )
    pairs = Pairs(points.rays_a, points.rays_b, points.sigma_a, points.sigma_b)
    noise, converged, hessian = fit_rows(pairs, asked, mean, information, found, inliers)
    covariance = np.linalg.inv(hessian)[:3, :3]
    pull = found - mean
    return PairFit(
        Se2(float(found[0]), float(found[1]), wrap_rad(float(found[2]))),
        (covariance + covariance.T) / 2.0,
        Attitude(*map(float, found[3:6])),
        Attitude(*map(float, found[6:])),
        inliers,
        noise,
        float(pull @ (information * pull)),
        converged,
    )


def _vector(attitude: Attitude) -> Floats:
    return np.array([attitude.tilt_rad, attitude.roll_rad, attitude.height_m])
