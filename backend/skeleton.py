"""The team reduced to the poses where maps meet: small enough to try many joins.

Between two consecutive meeting poses of a map the chain is one edge with the chain's own pose and
covariance, so cycles through several maps are judged exactly as on the whole graph.
"""

from dataclasses import dataclass

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.chain import Forest, spanning_forest
from groundfuse.backend.consistency import against_chain, links
from groundfuse.backend.problem import Array, Indices, Problem

CHAIN_LENGTH = 1e-3  # any length below that of the joins: chains are always in the tree


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """Meeting poses, the chain between them, and the edges that may join maps.

    Attributes:
        node: (k,) pose number of every meeting pose, ascending.
        map_of: (k,) map of every meeting pose.
        num_maps: number of maps, also those without a meeting pose.
        chain: edges between consecutive meeting poses of a map.
        joins: the candidate edges, on meeting poses.
        maps: (m, 2) the two maps of every candidate, ascending.
    """

    node: Indices
    map_of: Indices
    num_maps: int
    chain: Problem
    joins: Problem
    maps: Indices


def skeleton(candidates: Problem, forest: Forest) -> Skeleton:
    """Reduce the team to the poses that `candidates`, edges between maps, touch."""
    node = np.unique(np.concatenate([candidates.a, candidates.b])).astype(np.int64)
    map_of = forest.part[node]
    order = np.lexsort((node, forest.depth[node], map_of))
    along = np.flatnonzero(map_of[order][1:] == map_of[order][:-1])
    low, high = order[along], order[along + 1]
    pose_b = forest.poses[node[high]]
    step = planar.between(forest.poses[node[low]], pose_b)
    spatial = forest.between(node[low], node[high])
    noise = planar.carried(planar.adjoint(planar.inverse(pose_b)), spatial)
    chain = Problem(len(node), low, high, step, planar.inverted(noise))
    a, b = np.searchsorted(node, candidates.a), np.searchsorted(node, candidates.b)
    joins = Problem(len(node), a, b, candidates.a_from_b, candidates.information)
    maps = np.stack([map_of[a], map_of[b]], axis=1)
    return Skeleton(node, map_of, int(forest.part.max()) + 1, chain, joins, np.sort(maps, axis=1))


def joined(team: Skeleton, tree: Indices) -> Forest:
    """Return the trees of meeting poses when the maps are joined by the candidates `tree`."""
    tied, chain = team.joins.of(tree), team.chain
    problem = Problem(
        len(team.node),
        np.concatenate([chain.a, tied.a]),
        np.concatenate([chain.b, tied.b]),
        np.concatenate([chain.a_from_b, tied.a_from_b]),
        np.concatenate([chain.information, tied.information]),
    )
    length = np.concatenate([np.full(len(chain), CHAIN_LENGTH), np.ones(len(tied))])
    return spanning_forest(problem, length)


def chi2_of_joins(team: Skeleton, forest: Forest) -> Array:
    """Return (m,) chi2 of every candidate against the tree; infinite between unconnected parts."""
    together = forest.part[team.joins.a] == forest.part[team.joins.b]
    chi2 = np.full(len(team.joins), np.inf)
    chi2[together] = against_chain(links(team.joins.of(together), forest), forest)
    return chi2
