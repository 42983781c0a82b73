"""Fusing frames whose numbers have gaps, and giving every frame its own name back.

A step of a trajectory is known by neighbouring numbers. Graph files number as they like (every
tenth key frame), so the frames of a robot are counted 0, 1, 2, ... in order before they are fused.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby, pairwise

from groundfuse.backend.measurement import FrameId, RelativePose, TeamEstimate
from groundfuse.backend.team import DEFAULTS, TeamOptions, fuse


def fuse_counted(
    frames: Sequence[FrameId], edges: Sequence[RelativePose], options: TeamOptions = DEFAULTS
) -> TeamEstimate:
    """Fuse frames in order of their numbers, whatever the gaps (ValueError as `fuse`)."""
    order = sorted(frames)
    if all(b.index - a.index == 1 for a, b in pairwise(order) if a.robot == b.robot):
        return fuse(order, edges, options)
    counted: dict[FrameId, FrameId] = {}
    for robot, own in groupby(order, key=lambda frame: frame.robot):
        counted |= {frame: FrameId(robot, k) for k, frame in enumerate(own)}
    name = {new: old for old, new in counted.items()}
    dense = [replace(e, a=counted[e.a], b=counted[e.b]) for e in edges]
    return renamed(fuse(list(name), dense, options), name.__getitem__)


def renamed(estimate: TeamEstimate, name: Callable[[FrameId], FrameId]) -> TeamEstimate:
    """Return the estimate with other names for its frames."""
    return replace(
        estimate,
        team_from_base={name(f): pose for f, pose in estimate.team_from_base.items()},
        component_of={name(f): part for f, part in estimate.component_of.items()},
        covariance={name(f): matrix for f, matrix in estimate.covariance.items()},
        anchors=tuple(replace(a, first=name(a.first)) for a in estimate.anchors),
        verdicts=tuple(replace(v, a=name(v.a), b=name(v.b)) for v in estimate.verdicts),
        ambiguities=tuple(
            replace(one, answers=tuple(replace(w, a=name(w.a), b=name(w.b)) for w in one.answers))
            for one in estimate.ambiguities
        ),
        map_of={name(f): number for f, number in estimate.map_of.items()},
        map_from_base={name(f): pose for f, pose in estimate.map_from_base.items()},
    )
