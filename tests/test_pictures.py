"""Pictures in the out folder show the floor where the world file says, component by component."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from fused_world import bundle_of, chain, edge, fused_of
from painted_team import CELL_M, HEIGHT_M, PAIR, QUICK, copied_pair, painted_floor, painted_pair

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.mosaic import Mosaic, MosaicOptions
from groundfuse.frontend.overhead_view import OverheadOptions, overhead_grid
from groundfuse.tools import pictures
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.pipeline import Stopwatch
from groundfuse.tools.settings import with_settings
from groundfuse.tools.team_folder import read_team

MOSAIC = with_settings(RunOptions(), QUICK).mosaic
FRAMES = {n: [FrameId(n, k) for k in range(len(m.poses))] for n, m in PAIR.items()}
TRUTH = {f: p for n, m in PAIR.items() for f, p in zip(FRAMES[n], m.poses, strict=True)}


def fused_at_truth(folder=None, overlaps=((1, 0), (2, 1), (3, 2))):
    """A painted team whose poses are the true ones, and whose attitudes are the nominal ones."""
    robots = read_team(folder or painted_pair(), list(PAIR))
    edges = [*chain(TRUTH, FRAMES["A"]), *chain(TRUTH, FRAMES["B"])]
    edges += [edge(TRUTH, FRAMES["A"][i], FRAMES["B"][j]) for i, j in overlaps]
    return fused_of(robots, edges)


def written(out, fused, options=MOSAIC):
    watch = Stopwatch()
    mosaics = pictures.write_mosaics(out, fused, options, 2, watch, quiet=True)
    assert list(watch.seconds) == ["mosaic", "writing"]
    return mosaics


def decoded(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def layer_names(stem):
    return {
        f"{stem}{part}.{kind}"
        for part in ("", "_mean", "_count", "_few")
        for kind in ("png", "pgw")
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("mosaic")
    fused = fused_at_truth()
    return out, written(out, fused), fused


def small_mosaic():
    rng = np.random.default_rng(3)
    count = np.array([[0, 1, 2], [3, 15, 40]], dtype=np.uint16)
    return Mosaic(
        floor=rng.integers(0, 256, (2, 3, 3), dtype=np.uint8),
        mean=rng.integers(0, 256, (2, 3, 3), dtype=np.uint8),
        count=count,
        uncertain=(count > 0) & (count < 3),
        x_min_m=-1.5,
        y_max_m=2.25,
        m_per_px=0.5,
    )


def metres_of(text, column, row):
    """As a GIS reads a world file: A, D, B, E, C, F."""
    a, d, b, e, c, f = map(float, text.split())
    return a * column + b * row + c, d * column + e * row + f


def test_a_world_file_takes_pixel_centres_to_metres():
    text = pictures.world_file(small_mosaic())
    assert len(text.splitlines()) == 6
    assert metres_of(text, 0, 0) == (-1.25, 2.0)
    assert metres_of(text, 2, 1) == (-0.25, 1.5)


def test_layers_decode_to_what_they_show(made):
    out, mosaics, _ = made
    mosaic = mosaics[0]
    assert list(mosaics) == [0]
    assert {p.name for p in out.iterdir()} == layer_names("mosaic")
    for name, layer in (("mosaic.png", mosaic.floor), ("mosaic_mean.png", mosaic.mean)):
        picture = decoded(out / name)
        assert np.array_equal(picture[..., :3], layer)
        assert np.array_equal(picture[..., 3], np.where(mosaic.count > 0, 255, 0))
    assert np.array_equal(decoded(out / "mosaic_few.png") > 0, mosaic.uncertain)
    assert set(np.unique(decoded(out / "mosaic_few.png"))) <= {0, 255}
    count = decoded(out / "mosaic_count.png")
    assert np.array_equal(count, 16 * mosaic.count)
    for name in layer_names("mosaic"):
        if name.endswith(".pgw"):
            assert (out / name).read_text() == pictures.world_file(mosaic)


def test_counts_too_high_for_a_grey_value_stay_white(tmp_path):
    for write in pictures._layers(tmp_path, "x", small_mosaic()):
        write()
    assert decoded(tmp_path / "x_count.png").tolist() == [[0, 16, 32], [48, 240, 255]]
    assert decoded(tmp_path / "x_few.png").tolist() == [[0, 255, 255], [0, 0, 0]]


def test_the_mosaic_is_the_floor_where_the_world_file_puts_it(made):
    """Against the painted floor, averaged to the mosaic's cells: likest in place, to a fraction.

    Half a cell is what a mix-up of edges and centres would make; nominal instead of true
    attitudes leave 0.06 cells (0.6 mm).
    """
    out, _, fused = made
    picture = decoded(out / "mosaic.png")[..., :3].astype(float).mean(axis=2)
    count = decoded(out / "mosaic_count.png") // 16
    text = (out / "mosaic.pgw").read_text()
    floor = painted_floor(1).mean(axis=2)
    cells = 2 * round(MOSAIC.m_per_px / CELL_M / 2.0) + 1
    smooth = cv2.blur(floor, (cells, cells))
    rows, columns = np.nonzero(count >= 3)
    first = TRUTH[FRAMES["A"][0]]  # the team's frame is that of A0

    def likeness(shift_columns, shift_rows):
        x, y = metres_of(text, columns + shift_columns, rows + shift_rows)
        at = first.apply(np.column_stack([x, y])) / CELL_M + floor.shape[0] / 2
        maps = at.astype(np.float32)[None]
        wanted = cv2.remap(smooth, maps, None, cv2.INTER_LINEAR)[0]
        return float(np.corrcoef(wanted, picture[rows, columns])[0, 1])

    assert fused.best.team_from_base[FRAMES["A"][0]] == Se2(0.0, 0.0, 0.0)
    here = likeness(0, 0)
    assert here > 0.9
    for along in ((1, 0), (0, 1)):
        before, after = likeness(-along[0], -along[1]), likeness(*along)
        assert max(before, after) < 0.9 * here
        off_cells = 0.5 * (before - after) / (before - 2.0 * here + after)
        assert abs(off_cells) < 0.25


def test_the_bundles_attitudes_are_used(made, tmp_path):
    """Every camera 8 % higher: the floor grows as much."""
    out, mosaics, plain = made
    higher = {
        f: replace(frame.attitude, height_m=1.08 * HEIGHT_M)
        for f, (_, frame) in plain.frames.items()
    }
    fused = replace(plain, bundled=bundle_of(plain.team, attitude=higher))
    wider = written(tmp_path, fused)[0]
    assert (wider.count > 0).sum() > 1.08 * (mosaics[0].count > 0).sum()
    assert (out / "mosaic.png").read_bytes() != (tmp_path / "mosaic.png").read_bytes()


def test_parts_that_never_met_have_a_mosaic_each(tmp_path):
    fused = fused_at_truth(overlaps=())
    mosaics = written(tmp_path, fused)
    assert list(mosaics) == [0, 1]
    assert {p.name for p in tmp_path.iterdir()} == layer_names("mosaic") | layer_names("mosaic_1")
    alone = fused_at_truth()
    assert mosaics[0].count.sum() + mosaics[1].count.sum() > 0
    assert fused.best.component_of[FRAMES["B"][0]] == 1
    assert mosaics[0].count.max() <= len(FRAMES["A"])
    assert mosaics[1].count.max() <= len(FRAMES["B"])
    assert alone.best.component_of[FRAMES["B"][0]] == 0


def test_more_is_written_beside_a_mosaic_and_its_failure_is_told(tmp_path):
    fused, seen = fused_at_truth(overlaps=()), []
    watch = Stopwatch()

    def note(component, mosaic):
        seen.append((component, mosaic))

    def fail(component, _):
        raise DataError(f"no room for {component}")

    for kind in ("longer", "shorter"):
        seen.clear()
        how = {"quiet": True, kind: (note,)}
        mosaics = pictures.write_mosaics(tmp_path, fused, MOSAIC, 2, watch, **how)
        assert seen == list(mosaics.items())
        how[kind] = (note, fail)
        with pytest.raises(DataError, match="no room for 0"):
            pictures.write_mosaics(tmp_path, fused, MOSAIC, 2, watch, **how)


def test_what_a_mosaic_refuses_is_one_line_that_names_the_part(tmp_path):
    fused = fused_at_truth()
    options = MosaicOptions(m_per_px=0.01, max_cells=100)
    with pytest.raises(TeamError, match=r"^mosaic of component 0: a mosaic of \d+ x \d+ cells of"):
        written(tmp_path, fused, options)
    assert not list(tmp_path.iterdir())


def test_a_picture_that_vanished_meanwhile_is_named(tmp_path):
    team = copied_pair(tmp_path / "team")
    fused = fused_at_truth(team)
    (team / "A" / "images" / "img_01.png").unlink()
    with pytest.raises(DataError, match=r"A/images/img_01\.png: cannot read: No such file"):
        written(tmp_path / "out", fused)


def test_every_frame_has_an_overhead_view_of_its_own(tmp_path):
    fused, options = fused_at_truth(), OverheadOptions(cell_per_height=0.01)
    pictures.write_overheads(tmp_path, fused, options)
    names = {p.name for p in (tmp_path / "overhead").iterdir()}
    assert names == {f"{frame}.png" for frame in TRUTH}
    for frame, (robot, known) in fused.frames.items():
        grid = overhead_grid(robot.camera, known.attitude, options)
        view = decoded(tmp_path / "overhead" / f"{frame}.png")
        assert view.shape == (grid.height_px, grid.width_px, 3)
        assert (view > 0).any()


def test_every_part_has_a_location_graph_as_large_as_its_mosaic_at_least(tmp_path):
    fused = fused_at_truth(overlaps=())
    mosaics = written(tmp_path, fused)
    for component, stem in ((0, "location_graph"), (1, "location_graph_1")):
        pictures.write_location_graph(tmp_path, fused, component, mosaics[component])
        picture = decoded(tmp_path / f"{stem}.png")
        assert picture.ndim == 3
        rows, columns = mosaics[component].floor.shape[:2]
        assert picture.shape[0] >= rows
        assert picture.shape[1] >= columns
