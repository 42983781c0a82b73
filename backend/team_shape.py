"""Who holds a team together: bridges between robots, robots of one frame."""

from collections import Counter
from collections.abc import Iterable, Sequence

from groundfuse.backend.measurement import FrameId, TeamEstimate


def bridges(estimate: TeamEstimate) -> tuple[str, ...]:
    """Return the robots without which others of their component would no longer be connected.

    Only accepted edges between robots count, and a robot's own pieces count as one.
    """
    pairs = {
        (v.a.robot, v.b.robot) for v in estimate.verdicts if v.accepted and v.a.robot != v.b.robot
    }
    robots = sorted({robot for pair in pairs for robot in pair})
    before = _parts(robots, pairs)
    found = []
    for robot in robots:
        rest = [other for other in robots if other != robot]
        if _parts(rest, (p for p in pairs if robot not in p)) > before:
            found.append(robot)
    return tuple(found)


def _parts(robots: Sequence[str], pairs: Iterable[tuple[str, str]]) -> int:
    """Return the number of connected parts."""
    root = {robot: robot for robot in robots}

    def top(robot: str) -> str:
        while root[robot] != robot:
            robot = root[robot]
        return robot

    for one, two in pairs:
        root[top(one)] = top(two)
    return sum(root[robot] == robot for robot in robots)


def frames_by_robot(frames: Iterable[FrameId]) -> dict[str, int]:
    """Return how many frames every robot has, by name."""
    return dict(sorted(Counter(frame.robot for frame in frames).items()))
