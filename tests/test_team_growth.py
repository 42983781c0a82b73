"""A team that grows: what is solved again, and what goes on from what the store knows."""

from dataclasses import replace

import pytest
from painted_team import QUICK, painted_pair

from groundfuse.backend.bundle_estimate import BundleEstimate
from groundfuse.tools import team_graphs
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.pipeline import Stopwatch, fuse_robots
from groundfuse.tools.settings import with_settings
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.workers import silent

# Either answer may lie a fifth of a sigma from the optimum, see `bundle.SETTLED`.
TOLERANCE_SIGMA = 0.5


def fused(robots, store):
    return fuse_robots(
        robots, with_settings(RunOptions(), QUICK), 2, silent, Stopwatch(), store=store
    )


@pytest.fixture
def store():
    with Store() as kept:
        yield kept


def without_last(robots):
    """The team before its last robot's last picture was there."""
    return [*robots[:-1], replace(robots[-1], frames=robots[-1].frames[:-1])]


@pytest.fixture
def counted(monkeypatch):
    """The robots whose own graphs were solved."""
    names = []

    def spy(name, *rest, work=team_graphs.robot_estimate):
        names.append(name)
        return work(name, *rest)

    monkeypatch.setattr(team_graphs, "robot_estimate", spy)
    return names


def test_one_picture_more_solves_its_robot_and_goes_on(counted, store):
    robots = read_team(painted_pair(), ["A", "B"])
    before = fused(without_last(robots), store).bundled
    counted.clear()
    after = fused(robots, store).bundled
    assert counted == ["B"]
    assert isinstance(before, BundleEstimate)
    assert isinstance(after, BundleEstimate)
    total = sum(len(robot.frames) for robot in robots)
    assert before.settled_frames == total - 1
    assert after.settled_frames == total - 1  # it went on
    with Store() as empty:
        alone = fused(robots, empty).bundled
    assert isinstance(alone, BundleEstimate)
    assert alone.settled_frames == total
    assert set(after.attitude) == set(alone.attitude)
    for frame, covariance in alone.team.covariance.items():
        apart = alone.team.team_from_base[frame].inverse() @ after.team.team_from_base[frame]
        assert (abs(apart.vector()) < TOLERANCE_SIGMA * covariance.diagonal() ** 0.5).all()


def test_the_same_again_is_the_same_to_the_bit_whatever_came_later(store):
    robots = read_team(painted_pair(), ["A", "B"])
    first = fused(robots, store).bundled
    fused(without_last(robots), store)
    again = fused(robots, store).bundled
    assert isinstance(first, BundleEstimate)
    assert isinstance(again, BundleEstimate)
    assert again.team.team_from_base == first.team.team_from_base


def test_another_camera_file_starts_over(store):
    robots = read_team(painted_pair(), ["A", "B"])
    fused(without_last(robots), store)
    camera = robots[0].camera
    filed = camera.mount.attitude
    higher = replace(filed, height_m=1.001 * filed.height_m)
    changed = replace(
        robots[0],
        camera=replace(camera, mount=replace(camera.mount, attitude=higher)),
        frames=tuple(replace(frame, attitude=higher) for frame in robots[0].frames),
    )
    after = fused([changed, robots[1]], store).bundled
    assert isinstance(after, BundleEstimate)
    assert after.settled_frames == sum(len(robot.frames) for robot in robots)


def test_another_attitude_of_a_picture_starts_over(store):
    robots = read_team(painted_pair(), ["A", "B"])
    fused(without_last(robots), store)
    some = robots[0].frames[1]
    leaning = replace(some, attitude=replace(some.attitude, tilt_rad=some.attitude.tilt_rad + 1e-4))
    frames = tuple(leaning if f.id == some.id else f for f in robots[0].frames)
    after = fused([replace(robots[0], frames=frames), robots[1]], store).bundled
    assert isinstance(after, BundleEstimate)
    assert after.settled_frames == sum(len(robot.frames) for robot in robots)
