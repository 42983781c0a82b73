"""Pairs that look alike are the same whatever a store knows, and only what is new is worked out."""

import sqlite3

import numpy as np
import pytest
from road_features import along_a_road

from groundfuse.backend.measurement import FrameId
from groundfuse.frontend import retrieval
from groundfuse.frontend.pairs import retrieved_pairs, sample_of
from groundfuse.frontend.retrieval import RetrievalOptions
from groundfuse.tools.packing import key_of
from groundfuse.tools.similar import similar_pairs
from groundfuse.tools.store import Store

OPTIONS = RetrievalOptions(
    num_words=16,
    num_frames=2,
    num_others=1,
    num_candidates=6,
    num_sample=16,
    num_votes=3,
    least_votes=1.0,
)
COUNT = 60
ROAD = along_a_road(COUNT + 2, 15, np.random.default_rng(31))
NAMES = [*(FrameId("A", k) for k in range(30)), *(FrameId("B", k) for k in range(30))]
EMPTY = along_a_road(1, 1, np.random.default_rng(0), seen=0)[0]


def names_with(new):
    """The frames with one more, named so that it stands in its place."""
    return sorted([*NAMES, new])


class Seen(dict):
    """Features by frame, and which of them were asked for."""

    def __init__(self, features):
        super().__init__(features)
        self.asked = []

    def __getitem__(self, frame):
        self.asked.append(frame)
        return super().__getitem__(frame)


@pytest.fixture
def store():
    with Store() as empty:
        yield empty


@pytest.fixture
def votes(monkeypatch):
    """How many frames voted: the length of a list that grows."""
    cast, voted = retrieval.cast, []

    def noted(voter, others, num_votes):
        voted.append(len(others))
        return cast(voter, others, num_votes)

    monkeypatch.setattr(retrieval, "cast", noted)
    return voted


def run(store, order, road=ROAD, options=OPTIONS, num_threads=2):
    """The pairs and how many looks were fetched; `road` has the features of the order's frames."""
    looks = {frame: key_of("look", k) for frame, k in order.items()}
    seen = Seen((frame, road[k]) for frame, k in order.items())
    found = similar_pairs(looks, seen, options, store, num_threads)
    num_read = len(seen.asked)
    assert found == retrieved_pairs(seen, options)
    return found, num_read


def numbered(names, new=None):
    """Which features each frame has: a new one has the last, the others theirs."""
    old = iter(range(COUNT))
    return {frame: COUNT if frame == new else next(old) for frame in names}


def test_a_first_run_reads_all_and_a_second_nothing(votes, store):
    found, num_read = run(store, numbered(NAMES))
    assert len(found) >= COUNT
    assert num_read == COUNT + OPTIONS.num_sample
    assert len(votes) == 4 * COUNT  # two ways each, and once more by heart
    again, num_read = run(store, numbered(NAMES))
    assert (again, num_read) == (found, 0)
    assert len(votes) == 6 * COUNT


@pytest.mark.parametrize("new", [FrameId("B", 30), FrameId("A", 31), FrameId("0", 0)])
def test_one_frame_more_costs_itself_and_the_votes_of_those_it_resembles(votes, store, new):
    names = names_with(new)
    assert new not in sample_of(names, OPTIONS)
    run(store, numbered(NAMES))
    votes.clear()
    _, num_read = run(store, numbered(names, new))
    assert num_read == 1
    by_heart = 2 * len(names)
    # Itself both ways, and frames that saw the same marks: worst seen 29 of 122.
    assert 2 <= len(votes) - by_heart <= 40


def test_a_frame_that_is_gone_costs_no_reading(store):
    run(store, numbered(NAMES))
    gone = next(frame for frame in NAMES if frame not in sample_of(NAMES, OPTIONS))
    left = {frame: k for frame, k in numbered(NAMES).items() if frame != gone}
    assert sample_of(left, OPTIONS) == sample_of(NAMES, OPTIONS)
    assert run(store, left)[1] == 0


def test_another_sample_teaches_all_anew(votes, store):
    """The right pairs though what was kept was taught by another sample."""
    run(store, numbered(NAMES))
    new = next(
        f for k in range(30, 999) if (f := FrameId("B", k)) in sample_of([*NAMES, f], OPTIONS)
    )
    votes.clear()
    _, num_read = run(store, numbered(names_with(new), new))
    assert num_read == COUNT + 1 + OPTIONS.num_sample
    assert len(votes) == 4 * (COUNT + 1)


def test_other_features_and_other_options_are_not_taken_for_the_same(store):
    run(store, numbered(NAMES))
    changed = {**numbered(NAMES), NAMES[20]: COUNT + 1}
    run(store, changed)
    for option, value in (("num_votes", 2), ("num_features", 20), ("num_candidates", 9)):
        how = {name: getattr(OPTIONS, name) for name in OPTIONS.__slots__} | {option: value}
        run(store, numbered(NAMES), options=RetrievalOptions(**how))


@pytest.mark.parametrize("kind", ["described", "votes", "vocabulary"])
def test_a_damaged_piece_is_worked_out_again(tmp_path, kind, caplog):
    path = tmp_path / "store.sqlite"
    with Store(path) as store:
        found, _ = run(store, numbered(NAMES))
    base = sqlite3.connect(path)
    base.execute("DELETE FROM entry WHERE kind = 'retrieval'")
    rows = base.execute("SELECT id, value FROM entry WHERE kind = ?", (kind,)).fetchall()
    number, value = rows[len(rows) // 2]
    spoilt = value[:-70] + bytes([value[-70] ^ 1]) + value[-69:]
    base.execute("UPDATE entry SET value = ? WHERE id = ?", (spoilt, number))
    base.commit()
    base.close()
    with Store(path) as store:
        assert run(store, numbered(NAMES))[0] == found
    assert len(caplog.messages) == 1
    assert f": {kind} of " in caplog.messages[0]


def test_the_number_of_threads_changes_nothing():
    every = "SELECT key, value FROM entry WHERE kind != 'retrieval' ORDER BY key"
    with Store() as one, Store() as two:
        assert run(one, numbered(NAMES), num_threads=1) == run(two, numbered(NAMES), num_threads=3)
        assert one._base.execute(every).fetchall() == two._base.execute(every).fetchall()


def test_blank_frames_and_none(store):
    """Nothing is taught: no pairs, and nothing is described; one blank frame takes no part."""
    assert run(store, {}) == ([], 0)
    assert run(store, {NAMES[0]: 0, NAMES[1]: 1}, [EMPTY, EMPTY]) == ([], 2)
    mixed = [EMPTY, *ROAD[:8]]
    order = {NAMES[k]: k for k in range(9)}
    found, _ = run(store, order, mixed)
    assert found
    assert all(NAMES[0] not in pair for pair in found)
    run(store, {FrameId("B", 7): 8} | {NAMES[k]: k for k in range(8)}, mixed)
