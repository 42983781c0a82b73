"""Trajectories as trees: chained poses and the covariance of any two frames along the chain.

A tree of edges spans every connected part. Covariances are summed in the root's (spatial) tangent,
where those of independent edges simply add, so the covariance between two frames is the sum over
the path between them, and none of it needs a matrix larger than 3x3. All steps are doubled
(ancestor of an ancestor), never walked: chains of 100,000 poses are as safe as short ones.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from groundfuse.backend import planar
from groundfuse.backend.problem import Array, Indices, Problem, components


@dataclass(frozen=True, slots=True, eq=False)
class Forest:
    """Rooted spanning trees, one per connected part; the root is the part's first pose.

    Attributes:
        part: (n,) number of the connected part, by first appearance.
        edge: (n,) the edge towards the root, -1 at a root.
        depth: (n,) edges to the root.
        ancestors: (levels, n) the 2^k-th ancestor, the root standing for what lies above it.
        poses: (n, 3) root_from_node, chained.
        spatial: (n, 3, 3) covariance of the chain from the root, in the root's tangent.
    """

    part: Indices
    edge: Indices
    depth: Indices
    ancestors: Indices
    poses: Array
    spatial: Array

    def between(self, i: Indices, j: Indices) -> Array:
        """Return (m, 3, 3) covariance of the chain from i to j, in the root's tangent."""
        return self.spatial[i] + self.spatial[j] - 2.0 * self.spatial[self.meeting(i, j)]

    def meeting(self, i: Indices, j: Indices) -> Indices:
        """Return (m,) the deepest common ancestor of pairs in the same part."""
        swap = self.depth[i] < self.depth[j]
        low, high = np.where(swap, j, i), np.where(swap, i, j)
        for level in self.ancestors[::-1]:
            low = np.where(self.depth[level[low]] >= self.depth[high], level[low], low)
        for level in self.ancestors[::-1]:
            apart = level[low] != level[high]
            low, high = np.where(apart, level[low], low), np.where(apart, level[high], high)
        met: Indices = np.where(low == high, low, self.ancestors[0][low])
        return met


def spanning_forest(problem: Problem, length: Array) -> Forest:
    """Return the spanning trees of least total length (m,) > 0; ties go to the earlier edge."""
    part = components(problem)
    parent, edge = _rooted(problem, length, part)
    ancestors = [parent]
    while True:
        further = ancestors[-1][ancestors[-1]]
        if np.array_equal(further, ancestors[-1]):
            break
        ancestors.append(further)
    step, noise = _steps(problem, parent, edge)
    poses, depth = step, (edge >= 0).astype(np.int64)
    for level in ancestors:
        poses, depth = planar.compose(poses[level], poses), depth + depth[level]
    spatial = planar.carried(planar.adjoint(poses), noise)
    for level in ancestors:
        spatial = spatial + spatial[level]  # a root adds nothing
    return Forest(part, edge, depth, np.array(ancestors), poses, spatial)


def _rooted(problem: Problem, length: Array, part: Indices) -> tuple[Indices, Indices]:
    """Return the parent of every pose (a root is its own) and the edge to it (-1)."""
    n = problem.num_poses
    low, high = np.minimum(problem.a, problem.b), np.maximum(problem.a, problem.b)
    order = np.lexsort((np.arange(len(problem)), length, high, low))
    _, first = np.unique(low[order] * n + high[order], return_index=True)
    edge = order[first]  # the shortest edge of every linked pair
    rank = np.empty(len(edge))
    rank[np.lexsort((edge, length[edge]))] = np.arange(1, len(edge) + 1)  # distinct: no ties
    tree = minimum_spanning_tree(coo_array((rank, (low[edge], high[edge])), shape=(n, n)).tocsr())
    _, roots = np.unique(part, return_index=True)
    rows, columns = tree.nonzero()
    above = np.full(len(roots), n)  # one node over all roots: a single walk reaches every part
    links = coo_array(
        (
            np.ones(len(rows) + len(roots)),
            (np.concatenate([rows, above]), np.concatenate([columns, roots])),
        ),
        shape=(n + 1, n + 1),
    )
    _, parent = breadth_first_order(links.tocsr(), n, directed=False)
    parent = parent[:n].astype(np.int64)
    parent[roots] = roots
    key = low[edge] * n + high[edge]
    node = np.arange(n)
    wanted = np.minimum(node, parent) * n + np.maximum(node, parent)
    place = np.searchsorted(key, wanted)
    towards = np.full(n, -1, dtype=np.int64)
    towards[parent != node] = edge[place[parent != node]]
    return parent, towards


def _steps(problem: Problem, parent: Indices, edge: Indices) -> tuple[Array, Array]:
    """Return parent_from_node (n, 3) and its covariance in the node's tangent (n, 3, 3)."""
    step, noise = np.zeros((len(edge), 3)), np.zeros((len(edge), 3, 3))
    inner = edge >= 0
    used = edge[inner]
    measured = problem.a_from_b[used]
    covariance = planar.inverted(problem.information[used])
    forward = problem.a[used] == parent[inner]
    step[inner] = np.where(forward[:, None], measured, planar.inverse(measured))
    turned = planar.carried(planar.adjoint(measured), covariance)
    noise[inner] = np.where(forward[:, None, None], covariance, turned)
    return step, noise
