"""How the maps of a team lie: the assignment that most independent evidence agrees on.

An assignment joins the maps by one hypothesis per join; every other overlap then agrees with it or
does not. Its score counts closures (pairs of maps that agree beyond what a tree needs; closing by
chance is rare however many overlaps repeat the same mistake) far above support, and support only by
its logarithm, so that only a clear majority decides between two maps that nobody else sees. Rivals
whose support is within `ambiguity_ratio` of the best one's stay open, and only what all of them
agree on is used.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.chain import Forest
from groundfuse.backend.chance import coincidence, expected_sets
from groundfuse.backend.consistency import Flags, links
from groundfuse.backend.cycles import Cycle, closed_cycles
from groundfuse.backend.hypotheses import MAX_PER_PAIR, Hypothesis, hypotheses
from groundfuse.backend.option_checks import check_numbers
from groundfuse.backend.problem import Indices
from groundfuse.backend.skeleton import Skeleton, chi2_of_joins, joined

CERTAINTY = 100.0  # times rarer by chance than a rival that chance explains
CLOSURE = 7.0  # log of 1000: how rarely a wrong hypothesis closes a cycle by chance


@dataclass(frozen=True, slots=True, kw_only=True)
class VotingOptions:
    """How overlaps between maps are weighed.

    Attributes:
        limit: chi2 of 3 degrees of freedom above which overlaps or cycles disagree.
        num_hypotheses: alternatives kept per pair of maps.
        ambiguity_ratio: how many times the support of the next-best answer the best one needs.
        max_alternatives: rival assignments examined.
        chance: a rival whose support this many sets of unrelated overlaps would reach by chance is
            no answer.
    """

    limit: float = 16.27  # 99.9 %
    num_hypotheses: int = 4
    ambiguity_ratio: float = 2.0
    max_alternatives: int = 100
    chance: float = 0.05

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("max_alternatives",), shares=("chance",))


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """One way to join the maps.

    Attributes:
        tree: candidate edges that join the maps, no cycle among them.
        agreeing: (m,) whether each candidate agrees with the tree.
        score: closures and support, in natural-log units.
        closures: pairs of maps that agree beyond those of the tree.
        support: agreeing candidates per pair of maps that has any.
    """

    tree: Indices
    agreeing: Flags
    score: float
    closures: int
    support: dict[tuple[int, int], int]


@dataclass(frozen=True, slots=True, eq=False)
class Vote:
    """The outcome.

    Attributes:
        best: the assignment of the highest score.
        rivals: other assignments that the data do not exclude.
        sure: (m,) candidates that agree with the best assignment and with all rivals.
    """

    best: Assignment
    rivals: tuple[Assignment, ...]
    sure: Flags


def vote(team: Skeleton, options: VotingOptions) -> Vote:
    """Weigh all candidate joins of the team."""
    chains = joined(team, np.empty(0, dtype=np.int64))
    found = hypotheses(team, chains, options.limit, options.num_hypotheses)
    cycles = closed_cycles(found, links(team.joins, chains), chains, options.limit)
    best = _assignment(team, found, cycles, (), options.limit)
    rivals = []
    for forced in _alternatives(found, cycles, best)[: options.max_alternatives]:
        rival = _assignment(team, found, cycles, forced, options.limit)
        if rival.score > best.score:
            best, rival = rival, best
        rivals.append(rival)
    open_rivals = tuple(
        r
        for r in rivals
        if _is_open(r, best, options.ambiguity_ratio)
        and not _is_coincidence(team, chains, r, best, options)
    )
    sure = np.logical_and.reduce([best.agreeing, *(r.agreeing for r in open_rivals)])
    return Vote(best, open_rivals, sure)


def _is_open(rival: Assignment, best: Assignment, ratio: float) -> bool:
    """Return whether the data leave a rival possible.

    It closes as many cycles, and its support is within `ratio` of the best one's, in the geometric
    mean over the pairs of maps where they differ: a displaced map brings all its pairs at once, so
    they are one piece of evidence and not many.
    """
    if np.array_equal(rival.agreeing, best.agreeing) or rival.closures < best.closures:
        return False
    pairs = rival.support.keys() | best.support.keys()
    differing = sum(rival.support.get(p) != best.support.get(p) for p in pairs)
    return rival.score >= best.score - (math.log(ratio) + 1e-9) * max(1, differing)


def _is_coincidence(
    team: Skeleton, chains: Forest, rival: Assignment, best: Assignment, options: VotingOptions
) -> bool:
    """Return whether wrong overlaps make up a rival by chance, and certainly not the best answer.

    The one has to hold for all pairs of maps where the two differ, the other for one of them.
    """
    pairs = rival.support.keys() | best.support.keys()
    sure = False
    for pair in pairs:
        theirs, ours = rival.support.get(pair, 0), best.support.get(pair, 0)
        if theirs == ours:
            continue
        between = (team.maps == pair).all(axis=1)
        edges = links(team.joins.of(between), chains)
        some = edges.of(np.arange(min(len(edges.a), MAX_PER_PAIR)))
        probability = coincidence(some, chains, options.limit)
        count = len(edges.a)
        unrelated = max(0, count - ours - theirs)  # some may agree with both
        if theirs and expected_sets(unrelated, theirs, probability) < options.chance:
            return False
        most = options.chance / CERTAINTY
        sure |= bool(ours) and expected_sets(count, ours, probability) < most
    return sure


def _alternatives(
    found: Sequence[Hypothesis], cycles: Sequence[Cycle], best: Assignment
) -> list[Cycle]:
    """Return what to force: cycles, then single hypotheses, that the best assignment refuses."""
    refused = {k for k, h in enumerate(found) if not best.agreeing[h.seed]}
    rival_cycles = [c for c in cycles if refused & set(c)]
    rival_cycles.sort(key=lambda c: -sum(found[k].support for k in c))
    singles = sorted(refused, key=lambda k: -found[k].support)
    return [*rival_cycles, *((k,) for k in singles)]


def _assignment(
    team: Skeleton,
    found: Sequence[Hypothesis],
    cycles: Sequence[Cycle],
    forced: Iterable[int],
    limit: float,
) -> Assignment:
    """Join the maps: first by what is forced, then by votes and support (Kruskal)."""
    votes = np.zeros(len(found))
    for cycle in cycles:
        votes[list(cycle)] += 1
    first = list(forced)
    order = sorted(range(len(found)), key=lambda k: (-votes[k], -found[k].support, k))
    root = list(range(team.num_maps))

    def top(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    tree = []
    for k in [*first, *order]:
        f, g = (top(m) for m in found[k].maps)
        if f != g:
            root[f] = g
            tree.append(found[k].seed)
    return scored(team, np.array(tree, dtype=np.int64), limit)


def scored(team: Skeleton, tree: Indices, limit: float) -> Assignment:
    """Judge all candidates against the maps joined by `tree`."""
    forest: Forest = joined(team, tree)
    agreeing = chi2_of_joins(team, forest) <= limit
    key = team.maps[agreeing, 0] * team.num_maps + team.maps[agreeing, 1]
    pairs, support = np.unique(key, return_counts=True)
    closures = len(support) - len(tree)
    score = CLOSURE * closures + float(np.log(support).sum())
    split = (divmod(pair, team.num_maps) for pair in pairs.tolist())
    return Assignment(
        tree, agreeing, score, closures, dict(zip(split, support.tolist(), strict=True))
    )
