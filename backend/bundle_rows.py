"""Whitened derivatives of all sightings; numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_model import State, derivatives, through_lens, view_of
from groundfuse.backend.bundle_plan import BLOCK
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_tracks import Observations

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Whitened derivatives of all sightings.

    Attributes:
        by_frame: (6, n, 2).
        by_point: (d, n, 2): by x and y, and z where the floor has relief.
        by_lens: (2, n, 2); (2, 0, 2) where lenses are as filed.
        relief: (3, points) of the relief's prior at each point: its residual -z / (relief h), and
            the derivatives of z / (relief h) by z and by the height h of the first camera that
            sees the point; (3, 0) on a flat floor.
    """

    by_frame: Array
    by_point: Array
    by_lens: Array
    relief: Array


def whitened_rows(seen: Observations, state: State, weight: Array, priors: Priors) -> Rows:
    """Differentiate all sightings; `weight` (n,) is the kernel's over the variance."""
    count, lens = len(seen.frame), bool(priors.free_lens.any())
    size = 3 if priors.relief > 0.0 else 2
    by_frame, by_point = np.empty((BLOCK, count, 2)), np.empty((size, count, 2))
    by_lens, root_weight = np.empty((2, count if lens else 0, 2)), np.sqrt(weight)[:, None]
    for part in seen.parts:
        view = view_of(seen, state, part)
        found = derivatives(view)
        robot = priors.robot_of[seen.frame[part]]
        if lens or state.shared[:, 3:5].any():
            found = through_lens(found, view, state.shared[robot], seen.gain[part])
        if lens:
            free = priors.free_lens[robot].T[:, :, None]
            by_lens[:, part] = found.by_lens * root_weight[part] * free
        by_frame[:, part] = found.by_frame * root_weight[part]
        by_point[:, part] = found.by_point[:size] * root_weight[part]
    for index in np.flatnonzero(priors.fixed).tolist():
        by_frame[:3, seen.frame_start[index] : seen.frame_start[index + 1]] = 0.0
    return Rows(by_frame, by_point, by_lens, relief_rows(seen, state, priors))


def relief_rows(seen: Observations, state: State, priors: Priors) -> Array:
    """Prior of the floor points' heights, see `Rows`."""
    if priors.relief == 0.0:
        return np.zeros((3, 0))
    height = state.attitude[seen.frame[seen.first], 2]
    by_z = 1.0 / (priors.relief * height)
    value = state.point[:, 2] * by_z
    return np.stack([-value, by_z, -value / height])
