"""Correspondences laid on each other: what the bundle gets, and what is not made twice."""

import math
from dataclasses import replace

import numpy as np
import pytest
from painted_team import HEIGHT_M, PAIR, QUICK, SIGMA, painted_pair, silent

from groundfuse.backend.bundle_tracks import sightings_from_edges
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, Se2
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.frontend.patches import Keypoints, PatchOptions, empty_templates
from groundfuse.tools import aligned_edges as module
from groundfuse.tools.aligned_edges import KIND, Desk, _keys, aligned_edges
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.pipeline import Stopwatch, fuse_robots
from groundfuse.tools.settings import with_settings
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.team_graphs import accepted_edges

OPTIONS = PatchOptions()


@pytest.fixture(scope="module")
def fused():
    robots = read_team(painted_pair(), ["A", "B"])
    chosen = with_settings(RunOptions(), QUICK)
    return fuse_robots(robots, chosen, 2, silent, Stopwatch(), bundled=False)


@pytest.fixture(scope="module")
def accepted(fused):
    return accepted_edges(fused.team, fused.edges)


def desk_of(fused, store=None, num_threads=2, most_sightings=100_000):
    return Desk(fused.front_end.pictures, store or Store(), num_threads, silent, most_sightings)


def run(fused, edges, options=OPTIONS, **means):
    desk = desk_of(fused, **means)
    return aligned_edges(fused.robots, fused.robots, fused.team, edges, options, desk)


def same(found, known):
    return len(found) == len(known) and all(
        np.array_equal(getattr(f.correspondences, name), getattr(k.correspondences, name))
        for f, k in zip(found, known, strict=True)
        for name in ("rays_a", "rays_b", "sigma_a", "sigma_b")
    )


def true_attitudes():
    """As `paint_team` draws them."""
    found = {}
    for number, (name, member) in enumerate(PAIR.items()):
        rng = np.random.default_rng([1, number])
        for index in range(len(member.poses)):
            tilt, roll, height = rng.standard_normal(3).tolist()
            found[FrameId(name, index)] = Attitude(
                math.radians(member.tilt_deg) + tilt * SIGMA.tilt_rad,
                roll * SIGMA.roll_rad,
                HEIGHT_M + height * SIGMA.height_m,
            )
    return found


def true_misses_m(fused, edges):
    """How far both ends of each correspondence truly lie apart on the floor, m."""
    attitude, of = true_attitudes(), {robot.name: robot for robot in fused.robots}
    found = []
    for edge in edges:
        ends = []
        for frame, rays in zip(
            (edge.a, edge.b),
            (edge.correspondences.rays_a, edge.correspondences.rays_b),
            strict=True,
        ):
            robot = of[frame.robot]
            foot = robot.truth[frame] @ robot.camera.mount.base_from_foot
            ends.append(foot.apply(floor_from_rays(attitude[frame], rays)))
        found.append(np.hypot(*(ends[0] - ends[1]).T))
    return np.concatenate(found)


def test_what_belongs_together_lies_nearer(fused, accepted):
    before = true_misses_m(fused, accepted)
    after = true_misses_m(fused, run(fused, accepted))
    # 0.58 and 0.37 of what it was, and 0.78 of the correspondences.
    assert np.median(after) < 0.7 * np.median(before)
    assert np.quantile(after, 0.9) < 0.7 * np.quantile(before, 0.9)
    assert len(after) > 0.7 * len(before)


def test_everything_but_the_correspondences_stays(fused, accepted):
    found = run(fused, accepted)
    for old, new in zip(accepted, found, strict=True):
        assert (new.a, new.b, new.a_from_b) == (old.a, old.b, old.a_from_b)
        assert new.num_inliers == old.num_inliers
        assert np.array_equal(new.covariance, old.covariance)


def test_a_keypoint_of_several_pairs_stays_one(fused, accepted):
    """The pairs' keypoints are known by their rays; joined by them, no more may come out."""
    index_of = {frame: k for k, frame in enumerate(sorted(fused.team.team_from_base))}
    before, _ = sightings_from_edges(accepted, index_of)
    found = run(fused, accepted)
    after, links = sightings_from_edges(found, index_of)
    assert len(after) <= len(before)
    assert len(links) > 1.2 * len(after) / 2.0  # several are of more than one pair


def test_threads_and_runs_give_the_same_bits(fused, accepted):
    assert same(run(fused, accepted, num_threads=1), run(fused, accepted, num_threads=3))


def test_little_room_gives_the_same_bits(fused, accepted):
    """Ten patches and no picture at a time."""
    little = replace(OPTIONS, cache_bytes=10 * empty_templates(1, OPTIONS).nbytes)
    assert same(run(fused, accepted[:3], little), run(fused, accepted[:3]))


def test_the_order_of_the_pairs_does_not_matter(fused, accepted):
    assert same(run(fused, accepted[::-1])[::-1], run(fused, accepted))


def test_what_is_known_is_not_made_again(fused, accepted, monkeypatch):
    store = Store()
    first = run(fused, accepted, store=store)

    def no_picture(*_):
        raise AssertionError("a picture was read")

    monkeypatch.setattr(module, "load_image", no_picture)
    assert same(run(fused, accepted, store=store), first)


def test_a_pair_more_reads_its_pictures_only(fused, accepted, monkeypatch):
    store, loaded = Store(), set()
    last = accepted[-1]
    ends = {last.a, last.b}
    known = [edge for edge in accepted if not ends & {edge.a, edge.b}]
    assert known
    run(fused, known, store=store)
    load = module.load_image

    def noted(frame, camera):
        loaded.add(frame.id)
        return load(frame, camera)

    monkeypatch.setattr(module, "load_image", noted)
    run(fused, [*known, last], store=store)
    assert loaded == ends


@pytest.mark.parametrize("change", [{"radius_px": 6}, {"noise": 0.1}])
def test_other_options_make_it_anew(fused, accepted, change):
    store, other = Store(), replace(OPTIONS, **change)
    run(fused, accepted, store=store)
    assert same(run(fused, accepted, other, store=store), run(fused, accepted, other))
    assert not same(run(fused, accepted, other), run(fused, accepted))


def test_another_picture_of_the_same_name_is_aligned_anew(fused, accepted):
    store = Store()
    run(fused, accepted, store=store)
    before = store.latest(KIND).keys
    frame = accepted[0].a
    pictures = {**fused.front_end.pictures, frame: b"\1" * 20}
    desk = replace(desk_of(fused, store), pictures=pictures)
    aligned_edges(fused.robots, fused.robots, fused.team, accepted, OPTIONS, desk)
    gone = ~np.isin(before, store.latest(KIND).keys)
    assert 0 < gone.sum() < len(before)


def test_an_alignment_is_known_by_both_pictures():
    rays = np.array([[0.1, 0.2], [0.1, 0.25], [0.3, 0.1]])
    number = np.array([0, 1, 1])
    points = Keypoints(number, rays, rays, np.ones(3), np.array([0, 0, 2]))
    keys = _keys(np.array([5, 6]), points)
    assert (_keys(np.array([7, 6]), points) != keys).tolist() == [True, True, False]
    assert (_keys(np.array([5, 7]), points) != keys).tolist() == [False, True, True]


def test_pairs_that_would_keep_too_few_stay_as_they_are(fused, accepted):
    assert run(fused, accepted, replace(OPTIONS, min_links=10_000)) == tuple(accepted)
    assert run(fused, accepted, replace(OPTIONS, min_correlation=1.01)) == tuple(accepted)


def test_it_can_be_left_out(fused, accepted):
    assert run(fused, accepted, replace(OPTIONS, use=False)) == tuple(accepted)


def test_edges_without_correspondences_pass_through(fused, accepted):
    odometry = RelativePose(FrameId("A", 0), FrameId("A", 1), Se2(0.2, 0.0, 0.15), np.eye(3))
    assert run(fused, [odometry]) == (odometry,)
    assert run(fused, [*accepted, odometry])[-1] is odometry


def test_a_large_team_aligns_a_part(fused, accepted, monkeypatch):
    monkeypatch.setattr(module, "LEAST_SIGHTINGS", 20)
    some = run(fused, accepted, replace(OPTIONS, min_links=1), most_sightings=1)
    count, whole = (sum(len(e.correspondences) for e in part) for part in (some, accepted))
    assert 0 < count < 0.7 * whole
