"""Two views of one floor with a chosen overlap, at a random place: cheap truth for the benches."""

import math
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.camera import Camera
from groundfuse.tools.overlap import View, counted_floor, true_overlap
from groundfuse.tools.photometry import Photometry
from groundfuse.tools.render import World
from groundfuse.tools.world import RenderedFrame, take, wobbled

TRIES = 200
PLACE_PER_HEIGHT = 3.0
"""Views a lie within this many heights of the origin both ways: many pairs share drawn floor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """Which pairs are wanted.

    Attributes:
        least_overlap: of the footprints.
        most_overlap: of the footprints.
        max_turn_rad: largest difference of the headings, either way.
    """

    least_overlap: float = 0.3
    most_overlap: float = 0.8
    max_turn_rad: float = math.pi

    def __post_init__(self) -> None:
        """Refuse limits that no pair can keep (ValueError)."""
        if not 0.0 <= self.least_overlap <= self.most_overlap <= 1.0:
            found = f"{self.least_overlap:g} to {self.most_overlap:g}"
            raise ValueError(f"overlaps must lie within 0 to 1 and in order, got {found}")


@dataclass(frozen=True, slots=True, eq=False)
class RenderedPair:
    """Two pictures and the truth about them.

    Attributes:
        a: of the first camera.
        b: of the second.
        a_from_b: true pose of base b in base a.
        overlap: true share of the smaller footprint.
    """

    a: RenderedFrame
    b: RenderedFrame
    a_from_b: Se2
    overlap: float


def draw_views(
    cameras: tuple[Camera, Camera], options: PairOptions, rng: np.random.Generator
) -> tuple[View, View]:
    """Draw two wobbling views whose overlap lies within the options.

    Raises:
        ValueError: no such pair was found.
    """
    camera_a, camera_b = cameras
    height = camera_a.mount.attitude.height_m
    x, y = rng.uniform(-PLACE_PER_HEIGHT * height, PLACE_PER_HEIGHT * height, 2)
    heading = float(rng.uniform(-math.pi, math.pi))
    a = View(camera_a, wobbled(camera_a, rng), Se2(float(x), float(y), heading))
    floor = counted_floor(a)
    reach = float(np.hypot(*np.ptp(floor, axis=0)))
    for _ in range(TRIES):
        turn = heading + float(rng.uniform(-options.max_turn_rad, options.max_turn_rad))
        attitude = wobbled(camera_b, rng)
        still = counted_floor(View(camera_b, attitude, Se2(0.0, 0.0, turn))).mean(axis=0)
        offset = rng.uniform(-reach, reach, 2) * (1.0 - options.least_overlap)
        at = floor.mean(axis=0) + offset - still
        b = View(camera_b, attitude, Se2(float(at[0]), float(at[1]), turn))
        if options.least_overlap <= true_overlap(a, b) <= options.most_overlap:
            return a, b
    wanted = f"{options.least_overlap:g} and {options.most_overlap:g}"
    raise ValueError(f"found no two views with an overlap between {wanted} in {TRIES} tries")


def render_pair(
    world: World,
    cameras: tuple[Camera, Camera],
    options: PairOptions,
    rng: np.random.Generator,
    photometry: Photometry | None = None,
) -> RenderedPair:
    """Photograph a random pair; frames are called A0 and B0.

    Raises:
        ValueError: as `draw_views`, and a lens that has no ray for a pixel.
    """
    views = draw_views(cameras, options, rng)
    light = photometry or Photometry()
    a, b = (
        RenderedFrame(FrameId(name, 0), take(world, view, light, rng), view)
        for name, view in zip("AB", views, strict=True)
    )
    motion = a.world_from_base.inverse() @ b.world_from_base
    return RenderedPair(a, b, motion, true_overlap(*views))
