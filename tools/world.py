"""A world with known truth: photographs of an invented floor and where they were taken.

Shared by the tests, the benches and `render_team.py`. Everything follows from the seed alone.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.ahead import in_threads
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.tools.floors import make_floor
from groundfuse.tools.obstacles import Obstacle
from groundfuse.tools.overlap import View, all_overlaps, counted_floor, true_overlap
from groundfuse.tools.photometry import Photometry, photograph
from groundfuse.tools.render import World, render_view

FREE_PER_HEIGHT = 0.35  # no obstacle stands nearer to a camera's foot, in camera heights
OBSTACLE_TRIES = 400
WOBBLE, SOLIDS, LIGHT = range(3)  # independent streams of chance from one seed


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
        return all_overlaps({frame.id: frame.view for frame in self.frames})


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


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A world and where every picture of it is taken, before any is taken.

    Attributes:
        world: floor and obstacles.
        robots: who takes pictures.
        views: the true views of each robot, in order.
        seed: all chance follows from it.
    """

    world: World
    robots: tuple[RobotSpec, ...]
    views: tuple[tuple[View, ...], ...]
    seed: int

    def by_frame(self) -> dict[FrameId, View]:
        """Return every view by the picture's name, robot after robot."""
        return {
            FrameId(robot.name, index): view
            for robot, views in zip(self.robots, self.views, strict=True)
            for index, view in enumerate(views)
        }


def set_scene(
    floor: str,
    seed: int,
    robots: Sequence[RobotSpec],
    num_obstacles: int = 0,
    grain: float = 1.0,
) -> Scene:
    """Lay a floor whose grain suits the lowest camera, stand solids on it, and wobble the cameras.

    Args:
        floor: its name.
        seed: all chance follows from it.
        robots: who takes pictures, and where.
        num_obstacles: solids to place.
        grain: how many times coarser the floor is than suits 640 pixels across.

    Raises:
        ValueError: no robot, or an unknown floor.
    """
    if not robots:
        raise ValueError("a team needs at least one robot, got none")
    lowest = min(robot.camera.mount.attitude.height_m for robot in robots)
    raster = make_floor(floor, seed, lowest * grain)
    views = []
    for index, robot in enumerate(robots):
        rng = np.random.default_rng([seed, WOBBLE, index])
        views.append(
            tuple(View(robot.camera, wobbled(robot.camera, rng), p) for p in robot.world_from_base)
        )
    every = [view for of_robot in views for view in of_robot]
    rng = np.random.default_rng([seed, SOLIDS])
    solids = place_obstacles(every, num_obstacles, lowest, rng)
    return Scene(World(raster, solids), tuple(robots), tuple(views), seed)


def photographs(
    scene: Scene, photometry: Photometry, num_threads: int = 1
) -> Generator[RenderedFrame, None, None]:
    """Take the pictures, robot after robot; each is the same whatever came before.

    Raises:
        ValueError: a lens that has no ray for a pixel.
    """
    numbers = {robot.name: k for k, robot in enumerate(scene.robots)}

    def taken(item: tuple[FrameId, View]) -> RenderedFrame:
        frame, view = item
        rng = np.random.default_rng([scene.seed, LIGHT, numbers[frame.robot], frame.index])
        return RenderedFrame(frame, take(scene.world, view, photometry, rng), view)

    return in_threads(taken, scene.by_frame().items(), num_threads)


def make_team(
    floor: str,
    seed: int,
    robots: Sequence[RobotSpec],
    photometry: Photometry | None = None,
    num_obstacles: int = 0,
) -> RenderedTeam:
    """Photograph one floor with a team: `set_scene`, then all `photographs`.

    Raises:
        ValueError: no robot; an unknown floor; a lens that has no ray for a pixel.
    """
    scene = set_scene(floor, seed, robots, num_obstacles)
    frames = tuple(photographs(scene, photometry or Photometry()))
    rendered = [
        RenderedRobot(
            robot.name, robot.camera, tuple(f for f in frames if f.id.robot == robot.name)
        )
        for robot in robots
    ]
    return RenderedTeam(tuple(rendered), scene.world.obstacles)


def take(world: World, view: View, photometry: Photometry, rng: np.random.Generator) -> Image:
    """Take one picture."""
    light = render_view(world, view.camera, view.attitude, view.world_from_base)
    return photograph(light, photometry, rng)
