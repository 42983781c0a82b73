"""The motion most candidate matches agree on, and how far ahead of the runner-up it is.

Floor coordinates of two views differ by an isometry (paper §2) as far as the cameras are steady;
the consensus therefore draws two candidates, compares their segment lengths, and lets every
candidate vote. Candidates are the k nearest neighbours *without* ratio test: on a floor that
repeats, the neighbours spread over the repeats and the second-best motion gets nearly as many votes
as the best, which no count of inliers would show.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groundfuse.backend.measurement import Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Mask, Points
from groundfuse.frontend.candidates_compiled import laid_out
from groundfuse.frontend.consensus_compiled import search
from groundfuse.frontend.consensus_table import Limits, Table
from groundfuse.frontend.middle import middle


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

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("refinements",))
        if self.max_turn_rad > math.pi:
            raise ValueError(f"max_turn_rad must be pi at most, got {self.max_turn_rad:g}")


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
    table = _table(found)
    limits = _limits(found, tolerance_m, max_log_scale, options, gate)
    draws = rng.random((2, options.num_draws))
    motions, votes = np.empty((options.num_modes, 4)), np.empty(options.num_modes, dtype=np.int64)
    voters = np.empty((options.num_modes, len(found.index_a)), dtype=np.bool_)
    most, steps = options.max_hypotheses, options.refinements
    count = search(table, draws, limits, most, steps, motions, votes, voters)
    modes = [_mode(motions[k], int(votes[k]), voters[k]) for k in range(count)]
    return sorted(modes, key=lambda mode: -mode.votes)


def _table(found: Candidates) -> Table:
    """Lay candidates out for the compiled loops."""
    laid = laid_out(found.floor_a, found.floor_b, found.index_a, found.rank, found.turn_rad)
    return Table(*laid, found.index_b, int(found.index_b.max()) + 1)


def _limits(
    found: Candidates,
    tolerance_m: float,
    max_log_scale: float,
    options: ConsensusOptions,
    gate: Gate | None,
) -> Limits:
    """Return what is asked of a motion; a gate gives way by the tolerance that wobble needs."""
    centre = middle(found.floor_b.T.copy())
    expected, gate_m, gate_rad = np.array([1.0, 0.0, 0.0, 0.0]), np.inf, np.inf
    if gate is not None:
        size_m = float(np.sqrt(((found.floor_b - centre) ** 2).sum(axis=1).mean()))
        expected = _coefficients(gate.a_from_b)
        gate_m = gate.radius_m + tolerance_m
        gate_rad = gate.turn_rad + tolerance_m / max(size_m, tolerance_m)
    return Limits(
        tolerance_m,
        math.cos(options.max_turn_rad),
        math.exp(max_log_scale),
        options.min_baseline_tolerances * tolerance_m,
        options.distinct_tolerances * tolerance_m,
        options.distinct_turn_rad,
        float(centre[0]),
        float(centre[1]),
        expected,
        gate_m,
        math.hypot(*centre),
        gate_rad,
    )


def _coefficients(motion: Se2) -> Floats:
    return np.array([np.cos(motion.theta_rad), np.sin(motion.theta_rad), motion.x_m, motion.y_m])


def _mode(motion: Floats, votes_of: int, voters: Mask) -> Mode:
    heading = float(np.arctan2(motion[1], motion[0]))
    scale = float(np.hypot(motion[0], motion[1]))
    return Mode(Se2(float(motion[2]), float(motion[3]), heading), scale, voters, votes_of)
