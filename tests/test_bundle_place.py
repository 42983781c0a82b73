"""New frames find their places among known ones, whatever some correspondences say."""

import math
from dataclasses import replace

import numpy as np
import pytest
from bundle_world import pair_team, simulate

from groundfuse.backend.bundle_estimate import BundleOptions
from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_place import agrees, noise_of, placed_among_known
from groundfuse.backend.bundle_setup import priors_of, team_of
from groundfuse.backend.bundle_tracks import Links, matched
from groundfuse.backend.measurement import FrameId, Reason, Rejected

NEW = (FrameId("A", 6), FrameId("B", 3))
# Keypoints are good to 1e-4 px of a focal length of hundreds, cameras less than a metre high:
# each tells its place to some 2e-7 m. Worst seen 5e-8 m and 2e-7 rad.
SHARP_PX = 1e-4
TOLERANCE = 1e-6


def placing(team, new=NEW, options=None):
    """Links, keypoints, the start (known frames at the truth, new ones 2 cm and 1 deg off)."""
    start, edges, prior, sigma, cameras = team.arguments
    numbered = team_of(start)
    priors = priors_of(numbered, prior, sigma, options or BundleOptions())
    seen = matched(edges, numbered.index_of)
    known = np.array([frame not in new for frame in numbered.frames])
    feet = [(team.truth[f] @ cameras[f.robot].base_from_foot).vector() for f in numbered.frames]
    true = [team.attitude[f] for f in numbered.frames]
    attitude = np.array([(a.tilt_rad, a.roll_rad, a.height_m) for a in true])
    truth = State(np.array(feet), attitude, np.zeros((2, 6)), np.zeros((0, 3)))
    off = np.array([0.02, -0.02, math.radians(1.0)])
    pose, filed = truth.pose + off * ~known[:, None], truth.attitude.copy()
    filed[~known] = priors.attitude[~known]
    begin = State(pose, filed, truth.shared, truth.point)
    return (seen.links, seen.sightings, begin, priors, known), truth


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_new_frames_come_where_they_are(wrong):
    team = simulate(pair_team(), np.random.default_rng(1), noise_px=SHARP_PX, wrong=wrong)
    given, truth = placing(team)
    known = given[4]
    found = placed_among_known(*given, BundleOptions())
    np.testing.assert_allclose(found.pose, truth.pose, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(found.attitude, truth.attitude, rtol=0, atol=TOLERANCE)
    assert (found.pose[known] == given[2].pose[known]).all()
    assert (found.attitude[known] == given[2].attitude[known]).all()
    assert len(found.point) == 0


def test_the_surer_the_files_the_nearer_attitudes_stay():
    """Files twenty times as sure as they are right hold attitudes that pictures would move."""
    team = simulate(pair_team(), np.random.default_rng(2))
    (links, sightings, begin, priors, known), _ = placing(team)
    moved = []
    for share in (1.0, 0.05, 1e-6):
        sure = replace(priors, sigma=share * priors.sigma)
        found = placed_among_known(links, sightings, begin, sure, known, BundleOptions())
        moved.append(np.abs(found.attitude - begin.attitude).max())
    assert moved[0] > 0.004
    assert 0.01 * moved[0] < moved[1] < 0.5 * moved[0]
    assert moved[2] < 1e-9


def test_without_new_frames_nothing_moves():
    team = simulate(pair_team(), np.random.default_rng(3))
    given, _ = placing(team, new=())
    assert placed_among_known(*given, BundleOptions()) is given[2]


def test_frames_that_see_too_little_of_the_known_are_not_placed():
    team = simulate(pair_team(), np.random.default_rng(4))
    given, _ = placing(team, new=[frame for frame in team.truth if frame.robot == "A"][1:])
    most = BundleOptions(min_links=10_000)
    assert placed_among_known(*given, most) is None
    alone = [f for f in team.truth if f != FrameId("A", 0)]
    given, _ = placing(team, new=alone)  # most of them share no floor with the first
    assert placed_among_known(*given, BundleOptions()) is None


def test_frames_that_do_not_settle_are_not_placed():
    team = simulate(pair_team(), np.random.default_rng(5), noise_px=SHARP_PX)
    given, _ = placing(team)
    assert placed_among_known(*given, BundleOptions(iterations=1)) is None


@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0])
def test_noise_is_told_from_all_correspondences(noise):
    chi2 = noise**2 * np.random.default_rng(6).chisquare(2, 20_000)
    chi2[:1000] = 1e6  # wrong ones
    # A twentieth of wrong ones moves the median by 2 ln(1 / (1 - 0.526)) / (2 ln 2) = 1.078.
    assert noise_of(chi2) == pytest.approx(noise * math.sqrt(1.078), rel=0.02)
    assert noise_of(np.zeros(5)) > 0.0


def test_pairs_agree_unless_they_lose_much_and_did_not_before():
    edges = simulate(pair_team(), np.random.default_rng(7)).edges[:3]
    edge = np.repeat([0, 1, 2], 10)
    links = Links(edge, edge, edge)
    few = np.zeros(30, bool)
    few[[0, 1, 10, 20]] = True
    assert agrees(links, few, edges, ())
    few[2] = True
    assert not agrees(links, few, edges, ())
    known = Rejected(edges[0].a, edges[0].b, Reason.RESIDUAL, 0.1, 0.3)
    assert agrees(links, few, edges, (known,))
    other = Rejected(edges[1].a, edges[1].b, Reason.RESIDUAL, 0.1, 0.3)
    assert not agrees(links, few, edges, (other,))
