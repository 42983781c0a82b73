"""Measure how fast a mosaic grows: combining the views of a cell, and everything with warping.

    bench_mosaic.py                  both tables
    bench_mosaic.py --views 40       denser overlap in the second

Combining: 16 and 7 noisy views a cell, a fifth of the cells with an obstacle in a third of the
views; beside it numpy's median, which keeps half the noise of the views it throws away and knows
no weights. Everything: pictures of 640 x 480 of a noise floor held in memory, tilted by 33 deg, all
around one spot, one thread; seconds are the processor's. Millions of seen cells per second.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend import selection, selection_compiled
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera, Intrinsics, Mount
from groundfuse.frontend.mosaic import MosaicOptions, MosaicView, build_mosaic

NUM_CELLS = 65_536
REPEATS = 5
NOISE_HALF_LEVELS = 6.0
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


def noisy_views(depth: int) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Colours (depth, 3, cells) in half levels and footprints (depth, cells)."""
    rng = np.random.default_rng(depth)
    colours = np.rint(rng.normal(240.0, NOISE_HALF_LEVELS, (depth, 3, NUM_CELLS)))
    colours[: depth // 3, :, : NUM_CELLS // 5] += 120.0
    return colours.astype(np.uint16), rng.uniform(1, 3, (depth, NUM_CELLS)).astype(np.float32)


def bench_combining(depths: Sequence[int]) -> None:
    """Print millions of cells per second of the rule, numpy's reading of it, and a median."""
    print("combining, Mcell/s on one core")
    print(f"{'views':>7}{'as run':>10}{'numpy':>10}{'median':>10}{'as run / median':>17}")
    for depth in depths:
        colours, footprint = noisy_views(depth)
        weight = np.float32(1.0) / footprint**4

        def run(rule: Callable[..., Any], arguments: tuple[Any, ...]) -> float:
            return NUM_CELLS / 1e6 / fastest_s(lambda: rule(*arguments))

        arguments = (colours, footprint, weight, NOISE_HALF_LEVELS, 3.0)
        ours = run(selection_compiled.combined, arguments)
        plain = run(selection.combined, arguments)
        peer = run(lambda values: np.median(values, axis=0), (colours,))
        print(f"{depth:7d}{ours:10.2f}{plain:10.2f}{peer:10.2f}{ours / peer:17.1f}", flush=True)


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
