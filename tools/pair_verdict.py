"""What two frames have to do with each other: a motion with its covariance, or why there is none.

A pair's verdict depends on what was seen of the two, on priors and on options, and on nothing else:
neither on the frames' numbers nor on when or where it was computed.
"""

import functools
import hashlib
import math
from dataclasses import dataclass, replace

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Reason, Rejected, RelativePose, Se2
from groundfuse.frontend import paper_matcher, sift_matcher
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.consensus import Gate
from groundfuse.frontend.features import Features
from groundfuse.frontend.fit import Prior
from groundfuse.frontend.motion import MotionOptions, View, relative_pose
from groundfuse.tools.code_version import code_of
from groundfuse.tools.frame_look import Looked, looked
from groundfuse.tools.front_end_options import FrontEndOptions, Matcher
from groundfuse.tools.packing import key_of, packed
from groundfuse.tools.robot import Frame, Robot

Verdict = RelativePose | Rejected


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """A frame, its robot, and the key of what was seen there."""

    frame: Frame
    robot: Robot
    key: bytes


@dataclass(frozen=True, slots=True, eq=False)
class PairJob:
    """A pair to compare: what is known of it beforehand.

    Attributes:
        a: the one frame, without its picture.
        b: the other.
        gate: where odometry allows b to be, foot to foot.
        swayed: the same, as wide as matching needs it.
        looks: keys of what was seen of a and of b.
        key: digest of all that the verdict depends on.
    """

    a: View
    b: View
    gate: Gate | None
    swayed: Gate | None
    looks: tuple[bytes, bytes]
    key: bytes


def look(image: Image, robot: Robot, frame: Frame, options: FrontEndOptions) -> tuple[Spot, Looked]:
    """Return everything that matching needs to know of one picture, without a key."""
    return Spot(frame, robot, b""), looked(image, robot.camera, frame, options)


def compare(a: tuple[Spot, Looked], b: tuple[Spot, Looked], options: FrontEndOptions) -> Verdict:
    """Match two frames and fit the motion between them."""
    (spot_a, seen_a), (spot_b, seen_b) = a, b
    return verdict(pair_job(spot_a, spot_b, options), seen_a, seen_b, options)


def pair_job(a: Spot, b: Spot, options: FrontEndOptions) -> PairJob:
    """Return what is to be done with a pair of frames."""
    gate = odometry_gate(a, b, options)
    widened = None if gate is None else swayed(gate, a, b, options)
    views, looks = (_view(a), _view(b)), (a.key, b.key)
    known = [_key_of_view(v.prior.mean, v.prior.sigma, v.base_from_foot) for v in views]
    match = options.paper if options.matcher is Matcher.PAPER else options.match
    how = _key_of_method(match, options.motion)
    rests_on = b"".join((how, *looks, *known))  # digests of one length each
    return PairJob(*views, gate, widened, looks, key_of("pair", rests_on, gate, widened))


@functools.lru_cache(maxsize=4)
def _key_of_method(
    match: sift_matcher.MatchOptions | paper_matcher.PaperOptions, motion: MotionOptions
) -> bytes:
    """Return what stands for code and options: the same for all pairs of a run."""
    return key_of("how", code_of("groundfuse.tools.pair_verdict"), match, motion)


@functools.lru_cache(maxsize=4096)
def _key_of_view(mean: Attitude, sigma: Attitude, base_from_foot: Se2) -> bytes:
    """Return what stands for a camera's place: the same for many pairs, often for many frames."""
    return key_of("view", mean, sigma, base_from_foot)


def verdict(job: PairJob, a: Looked, b: Looked, options: FrontEndOptions) -> Verdict:
    """Match two frames and fit the motion between them."""
    rng = np.random.default_rng(_seed(a.features, b.features))
    if a.paper is not None and b.paper is not None:
        found = paper_matcher.match(a.paper, b.paper, options.paper, rng)
    else:
        found = sift_matcher.match(a.features, b.features, options.match, rng, job.swayed)
    views = replace(job.a, grey=a.grey), replace(job.b, grey=b.grey)
    result = relative_pose(*views, found, options.motion)
    if isinstance(result, RelativePose) and job.gate is not None:
        moved = _foot_motion(job.a.base_from_foot, job.b.base_from_foot, result.a_from_b)
        off_m, off_rad = _off(moved, job.gate)
        if off_m > 2.0 * job.gate.radius_m or off_rad > 2.0 * job.gate.turn_rad:
            return Rejected(job.a.id, job.b.id, Reason.PRIOR, off_m, 2.0 * job.gate.radius_m)
    return result


def pair_done(job: PairJob, a: Looked, b: Looked, options: FrontEndOptions) -> bytes:
    """Compare two frames and return the verdict, packed."""
    return packed(verdict(job, a, b, options))


def named(found: Verdict, a: FrameId, b: FrameId) -> Verdict:
    """Return a verdict under the names that its frames have today."""
    return found if (found.a, found.b) == (a, b) else replace(found, a=a, b=b)


def _view(spot: Spot) -> View:
    prior = Prior(spot.frame.attitude, spot.frame.sigma)
    return View(spot.frame.id, prior, spot.robot.camera.mount.base_from_foot)


def _seed(a: Features, b: Features) -> list[int]:
    """Seed that belongs to what is compared, so that no order, name or number matters."""
    both = (hashlib.blake2b(f.rays.tobytes(), digest_size=16).digest() for f in (a, b))
    return [int.from_bytes(digest, "little") for digest in both]


def odometry_gate(a: Spot, b: Spot, options: FrontEndOptions) -> Gate | None:
    """Return where odometry allows frame b to be, seen from frame a of the same robot."""
    first, last = a.frame.odometry, b.frame.odometry
    if a.robot.name != b.robot.name or first is None or last is None:
        return None
    low, high = sorted((a.frame.id.index, b.frame.id.index))
    steps = [frame.odometry for frame in a.robot.frames[low + 1 : high + 1]]
    mount_a, mount_b = (spot.robot.camera.mount.base_from_foot for spot in (a, b))
    foot, turn2, place2 = last.map_from_base @ mount_b, 0.0, 0.0
    for step in steps:
        if step is None:
            return None
        at, sigma = step.map_from_base, step.sigma
        # An error of a step's turn swings all that follows about the step's end.
        lever_m = math.hypot(foot.x_m - at.x_m, foot.y_m - at.y_m)
        turn2 += sigma.theta_rad**2
        place2 += sigma.x_m**2 + sigma.y_m**2 + (sigma.theta_rad * lever_m) ** 2
    motion = first.map_from_base.inverse() @ last.map_from_base
    turn_rad, radius_m = math.sqrt(turn2), math.sqrt(place2)
    gate = options.odometry_gate_sigmas
    return Gate(_foot_motion(mount_a, mount_b, motion), gate * radius_m, gate * turn_rad)


def swayed(gate: Gate, a: Spot, b: Spot, options: FrontEndOptions) -> Gate:
    """Widen a gate by how far the wobble moves the floor in the middle of the views.

    Matching takes the cameras at their expected attitudes; only the fit knows better.
    """
    sway2 = 0.0
    for spot in (a, b):
        sway2 += _sway2(spot.frame.attitude, spot.frame.sigma)
    sway_m = options.odometry_gate_sigmas * math.sqrt(sway2)
    return gate._replace(radius_m=math.hypot(gate.radius_m, sway_m))


def _sway2(expected: Attitude, sigma: Attitude) -> float:
    by_tilt = expected.height_m / math.cos(expected.tilt_rad) ** 2 * sigma.tilt_rad
    by_height = math.tan(expected.tilt_rad) * sigma.height_m
    return by_tilt**2 + (expected.height_m * sigma.roll_rad) ** 2 + by_height**2


def _foot_motion(base_from_foot_a: Se2, base_from_foot_b: Se2, a_from_b: Se2) -> Se2:
    """Turn a motion of bases into one of camera feet."""
    return base_from_foot_a.inverse() @ a_from_b @ base_from_foot_b


def _off(motion: Se2, gate: Gate) -> tuple[float, float]:
    error = gate.a_from_b.inverse() @ motion
    return math.hypot(error.x_m, error.y_m), abs(error.theta_rad)
