"""Normal equations of a linearised pose graph, and their solution: direct, or by a known factor."""

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU

from groundfuse.backend import sparse
from groundfuse.backend.problem import Array, Linear

MAX_ROUNDS = 12  # of conjugate gradients: more cost as much as a factorisation
LEAST_RATE = 4.0  # by which the squared error must shrink per round, or the factor is too old


def of_linear(
    linear: Linear, information: Array, layout: sparse.Pattern, fill: sparse.Filling | None = None
) -> tuple[csc_array, Array]:
    """Return the information matrix of the free poses and the gradient (size, 3) of chi2 / 2.

    Args:
        linear: residuals and derivatives of all edges.
        information: (m, 3, 3) of the edges.
        layout: where their blocks go.
        fill: that of 3 x 3 blocks in the layout.
    """
    left_a = np.swapaxes(linear.by_a, 1, 2) @ information
    left_b = np.swapaxes(linear.by_b, 1, 2) @ information
    matrix = sparse.assembled(
        fill or sparse.filling(layout, 3),
        left_a @ linear.by_a,
        left_a @ linear.by_b,
        left_b @ linear.by_b,
    )
    residual = linear.residual[:, :, None]
    gradient = sparse.gathered(layout, (left_a @ residual)[:, :, 0], (left_b @ residual)[:, :, 0])
    return matrix, gradient


def by_known_factor(matrix: csc_array, right: Array, known: SuperLU, fine: float) -> Array | None:
    """Solve matrix x = right (n,) by conjugate gradients with the factor of a similar matrix.

    Every round lowers x' matrix x / 2 - x' right, that is half of chi2; the rounds end where one
    gains less than `fine` of chi2. None where they don't come there soon: factorise anew.
    """
    found, error = np.zeros_like(right), right.copy()
    towards = known.solve(error)
    along = towards.copy()
    square = first = float(error @ towards)
    if not square > 0.0:  # exact data: nothing is left to do
        return found
    for k in range(1, MAX_ROUNDS + 1):
        image = matrix @ along
        length = square / float(along @ image)
        found += length * along
        if length * square <= fine:
            return found
        error -= length * image
        towards = known.solve(error)
        before, square = square, float(error @ towards)
        if k > 1 and not square <= first * LEAST_RATE**-k:
            return None
        along = towards + square / before * along
    return None
