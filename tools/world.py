"""A world with known truth: photographs of an invented floor and where they were taken.

Shared by the tests, the benches and `render_team.py`. Everything follows from the seed alone.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.tools.floors import make_floor
from groundfuse.tools.obstacles import Obstacle
from groundfuse.tools.overlap import View, counted_floor, true_overlap
from groundfuse.tools.photometry import Photometry, photograph
from groundfuse.tools.render import World, render_view

FREE_PER_HEIGHT = 0.35  # no obstacle stands nearer to a camera's foot, in camera heights
OBSTACLE_TRIES = 400


@dataclass(frozen=True, slots=True)
class RobotSpec:
    """A robot and where it takes its pictures.

    Attributes:
        name: of the robot.
        camera: the mount's sigmas are the wobble's.
        world_from_base: true pose of every picture, in order.
    """

    name: str
    camera: Camera
    world_from_base: tuple[Se2, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """A picture and the truth about it.

    Attributes:
        id: robot and index.
        image: (rows, columns, 3) BGR of 8 bits.
        view: camera, true attitude and true `world_from_base`.
    """

    id: FrameId
    image: Image
    view: View

    @property
    def attitude(self) -> Attitude:
        """True tilt, roll and height."""
        return self.view.attitude

    @property
    def world_from_base(self) -> Se2:
        """True pose of the robot."""
        return self.view.world_from_base


@dataclass(frozen=True, slots=True, eq=False)
class RenderedRobot:
    """A robot's pictures in order."""

    name: str
    camera: Camera
    frames: tuple[RenderedFrame, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedTeam:
    """All robots' pictures of one floor."""

    robots: tuple[RenderedRobot, ...]
    obstacles: tuple[Obstacle, ...]

    @property
    def frames(self) -> tuple[RenderedFrame, ...]:
        """All pictures, robot after robot."""
        return tuple(frame for robot in self.robots for frame in robot.frames)

    def true_overlap(self, a: FrameId, b: FrameId) -> float:
        """Return the share of the smaller footprint that both pictures show, 0 to 1."""
        views = {frame.id: frame.view for frame in self.frames}
        return true_overlap(views[a], views[b])

    def true_motion(self, a: FrameId, b: FrameId) -> Se2:
        """Return the true pose of b in a, base to base."""
        poses = {frame.id: frame.world_from_base for frame in self.frames}
        return poses[a].inverse() @ poses[b]

    def overlaps(self) -> dict[tuple[FrameId, FrameId], float]:
        """Return the overlap of every pair that has any."""
        pairs = itertools.combinations(self.frames, 2)
        found = {(a.id, b.id): true_overlap(a.view, b.view) for a, b in pairs}
        return {pair: share for pair, share in found.items() if share > 0.0}


def wobbled(camera: Camera, rng: np.random.Generator) -> Attitude:
    """Draw the true attitude of one picture: the mount's, off by its sigmas (Gaussian)."""
    nominal, sigma = camera.mount.attitude, camera.mount.sigma
    tilt, roll, height = rng.standard_normal(3)
    return Attitude(
        nominal.tilt_rad + sigma.tilt_rad * float(tilt),
        nominal.roll_rad + sigma.roll_rad * float(roll),
        nominal.height_m + sigma.height_m * float(height),
    )


def place_obstacles(
    views: Sequence[View], count: int, height_m: float, rng: np.random.Generator
) -> tuple[Obstacle, ...]:
    """Stand up to `count` solids where cameras see them and no camera or other solid stands.

    Args:
        views: all the team's; the solids stand on floor that one of them shows.
        count: fewer are placed where there is no room.
        height_m: of a camera; the solids are 0.1 to 0.4 of it in every direction.
        rng: source of chance.
    """
    feet = np.array([[v.world_from_foot.x_m, v.world_from_foot.y_m] for v in views])
    placed: list[Obstacle] = []
    for _ in range(OBSTACLE_TRIES):
        if len(placed) == count:
            break
        seen = counted_floor(views[int(rng.integers(len(views)))])
        spot = seen[int(rng.integers(len(seen)))]
        solid = _random_solid(spot, height_m, rng)
        clear = np.hypot(*(feet - spot).T).min() - solid.radius_m
        others = [
            np.hypot(*(spot - (o.world_from_solid.x_m, o.world_from_solid.y_m))) - o.radius_m
            for o in placed
        ]
        apart = min(others, default=math.inf) - solid.radius_m
        if clear > FREE_PER_HEIGHT * height_m and apart > 0.1 * height_m:
            placed.append(solid)
    return tuple(placed)


def _random_solid(spot: np.ndarray, height_m: float, rng: np.random.Generator) -> Obstacle:
    half_x, half_y, tall = height_m * rng.uniform((0.06, 0.06, 0.12), (0.16, 0.12, 0.40))
    is_round = bool(rng.random() < 0.5)
    blue, green, red = rng.uniform(40.0, 210.0, 3)
    pose = Se2(float(spot[0]), float(spot[1]), float(rng.uniform(-math.pi, math.pi)))
    radius = float(half_y if is_round else half_x)
    colour = (float(blue), float(green), float(red))
    seed = int(rng.integers(2**31))
    return Obstacle(pose, radius, float(half_y), float(tall), colour, is_round, seed)


def make_team(
    floor: str,
    seed: int,
    robots: Sequence[RobotSpec],
    photometry: Photometry | None = None,
    num_obstacles: int = 0,
) -> RenderedTeam:
    """Photograph one floor with a team.

    The floor's grain suits the lowest camera. Wobble, obstacles and photometry come from `seed`.

    Raises:
        ValueError: no robot; an unknown floor; a camera whose lens has no ray for a pixel.
    """
    if not robots:
        raise ValueError("a team needs at least one robot, got none")
    heights = [robot.camera.mount.attitude.height_m for robot in robots]
    chance = np.random.default_rng(seed).spawn(len(robots) + 1)
    views = [
        [View(robot.camera, wobbled(robot.camera, rng), pose) for pose in robot.world_from_base]
        for robot, rng in zip(robots, chance, strict=False)
    ]
    every_view = [view for of_robot in views for view in of_robot]
    solids = place_obstacles(every_view, num_obstacles, min(heights), chance[-1])
    world = World(make_floor(floor, seed, min(heights)), solids)
    rendered = [
        _photographed(world, robot, of_robot, photometry or Photometry(), rng)
        for robot, of_robot, rng in zip(robots, views, chance, strict=False)
    ]
    return RenderedTeam(tuple(rendered), solids)


def _photographed(
    world: World,
    robot: RobotSpec,
    views: Sequence[View],
    photometry: Photometry,
    rng: np.random.Generator,
) -> RenderedRobot:
    frames = [
        RenderedFrame(FrameId(robot.name, index), take(world, view, photometry, rng), view)
        for index, view in enumerate(views)
    ]
    return RenderedRobot(robot.name, robot.camera, tuple(frames))


def take(world: World, view: View, photometry: Photometry, rng: np.random.Generator) -> Image:
    """Take one picture."""
    light = render_view(world, view.camera, view.attitude, view.world_from_base)
    return photograph(light, photometry, rng)
