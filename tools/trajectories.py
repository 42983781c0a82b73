"""Where robots take their pictures: closed wavy loops that meet at two or three places.

As in the paper, a robot comes back to where it began (its first and last view share floor), and
the robots' loops overlap. Everything is decided by footprints, not by what the pictures show.
"""

import math
from collections.abc import Sequence

import numpy as np

from groundfuse.backend.measurement import IDENTITY, Se2
from groundfuse.frontend.arrays import Floats
from groundfuse.frontend.camera import Camera
from groundfuse.tools.overlap import (
    STEP_PER_HEIGHT,
    View,
    counted_floor,
    near_pairs,
    true_overlap,
)
from groundfuse.tools.world import RobotSpec

WAY_PER_HEIGHT = 0.48
"""Way between two pictures; with a field of view near 60 deg neighbours share about half."""
LAST_GAP = 0.6  # of a step: what is missing to the start after the last picture
SHORTEST_LAP = 12.6  # steps: tighter turns leave neighbours no common floor
VIEWS_PER_LAP = 26  # at least, in a planned team: a long way comes back to floor it has seen
WAVES = {2: 0.08, 3: 0.03}  # relative amplitude of the loop's radius by waves per turn
HEADING_SIGMA_RAD = math.radians(2.0)
DENSE = 4096
MIN_OVERLAP = 0.4
"""Pairs of two robots that share at least this much of a footprint make a meeting place."""
PLACES = (2, 3)
TRIES = 1000
VERIFIED = 20
NEAR_PER_HEIGHT = 0.65
COARSE_PER_HEIGHT = 0.05  # grid on which starts are compared


def loop(num_views: int, step_m: float, rng: np.random.Generator, laps: int = 1) -> tuple[Se2, ...]:
    """Return poses of the base around a wavy loop, evenly spaced, looking along the way.

    The first pose is the origin; half of the loops run clockwise. Fewer than 13 views end part of
    the way around. Later laps of several run over the same
    loop, with pictures at other places of it.

    Raises:
        ValueError: no view, no lap, or a step without length.
    """
    if num_views < 1 or laps < 1 or not step_m > 0.0:
        found = f"{num_views} views, {laps} laps, step {step_m:g} m"
        raise ValueError(f"a loop needs views, laps and a step above 0, got {found}")
    along, curve = _closed_curve(rng)
    round_trip = step_m * max((num_views - 1 + LAST_GAP) / laps, SHORTEST_LAP)
    at = (np.arange(num_views) * step_m / round_trip) % 1.0 * along[-1]
    x, y = (np.interp(at, along, axis) for axis in curve.T)
    ahead = np.gradient(curve, along, axis=0)
    dx, dy = (np.interp(at, along, axis) for axis in ahead.T)
    side = 1.0 if rng.random() < 0.5 else -1.0
    scale = round_trip / along[-1]
    heading = np.arctan2(side * dy, dx) + HEADING_SIGMA_RAD * rng.standard_normal(num_views)
    places = np.column_stack([x * scale, side * y * scale, heading])
    poses = [Se2(*map(float, place)) for place in places]
    return tuple(poses[0].inverse() @ pose for pose in poses)


def _closed_curve(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Way along a closed curve (n,) and its points (n, 2)."""
    turn = np.linspace(0.0, 2 * math.pi, DENSE + 1)
    radius = 1.0 + sum(
        size * np.sin(waves * turn + rng.uniform(0.0, 2 * math.pi)) for waves, size in WAVES.items()
    )
    curve = np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])
    steps = np.hypot(*np.diff(curve, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)]), curve


def placed(poses: Sequence[Se2], world_from_start: Se2) -> tuple[Se2, ...]:
    """Put a trajectory that begins at the origin somewhere in the world."""
    return tuple(world_from_start @ pose for pose in poses)


def plan_team(
    cameras: Sequence[tuple[str, Camera]],
    num_views: int,
    rng: np.random.Generator,
    step_m: float | None = None,
) -> tuple[RobotSpec, ...]:
    """Plan loops for a team: every robot meets an earlier one at two or three places.

    Args:
        cameras: names and cameras, in order.
        num_views: of each robot.
        rng: source of chance.
        step_m: way between pictures; by default WAY_PER_HEIGHT of each robot's camera height.

    Raises:
        ValueError: as `loop`.
    """
    team: list[RobotSpec] = []
    for name, camera in cameras:
        height = camera.mount.attitude.height_m
        laps = max(1, num_views // VIEWS_PER_LAP)
        poses = loop(num_views, step_m or WAY_PER_HEIGHT * height, rng, laps)
        start = Se2(0.0, 0.0, float(rng.uniform(-math.pi, math.pi)))
        if team:
            start = _meeting_start(team, camera, poses, rng)
        team.append(RobotSpec(name, camera, placed(poses, start)))
    return tuple(team)


def _meeting_start(
    team: Sequence[RobotSpec], camera: Camera, poses: Sequence[Se2], rng: np.random.Generator
) -> Se2:
    """Draw starts until the new robot meets an earlier one often enough, and not all the way.

    The middles of the footprints tell cheaply which starts are worth counting.
    """
    best, most, verified = Se2(0.0, 0.0, 0.0), -1, 0
    for _ in range(TRIES):
        partner = team[int(rng.integers(len(team)))]
        start = _start_over(partner, camera, poses, rng)
        mine = placed(poses, start)
        near = _near(partner, camera, mine)
        lengths = (len(partner.world_from_base), len(poses))
        likely = count_places(near, lengths) in PLACES and len(near) <= len(poses)
        if most >= 0 and not likely:
            continue
        views = _views(partner.camera, partner.world_from_base), _views(camera, mine)
        pairs = meetings(*views, COARSE_PER_HEIGHT)
        places = count_places(pairs, lengths)
        if places in PLACES and len(pairs) <= len(poses):
            return start
        if most < places <= PLACES[1]:
            best, most = start, places
        verified += 1
        if verified == VERIFIED:
            break
    return best


def _start_over(
    partner: RobotSpec, camera: Camera, poses: Sequence[Se2], rng: np.random.Generator
) -> Se2:
    """Start such that some view of the new robot shows the middle of some view of the partner."""
    i, j = int(rng.integers(len(partner.world_from_base))), int(rng.integers(len(poses)))
    target = _middles(partner.camera, partner.world_from_base[i : i + 1])[0]
    turn = Se2(0.0, 0.0, float(rng.uniform(-math.pi, math.pi)))
    reached = _middles(camera, [turn @ poses[j]])[0]
    return Se2(float(target[0] - reached[0]), float(target[1] - reached[1]), turn.theta_rad)


def _middles(camera: Camera, poses: Sequence[Se2]) -> Floats:
    """Middles (n, 2) of the nominal footprints."""
    still = counted_floor(View(camera, camera.mount.attitude, IDENTITY)).mean(axis=0)
    return np.vstack([pose.apply(still[None, :]) for pose in poses])


def _near(partner: RobotSpec, camera: Camera, poses: Sequence[Se2]) -> list[tuple[int, int]]:
    """Pairs whose footprints' middles are so near that they may well be a meeting."""
    a, b = _middles(partner.camera, partner.world_from_base), _middles(camera, poses)
    heights = partner.camera.mount.attitude.height_m + camera.mount.attitude.height_m
    apart = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    return [(int(i), int(j)) for i, j in np.argwhere(apart < NEAR_PER_HEIGHT * heights / 2.0)]


def _views(camera: Camera, poses: Sequence[Se2]) -> list[View]:
    return [View(camera, camera.mount.attitude, pose) for pose in poses]


def meetings(
    a: Sequence[View], b: Sequence[View], step_per_height: float = STEP_PER_HEIGHT
) -> list[tuple[int, int]]:
    """Return the index pairs of two robots' views that share at least MIN_OVERLAP."""
    return [
        (i, j)
        for i, j in near_pairs(a, b)
        if true_overlap(a[i], b[j], step_per_height) >= MIN_OVERLAP
    ]


def count_places(pairs: Sequence[tuple[int, int]], lengths: tuple[int, int]) -> int:
    """Count meeting places: pairs are of one place if both indices are the same or neighbours.

    Views go around loops of the given lengths: the last is a neighbour of the first.
    """
    left, places = set(pairs), 0
    while left:
        places += 1
        border = [left.pop()]
        while border:
            i, j = border.pop()
            near = {
                ((i + di) % lengths[0], (j + dj) % lengths[1])
                for di in (-1, 0, 1)
                for dj in (-1, 0, 1)
            } & left
            left -= near
            border.extend(near)
    return places
