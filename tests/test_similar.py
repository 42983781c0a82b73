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
def compared(monkeypatch):
    """With how many others frames were compared: a list that grows."""
    nearest_kin, numbers = retrieval.nearest_kin, []

    def noted(voter, others):
        numbers.append(len(others))
        return nearest_kin(voter, others)

    monkeypatch.setattr(retrieval, "nearest_kin", noted)
    return numbers


def run(store, order, road=ROAD, options=OPTIONS, num_threads=2):
    """The pairs and how many looks were fetched; `road` has the features of the order's frames."""
    looks = {frame: key_of("look", k) for frame, k in order.items()}
    seen = Seen((frame, road[k]) for frame, k in order.items())
    return similar_pairs(looks, seen, options, store, num_threads), len(seen.asked)


def by_heart(order, road=ROAD, options=OPTIONS):
    """The pairs without a store."""
    return retrieved_pairs({frame: road[k] for frame, k in order.items()}, options)


def numbered(names, new=None):
    """Which features each frame has: a new one has the last, the others theirs."""
    old = iter(range(COUNT))
    return {frame: COUNT if frame == new else next(old) for frame in names}


def test_a_first_run_reads_all_and_a_second_nothing(compared, store):
    found, num_read = run(store, numbered(NAMES))
    assert found == by_heart(numbered(NAMES))
    assert len(found) >= COUNT
    assert num_read == COUNT + OPTIONS.num_sample
    compared.clear()
    again, num_read = run(store, numbered(NAMES))
    assert (again, num_read) == (found, 0)
    assert compared == []


@pytest.mark.parametrize("new", [FrameId("B", 30), FrameId("A", 31), FrameId("0", 0)])
def test_one_frame_more_costs_itself_and_a_comparison_with_those_it_resembles(compared, store, new):
    order = numbered(names_with(new), new)
    assert new not in sample_of(order, OPTIONS)
    run(store, numbered(NAMES))
    compared.clear()
    found, num_read = run(store, order)
    assert num_read == 1
    # Itself with all of its candidates; others with it and nobody else.
    most = max(compared)
    assert OPTIONS.num_candidates <= most <= 2 * OPTIONS.num_candidates
    compared.remove(most)
    assert set(compared) == {1}
    assert len(compared) <= 30  # worst seen 15 of 60 frames
    assert found == by_heart(order)


def test_who_votes_anew_and_who_is_compared_follows_from_the_lists(compared, store):
    """A frame that goes lets another onto the lists: compared once, though the frame came back."""
    order = numbered(NAMES)
    gone = next(frame for frame in NAMES if frame not in sample_of(NAMES, OPTIONS))
    left = {frame: k for frame, k in order.items() if frame != gone}
    run(store, order)
    compared.clear()
    found, _ = run(store, left)
    assert set(compared) <= {1, 2}  # a place on one list, or on both
    assert len(compared) >= 2
    assert found == by_heart(left)
    compared.clear()
    run(store, order)
    assert compared == []  # the votes of the first run are there still
    for frame in [frame for frame in left if frame not in sample_of(NAMES, OPTIONS)][::4]:
        del left[frame]
        assert run(store, left)[0] == by_heart(left)


def test_a_frame_that_is_gone_costs_no_reading(store):
    run(store, numbered(NAMES))
    gone = next(frame for frame in NAMES if frame not in sample_of(NAMES, OPTIONS))
    left = {frame: k for frame, k in numbered(NAMES).items() if frame != gone}
    assert sample_of(left, OPTIONS) == sample_of(NAMES, OPTIONS)
    found, num_read = run(store, left)
    assert (found, num_read) == (by_heart(left), 0)


def test_another_sample_teaches_all_anew(compared, store):
    """The right pairs though what was kept was taught by another sample."""
    run(store, numbered(NAMES))
    new = next(
        f for k in range(30, 999) if (f := FrameId("B", k)) in sample_of([*NAMES, f], OPTIONS)
    )
    compared.clear()
    order = numbered(names_with(new), new)
    found, num_read = run(store, order)
    assert num_read == COUNT + 1 + OPTIONS.num_sample
    assert len(compared) == COUNT + 1
    assert found == by_heart(order)


def test_other_features_and_other_options_are_not_taken_for_the_same(store):
    run(store, numbered(NAMES))
    changed = {**numbered(NAMES), NAMES[20]: COUNT + 1}
    assert run(store, changed)[0] == by_heart(changed)
    for option, value in (("num_votes", 2), ("num_features", 20), ("num_candidates", 9)):
        how = {name: getattr(OPTIONS, name) for name in OPTIONS.__slots__} | {option: value}
        other = RetrievalOptions(**how)
        found, _ = run(store, numbered(NAMES), options=other)
        assert found == by_heart(numbered(NAMES), options=other)


@pytest.mark.parametrize("kind", ["described", "votes", "vocabulary", "kin"])
def test_a_damaged_piece_is_worked_out_again(tmp_path, kind, caplog):
    path = tmp_path / "store.sqlite"
    with Store(path) as store:
        found, _ = run(store, numbered(NAMES))
    base = sqlite3.connect(path)
    results = ("retrieval", "votes") if kind == "kin" else ("retrieval", "retrieval")
    base.execute("DELETE FROM entry WHERE kind IN (?, ?)", results)
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
