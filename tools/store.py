"""One file per team that keeps what was computed, by what it was computed from.

Every entry's key is a digest of all that its value depends on: pictures, calibration, options,
code. So nothing in a store is ever out of date: what is new has a new key and is computed, what is
not is found. SQLite's log makes each entry whole or absent whenever the process is killed; every
`SYNC_S` seconds all is forced to the disk, so that a power cut costs no more than that.
"""

import contextlib
import json
import logging
import sqlite3
import threading
import time
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from groundfuse.tools.errors import DataError
from groundfuse.tools.packing import DamagedError, is_whole, key_of, packed, unpacked
from groundfuse.tools.store_lock import Lock

Result = TypeVar("Result")
Row = tuple[bytes, str, str]
"""An entry's packed value, what it is, and whose."""
log = logging.getLogger(__name__)
STORE = "store.sqlite"
"""Its usual name, in the out folder."""
APPLICATION = 0x67667573  # "gfus"
VERSION = 2
EARLIER = frozenset({0, 1})
"""A new file, and stores whose entries may stay as they are: those of 1 have another checksum."""
SYNC_S = 5.0
TOGETHER = 256
"""Entries that are fetched with one question."""
MAGIC = b"SQLite format 3\0"
TABLES = """
CREATE TABLE run(
    id INTEGER PRIMARY KEY, begun TEXT NOT NULL, options TEXT NOT NULL, versions TEXT NOT NULL);
CREATE TABLE entry(
    id INTEGER PRIMARY KEY, key BLOB NOT NULL UNIQUE, kind TEXT NOT NULL, label TEXT NOT NULL,
    run INTEGER REFERENCES run(id), value BLOB NOT NULL);
"""
INDEX = "CREATE INDEX IF NOT EXISTS entry_by_kind ON entry(kind)"
"""Without it, whoever asks for a kind reads through the whole file."""


class Store:
    """A store that this process holds; without a path it lives in memory and ends with it.

    Raises:
        DataError: another run holds it, it is of another version or damaged, or no store at all.
    """

    def __init__(self, path: Path | None = None, *, fresh: bool = False) -> None:
        self.path = path
        self._guard = threading.RLock()
        self._run: int | None = None
        self._synced_s = time.monotonic()
        self._lock = None if path is None else Lock(path.with_name(f"{path.name}.lock"))
        try:
            if path is not None and path.exists():
                _check_head(path)
                if fresh:
                    _remove(path)
            with self._told():
                self._base = _opened(path)
            # One in memory ends with whoever holds it, and nobody may have closed it.
            self._end = weakref.finalize(self, self._base.close)
        except BaseException:
            if self._lock is not None:
                self._lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Put everything into the one file and let others have it."""
        with self._guard, contextlib.suppress(sqlite3.Error):
            self._end()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def begin(self, options: object, versions: object) -> None:
        """Note what the entries that follow are made with.

        Raises:
            DataError: the disk is full, or fails.
        """
        row = (time.strftime("%Y-%m-%dT%H:%M:%S%z"), json.dumps(options), json.dumps(versions))
        with self._told(), self._guard:
            insert = "INSERT INTO run(begun, options, versions) VALUES (?, ?, ?)"
            self._run = self._base.execute(insert, row).lastrowid

    def known(self, keys: Iterable[bytes]) -> set[bytes]:
        """Return the keys that have an entry."""
        found, left = set[bytes](), iter(keys)
        while part := list(islice(left, TOGETHER)):
            find = f"SELECT key FROM entry WHERE key IN ({_marks(part)})"  # noqa: S608
            with self._told(), self._guard:
                found.update(key for (key,) in self._base.execute(find, part))
        return found

    def load(self, key: bytes) -> Any:  # noqa: ANN401
        """Return an entry's value; None where there is none, or a damaged one (which is told)."""
        return next(self.load_all([key]))

    def load_all(self, keys: Iterable[bytes]) -> Iterator[Any]:
        """Yield entries' values in the order of their keys, as `load` does; few lie packed."""
        left = iter(keys)
        while part := list(islice(left, TOGETHER)):
            rows = self._rows(part)
            yield from (self._value(rows.get(key)) for key in part)

    def read(self, key: bytes) -> bytes | None:
        """Return an entry as it is packed; None as in `load`."""
        row = self._rows([key]).get(key)
        if row is None:
            return None
        if not is_whole(row[0]):
            self._tell_damaged(row)
            return None
        return row[0]

    def latest(self, kind: str) -> Any:  # noqa: ANN401
        """Return the value of a kind that was kept last; None where there is none."""
        find = "SELECT key FROM entry WHERE kind = ? ORDER BY id DESC LIMIT 1"
        with self._told(), self._guard:
            row = self._base.execute(find, (kind,)).fetchone()
        return None if row is None else self.load(row[0])

    def _rows(self, keys: Sequence[bytes]) -> dict[bytes, Row]:
        columns = "key, value, kind, label"
        find = f"SELECT {columns} FROM entry WHERE key IN ({_marks(keys)})"  # noqa: S608
        with self._told(), self._guard:
            return {row[0]: row[1:] for row in self._base.execute(find, keys)}

    def _value(self, row: Row | None) -> Any:  # noqa: ANN401
        if row is None:
            return None
        try:
            return unpacked(row[0])
        except (DamagedError, TypeError):
            self._tell_damaged(row)
            return None

    def _tell_damaged(self, row: Row) -> None:
        _, kind, label = row
        log.warning("%s: %s of %s is damaged, computed anew", self.path, kind, label)

    def save(self, key: bytes, kind: str, label: str, value: bytes) -> None:
        """Keep a packed value from now on, whatever happens to the process.

        Args:
            key: digest of all that it depends on.
            kind: what it is.
            label: whose it is, for people.
            value: see `packing`.

        Raises:
            DataError: the disk is full, or fails; what is there already stays.
        """
        self.save_all(kind, [(key, label, value)])

    def save_all(self, kind: str, entries: Sequence[tuple[bytes, str, bytes]]) -> None:
        """Keep packed values of a kind, all or, where the process ends, none; else as `save`.

        Args:
            kind: what they are.
            entries: key, label and value of each.
        """
        insert = "INSERT OR REPLACE INTO entry(key, kind, label, run, value) VALUES (?, ?, ?, ?, ?)"
        rows = [
            (key, kind, label.encode(errors="replace").decode(), self._run, value)
            for key, label, value in entries
        ]
        with self._told(), self._guard:
            with self._base:
                self._base.execute("BEGIN")
                self._base.executemany(insert, rows)
            if time.monotonic() - self._synced_s > SYNC_S:
                self._base.execute("PRAGMA wal_checkpoint(PASSIVE)")
                self._synced_s = time.monotonic()

    def forget_others(self, kind: str, keys: Collection[bytes]) -> None:
        """Remove all entries of a kind but those with these keys; others may take their room."""
        find = "SELECT id, key FROM entry WHERE kind = ?"
        with self._told(), self._guard:
            found = self._base.execute(find, (kind,)).fetchall()
            gone = [(number,) for number, key in found if key not in keys]
            if gone:
                self._base.execute("BEGIN")
                self._base.executemany("DELETE FROM entry WHERE id = ?", gone)
                self._base.execute("COMMIT")

    def forget_older(self, kinds: Sequence[str], most: int) -> None:
        """Remove what was superseded: of each label of these kinds, all but the latest few.

        Args:
            kinds: those of which a run makes few and the next seldom needs more than the last.
            most: entries that stay of each label.
        """
        newest = "row_number() OVER (PARTITION BY kind, label ORDER BY id DESC) AS place"
        of = f"SELECT id, {newest} FROM entry WHERE kind IN ({_marks(kinds)})"  # noqa: S608
        with self._told(), self._guard:
            remove = f"DELETE FROM entry WHERE id IN (SELECT id FROM ({of}) WHERE place > ?)"  # noqa: S608
            self._base.execute(remove, (*kinds, most))

    def kept(self, kind: str, label: str, parts: Sequence[object], work: Callable[[], Any]) -> Any:  # noqa: ANN401
        """Return what work gives, from the entry of its key where there is one.

        Args:
            kind: what it is.
            label: whose it is, for people.
            parts: all that it depends on.
            work: how it is made.
        """
        key = key_of(kind, *parts)
        found = self.load(key)
        if found is None:
            data = packed(work())
            self.save(key, kind, label, data)
            found = unpacked(data)
        return found

    def kept_each(
        self,
        kind: str,
        labels: Sequence[str],
        keys: Sequence[bytes],
        works: Callable[[Sequence[int]], Iterable[Result]],
    ) -> list[Result]:
        """Return many values of a kind, from the entries of their keys where there are such.

        Args:
            kind: what they are.
            labels: whose each is, for people.
            keys: of each, digests of all that it depends on.
            works: yields those of the places it is given, in order.
        """
        found: list[Any] = list(self.load_all(keys))
        missing = [place for place, value in enumerate(found) if value is None]
        made = zip(missing, works(missing), strict=True)
        while part := [(place, packed(value)) for place, value in islice(made, TOGETHER)]:
            self.save_all(kind, [(keys[place], labels[place], data) for place, data in part])
            for place, data in part:
                found[place] = unpacked(data)
        return found

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn SQLite's complaints into the one line."""
        try:
            yield
        except sqlite3.DatabaseError as error:
            code = error.sqlite_errorcode & 0xFF if hasattr(error, "sqlite_errorcode") else 0
            why = {
                sqlite3.SQLITE_FULL: "no space left on the disk; what is stored stays",
                sqlite3.SQLITE_IOERR: "the disk fails or is full; what is stored stays",
                sqlite3.SQLITE_READONLY: "no permission to write here",
                sqlite3.SQLITE_CANTOPEN: "cannot be opened",
                sqlite3.SQLITE_CORRUPT: "the store is damaged, start over with --fresh",
                sqlite3.SQLITE_NOTADB: "the store is damaged, start over with --fresh",
            }.get(code, str(error))
            raise DataError(f"{self.path}: {why}") from error


def _opened(path: Path | None) -> sqlite3.Connection:
    name = ":memory:" if path is None else str(path)
    base = sqlite3.connect(name, isolation_level=None, check_same_thread=False)
    try:
        # One process at a time, so no shared memory; entries are large, so are pages and the log.
        for setting in ("locking_mode=EXCLUSIVE", "page_size=16384", "synchronous=NORMAL"):
            base.execute(f"PRAGMA {setting}")
        (found,) = base.execute("PRAGMA user_version").fetchone()
        _check_version(path, found)
        if found == 0:  # before there is a log: a killed process must leave nothing or a store
            head = f"PRAGMA application_id={APPLICATION}; PRAGMA user_version={VERSION};"
            base.executescript(f"BEGIN; {TABLES} {head} COMMIT;")
        elif found != VERSION:  # its groundfuse would take new entries for damaged ones
            base.execute(f"PRAGMA user_version={VERSION}")
        base.execute("PRAGMA journal_mode=WAL")
        base.execute(INDEX)
        base.execute("PRAGMA wal_autocheckpoint=4096")
    except BaseException:
        base.close()
        raise
    return base


def _marks(values: Sequence[object]) -> str:
    return ",".join("?" * len(values))


def _check_version(path: Path | None, found: int) -> None:
    if found != VERSION and found not in EARLIER:
        raise DataError(
            f"{path}: store of version {found}, this groundfuse reads {VERSION}: "
            "use the groundfuse that wrote it, or start over with --fresh"
        )


def _check_head(path: Path) -> None:
    """Refuse, and so never remove, a file that isn't ours (DataError)."""
    if not path.is_file():
        raise DataError(f"{path}: is a folder, needed a file for the store")
    with path.open("rb") as stream:
        head = stream.read(100)
    ours = head[68:72] == APPLICATION.to_bytes(4, "big")
    if head and not (head.startswith(MAGIC) and ours):
        raise DataError(f"{path}: not a store of groundfuse")


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
