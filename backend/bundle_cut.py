"""Correspondences whose ends do not meet on the floor, and pairs that lose too many; numpy only."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_estimate import BundleOptions
from groundfuse.backend.bundle_landing_compiled import meeting_chi2
from groundfuse.backend.bundle_model import State, floor_points
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_tracks import Links, Sightings
from groundfuse.backend.measurement import Reason, Rejected, RelativePose

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """What is left.

    Attributes:
        links: correspondences that are kept, of pairs with enough of them.
        num_wrong: correspondences found wrong.
        rejected: pairs that lost most of theirs.
        weak: pairs with too few, which count as relative poses.
    """

    links: Links
    num_wrong: int
    rejected: tuple[Rejected, ...]
    weak: tuple[RelativePose, ...]


def link_chi2(
    links: Links, sightings: Sightings, state: State, priors: Priors, noise: float
) -> Array:
    """Squared distance of both ends on the floor over its variance (n,); inf above a horizon.

    A point above the floor lands elsewhere for each camera: relief counts as variance.
    """
    landing = floor_points(sightings.frame, sightings.ray, sightings.gain, state, priors.robot_of)
    relief_m = priors.relief * state.attitude[sightings.frame, 2]
    chi2 = np.empty(len(links))
    sigma = noise * sightings.sigma
    meeting_chi2((links.a, links.b), landing, sigma, relief_m, chi2)
    return chi2


def cut(
    links: Links, edges: Sequence[RelativePose], wrong: NDArray[np.bool_], options: BundleOptions
) -> Cut:
    """Drop wrong links (n,), pairs that lose most of theirs, and pairs that keep too few."""
    before = np.bincount(links.edge, minlength=len(edges))
    left = np.bincount(links.edge[~wrong], minlength=len(edges))
    pictured = before >= options.min_links
    refused = pictured & (left < options.min_link_share * before)
    weak = ~refused & (left < options.min_links)
    kept = ~wrong & ~(refused | weak)[links.edge]
    rejected = tuple(
        Rejected(
            edges[index].a,
            edges[index].b,
            Reason.RESIDUAL,
            float(left[index] / before[index]),
            options.min_link_share,
        )
        for index in np.flatnonzero(refused).tolist()
    )
    few = tuple(edges[index] for index in np.flatnonzero(weak).tolist())
    return Cut(links.only(kept), int(wrong.sum()), rejected, few)
