"""Measure how fast a mosaic grows: combining the views of a cell, and everything with warping.

    bench_mosaic.py                  both tables
    bench_mosaic.py --views 40       denser overlap in the second

Combining: 16 and 7 noisy views a cell, a fifth of the cells with an obstacle in a third of the
views: taking a tile's stack of views down to its layers, and that with putting the views on it,
which compensates their exposure, weighs and packs them. Beside it numpy's median, which keeps half
the noise of the views it throws away and knows no weights. Everything: pictures of 640 x 480 of a
noise floor held in memory, tilted by 33 deg, all around one spot, one thread; seconds are the
processor's. Millions of seen cells per second.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera, Intrinsics, Mount
from groundfuse.frontend.mosaic import MosaicOptions, MosaicView, build_mosaic
from groundfuse.frontend.mosaic_tile import TileStack
from groundfuse.frontend.sight import SeenCells

SIDE = 256
LIMITS = np.array([639.0, 0.0, 479.0], np.float32)
REPEATS = 5
NOISE_LEVELS = 3.0
HEIGHT_M = 0.55
CELL_M = 0.0015


def fastest_s(work: Callable[[], object]) -> float:
    """Return the least processor time of some runs; the first, which may compile, doesn't count."""
    work()
    seconds = []
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    return min(seconds)


def noisy_views(depth: int) -> list[SeenCells]:
    """Views of all cells of a tile."""
    rng = np.random.default_rng(depth)
    rows, columns = np.divmod(np.arange(SIDE * SIDE), SIDE)
    cell = np.column_stack([rows, columns]).astype(np.int32)
    views = []
    for number in range(depth):
        colour = rng.normal(120.0, NOISE_LEVELS, (SIDE * SIDE, 3)).astype(np.float32)
        if number < depth // 3:
            colour[: SIDE * SIDE // 5] += 60.0
        lowest, highest = (0.0, 0.0, 1.0, 1.0), (639.0, 479.0, 3.0, 1.0)
        place = rng.uniform(lowest, highest, (SIDE * SIDE, 4)).astype(np.float32)
        views.append(SeenCells(cell, place, colour))
    return views


def stacked(views: Sequence[SeenCells]) -> TileStack:
    """Put views on a stack."""
    stack = TileStack(SIDE, SIDE, len(views))
    for seen in views:
        stack.add((0, 0), seen, LIMITS, np.zeros(3))
    return stack


def bench_combining(depths: Sequence[int]) -> None:
    """Print millions of cells per second of the rule, of all that a tile needs, and of a median."""
    print("combining, Mcell/s on one core")
    print(f"{'views':>7}{'down':>10}{'on, down':>10}{'median':>10}{'down / median':>15}")
    for depth in depths:
        views = noisy_views(depth)
        stack, colours = stacked(views), np.stack([seen.colour for seen in views])

        def speed(work: Callable[[], object]) -> float:
            return SIDE * SIDE / 1e6 / fastest_s(work)

        def both(views: Sequence[SeenCells] = views) -> object:
            return stacked(views).finished(NOISE_LEVELS, 3.0)

        down = speed(partial(stack.finished, NOISE_LEVELS, 3.0))
        median = speed(partial(np.median, colours, axis=0))
        print(f"{depth:7d}{down:10.2f}{speed(both):10.2f}{median:10.2f}{down / median:15.1f}")


def ring_views(number: int) -> list[MosaicView]:
    """Views from all around a spot, of noise: the work doesn't depend on what is shown."""
    lens = Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0)
    filed = Attitude(math.radians(33.0), 0.0, HEIGHT_M)
    camera = Camera(lens, Mount(filed, Attitude(0.01, 0.003, 0.002)))
    rng = np.random.default_rng(1)
    picture: Image = rng.integers(60, 200, (480, 640, 3)).astype(np.uint8)
    turns = 2.0 * math.pi * np.arange(number) / number
    places = [Se2(-0.3 * math.cos(t), -0.3 * math.sin(t), t) for t in turns.tolist()]
    return [
        MosaicView(FrameId("A", i), camera, filed, place, lambda: picture)
        for i, place in enumerate(places)
    ]


def bench_everything(number: int) -> None:
    """Print millions of cells per second from pictures to layers."""
    views = ring_views(number)
    options = MosaicOptions(m_per_px=CELL_M, workers=1)
    mosaic = build_mosaic(views, options)
    seconds = fastest_s(lambda: build_mosaic(views, options))
    seen = int((mosaic.count > 0).sum())
    depth = float(mosaic.count[mosaic.count > 0].mean())
    print("everything, with exposures and warping, one thread")
    print(f"{'views':>7}{'mean depth':>12}{'Mcells':>9}{'CPU s':>8}{'Mcell/s':>9}{'ns/view':>9}")
    per_view = 1e9 * seconds / float(mosaic.count.sum())
    print(
        f"{number:7d}{depth:12.1f}{seen / 1e6:9.2f}{seconds:8.2f}{seen / 1e6 / seconds:9.3f}"
        f"{per_view:9.0f}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables."""
    command = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.add_argument("--depths", nargs="+", type=int, default=[7, 16])
    command.add_argument("--views", type=int, default=16)
    asked = command.parse_args(arguments)
    cv2.setNumThreads(1)
    bench_combining(asked.depths)
    bench_everything(asked.views)
    return 0


if __name__ == "__main__":
    sys.exit(main())
