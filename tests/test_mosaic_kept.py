"""A mosaic of a team that grew renders what changed, and an interruption changes nothing."""

import dataclasses
import math

import numpy as np
import pytest
from analytic_floor import make_camera, ring, rounded, view_of, waves

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend import made_from, mosaic_stream
from groundfuse.frontend.kept_parts import MOST_PATCHES, Patch, _from, _pasted
from groundfuse.frontend.mosaic import MosaicOptions, planned_mosaic
from groundfuse.frontend.mosaic_plan import Layout, plan_mosaic
from groundfuse.frontend.mosaic_tile import Tile
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor

CAMERA = make_camera(30.0)
CELL_M = 0.02
OPTIONS = MosaicOptions(m_per_px=CELL_M, tile_cells=8, compensate=False)
LIGHT = dataclasses.replace(OPTIONS, compensate=True)
# Two solves of 3 x 3 matrices whose condition is below 100, at coordinates of a few metres:
# 2 x 100 x 2.2e-16 x 4.  Worst seen 9e-16.
TOLERANCE_SHIFT_M = 2e-13


class Parts(dict):
    """A memory; the power fails when `left` more parts have been saved."""

    def __init__(self, parts=(), left=math.inf):
        super().__init__(parts)
        self.left, self.saved = left, []

    def load(self, name):
        return self.get(name)

    def load_all(self, names):
        return map(self.get, names)

    def save(self, name, part):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        self.saved.append(name)
        self[name] = part

    def tiles_saved(self):
        return {name for name in self.saved if name.startswith("tile")}


def team(number=5, robot="A", x_m=0.0):
    """Views from around a spot, each of its own brightness."""

    def colour(points):
        return waves(points, 0.2)

    return [
        dataclasses.replace(
            view_of(frame, CAMERA, Se2(x_m, 0.0, 0.0) @ pose, rounded(image * (0.8 + 0.05 * i))),
            digest=str(frame).encode(),
        )
        for i, (frame, pose, image) in enumerate(ring(number, CAMERA, colour, robot=robot))
    ]


def moved(views, number, cells):
    """The same views, one of them moved along x."""
    shift = Se2(cells * CELL_M, 0.0, 0.0)
    view = views[number]
    other = dataclasses.replace(view, team_from_base=shift @ view.team_from_base)
    return [*views[:number], other, *views[number + 1 :]]


def made(views, options=OPTIONS, parts=None):
    earlier = None if parts is None else parts.get("layout")
    plan = plan_mosaic(views, options, earlier)
    if parts is not None:
        parts.save("layout", plan.layout)
    return planned_mosaic(plan, dataclasses.replace(options, workers=1), None, parts)


def is_equal(a, b):
    return (a.x_min_m, a.y_max_m) == (b.x_min_m, b.y_max_m) and all(
        np.array_equal(getattr(a, layer), getattr(b, layer)) for layer in ("floor", "mean", "count")
    )


def unreadable(view):
    def load():
        raise AssertionError(f"{view.frame} is loaded again")

    return dataclasses.replace(view, load=load)


@pytest.mark.parametrize("options", [OPTIONS, LIGHT])
def test_nothing_is_rendered_twice(options):
    views, parts = team(), Parts()
    first = made(views, options, parts)
    assert is_equal(first, made(views, options))
    again = made([unreadable(view) for view in views], options, parts)
    assert is_equal(first, again)


def test_a_team_that_grows_in_all_directions_renders_only_where_it_grew():
    views, parts = team(), Parts()
    made(views, OPTIONS, parts)
    before = parts.tiles_saved()
    for x_m in (-2.0, 2.0):
        parts.saved.clear()
        views = [*views, *team(2, robot="B" if x_m < 0 else "C", x_m=x_m)]
        readable = [v if v.frame.robot != "A" else unreadable(v) for v in views]
        assert is_equal(made(readable, OPTIONS, parts), made(views))
        assert parts.tiles_saved()
        assert not parts.tiles_saved() & before


def test_a_new_view_renders_its_own_tiles():
    views, parts = team(), Parts()
    made(views[:-1], OPTIONS, parts)
    every = parts.tiles_saved()
    parts.saved.clear()
    assert is_equal(made(views, OPTIONS, parts), made(views))
    assert parts.tiles_saved()
    assert every - parts.tiles_saved()


WIDE = dataclasses.replace(OPTIONS, tile_cells=128)
"""Tiles that a view shows a small part of."""


def tiles_of(parts):
    return [part for name, part in parts.items() if name.startswith("tile")]


def test_a_new_view_renders_only_the_cells_around_it(monkeypatch):
    """The view of A is not looked at again, although it lies in the same tiles."""
    rendered = []
    work = mosaic_stream._tile

    def counted(scene, block, shown):
        rendered.append((block[0].stop - block[0].start) * (block[1].stop - block[1].start))
        return work(scene, block, shown)

    first, second = team(1), team(1, robot="B", x_m=1.2)
    parts = Parts()
    made(first, WIDE, parts)
    monkeypatch.setattr(mosaic_stream, "_tile", counted)
    found = made([unreadable(first[0]), *second], WIDE, parts)
    assert is_equal(found, made([*first, *second], WIDE))
    (extent,) = plan_mosaic(second, WIDE).extents
    num_cells = (extent.rows.stop - extent.rows.start) * (
        extent.columns.stop - extent.columns.start
    )
    assert sum(rendered[: len(tiles_of(parts))]) == num_cells
    assert all(len(tile.patches) == 1 for tile in tiles_of(parts))
    parts.saved.clear()
    nothing_new = [unreadable(view) for view in (*first, *second)]
    assert is_equal(made(nothing_new, WIDE, parts), found)
    assert not parts.tiles_saved()


def test_new_views_beside_and_over_each_other_end_as_one_mosaic():
    """One after the other, each patches what was patched before; too many, and all is made anew."""
    views, parts, numbers = team(12), Parts(), []
    for number in range(2, 13):
        made(views[:number], WIDE, parts)
        numbers.append(max(len(tile.patches) for tile in tiles_of(parts)))
    assert is_equal(made(views, WIDE, parts), made(views, WIDE))
    assert max(numbers) == MOST_PATCHES
    assert numbers[-1] < MOST_PATCHES


@pytest.mark.parametrize(("cells", "stays"), [(0.05, True), (-0.03, False)])
def test_a_patch_is_judged_by_what_it_was_rendered_with(cells, stays):
    """The first view has moved by 0.08 cells when the new one joins, and not when the rest was."""
    views, parts = team(), Parts()
    made(views[:-1], WIDE, parts)
    near = moved(views, 0, 0.08)
    first = made(near, WIDE, parts)
    assert not is_equal(first, made(near, WIDE))  # the rest is not renewed
    assert not is_equal(first, made(views, WIDE))  # the patch is
    parts.saved.clear()
    after = moved(views, 0, cells)
    assert is_equal(made(after, WIDE, parts), first) == stays
    assert bool(parts.tiles_saved()) != stays


def test_a_view_that_was_only_patched_in_and_is_gone_leaves_nothing():
    views, parts = team(), Parts()
    made(views[:-1], WIDE, parts)
    made(views, WIDE, parts)
    assert any(tile.patches for tile in tiles_of(parts))
    assert is_equal(made(views[:-1], WIDE, parts), made(views[:-1], WIDE))


def test_the_cells_of_a_patch_stay_where_its_tile_is():
    """A grid that grew has the tile at other rows and columns."""
    block, box = (slice(8, 16), slice(16, 24)), (slice(9, 11), slice(18, 21))
    patch = Patch(_from(block, box), record())
    assert patch.cells == (1, 3, 2, 5)
    assert patch.within(block) == box
    assert patch.within((slice(0, 8), slice(40, 48))) == (slice(1, 3), slice(42, 45))


def test_floor_that_no_view_saw_is_patched_in():
    """Tiles of which nothing was seen are kept, too: far floor of the one is near for the other."""
    block, cells = (slice(8, 12), slice(4, 10)), (1, 3, 2, 5)
    new = Tile(
        np.full((2, 3, 3), 7, np.uint8), np.full((2, 3, 3), 8, np.uint8), np.ones((2, 3), np.uint16)
    )
    found = _pasted(None, block, new, cells)
    assert found.floor.shape == found.mean.shape == (4, 6, 3)
    np.testing.assert_array_equal(np.argwhere(found.count), np.argwhere(found.floor[..., 0]))
    assert found.count[1:3, 2:5].all()
    assert found.count.sum() == 6
    assert _pasted(found, block, None, cells) is found
    assert _pasted(None, block, None, cells) is None
    again = _pasted(found, block, Tile(new.mean, new.floor, new.count), (0, 2, 2, 5))
    assert (found.floor[1:3, 2:5] == 7).all()  # what it was pasted on stays as it was
    assert (again.floor[0:2, 2:5] == 8).all()
    assert (again.floor[2, 2:5] == 7).all()


def test_only_what_is_new_or_moved_is_sampled():
    views, parts = team(), Parts()
    made(views[:-1], LIGHT, parts)
    parts.saved.clear()
    first, *others = views
    other = dataclasses.replace(first, digest=b"another")
    made(moved(moved([other, *others], 2, 0.2), 3, 0.02), LIGHT, parts)
    sampled = {name for name in parts.saved if name.startswith("samples")}
    assert sampled == {f"samples of {views[k].frame}" for k in (0, 2, -1)}


@pytest.mark.parametrize(("cells", "stays"), [(0.09, True), (0.11, False)])
def test_a_small_move_renders_nothing(cells, stays):
    views, parts = team(), Parts()
    first = made(views, OPTIONS, parts)
    parts.saved.clear()
    other = moved(views, 2, cells)
    again = made(other, OPTIONS, parts)
    assert is_equal(again, first) == stays
    assert is_equal(again, made(other)) != stays
    assert bool(parts.tiles_saved()) != stays


def test_a_turn_renders_what_is_far_from_its_middle():
    """A tenth of a cell is reached 0.8 m off."""
    turn, radius_m = Se2(0.0, 0.0, 0.1 * CELL_M / 0.8), 0.8
    views, parts = team(1, x_m=0.3), Parts()
    made(views, OPTIONS, parts)
    every = parts.tiles_saved()
    parts.saved.clear()
    turned = dataclasses.replace(views[0], team_from_base=turn @ views[0].team_from_base)
    made([turned], OPTIONS, parts)
    side_m, near, far = 8 * CELL_M, 0, 0
    for name in every:
        row, column = map(int, name.split()[1:])
        x = side_m * np.array([column, column + 1, column, column + 1])
        y = -side_m * np.array([row, row, row + 1, row + 1])
        distance_m = np.hypot(x, y)
        if distance_m.max() < radius_m:
            near += 1
            assert name not in parts.tiles_saved()
        if np.hypot(np.clip(0, x.min(), x.max()), np.clip(0, y.min(), y.max())) > radius_m:
            far += 1
            assert name in parts.tiles_saved()
    assert min(near, far) > 0


def test_small_moves_do_not_add_up():
    """Twenty steps of 0.03 cells: what is shown is never 0.1 cells off."""
    views, parts = team(), Parts()
    renewed = []
    for step in range(20):
        parts.saved.clear()
        made(moved(views, 2, 0.03 * step), OPTIONS, parts)
        renewed += [step] if parts.tiles_saved() else []
    assert renewed == [0, 4, 8, 12, 16]


def test_without_tolerance_every_change_counts():
    options = dataclasses.replace(LIGHT, keep_within_cells=0.0, keep_within_levels=0.0)
    views, parts = team(), Parts()
    made(views, options, parts)
    other = moved(views, 2, 1e-9)
    found = made(other, options, parts)
    assert is_equal(found, made(other, options))
    parts.saved.clear()
    assert is_equal(made([unreadable(view) for view in other], options, parts), found)
    assert parts.saved == ["layout"]


def test_another_picture_or_option_renders_anew():
    views, parts = team(), Parts()
    made(views, OPTIONS, parts)
    every = parts.tiles_saved()
    black = dataclasses.replace(views[2], load=lambda: np.zeros((120, 160, 3), np.uint8))
    black = dataclasses.replace(black, digest=b"another")
    other = [*views[:2], black, *views[3:]]
    assert is_equal(made(other, OPTIONS, parts), made(other))
    for change in ({"max_depth": 2}, {"num_sigmas": 0.5}, {"far_footprint": 1.5}):
        options = dataclasses.replace(OPTIONS, **change)
        parts.saved.clear()
        assert is_equal(made(other, options, parts), made(other, options))
        assert parts.tiles_saved() <= every
        assert parts.tiles_saved()


def changed_team():
    """Before and after: a new view, a view that moved by 0.2 cells, all others by a little."""
    views = team(6)
    after = moved(moved(views, 1, 0.2), 3, 0.05)
    return views[:-1], after


@pytest.mark.parametrize("options", [OPTIONS, LIGHT, dataclasses.replace(OPTIONS, tile_cells=16)])
def test_an_interrupted_run_ends_as_an_undisturbed_one(options):
    """Whatever was renewed before the end: the same parts stay, the same are renewed."""
    before, after = changed_team()
    start = Parts()
    made(before, options, start)
    whole = Parts(start)
    expected = made(after, options, whole)
    assert not is_equal(expected, made(after, options))  # something was kept
    num_saved = len(whole.saved)
    assert num_saved > 20
    assert options.compensate or any(tile.patches for tile in tiles_of(whole))
    for left in range(0, num_saved, 11):
        parts = Parts(start, left)
        with pytest.raises(KeyboardInterrupt):
            made(after, options, parts)
        parts.left = math.inf
        parts.saved.clear()
        assert is_equal(made(after, options, parts), expected)
        assert len(parts.saved) == num_saved - max(left - 1, 0)  # the layout is always written


def test_a_memory_needs_digests():
    views = [*team(2), view_of(FrameId("A", 7), CAMERA, Se2(0, 0, 0), np.zeros((120, 160, 3)))]
    made(views[:2], OPTIONS, Parts())
    with pytest.raises(ValueError, match="a mosaic that is kept needs a digest of picture A7"):
        made(views, OPTIONS, Parts())


def numbers(foot, attitude):
    return [foot.x_m, foot.y_m, foot.theta_rad, *dataclasses.astuple(attitude)]


def test_the_shift_is_that_of_rays():
    """Where a ray of the one placing meets the floor in the other, from the formulas for rays."""
    rng = np.random.default_rng(1)
    kept = Se2(1.0, -2.0, 0.7), Attitude(0.5, 0.03, 0.55)
    today = Se2(1.01, -2.02, 0.71), Attitude(0.52, 0.02, 0.56)
    points = rng.uniform(0.1, 0.4, (4, 2)) + np.array([1.0, -2.0])
    rays = rays_from_floor(kept[1], kept[0].inverse().apply(points))
    shown = today[0].apply(floor_from_rays(today[1], rays))
    expected = np.hypot(*(shown - points).T).max()
    places = np.array([numbers(*kept)]), np.array([numbers(*today)])
    assert made_from.floor_shift_m(*places, points[None]) == pytest.approx(
        expected, abs=TOLERANCE_SHIFT_M
    )
    assert expected > 0.01
    assert made_from.floor_shift_m(places[0], places[0], points[None]) < TOLERANCE_SHIFT_M


def record(**changes):
    lens = CAMERA.intrinsics
    same = {
        "settings": ("tile", 0.01),
        "who": ("A 0 00",),
        "lenses": ((lens, 0, 119),),
        "lens_of_view": np.array([0]),
        "place": np.array([[0.0, 0.0, 0.0, 0.5, 0.0, 0.55]]),
        "limit_m": np.array([0.02]),
        "colour": np.zeros((1, 6)),
        "noise_levels": 3.0,
    }
    return made_from.MadeFrom(**(same | changes))


def colour(gain=0.0, falloff=(0.0, 0.0, 0.0)):
    return {"colour": np.array([[0.0, gain, 0.0, *falloff]])}


def lens(**changes):
    return {"lenses": ((dataclasses.replace(CAMERA.intrinsics, **changes), 0, 119),)}


# A quarter of a level in 128 is 0.00195; three sigmas of noise may change by 0.25 levels.  With a
# limit of 2 cells a pixel and 80 px from the middle, 6e-4 of the focal length are 0.1 cells.
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"settings": ("tile", 0.02)}, False),
        ({"who": ("A 0 01",)}, False),
        ({"who": ("A 0 00", "A 1 00")}, False),
        ({"limit_m": np.array([0.0200001])}, False),
        (colour(gain=0.0019), True),
        (colour(gain=-0.0019), True),
        (colour(gain=0.0020), False),
        (colour(falloff=(0.0, 0.0, 0.0020)), False),
        (colour(gain=0.01, falloff=(-0.01, 0.0, 0.0)), False),  # cancels at the border only
        (colour(falloff=(0.01, -0.01, 0.0)), False),  # 0.0025 halfway
        (colour(falloff=(0.007, -0.007, 0.0)), True),
        ({"noise_levels": 3.08}, True),
        ({"noise_levels": 3.09}, False),
        (lens(fx_px=128.0 * (1 + 3e-4)), True),
        (lens(fx_px=128.0 * (1 + 9e-4)), False),
        (lens(width_px=161), False),
        ({"lenses": ((CAMERA.intrinsics, 0, 118),)}, False),
    ],
)
def test_what_may_change(changes, expected):
    corners = np.array([[[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.5, 0.5]]])
    options = dataclasses.replace(OPTIONS, m_per_px=0.01)
    assert made_from.is_same(record(), record(**changes), corners, 0.01, options) == expected
    assert made_from.is_same(record(**changes), record(), corners, 0.01, options) == expected


def test_cells_stay_while_their_length_is_nearly_the_same():
    views = team()
    free = MosaicOptions(tile_cells=8)
    today = plan_mosaic(views, free)
    (useful_m,) = today.layout.useful_m.values()
    for factor, kept in ((1.009, True), (0.991, True), (1.011, False), (0.989, False)):
        earlier = Layout({"A": useful_m * factor}, today.layout.sampling_cells)
        plan = plan_mosaic(views, free, earlier)
        assert plan.layout.useful_m["A"] == (useful_m * factor if kept else useful_m)
        assert plan.limit_m[0] == free.far_footprint * plan.layout.useful_m["A"]
    exact = dataclasses.replace(free, keep_within_cells=0.0)
    assert plan_mosaic(views, exact, Layout({"A": useful_m * 1.001}, 9)).layout == today.layout
    other = Layout({"B": 1.0}, today.layout.sampling_cells + 1)
    assert plan_mosaic(views, free, other).layout == Layout({"A": useful_m}, other.sampling_cells)
    far = Layout({}, 10 * today.layout.sampling_cells)
    assert plan_mosaic(views, free, far).layout == today.layout


def test_the_grid_is_of_whole_tiles_from_the_origin():
    for x_m in (-3.0, 0.0, 0.123, 4.0):
        grid = plan_mosaic(team(x_m=x_m), OPTIONS).grid
        row, column = grid.first_cells
        assert (grid.x_min_m, grid.y_max_m) == (column * CELL_M, -row * CELL_M)
        assert not any(n % 8 for n in (row, column, grid.rows, grid.columns))
