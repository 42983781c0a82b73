"""Wrong steps of a trajectory: where cutting a chain would let edges in that are now turned down.

Pictures alone make the chain too, so two consecutive pictures can be mismatched. What lies behind
(or before) a wrong step is rigidly displaced: the edges from there to the rest are turned down
although they all ask for the same displacement. Such a set, and the step that separates it from the
edges that fit, is what this module looks for.
"""

from typing import NamedTuple

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.chain import Forest
from groundfuse.backend.clique import largest_clique
from groundfuse.backend.consistency import Flags, Links
from groundfuse.backend.problem import Array, Indices, Problem, components

SLACK = 4.0  # the rest of the team is not known exactly: limit of agreement times this
UNCLEAN = (
    0.2  # part of the displaced edges a step may leave unexplained, or of fitting ones it cuts
)
MAX_CUTS = 3  # different places of a cut that are proposed per map and side
MAX_EDGES = 250  # edges of one map that are compared all with all


class Cut(NamedTuple):
    """A step that may be wrong.

    Attributes:
        edge: the step.
        gain: edges turned down that ask for the same displacement behind it, less the accepted
            edges across it.
    """

    edge: int
    gain: int


def doubtful_steps(
    problem: Problem, maps: Forest, poses: Array, accepted: Flags, limit: float
) -> list[Cut]:
    """Return steps that may be wrong, a few per map, the most promising first.

    Args:
        problem: all edges.
        maps: chains of the maps, its `edge` numbering the edges of `problem`.
        poses: (n, 3) solution.
        accepted: (m,) edges in the solution.
        limit: chi2 above which edges disagree.
    """
    part = components(problem.of(accepted))
    fitting = accepted.copy()
    fitting[maps.edge[maps.edge >= 0]] = False
    fits = problem.of(fitting)
    outside = np.flatnonzero(~accepted & (part[problem.a] == part[problem.b]))
    touched = np.concatenate([maps.part[problem.a[outside]], maps.part[problem.b[outside]]])
    cuts = set[Cut]()
    for number in np.flatnonzero(np.bincount(touched, minlength=1) >= 2).tolist():
        for behind in (True, False):
            edges, ends = _ends(problem, maps, outside, number, behind=behind)
            if len(edges) <= MAX_EDGES:
                asked = _asked(problem, maps, poses, edges, ends)
                group = largest_clique(_agree(asked, maps, limit * SLACK))
                displaced = problem.of(edges[group])
                cuts |= _separating(problem, maps, fits, displaced, number, behind=behind)
    return sorted(cuts, key=lambda cut: (-cut.gain, cut.edge))


def _ends(
    problem: Problem, maps: Forest, edges: Indices, number: int, *, behind: bool
) -> tuple[Indices, Indices]:
    """Return the edges that touch a map and their poses in it (of a loop: the later or earlier)."""
    a, b = problem.a[edges], problem.b[edges]
    in_a, in_b = maps.part[a] == number, maps.part[b] == number
    chosen = np.where((maps.depth[a] > maps.depth[b]) == behind, a, b)
    end = np.where(in_a & in_b, chosen, np.where(in_a, a, b))
    touching = in_a | in_b
    return edges[touching], end[touching]


def _asked(problem: Problem, maps: Forest, poses: Array, edges: Indices, ends: Indices) -> Links:
    """Return where each edge puts the map in the team, the other end being where it is."""
    forward = problem.b[edges] == ends
    measured = problem.a_from_b[edges]
    step = np.where(forward[:, None], measured, planar.inverse(measured))
    covariance = planar.inverted(problem.information[edges])
    turned = planar.carried(planar.adjoint(measured), covariance)
    noise = np.where(forward[:, None, None], covariance, turned)
    other = np.where(forward, problem.a[edges], problem.b[edges])
    in_map = maps.poses[ends]
    team_from_map = planar.compose(planar.compose(poses[other], step), planar.inverse(in_map))
    return Links(other, ends, team_from_map, planar.carried(planar.adjoint(in_map), noise))


def _agree(asked: Links, maps: Forest, limit: float) -> Flags:
    row, column = np.triu_indices(len(asked.a), 1)
    one, two = asked.of(row), asked.of(column)
    error = planar.log(planar.compose(planar.inverse(one.f_from_g), two.f_from_g))
    noise = one.noise + two.noise + maps.between(one.b, two.b)
    close = planar.mahalanobis2(error, noise) <= limit
    agrees = np.eye(len(asked.a), dtype=bool)
    agrees[row[close], column[close]] = True
    return agrees | agrees.T


def _separating(
    problem: Problem,
    maps: Forest,
    fitting: Problem,
    displaced: Problem,
    number: int,
    *,
    behind: bool,
) -> set[Cut]:
    """Return the steps of a map that best separate displaced edges from fitting ones.

    A step counts for what lies behind it (or before it): overlaps that end there, and loops that
    lead across the step.
    """
    nodes = np.flatnonzero((maps.part == number) & (maps.edge >= 0))
    if not len(nodes):
        return set()
    wrong = _across(maps, nodes, displaced, number, behind=behind)
    right = _across(maps, nodes, fitting, number, behind=behind)
    gain = wrong - right
    clean = (right <= UNCLEAN * wrong) & (wrong >= (1.0 - UNCLEAN) * len(displaced))
    steps = maps.edge[nodes]
    firmness = np.linalg.slogdet(problem.information[steps])[1]
    order = np.lexsort((steps, firmness, -gain))
    # Steps with the same edges on either side are the same to all: keep the least certain.
    sides = np.stack([wrong, right], axis=1)[order]
    _, first = np.unique(sides, axis=0, return_index=True)
    best = order[np.sort(first)[:MAX_CUTS]]
    return {Cut(int(steps[k]), int(gain[k])) for k in best if gain[k] >= 2 and clean[k]}


def _across(maps: Forest, nodes: Indices, edges: Problem, number: int, *, behind: bool) -> Array:
    """Return, per node, the edges between what lies behind its step (or before) and the rest."""
    in_a, in_b = maps.part[edges.a] == number, maps.part[edges.b] == number
    loop = in_a & in_b
    ends = np.zeros((edges.num_poses, 2))  # of overlaps and loops
    np.add.at(ends[:, 0], edges.a[in_a & ~loop], 1.0)
    np.add.at(ends[:, 0], edges.b[in_b & ~loop], 1.0)
    np.add.at(ends[:, 1], edges.a[loop], 1.0)
    np.add.at(ends[:, 1], edges.b[loop], 1.0)
    np.add.at(ends[:, 1], maps.meeting(edges.a[loop], edges.b[loop]), -2.0)
    overlaps, loops = _summed_up(maps, nodes, ends).T
    crossing: Array = loops + (overlaps if behind else ends[:, 0].sum() - overlaps)
    return crossing


def _summed_up(maps: Forest, nodes: Indices, values: Array) -> Array:
    """Return, per node, the sum of the values (n, k) over everything behind it."""
    total = values.copy()
    parent = maps.ancestors[0]
    for node in nodes[np.argsort(-maps.depth[nodes], kind="stable")].tolist():
        total[parent[node]] += total[node]
    summed: Array = total[nodes]
    return summed
