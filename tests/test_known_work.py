"""What the store knows is not done again; what is new is; and the result is that of a fresh run."""

import contextlib
import dataclasses
import shutil

import cv2
import pytest
from painted_team import QUICK, copied_pair, painted_pair

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.tools import front_end
from groundfuse.tools.errors import DataError
from groundfuse.tools.frame_look import look_done, look_job, picture_of
from groundfuse.tools.front_end import Reused, run_front_end
from groundfuse.tools.front_end_options import Matcher, with_matcher
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.packing import packed
from groundfuse.tools.settings import with_settings
from groundfuse.tools.shelf import Shelf
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.workers import Threads

OPTIONS = with_settings(RunOptions(), QUICK).front_end
FRAMES, PAIRS = 7, 21  # so few frames that retrieval pairs each with each


def stage(_name):
    return contextlib.nullcontext()


def run(team, store, options=OPTIONS, robots=("A", "B")):
    """The result, and how many of each were worked on."""
    worked = {}

    def noted(items, total, title):
        worked[title] = total
        return items

    if not isinstance(team, tuple):
        team = read_team(team, robots)
    return run_front_end(team, options, Threads(2), store, noted, stage), worked


def bits(found):
    """Everything that was found, as bytes."""
    return packed((found.edges, found.rejected, found.repetition, found.key))


@pytest.fixture(scope="module")
def first():
    store = Store()
    return *run(painted_pair(), store), store


def copy_of(store):
    """A store of its own with the same content."""
    copied = Store()
    store._base.backup(copied._base)
    return copied


@pytest.fixture
def known(first):
    return copy_of(first[2])


def test_a_first_run_does_everything(first):
    found, worked, _ = first
    assert worked == {"features": FRAMES, "pairs": PAIRS}
    assert found.reused == Reused(0, FRAMES, 0, PAIRS)
    assert found.reused.line() == ""
    assert len(found.edges) >= 10


def test_a_second_run_does_nothing_and_finds_the_same_bits(first, known):
    again, worked = run(painted_pair(), known)
    assert worked == {}
    assert bits(again) == bits(first[0])
    assert again.reused.line() == "from the store: 7 of 7 pictures, 21 of 21 pairs"


def assert_as_fresh(found, team, options=OPTIONS):
    fresh, _ = run(team, Store(), options)
    assert bits(found) == bits(fresh)


@pytest.mark.parametrize("place", ["img_00a.png", "img_99.png"])
def test_a_picture_that_is_added_anywhere_costs_itself_and_its_pairs(tmp_path, known, place):
    """In the middle it moves the numbers of those behind it; what they are worth stays."""
    team = copied_pair(tmp_path / "team")
    images = team / "A" / "images"
    picture = cv2.imread(str(images / "img_01.png"))
    assert cv2.imwrite(str(images / place), picture[:, ::-1])
    found, worked = run(team, known)
    assert worked == {"features": 1, "pairs": FRAMES}
    assert len(found.edges) + len(found.rejected) == PAIRS + FRAMES
    assert_as_fresh(found, team)


def test_a_picture_that_is_removed_costs_nothing(tmp_path, known):
    team = copied_pair(tmp_path / "team")
    (team / "A" / "images" / "img_00.png").unlink()
    (team / "A" / "groundtruth.tum").unlink()
    found, worked = run(team, known)
    assert worked == {}
    assert FrameId("A", 3) not in found.repetition
    assert_as_fresh(found, team)


def test_a_robot_that_joins_costs_its_own():
    store = Store()
    run(painted_pair(), store, robots=["A"])
    found, worked = run(painted_pair(), store)
    assert worked == {"features": 3, "pairs": PAIRS - 6}
    assert_as_fresh(found, painted_pair())


def test_a_robot_may_be_called_otherwise(tmp_path, known):
    """Pairs are the same as long as the order of the two names is."""
    team = copied_pair(tmp_path / "team")
    shutil.move(team / "B", team / "Z")
    found, worked = run(team, known, robots=["A", "Z"])
    assert worked == {}
    assert FrameId("Z", 2) in found.repetition
    assert {f.robot for e in found.edges for f in (e.a, e.b)} == {"A", "Z"}


def changed(name, **how):
    """The painted team with other cameras for one robot."""
    team = read_team(painted_pair(), ["A", "B"])
    return tuple(
        dataclasses.replace(
            robot,
            camera=dataclasses.replace(
                robot.camera, mount=dataclasses.replace(robot.camera.mount, **how)
            ),
        )
        if robot.name == name
        else robot
        for robot in team
    )


def test_a_camera_that_moves_on_its_robot_costs_the_pairs_of_that_robot(known):
    team = changed("B", base_from_foot=Se2(0.3, 0.1, 0.2))
    found, worked = run(team, known)
    assert worked == {"pairs": PAIRS - 6}  # all but those of A alone
    assert_as_fresh(found, team)


def test_another_calibration_costs_the_pictures_of_that_robot(known):
    team = read_team(painted_pair(), ["A", "B"])
    lens = dataclasses.replace(team[1].camera.intrinsics, fx_px=191.5)
    camera = dataclasses.replace(team[1].camera, intrinsics=lens)
    team = (team[0], dataclasses.replace(team[1], camera=camera))
    found, worked = run(team, known)
    assert worked == {"features": 3, "pairs": PAIRS - 6}
    assert_as_fresh(found, team)


@pytest.mark.parametrize(
    ("settings", "looks", "pairs"),
    [
        (["features.max_features=550"], FRAMES, PAIRS),
        (["match.min_votes=13"], 0, PAIRS),
        (["motion.max_ambiguity=0.5"], 0, PAIRS),
        (["pairs.retrieval.num_features=149"], 0, 0),
        (["paper.min_segments=4"], 0, 0),  # of a matcher that is not asked
        (["odometry_gate_sigmas=3"], 0, 0),  # there is no odometry
    ],
)
def test_an_option_costs_what_depends_on_it(known, settings, looks, pairs):
    options = with_settings(OPTIONS, settings)
    found, worked = run(painted_pair(), known, options)
    assert (worked.get("features", 0), worked.get("pairs", 0)) == (looks, pairs)
    assert_as_fresh(found, painted_pair(), options)


def test_two_ways_are_kept_side_by_side(known, first):
    """To and fro between two options costs once."""
    other = with_settings(OPTIONS, ["match.min_votes=13"])
    run(painted_pair(), known, other)
    for options in (OPTIONS, other):
        assert run(painted_pair(), known, options)[1] == {}
    assert bits(run(painted_pair(), known)[0]) == bits(first[0])


@pytest.mark.parametrize("matcher", [Matcher.FAST, Matcher.PAPER])
def test_the_other_matchers_looks_come_back_whole(matcher):
    """All that matching needs survives the store, also the grey pictures and the profiles."""
    options = with_matcher(OPTIONS, matcher)
    store = Store()
    robots = ["B"]
    found, _ = run(painted_pair(), store, options, robots)
    store._base.execute("DELETE FROM entry WHERE kind = 'pair'")
    again, worked = run(painted_pair(), store, options, robots)
    assert worked == {"pairs": 3}
    assert bits(again) == bits(found)


def jobs():
    (robot,) = read_team(painted_pair(), ["B"])
    return [look_job(robot, frame, OPTIONS) for frame in robot.frames]


def test_a_shelf_holds_no_more_than_it_may():
    store, orders = Store(), jobs()
    data = [look_done(picture_of(job), job, OPTIONS) for job in orders]
    room = len(data[0]) + len(data[1])
    held = Shelf(store, {job.key: job for job in orders}, OPTIONS, room)
    for job, found in zip(orders, data, strict=True):
        held.put(job, found)
        assert held.num_bytes <= room
    for job, found in zip(orders, data, strict=True):
        assert packed(held.looked(job.key)) == found
        assert held.packed(job.key) == found
        assert held.num_bytes <= room
    latest = held.looked(orders[-1].key)
    assert held.looked(orders[-1].key) is latest


def test_a_damaged_entry_is_looked_at_again(known, first, caplog):
    """It is found when a pair needs it."""
    known._base.execute("DELETE FROM entry WHERE kind = 'pair' AND label = 'A0-A1'")
    known._base.execute("UPDATE entry SET value = zeroblob(9) WHERE kind = 'look' AND label = 'A1'")
    again, worked = run(painted_pair(), known)
    assert worked == {"pairs": 1}
    assert bits(again) == bits(first[0])
    assert caplog.messages == ["None: look of A1 is damaged, computed anew"]
    assert run(painted_pair(), known)[1] == {}


def test_a_picture_that_changes_during_the_run_is_refused(tmp_path):
    """A digest of one content must not come to stand for the features of another."""
    team = copied_pair(tmp_path / "team")
    (robot,) = read_team(team, ["B"])
    job = look_job(robot, robot.frames[1], OPTIONS)
    picture_of(job)
    path = robot.frames[1].path
    shutil.copy(robot.frames[2].path, path)
    with pytest.raises(DataError, match=r"img_01\.png: has changed since the run began$"):
        picture_of(job)
    path.unlink()
    with pytest.raises(DataError, match=r"img_01\.png: cannot read: No such file"):
        picture_of(job)


def test_what_a_run_found_before_it_broke_off_is_not_done_again(monkeypatch, first):
    """At any pair: the next run goes on with the next."""
    store, done, keep = Store(), [], front_end._Pairs._keep

    def breaking(self, job, data):
        if len(done) == 5:
            raise KeyboardInterrupt
        done.append(job)
        keep(self, job, data)

    monkeypatch.setattr(front_end._Pairs, "_keep", breaking)
    with pytest.raises(KeyboardInterrupt):
        run(painted_pair(), store)
    monkeypatch.setattr(front_end._Pairs, "_keep", keep)
    again, worked = run(painted_pair(), store)
    assert worked == {"pairs": PAIRS - 5}
    assert bits(again) == bits(first[0])
