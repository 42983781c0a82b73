"""What the overlaps say about where two maps lie: one hypothesis per set of overlaps that agree."""

from dataclasses import dataclass

import numpy as np

from groundfuse.backend.chain import Forest
from groundfuse.backend.clique import largest_clique
from groundfuse.backend.consistency import Flags, agreement, links
from groundfuse.backend.problem import Indices
from groundfuse.backend.skeleton import Skeleton

MAX_PER_PAIR = 250  # overlaps of one pair of maps that are compared all with all


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Overlaps between two maps that agree with each other.

    Attributes:
        maps: the two maps, ascending.
        members: candidate edges that agree, ascending.
        seed: the member that agrees with the most candidates of the pair.
    """

    maps: tuple[int, int]
    members: Indices
    seed: int

    @property
    def support(self) -> int:
        """Return how many overlaps agree."""
        return len(self.members)


def hypotheses(
    team: Skeleton, chains: Forest, limit: float, num_per_pair: int
) -> tuple[Hypothesis, ...]:
    """Return the best-supported hypotheses of every pair of maps, strongest first within a pair."""
    key = team.maps[:, 0] * team.num_maps + team.maps[:, 1]
    order = np.argsort(key, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(key[order])) + 1) if len(order) else []
    return tuple(
        h for group in groups for h in _of_pair(team, chains, np.sort(group), limit, num_per_pair)
    )


def _of_pair(
    team: Skeleton, chains: Forest, group: Indices, limit: float, num_per_pair: int
) -> list[Hypothesis]:
    maps = (int(team.maps[group[0], 0]), int(team.maps[group[0], 1]))
    if len(group) > MAX_PER_PAIR:
        group = group[np.linspace(0, len(group) - 1, MAX_PER_PAIR).astype(np.int64)]
    agrees = agreement(links(team.joins.of(group), chains), chains, limit)
    found: list[Hypothesis] = []
    left = np.arange(len(group))
    while len(left) and len(found) < num_per_pair:
        clique = left[largest_clique(agrees[np.ix_(left, left)])]
        seed = clique[np.argmax(agrees[clique].sum(axis=1))]
        found.append(Hypothesis(maps, np.sort(group[clique]), int(group[seed])))
        left = _without(left, clique, agrees)
    return found


def _without(left: Indices, clique: Indices, agrees: Flags) -> Indices:
    """Drop the clique and whatever agrees with most of it: that is no other hypothesis."""
    rest = np.setdiff1d(left, clique)
    same = agrees[np.ix_(rest, clique)].mean(axis=1) > 0.5
    kept: Indices = rest[~same]
    return kept
