"""How sharp a mosaic is against the floor that was photographed: gradient energy on free floor.

The reference is the floor's true colour averaged over each cell of the mosaic, without any camera:
what is lost to the pixels' own size counts against the mosaic. With pictures of 640 x 480 from
0.55 m, tilted by 33 and 45 deg, a pixel covers 1.3 to 4 mm of floor; the cells here are 1.5 mm.
"""

from collections.abc import Mapping

import cv2
import numpy as np

from groundfuse.backend.bundle_estimate import BundleEstimate
from groundfuse.backend.measurement import Attitude, FrameId, Se2, TeamEstimate
from groundfuse.frontend.arrays import Floats, Image, Mask
from groundfuse.frontend.mosaic import Mosaic, MosaicOptions, MosaicView, build_mosaic
from groundfuse.tools.floor_raster import FloorRaster
from groundfuse.tools.noise import Rect
from groundfuse.tools.pipeline import Fused
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.team_folder import load_image
from groundfuse.tools.world import Scene

CELL_M = 0.0015
SUPERSAMPLES = 3
FEWEST_VIEWS = 3
MARGIN_CELLS = 4
OBSTACLE_MARGIN_M = 0.05
"""Free floor is seen by three views at least, and this far from what stands on it."""


def sharpness(team: Fused, bundled: BundleEstimate, scene: Scene) -> tuple[float, float, float]:
    """Gradient energy over the true texture's: of the Pose2, bundled and true poses' mosaics."""
    views = scene.by_frame()
    true = {frame: view.world_from_base for frame, view in views.items()}
    filed = {frame: known.attitude for frame, (_, known) in team.frames.items()}
    found = bundled.attitude
    exact = {frame: view.attitude for frame, view in views.items()}
    return (
        _ratio(team, _poses(team.team), filed, scene),
        _ratio(team, _poses(bundled.team), found, scene),
        _ratio(team, true, exact, scene),
    )


def _poses(team: TeamEstimate) -> dict[FrameId, Se2]:
    return {f: pose for f, pose in team.team_from_base.items() if team.component_of[f] == 0}


def _ratio(
    team: Fused, poses: Mapping[FrameId, Se2], attitudes: Mapping[FrameId, Attitude], scene: Scene
) -> float:
    views = [
        _view(*team.frames[frame], attitudes[frame], pose) for frame, pose in sorted(poses.items())
    ]
    mosaic = build_mosaic(views, MosaicOptions(m_per_px=CELL_M))
    first = min(poses)
    world_from_team = scene.by_frame()[first].world_from_base @ poses[first].inverse()
    truth = _true_texture(mosaic, scene.world.floor, world_from_team)
    free = _free_floor(mosaic, scene, world_from_team)
    return _energy(mosaic.floor, free) / _energy(truth, free)


def _view(robot: Robot, known: Frame, attitude: Attitude, pose: Se2) -> MosaicView:
    return MosaicView(
        known.id, robot.camera, attitude, pose, lambda: load_image(known, robot.camera)
    )


def _cells(mosaic: Mosaic, world_from_team: Se2, shift: tuple[float, float]) -> Floats:
    """World coordinates (rows, columns, 2) of a place in every cell."""
    rows, columns = mosaic.count.shape
    x = mosaic.x_min_m + (np.arange(columns) + shift[0]) * mosaic.m_per_px
    y = mosaic.y_max_m - (np.arange(rows) + shift[1]) * mosaic.m_per_px
    places = np.stack(np.meshgrid(x, y), axis=2)
    return world_from_team.apply(places.reshape(-1, 2)).reshape(rows, columns, 2)


def _true_texture(mosaic: Mosaic, floor: FloorRaster, world_from_team: Se2) -> Image:
    """The floor averaged over the mosaic's cells."""
    corners = _cells(mosaic, world_from_team, (0.5, 0.5)).reshape(-1, 2) / floor.cell_m
    low = np.floor(corners.min(axis=0)).astype(int) - 4
    size = np.ceil(corners.max(axis=0)).astype(int) + 4 - low
    patch = floor.patch(Rect(int(low[0]), int(low[1]), int(size[0]), int(size[1])), 0)
    total = np.zeros((*mosaic.count.shape, 3), dtype=np.float32)
    steps = (np.arange(SUPERSAMPLES) + 0.5) / SUPERSAMPLES
    for across in steps.tolist():
        for down in steps.tolist():
            at = _cells(mosaic, world_from_team, (across, down)) / floor.cell_m - low - 0.5
            at = at.astype(np.float32)
            total += cv2.remap(patch, at[:, :, 0], at[:, :, 1], cv2.INTER_LINEAR)
    mean: Image = np.rint(total / SUPERSAMPLES**2).astype(np.uint8)
    return mean


def _free_floor(mosaic: Mosaic, scene: Scene, world_from_team: Se2) -> Mask:
    """Cells that enough views see and that no solid hides."""
    free = mosaic.count >= FEWEST_VIEWS
    places = _cells(mosaic, world_from_team, (0.5, 0.5))
    for solid in scene.world.obstacles:
        middle = np.array([solid.world_from_solid.x_m, solid.world_from_solid.y_m])
        reach = solid.radius_m + solid.height_m + OBSTACLE_MARGIN_M
        free &= np.hypot(*np.moveaxis(places - middle, 2, 0)) > reach
    side = 2 * MARGIN_CELLS + 1
    shrunk = cv2.erode(free.astype(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(shrunk > 0)


def _energy(picture: Image, where: Mask) -> float:
    """Mean squared gradient over the squared mean grey: exposure does not matter."""
    grey: Floats = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float64)
    down: Floats = np.asarray(np.gradient(grey, axis=0))
    across: Floats = np.asarray(np.gradient(grey, axis=1))
    energy = down**2 + across**2
    return float(np.mean(energy[where]) / np.mean(grey[where]) ** 2)
