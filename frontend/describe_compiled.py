"""Which way a keypoint points, and what its surroundings look like; compiled.

Lowe 2004, sections 5 and 6; the root of the histogram as Arandjelovic & Zisserman, Three things
everyone should know to improve object retrieval, 2012. The surroundings are sampled on a grid that
turns and grows with the keypoint, the same number of samples for all.
"""

import math

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Picture32

BINS = 36
WINDOW = 1.5
"""Sigma of the orientation's window over the blur of the level it is read from."""
STRIDE = 2
"""Gradients of every second pixel: the level is as smooth as that."""
CELLS = 4
TURNS = 8
CELL = 4.2
"""Side of a cell over the keypoint's blur. Lowe's 3 makes the smallest too easy to mix up."""
SAMPLES = 18
"""Per side of a patch of `CELLS` + 1 cells: half a cell all around adds to the outer ones."""
CAP = 0.2
TINY = 1e-9


@part
def _angle(y: np.float32, x: np.float32) -> np.float32:
    """Return atan2 from 0 to 2 pi, to 1e-5 (Abramowitz & Stegun 1964, 4.4.49)."""
    across, along = abs(x), abs(y)
    z = min(across, along) / max(across, along, np.float32(1e-30))
    q = z * z
    angle = np.float32(-0.0851330) + q * np.float32(0.0208351)
    angle = np.float32(-0.3302995) + q * (np.float32(0.1801410) + q * angle)
    angle = z * (np.float32(0.9998660) + q * angle)
    angle = np.float32(math.pi / 2.0) - angle if along > across else angle
    angle = np.float32(math.pi) - angle if x < 0.0 else angle
    return np.float32(2.0 * math.pi) - angle if y < 0.0 else angle


@part
def _turns(level: Picture32, cx: int, cy: int, falloff: Picture32, bins: Picture32) -> None:
    """Write the smoothed histogram of gradient directions around a pixel; `bins` is (2, BINS)."""
    rows, columns = level.shape
    radius = len(falloff) - 1
    raw, smooth = bins[0], bins[1]
    raw[:] = 0.0
    for j in range(-radius, radius + 1, STRIDE):
        y = min(max(cy + j, 1), rows - 2)
        for i in range(-radius, radius + 1, STRIDE):
            x = min(max(cx + i, 1), columns - 2)
            dx = level[y, x + 1] - level[y, x - 1]
            dy = level[y + 1, x] - level[y - 1, x]
            k = int(_angle(dy, dx) * np.float32(BINS / (2.0 * math.pi)) + np.float32(0.5))
            length = math.sqrt(dx * dx + dy * dy)
            raw[k if k < BINS else 0] += length * falloff[abs(i)] * falloff[abs(j)]
    for k in range(BINS):
        near = raw[k - 1] + raw[(k + 1) % BINS]
        far = raw[k - 2] + raw[(k + 2) % BINS]
        smooth[k] = np.float32(0.375) * raw[k] + np.float32(0.25) * near + np.float32(0.0625) * far


@compiled
def orientations(level: Picture32, points: Floats, sigma_px: float, second: float) -> Floats:
    """Return index and direction (m, 2) of points, rad clockwise in the picture.

    A point has a direction for each peak of its histogram.

    Args:
        level: (rows, columns).
        points: (n, 2) pixels of the level.
        sigma_px: blur of the level.
        second: peaks this high count, as a share of the highest.
    """
    falloff = np.empty(round(3.0 * WINDOW * sigma_px) + 1, np.float32)
    for i in range(len(falloff)):
        falloff[i] = math.exp(-0.5 * (i / (WINDOW * sigma_px)) ** 2)
    bins = np.empty((2, BINS), np.float32)
    smooth = bins[1]
    found = np.empty((len(points) * BINS // 2, 2))
    count = 0
    for n in range(len(points)):
        _turns(level, round(points[n, 0]), round(points[n, 1]), falloff, bins)
        least = np.float32(second) * smooth.max()
        for k in range(BINS):
            here, left, right = smooth[k], smooth[k - 1], smooth[(k + 1) % BINS]
            if here >= least and here > left and here >= right:
                peak = k + 0.5 * (left - right) / (left - 2.0 * here + right)
                found[count, 0], found[count, 1] = n, (peak % BINS) * (2.0 * math.pi / BINS)
                count += 1
    return found[:count].copy()


@part
def _sampled(level: Picture32, keypoint: Floats, patch: Picture32) -> None:
    """Write the level's values on the keypoint's grid, which reaches one sample beyond."""
    rows, columns = level.shape
    side = len(patch)
    step = keypoint[3] * CELL * (CELLS + 1) / SAMPLES
    c, s = step * math.cos(keypoint[2]), step * math.sin(keypoint[2])
    middle = 0.5 * (side - 1)
    for j in range(side):
        u0 = keypoint[0] - middle * c - (j - middle) * s
        v0 = keypoint[1] - middle * s + (j - middle) * c
        for i in range(side):
            u = min(max(u0 + i * c, 0.0), columns - 1.001)
            v = min(max(v0 + i * s, 0.0), rows - 1.001)
            x, y = int(u), int(v)
            across, down = np.float32(u - x), np.float32(v - y)
            top = level[y, x] + across * (level[y, x + 1] - level[y, x])
            low = level[y + 1, x] + across * (level[y + 1, x + 1] - level[y + 1, x])
            patch[j, i] = top + down * (low - top)


@part
def _gradients(patch: Picture32, falloff: Picture32, strength: Picture32, turn: Picture32) -> None:
    """Write weighted length, and direction in turn bins: a vector operation."""
    for j in range(SAMPLES):
        for i in range(SAMPLES):
            dx = patch[j + 1, i + 2] - patch[j + 1, i]
            dy = patch[j + 2, i + 1] - patch[j, i + 1]
            strength[j, i] = np.sqrt(dx * dx + dy * dy) * (falloff[j] * falloff[i])
            turn[j, i] = _angle(dy, dx) * np.float32(TURNS / (2.0 * math.pi))


@part
def _gathered(strength: Picture32, turn: Picture32, at: Picture32, bins: Picture32) -> None:
    """Share each gradient among the two nearest cells of each axis and the two nearest turns."""
    bins[:] = 0.0
    for j in range(SAMPLES):
        b = int(at[j])
        down = at[j] - np.float32(b)
        for i in range(SAMPLES):
            a = int(at[i])
            across = at[i] - np.float32(a)
            k = int(turn[j, i])
            late = turn[j, i] - np.float32(k)
            k, after = k & (TURNS - 1), (k + 1) & (TURNS - 1)
            lower = strength[j, i] * down
            upper = strength[j, i] - lower
            w01, w11 = upper * across, lower * across
            w00, w10 = upper - w01, lower - w11
            bins[b, a, k] += w00 - w00 * late
            bins[b, a, after] += w00 * late
            bins[b, a + 1, k] += w01 - w01 * late
            bins[b, a + 1, after] += w01 * late
            bins[b + 1, a, k] += w10 - w10 * late
            bins[b + 1, a, after] += w10 * late
            bins[b + 1, a + 1, k] += w11 - w11 * late
            bins[b + 1, a + 1, after] += w11 * late


@part
def _rooted(bins: Picture32, row: Picture32) -> None:
    """Write the inner cells, capped, as the root of their shares: a unit row."""
    n = 0
    square = np.float32(0.0)
    for b in range(1, CELLS + 1):
        for a in range(1, CELLS + 1):
            for k in range(TURNS):
                row[n] = bins[b, a, k]
                square += row[n] * row[n]
                n += 1
    most = np.float32(CAP) * np.sqrt(square)
    total = np.float32(TINY)
    for n in range(len(row)):
        row[n] = min(row[n], most)
        total += row[n]
    for n in range(len(row)):
        row[n] = np.sqrt(row[n] / total)


@compiled
def descriptors(level: Picture32, keypoints: Floats) -> Picture32:
    """Return RootSIFT rows (n, 128) of unit length.

    Args:
        level: (rows, columns), blurred about as much as the keypoints.
        keypoints: (n, 4) x, y, direction in rad clockwise, blur; pixels of the level.
    """
    patch = np.empty((SAMPLES + 2, SAMPLES + 2), np.float32)
    strength = np.empty((SAMPLES, SAMPLES), np.float32)
    turn = np.empty((SAMPLES, SAMPLES), np.float32)
    bins = np.zeros((CELLS + 2, CELLS + 2, TURNS), np.float32)
    at, falloff = np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32)
    for i in range(SAMPLES):
        at[i] = (i + 0.5) * (CELLS + 1) / SAMPLES  # cells; the middle of the first inner one is 1
        falloff[i] = math.exp(-2.0 * ((at[i] - 0.5 * (CELLS + 1)) / CELLS) ** 2)
    rows = np.empty((len(keypoints), CELLS * CELLS * TURNS), np.float32)
    for n in range(len(keypoints)):
        _sampled(level, keypoints[n], patch)
        _gradients(patch, falloff, strength, turn)
        _gathered(strength, turn, at, bins)
        _rooted(bins, rows[n])
    return rows
