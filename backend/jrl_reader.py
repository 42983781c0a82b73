"""JRL text to its content: everything in it is read, or refused with where it stands.

What is no planar pose graph (three dimensions, ranges, landmarks) is refused by its tag.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from groundfuse.backend.graph_keys import MAX_KEY
from groundfuse.backend.jrl import (
    BETWEEN,
    POSE,
    PRIOR,
    Between,
    Dataset,
    Entry,
    Factors,
    Nine,
    Prior,
    Values,
)
from groundfuse.backend.measurement import Se2

Part = TypeVar("Part")
ASYMMETRY = 1e-9  # relative: rounding of a matrix that was inverted
REQUIRED = ("name", "robots", "measurements")
SECTIONS = (
    *("groundtruth", "initialization"),
    *("potential_outlier_factors", "outlier_factors"),
)


def parsed(text: str) -> Dataset:
    """Read a JRL dataset.

    Raises:
        ValueError: no JSON (with the line), or something missing, unknown, given twice, or out of
            range (with its place, as measurements.a[3].measurements[0]).
    """
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_constant=_no_number)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    top = _members(content, "the file", REQUIRED, SECTIONS)
    if not isinstance(top["name"], str):
        raise ValueError(f"name: needs a text, got {_shown(top['name'])}")  # noqa: TRY004
    robots = _robots(top["robots"])
    measurements = _by_robot(top["measurements"], "measurements", robots, _entries)
    for robot in robots:
        measurements.setdefault(robot, ())
    groundtruth, initialization = (
        _by_robot(top[name], name, robots, _values) if name in top else None
        for name in SECTIONS[:2]
    )
    potential, wrong = (
        _factors(top[name], name, robots, measurements) if name in top else None
        for name in SECTIONS[2:]
    )
    return Dataset(top["name"], robots, measurements, groundtruth, initialization, potential, wrong)


def _unique(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for name, value in pairs:
        if name in content:
            raise ValueError(f"{name!r} is given twice")
        content[name] = value
    return content


def _no_number(word: str) -> float:
    raise ValueError(f"every number must be finite, got {word}")


def _shown(content: object) -> str:
    text = json.dumps(content)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _members(
    content: object, place: str, needed: Iterable[str], allowed: Iterable[str] = ()
) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"{place}: needs an object, got {_shown(content)}")  # noqa: TRY004
    for name in needed:
        if name not in content:
            raise ValueError(f'{place}: "{name}" is missing')
    for name in content:
        if name not in {*needed, *allowed}:
            raise ValueError(f'{place}: unknown member "{name}"')
    return content


def _items(content: object, place: str) -> list[Any]:
    if content is None:  # what an empty list is written as
        return []
    if not isinstance(content, list):
        raise ValueError(f"{place}: needs a list, got {_shown(content)}")  # noqa: TRY004
    return content


def _whole(content: object, place: str) -> int:
    number = isinstance(content, int) and not isinstance(content, bool)
    if not number or not 0 <= int(str(content)) <= MAX_KEY:
        raise ValueError(f"{place}: needs a whole number below 2^64, got {_shown(content)}")
    return int(str(content))


def _number(content: object, place: str) -> float:
    if isinstance(content, bool) or not isinstance(content, int | float):
        raise ValueError(f"{place}: needs a number, got {_shown(content)}")  # noqa: TRY004
    try:
        number = float(content)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{place}: every number must be finite")
    return number


def _robots(content: object) -> tuple[str, ...]:
    """Read the robots: letters, or their codes, which is what a C++ char is written as."""
    robots: list[str] = []
    for k, robot in enumerate(_items(content, "robots")):
        place = f"robots[{k}]"
        code = isinstance(robot, int) and not isinstance(robot, bool) and 32 < robot < 127
        letter = chr(robot) if code else robot
        if not isinstance(letter, str) or len(letter) != 1 or not "!" <= letter <= "~":
            raise ValueError(f"{place}: needs a letter or its code, got {_shown(robot)}")
        if letter in robots:
            raise ValueError(f"{place}: {letter} is given twice")
        robots.append(letter)
    return tuple(robots)


def _by_robot(
    content: object, place: str, robots: Iterable[str], read: Callable[[object, str], Part]
) -> dict[str, Part]:
    every = _members({} if content is None else content, place, (), robots)
    return {robot: read(own, f"{place}.{robot}") for robot, own in every.items()}


def _entries(content: object, place: str) -> tuple[Entry, ...]:
    return tuple(_entry(e, f"{place}[{k}]") for k, e in enumerate(_items(content, place)))


def _entry(content: object, place: str) -> Entry:
    members = _members(content, place, ("stamp",), ("measurements",))
    inside = f"{place}.measurements"
    rows = _items(members.get("measurements"), inside)
    measured = tuple(_measured(m, f"{inside}[{k}]") for k, m in enumerate(rows))
    return Entry(_whole(members["stamp"], f"{place}.stamp"), measured)


def _measured(content: object, place: str) -> Prior | Between:
    tag = content.get("type") if isinstance(content, dict) else None
    if tag == PRIOR:
        members = _members(content, place, ("type", "key", "prior", "covariance"))
        key = _whole(members["key"], f"{place}.key")
        pose = _pose(members["prior"], f"{place}.prior")
        return Prior(key, pose, _covariance(members["covariance"], f"{place}.covariance"))
    if tag == BETWEEN:
        names = ("type", "key1", "key2", "measurement", "covariance")
        members = _members(content, place, names)
        a, b = (_whole(members[name], f"{place}.{name}") for name in ("key1", "key2"))
        if a == b:
            raise ValueError(f"{place}: an edge needs two different frames, got {a} twice")
        pose = _pose(members["measurement"], f"{place}.measurement")
        return Between(a, b, pose, _covariance(members["covariance"], f"{place}.covariance"))
    _members(content, place, ("type",), content if isinstance(content, dict) else ())
    solid = ": it is three-dimensional" if "3" in str(tag) else ""
    raise ValueError(f"{place}: unknown type {tag}{solid}; {PRIOR} and {BETWEEN} are read")


def _pose(content: object, place: str, *more: str) -> Se2:
    members = _members(content, place, ("x", "y", "theta", *more), ("type",))
    if members.get("type", POSE) != POSE:
        raise ValueError(f"{place}: unknown type {members['type']}; {POSE} is read")
    return Se2(*(_number(members[name], f"{place}.{name}") for name in ("x", "y", "theta")))


def _covariance(content: object, place: str) -> Nine:
    rows = [_number(value, f"{place}[{k}]") for k, value in enumerate(_items(content, place))]
    if len(rows) != 9:
        raise ValueError(f"{place}: needs 9 numbers, got {len(rows)}")
    a, b, c, d, e, f, g, h, i = rows
    matrix = np.reshape(rows, (3, 3))
    if np.abs(matrix - matrix.T).max() > ASYMMETRY * np.abs(matrix).max():
        raise ValueError(f"{place}: must be symmetric")
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if not smallest > 0.0:
        raise ValueError(
            f"{place}: must be positive definite, its smallest eigenvalue is {smallest:.3g}"
        )
    return a, b, c, d, e, f, g, h, i


def _values(content: object, place: str) -> Values:
    """Read poses: a list with keys inside, as the library writes, or by key, as documented."""
    rows: list[tuple[int | None, Any]]
    if isinstance(content, dict):
        rows = [(_written(key, place), own) for key, own in content.items()]
    else:
        rows = [(None, own) for own in _items(content, place)]
    values: Values = {}
    for k, (known, own) in enumerate(rows):
        here = f"{place}[{k}]"
        tag = own.get("type", POSE) if isinstance(own, dict) else POSE
        if tag != POSE:
            raise ValueError(f"{here}: unknown type {tag}; {POSE} is read")
        pose = _pose(own, here, *(("key",) if known is None else ()))
        key = _whole(own["key"], f"{here}.key") if known is None else known
        if key in values:
            raise ValueError(f"{here}: key {key} is given twice")
        values[key] = pose
    return values


def _written(key: str, place: str) -> int:
    if not (key.isascii() and key.isdecimal() and len(key) <= 20):
        raise ValueError(f"{place}: a key must be a whole number below 2^64, got {key}")
    return _whole(int(key), place)


def _factors(
    content: object,
    place: str,
    robots: Iterable[str],
    measurements: Mapping[str, tuple[Entry, ...]],
) -> dict[str, Factors]:
    def read(own: object, here: str) -> Factors:
        return tuple(_pair(pair, f"{here}[{k}]") for k, pair in enumerate(_items(own, here)))

    every = _by_robot(content, place, robots, read)
    for robot, pairs in every.items():
        for k, (entry, number) in enumerate(pairs):
            entries = measurements[robot]
            if entry >= len(entries) or number >= len(entries[entry].measurements):
                raise ValueError(f"{place}.{robot}[{k}]: no measurement [{entry}, {number}]")
    return every


def _pair(content: object, place: str) -> tuple[int, int]:
    items = _items(content, place)
    if len(items) != 2:
        raise ValueError(f"{place}: needs [entry, measurement], got {_shown(content)}")
    return _whole(items[0], f"{place}[0]"), _whole(items[1], f"{place}[1]")
