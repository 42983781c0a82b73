"""Agreement along chains and around cycles of maps: calibrated for right edges, not for wrong."""

import numpy as np
import pytest
from graph_world import team

from groundfuse.backend import planar, skeleton
from groundfuse.backend import team as fusing
from groundfuse.backend.consistency import against_chain, agreement, chi2_between, links
from groundfuse.backend.cycles import cycle_chi2
from groundfuse.backend.numbering import team_of

# Chi2 of 3 degrees of freedom: mean 3, variance 6; some 100 independent values: 3 +- 4 sqrt(.06).
MEAN = (2.0, 4.0)


def parts(seed, **shape):
    """The meeting poses of a simulated team, the edges as links, and its chains."""
    world = team(seed, **shape)
    numbered = team_of(world.frames, world.edges, 1)
    found = fusing._joined(numbered, numbered.is_step, fusing.DEFAULTS, guess=True)
    chains = skeleton.joined(found.team, np.empty(0, dtype=np.int64))
    inner = found.maps.part[numbered.problem.a] == found.maps.part[numbered.problem.b]
    return world, found, chains, np.array(world.wrong)[~inner]


def test_right_loops_have_the_chi2_of_three_degrees_of_freedom():
    values = []
    for seed in range(25):
        world = team(seed, robots=1, frames=40, loops=12)
        numbered = team_of(world.frames, world.edges, 1)
        found = fusing._joined(numbered, numbered.is_step, fusing.DEFAULTS, guess=True)
        loops = numbered.problem.of(~numbered.is_step)
        values += against_chain(links(loops, found.maps), found.maps).tolist()
    assert MEAN[0] < np.mean(values) < MEAN[1]


def test_right_overlaps_agree_pairwise_with_chi2_of_three_degrees_of_freedom():
    values = []
    for seed in range(25):
        _, found, chains, _ = parts(seed, frames=30, overlaps=6, loops=0)
        edges = links(found.team.joins, chains)
        row, column = np.triu_indices(len(edges.a), 1)
        values += chi2_between(edges.of(row), edges.of(column), chains).tolist()
    assert MEAN[0] < np.mean(values) < MEAN[1]


@pytest.mark.parametrize("forward", [(True, True, False), (False, True, True)])
def test_right_cycles_close_with_chi2_of_three_degrees_of_freedom(forward):
    # Walking A-B-C-A takes the hops AB and BC ahead and AC back; the other way round likewise.
    values = []
    for seed in range(25):
        _, found, chains, _ = parts(seed, robots=3, frames=20, overlaps=3, loops=0)
        edges = links(found.team.joins, chains)
        maps = found.team.maps
        ab, bc, ac = (
            np.flatnonzero((maps == pair).all(axis=1)) for pair in ([0, 1], [1, 2], [0, 2])
        )
        if forward[0]:
            hops, ahead = np.stack([ab, bc, ac], axis=1), [True, True, False]
        else:
            hops, ahead = np.stack([ac, bc, ab], axis=1), [True, False, False]
        turns = np.tile(ahead, (len(hops), 1))
        values += cycle_chi2(edges, chains, hops, turns).tolist()
    assert MEAN[0] < np.mean(values) < MEAN[1]


def test_wrong_overlaps_agree_with_nothing():
    _, found, chains, wrong = parts(2, frames=40, overlaps=20, wrong_overlaps=0.5)
    agrees = agreement(links(found.team.joins, chains), chains, 16.27)
    assert agrees[np.ix_(~wrong, ~wrong)].mean() > 0.98
    assert agrees[np.ix_(wrong, ~wrong)].mean() < 0.02


@pytest.mark.parametrize("joined", [False, True])
def test_all_pairs_at_once_are_judged_as_pairs_are(joined):
    """The compiled loop against numpy, on paths and on trees that branch, at every limit."""
    _, found, chains, _ = parts(5, robots=3, frames=30, overlaps=8, wrong_overlaps=0.3, loops=0)
    if joined:
        chains = skeleton.joined(found.team, found.verdict.best.tree)
        assert (np.bincount(chains.ancestors[0]) > 2).any()
    edges = links(found.team.joins, chains)
    row, column = np.triu_indices(len(edges.a), 1)
    one, other = chains.part[edges.a[row]], chains.part[edges.b[row]]
    alike = (one == chains.part[edges.a[column]]) & (other == chains.part[edges.b[column]])
    row, column = row[alike], column[alike]  # ends of other maps have no chain between them
    chi2 = chi2_between(edges.of(row), edges.of(column), chains)
    assert len(chi2) > 50
    # Two ways to solve 3x3 of condition 1e4 in doubles: 1e-12. 1e-13 would do, 1e-14 would not.
    for value in chi2:
        above = agreement(edges, chains, value * (1.0 + 1e-11))
        below = agreement(edges, chains, value * (1.0 - 1e-11))
        assert np.array_equal(above, above.T)
        assert above.diagonal().all()
        assert np.array_equal(above[row, column], chi2 <= value * (1.0 + 1e-11))
        assert np.array_equal(below[row, column], chi2 <= value * (1.0 - 1e-11))


def test_links_do_not_depend_on_how_a_map_is_turned():
    """The chi2 of a cycle is a number; only its coordinates depend on the map's frame."""
    _, found, chains, _ = parts(4, frames=20, overlaps=5, loops=0)
    plain = links(found.team.joins, chains)
    shift = planar.exp(np.array([3.0, -20.0, 2.0]))
    by = planar.adjoint(shift)
    turned = type(chains)(
        chains.part,
        chains.edge,
        chains.depth,
        chains.ancestors,
        planar.compose(np.broadcast_to(shift, chains.poses.shape), chains.poses),
        planar.carried(by, chains.spatial),
    )
    other = links(found.team.joins, turned)
    row, column = np.triu_indices(len(plain.a), 1)
    one = chi2_between(plain.of(row), plain.of(column), chains)
    two = chi2_between(other.of(row), other.of(column), turned)
    assert np.allclose(one, two, rtol=1e-6)
