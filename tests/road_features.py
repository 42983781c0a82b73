"""Features that are descriptors alone: frames along a row of marks, for retrieval."""

import numpy as np

from groundfuse.frontend.features import Features
from groundfuse.frontend.overhead_view import OverheadGrid

GRID = OverheadGrid(0.002, 1.0, 0.5, 500, 500, 1.0)


def features(descriptors, log_size=None):
    """Features that have nothing but descriptors, and sizes where they matter."""
    count = len(descriptors)
    blank, points = np.zeros(count), np.zeros((count, 2))
    size = blank if log_size is None else log_size
    return Features(
        points, points, blank, size, blank, descriptors, GRID, 0.55, 0.01, 0.01, 0.01, 0.1
    )


def along_a_road(num_frames, step, rng, *, seen=60, bits=False):
    """Frames that each see `seen` marks of a row, `step` further every time, with noise."""
    marks = rng.uniform(0.0, 1.0, (num_frames * step + seen, 128)) ** 4
    frames = []
    for k in range(num_frames):
        rows = marks[k * step : k * step + seen]
        if bits:
            rows = rows[:, :32] > np.median(rows)
            spread = np.repeat(rows, 8, axis=1) ^ (rng.random((seen, 256)) < 0.08)
            described = np.packbits(spread, axis=1)
        else:
            noisy = np.abs(rows + 0.05 * rng.standard_normal(rows.shape))
            described = np.sqrt(noisy / noisy.sum(axis=1, keepdims=True)).astype(np.float32)
        frames.append(features(described[rng.permutation(seen)]))
    return frames
