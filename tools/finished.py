"""Files that an earlier run left and that need not be made again."""

import hashlib
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from groundfuse.tools.packing import key_of, packed
from groundfuse.tools.store import Store


def unless_finished(
    store: Store,
    out: Path,
    kind: str,
    parts: Sequence[object],
    names: Sequence[str],
    work: Callable[[], None],
) -> set[str]:
    """Do work that writes files, unless all it would write lies there as it left it.

    Args:
        store: remembers which files the work wrote, and their digests.
        out: where it writes them.
        kind: what it makes.
        parts: all that the files depend on.
        names: patterns for the names of the files, seen from `out`: whatever else is written there
            meanwhile is not of the work.
        work: writes them.

    Returns:
        the names of the files, seen from `out`, that were there and stay.
    """
    key = key_of(kind, *parts)
    known: dict[str, bytes] | None = store.load(key)
    if known is not None and _digests(out, known) == known:
        return set(known)
    before = _stamps(out, names)
    work()
    after = _stamps(out, names)
    written = sorted(name for name, stamp in after.items() if before.get(name) != stamp)
    store.save(key, kind, "files", packed(_digests(out, written)))
    return set()


def _digests(out: Path, names: Collection[str]) -> dict[str, bytes | None]:
    """Return the digest of each file."""
    with ThreadPoolExecutor() as threads:
        return dict(zip(names, threads.map(lambda name: _digest(out / name), names), strict=True))


def _digest(path: Path) -> bytes | None:
    """Return a file's digest, a piece at a time; None where it can't be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=20)).digest()
    except OSError:
        return None


def _stamps(out: Path, names: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Return what tells a rewritten file from an old one: number, size and time."""
    found = {}
    for path in (path for name in names for path in out.glob(name)):
        stat = path.stat()
        found[path.relative_to(out).as_posix()] = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
    return found
