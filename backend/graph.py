"""One robot's own graph: chained poses (steps only) and optimised poses (all of its edges)."""

from collections.abc import Sequence
from dataclasses import dataclass

from groundfuse.backend.measurement import FrameId, RelativePose, Se2, TeamEstimate
from groundfuse.backend.team import DEFAULTS, TeamOptions, fuse


@dataclass(frozen=True, slots=True, eq=False)
class RobotEstimate:
    """A robot alone, in its own map frames (the first frame of a fragment is the origin).

    Attributes:
        robot: name.
        fragment_of: connected piece of trajectory (steps only) that each frame belongs to.
        chained: pose of every frame in its fragment's frame, from steps alone.
        optimised: the robot's graph with all its edges; fragments may be joined by loops, see
            `optimised.component_of`.
    """

    robot: str
    fragment_of: dict[FrameId, int]
    chained: dict[FrameId, Se2]
    optimised: TeamEstimate


def robot_estimate(
    robot: str,
    frames: Sequence[FrameId],
    edges: Sequence[RelativePose],
    options: TeamOptions = DEFAULTS,
) -> RobotEstimate:
    """Estimate one robot's trajectory from its own edges; frames and edges of others are ignored.

    Raises:
        ValueError: as `fuse`, or the robot has no frame.
    """
    own = [f for f in frames if f.robot == robot]
    if not own:
        raise ValueError(f"robot {robot} has no frame")
    inner = [e for e in edges if e.a.robot == robot and e.b.robot == robot]
    optimised = fuse(own, inner, options)
    return RobotEstimate(robot, dict(optimised.map_of), dict(optimised.map_from_base), optimised)
