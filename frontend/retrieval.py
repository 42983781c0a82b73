"""Which frames may show the same floor: every feature votes for the frames of its nearest kin.

No prior knowledge of where anything is. Descriptors are reduced to their leading principal
components; each of a frame's strongest features looks up its nearest features in all other frames
and votes for their frames, near kin more than far.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.features import Features

Short = NDArray[np.float32]
CHUNK = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class RetrievalOptions:
    """Options of retrieval.

    Attributes:
        num_features: features per frame that vote and are voted for.
        num_components: principal components kept.
        num_votes: nearest features that each feature votes for.
        num_frames: frames returned per frame.
    """

    num_features: int = 150
    num_components: int = 32
    num_votes: int = 5
    num_frames: int = 8


def similarity(frames: Iterable[Features], options: RetrievalOptions) -> NDArray[np.float64]:
    """Return (n, n) votes between frames, symmetric, zero on the diagonal.

    Frames are read once, one after the other: they need not be in memory together.
    """
    chosen = [_strided(frame, options.num_features) for frame in frames]
    votes = np.zeros((len(chosen), len(chosen)))
    owner = np.repeat(np.arange(len(chosen)), [len(rows) for rows in chosen])
    if len(owner) == 0:
        return votes
    short = _reduced(chosen, options.num_components)
    for start in range(0, len(owner), CHUNK):
        rows = slice(start, start + CHUNK)
        likeness = short[rows] @ short.T
        likeness[owner[rows, None] == owner[None, :]] = -np.inf
        _vote(votes, likeness, owner[rows], owner, options.num_votes)
    both: NDArray[np.float64] = votes + votes.T
    return both


def _strided(frame: Features, most: int) -> Short:
    """An even selection of a frame's descriptors as unit rows; bits become -1 and 1."""
    chosen = np.linspace(0, len(frame) - 1, min(len(frame), most)).round().astype(np.int64)
    rows = frame.descriptors[chosen]
    if rows.dtype == np.uint8:
        rows = np.unpackbits(rows, axis=1).astype(np.float32) / 8.0 - 1.0 / 16.0
    return rows.astype(np.float32)


def _reduced(rows: Sequence[Short], num_components: int) -> Short:
    """Project on the leading principal components of all rows, to unit length."""
    stacked = np.concatenate(list(rows))
    centred = stacked - stacked.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    short = centred @ axes[:, ::-1][:, :num_components]
    length = np.maximum(np.linalg.norm(short, axis=1, keepdims=True), 1e-9)
    unit: Short = (short / length).astype(np.float32)
    return unit


def _vote(
    votes: NDArray[np.float64],
    likeness: Short,
    voter: NDArray[np.int64],
    owner: NDArray[np.int64],
    num_votes: int,
) -> None:
    """Add the votes of some features (rows of `likeness`) to the table."""
    count = min(num_votes, likeness.shape[1])
    nearest = np.argpartition(-likeness, count - 1, axis=1)[:, :count]
    value = np.take_along_axis(likeness, nearest, axis=1)
    weight = np.where(np.isfinite(value), np.maximum(value, 0.0), 0.0) ** 4
    np.add.at(votes, (np.repeat(voter, count), owner[nearest.ravel()]), weight.ravel())


def retrieved(frames: Iterable[Features], options: RetrievalOptions) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, where one is among the most similar frames of the other."""
    votes = similarity(frames, options)
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(votes):
        best = np.argsort(-row, kind="stable")[: options.num_frames]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in best if row[j] > 0.0 and j != i)
    return sorted(pairs)
