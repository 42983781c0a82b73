"""Short names for simulated teams, and scores against their truth."""

import math

import numpy as np

from groundfuse.tools import simulate_sightings
from groundfuse.tools.simulate_sightings import FOCAL_PX, SightingOptions
from groundfuse.tools.simulated_robot import SimulatedRobot, lawn_path, loop_path

__all__ = ["FOCAL_PX", "Robot", "ate_m", "lawn_path", "loop_path", "nees", "pair_team", "simulate"]

Robot = SimulatedRobot
START_SIGMA = (0.003, math.radians(0.1))


def pair_team():
    """The paper's team in shape: two robots of 13 views, tilts 33 and 45 degrees."""
    return (
        Robot("A", loop_path(13)),
        Robot("B", loop_path(13, (0.6, 0.3), phase=1.0), tilt_deg=45.0, height_m=0.6),
    )


def simulate(robots, rng, *, start_sigma=START_SIGMA, **options):
    start = {"start_sigma_m": start_sigma[0], "start_sigma_rad": start_sigma[1]}
    return simulate_sightings.simulate(robots, rng, SightingOptions(**start, **options))


def ate_m(poses, truth, *, scale=False):
    """Root mean square position error after the best rigid (or similarity) alignment."""
    frames = sorted(truth)
    found = np.array([[poses[f].x_m, poses[f].y_m] for f in frames])
    true = np.array([[truth[f].x_m, truth[f].y_m] for f in frames])
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    z, w = found @ [1, 1j], true @ [1, 1j]
    factor = np.vdot(z, w) / (np.vdot(z, z).real if scale else abs(np.vdot(z, w)))
    return float(np.sqrt(np.mean(np.abs(z * factor - w) ** 2)))


def nees(poses, covariance, truth):
    """Normalised squared error of every pose relative to the reference frame."""
    values = []
    for frame, spread in covariance.items():
        error = (truth[frame].inverse() @ poses[frame]).vector()
        values.append(float(error @ np.linalg.solve(spread, error)))
    return np.array(values)
