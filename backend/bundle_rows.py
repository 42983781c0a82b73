"""Whitened derivatives of all sightings; numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_model import State, derivatives
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_rows_compiled import Lines
from groundfuse.backend.bundle_tracks import Observations

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Whitened derivatives of all sightings.

    Attributes:
        lines: (n, 2, 6) by the frame; (n, 2, d) by x and y of the floor point, and z where the
            floor has relief; (n, 2, 2) by the lens, (0, 2, 2) where lenses are as filed.
        relief: (3, points) of the relief's prior at each point: its residual -z / (relief h), and
            the derivatives of z / (relief h) by z and by the height h of the first camera that
            sees the point; (3, 0) on a flat floor.
    """

    lines: Lines
    relief: Array


def whitened_rows(seen: Observations, state: State, weight: Array, priors: Priors) -> Rows:
    """Differentiate all sightings; `weight` (n,) is the kernel's over the variance."""
    lens, size = bool(priors.free_lens.any()), 3 if priors.relief > 0.0 else 2
    lines = derivatives(seen, state, priors.robot_of, np.sqrt(weight), size=size, lens=lens)
    if lens:
        lines.by_lens[:] *= priors.free_lens[priors.robot_of[seen.frame], None, :]
    for index in np.flatnonzero(priors.fixed).tolist():
        lines.by_frame[seen.frame_start[index] : seen.frame_start[index + 1], :, :3] = 0.0
    return Rows(lines, relief_rows(seen, state, priors))


def relief_rows(seen: Observations, state: State, priors: Priors) -> Array:
    """Prior of the floor points' heights, see `Rows`."""
    if priors.relief == 0.0:
        return np.zeros((3, 0))
    height = state.attitude[seen.frame[seen.first], 2]
    by_z = 1.0 / (priors.relief * height)
    value = state.point[:, 2] * by_z
    return np.stack([-value, by_z, -value / height])
