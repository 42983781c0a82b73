"""Correspondences laid on each other: what the bundle gets, and what is not made twice."""

import math
from dataclasses import replace

import numpy as np
import pytest
from painted_team import HEIGHT_M, PAIR, QUICK, SIGMA, painted_pair

from groundfuse.backend.bundle_tracks import matched
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, Se2
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.frontend.patches import Keypoints, PatchOptions, empty_templates
from groundfuse.tools import aligned_keypoints as module
from groundfuse.tools.aligned_keypoints import KIND, Desk, _keys, aligned_keypoints, near_parts
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.pipeline import Stopwatch, fuse_robots
from groundfuse.tools.settings import with_settings
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.team_graphs import accepted_edges
from groundfuse.tools.workers import silent

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
    return aligned_keypoints(fused.robots, fused.robots, fused.team, edges, options, desk)


def as_detected(fused, edges):
    return matched(edges, {frame: k for k, frame in enumerate(sorted(fused.team.team_from_base))})


def of_edge(found, number):
    """An edge's correspondences: frames, rays and sigmas of both ends."""
    mine, seen = found.links.edge == number, found.sightings
    ends = (found.links.a[mine], found.links.b[mine])
    return [part[end] for end in ends for part in (seen.frame, seen.ray, seen.sigma)]


def same(found, known, numbers=None, rtol=0.0):
    """Whether edges (all, or these of `found`) have the same correspondences, or nearly."""
    count = int(max(found.links.edge.max(), known.links.edge.max())) + 1
    numbers = range(count) if numbers is None else numbers
    return all(
        one.shape == other.shape and np.allclose(one, other, rtol=rtol, atol=0.0)
        for place, number in enumerate(numbers)
        for one, other in zip(of_edge(found, number), of_edge(known, place), strict=True)
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


def true_misses_m(fused, found):
    """How far both ends of each correspondence truly lie apart on the floor, m."""
    attitude, of = true_attitudes(), {robot.name: robot for robot in fused.robots}
    seen, place = found.sightings, np.full((len(found.sightings), 2), np.nan)
    for number, frame in enumerate(sorted(fused.team.team_from_base)):
        robot, mine = of[frame.robot], seen.frame == number
        foot = robot.truth[frame] @ robot.camera.mount.base_from_foot
        place[mine] = foot.apply(floor_from_rays(attitude[frame], seen.ray[mine]))
    return np.hypot(*(place[found.links.a] - place[found.links.b]).T)


def test_what_belongs_together_lies_nearer(fused, accepted):
    before = true_misses_m(fused, as_detected(fused, accepted))
    after = true_misses_m(fused, run(fused, accepted))
    # 0.58 and 0.37 of what it was, and 0.78 of the correspondences.
    assert np.median(after) < 0.7 * np.median(before)
    assert np.quantile(after, 0.9) < 0.7 * np.quantile(before, 0.9)
    assert len(after) > 0.7 * len(before)


def test_a_keypoint_of_several_pairs_stays_one(fused, accepted):
    before, found = as_detected(fused, accepted), run(fused, accepted)
    linked = np.unique([found.links.a, found.links.b])
    assert len(linked) <= len(before.sightings)
    assert len(found.links) > 1.2 * len(linked) / 2.0  # several are of more than one pair


def test_the_correspondences_stay_between_their_frames(fused, accepted):
    found, frames = run(fused, accepted), sorted(fused.team.team_from_base)
    assert (np.diff(found.links.edge) >= 0).all()
    for number, edge in enumerate(accepted):
        frame_a, _, _, frame_b, _, _ = of_edge(found, number)
        assert len(frame_a) >= OPTIONS.min_links
        assert {frames[k] for k in frame_a.tolist()} == {edge.a}
        assert {frames[k] for k in frame_b.tolist()} == {edge.b}


def test_threads_and_runs_give_the_same_bits(fused, accepted):
    assert same(run(fused, accepted, num_threads=1), run(fused, accepted, num_threads=3))


def test_little_room_gives_the_same_bits(fused, accepted):
    """Ten patches and no picture at a time."""
    little = replace(OPTIONS, cache_bytes=10 * empty_templates(1, OPTIONS).nbytes)
    assert same(run(fused, accepted[:3], little), run(fused, accepted[:3]))


def test_parts_are_pieces_of_floor():
    """Cameras all over a square, each with its keypoints around it, in an order that says nothing.

    A sixteenth of the floor is seen by few more than a sixteenth of the cameras.
    """
    rng = np.random.default_rng(6)
    cameras = rng.uniform(0.0, 40.0, (1600, 2))
    view = rng.integers(0, 1600, 16_000)
    floor = cameras[view] + rng.uniform(-0.5, 0.5, (16_000, 2))
    numbers = np.arange(16_000) + 7
    parts = near_parts(numbers, floor, 1000)
    assert [len(part) for part in parts] == [1000] * 16
    assert sorted(np.concatenate(parts)) == numbers.tolist()
    read = sum(len(np.unique(view[part - 7])) for part in parts)
    # Of the 10 m around a part, cameras up to half a metre beyond count: 1.21 times as many. Parts
    # that begin in one strip and end in the next have a longer border.
    assert read < 1.4 * 1600
    in_order = [numbers[first : first + 1000] for first in range(0, 16_000, 1000)]
    assert sum(len(np.unique(view[part - 7])) for part in in_order) > 4 * 1600


def test_one_part_stays_as_it_is():
    numbers, floor = np.array([5, 3, 9]), np.array([[0.0, 2.0], [1.0, 2.0], [-1.0, 2.0]])
    assert [part.tolist() for part in near_parts(numbers, floor, 3)] == [[5, 3, 9]]
    assert near_parts(numbers[:0], floor[:0], 3) == []
    parts = near_parts(numbers, floor, 2)  # a floor without width
    assert [part.tolist() for part in parts] == [[9, 5], [3]]


def test_the_order_of_the_pairs_does_not_matter(fused, accepted):
    backwards = range(len(accepted) - 1, -1, -1)
    # A keypoint's variance is a mean over its pairs, in their order.
    assert same(run(fused, accepted[::-1]), run(fused, accepted), backwards, rtol=1e-14)


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
    aligned_keypoints(fused.robots, fused.robots, fused.team, accepted, OPTIONS, desk)
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
    before = as_detected(fused, accepted)
    assert same(run(fused, accepted, replace(OPTIONS, min_links=10_000)), before)
    assert same(run(fused, accepted, replace(OPTIONS, min_correlation=1.01)), before)


def test_a_pair_that_keeps_too_few_does_not_touch_the_others(fused, accepted):
    """It keeps what the detector saw, where the others have the same keypoints aligned."""
    before, found = as_detected(fused, accepted), run(fused, accepted)
    counts = np.bincount(found.links.edge)
    few = int(np.argmin(counts))
    assert (counts > counts[few]).any()
    some = run(fused, accepted, replace(OPTIONS, min_links=int(counts[few]) + 1))
    for number, count in enumerate(counts.tolist()):
        known = before if count == counts[few] else found
        ends = zip(of_edge(some, number), of_edge(known, number), strict=True)
        assert all(np.array_equal(one, other) for one, other in ends)


def test_it_can_be_left_out(fused, accepted):
    left_out = run(fused, accepted, replace(OPTIONS, use=False))
    assert same(left_out, as_detected(fused, accepted))


def test_edges_without_correspondences_have_no_links(fused, accepted):
    odometry = RelativePose(FrameId("A", 0), FrameId("A", 1), Se2(0.2, 0.0, 0.15), np.eye(3))
    assert len(run(fused, [odometry]).links) == 0
    assert same(
        run(fused, [odometry, *accepted]), run(fused, accepted), range(1, len(accepted) + 1)
    )


def test_a_large_team_aligns_a_part(fused, accepted, monkeypatch):
    monkeypatch.setattr(module, "LEAST_SIGHTINGS", 20)
    some = run(fused, accepted, replace(OPTIONS, min_links=1), most_sightings=1)
    count, whole = len(some.links), len(as_detected(fused, accepted).links)
    assert 0 < count < 0.7 * whole
