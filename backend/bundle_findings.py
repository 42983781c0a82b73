"""What the pictures tell of the cameras and what they do not, in one line each; numpy only."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_estimate import Estimated, Finding, FindingKind, MountEstimate
from groundfuse.backend.bundle_files import FileTest
from groundfuse.backend.bundle_priors import prior_residual
from groundfuse.backend.bundle_setup import Team
from groundfuse.backend.bundle_solve import Problem, Solution

Array = NDArray[np.float64]

FAR_OFF_SIGMA = 3.0
"""A file's number further off than so many sigmas is worth a line."""
WOBBLE_SHARE = 1.5
"""A wobble that exceeds its sigma by this factor is worth a line."""
LITTLE_WAY = 0.1
"""Views that lie closer together, in camera heights, tell little of how the camera looks."""
LITTLE_TURN_DEG = 10.0
"""Headings that spread less tell little of the focal length."""
NOISE_SHARE = 2.0
"""So is a noise of the correspondences off by this factor, either way."""


def findings_of(
    team: Team,
    problem: Problem,
    solution: Solution,
    mounts: tuple[MountEstimate, ...],
    test: FileTest,
) -> tuple[Finding, ...]:
    """List all statements but the one about scale."""
    return (
        *_apart(team, problem),
        *(
            finding
            for index, mount in enumerate(mounts)
            for finding in _mount(mount, _cause(problem, solution, index))
        ),
        *_relative_heights(team, problem, test),
        *_relief(team, problem, solution),
        *_wobble(team, problem, solution),
        *_noise(team, solution),
    )


def scale_finding(robots: tuple[str, ...], scale_sigma: float) -> Finding:
    """State what is known of the map's scale."""
    text = f"absolute scale comes from the camera heights alone: sigma {100 * scale_sigma:.2g} %"
    return Finding(FindingKind.SCALE, robots, scale_sigma, text)


def _apart(team: Team, problem: Problem) -> Iterator[Finding]:
    """Robots that never meet."""
    groups = problem.priors.group_of
    count = int(groups.max()) + 1
    if count > 1:
        parts = [
            "+".join(name for name, g in zip(team.robots, groups, strict=True) if g == group)
            for group in range(count)
        ]
        text = f"no overlap between {', '.join(parts)}: relative poses and heights are not told"
        yield Finding(FindingKind.APART, team.robots, float(count), text)


def _cause(problem: Problem, solution: Solution, robot: int) -> str:
    """Say what motion is missing that would tell a robot's calibration, if any."""
    mine = problem.priors.robot_of == robot
    pose, height = solution.state.pose[mine], solution.state.attitude[mine, 2]
    # The mean direction's length falls below 1 as headings spread.
    turned = abs(np.mean(np.exp(1j * pose[:, 2])))
    spread = math.degrees(math.sqrt(-2.0 * math.log(max(turned, 1e-9)))) if turned < 1.0 else 0.0
    way = float(np.hypot(*np.ptp(pose[:, :2], axis=0)) / height.mean())
    if way < LITTLE_WAY:
        return f"; its views lie within {way:.2g} heights of each other"
    if spread < LITTLE_TURN_DEG:
        return f"; its views head the same way within {spread:.2g} deg"
    return ""


def _mount(mount: MountEstimate, cause: str) -> Iterator[Finding]:
    """One robot's calibration numbers."""
    degree = 180.0 / math.pi
    rows: tuple[tuple[str, Estimated | None, float, str], ...] = (
        ("tilt", mount.tilt_rad, degree, "deg"),
        ("roll", mount.roll_rad, degree, "deg"),
        ("focal length", mount.focal, 100.0, "%"),
        ("first distortion term", mount.distortion, 1.0, ""),
    )
    for name, found, unit, sign in rows:
        if found is None:
            continue
        if found.value is None:
            share = found.sigma / found.prior_sigma
            text = (
                f"{mount.robot}: {name} is not observable here "
                f"(sigma {share:.0%} of the prior's{cause})"
            )
            yield Finding(FindingKind.UNOBSERVABLE, (mount.robot,), share, text)
        elif abs(found.value) > FAR_OFF_SIGMA * found.sigma:
            text = (
                f"{mount.robot}: {name} is off its file by {found.value * unit:+.3g} "
                f"+- {found.sigma * unit:.2g} {sign}".rstrip()
            )
            yield Finding(FindingKind.CALIBRATION, (mount.robot,), found.value, text)


def _relative_heights(team: Team, problem: Problem, test: FileTest) -> Iterator[Finding]:
    """Heights of robots against the first of their group."""
    groups, shared = problem.priors.group_of, test.covariance
    for group in range(int(groups.max()) + 1):
        members = np.flatnonzero(groups == group).tolist()
        first = 6 * members[0] + 2
        for index in members[1:]:
            place = 6 * index + 2
            value = float(test.value[index, 2] - test.value[members[0], 2])
            variance = shared[first, first] + shared[place, place] - 2.0 * shared[first, place]
            sigma = math.sqrt(max(variance, 0.0))
            if abs(value) > FAR_OFF_SIGMA * sigma:
                pair = (team.robots[members[0]], team.robots[index])
                text = (
                    f"{pair[1]}: height against {pair[0]}'s is off the files by "
                    f"{100 * value:+.3g} +- {100 * sigma:.2g} %"
                )
                yield Finding(FindingKind.CALIBRATION, pair, value, text)


def _relief(team: Team, problem: Problem, solution: Solution) -> Iterator[Finding]:
    """A floor that is not flat."""
    if problem.priors.relief > 0.0:
        spread_m = float(np.std(solution.state.point[:, 2]))
        text = f"the floor is not flat: its points' heights spread by {spread_m:.2g} m"
        yield Finding(FindingKind.RELIEF, team.robots, spread_m, text)


def _wobble(team: Team, problem: Problem, solution: Solution) -> Iterator[Finding]:
    """Frames that wander more than their sigmas say."""
    residual = prior_residual(solution.state, problem.priors)
    for index, robot in enumerate(team.robots):
        mine = residual[problem.priors.robot_of == index]
        spread = np.sqrt(np.mean(mine**2, axis=0))
        for name, value in zip(("tilt", "roll", "height"), spread.tolist(), strict=True):
            if value > WOBBLE_SHARE:
                text = f"{robot}: the {name} wobbles {value:.1f} times as much as its sigma"
                yield Finding(FindingKind.WOBBLE, (robot,), value, text)


def _noise(team: Team, solution: Solution) -> Iterator[Finding]:
    """Keypoints noisier or better than promised."""
    if not 1.0 / NOISE_SHARE < solution.noise < NOISE_SHARE:
        text = f"keypoint residuals are {solution.noise:.2g} times what their sigmas promise"
        yield Finding(FindingKind.NOISE, team.robots, solution.noise, text)
