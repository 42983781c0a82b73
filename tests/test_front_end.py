"""The whole front-end on small teams: right edges, reasons for the rest, the same every time."""

import contextlib
import dataclasses
import functools
import math
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from floor_pairs import camera, drawn, error_of, nees, photo, true_motion
from scipy import stats

from groundfuse.backend.measurement import (
    Attitude,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
)
from groundfuse.frontend.ahead import AHEAD, in_threads
from groundfuse.frontend.consensus import Gate
from groundfuse.frontend.fit import Prior
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.frontend.pairs import PairOptions
from groundfuse.frontend.repetition import REPEATS
from groundfuse.frontend.retrieval import RetrievalOptions
from groundfuse.tools import front_end
from groundfuse.tools.errors import DataError
from groundfuse.tools.front_end import FrontEndResult, run_front_end
from groundfuse.tools.front_end_options import FrontEndOptions, Matcher, with_matcher
from groundfuse.tools.overlap import true_overlap
from groundfuse.tools.pair_verdict import Spot, compare, look, odometry_gate, swayed
from groundfuse.tools.robot import Frame, Odometry, Robot
from groundfuse.tools.similar import similar_pairs
from groundfuse.tools.store import Store
from groundfuse.tools.workers import Threads, silent

BARREL = (-0.2, 0.05, 1e-3, -8e-4, 0.0)
CAMERAS = {
    "A": camera(33.0, base_from_foot=Se2(0.1, 0.02, 0.1)),
    "B": camera(42.0, coefficients=BARREL, focal_px=240.0, base_from_foot=Se2(-0.05, 0.0, -0.2)),
}
PATHS = {
    "A": [Se2(0.15 * k, 0.02 * k * k, 0.2 * k) for k in range(6)],
    "B": [Se2(0.75 - 0.15 * k, 0.62, -2.2) for k in range(2)],
}
BLACK = FrameId("A", 3)
OPTIONS = FrontEndOptions(pairs=PairOptions(retrieval=RetrievalOptions(num_frames=3)))


@functools.cache
def shots(floor="speckle"):
    """All photographs by frame."""
    return {
        FrameId(name, k): photo(CAMERAS[name], pose, floor, FrameId(name, k))
        for name, path in PATHS.items()
        for k, pose in enumerate(path)
    }


def robot(name, folder=Path(), count=None, odometry=None):
    """A robot as read from a folder; `odometry(k)` gives each frame's."""
    cam = CAMERAS[name]
    frames = tuple(
        Frame(
            FrameId(name, k),
            folder / f"{name}{k}.png",
            float(k),
            cam.mount.attitude,
            cam.mount.sigma,
            odometry(k) if odometry else None,
        )
        for k in range(count or len(PATHS[name]))
    )
    return Robot(name, cam, frames)


def run(robots, *, options=OPTIONS, workers=1, progress=silent, store=None):
    def stage(_name):
        return contextlib.nullcontext()

    return run_front_end(robots, options, Threads(workers), store or Store(), progress, stage)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("team")
    for frame, shot in shots().items():
        image = np.zeros_like(shot.image) if frame == BLACK else shot.image
        assert cv2.imwrite(str(place / f"{frame}.png"), image)
    return place


@pytest.fixture(scope="module")
def team(folder):
    return robot("A", folder), robot("B", folder)


STAGES: list[tuple[str, int]] = []


@pytest.fixture(scope="module")
def found(team) -> FrontEndResult:
    def recorded(items, total, title):
        STAGES.append((title, total))
        return items

    return run(team, progress=recorded)


def test_every_edge_is_right(found):
    scores = []
    for edge in found.edges:
        truth = true_motion(shots()[edge.a], shots()[edge.b])
        error = error_of(edge.a_from_b, truth)
        assert np.hypot(*error[:2]) < 0.01
        assert abs(error[2]) < math.radians(0.5)
        scores.append(nees(edge.a_from_b, edge.covariance, truth))
    # Edges share frames and so their wobble: the sum spreads more than a chi square's. Seen 2.7.
    assert 0.8 < np.mean(scores) < 6.0


def test_every_overlap_is_an_edge(found):
    edges = {(edge.a, edge.b) for edge in found.edges}
    seen = shots()
    for a in seen:
        for b in seen:
            if a < b and BLACK not in (a, b) and true_overlap(seen[a].view, seen[b].view) > 0.5:
                assert (a, b) in edges
    assert any(a.robot != b.robot for a, b in edges)


def test_a_black_image_is_turned_down_and_bridged(found):
    """Its neighbours are tried and fail with the number; the chain goes on without it."""
    refused = {(r.a, r.b): r for r in found.rejected}
    for near in (FrameId("A", 2), FrameId("A", 4)):
        result = refused[tuple(sorted((near, BLACK)))]
        assert (result.reason, result.value, result.limit) == (Reason.FEW_FEATURES, 0.0, 20.0)
    assert all(BLACK not in (edge.a, edge.b) for edge in found.edges)
    assert (FrameId("A", 2), FrameId("A", 4)) in {(edge.a, edge.b) for edge in found.edges}


def test_a_skip_is_tried_only_where_the_chain_is_cut(team):
    """Without retrieval: neighbours, then the three skips over the black frame, then no more."""
    lean = FrontEndOptions(pairs=PairOptions(retrieval=RetrievalOptions(num_frames=0)))
    titles = []

    def recorded(items, total, title):
        titles.append((title, total))
        return items

    result = run(team[:1], options=lean, progress=recorded)
    assert titles == [("features", 6), ("pairs", 5), ("bridging 2", 3)]
    assert len(result.edges) == 4
    off = dataclasses.replace(lean, pairs=dataclasses.replace(lean.pairs, max_skip=1))
    cut = run(team[:1], options=off)
    assert (FrameId("A", 2), FrameId("A", 4)) not in {(edge.a, edge.b) for edge in cut.edges}


def test_every_pair_ends_once_and_in_order(found):
    pairs = [(r.a, r.b) for r in found.edges] + [(r.a, r.b) for r in found.rejected]
    assert len(pairs) == len(set(pairs))
    assert STAGES[0] == ("features", len(shots()))
    assert sum(total for _, total in STAGES[1:]) == len(pairs)  # none is tried twice
    assert all(a < b for a, b in pairs)
    for part in (found.edges, found.rejected):
        assert [(r.a, r.b) for r in part] == sorted((r.a, r.b) for r in part)
    assert set(found.repetition) == set(shots())
    assert all(second < REPEATS for second in found.repetition.values())


def assert_same(one, two):
    assert one.rejected == two.rejected
    assert [(e.a, e.b, e.a_from_b, e.num_inliers, e.ambiguity) for e in one.edges] == [
        (e.a, e.b, e.a_from_b, e.num_inliers, e.ambiguity) for e in two.edges
    ]
    for a, b in zip(one.edges, two.edges, strict=True):
        np.testing.assert_array_equal(a.covariance, b.covariance)
        np.testing.assert_array_equal(a.correspondences.rays_b, b.correspondences.rays_b)


def test_neither_workers_nor_order_matter(team, found):
    """To the bit: three threads, the robots the other way round."""
    assert_same(run(team[::-1], workers=3), found)


class Elsewhere:
    """Gives its work away, as a cluster does, but has threads here."""

    num_threads = 3

    def __init__(self):
        self.look, self.compare = Threads(1).look, Threads(1).compare


def test_what_is_not_given_away_uses_the_threads_there_are_here(team, found, monkeypatch):
    """Retrieval is done here, whoever looks and compares."""
    asked = []

    def counted(*arguments):
        asked.append(arguments[-1])
        return similar_pairs(*arguments)

    monkeypatch.setattr(front_end, "similar_pairs", counted)
    for workers in (Elsewhere(), Threads(2)):
        stage = contextlib.nullcontext
        assert_same(run_front_end(team, OPTIONS, workers, Store(), silent, stage), found)
    assert asked == [3, 2]


def test_an_unreadable_picture_stops_with_its_path(folder):
    missing = dataclasses.replace(robot("A", folder).frames[0], path=folder / "gone.png")
    lone = Robot("A", CAMERAS["A"], (missing,))
    with pytest.raises(DataError, match=r"gone\.png"):
        run((lone,))


def test_one_frame_is_a_team(folder):
    result = run((robot("B", folder, count=1),))
    assert (result.edges, result.rejected) == ((), ())
    assert list(result.repetition) == [FrameId("B", 0)]


def test_threads_keep_the_order():
    def work(item):
        time.sleep(0.001 * (item % 3))
        return -item

    for workers in (1, 2, 4):
        assert list(in_threads(work, range(40), workers)) == [-k for k in range(40)]
        assert list(in_threads(work, [], workers)) == []


def test_threads_begin_little_ahead_and_nothing_after_the_end():
    begun = []
    results = in_threads(begun.append, range(1000), 2)
    next(results)
    results.close()
    assert 0 < len(begun) <= 2 * AHEAD


def test_a_failure_in_a_thread_ends_the_work():
    begun = []

    def work(item):
        begun.append(item)
        if item == 5:
            raise DataError("five")

    for workers in (1, 2):
        with pytest.raises(DataError, match="five"):
            list(in_threads(work, range(1000), workers))
    assert len(begun) < 100


def test_matchers_bring_what_they_need():
    plain = FrontEndOptions()
    fast = with_matcher(plain, Matcher.FAST)
    assert (fast.features.kind, fast.photometric, fast.matcher) == ("orb", True, Matcher.FAST)
    paper = with_matcher(plain, Matcher.PAPER)
    assert (paper.features.kind, paper.photometric, paper.matcher) == ("sift", False, Matcher.PAPER)
    _, seen = look_at(FrameId("A", 0), options=fast)
    assert (seen.features.descriptors.dtype, seen.paper) == (np.uint8, None)
    assert seen.grey is not None


def look_at(frame, floor="speckle", options=OPTIONS, odometry=None, **changes):
    member = robot(frame.robot, odometry=odometry)
    known = dataclasses.replace(member.frames[frame.index], **changes)
    return look(shots(floor)[frame].image, member, known, options)


def motion_between(a, b, floor="speckle"):
    return true_motion(shots(floor)[a], shots(floor)[b])


def test_the_fast_preset_is_as_good():
    fast = with_matcher(FrontEndOptions(), Matcher.FAST)
    a, b = FrameId("A", 0), FrameId("A", 1)
    result = compare(look_at(a, options=fast), look_at(b, options=fast), fast)
    assert isinstance(result, RelativePose)
    error = error_of(result.a_from_b, motion_between(a, b))
    assert np.hypot(*error[:2]) < 0.0015  # ORB alone is good to 3 mm; seen 0.4 mm
    assert abs(error[2]) < math.radians(0.1)
    assert nees(result.a_from_b, result.covariance, motion_between(a, b)) < 16.0


def test_a_frame_list_that_knows_the_attitude_helps():
    """True attitudes with small sigmas instead of the mount's: the wobble's share goes."""
    a, b = FrameId("A", 0), FrameId("A", 1)
    sure = Attitude(1e-5, 1e-5, 1e-6)
    plain = compare(look_at(a), look_at(b), OPTIONS)
    known = [look_at(f, attitude=shots()[f].attitude, sigma=sure) for f in (a, b)]
    told = compare(*known, OPTIONS)
    assert np.linalg.det(told.covariance) < 0.1 * np.linalg.det(plain.covariance)
    error = error_of(told.a_from_b, motion_between(a, b))
    assert np.hypot(*error[:2]) < 0.0004  # seen 0.1 mm
    assert nees(told.a_from_b, told.covariance, motion_between(a, b)) < 16.0


@pytest.mark.parametrize("height_m", [0.1, 70.0])
def test_the_same_world_at_another_scale_gives_the_same_in_heights(height_m):
    """A scrubber and a drone over floors of their grain: one picture, one result."""
    ends = []
    for h in (0.55, height_m):
        cam, k = camera(33.0, h), h / 0.55
        poses = Se2(0.0, 0.0, 0.2), Se2(0.2 * k, 0.03 * k, 0.4)
        seen, taken = [], []
        for name, pose in zip("AB", poses, strict=True):
            shot = photo(cam, pose, frame=FrameId(name, 0))
            frame = Frame(shot.id, Path(), 0.0, cam.mount.attitude, cam.mount.sigma)
            seen.append(look(shot.image, Robot(name, cam, (frame,)), frame, OPTIONS))
            taken.append(shot)
        result = compare(*seen, OPTIONS)
        assert isinstance(result, RelativePose)
        truth = true_motion(*taken)
        assert nees(result.a_from_b, result.covariance, truth) < stats.chi2.ppf(0.9999, 3)
        scale = np.array([k, k, 1.0])
        ends.append(
            (error_of(result.a_from_b, truth) / scale, np.sqrt(np.diag(result.covariance)) / scale)
        )
    (error, sigma), (other, other_sigma) = ends
    # The same picture but for its rounding; seen a third of a sigma.
    assert (np.abs(error - other) < sigma).all()
    np.testing.assert_allclose(other_sigma, sigma, rtol=0.2)


# Tiles repeat after 200 cells of 0.75 mm.
PERIOD_M = 0.15
TILED = FrameId("A", 0), FrameId("A", 1), FrameId("A", 2)


def driven(path, sigma, off=lambda _k: Se2(0.0, 0.0, 0.0)):
    """Odometry of a path: where the robot believed to be, `off` from the truth."""
    return lambda k: Odometry(path[k] @ off(k), sigma)


@functools.cache
def tiled(sigma=None, slip=Se2(0.0, 0.0, 0.0)):  # noqa: B008
    odometry = None
    if sigma is not None:
        odometry = driven(PATHS["A"], sigma, lambda k: slip if k else Se2(0.0, 0.0, 0.0))
    return [look_at(frame, "tiles", odometry=odometry) for frame in TILED]


def tile_results(seen):
    return [compare(seen[i], seen[j], OPTIONS) for i, j in ((0, 1), (1, 2), (0, 2))]


def test_no_edge_on_identical_tiles_without_a_prior():
    seen = tiled()
    assert all(s.features.repetition > REPEATS for _, s in seen)
    for result in tile_results(seen):
        assert isinstance(result, Rejected)
        assert result.reason is Reason.AMBIGUOUS
        assert result.value > result.limit == 0.6


def test_odometry_better_than_half_a_tile_makes_tiles_a_floor():
    """4 sigmas of 6 mm and 0.3 deg are 30 mm per step; the robot slipped by 9 mm."""
    sigma = Se2(0.006, 0.006, math.radians(0.3))
    seen = tiled(sigma, Se2(0.007, -0.006, math.radians(0.3)))
    for result, (i, j) in zip(tile_results(seen), ((0, 1), (1, 2), (0, 2)), strict=True):
        assert isinstance(result, RelativePose), result
        truth = motion_between(TILED[i], TILED[j], "tiles")
        error = error_of(result.a_from_b, truth)
        assert np.hypot(*error[:2]) < 0.005
        assert nees(result.a_from_b, result.covariance, truth) < stats.chi2.ppf(0.9999, 3)


def test_coarse_odometry_leaves_tiles_ambiguous():
    """A gate that lets a tile's neighbours in must not choose one of them."""
    sigma = Se2(0.05, 0.05, math.radians(1.0))
    for result in tile_results(tiled(sigma, Se2(0.07, 0.0, 0.0))):
        assert isinstance(result, Rejected)
        assert result.reason is Reason.AMBIGUOUS


def on_speckle(sigma, slip, i=0, j=1):
    odometry = driven(PATHS["A"], sigma, lambda k: slip if k else Se2(0.0, 0.0, 0.0))
    a, b = (look_at(FrameId("A", k), odometry=odometry) for k in (i, j))
    return compare(a, b, OPTIONS)


def test_a_motion_that_odometry_rules_out_is_turned_down():
    """The wheels slipped by 4 mm and swear by a tenth of one: the pictures are not believed."""
    sigma = Se2(1e-4, 1e-4, math.radians(0.01))
    result = on_speckle(sigma, Se2(0.004, 0.0, 0.0))
    assert isinstance(result, Rejected)
    assert result.reason is Reason.PRIOR
    assert result.value == pytest.approx(0.004, abs=0.001)
    # Twice four sigmas of a step: x, y, and the turn over the foot's lever of 0.102 m.
    lever = math.hypot(0.1, 0.02) * math.radians(0.01)
    assert result.limit == pytest.approx(8.0 * math.sqrt(2 * 1e-8 + lever**2))
    far = on_speckle(sigma, Se2(0.3, 0.0, 0.0))
    assert isinstance(far, Rejected)
    assert far.reason is Reason.FEW_INLIERS


@pytest.mark.parametrize(("i", "j"), [(0, 1), (1, 2)])
def test_odometry_finer_than_the_wobble_does_no_harm(i, j):
    """The isometries of these pairs are 17 mm off for the wobble; odometry to half a one is not."""
    result = on_speckle(Se2(5e-4, 5e-4, math.radians(0.05)), Se2(0.0, 0.0, 0.0), i, j)
    assert isinstance(result, RelativePose)


@pytest.mark.parametrize("sigma", [(0.03, 1e-4, 1e-4), (1e-4, 0.03, 1e-4), (1e-4, 1e-4, 0.03)])
@pytest.mark.parametrize("tilt_deg", [10.0, 45.0])
def test_the_gate_grows_by_what_wobble_does_to_the_middle_of_the_views(tilt_deg, sigma):
    """Four root mean squares of both views' drawn shifts."""
    cam = camera(tilt_deg, sigma=Attitude(*sigma))
    frame = Frame(FrameId("A", 0), Path(), 0.0, cam.mount.attitude, cam.mount.sigma)
    seen = Spot(frame, Robot("A", cam, (frame,)), b"")
    rng = np.random.default_rng(22)
    axis = np.zeros((1, 2))
    still = floor_from_rays(cam.mount.attitude, axis)
    known = Prior(cam.mount.attitude, cam.mount.sigma)
    shifts = [floor_from_rays(drawn(known, rng), axis) - still for _ in range(400)]
    both = 2.0 * np.mean(np.square(shifts).sum(axis=2))
    wide = swayed(Gate(Se2(0.1, 0.2, 0.3), 0.05, 0.07), seen, seen, OPTIONS)
    # A mean square of 400 draws: 7 %.
    assert wide.radius_m**2 - 0.05**2 == pytest.approx(16.0 * both, rel=0.3)
    assert (wide.a_from_b, wide.turn_rad) == (Se2(0.1, 0.2, 0.3), 0.07)


def turning_robot(rng, count=7):
    """A true path with a turn on the spot, and odometry of it with drawn errors of each step."""
    steps = [Se2(0.2, 0.0, 0.3), Se2(0.0, 0.0, 1.2), Se2(0.15, 0.05, 0.0)]
    truth, believed, sigma = [Se2(1.0, 2.0, 0.5)], [Se2(0.0, 0.0, 0.0)], Se2(0.004, 0.002, 0.02)
    for k in range(count - 1):
        step = steps[k % 3]
        slip = Se2(*(rng.standard_normal(3) * sigma.vector()))
        truth.append(truth[-1] @ step)
        believed.append(believed[-1] @ step @ slip)
    return truth, lambda k: Odometry(believed[k], sigma)


def test_the_odometry_gate_is_as_wide_as_odometry_is_wrong():
    """Root mean square of the foot's and the heading's error against the gate, over four sigmas."""
    rng = np.random.default_rng(21)
    mount = CAMERAS["A"].mount.base_from_foot
    last = 5
    places, turns = [], []
    for _ in range(150):
        truth, odometry = turning_robot(rng)
        seen = [_seen("A", k, odometry) for k in (0, last)]
        gate = odometry_gate(*seen, OPTIONS)
        foot = mount.inverse() @ truth[0].inverse() @ truth[last] @ mount
        error = gate.a_from_b.inverse() @ foot
        places.append((error.x_m**2 + error.y_m**2) / (gate.radius_m / 4.0) ** 2)
        turns.append((error.theta_rad / (gate.turn_rad / 4.0)) ** 2)
    # A mean square of 150 draws of one to two numbers: 12 %.
    assert np.mean(places) == pytest.approx(1.0, abs=0.35)
    assert np.mean(turns) == pytest.approx(1.0, abs=0.4)


def _seen(name, index, odometry):
    """A frame of which only the odometry matters."""
    member = robot(name, odometry=odometry)
    return Spot(member.frames[index], member, b"")


def test_there_is_no_gate_without_odometry_all_the_way():
    sigma = Se2(0.01, 0.01, 0.01)
    full = driven(PATHS["A"], sigma)

    def gap(k):
        return None if k == 2 else full(k)

    assert odometry_gate(_seen("A", 0, full), _seen("A", 3, full), OPTIONS) is not None
    assert odometry_gate(_seen("A", 0, gap), _seen("A", 1, gap), OPTIONS) is not None
    assert odometry_gate(_seen("A", 1, gap), _seen("A", 3, gap), OPTIONS) is None
    assert odometry_gate(_seen("A", 0, gap), _seen("A", 2, gap), OPTIONS) is None
    assert odometry_gate(_seen("A", 0, None), _seen("A", 1, None), OPTIONS) is None
    both = driven(PATHS["B"], sigma)
    assert odometry_gate(_seen("A", 0, full), _seen("B", 1, both), OPTIONS) is None
