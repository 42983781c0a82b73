"""Is it the global optimum? A lower bound on chi2 from the dual of the chordal problem.

With translation and rotation weighted by one number each, the cost of a planar graph is quadratic
in the positions and the headings as complex numbers of length 1. Its Lagrangian dual is a
semidefinite program whose solution is known at a stationary point: the multipliers follow from
stationarity, and if the matrix of the quadratic form less the multipliers has no negative
eigenvalue, the point is a global minimum. That is checked by the signs of one sparse factorisation.
Carlone et al., "Planar pose graph optimization: duality, optimal solutions and verification", 2016.

Whatever the covariances are, every edge costs at least what an isotropic edge would whose
information its own dominates, so the proven minimum of that problem bounds ours from below. Where
all edges are isotropic the two are the same up to the bending of the residuals, and the certificate
is one of our own optimum. Elsewhere the bound is loose, and what is certified is a surrogate:
isotropic edges of the same mean information, with the distance of its optimum from our solution.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from groundfuse.backend import planar, sparse
from groundfuse.backend.initial import held_poses
from groundfuse.backend.problem import Array, Metric, Problem, chi2, components
from groundfuse.backend.solver import SolverOptions, minimise

Complex = NDArray[np.complex128]

TIGHT = SolverOptions(relative_decrease=1e-15)
ISOTROPIC = 1e-6  # relative differences of information below this are rounding in a text file
NOTHING = 1e-9  # chi2 is never below 0: exact data need no other proof
FINE = 1e-6  # part of the cost that rounding may take from the bound


class Status(StrEnum):
    """What is proven about a solution."""

    CERTIFIED = "certified"
    SURROGATE = "certified surrogate"
    NOT = "not certified"


@dataclass(frozen=True, slots=True)
class Certificate:
    """What is known about a solution.

    Attributes:
        status: CERTIFIED: no other solution has a chi2 lower by more than the tolerance.
            SURROGATE: the isotropic problem's optimum is proven, `distance_m` from ours. NOT: a
            better solution may exist.
        chi2: of the solution.
        lower_bound: no solution has a chi2 below this.
        surrogate_gap: cost of the surrogate's optimum over its proven bound, less 1.
        distance_m: largest distance of a pose from its place in the surrogate's optimum, after the
            best rigid alignment of every connected part.
    """

    status: Status
    chi2: float
    lower_bound: float
    surrogate_gap: float
    distance_m: float


class Bound(NamedTuple):
    """A stationary point of an isotropic problem, its cost, and the proven bound below it."""

    poses: Array
    cost: float
    lower: float


def certificate(problem: Problem, poses: Array, tolerance: float = 1e-3) -> Certificate:
    """Certify a solution (n, 3) of a problem.

    Args:
        problem: the edges that the solution is for.
        poses: a local minimum of it.
        tolerance: part of chi2 by which a certified solution may exceed the bound.
    """
    own = chi2(problem, poses)
    surrogate = bounded(_isotropic(problem), poses)
    below = surrogate if is_isotropic(problem) else bounded(_dominated(problem), poses)
    gap = surrogate.cost / surrogate.lower - 1.0 if surrogate.lower > 0.0 else np.inf
    gap = 0.0 if surrogate.cost <= NOTHING else gap
    status = Status.NOT
    if own - below.lower <= tolerance * own + NOTHING:
        status = Status.CERTIFIED
    elif gap <= tolerance and not is_isotropic(problem):
        status = Status.SURROGATE
    distance_m = _distance_m(problem, poses, surrogate.poses)
    return Certificate(status, own, max(0.0, below.lower), float(gap), distance_m)


def is_isotropic(problem: Problem) -> bool:
    """Return whether all edges weigh x and y alike and apart from theta."""
    information = problem.information
    scale = information[:, 0, 0] + information[:, 1, 1]
    uneven = np.abs(information[:, 0, 0] - information[:, 1, 1]) / scale
    coupled = np.abs(information[:, 0, 1]) / scale
    mixed = np.abs(information[:, :2, 2]).max(axis=1) / np.sqrt(scale * information[:, 2, 2])
    return bool(np.max([uneven, coupled, mixed], initial=0.0) <= ISOTROPIC)


def _isotropic(problem: Problem) -> Problem:
    """Return edges of the same heading information and the same mean position variance."""
    covariance = planar.inverted(problem.information)
    along = 2.0 / (covariance[:, 0, 0] + covariance[:, 1, 1])
    return _weighted(problem, along, 1.0 / covariance[:, 2, 2])


def _dominated(problem: Problem) -> Problem:
    """Return isotropic edges whose information every edge's own dominates."""
    covariance = planar.inverted(problem.information)
    information = problem.information
    mixed = np.abs(information[:, :2, 2]).max(axis=1) > 0.0
    turn = np.where(mixed, 0.7 / covariance[:, 2, 2], information[:, 2, 2])
    spare = np.where(mixed, information[:, 2, 2] - turn, 1.0)
    outer = information[:, :2, 2, None] * information[:, None, 2, :2]
    left = information[:, :2, :2] - outer / spare[:, None, None]
    smallest: Array = np.asarray(np.linalg.eigvalsh(left)[:, 0], dtype=np.float64)
    return _weighted(problem, smallest, turn)


def _weighted(problem: Problem, along: Array, turn: Array) -> Problem:
    information = np.zeros((len(problem), 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = along
    information[:, 2, 2] = turn
    return replace(problem, information=information, metric=Metric.CHORD)


def bounded(isotropic: Problem, start: Array) -> Bound:
    """Descend to a stationary point of an isotropic chordal problem and bound its optimum."""
    solution = minimise(isotropic, start, options=TIGHT)
    multipliers = _multipliers(isotropic, solution.poses)
    matrix = _less_multipliers(isotropic, multipliers)
    shift = _least_shift(matrix, FINE * solution.chi2 / isotropic.num_poses)
    lower = float(multipliers.sum()) - shift * isotropic.num_poses
    return Bound(solution.poses, solution.chi2, max(0.0, min(lower, solution.chi2)))


def _terms(isotropic: Problem) -> tuple[Array, Array, Complex, Complex]:
    """Return weights of positions and headings, and measured positions and headings as numbers."""
    measured = isotropic.a_from_b
    place = measured[:, 0] + 1j * measured[:, 1]
    turn = np.exp(1j * measured[:, 2])
    return isotropic.information[:, 0, 0], isotropic.information[:, 2, 2], place, turn


def _multipliers(isotropic: Problem, poses: Array) -> Array:
    """Return (n,) the multipliers that make the poses stationary; their sum is the cost there."""
    along, around, place, turn = _terms(isotropic)
    a, b = isotropic.a, isotropic.b
    position, heading = poses[:, 0] + 1j * poses[:, 1], np.exp(1j * poses[:, 2])
    step = along * (position[b] - position[a] - heading[a] * place)
    twist = around * (heading[b] - heading[a] * turn)
    gradient = np.zeros(isotropic.num_poses, dtype=complex)
    np.add.at(gradient, b, twist)
    np.add.at(gradient, a, -step * place.conj() - twist * turn.conj())
    multipliers: Array = np.real(heading.conj() * gradient)
    return multipliers


def _less_multipliers(isotropic: Problem, multipliers: Array) -> csc_array:
    """Return the quadratic form less the multipliers, (position, heading) by pose.

    One position of every connected part is pinned: its place costs nothing.
    """
    along, around, place, turn = _terms(isotropic)
    empty = np.zeros((len(isotropic), 2, 2), dtype=complex)
    aa, ab, bb = empty, empty.copy(), empty.copy()
    aa[:, 0, 0] = bb[:, 0, 0] = along
    aa[:, 0, 1] = along * place
    aa[:, 1, 0] = aa[:, 0, 1].conj()
    aa[:, 1, 1] = along * np.abs(place) ** 2 + around
    bb[:, 1, 1] = around
    ab[:, 0, 0] = -along
    ab[:, 1, 0] = -along * place.conj()
    ab[:, 1, 1] = -around * turn.conj()
    own = np.zeros((isotropic.num_poses, 2, 2), dtype=complex)
    own[:, 1, 1] = -multipliers
    own[held_poses(isotropic), 0, 0] = along.mean()
    nobody = np.empty(0, dtype=np.int64)
    layout = sparse.pattern(isotropic.num_poses, isotropic.a, isotropic.b, nobody)
    return sparse.assembled(sparse.filling(layout, 2, own=True), aa, ab, bb, own)


def _least_shift(matrix: csc_array, fine: float) -> float:
    """Return how much must be added to the headings' diagonal to leave no negative eigenvalue.

    Tried from `fine` upwards in steps of a hundred; infinite where a large shift is not enough.
    """
    headings = np.tile([0.0, 1.0], matrix.indptr.size // 2)

    def enough(shift: float) -> bool:
        raised = csc_array(matrix + sparse.diagonal(shift * headings))
        try:
            pivots: Complex = np.asarray(sparse.factorised(raised).U.diagonal())
        except RuntimeError:  # a pivot of exactly 0, as exact data have it
            return False
        return bool(np.all(np.real(pivots) > 0.0))

    for power in range(4):
        if enough(fine * 100.0**power):
            return fine * 100.0**power
    return np.inf


def _distance_m(problem: Problem, one: Array, two: Array) -> float:
    """Return the largest distance between two solutions, every connected part aligned."""
    part = components(problem)
    farthest = 0.0
    for number in range(int(part.max(initial=-1)) + 1):
        p, q = ((poses[:, 0] + 1j * poses[:, 1])[part == number] for poses in (one, two))
        p, q = p - p.mean(), q - q.mean()
        inner = np.vdot(p, q)
        turn = inner / abs(inner) if abs(inner) > 0.0 else 1.0
        farthest = max(farthest, float(np.abs(p * turn - q).max()))
    return farthest
