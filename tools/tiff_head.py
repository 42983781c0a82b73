"""The size of a TIFF from its first directory, and whether all its pixels are in the file."""

import struct
from typing import BinaryIO

WIDTH, HEIGHT = 256, 257
OFFSETS, COUNTS = (273, 324), (279, 325)  # of strips, of tiles
SHORT, LONG = 3, 4
TYPE_BYTES = (0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8)


def tiff_size(stream: BinaryIO, num_bytes: int) -> tuple[int, int]:
    """Return (width, height) in pixels of the first picture of a classic TIFF.

    Args:
        stream: the file, anywhere.
        num_bytes: its length.

    Raises:
        ValueError: no size in it, or strips or tiles that lie outside of the file.
        struct.error: the directory is cut short.
    """
    stream.seek(0)
    order = "<" if stream.read(2) == b"II" else ">"
    (directory,) = struct.unpack(order + "2xI", stream.read(6))
    stream.seek(directory)
    (num_entries,) = struct.unpack(order + "H", stream.read(2))
    entries = [stream.read(12) for _ in range(num_entries)]
    values: dict[int, tuple[int, ...]] = {}
    for entry in entries:
        tag, kind, count, offset = struct.unpack(order + "HHII", entry)
        length = count * (TYPE_BYTES[kind] if kind < len(TYPE_BYTES) else 0)
        if length > 4 and offset + length > num_bytes:
            raise ValueError(f"it is cut short after {num_bytes} bytes")
        if tag in (WIDTH, HEIGHT, *OFFSETS, *COUNTS) and kind in (SHORT, LONG):
            values[tag] = _values(stream, order, entry, kind, count)
    if not values.get(WIDTH) or not values.get(HEIGHT):
        raise ValueError("a TIFF without a size")
    for offsets, counts in zip(OFFSETS, COUNTS, strict=True):
        ends = (a + n for a, n in zip(values.get(offsets, ()), values.get(counts, ()), strict=True))
        if max(ends, default=0) > num_bytes:
            raise ValueError(f"it is cut short after {num_bytes} bytes")
    return values[WIDTH][0], values[HEIGHT][0]


def _values(stream: BinaryIO, order: str, entry: bytes, kind: int, count: int) -> tuple[int, ...]:
    """Return an entry's numbers: in its last four bytes, or where these point to."""
    letter, size = ("H", 2) if kind == SHORT else ("I", 4)
    if count * size <= 4:
        return struct.unpack(f"{order}{count}{letter}", entry[8 : 8 + count * size])
    (offset,) = struct.unpack(order + "I", entry[8:])
    stream.seek(offset)
    return struct.unpack(f"{order}{count}{letter}", stream.read(count * size))
