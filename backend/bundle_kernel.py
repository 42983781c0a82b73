"""How far sightings are from the model, how noisy they are, and what each weighs; numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_model import State, residuals
from groundfuse.backend.bundle_tracks import Integers, Observations

Array = NDArray[np.float64]

UNSEEN_RATIO = 1e4
"""A sighting behind the camera costs as much as one a hundred kernel widths off."""
LEAST_FREEDOM = 0.9
"""Points with fewer degrees of freedom say nothing about the noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """How far the sightings are from the model.

    Attributes:
        residual: (n, 2) measured minus predicted rays; 0 where unseen.
        unseen: (n,) whether the point is behind the camera.
        chi2: (n,) squared residual over the promised variance; 0 where unseen.
    """

    residual: Array
    unseen: NDArray[np.bool_]
    chi2: Array


def errors_of(seen: Observations, state: State, robot_of: Integers) -> Errors:
    """Compare all sightings with the model."""
    residual, unseen = residuals(seen, state, robot_of)
    chi2 = (residual[:, 0] ** 2 + residual[:, 1] ** 2) / seen.sigma**2
    return Errors(residual, unseen, chi2)


def noise_factor(seen: Observations, errors: Errors, absorbed: Array) -> float:
    """Median residual of the floor points over what the sigmas promise.

    A point seen k times has 2 k residuals and absorbs 2 of them, or up to 3 where the floor has
    relief (`absorbed`, (points,)), which leaves chi-square with v = 2 k - absorbed degrees of
    freedom; its median is near v (1 - 2 / 9 v)^3 (Wilson and Hilferty 1931).
    """
    total = np.bincount(seen.point, errors.chi2, seen.num_points)
    freedom = 2.0 * np.bincount(seen.point, ~errors.unseen, seen.num_points) - absorbed
    several = freedom > LEAST_FREEDOM
    total, freedom = total[several], freedom[several]
    if len(total) == 0:
        return 1.0
    median = freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3
    taken = 3.0 * (len(seen.frame_start) - 1)  # each frame's pose absorbs as well
    left = max(freedom.sum() - taken, 1.0) / freedom.sum()
    return float(np.sqrt(np.median(total / median) / left))


@dataclass(frozen=True, slots=True)
class Kernel:
    """Cauchy on whitened residuals.

    Attributes:
        width: in sigmas of what the residuals spread by.
        spread: what they spread by, over what is promised.
        noise: what the keypoints' noise is taken for, over what is promised.
    """

    width: float
    spread: float
    noise: float

    def ratio(self, errors: Errors) -> Array:
        """Squared residuals over the squared width (n,)."""
        chi2 = errors.chi2 / (self.width * self.spread) ** 2
        return np.where(errors.unseen, UNSEEN_RATIO, chi2)

    def weight(self, errors: Errors) -> Array:
        """Weights (n,), 0 to 1."""
        return np.where(errors.unseen, 0.0, 1.0 / (1.0 + self.ratio(errors)))

    def cost(self, errors: Errors) -> float:
        """Twice the negative log likelihood."""
        scale = self.width * self.spread / self.noise
        return float(scale**2 * np.sum(np.log1p(self.ratio(errors))))

    def information(self, errors: Errors, sigma: Array) -> Array:
        """Weights over variances (n,)."""
        found: Array = self.weight(errors) / (self.noise * sigma) ** 2
        return found
