"""Which robot and frame an integer id means.

gtsam's symbols keep a letter in the top byte of 64 bits and the index below it; distributed-mapper
and JRL name robots so. Plain integers belong to the robot of their file. Offset schemes give robot
k the ids from k * offset on.
"""

import string
from dataclasses import dataclass
from enum import StrEnum

from groundfuse.backend.measurement import FrameId

INDEX_BITS = 56
MAX_INDEX = (1 << INDEX_BITS) - 1
MAX_KEY = (1 << 64) - 1
LETTERS = string.ascii_uppercase + string.ascii_lowercase


def key_of_symbol(letter: str, index: int) -> int:
    """Return gtsam's 64-bit key.

    Raises:
        ValueError: no single character of one byte, or an index of more than 56 bits.
    """
    if len(letter) != 1 or not 0 < ord(letter) < 256:
        raise ValueError(f"a symbol needs a single letter, got {letter!r}")
    if not 0 <= index <= MAX_INDEX:
        raise ValueError(f"the index of a symbol must be below 2^56, got {index}")
    return ord(letter) << INDEX_BITS | index


def letter_of_key(key: int) -> str | None:
    """Return the character in the top byte, or None where it is no printable one."""
    character = chr(key >> INDEX_BITS)
    return character if character.isascii() and character.isprintable() and key >> 56 > 32 else None


def symbol_name(key: int) -> str:
    """Return A12 for gtsam's symbol of that name, and the number itself for any other key."""
    letter = letter_of_key(key)
    return f"{letter}{key & MAX_INDEX}" if letter in set(LETTERS) else str(key)


def robot_name(k: int) -> str:
    """Return A to Z, then R26, R27, ..."""
    return chr(ord("A") + k) if k < 26 else f"R{k}"


class KeyKind(StrEnum):
    """How ids name frames."""

    AUTO = "auto"
    GTSAM = "gtsam"
    PLAIN = "plain"
    OFFSET = "offset"


@dataclass(frozen=True, slots=True)
class KeyScheme:
    """How ids name frames, and the offset where there is one.

    Attributes:
        kind: AUTO takes ids with a letter in their top byte for gtsam's and others for plain.
        offset: ids per robot, for OFFSET.
    """

    kind: KeyKind = KeyKind.AUTO
    offset: int = 0


AUTO = KeyScheme()


def parsed_scheme(word: str) -> KeyScheme:
    """Read auto, gtsam, plain or offset=N.

    Raises:
        ValueError: it is none of these.
    """
    kind, equals, number = word.partition("=")
    if kind == KeyKind.OFFSET and number.isascii() and number.isdecimal() and int(number) > 0:
        return KeyScheme(KeyKind.OFFSET, int(number))
    if kind in {KeyKind.AUTO, KeyKind.GTSAM, KeyKind.PLAIN} and not equals:
        return KeyScheme(KeyKind(kind))
    raise ValueError(f"keys are auto, gtsam, plain or offset=N (N from 1), got {word}")


def named_frame(key: int, scheme: KeyScheme) -> FrameId | None:
    """Return the frame that a key names by itself, None where it is plain.

    Raises:
        ValueError: the scheme is gtsam's and the key has no letter.
    """
    if scheme.kind is KeyKind.PLAIN:
        return None
    if scheme.kind is KeyKind.OFFSET:
        robot, index = divmod(key, scheme.offset)
        return FrameId(robot_name(robot), index)
    letter = letter_of_key(key)
    if letter is None and scheme.kind is KeyKind.GTSAM:
        raise ValueError(f"id {key} has no robot's letter in its top byte")
    return None if letter is None else FrameId(letter, key & MAX_INDEX)
