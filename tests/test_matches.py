"""Matches refuse what no later stage could use, and travel between processes."""

import pickle

import numpy as np
import pytest

from groundfuse.backend.measurement import IDENTITY, Correspondences, Reason
from groundfuse.frontend.matches import Matches, Miss


def correspondences(count=4, sigmas=4):
    rays = np.arange(2.0 * count).reshape(-1, 2)
    return Correspondences(rays, rays + 1.0, np.full(sigmas, 1e-3), np.full(sigmas, 2e-3))


def test_matches_survive_pickling():
    matches = Matches(correspondences(), IDENTITY, 0.25)
    copy = pickle.loads(pickle.dumps(matches))  # noqa: S301
    np.testing.assert_array_equal(copy.correspondences.rays_b, matches.correspondences.rays_b)
    assert (copy.a_from_b, copy.ambiguity) == (IDENTITY, 0.25)


def test_a_miss_survives_pickling():
    miss = Miss(Reason.FEW_INLIERS, 3.0, 12.0)
    assert pickle.loads(pickle.dumps(miss)) == miss  # noqa: S301


@pytest.mark.parametrize("ambiguity", [-0.1, 1.1, float("nan"), float("inf")])
def test_ambiguity_outside_zero_to_one_is_refused(ambiguity):
    with pytest.raises(ValueError, match=r"ambiguity must lie in \[0, 1\], got"):
        Matches(correspondences(), IDENTITY, ambiguity)


def test_unequal_lengths_are_refused():
    with pytest.raises(ValueError, match=r"must be \(n, 2\) and \(n,\), got shapes .*\(3,\)"):
        Matches(correspondences(4, 3), IDENTITY, 0.0)
