"""Another look with corrected cameras: when it is worth it, and the way back to the files."""

import math
from dataclasses import replace

import numpy as np
import pytest
from painted_team import QUICK, painted_pair

from groundfuse.backend.bundle_estimate import Estimated, MountEstimate
from groundfuse.backend.drift import accuracy
from groundfuse.backend.measurement import Attitude, Correspondences, FrameId, RelativePose, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.tools.calibration_file import correction
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.pipeline import Stopwatch, fuse_robots
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.second_look import as_filed, corrected, is_worth_it
from groundfuse.tools.settings import with_settings
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.team_graphs import accepted_edges
from groundfuse.tools.workers import silent

LENS = Intrinsics(
    640, 480, 548.0, 549.5, 316.8, 243.0, Distortion.EQUIDISTANT, (0.012, -0.004, 0.001, 0.0)
)
MOUNT = Mount(Attitude(0.6, 0.01, 0.5), Attitude(0.01, 0.003, 0.002), Se2(0.1, 0.0, 0.05))
CAMERA = Camera(LENS, MOUNT, name="c")
A, B = FrameId("A", 0), FrameId("B", 0)
# As in test_focal_gain: second order in the correction, and the tangential terms.
TOLERANCE_PX = 0.02


def robots(tmp_path):
    tilted = Attitude(0.62, 0.0, 0.51)
    return tuple(
        Robot(f.robot, CAMERA, (Frame(f, tmp_path / "p.png", 0.0, tilted, MOUNT.sigma),))
        for f in (A, B)
    )


def found(robot, *, used=True, focal=None, **numbers):
    def number(name):
        return Estimated(numbers.get(name, 0.0), 1e-4, 0.03, used and name in numbers)

    seen = None if focal is None else Estimated(focal, 1e-4, 0.003, used)
    return MountEstimate(robot, number("tilt"), number("roll"), number("height"), seen, None)


def test_only_used_numbers_correct():
    assert correction(None) == 0.0
    assert correction(Estimated(0.2, 0.1, 1.0, used=False)) == 0.0
    assert correction(Estimated(None, 0.1, 1.0, used=True)) == 0.0
    assert correction(Estimated(0.2, 0.1, 1.0, used=True)) == 0.2


@pytest.mark.parametrize(
    ("numbers", "worth"),
    [
        ({}, False),
        ({"tilt": 0.004}, False),  # half a wobble is 0.005
        ({"tilt": 0.006}, True),
        ({"roll": -0.002}, True),
        ({"height": 0.0015}, False),  # and of the height 0.002
        ({"height": 0.0025}, True),
        ({"focal": 5e-5}, False),
        ({"focal": -4e-4}, True),
    ],
)
def test_a_look_is_worth_what_has_cost_pairs(tmp_path, numbers, worth):
    team = robots(tmp_path)
    mounts = [found("A"), found("B", **numbers)]
    assert is_worth_it(team, (), mounts) == worth
    assert not is_worth_it(team, mounts, mounts)  # already looked with these
    assert not is_worth_it(team, (), [found("B", used=False, **numbers)])


def test_a_lens_that_is_known_very_well_is_not_worth_a_look_for_next_to_nothing(tmp_path):
    team = robots(tmp_path)
    for off, worth in ((2e-4, False), (-4e-4, True)):
        focal = Estimated(off, 1e-6, 0.003, used=True)
        mounts = [replace(found("B"), focal=focal)]
        assert is_worth_it(team, (), mounts) == worth


def test_frames_move_with_their_mount(tmp_path):
    after, same = corrected(robots(tmp_path), [found("A", tilt=0.02, roll=-0.01, height=0.01)])
    (frame,) = after.frames
    wanted = Attitude(0.64, -0.01, 0.51 * 1.01)
    for name in ("tilt_rad", "roll_rad", "height_m"):
        assert math.isclose(getattr(frame.attitude, name), getattr(wanted, name))
    assert math.isclose(after.camera.mount.attitude.tilt_rad, 0.62)
    assert same == robots(tmp_path)[1]


def test_rays_of_a_corrected_lens_go_back_to_the_files(tmp_path):
    pixels = np.random.default_rng(1).uniform((0, 0), (639, 479), (50, 2))
    mounts = [found("A", focal=-0.002)]
    team = robots(tmp_path)
    better = corrected(team, mounts)[0].camera.intrinsics
    assert math.isclose(better.fx_px, 548.0 * 0.998)
    true, filed = better.rays_from_px(pixels), LENS.rays_from_px(pixels)
    sigma = np.full(50, 1e-3)
    points = Correspondences(true, filed, sigma, sigma)
    edge = RelativePose(A, B, Se2(0.1, 0.0, 0.0), np.eye(3) * 1e-6, 50, 0.1, points)
    (back,) = as_filed([edge], team, mounts)
    assert LENS.fx_px * np.abs(back.correspondences.rays_a - filed).max() < TOLERANCE_PX
    assert LENS.fx_px * np.abs(true - filed).max() > 20 * TOLERANCE_PX
    np.testing.assert_array_equal(back.correspondences.rays_b, filed)  # robot B is as filed
    np.testing.assert_allclose(back.correspondences.sigma_a, sigma * 0.998)
    (untouched,) = as_filed([edge], team, [])
    assert untouched is edge
    bare = replace(edge, correspondences=None)
    assert as_filed([bare], team, mounts) == (bare,)


def test_equal_rays_stay_equal(tmp_path):
    # A keypoint that several pairs share is recognised by its bits.
    rays = np.random.default_rng(2).uniform(-0.5, 0.5, (37, 2))
    sigma = np.full(37, 1e-3)
    whole = Correspondences(rays, rays, sigma, sigma)
    part = Correspondences(rays[5:16], rays[5:16], sigma[5:16], sigma[5:16])
    mounts = [found("A", focal=0.0013)]
    edges = [RelativePose(A, B, Se2(0, 0, 0), np.eye(3), 9, 0.1, p) for p in (whole, part)]
    one, other = as_filed(edges, robots(tmp_path), mounts)
    np.testing.assert_array_equal(one.correspondences.rays_a[5:16], other.correspondences.rays_a)


def test_a_wrong_mount_costs_pairs_only_at_the_first_look():
    tilt_off = math.radians(1.2)
    options = with_settings(RunOptions(), QUICK)
    filed = tuple(with_tilt(robot, tilt_off) for robot in read_team(painted_pair(), ["A", "B"]))
    once = fuse_robots(filed, replace(options, more_looks=0), 2, silent, Stopwatch())
    again = fuse_robots(filed, options, 2, silent, Stopwatch())
    assert again.robots == once.robots == filed
    for robot, camera in zip(filed, again.cameras, strict=True):
        change = camera.camera.mount.attitude.tilt_rad - robot.camera.mount.attitude.tilt_rad
        found = next(m for m in again.bundled.mounts if m.robot == robot.name).tilt_rad
        assert found.used
        assert math.isclose(change, found.value)
        # The mean wobble of a dozen views, 0.5 deg / sqrt(12), is part of what is found.
        assert abs(change + tilt_off) < 3 * math.radians(0.15)
    assert len(accepted_edges(again.team, again.edges)) >= len(
        accepted_edges(once.team, once.edges)
    )
    truth = {f: p for robot in filed for f, p in robot.truth.items()}
    first, last = (accuracy(some.team.team_from_base, truth).ate_m for some in (once, again))
    assert last < 0.7 * first  # Pose2 graphs: the motions themselves are better


def with_tilt(robot, off_rad):
    attitude = robot.camera.mount.attitude
    attitude = replace(attitude, tilt_rad=attitude.tilt_rad + off_rad)
    camera = replace(robot.camera, mount=replace(robot.camera.mount, attitude=attitude))
    frames = tuple(replace(frame, attitude=attitude) for frame in robot.frames)
    return replace(robot, camera=camera, frames=frames)
