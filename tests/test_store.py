"""A store keeps what it acknowledged, is held by one process, and refuses what is not its own."""

import hashlib
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading

import pytest

from groundfuse.tools import packing
from groundfuse.tools import store as module
from groundfuse.tools.errors import DataError
from groundfuse.tools.packing import key_of, packed
from groundfuse.tools.store import Store

HOLD = """
import sys, time
from pathlib import Path
from groundfuse.tools.packing import key_of, packed
from groundfuse.tools.store import Store
store = Store(Path(sys.argv[1]))
for k in range(10_000):
    store.save(key_of(k), "number", str(k), packed((k, bytes(5000))))
    print(k, flush=True)
"""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "out" / "store.sqlite"


def put(store, value, key=b"k", kind="number", label="A1"):
    store.save(key, kind, label, packed(value))


def rows(path, query):
    base = sqlite3.connect(path)
    try:
        return base.execute(query).fetchall()
    finally:
        base.close()


def refusal(path, **how):
    with pytest.raises(DataError) as caught:
        Store(path, **how)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_what_was_put_in_is_there_next_time(path):
    with Store(path) as store:
        assert store.load(b"k") is None
        put(store, (1, "two"))
        put(store, 3.0, b"other")
        assert store.load(b"k") == (1, "two")
        assert store.known([b"k", b"x", b"other"]) == {b"k", b"other"}
    with Store(path) as store:
        assert store.load(b"k") == (1, "two")
        assert store.read(b"other") == packed(3.0)
        put(store, "new")
        assert store.load(b"k") == "new"
    assert {p.name for p in path.parent.iterdir()} == {"store.sqlite", "store.sqlite.lock"}


def test_the_latest_of_a_kind_is_what_was_kept_last(path):
    with Store(path) as store:
        assert store.latest("number") is None
        for key, value in ((b"1", 1.0), (b"2", 2.0), (b"1", 3.0)):
            store.save(key, "number", "x", packed(value))
            store.save(b"other", "word", "x", packed("text"))
            assert store.latest("number") == value
    with Store(path) as store:
        assert store.latest("number") == 3.0


def test_many_values_come_in_the_order_of_their_keys(monkeypatch):
    """Whatever lies together, and whichever are not there or asked for twice."""
    monkeypatch.setattr(module, "TOGETHER", 7)
    asked = [39, 3, 8, 8, *range(30, -1, -1)]
    expected = [k if k % 2 == 0 else None for k in asked]
    with Store() as store:
        for k in range(0, 40, 2):
            put(store, k, key_of(k))
        assert list(store.load_all(key_of(k) for k in asked)) == expected
        assert store.known(key_of(k) for k in asked) == {key_of(k) for k in asked if k % 2 == 0}
        assert list(store.load_all([])) == []


def test_of_many_values_only_those_that_are_not_there_are_made(monkeypatch, path):
    monkeypatch.setattr(module, "TOGETHER", 3)
    places = []

    def works(missing):
        places.extend(missing)
        return ((k, f"made {k}") for k in missing)

    names, keys = [f"A{k}" for k in range(11)], [key_of(k) for k in range(11)]
    with Store(path) as store:
        put(store, "old", keys[4])
        put(store, "old", keys[9])
        found = store.kept_each("number", names, keys, works)
        assert places == [0, 1, 2, 3, 5, 6, 7, 8, 10]
        assert found == ["old" if k in (4, 9) else (k, f"made {k}") for k in range(11)]
    with Store(path) as store:
        assert store.kept_each("number", names, keys, works) == found
    assert len(places) == 9
    told = rows(path, "SELECT label FROM entry WHERE kind = 'number' ORDER BY key")
    assert len(told) == 11
    assert ("A7",) in told


def test_work_that_fails_leaves_what_was_kept_before_it(monkeypatch):
    monkeypatch.setattr(module, "TOGETHER", 2)
    keys = [key_of(k) for k in range(6)]

    def works(missing):
        for k in missing:
            if k == 5:
                raise DataError("no such picture")
            yield k

    with Store() as store:
        with pytest.raises(DataError, match=r"^no such picture$"):
            store.kept_each("number", "abcdef", keys, works)
        assert list(store.load_all(keys)) == [0, 1, 2, 3, None, None]
        assert not store._base.in_transaction


def test_without_a_path_it_lives_in_memory():
    with Store() as store:
        put(store, 1)
        assert store.load(b"k") == 1
    with Store() as store:
        assert store.load(b"k") is None


def test_others_of_a_kind_are_forgotten_and_leave_room(path):
    with Store(path) as store:
        for k in range(9):
            put(store, bytes(100_000), b"k%d" % k, "tile")
        put(store, 1, b"k9", "number")
    size = path.stat().st_size
    with Store(path) as store:
        store.forget_others("tile", {b"k3", b"k5", b"x"})
        keys = {b"k%d" % k for k in range(10)}
        assert store.known(keys) == {b"k3", b"k5", b"k9"}
        for k in range(6):
            put(store, bytes(100_000), b"m%d" % k, "tile")
        store.forget_others("none", set())
        assert len(store.known(keys)) == 3
    assert path.stat().st_size <= size


def test_of_what_is_superseded_the_latest_stay(path):
    """Of each kind and label apart; whatever else there is stays."""
    with Store(path) as store:
        for k in range(6):
            for kind, label in (("graph", "A"), ("graph", "B"), ("bundle", "A"), ("look", "A")):
                put(store, k, f"{kind} {label} {k}".encode(), kind, label)
        put(store, 0, b"graph A 1", "graph", "A")  # kept again: now the latest
        store.forget_older(("graph", "bundle"), 2)
        left = {f"{what} {k}" for what in ("graph B", "bundle A") for k in (4, 5)}
        left |= {f"look A {k}" for k in range(6)} | {"graph A 1", "graph A 5"}
        everything = [
            f"{w} {k}" for w in ("graph A", "graph B", "bundle A", "look A") for k in range(6)
        ]
        assert store.known(name.encode() for name in everything) == {name.encode() for name in left}


@pytest.mark.parametrize("before", ["none", "without"])
def test_a_kind_is_found_without_reading_everything(path, before):
    """Also in a store that was made without the index."""
    if before == "without":
        with Store(path) as store:
            put(store, 1, b"k", "number")
        rows(path, "DROP INDEX entry_by_kind")
    with Store(path) as store:
        put(store, 2, b"m", "number")
        assert store.latest("number") == 2
    plan = "EXPLAIN QUERY PLAN SELECT id FROM entry WHERE kind = 'number' ORDER BY id DESC"
    assert "USING COVERING INDEX entry_by_kind" in str(rows(path, plan))


def test_fresh_starts_over(path):
    with Store(path) as store:
        put(store, 1)
    with Store(path, fresh=True) as store:
        assert store.load(b"k") is None
        put(store, 2)
    with Store(path) as store:
        assert store.load(b"k") == 2


def test_it_knows_what_entries_were_made_with(path):
    with Store(path) as store:
        store.begin({"a": 1}, {"numpy": "2"})
        put(store, 1)
        store.begin({"a": 2}, {"numpy": "3"})
        put(store, 1, b"other", label="B2\udcff")
    query = "SELECT label, options, versions FROM entry JOIN run ON run.id = run ORDER BY entry.id"
    assert rows(path, query) == [
        ("A1", '{"a": 1}', '{"numpy": "2"}'),
        ("B2?", '{"a": 2}', '{"numpy": "3"}'),
    ]


def test_many_threads_may_use_it(path):
    with Store(path) as store:

        def work(first):
            for k in range(first, first + 50):
                put(store, k, key_of(k))
                assert store.load(key_of(k)) == k

        threads = [threading.Thread(target=work, args=(50 * k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(store.known(key_of(k) for k in range(200))) == 200


# Held by one


def test_the_second_is_told_who_holds_it(path):
    with Store(path):
        here = f"process {os.getpid()} on {socket.gethostname()}"
        assert refusal(path) == f"{path}: store is held by {here}"
        assert refusal(path, fresh=True) == f"{path}: store is held by {here}"
    with Store(path):
        pass


def test_a_process_that_was_killed_holds_nothing_and_loses_nothing(path):
    """Killed while it writes: every entry it acknowledged is there, whole."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        lines = [process.stdout.readline() for _ in range(60)]
        assert f"held by process {process.pid} on " in refusal(path)
        process.send_signal(signal.SIGKILL)
        lines += process.stdout.readlines()
    finally:
        process.kill()
        process.stdout.close()
        process.wait()
    last = [int(line) for line in lines if line.endswith("\n")][-1]
    with Store(path) as store:
        for k in range(last + 1):
            assert store.load(key_of(k)) == (k, bytes(5000))
        assert len(store.known(key_of(k) for k in range(10_000))) in (last + 1, last + 2)


def test_a_store_killed_at_birth_is_no_obstacle(path):
    """Whatever is left of the first moments: nothing, or an empty file."""
    path.parent.mkdir()
    path.touch()
    with Store(path) as store:
        put(store, 1)
    assert rows(path, "PRAGMA user_version") == [(module.VERSION,)]


def test_a_failed_opening_lets_go_of_the_lock(path):
    path.parent.mkdir()
    path.write_bytes(b"something else")
    refusal(path)
    path.unlink()
    with Store(path):
        pass


# What is not right


def test_what_is_no_store_is_neither_read_nor_removed(path):
    path.parent.mkdir()
    for content in (b"notes", b"x" * 200):
        path.write_bytes(content)
        for fresh in (False, True):
            assert refusal(path, fresh=fresh) == f"{path}: not a store of groundfuse"
        assert path.read_bytes() == content
    path.unlink()
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE mine(x)")
    base.close()
    assert refusal(path, fresh=True) == f"{path}: not a store of groundfuse"
    path.unlink()
    path.mkdir()
    assert refusal(path) == f"{path}: is a folder, needed a file for the store"


def test_another_version_is_refused_with_both_numbers(path):
    with Store(path):
        pass
    rows(path, "PRAGMA user_version = 7")
    assert refusal(path) == (
        f"{path}: store of version 7, this groundfuse reads 2: "
        "use the groundfuse that wrote it, or start over with --fresh"
    )
    with Store(path, fresh=True) as store:
        put(store, 1)


def test_a_store_of_version_1_is_taken_over(path, caplog):
    """Its entries, under a digest for a checksum, are found; its groundfuse refuses it then."""
    with Store(path) as store:
        put(store, "x" * 500)
        body = packed("y" * 500)[packing.CHECKSUM_BYTES :]
        store.save(b"old", "number", "A2", hashlib.blake2b(body, digest_size=8).digest() + body)
    rows(path, "PRAGMA user_version = 1")
    with Store(path) as store:
        assert store.load(b"old") == "y" * 500
        assert store.load(b"k") == "x" * 500
        put(store, 2)
    assert rows(path, "PRAGMA user_version") == [(2,)]
    assert not caplog.messages


def test_a_damaged_entry_is_named_and_counts_as_missing(path, caplog):
    with Store(path) as store:
        put(store, "x" * 500)
    data = path.read_bytes()
    assert data.count(b"x" * 500) == 1
    path.write_bytes(data.replace(b"x" * 500, b"x" * 499 + b"y"))
    with Store(path) as store:
        assert store.load(b"k") is None
        assert caplog.messages == [f"{path}: number of A1 is damaged, computed anew"]
        put(store, 2)
        assert store.load(b"k") == 2


def test_a_damaged_file_is_told_in_one_line(path):
    with Store(path) as store:
        for k in range(50):
            put(store, "x" * 5000, key_of(k))
    data = bytearray(path.read_bytes())
    data[16384:] = os.urandom(len(data) - 16384)
    path.write_bytes(data)
    with pytest.raises(DataError) as caught, Store(path) as store:
        store.known(key_of(k) for k in range(50))
    assert str(caught.value) == f"{path}: the store is damaged, start over with --fresh"
    with Store(path, fresh=True) as store:
        assert store.known([b"k"]) == set()


def test_a_full_disk_is_told_in_one_line_and_costs_nothing_that_was_stored(path):
    with Store(path) as store:
        put(store, 1)
        (pages,) = store._base.execute("PRAGMA page_count").fetchone()
        store._base.execute(f"PRAGMA max_page_count = {pages + 2}")
        with pytest.raises(DataError) as caught:
            put(store, bytes(200_000), b"big")
        assert str(caught.value) == f"{path}: no space left on the disk; what is stored stays"
        assert store.load(b"k") == 1
    with Store(path) as store:
        assert store.known([b"k", b"big"]) == {b"k"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_store_that_must_not_be_written(path):
    path.parent.mkdir(mode=0o500)
    assert refusal(path).endswith("cannot write: no permission to write here")


def test_a_folder_that_is_a_file(tmp_path):
    (tmp_path / "file").touch()
    assert refusal(tmp_path / "file" / "store.sqlite") == (
        f"{tmp_path}/file: cannot write: a file stands where a folder is needed"
    )
