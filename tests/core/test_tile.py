"""One cloud becomes tiles: nothing is lost, nothing moves, and the ground shows no seam."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import make_tile
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, Lattice
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.types import F64


def sloping_road(seed: int) -> F64:
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-90.0, -20.0), (90.0, 20.0), (60_000, 2))
    return np.column_stack([xy, 0.05 * xy[:, 0] + rng.normal(0, 0.01, len(xy))])


def test_every_point_survives_in_its_own_tile_and_within_a_hundredth_of_a_millimetre() -> None:
    points = sloping_road(1) + np.array([1234.5, -987.0, 3.0])
    point_map = map_from_points(points, lattice=Lattice(0.3, -0.6))
    back = all_points(point_map)
    assert len(back) == len(points)
    for axis in range(3):
        np.testing.assert_allclose(np.sort(back[:, axis]), np.sort(points[:, axis]), rtol=0, atol=1e-5)
    assert len(point_map.tiles) > 2
    for content in point_map.tiles.values():
        assert content.points.dtype == np.float32
        assert content.points[:, :2].min() >= 0
        assert content.points[:, :2].max() < TILE_CELLS * CELL_SIZE


def test_ground_has_no_seam_where_tiles_meet() -> None:
    points = sloping_road(2)
    there = map_from_points(points, lattice=Lattice())
    elsewhere = map_from_points(points, lattice=Lattice(-30.0, 30.0))  # the seams lie somewhere else
    compared = 0
    for content in there.tiles.values():
        window = content.window
        for beside in elsewhere.tiles.values():
            shifted = beside.window
            row0, col0 = shifted.row0 + 100, shifted.col0 - 100
            common = window.intersection(Grid(window.lattice, row0, col0, TILE_CELLS, TILE_CELLS))
            if common.rows * common.cols:
                same = Grid(shifted.lattice, common.row0 - 100, common.col0 + 100, common.rows, common.cols)
                z, w = content.ground_z[common.slices_in(window)], beside.ground_z[same.slices_in(shifted)]
                np.testing.assert_array_equal(np.isnan(z), np.isnan(w))
                assert np.nanmax(np.abs(z - w), initial=0.0) < 0.06, "beyond the way a cell without points is filled"
                compared += int(np.isfinite(z).sum())
    assert compared > 50_000


def test_the_name_of_a_map_follows_its_points() -> None:
    points = sloping_road(3)
    assert map_from_points(points).map_id == map_from_points(points.copy()).map_id
    assert map_from_points(points).map_id != map_from_points(points[::2]).map_id
    assert map_from_points(points, map_id="street").map_id == "street"


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-300, 300)] * 3), min_size=1, max_size=30))
def test_any_finite_cloud_is_kept_whole(points: list[tuple[float, float, float]]) -> None:
    assert len(all_points(map_from_points(np.array(points)))) == len(points)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_what_an_edited_tile_takes_along_is_what_it_would_work_out_afresh(seed: int, known: bool) -> None:
    rng = np.random.default_rng(seed)
    tile = make_tile(rng.uniform((0.0, 0.0, -1.0), (76.7, 76.7, 20.0), (200, 3)).astype(np.float32))
    if known:
        assert tile.obstacle_words.any(), "worked out, with all that it follows from"
    few = rng.uniform(0.0, (76.8, 76.8, 9.0), (5, 3)).astype(np.float32)
    edited = tile.without(rng.random(200) < 0.3).with_new(few).but(free=np.ones((TILE_CELLS, TILE_CELLS), np.uint64))
    afresh = replace(edited)
    for name in ("cells", "base", "columns", "obstacle_words"):
        np.testing.assert_equal(getattr(edited, name), getattr(afresh, name))
    bit, obstacle = afresh.columns
    expected = np.zeros(TILE_CELLS**2, np.uint64)
    np.bitwise_or.at(expected, afresh.cells[obstacle], np.uint64(1) << bit[obstacle].astype(np.uint64))
    np.testing.assert_array_equal(edited.obstacle_words.reshape(-1), expected)


def test_nothing_of_a_tile_can_be_written_to_and_what_it_was_made_of_still_can() -> None:
    points = np.zeros((2, 3), dtype=np.float32)
    tile = make_tile(points)
    made = tile, tile.without(np.array([True, False])), tile.with_new(points), tile.but(points=points)
    for one in made:
        for plane in (one.points, one.ground_z):
            with pytest.raises(ValueError, match="read-only"):
                plane[:] = 1.0
    points[:] = 1.0
