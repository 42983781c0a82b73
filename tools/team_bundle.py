"""The bundle's stage of the main job: from robots and accepted pairs to the back-end and back.

A team that has grown goes on from the bundle that its store holds of most of the same pictures, as
long as cameras, files and options are what they were.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from groundfuse.backend.bundle import bundle
from groundfuse.backend.bundle_estimate import (
    BundleCamera,
    BundleEstimate,
    BundleOptions,
    BundleRefusal,
)
from groundfuse.backend.bundle_tracks import Matched
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, TeamEstimate
from groundfuse.tools.code_version import code_of
from groundfuse.tools.focal_gain import focal_gains
from groundfuse.tools.packing import key_of
from groundfuse.tools.robot import Robot
from groundfuse.tools.store import Store

KIND = "bundle"


@dataclass(frozen=True, slots=True, eq=False)
class KeptBundle:
    """A bundle as the store has it.

    Attributes:
        result: what was found.
        cameras: digest of each robot's camera, and of options and code.
        filed: attitudes of the frames, and their sigmas.
    """

    result: BundleEstimate | BundleRefusal
    cameras: dict[str, bytes]
    filed: dict[FrameId, tuple[Attitude, Attitude]]


def kept_bundle(
    robots: Sequence[Robot],
    team: TeamEstimate,
    edges: Callable[[], tuple[Sequence[RelativePose], Matched]],
    options: BundleOptions,
    store: Store,
    rests_on: Sequence[object],
    *,
    may_go_on: bool,
) -> BundleEstimate | BundleRefusal:
    """Return the planar bundle, from the store where all that it rests on is the same.

    Args:
        robots: as filed.
        team: of the Pose2 graph.
        edges: its accepted ones with their correspondences, frames numbered in their order; not
            asked for where the store has the bundle.
        options: see there.
        store: what is known.
        rests_on: all that this depends on, as parts of a key.
        may_go_on: from the latest bundle in the store.
    """
    code = code_of("groundfuse.tools.team_bundle", rooms=("backend", "tools"))
    cameras = {robot.name: key_of(code, options, robot.camera) for robot in robots}
    filed = {frame.id: (frame.attitude, frame.sigma) for r in robots for frame in r.frames}

    def work() -> KeptBundle:
        latest: KeptBundle | None = store.latest(KIND) if may_go_on else None
        earlier = None if latest is None else _earlier(latest, cameras, filed)
        return KeptBundle(_bundled(robots, team, *edges(), options, earlier), cameras, filed)

    found: KeptBundle = store.kept(KIND, "team", (code, *rests_on), work)
    return found.result


def _earlier(
    latest: KeptBundle,
    cameras: dict[str, bytes],
    filed: dict[FrameId, tuple[Attitude, Attitude]],
) -> BundleEstimate | None:
    """Return an earlier bundle to go on from, if it was made of the same files."""
    same_cameras = all(cameras.get(r, key) == key for r, key in latest.cameras.items())
    same_files = all(filed.get(frame, known) == known for frame, known in latest.filed.items())
    if same_cameras and same_files and isinstance(latest.result, BundleEstimate):
        return latest.result
    return None


def _bundled(
    robots: Sequence[Robot],
    team: TeamEstimate,
    edges: Sequence[RelativePose],
    seen: Matched,
    options: BundleOptions,
    earlier: BundleEstimate | None,
) -> BundleEstimate | BundleRefusal:
    frames = [frame for robot in robots for frame in robot.frames]
    cameras = {
        robot.name: BundleCamera(
            robot.camera.mount.base_from_foot,
            robot.camera.intrinsics.focal_px,
            focal_gains(robot.camera.intrinsics),
        )
        for robot in robots
    }
    prior = {frame.id: frame.attitude for frame in frames}
    sigma = {frame.id: frame.sigma for frame in frames}
    return bundle(team, edges, prior, sigma, cameras, options, earlier, seen)
