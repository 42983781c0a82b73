"""From a matcher's correspondences to a measured motion of the robot's base, or why not."""

from dataclasses import dataclass, field

import numpy as np

from groundfuse.backend.measurement import (
    Correspondences,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
)
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Mask
from groundfuse.frontend.fit import FitOptions, PairFit, Prior, fit_pair
from groundfuse.frontend.matches import Matches, Miss
from groundfuse.frontend.photometric import GreyView, PhotometricOptions, align


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """When a fitted motion is believed.

    Attributes:
        fit: the fit itself.
        photometric: the photometric stage, for views that bring their pictures.
        max_photometric_chi2: the photometric motion is kept where it lies within this squared
            distance of the features' motion, both uncertainties counted; 3 dof.
        min_inliers: fewest correspondences after the fit's gate.
        max_ambiguity: largest ratio of the second-best motion's votes to the best one's.
        max_noise: largest residual noise, as a multiple of the detector's model.
        max_attitude_chi2: largest squared distance of both attitudes from their priors; the 6-dof
            chi-square exceeds 33 once in 100 000.
        max_sigma_heights: largest standard deviation of the position, in camera heights.
    """

    fit: FitOptions = field(default_factory=FitOptions)
    photometric: PhotometricOptions = field(default_factory=PhotometricOptions)
    max_photometric_chi2: float = 25.0
    min_inliers: int = 12
    max_ambiguity: float = 0.6
    max_noise: float = 4.0
    max_attitude_chi2: float = 33.0
    max_sigma_heights: float = 0.1

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(
            self,
            may_be_zero=("max_ambiguity",),
            may_be_inf=(
                "max_photometric_chi2",
                "max_ambiguity",
                "max_noise",
                "max_attitude_chi2",
                "max_sigma_heights",
            ),
        )


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What the fit needs to know of one frame.

    Attributes:
        id: the frame.
        prior: attitude of its camera.
        base_from_foot: place of the camera's foot on the robot.
        grey: the picture, where the photometric stage is wanted.
    """

    id: FrameId
    prior: Prior
    base_from_foot: Se2
    grey: GreyView | None = None


def selected(points: Correspondences, keep: Mask, noise: float) -> Correspondences:
    """Return the kept correspondences with their sigmas scaled to the noise that was found."""
    return Correspondences(
        points.rays_a[keep],
        points.rays_b[keep],
        points.sigma_a[keep] * noise,
        points.sigma_b[keep] * noise,
    )


def relative_pose(
    a: View, b: View, found: Matches | Miss, options: MotionOptions
) -> RelativePose | Rejected:
    """Fit the motion of base b in base a to what a matcher found."""
    if isinstance(found, Miss):
        return Rejected(a.id, b.id, found.reason, found.value, found.limit)
    if found.ambiguity > options.max_ambiguity:
        return Rejected(a.id, b.id, Reason.AMBIGUOUS, found.ambiguity, options.max_ambiguity)
    if len(found.correspondences) < options.min_inliers:
        count = float(len(found.correspondences))
        return Rejected(a.id, b.id, Reason.FEW_INLIERS, count, options.min_inliers)
    fit = fit_pair(found.correspondences, found.a_from_b, a.prior, b.prior, options.fit)
    return _judged(a, b, found, fit, options)


def _judged(
    a: View, b: View, found: Matches, fit: PairFit, options: MotionOptions
) -> RelativePose | Rejected:
    num_inliers = int(fit.inliers.sum())
    height_m = min(a.prior.mean.height_m, b.prior.mean.height_m)
    sigma_heights = float(max(fit.covariance[0, 0], fit.covariance[1, 1])) ** 0.5 / height_m
    checks = (
        (Reason.FEW_INLIERS, -float(num_inliers), -float(options.min_inliers)),
        (Reason.RESIDUAL, fit.noise, options.max_noise),
        (Reason.ATTITUDE, fit.attitude_chi2, options.max_attitude_chi2),
        (Reason.DEGENERATE, sigma_heights, options.max_sigma_heights),
        (Reason.NOT_CONVERGED, 0.0 if fit.converged else 1.0, 0.5),
    )
    for reason, value, limit in checks:
        if not value <= limit:
            return Rejected(a.id, b.id, reason, abs(value), abs(limit))
    motion, spread = _aligned(a, b, fit, options)
    lever = b.base_from_foot.adjoint()
    covariance = lever @ spread @ lever.T
    return RelativePose(
        a.id,
        b.id,
        a.base_from_foot @ motion @ b.base_from_foot.inverse(),
        (covariance + covariance.T) / 2.0,
        num_inliers,
        found.ambiguity,
        selected(found.correspondences, fit.inliers, fit.noise),
    )


def _aligned(a: View, b: View, fit: PairFit, options: MotionOptions) -> tuple[Se2, Floats]:
    """The photometric motion where it is wanted, well-founded and near; else the features'."""
    from_features = fit.a_from_b, fit.covariance
    if a.grey is None or b.grey is None:
        return from_features
    attitudes = fit.attitude_a, fit.attitude_b
    found = align(a.grey, b.grey, fit.a_from_b, a.prior, b.prior, attitudes, options.photometric)
    if found is None or found.residual > options.photometric.max_residual:
        return from_features
    change = (fit.a_from_b.inverse() @ found.a_from_b).vector()
    chi2 = float(change @ np.linalg.solve(fit.covariance + found.covariance, change))
    if chi2 > options.max_photometric_chi2:
        return from_features
    return found.a_from_b, found.covariance
