"""A mosaic too large to be held: the file holds what memory would have held, in its place."""

import logging
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_pictures import MOSAIC, fused_at_truth, layer_names, written

from groundfuse.frontend.mosaic import Mosaic
from groundfuse.frontend.mosaic_preview import Preview, reduction
from groundfuse.frontend.mosaic_tile import Tile
from groundfuse.frontend.sight import Grid
from groundfuse.tools import geotiff, pictures
from groundfuse.tools.errors import DataError, TeamError

rasterio = pytest.importorskip("rasterio", reason="needs the extra [geo]")

SMALL = replace(MOSAIC, m_per_px=0.004, tile_cells=geotiff.BLOCK)
LARGE = replace(SMALL, memory_cells=20_000)
"""The same mosaic, but memory is said to hold a fraction of it."""


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The mosaic held as a whole, the folder of the same one as a file, and the file's preview."""
    held, out = tmp_path_factory.mktemp("held"), tmp_path_factory.mktemp("file")
    fused = fused_at_truth()
    return written(held, fused, SMALL)[0], out, written(out, fused, LARGE)[0]


def tile_of(rows, columns, seed=1):
    rng = np.random.default_rng(seed)
    count = rng.integers(0, 3, (rows, columns)).astype(np.uint16)
    floor = rng.integers(1, 256, (rows, columns, 3)).astype(np.uint8) * (count > 0)[..., None]
    return Tile(floor.astype(np.uint8), floor.astype(np.uint8), count)


def test_the_file_holds_every_cell_in_its_place(both):
    held, out, _ = both
    with rasterio.open(out / "mosaic.tif") as file:
        place = file.transform
        assert (place.a, place.b, place.d, place.e) == (held.m_per_px, 0, 0, -held.m_per_px)
        left, top = (held.x_min_m - place.c) / place.a, (held.y_max_m - place.f) / place.e
        column, row = round(left), round(top)
        assert abs(left - column) + abs(top - row) < 1e-6  # trimmed by whole cells
        bands = file.read()
        names = [colour.name for colour in file.colorinterp]
    assert names == ["red", "green", "blue", "alpha"]
    rows, columns = held.count.shape
    part = bands[:, row : row + rows, column : column + columns]
    assert np.array_equal(part[:3].transpose(1, 2, 0)[..., ::-1], held.floor)
    assert np.array_equal(part[3], np.where(held.count > 0, 255, 0))
    assert (bands[3] > 0).sum() == (held.count > 0).sum()


def test_the_frame_is_local_and_in_metres(both):
    with rasterio.open(both[1] / "mosaic.tif") as file:
        text = file.crs.to_wkt()
        assert file.profile["tiled"]
        assert file.block_shapes[0] == (geotiff.BLOCK, geotiff.BLOCK)
        assert file.overviews(1) == [2, 4]
    assert text.startswith("LOCAL_CS")
    assert 'UNIT["metre",1' in text


def test_overviews_are_means_of_what_was_seen(both):
    with rasterio.open(both[1] / "mosaic.tif") as file:
        whole, half = file.read(), file.read(out_shape=(4, file.height // 2, file.width // 2))
    rows, columns = half.shape[1:]
    groups = whole[:, : 2 * rows, : 2 * columns].reshape(4, rows, 2, columns, 2)
    full = groups[3].min(axis=(1, 3)) == 255
    assert full.sum() > 1000
    error = np.abs(groups[:3].mean(axis=(2, 4)) - half[:3])[:, full]
    assert np.quantile(error, 0.99) <= 1.0  # rounding; odd sides shift some cells


def test_the_preview_is_the_mosaic_reduced(both):
    held, out, preview = both
    assert preview.count.size <= LARGE.memory_cells
    assert preview.m_per_px in {2 * held.m_per_px, 4 * held.m_per_px, 8 * held.m_per_px}
    assert {p.name for p in out.iterdir()} == layer_names("mosaic") | {"mosaic.tif"}
    picture = cv2.imread(str(out / "mosaic.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(picture[..., :3], preview.floor)
    seen_m2 = [(m.count > 0).sum() * m.m_per_px**2 for m in (held, preview)]
    assert seen_m2[0] <= seen_m2[1] < 1.1 * seen_m2[0]
    means = [m.floor[m.count > 0].mean() for m in (held, preview)]
    assert means[1] == pytest.approx(means[0], abs=1.0)


def test_a_preview_averages_what_was_seen_group_by_group():
    grid, tile = Grid(1.0, 2.0, 0.5, 10, 7), tile_of(10, 7)
    preview = Preview(grid, 4)
    preview.add((slice(0, 8), slice(0, 7)), Tile(tile.floor[:8], tile.mean[:8], tile.count[:8]))
    preview.add((slice(8, 10), slice(0, 7)), Tile(tile.floor[8:], tile.mean[8:], tile.count[8:]))
    found = preview.finished()
    assert isinstance(found, Mosaic)
    assert (found.x_min_m, found.y_max_m, found.m_per_px) == (1.0, 2.0, 2.0)
    assert found.count.shape == (3, 2)
    for row in range(3):
        for column in range(2):
            group = slice(4 * row, 4 * row + 4), slice(4 * column, 4 * column + 4)
            seen = tile.floor[group][tile.count[group] > 0]
            assert np.array_equal(found.floor[row, column], np.rint(seen.mean(axis=0)))
            assert found.count[row, column] == tile.count[group].max()


def test_the_reduction_is_the_least_power_of_two_that_suffices():
    grid = Grid(0.0, 0.0, 1.0, 1000, 1000)
    for most, factor in ((10**6, 1), (10**6 - 1, 2), (250_000, 2), (249_999, 4), (1, 256)):
        assert reduction(grid, most, 256) == factor


def test_an_older_runs_file_goes(tmp_path):
    (tmp_path / "mosaic.tif").write_text("old")
    written(tmp_path, fused_at_truth(), SMALL)
    assert not (tmp_path / "mosaic.tif").exists()


def test_without_rasterio_cells_are_larger_and_one_line_says_so(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(pictures, "can_write", lambda: False)
    options = replace(LARGE, m_per_px=None)
    with caplog.at_level(logging.WARNING):
        mosaic = written(tmp_path, fused_at_truth(), options)[0]
    assert mosaic.count.size <= LARGE.memory_cells
    (line,) = caplog.messages
    assert "mosaic.tif: not written: " in line
    assert line.endswith(
        "need rasterio (pip install groundfuse[geo]); mosaic.png has larger cells, "
        f"{mosaic.m_per_px:g} m"
    )
    assert {p.name for p in tmp_path.iterdir()} == layer_names("mosaic")
    with pytest.raises(TeamError, match="exceeds max_cells 20000: raise m_per_px"):
        written(tmp_path, fused_at_truth(), LARGE)


def test_a_failure_leaves_nothing_behind(tmp_path):
    grid = Grid(0.0, 0.0, 0.5, 300, 300)

    def fail():
        with geotiff.new_geotiff(tmp_path / "x.tif", grid) as file:
            file.add((slice(0, 256), slice(0, 256)), tile_of(256, 256))
            raise ValueError("no floor")

    with pytest.raises(ValueError, match="no floor"):
        fail()
    assert not list(tmp_path.iterdir())
    (tmp_path / "y.tif").mkdir()
    with (
        pytest.raises(DataError, match=r"y\.tif: cannot write: "),
        geotiff.new_geotiff(tmp_path / "y.tif", grid),
    ):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["y.tif"]


SPARSE = """
import resource, sys
from pathlib import Path
import numpy as np
from groundfuse.frontend.mosaic_tile import Tile
from groundfuse.frontend.sight import Grid
from groundfuse.tools.geotiff import new_geotiff
grid = Grid(0.0, 0.0, 0.001, 8_192, 8_192)
with new_geotiff(Path(sys.argv[1]), grid) as file:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(32):
        count = np.full((256, 256), 3, np.uint16)
        colour = np.full((256, 256, 3), 100 + k, np.uint8)
        block = slice(256 * k, 256 * k + 256), slice(256 * k, 256 * k + 256)
        file.add(block, Tile(colour, colour, count))
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) // 1024)
"""


def test_a_large_sparse_mosaic_takes_little_memory_and_disk(tmp_path):
    """8192 x 8192 cells would be 268 MB with their alpha; the cache is bounded by 64 MB."""
    ran = subprocess.run(
        [sys.executable, "-c", SPARSE, str(tmp_path / "x.tif")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert int(ran.stdout) < 200
    assert (tmp_path / "x.tif").stat().st_size < 3_000_000
    with rasterio.open(tmp_path / "x.tif") as file:
        assert file.shape == (8_192, 8_192)
        last = file.read(1, window=((7_936, 8_192), (7_936, 8_192)))
    assert (last == 131).all()
