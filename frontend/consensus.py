"""The motion most candidate matches agree on, and how far ahead of the runner-up it is.

Floor coordinates of two views differ by an isometry (paper §2) as far as the cameras are steady;
the consensus therefore draws two candidates, compares their segment lengths, and lets every
candidate vote. Candidates are the k nearest neighbours *without* ratio test: on a floor that
repeats, the neighbours spread over the repeats and the second-best motion gets nearly as many votes
as the best, which no count of inliers would show.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.arrays import Floats, Mask, Points


class Candidates(NamedTuple):
    """Possible matches, sorted by `index_a`.

    Attributes:
        floor_a: (n, 2) metres in foot a, at the nominal attitude.
        floor_b: (n, 2) metres in foot b.
        index_a: (n,) feature of a; one feature has several candidates.
        index_b: (n,) feature of b.
        rank: (n,) 0 for the nearest neighbour.
        turn_rad: (n,) orientation in a minus orientation in b; nan where features have none.
    """

    floor_a: Points
    floor_b: Points
    index_a: np.ndarray
    index_b: np.ndarray
    rank: np.ndarray
    turn_rad: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsensusOptions:
    """Options of the consensus.

    Attributes:
        num_draws: pairs of candidates that are drawn.
        max_hypotheses: drawn pairs that go to the vote after the segment test.
        max_turn_rad: largest disagreement between segment and feature orientation.
        min_baseline_tolerances: shortest segment, in vote tolerances.
        distinct_tolerances: motions further apart than this at the view's centre are distinct.
        distinct_turn_rad: motions that turn this much apart are distinct.
        refinements: least-squares steps over the voters.
        num_modes: distinct motions that are looked for.
    """

    num_draws: int = 30_000
    max_hypotheses: int = 300
    max_turn_rad: float = 0.45
    min_baseline_tolerances: float = 6.0
    distinct_tolerances: float = 4.0
    distinct_turn_rad: float = 0.35
    refinements: int = 3
    num_modes: int = 3


class Gate(NamedTuple):
    """Motions that are possible by what is known beforehand.

    Attributes:
        a_from_b: expected motion, foot to foot.
        radius_m: largest distance of foot b from where it is expected.
        turn_rad: largest turn from it.
    """

    a_from_b: Se2
    radius_m: float
    turn_rad: float


class Mode(NamedTuple):
    """A motion that candidates agree on.

    Attributes:
        a_from_b: isometry part.
        scale: metres of a per metre of b; 1 for the isometry model.
        voters: (n,) candidates within tolerance, at most one per feature of a and of b.
        votes: features of a that vote for it.
    """

    a_from_b: Se2
    scale: float
    voters: Mask
    votes: int


def find_modes(
    found: Candidates,
    tolerance_m: float,
    max_log_scale: float,
    options: ConsensusOptions,
    rng: np.random.Generator,
    gate: Gate | None = None,
) -> list[Mode]:
    """Return the distinct motions with most votes, best first; empty if no candidates agree.

    Args:
        found: candidate matches.
        tolerance_m: distance within which a candidate votes for a motion.
        max_log_scale: largest |log scale| between the views; 0 for the isometry model.
        options: see `ConsensusOptions`.
        rng: for the draws.
        gate: motions outside are not considered, not even as rivals.
    """
    if len(found.index_a) < 2:
        return []
    hypotheses = _drawn(found, tolerance_m, max_log_scale, options, rng)
    centre = np.median(found.floor_b, axis=0)
    if gate is not None:
        hypotheses = hypotheses[_within(gate, hypotheses, found.floor_b, tolerance_m)]
    if len(hypotheses) == 0:
        return []
    hypotheses = hypotheses[: options.max_hypotheses]
    votes = _votes(found, hypotheses, tolerance_m, options.max_turn_rad)
    motions: list[Floats] = []
    modes: list[Mode] = []
    while len(hypotheses) and len(modes) < options.num_modes:
        start = hypotheses[int(np.argmax(votes))]
        best, count = _refined(found, start, tolerance_m, max_log_scale, options)
        # A start on the slope of a known mode climbs back to it: no rival. One at the edge of the
        # gate may climb out of it.
        known = any(
            not _distinct(other[None], best, centre, tolerance_m, options)[0] for other in motions
        )
        inside = gate is None or _within(gate, best[None], found.floor_b, tolerance_m)[0]
        if inside and not known:
            motions.append(best)
            modes.append(_mode(found, best, count, tolerance_m, options))
        apart = _distinct(hypotheses, best, centre, tolerance_m, options)
        apart &= _distinct(hypotheses, start, centre, tolerance_m, options)
        hypotheses, votes = hypotheses[apart], votes[apart]
    return sorted(modes, key=lambda mode: -mode.votes)


def _mode(
    found: Candidates, motion: Floats, votes: int, tolerance_m: float, options: ConsensusOptions
) -> Mode:
    heading = float(np.arctan2(motion[1], motion[0]))
    return Mode(
        Se2(float(motion[2]), float(motion[3]), heading),
        float(np.hypot(motion[0], motion[1])),
        one_to_one(found, motion, tolerance_m, options.max_turn_rad),
        votes,
    )


def _drawn(
    found: Candidates,
    tolerance_m: float,
    max_log_scale: float,
    options: ConsensusOptions,
    rng: np.random.Generator,
) -> Floats:
    """Hypotheses (m, 4) `s cos, s sin, x, y` of drawn pairs that pass the segment test."""
    weight = 1.0 / (1.0 + found.rank)
    cumulative = np.cumsum(weight)
    draws = rng.random((2, options.num_draws)) * cumulative[-1]
    one, two = np.searchsorted(cumulative, draws)
    in_a = found.floor_a[two] - found.floor_a[one]
    in_b = found.floor_b[two] - found.floor_b[one]
    length_a, length_b = np.hypot(*in_a.T), np.hypot(*in_b.T)
    shortest = options.min_baseline_tolerances * tolerance_m
    stretch = np.expm1(max_log_scale) * length_b
    ok = (np.minimum(length_a, length_b) > shortest) & (
        np.abs(length_a - length_b) < 2.0 * tolerance_m + stretch
    )
    one, two, in_a, in_b = one[ok], two[ok], in_a[ok], in_b[ok]
    length_a, length_b = length_a[ok], length_b[ok]
    turn = np.arctan2(in_a[:, 1], in_a[:, 0]) - np.arctan2(in_b[:, 1], in_b[:, 0])
    agree = np.ones(len(turn), dtype=bool)
    for end in (one, two):
        error = np.abs(np.remainder(turn - found.turn_rad[end] + np.pi, 2 * np.pi) - np.pi)
        agree &= ~(error > options.max_turn_rad)
    keep = np.flatnonzero(agree)
    one, two, turn = one[keep], two[keep], turn[keep]
    ratio = np.log(length_a[keep] / length_b[keep])
    scale = np.exp(np.clip(ratio, -max_log_scale, max_log_scale))
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    middle_a = (found.floor_a[one] + found.floor_a[two]) / 2.0
    middle_b = (found.floor_b[one] + found.floor_b[two]) / 2.0
    x = middle_a[:, 0] - c * middle_b[:, 0] + s * middle_b[:, 1]
    y = middle_a[:, 1] - s * middle_b[:, 0] - c * middle_b[:, 1]
    return np.stack([c, s, x, y], axis=1)


def _residual(found: Candidates, motions: Floats) -> Floats:
    """Squared distances (m, n) between a and moved b."""
    c, s, x, y = (motions[:, k, None].astype(np.float32) for k in range(4))
    ax, ay = found.floor_a.astype(np.float32).T
    bx, by = found.floor_b.astype(np.float32).T
    dx = c * bx - s * by + (x - ax)
    dy = s * bx + c * by + (y - ay)
    squared: Floats = dx * dx + dy * dy
    return squared


def _near(found: Candidates, motions: Floats, tolerance_m: float, max_turn_rad: float) -> Mask:
    """Which candidates (m, n) lie within tolerance and are turned as the motion turns them."""
    near = _residual(found, motions) < tolerance_m**2
    cos_turn = np.cos(found.turn_rad).astype(np.float32)
    sin_turn = np.sin(found.turn_rad).astype(np.float32)
    length = np.hypot(motions[:, 0], motions[:, 1])[:, None]
    c, s = (motions[:, :2].T[:, :, None] / length).astype(np.float32)
    voting: Mask = near & ~(c * cos_turn + s * sin_turn < np.cos(max_turn_rad))
    return voting


def _votes(
    found: Candidates, motions: Floats, tolerance_m: float, max_turn_rad: float
) -> np.ndarray:
    """Features of a with a candidate within tolerance, per motion (m,)."""
    near = _near(found, motions, tolerance_m, max_turn_rad)
    starts = np.flatnonzero(np.r_[True, found.index_a[1:] != found.index_a[:-1]])
    votes: np.ndarray = np.logical_or.reduceat(near, starts, axis=1).sum(axis=1)
    return votes


def _refined(
    found: Candidates,
    motion: Floats,
    tolerance_m: float,
    max_log_scale: float,
    options: ConsensusOptions,
) -> tuple[Floats, int]:
    """Least squares over the voters, kept while the votes do not fall."""
    votes = int(_votes(found, motion[None], tolerance_m, options.max_turn_rad)[0])
    for _ in range(options.refinements):
        near = one_to_one(found, motion, tolerance_m, options.max_turn_rad)
        if near.sum() < 2:
            break
        candidate = _procrustes(found.floor_a[near], found.floor_b[near], max_log_scale)
        count = int(_votes(found, candidate[None], tolerance_m, options.max_turn_rad)[0])
        if count < votes:
            break
        motion, votes = candidate, count
    return motion, votes


def _procrustes(a: Points, b: Points, max_log_scale: float) -> Floats:
    """Best motion (4,) from b to a; with scale unless `max_log_scale` is 0 (Umeyama 1991)."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    da, db = a - mean_a, b - mean_b
    c, s = float((da * db).sum()), float((da[:, 1] * db[:, 0] - da[:, 0] * db[:, 1]).sum())
    length = np.hypot(c, s)
    if length == 0.0:
        return np.array([1.0, 0.0, *(mean_a - mean_b)])
    scale = 1.0
    if max_log_scale > 0.0:
        scale = float(
            np.clip(length / (db**2).sum(), np.exp(-max_log_scale), np.exp(max_log_scale))
        )
    c, s = scale * c / length, scale * s / length
    shift = mean_a - np.array([c * mean_b[0] - s * mean_b[1], s * mean_b[0] + c * mean_b[1]])
    return np.array([c, s, *shift])


def _coefficients(motion: Se2) -> Floats:
    return np.array([np.cos(motion.theta_rad), np.sin(motion.theta_rad), motion.x_m, motion.y_m])


def _apart(motions: Floats, other: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """How far motions (m, 4) differ from another at the centre of view b (m), and in turn (rad)."""
    change = motions - other
    dx = change[:, 0] * centre[0] - change[:, 1] * centre[1] + change[:, 2]
    dy = change[:, 1] * centre[0] + change[:, 0] * centre[1] + change[:, 3]
    turn = np.arctan2(motions[:, 1], motions[:, 0]) - np.arctan2(other[1], other[0])
    return np.hypot(dx, dy), np.abs(np.remainder(turn + np.pi, 2 * np.pi) - np.pi)


def _within(gate: Gate, motions: Floats, floor_b: Points, tolerance_m: float) -> Mask:
    """Which motions (m, 4) a gate allows, give or take the tolerance that wobble needs.

    Judged at the view's centre, where a motion is known best; a turn swings it about foot b.
    """
    centre = np.median(floor_b, axis=0)
    size = np.sqrt(((floor_b - centre) ** 2).sum(axis=1).mean())
    far, turn = _apart(motions, _coefficients(gate.a_from_b), centre)
    near = far <= gate.radius_m + turn * np.hypot(*centre) + tolerance_m
    allowed: Mask = near & (turn <= gate.turn_rad + tolerance_m / max(size, tolerance_m))
    return allowed


def _distinct(
    motions: Floats, other: Floats, centre: Floats, tolerance_m: float, options: ConsensusOptions
) -> Mask:
    far, turn = _apart(motions, other, centre)
    apart: Mask = far > options.distinct_tolerances * tolerance_m
    return apart | (turn > options.distinct_turn_rad)


def one_to_one(found: Candidates, motion: Floats, tolerance_m: float, max_turn_rad: float) -> Mask:
    """Return the nearest voter of each feature of a, then of each feature of b."""
    squared = _residual(found, motion[None])[0]
    near = np.flatnonzero(_near(found, motion[None], tolerance_m, max_turn_rad)[0])
    order = near[np.argsort(squared[near], kind="stable")]
    _, first = np.unique(found.index_a[order], return_index=True)
    order = order[np.sort(first)]
    _, first = np.unique(found.index_b[order], return_index=True)
    voters = np.zeros(len(found.index_a), dtype=bool)
    voters[order[first]] = True
    return voters
