"""A mosaic of any size as a tiled GeoTIFF with overviews, in metres of the team's own frame.

The frame is nobody's map projection, so the file says just that: a local frame in metres (an
engineering reference system), which QGIS and GDAL open in its place. Cells that nothing was seen
in are transparent; tiles without any such cell take no room.
"""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from groundfuse.frontend.mosaic_plan import Block
from groundfuse.frontend.mosaic_tile import Tile
from groundfuse.frontend.sight import Grid
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import make_folder

BLOCK = 256
"""Cells a side of the file's own tiles."""
SMALLEST_OVERVIEW = 256
GDAL_CACHE_MB = 64
FRAME = (
    'LOCAL_CS["groundfuse team frame",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)


def can_write() -> bool:
    """Tell whether rasterio (`pip install groundfuse[geo]`) is there."""
    return find_spec("rasterio") is not None


class GeoTiff:
    """A file that takes tiles; see `new_geotiff`."""

    def __init__(self, file: Any) -> None:  # noqa: ANN401
        """Take rasterio's open file."""
        self._file = file

    def add(self, block: Block, tile: Tile) -> None:
        """Write one tile whose place is a multiple of `BLOCK`."""
        rows, columns = block
        alpha = np.where(tile.count > 0, 255, 0).astype(np.uint8)
        bands = np.concatenate([tile.floor[..., ::-1], alpha[..., None]], axis=2)
        window = ((rows.start, rows.stop), (columns.start, columns.stop))
        self._file.write(np.ascontiguousarray(bands.transpose(2, 0, 1)), window=window)


@contextmanager
def new_geotiff(path: Path, grid: Grid) -> Iterator[GeoTiff]:
    """Open a new file for tiles; at the end it gets overviews and its name, whole or not at all.

    Raises:
        DataError: it can't be written.
    """
    import rasterio  # noqa: PLC0415 - an extra, and slow to load
    from rasterio.errors import RasterioError  # noqa: PLC0415

    part = make_folder(path.parent) / f".{secrets.token_hex(8)}.part.tif"
    try:
        # Threads only deflate: the bytes are those of one.
        with rasterio.Env(
            GDAL_CACHEMAX=GDAL_CACHE_MB, GDAL_NUM_THREADS="ALL_CPUS", GDAL_PAM_ENABLED=False
        ):
            with rasterio.open(part, "w", **_profile(grid)) as file:
                yield GeoTiff(file)
            _add_overviews(part, grid)
        part.replace(path)
    except (RasterioError, OSError) as error:
        raise DataError(f"{path}: cannot write: {error}") from error
    finally:
        part.unlink(missing_ok=True)


def _profile(grid: Grid) -> dict[str, Any]:
    from rasterio import Affine  # noqa: PLC0415
    from rasterio.crs import CRS  # noqa: PLC0415

    return {
        "driver": "GTiff",
        "width": grid.columns,
        "height": grid.rows,
        "count": 4,
        "dtype": "uint8",
        "crs": CRS.from_wkt(FRAME),
        "transform": Affine(grid.m_per_px, 0.0, grid.x_min_m, 0.0, -grid.m_per_px, grid.y_max_m),
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": BLOCK,
        "compress": "deflate",
        "predictor": 2,
        "photometric": "RGB",
        "alpha": "YES",
        "sparse_ok": True,
        "bigtiff": "IF_SAFER",
    }


def _add_overviews(path: Path, grid: Grid) -> None:
    """Add halvings down to one block, each the mean of what was seen."""
    import rasterio  # noqa: PLC0415
    from rasterio.enums import Resampling  # noqa: PLC0415

    factors, factor = [], 2
    while max(grid.rows, grid.columns) * 2 > SMALLEST_OVERVIEW * factor:
        factors.append(factor)
        factor *= 2
    if factors:
        options: dict[str, Any] = {"COMPRESS_OVERVIEW": "DEFLATE", "SPARSE_OK_OVERVIEW": "ON"}
        with rasterio.Env(**options), rasterio.open(path, "r+") as file:
            file.build_overviews(factors, Resampling.average)
