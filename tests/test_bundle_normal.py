"""The reduced system against the dense least-squares problem that it stands for."""

import numpy as np
import pytest

from groundfuse.backend.bundle_kernel import Errors, Kernel, errors_of, noise_factor
from groundfuse.backend.bundle_model import State, moved, residuals
from groundfuse.backend.bundle_priors import (
    SCALE_GAUGE_SIGMA,
    Between,
    Priors,
    between_residual,
    prior_cost,
    prior_residual,
)
from groundfuse.backend.bundle_solve import minimise, problem_of, step_from, system_at
from groundfuse.backend.bundle_tracks import Sightings, observations
from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.overhead import rays_from_floor

NUM_FRAMES, NUM_ROBOTS, NUM_POINTS = 5, 2, 40
SIGMA = 1e-3
STEP = 1e-6
# Central differences: truncation STEP^2 x third derivatives (1e3) over SIGMA = 1e-6 of a whitened
# row of size 1e3, and the system's condition is 1e4: relative 1e-5 of a step; worst seen 3e-6.
TOLERANCE = 5e-5


def problem(seed, *, lens=True, between=True, mount=True, relief=0.0):
    """A small problem away from its optimum: two robots, five frames that see most points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (NUM_POINTS, 2))
    pose = np.column_stack(
        [rng.uniform(-0.2, 0.2, (NUM_FRAMES, 2)), rng.uniform(-3, 3, NUM_FRAMES)]
    )
    attitude = np.column_stack(
        [rng.normal(0.1, 0.05, (NUM_FRAMES, 2)), rng.uniform(0.8, 1.0, NUM_FRAMES)]
    )
    frames, numbers, rays = [], [], []
    for frame in range(NUM_FRAMES):
        in_foot = Se2(*pose[frame]).inverse().apply(points)
        seen = rng.random(NUM_POINTS) < 0.7
        found = rays_from_floor(Attitude(*attitude[frame]), in_foot)[seen]
        rays.append(found + rng.normal(0, SIGMA, found.shape))
        frames.append(np.full(len(found), frame))
        numbers.append(np.flatnonzero(seen))
    frame, ray = np.concatenate(frames), np.concatenate(rays)
    sightings = Sightings(frame, ray, np.full(len(frame), SIGMA))
    seen = observations(sightings, np.arange(len(frame)), np.concatenate(numbers), NUM_FRAMES)
    priors = Priors(
        attitude + rng.normal(0, 0.01, attitude.shape),
        np.full((NUM_FRAMES, 3), 0.01),
        np.array([0.03, 0.02, 0.01, 0.003, 0.02, 1.0]),
        np.array([0, 0, 0, 1, 1]),
        np.arange(NUM_FRAMES) == 1,
        np.array([0, 0]),
        np.full((NUM_ROBOTS, 3), mount),
        np.array([[lens, False], [lens, lens]]),
        relief,
    )
    i, j = np.array([0, 4, 1])[: 3 * between], np.array([2, 3, 0])[: 3 * between]
    relative = [(Se2(*pose[b]).inverse() @ Se2(*pose[a])).inverse() for a, b in zip(i, j)]  # noqa: B905
    noisy = np.array([(r @ Se2(*rng.normal(0, 0.003, 3))).vector() for r in relative])
    root = rng.normal(size=(len(i), 3, 3)) * 20 + 200 * np.eye(3)
    edges = Between(i, j, noisy.reshape(-1, 3), root)
    state = State(
        pose + rng.normal(0, 1e-3, pose.shape) * ~priors.fixed[:, None],
        attitude + rng.normal(0, 1e-3, attitude.shape),
        rng.normal(0, 1e-3, (NUM_ROBOTS, 6)) * np.array([mount, mount, mount, 0, 0, 0])
        + np.pad(priors.free_lens * 2e-3, ((0, 0), (3, 1))),
        np.column_stack(
            [
                points + rng.normal(0, 1e-3, points.shape),
                rng.normal(0, relief / 2, NUM_POINTS),
            ]
        ),
    )
    return problem_of(seen, priors, edges), state


def stacked(task, state, weight):
    """All whitened residuals of the problem, one after another."""
    residual, _ = residuals(task.seen, state, task.priors.robot_of)
    whitened = residual * np.sqrt(weight)[:, None] / task.seen.sigma[:, None]
    return np.concatenate(
        [
            whitened.ravel(),
            prior_residual(state, task.priors).ravel(),
            between_residual(state, task.between).ravel(),
            (state.shared / task.priors.shared_sigma).ravel(),
            np.bincount(task.priors.group_of, state.shared[:, 2]) / SCALE_GAUGE_SIGMA,
            *relief_residual(task, state),
        ]
    )


def relief_residual(task, state):
    """Heights of the points over what the first camera's height allows them."""
    if task.priors.relief == 0.0:
        return []
    first = [int(np.flatnonzero(task.seen.point == p)[0]) for p in range(NUM_POINTS)]
    height = state.attitude[task.seen.frame[first], 2]
    return [state.point[:, 2] / (task.priors.relief * height)]


def dense_step(task, state, weight):
    """Gauss-Newton step of nodes and points from numeric derivatives."""
    free = np.ones((task.priors.num_nodes, 6), dtype=bool)
    free[:NUM_FRAMES][task.priors.fixed, :3] = False
    free[NUM_FRAMES:, 3:5] = task.priors.free_lens
    size = 3 if task.priors.relief > 0.0 else 2
    free[NUM_FRAMES:, 5] = False
    unknowns = int(free.sum())

    def at(vector):
        step = np.zeros(free.shape)
        step[free] = vector[:unknowns]
        return stacked(task, moved(state, step, vector[unknowns:].reshape(-1, size)), weight)

    total = unknowns + size * NUM_POINTS
    columns = [(at(u) - at(-u)) / (2 * STEP) for u in np.eye(total) * STEP]
    solution, *_ = np.linalg.lstsq(np.stack(columns, axis=1), -at(np.zeros(total)), rcond=None)
    step = np.zeros(free.shape)
    step[free] = solution[:unknowns]
    return step, solution[unknowns:].reshape(-1, size), columns, free


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "options",
    [{}, {"lens": False}, {"between": False}, {"mount": False}, {"relief": 0.01}],
    ids=lambda options: next(iter(options), "all"),
)
def test_a_step_is_the_dense_least_squares_step(seed, options):
    task, state = problem(seed, **options)
    errors = errors_of(task.seen, state, task.priors.robot_of)
    kernel = Kernel(3.0, 1.0, 1.0)
    system = system_at(task, state, errors, kernel, 0.0)
    after, step, _ = step_from(task, system, state, errors, kernel)
    expected, points, _, _ = dense_step(task, state, kernel.weight(errors))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(step, expected, atol=TOLERANCE * scale)
    np.testing.assert_allclose(
        (after.point - state.point)[:, : points.shape[1]],
        points,
        atol=TOLERANCE * np.abs(points).max(),
    )


@pytest.mark.parametrize("relief", [0.0, 0.01])
def test_the_reduced_system_is_the_schur_complement(relief):
    task, state = problem(5, relief=relief)
    errors = errors_of(task.seen, state, task.priors.robot_of)
    kernel = Kernel(3.0, 1.0, 1.0)
    reduced = system_at(task, state, errors, kernel, 0.0).reduced
    _, _, columns, free = dense_step(task, state, kernel.weight(errors))
    jacobian = np.stack(columns, axis=1)
    information = jacobian.T @ jacobian
    kept = int(free.sum())
    corner, cross = information[:kept, :kept], information[:kept, kept:]
    schur = corner - cross @ np.linalg.solve(information[kept:, kept:], cross.T)
    full = np.zeros((6 * task.priors.num_nodes,) * 2)
    rows, columns = task.pattern.rows, task.pattern.columns
    for row, column, block in zip(rows, columns, reduced.blocks, strict=True):
        full[6 * row : 6 * row + 6, 6 * column : 6 * column + 6] = block
        full[6 * column : 6 * column + 6, 6 * row : 6 * row + 6] = block.T
    got = full[np.ix_(free.ravel(), free.ravel())]
    spread = np.sqrt(np.diag(schur))
    np.testing.assert_allclose(
        got / np.outer(spread, spread), schur / np.outer(spread, spread), atol=TOLERANCE
    )


def test_the_prior_cost_is_the_sum_of_squares():
    task, state = problem(7)
    count = 2 * len(task.seen.frame)
    rest = stacked(task, state, np.ones(len(task.seen.frame)))[count:]
    np.testing.assert_allclose(
        prior_cost(state, task.priors, task.between), rest @ rest, rtol=1e-12
    )


def test_minimising_ends_where_the_gradient_vanishes():
    task, state = problem(8)
    solution = minimise(task, state, width=3.0, iterations=50, settled=1e-9)
    assert solution.settled
    kernel = Kernel(3.0, solution.noise, solution.noise)
    system = system_at(task, solution.state, solution.errors, kernel, 0.0)
    _, _, chi2 = step_from(task, system, solution.state, solution.errors, kernel)
    # Derivatives of an earlier state are kept while steps shrink; what that leaves is far below
    # one sigma of all unknowns together. Worst seen 1.2e-3.
    assert chi2 < 0.01


def test_a_start_far_away_ends_at_the_same_place():
    task, state = problem(9)
    near = minimise(task, state, width=3.0, iterations=60, settled=1e-9)
    rng = np.random.default_rng(1)
    nudge = rng.normal(0, 0.05, (task.priors.num_nodes, 6))
    nudge[NUM_FRAMES:] = 0.0
    nudge[:NUM_FRAMES][task.priors.fixed, :3] = 0.0
    away = moved(state, nudge, rng.normal(0, 0.1, (NUM_POINTS, 2)))
    far = minimise(task, away, width=3.0, iterations=60, settled=1e-9)
    # Kept derivatives leave a few hundredths of a sigma, which is 1 mm here; worst seen 3e-5.
    np.testing.assert_allclose(far.state.pose, near.state.pose, atol=1e-4)


def test_the_kernel_weighs_down_and_never_up():
    chi2 = np.array([0.0, 9.0, 81.0, 1e9])
    unseen = np.array([False, False, False, True])
    errors = Errors(np.zeros((4, 2)), unseen, chi2)
    np.testing.assert_allclose(Kernel(3.0, 1.0, 1.0).weight(errors), [1.0, 0.5, 0.1, 0.0])
    np.testing.assert_allclose(Kernel(3.0, 3.0, 3.0).weight(errors)[1], 0.9)
    # The cost's derivative by chi-square is the weight.
    more = Errors(np.zeros((4, 2)), unseen, chi2 + np.array([0.0, 1e-4, 0.0, 0.0]))
    slope = (Kernel(3.0, 1.0, 1.0).cost(more) - Kernel(3.0, 1.0, 1.0).cost(errors)) / 1e-4
    np.testing.assert_allclose(slope, 0.5, rtol=1e-3)


def test_the_noise_factor_is_one_for_promised_noise():
    # 400 points seen 2 to 5 times: the median's own spread is 3 %.
    rng = np.random.default_rng(4)
    times = rng.integers(2, 6, 400)
    point = np.repeat(np.arange(400), times)
    frame = np.concatenate([np.arange(count) for count in times])
    noise = rng.normal(0, 2e-3, (len(point), 2))
    mean = np.stack([np.bincount(point, axis) for axis in noise.T], axis=1) / times[:, None]
    sightings = Sightings(frame, noise, np.full(len(frame), 1e-3))
    seen = observations(sightings, np.arange(len(frame)), point, 5)
    order = np.lexsort((point, frame))
    left_over = (noise - mean[point])[order]
    chi2 = np.sum(left_over**2, axis=1) / 1e-6
    errors = Errors(left_over, np.zeros(len(frame), dtype=bool), chi2)
    assert 1.85 < noise_factor(seen, errors, np.full(400, 2.0)) < 2.15
