"""Which measured overlaps agree: pairwise tests along the chains, and the largest agreeing sets.

Two overlaps e1, e2 between maps F and G close a cycle through both chains. In G's tangent its error
is log(h1^-1 h2), h = map_F from map_G as the edge alone says, and its covariance is the sum of both
edges' and both chains' (pairwise consistency maximisation, Mangelson et al. 2018, with exact
covariances along the chains).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend import planar
from groundfuse.backend.chain import Forest
from groundfuse.backend.consistency_compiled import agreeing
from groundfuse.backend.problem import Array, Indices, Problem

Flags = NDArray[np.bool_]


class Links(NamedTuple):
    """Edges between two maps, or within one, as statements about the maps.

    Attributes:
        a: (m,) pose in map F.
        b: (m,) pose in map G.
        f_from_g: (m, 3) F's map frame from G's, as each edge alone says.
        noise: (m, 3, 3) covariance of the edge in G's tangent.
    """

    a: Indices
    b: Indices
    f_from_g: Array
    noise: Array

    def of(self, chosen: Flags | Indices) -> "Links":
        """Return only the chosen edges."""
        return Links(self.a[chosen], self.b[chosen], self.f_from_g[chosen], self.noise[chosen])


def links(problem: Problem, forest: Forest) -> Links:
    """Return what every edge says about the two maps that it joins."""
    poses_a, poses_b = forest.poses[problem.a], forest.poses[problem.b]
    f_from_b = planar.compose(poses_a, problem.a_from_b)
    f_from_g = planar.compose(f_from_b, planar.inverse(poses_b))
    noise = planar.carried(planar.adjoint(poses_b), planar.inverted(problem.information))
    return Links(problem.a, problem.b, f_from_g, noise)


def against_chain(one: Links, forest: Forest) -> Array:
    """Return (m,) chi2 of edges within one map against that map's chain."""
    noise = one.noise + forest.between(one.a, one.b)
    return planar.mahalanobis2(planar.log(one.f_from_g), noise)


def chi2_between(one: Links, two: Links, forest: Forest) -> Array:
    """Return (m,) chi2 of the cycle that each edge of `one` closes with the same row of `two`."""
    g_from_f = planar.inverse(one.f_from_g)
    error = planar.log(planar.compose(g_from_f, two.f_from_g))
    return planar.mahalanobis2(error, noise_between(one, two, forest))


def noise_between(one: Links, two: Links, forest: Forest) -> Array:
    """Return (m, 3, 3) covariance of those cycles, in the second map's tangent."""
    g_from_f = planar.inverse(one.f_from_g)
    chain_f = planar.carried(planar.adjoint(g_from_f), forest.between(one.a, two.a))
    noise: Array = one.noise + two.noise + forest.between(one.b, two.b) + chain_f
    return noise


def agreement(edges: Links, forest: Forest, limit: float) -> Flags:
    """Return (m, m) whether edges agree pairwise: chi2 of their cycle at most `limit`."""
    agrees = np.empty((len(edges.a), len(edges.a)), dtype=bool)
    agreeing(edges, (forest.depth, forest.ancestors, forest.spatial), limit, agrees)
    return agrees
