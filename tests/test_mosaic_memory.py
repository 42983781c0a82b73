"""The parts of a mosaic stay in the store while a mosaic has them, and not longer."""

import dataclasses
import sqlite3

import pytest
from painted_team import copied_pair
from test_pictures import FRAMES, MOSAIC, fused_at_truth

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.mosaic_plan import Layout
from groundfuse.tools import mosaic_memory, pictures
from groundfuse.tools.mosaic_memory import KIND, MosaicMemory
from groundfuse.tools.pipeline import Stopwatch
from groundfuse.tools.store import Store

LAYOUT = Layout({"A": 0.001}, 3)


def labels(path):
    base = sqlite3.connect(path)
    try:
        found = base.execute("SELECT kind, label FROM entry ORDER BY kind, label").fetchall()
    finally:
        base.close()
    return found


def known(fused):
    """With a digest for each picture, as the front-end has them."""
    digests = {frame: str(frame).encode() for frame in fused.best.team_from_base}
    front = dataclasses.replace(fused.front_end, pictures=digests)
    return dataclasses.replace(fused, front_end=front)


def written(out, fused, store, options=MOSAIC):
    pictures.write_mosaics(out, fused, options, 2, Stopwatch(), quiet=True, store=store)
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_parts_come_back_by_mosaic_and_name():
    with Store() as store:
        memory = MosaicMemory(store)
        memory.of("mosaic").save("layout", LAYOUT)
        assert memory.of("mosaic").load("layout") == LAYOUT
        assert memory.of("mosaic").load("tile 0 0") is None
        assert list(memory.of("mosaic").load_all(["tile 0 0", "layout"])) == [None, LAYOUT]
        assert memory.of("mosaic_1").load("layout") is None
        assert MosaicMemory(store).of("mosaic").load("layout") == LAYOUT


def test_what_other_code_rendered_is_not_found_and_goes(tmp_path, monkeypatch):
    path = tmp_path / "store.sqlite"
    with Store(path) as store:
        store.save(b"key", "other", "kind", b"value")
        first = MosaicMemory(store)
        for name in ("layout", "tile 0 0"):
            first.of("mosaic").save(name, LAYOUT)
        second = MosaicMemory(store)
        assert second.of("mosaic").load("layout") == LAYOUT
        second.of("mosaic_1").save("layout", LAYOUT)
        second.forget_others()
    assert labels(path) == [(KIND, "mosaic: layout"), (KIND, "mosaic_1: layout"), ("other", "kind")]
    monkeypatch.setattr(mosaic_memory, "code_of", lambda *_: "other")
    with Store(path) as store:
        third = MosaicMemory(store)
        assert third.of("mosaic").load("layout") is None
        third.forget_others()
    assert labels(path) == [("other", "kind")]


def test_the_next_run_reads_no_picture_and_writes_the_same(tmp_path):
    team = copied_pair(tmp_path / "team")
    fused = known(fused_at_truth(team))
    with Store(tmp_path / "store.sqlite") as store:
        first = written(tmp_path / "out", fused, store)
    before = labels(tmp_path / "store.sqlite")
    for picture in team.glob("*/images/*"):
        picture.unlink()
    with Store(tmp_path / "store.sqlite") as store:
        assert written(tmp_path / "again", fused, store) == first
    assert labels(tmp_path / "store.sqlite") == before
    assert written_without_store(tmp_path / "plain", known(fused_at_truth())) == first


def written_without_store(out, fused):
    return written(out, fused, None)


def test_a_file_of_tiles_is_the_same_from_a_store(tmp_path):
    pytest.importorskip("rasterio")
    large = dataclasses.replace(MOSAIC, memory_cells=20_000, m_per_px=0.004)
    with Store() as store:
        first = written(tmp_path / "out", known(fused_at_truth()), store, large)
        assert written(tmp_path / "again", known(fused_at_truth()), store, large) == first
    assert "mosaic.tif" in first


def test_tiles_of_a_part_that_left_are_forgotten(tmp_path):
    path = tmp_path / "store.sqlite"
    with Store(path) as store:
        written(tmp_path / "two", known(fused_at_truth(overlaps=())), store)
    assert any(label.startswith("mosaic_1: ") for _, label in labels(path))
    with Store(path) as store:
        written(tmp_path / "one", known(fused_at_truth()), store)
    assert not any(label.startswith("mosaic_1: ") for _, label in labels(path))
    assert {label for _, label in labels(path) if "samples" in label} == {
        f"mosaic: samples of {frame}" for frames in FRAMES.values() for frame in frames
    }


def test_a_robot_that_moved_is_rendered_anew(tmp_path):
    fused = known(fused_at_truth())
    shift = Se2(0.05, 0.0, 0.0)
    poses = {f: shift @ p for f, p in fused.best.team_from_base.items()}
    moved = dataclasses.replace(fused, team=dataclasses.replace(fused.team, team_from_base=poses))
    with Store() as store:
        first = written(tmp_path / "out", fused, store)
        second = written(tmp_path / "again", moved, store)
    assert second != first
    assert second == written_without_store(tmp_path / "plain", moved)
