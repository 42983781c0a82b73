"""New frames of a bundle placed among those that an earlier one knows (resection); numpy only.

Known frames stay where they are, and so do the floor points that their rays meet; then each new
frame is on its own: six unknowns, found by robust Gauss-Newton with the files' prior of its
attitude. That is enough to tell right correspondences from wrong ones as long as the new pairs
agree with what was known; where they do not, all frames must move before any is judged.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_estimate import BundleOptions
from groundfuse.backend.bundle_kernel import Kernel, errors_of
from groundfuse.backend.bundle_model import State, derivatives, floor_points, moved
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_tracks import (
    Integers,
    Links,
    Observations,
    Sightings,
    observations,
)
from groundfuse.backend.measurement import Rejected, RelativePose

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MEDIAN_CHI2 = 2.0 * math.log(2.0)
"""Of two degrees of freedom."""
LEAST_SPREAD = 1e-6
"""Of residuals, over what is promised: perfect pictures have none."""
SETTLED = 0.05
"""Chi-square that a frame's last step may have."""
MOST_LOST = 0.2
"""A pair that would lose more of its correspondences contradicts what was known."""


def placed_among_known(
    links: Links,
    sightings: Sightings,
    state: State,
    priors: Priors,
    known: Mask,
    options: BundleOptions,
) -> State | None:
    """Return the state with every new frame placed by its pairs with known frames.

    None where one has too few correspondences with them, or does not settle.

    Args:
        links: correspondences, right and wrong.
        sightings: keypoints.
        state: known frames where they are, new ones nearly; no floor points.
        priors: what the files say.
        known: (frames,) which frames stay.
        options: see there.
    """
    new = np.flatnonzero(~known)
    if not len(new):
        return state
    new_a, new_b = ~known[sightings.frame[links.a]], ~known[sightings.frame[links.b]]
    one = new_a != new_b
    mine = np.where(new_a, links.a, links.b)[one]
    other = np.where(new_a, links.b, links.a)[one]
    gain = None if sightings.gain is None else sightings.gain[other]
    frame, ray = sightings.frame[other], sightings.ray[other]
    landing = floor_points(frame, ray, gain, state, priors.robot_of).point
    met = np.isfinite(landing[:, 0])
    count = np.bincount(sightings.frame[mine[met]], minlength=len(known))
    if count[new].min() < options.min_links:
        return None
    seen = observations(sightings, mine[met], np.arange(int(met.sum())), len(known))
    points = np.column_stack([landing[met], np.zeros(len(seen.frame))])
    begun = State(state.pose, state.attitude, state.shared, points)
    return _settled(seen, begun, priors, new, options)


def _settled(
    seen: Observations, state: State, priors: Priors, new: Integers, options: BundleOptions
) -> State | None:
    """Move the new frames until they stay, each on its own; None if they don't."""
    wanted, weight, still = state.attitude[new], priors.sigma[new] ** -2, np.zeros((0, 3))
    axes, starts = np.arange(3, 6), seen.frame_start[new]
    for _ in range(options.iterations):
        errors = errors_of(seen, state, priors.robot_of)
        # Both ends err, so this is some 1.4 times the keypoints' own noise.
        spread = max(math.sqrt(float(np.median(errors.chi2)) / MEDIAN_CHI2), LEAST_SPREAD)
        kernel = Kernel(options.robust_sigma, spread, spread)
        root = np.sqrt(kernel.information(errors, seen.sigma))
        rows = derivatives(seen, state, priors.robot_of, root, size=2, lens=False).by_frame
        error = errors.residual * root[:, None]
        normal = np.add.reduceat(np.einsum("nik,nil->nkl", rows, rows), starts)
        right = np.add.reduceat(np.einsum("nik,ni->nk", rows, error), starts)
        normal[:, axes, axes] += weight
        right[:, 3:] += weight * (wanted - state.attitude[new])
        step = np.zeros((priors.num_nodes, 6))
        step[new] = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        state = moved(state, step, np.zeros((len(state.point), 2)))
        if float(np.sum(step[new] * right, axis=1).max()) < SETTLED:
            return State(state.pose, state.attitude, state.shared, still)
    return None


def noise_of(chi2: Array) -> float:
    """Return the keypoints' noise over what is promised, from all correspondences' chi-squares.

    Args:
        chi2: (n,) of two degrees of freedom each, with the noise that is promised.
    """
    return max(math.sqrt(float(np.median(chi2)) / MEDIAN_CHI2), LEAST_SPREAD)


def agrees(
    links: Links, wrong: Mask, edges: Sequence[RelativePose], rejected: Sequence[Rejected]
) -> bool:
    """Tell whether all pairs keep their correspondences, but for those rejected earlier.

    Args:
        links: correspondences.
        wrong: (n,) which of them do not meet.
        edges: pairs, by the links' numbers.
        rejected: by the earlier bundle.
    """
    before = np.bincount(links.edge, minlength=len(edges))
    lost = np.bincount(links.edge[wrong], minlength=len(edges))
    known = {(pair.a, pair.b) for pair in rejected}
    doubtful = np.flatnonzero(lost > MOST_LOST * before).tolist()
    return all((edges[k].a, edges[k].b) in known for k in doubtful)
