"""Pictures are read between their pixels as OpenCV reads them, and averaged over cells."""

import cv2
import numpy as np
import pytest
from analytic_floor import make_camera

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.overhead import rays_from_floor
from groundfuse.frontend.pyramid import pyramid
from groundfuse.frontend.reading_compiled import PHASES, read_cells
from groundfuse.frontend.sight import Grid, sight

# A place is rounded to 1/1024 px along each axis; noise of 0 to 255 has slopes of up to 255 x 2 a
# pixel there: 2 x 0.5 levels.  Worst seen 0.39.
TOLERANCE_LEVELS = 2.0 * 255.0 * 2.0 / (2 * PHASES)
# Central differences over six cells of 2 mm, kept in single precision: worst seen 9e-6.
TOLERANCE_SLOPE = 5e-5
PICTURE = np.random.default_rng(2).integers(0, 256, (90, 70, 3), dtype=np.uint8)


def means_at(px, slopes, level, places):
    made = pyramid(PICTURE, 1)
    place = np.column_stack([px, np.ones_like(px)]).astype(np.float32)
    colours = np.empty((len(px), 3), np.float32)
    reading = np.array([[[level, places]]], np.uint8)
    of_cells = np.asarray(slopes, np.float32).reshape(1, 1, 4)
    nearest = np.zeros((len(px), 2), np.int32)
    read_cells((made.levels, made.table), (of_cells, reading), nearest, place, colours)
    return made.level(level)[..., :3], colours


def bicubic(picture, px):
    maps = px.astype(np.float32)[None]
    floats = np.ascontiguousarray(picture).astype(np.float32)
    border = cv2.BORDER_REPLICATE
    return cv2.remap(floats, maps, None, cv2.INTER_CUBIC, borderMode=border)[0]


@pytest.mark.parametrize("level", [0, 1])
def test_one_place_is_what_opencv_reads_there(level):
    px = np.random.default_rng(level).uniform([-1.5, -1.5], [71.0, 91.0], (4000, 2))
    picture, found = means_at(px, np.zeros(4), level, 1)
    expected = np.clip(bicubic(picture, px / 2**level), 0, 255)
    # OpenCV 4 rounds places to 1/32 px: 16 times as much.
    rounding = 16.0 if cv2.__version__ < "5" else 1.0
    assert np.abs(found - expected).max() < rounding * TOLERANCE_LEVELS


def test_a_cell_is_the_mean_of_places_spread_over_it():
    px = np.random.default_rng(3).uniform([6.0, 6.0], [60.0, 80.0], (500, 2))
    right, down = np.array([1.7, 0.4]), np.array([-0.9, 1.2])
    picture, found = means_at(px, np.concatenate([right, down]), 0, 3)
    steps = (np.arange(3) + 0.5) / 3 - 0.5
    parts = [bicubic(picture, px + a * right + b * down) for a in steps for b in steps]
    expected = np.clip(np.mean(parts, axis=0), 0, 255)
    rounding = 16.0 if cv2.__version__ < "5" else 1.0
    assert np.abs(found - expected).max() < rounding * TOLERANCE_LEVELS


def test_where_halvings_run_out_more_places_are_read():
    px = np.random.default_rng(4).uniform([20.0, 20.0], [50.0, 60.0], (50, 2))
    slopes = np.array([8.0, 0.0, 0.0, 8.0])
    made = pyramid(PICTURE, 0)
    place = np.column_stack([px, px]).astype(np.float32)
    nearest = np.zeros((50, 2), np.int32)
    read = []
    for reading in ((1, 2), (0, 4)):
        colours = np.empty((50, 3), np.float32)
        way = np.array([[reading]], np.uint8)
        known = slopes.astype(np.float32).reshape(1, 1, 4), way
        read_cells((made.levels, made.table), known, nearest, place, colours)
        read.append(colours)
    assert np.array_equal(*read)


def test_slopes_lead_to_the_next_cell_and_the_one_below():
    camera, attitude, pose = make_camera(size=(640, 480)), Attitude(0.5, 0.04, 0.55), Se2(0.2, 0, 2)
    grid = Grid(-0.3, 0.9, 0.002, 200, 200)
    found = sight(camera, attitude, pose, grid, 9.0)

    def px(row, column):
        """Of places in cells from the grid's corner."""
        x, y = grid.x_min_m + column * grid.m_per_px, grid.y_max_m - row * grid.m_per_px
        rays = rays_from_floor(attitude, pose.inverse().apply(np.column_stack([x, y])))
        return camera.intrinsics.px_from_rays(rays)

    i, j = (part.ravel() for part in np.mgrid[5:50, 5:50])
    row, column = (
        first + found.step * (index + 0.5)
        for first, index in ((found.first_row, i), (found.first_column, j))
    )
    expected = np.hstack(
        [
            px(row, column + 0.5) - px(row, column - 0.5),
            px(row + 0.5, column) - px(row - 0.5, column),
        ]
    )
    got, seen = found.slopes[i, j], np.isfinite(expected).all(axis=1)
    seen &= (found.lattice[i, j, :2] > 0).all(axis=1) & (found.lattice[i, j, 2] < 3.0)
    assert seen.sum() > 300
    assert np.abs(got[seen] - expected[seen]).max() < TOLERANCE_SLOPE
