"""Values as bytes: plain numbers, words, arrays and the project's own dataclasses, never code.

    CRC-32 and length of all that follows (4 + 4, little endian, as the length of the outline) |
    length of the outline (4) | outline (JSON) | arrays, each from a multiple of 64 bytes on

The outline holds the value's shape; each array stands in it as its type, its shape and where its
raw bytes begin. Equal values give equal bytes, so that the bytes also serve as keys; an array comes
back in C order and in memory of its own, so that what is computed from a value that was put away
is the same to the bit as from one that was not, if both went this way.
"""

import enum
import functools
import hashlib
import importlib
import itertools
import json
import operator
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from isal import isal_zlib

CHECKSUM_BYTES = 8
STEP_BYTES = 64
OURS = "groundfuse."
PLAIN = frozenset({type(None), bool, int, float, str})
ENCODED = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode


class DamagedError(ValueError):
    """Bytes that were not packed here, or have changed since."""


def packed(value: object) -> bytes:
    """Return a value as bytes.

    Raises:
        TypeError: something in it is none of ours.
    """
    parts = _body(value)
    return b"".join([_checksum(parts), *parts])


def unpacked(data: bytes) -> Any:  # noqa: ANN401
    """Return the value.

    Raises:
        DamagedError: the checksum is wrong, or the bytes name what is not known.
    """
    if not is_whole(data):
        raise DamagedError(f"{len(data)} bytes with a wrong checksum")
    body = memoryview(data)[CHECKSUM_BYTES:]
    (length,) = struct.unpack("<I", body[:4])
    try:
        return _value(json.loads(bytes(body[4 : 4 + length])), body[_after(4 + length) :])
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedError(f"{len(data)} bytes that are no value: {error}") from error


def is_whole(data: object) -> bool:
    """Return whether bytes were packed here and have not changed since."""
    if not isinstance(data, bytes) or len(data) < CHECKSUM_BYTES + 4:
        return False
    found, body = data[:CHECKSUM_BYTES], [memoryview(data)[CHECKSUM_BYTES:]]
    return found == _checksum(body) or found == _checksum_1(body)


def key_of(*parts: object) -> bytes:
    """Return 20 bytes that stand for values: equal for equal values only."""
    body = _body(parts)
    # As ever, so that what an older release put away is found.
    digest = hashlib.blake2b(_checksum_1(body), digest_size=20)
    for part in body:
        digest.update(part)
    return digest.digest()


def digest_of(data: bytes) -> bytes:
    """Return 20 bytes that stand for a file's content."""
    return hashlib.blake2b(data, digest_size=20).digest()


class _Arrays:
    """Raw arrays, one after the other."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self._length = 0

    def add(self, array: np.ndarray[Any, Any]) -> int:
        """Return where the array begins."""
        start, raw = self._length, np.ascontiguousarray(array).tobytes()
        self.parts += [raw, bytes(_after(len(raw)) - len(raw))]
        self._length += _after(len(raw))
        return start


def _body(value: object) -> list[bytes]:
    """Return what follows the checksum, in parts."""
    arrays = _Arrays()
    outline = ENCODED(_outline(value, arrays)).encode()
    start = _after(4 + len(outline))
    lead = struct.pack("<I", len(outline)) + outline + bytes(start - 4 - len(outline))
    return [lead, *arrays.parts]


def _checksum(body: Iterable[bytes | memoryview]) -> bytes:
    """Return what tells a fault of the disk; some 20 times as quick as a digest."""
    found, length = 0, 0
    for part in body:
        found, length = isal_zlib.crc32(part, found), length + len(part)
    return struct.pack("<II", found, length & 0xFFFFFFFF)


def _checksum_1(body: Iterable[bytes | memoryview]) -> bytes:
    """Return the checksum of stores of version 1, a digest."""
    digest = hashlib.blake2b(digest_size=CHECKSUM_BYTES)
    for part in body:
        digest.update(part)
    return digest.digest()


def _after(length: int) -> int:
    return -(-length // STEP_BYTES) * STEP_BYTES


def _outline(value: Any, arrays: _Arrays) -> Any:  # noqa: ANN401
    """Return a value as JSON has it; lists begin with a letter for what they are."""
    kind: Any = type(value)
    return value if kind in PLAIN else _writer(kind)(value, arrays)


def _outlines(values: Iterable[Any], arrays: _Arrays) -> list[Any]:
    """Return values as JSON has them; most are plain, and there are hundreds of thousands."""
    return [v if type(v) in PLAIN else _outline(v, arrays) for v in values]


@functools.cache
def _writer(kind: Any) -> Callable[[Any, _Arrays], Any]:  # noqa: ANN401, PLR0911
    """Return what writes the outlines of a type's values."""
    if kind is bytes:
        return lambda value, _: ["B", value.hex()]
    if kind is tuple or kind is list:
        return _row
    if issubclass(kind, enum.Enum):
        name = _name(kind)
        return lambda value, _: ["E", name, value.value]
    if issubclass(kind, bool | int | float | str):
        return lambda value, _: value
    if issubclass(kind, np.generic):
        return lambda value, _: value.item()
    if issubclass(kind, np.ndarray):
        return lambda value, arrays: [
            "A",
            value.dtype.str,
            list(value.shape),
            arrays.add(value),
        ]
    if issubclass(kind, Mapping):
        pairs = itertools.chain.from_iterable
        return lambda value, arrays: ["D", *_outlines(pairs(value.items()), arrays)]
    name, parts = _name(kind), _parts(kind)
    return lambda value, arrays: ["O", name, *_outlines(parts(value), arrays)]


def _row(values: Sequence[Any], arrays: _Arrays) -> Any:  # noqa: ANN401
    """Return the outline of a sequence: if all are of one class of ours, column by column.

    So names stand once and not thousands of times, and each column is quick to make and to read.
    """
    kinds: set[Any] = {type(value) for value in values}
    if len(kinds) == 1 and len(values) > 1 and _holds_parts(kind := kinds.pop()):
        columns = zip(*map(_parts(kind), values), strict=True)
        return ["C", _name(kind), *[_row(column, arrays) for column in columns]]
    return ["T", *_outlines(values, arrays)]


@functools.cache
def _holds_parts(kind: Any) -> bool:  # noqa: ANN401
    """Return whether a class's values are made of parts."""
    return bool(fields(kind) if is_dataclass(kind) else getattr(kind, "_fields", ()))


@functools.cache
def _name(kind: Any) -> str:  # noqa: ANN401
    """Return where a value's class lies: `frontend.fit:Prior`."""
    if not kind.__module__.startswith(OURS):
        raise TypeError(f"a {kind.__name__} can't be packed")
    return f"{kind.__module__.removeprefix(OURS)}:{kind.__name__}"


@functools.cache
def _parts(kind: Any) -> Callable[[Any], Iterable[Any]]:  # noqa: ANN401
    """Return what takes a class's values apart."""
    if not is_dataclass(kind):
        if not hasattr(kind, "_fields"):
            raise TypeError(f"a {kind.__name__} can't be packed")
        return tuple
    words = [field.name for field in fields(kind)]
    if len(words) < 2:
        return lambda value: [getattr(value, word) for word in words]
    parts: Callable[[Any], Iterable[Any]] = operator.attrgetter(*words)
    return parts


@functools.cache
def _kind(name: str) -> Callable[..., Any]:
    """Return a class by that name: one of ours that only holds values, and nothing else."""
    module, _, word = name.partition(":")
    try:
        kind = vars(importlib.import_module(OURS + module))[word]
    except (ImportError, KeyError) as error:
        raise ValueError(f"there is no {name}") from error
    if not isinstance(kind, type) or not (
        is_dataclass(kind) or issubclass(kind, enum.Enum) or hasattr(kind, "_fields")
    ):
        raise ValueError(f"{name} does not hold values")
    return kind


@functools.cache
def _member(name: str, value: object) -> Any:  # noqa: ANN401
    """Return a member of one of our enumerations: there are few, and they come in thousands."""
    return _kind(name)(value)


@functools.cache
def _maker(name: str) -> Callable[..., Any]:
    """Return what makes a class's values of their parts.

    Those that check their parts did so before they were packed, and the checksum says that they are
    the same; of thousands of covariances, checks would take half of the time.
    """
    kind: Any = _kind(name)
    if not hasattr(kind, "__post_init__"):
        plain: Callable[..., Any] = kind
        return plain
    words, new, put = [field.name for field in fields(kind)], object.__new__, object.__setattr__

    def made(*parts: Any) -> Any:  # noqa: ANN401
        value = new(kind)
        for word, part in zip(words, parts, strict=True):
            put(value, word, part)
        return value

    return made


def _value(outline: Any, arrays: memoryview) -> Any:  # noqa: ANN401, PLR0911
    """Return what an outline describes; sequences come back as tuples."""
    if type(outline) is not list:
        return outline
    kind = outline[0]
    if kind == "A":
        return _array(arrays, *outline[1:])
    if kind == "O":
        return _maker(outline[1])(*_values(outline[2:], arrays))
    if kind == "B":
        return bytes.fromhex(outline[1])
    if kind == "E":
        return _member(outline[1], outline[2])
    if kind == "C":
        rows = zip(*_values(outline[2:], arrays), strict=True)
        return tuple(itertools.starmap(_maker(outline[1]), rows))
    if kind == "D":
        inner = _values(outline[1:], arrays)
        return dict(zip(inner[::2], inner[1::2], strict=True))
    if kind == "T":
        return tuple(_values(outline[1:], arrays))
    raise ValueError(f"there is no kind {kind!r}")


def _values(outlines: list[Any], arrays: memoryview) -> list[Any]:
    return [_value(part, arrays) if type(part) is list else part for part in outlines]


def _array(arrays: memoryview, kind: str, shape: list[int], start: int) -> np.ndarray[Any, Any]:
    dtype = _dtype(kind)
    if 0 in shape:  # may lie behind the end
        return np.zeros(shape, dtype)
    if start < 0:  # numpy looks for the other end only
        raise ValueError("offset must be non-negative")
    found: np.ndarray[Any, Any] = np.ndarray(shape, dtype, arrays, start).copy()
    return found


@functools.cache
def _dtype(kind: str) -> np.dtype[Any]:
    dtype = np.dtype(kind)
    if dtype.kind not in "biufc":
        raise ValueError(f"arrays of {kind} are not known")
    return dtype
