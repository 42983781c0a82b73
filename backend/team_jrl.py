"""A team as a JRL dataset: every robot's measurements at its frames, keys with its letter."""

from collections.abc import Iterable, Mapping, Sequence

from groundfuse.backend.graph_keys import LETTERS, key_of_symbol
from groundfuse.backend.jrl import Between, Dataset, Entry, Factors, Nine, Values
from groundfuse.backend.measurement import Array, FrameId, RelativePose, Se2


def letters_of(robots: Iterable[str]) -> dict[str, str]:
    """Return a letter per robot: its name where all names are letters, otherwise a, b, c, ...

    Raises:
        ValueError: more robots than letters.
    """
    names = sorted(set(robots))
    if all(len(name) == 1 and "!" <= name <= "~" for name in names):
        return {name: name for name in names}
    lower_first = sorted(LETTERS, key=lambda letter: (letter.isupper(), letter))
    if len(names) > len(lower_first):
        raise ValueError(f"keys have {len(lower_first)} letters, got {len(names)} robots")
    return dict(zip(names, lower_first, strict=False))


def keys_with_letters(frames: Iterable[FrameId], letter: Mapping[str, str]) -> dict[FrameId, int]:
    """Return gtsam's key of every frame (ValueError for an index of more than 56 bits)."""
    return {frame: key_of_symbol(letter[frame.robot], frame.index) for frame in frames}


def dataset_of_team(
    name: str,
    poses: Mapping[FrameId, Se2],
    edges: Sequence[RelativePose],
    letter: Mapping[str, str],
    truth: Mapping[FrameId, Se2] | None = None,
    wrong: Sequence[bool] | None = None,
    possible: Sequence[bool] | None = None,
) -> Dataset:
    """Return a dataset; an edge stands at its own robot's later frame, an overlap at a's.

    Args:
        name: of the dataset.
        poses: start values; stamps are the frames' numbers.
        edges: measurements between these frames.
        letter: of every robot; robots without a frame are left out.
        truth: true poses.
        wrong: per edge, whether it is wrong.
        possible: per edge, whether it may be.

    Raises:
        ValueError: an index of more than 56 bits.
    """
    key_of = keys_with_letters(poses, letter)
    letter = {robot: letter[robot] for robot in sorted({frame.robot for frame in poses})}
    made: dict[FrameId, list[int]] = {frame: [] for frame in sorted(poses)}
    for k, edge in enumerate(edges):
        later = edge.b if edge.a.robot == edge.b.robot and edge.b > edge.a else edge.a
        made[later].append(k)
    entries: dict[str, list[Entry]] = {own: [] for own in letter.values()}
    place: dict[int, tuple[str, int, int]] = {}
    for frame, numbers in made.items():
        own = letter[frame.robot]
        for j, k in enumerate(numbers):
            place[k] = (own, len(entries[own]), j)
        measured = tuple(_between(edges[k], key_of) for k in numbers)
        entries[own].append(Entry(frame.index, measured))
    return Dataset(
        name,
        tuple(letter.values()),
        {own: tuple(rows) for own, rows in entries.items()},
        None if truth is None else _values(truth, key_of, letter),
        _values(poses, key_of, letter),
        None if possible is None else _factors(possible, place, letter.values()),
        None if wrong is None else _factors(wrong, place, letter.values()),
    )


def _between(edge: RelativePose, key_of: Mapping[FrameId, int]) -> Between:
    return Between(key_of[edge.a], key_of[edge.b], edge.a_from_b, _nine(edge.covariance))


def _nine(covariance: Array) -> Nine:
    a, b, c, d, e, f, g, h, i = covariance.ravel().tolist()
    return a, b, c, d, e, f, g, h, i


def _values(
    poses: Mapping[FrameId, Se2], key_of: Mapping[FrameId, int], letter: Mapping[str, str]
) -> dict[str, Values]:
    values: dict[str, Values] = {own: {} for own in letter.values()}
    for frame in sorted(poses):
        if frame in key_of:
            values[letter[frame.robot]][key_of[frame]] = poses[frame]
    return values


def _factors(
    flags: Sequence[bool], place: Mapping[int, tuple[str, int, int]], letters: Iterable[str]
) -> dict[str, Factors]:
    every = sorted(place[k] for k, flag in enumerate(flags) if flag)
    return {own: tuple((i, j) for robot, i, j in every if robot == own) for own in letters}
