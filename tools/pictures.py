"""Pictures of the fused team: mosaics with world files, their layers, the location graph, 3D."""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from groundfuse.backend.measurement import FrameId, Rejected, RelativePose
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.kept_parts import Memory
from groundfuse.frontend.mosaic import (
    Mosaic,
    MosaicOptions,
    MosaicView,
    build_mosaic,
    planned_mosaic,
)
from groundfuse.frontend.mosaic_plan import Layout, MosaicPlan, plan_mosaic
from groundfuse.frontend.mosaic_preview import Preview, reduction
from groundfuse.frontend.mosaic_stream import Told, mosaic_tiles
from groundfuse.frontend.overhead_view import OverheadOptions, overhead_grid, overhead_view
from groundfuse.tools.drawing import draw_location_graph
from groundfuse.tools.errors import TeamError
from groundfuse.tools.files import write_atomic
from groundfuse.tools.geotiff import BLOCK, can_write, new_geotiff
from groundfuse.tools.mosaic_memory import MosaicMemory
from groundfuse.tools.outputs import component_name
from groundfuse.tools.pipeline import Fused, Stopwatch
from groundfuse.tools.png_file import write_png
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import load_image

log = logging.getLogger(__name__)

COUNT_GREY = 16
"""Grey values per view in the picture of the count of views."""


def write_mosaics(
    out: Path,
    fused: Fused,
    options: MosaicOptions,
    num_workers: int,
    watch: Stopwatch,
    *,
    quiet: bool,
    store: Store | None = None,
    longer: Sequence[Callable[[int, Mosaic], None]] = (),
    shorter: Sequence[Callable[[int, Mosaic], None]] = (),
) -> dict[int, Mosaic]:
    """Build and write the mosaic of every component with its layers; return them by component.

    A mosaic of more than `memory_cells` is written as a GeoTIFF, and what is returned and written
    as PNG is a reduced preview; without rasterio its cells are larger from the start.

    Args:
        out: folder.
        fused: the team.
        options: how.
        num_workers: threads.
        watch: takes the seconds.
        quiet: without a progress bar.
        store: has the tiles of the team's last mosaics, and takes these; see `mosaic_tiles`.
        longer: write more of a component and its mosaic, beside the layers; begun before them.
        shorter: likewise; begun after them.
    """
    mosaics: dict[int, Mosaic] = {}
    memory = None if store is None else MosaicMemory(store)
    for component in sorted(set(fused.best.component_of.values())):
        with (
            watch.stage("mosaic"),
            tqdm(desc="mosaic    ", disable=quiet or None, leave=False) as bar,
        ):

            def told(done: int, total: int, bar: tqdm = bar) -> None:
                bar.total = total
                bar.update(done - bar.n)

            name, views = component_name("mosaic", component), _views(fused, component)
            chosen = replace(options, workers=num_workers)
            try:
                kept = None if memory is None else memory.of(name)
                mosaic = _mosaic(out / f"{name}.tif", views, chosen, told, kept)
            except ValueError as error:
                raise TeamError(f"mosaic of component {component}: {error}") from error
        with watch.stage("writing"):
            works = _layers(out, name, mosaic)
            works[:0] = [partial(work, component, mosaic) for work in longer]
            works += [partial(work, component, mosaic) for work in shorter]
            with ThreadPoolExecutor(num_workers) as threads:
                for done in [threads.submit(work) for work in works]:
                    done.result()
        mosaics[component] = mosaic
    if memory is not None:
        memory.forget_others()
    return mosaics


def _mosaic(
    path: Path,
    views: Sequence[MosaicView],
    options: MosaicOptions,
    told: Told,
    memory: Memory | None,
) -> Mosaic:
    """Build a mosaic; one too large to be held goes to the GeoTIFF, and its preview comes back."""
    path.unlink(missing_ok=True)  # one of an earlier run is not this team's
    plan = _plan(views, options, memory)
    if plan.grid.rows * plan.grid.columns <= options.memory_cells:
        return planned_mosaic(plan, options, told, memory)
    if not can_write():
        mosaic = build_mosaic(views, options, told)
        log.warning(
            "%s: not written: %d x %d cells of %g m need rasterio (pip install groundfuse[geo]); "
            "mosaic.png has larger cells, %g m",
            path,
            plan.grid.columns,
            plan.grid.rows,
            plan.grid.m_per_px,
            mosaic.m_per_px,
        )
        return mosaic
    options = replace(options, tile_cells=BLOCK)
    plan = _plan(views, options, memory)
    preview = Preview(plan.grid, reduction(plan.grid, options.memory_cells, BLOCK))
    with new_geotiff(path, plan.grid) as file:
        for block, tile in mosaic_tiles(plan, options, told, memory):
            file.add(block, tile)
            preview.add(block, tile)
        return preview.finished()


def _plan(views: Sequence[MosaicView], options: MosaicOptions, memory: Memory | None) -> MosaicPlan:
    """Lay out a mosaic as the one before it, where that fits."""
    if memory is None:
        return plan_mosaic(views, options)
    earlier = memory.load("layout")
    plan = plan_mosaic(views, options, earlier if isinstance(earlier, Layout) else None)
    memory.save("layout", plan.layout)
    return plan


def _views(fused: Fused, component: int) -> list[MosaicView]:
    best, frames = fused.best, fused.frames

    def loader(frame: FrameId) -> Callable[[], Image]:
        robot, known = frames[frame]
        return lambda: load_image(known, robot.camera)

    return [
        MosaicView(
            frame,
            frames[frame][0].camera,
            fused.attitude(frame),
            pose,
            loader(frame),
            fused.front_end.pictures.get(frame, b""),
        )
        for frame, pose in sorted(best.team_from_base.items())
        if best.component_of[frame] == component
    ]


def write_location_graph(out: Path, fused: Fused, component: int, mosaic: Mosaic) -> None:
    """Write a picture of a component's trajectories and edges over its mosaic."""
    feet = {robot.name: robot.camera.mount.base_from_foot for robot in fused.robots}
    edges: list[RelativePose | Rejected] = [*fused.edges, *fused.front_end.rejected]
    picture = draw_location_graph(mosaic, fused.best, edges, component, feet)
    write_png(out / f"{component_name('location_graph', component)}.png", picture)


def write_overheads(out: Path, fused: Fused, options: OverheadOptions) -> None:
    """Write every frame's overhead view (paper eq. 1) at its best known attitude, forward up."""
    for frame, (robot, known) in sorted(fused.frames.items()):
        attitude = fused.attitude(frame)
        grid = overhead_grid(robot.camera, attitude, options)
        image = load_image(known, robot.camera)
        view, _ = overhead_view(image, robot.camera, attitude, grid)
        write_png(out / "overhead" / f"{frame}.png", view)


def _layers(out: Path, stem: str, mosaic: Mosaic) -> list[Callable[[], None]]:
    """Return what writes the layers, those that take long first."""

    def write(suffix: str, picture: Callable[[], np.ndarray]) -> None:
        write_png(out / f"{stem}{suffix}.png", picture())
        write_atomic(out / f"{stem}{suffix}.pgw", world_file(mosaic))

    layers: tuple[tuple[str, Callable[[], np.ndarray]], ...] = (
        ("", lambda: _see_through(mosaic.floor, mosaic.count)),
        ("_mean", lambda: _see_through(mosaic.mean, mosaic.count)),
        ("_count", lambda: np.asarray(cv2.convertScaleAbs(mosaic.count, alpha=COUNT_GREY))),
        ("_few", lambda: 255 * mosaic.uncertain.astype(np.uint8)),
    )
    return [partial(write, *layer) for layer in layers]


def _see_through(colours: Image, count: np.ndarray) -> Image:
    """Return BGRA that is transparent where nothing was seen."""
    picture = np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2BGRA), dtype=np.uint8)
    picture[..., 3] = np.uint8(255) * (count > 0).view(np.uint8)
    return picture


def world_file(mosaic: Mosaic) -> str:
    """Return a world file: the affine map from columns and rows to metres in the team's frame."""
    x_m = mosaic.x_min_m + mosaic.m_per_px / 2.0
    y_m = mosaic.y_max_m - mosaic.m_per_px / 2.0
    numbers = (mosaic.m_per_px, 0.0, 0.0, -mosaic.m_per_px, x_m, y_m)
    return "".join(f"{number!r}\n" for number in numbers)
