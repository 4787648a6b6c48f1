"""One cloud becomes tiles: nothing is lost, nothing moves. A map says what it is, and refuses in one line what it
cannot be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mapvote
from hand_made import make_map, make_tile, two_walls
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.point_map import MAP_SIZES, LazyTiles, all_points, cut_tiles, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, Drive, MapvoteError, PosePrior, Scan

POINTS = np.zeros((5, 3), dtype=np.float32)


def test_the_repr_of_a_map_and_of_a_tile_is_one_line() -> None:
    assert repr(two_walls()) == "PointMap('test-map': 24 points in 2 tiles)"
    assert repr(two_walls().tiles[0, 0]) == "Tile(0, 0: 12 points)"


def with_nan(array: F32) -> F32:
    array = array.copy()
    array.flat[4] = np.nan
    return array


def drive(stamps_ns: np.ndarray, prior: np.ndarray | None = None) -> Drive:
    return Drive(Path("d"), "v", "d", SENSORS["vlp16"], stamps_ns, lambda i: Scan(i, POINTS), prior)


def tile(points: np.ndarray, ground_z: np.ndarray | None = None, free: np.ndarray | None = None) -> Tile:
    window = Lattice().tile((0, 0))
    return Tile(window, points, np.zeros((256, 256), np.float32) if ground_z is None else ground_z, free)


@pytest.mark.parametrize(
    ("give", "says"),
    [
        (lambda: Scan(0, POINTS.astype(np.float64)), r"Scan\.points: expected float32 \(n, 3\), got float64 \(5, 3\)"),
        (lambda: Scan(0, POINTS[:, :2]), r"expected float32 \(n, 3\), got float32 \(5, 2\)"),
        (lambda: Scan(0, cast(Any, POINTS.tolist())), r"expected float32 \(n, 3\), got a list"),
        (lambda: Scan(0, with_nan(POINTS)), r"Scan\.points: 1 numbers are not finite, the first at \[1, 1\]"),
        (lambda: Scan(0, POINTS, np.zeros(4, np.float32)), r"Scan\.time_s: expected float32 \(5\), got float32 \(4,\)"),
        (
            lambda: Scan(0, POINTS, fields={"intensity": with_nan(POINTS[:, 0])}),
            r"Scan\.fields.*: 1 numbers are not finite",
        ),
        (
            lambda: PosePrior(np.eye(3), 1.0, 1.0),
            r"T_map_lidar of the prior: expected float64 \(4, 4\)",
        ),
        (lambda: PosePrior(np.eye(4) * np.nan, 1.0, 1.0), r"16 numbers are not finite"),
        (lambda: mapvote.map_from_points(np.zeros((4, 2))), r"got an array of shape \(4, 2\), expected \(n, 3\)"),
        (lambda: mapvote.map_from_points(np.full((4, 3), np.nan)), r"4 of 4 map points are not finite"),
        (lambda: drive(np.arange(3.0)), r"Drive\.stamps_ns: expected int64 \(n\), got float64 \(3,\)"),
        (lambda: drive(np.arange(3), np.zeros((2, 4, 4))), r"Drive\.T_map_lidar_prior: expected float64 \(3, 4, 4\)"),
        (lambda: tile(POINTS[:, :2]), r"Tile\.points: expected float32 \(n, 3\)"),
        (lambda: tile(POINTS, np.zeros((3, 3), np.float32)), r"Tile\.ground_z: expected float32 \(256, 256\)"),
        (lambda: tile(POINTS, None, np.zeros((256, 256))), r"Tile\.free: expected uint64"),
    ],
)
def test_arrays_that_cannot_be_are_refused_in_one_line(give: Callable[[], object], says: str) -> None:
    with pytest.raises(MapvoteError, match=says) as refused:
        give()
    assert "\n" not in str(refused.value)


def test_ground_under_points_is_that_of_their_tiles_and_nothing_beyond_the_map() -> None:
    rng = np.random.default_rng(1)
    ground = {(0, c): rng.normal(0.0, 1.0, (256, 256)).astype(np.float32) for c in (0, 1)}
    point_map = make_map({index: Tile(Lattice().tile(index), POINTS, z) for index, z in ground.items()})
    points = rng.uniform((-40.0, -10.0, 0.0), (190.0, 80.0, 1.0), (500, 3))
    rows, cols = Lattice().cells_of(points)
    inside = (rows >= 0) & (rows < 256) & (cols >= 0) & (cols < 512)
    wide = np.hstack([ground[0, 0], ground[0, 1]])
    expected = np.where(inside, wide[rows.clip(0, 255), cols.clip(0, 511)], np.nan)
    np.testing.assert_array_equal(point_map.ground_under(points), expected.astype(np.float64))
    assert point_map.ground_under(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("side_m", [300.0, 90_000.0])
def test_points_are_cut_into_tiles_in_ascending_order_and_keep_theirs_within_each(side_m: float) -> None:
    """The order holds for a few tiles and for more than two bytes can number."""
    points = np.random.default_rng(4).uniform(-side_m, side_m, (2000, 3))
    rows, cols = (cells // TILE_CELLS for cells in Lattice().cells_of(points))
    cut = list(cut_tiles(points, Lattice()))
    assert [tile for tile, _ in cut] == sorted(set(zip(rows.tolist(), cols.tolist(), strict=True)))
    np.testing.assert_array_equal(np.concatenate([mine for _, mine in cut]), np.lexsort((cols, rows)))
    assert all((rows[mine] == row).all() and (cols[mine] == col).all() for (row, col), mine in cut)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-300, 300)] * 3), min_size=1, max_size=30))
def test_every_point_survives_in_its_own_tile_and_within_a_hundredth_of_a_millimetre(
    points: list[tuple[float, float, float]],
) -> None:
    cloud = np.array(points) + np.array([1234.5, -987.0, 3.0])
    point_map = map_from_points(cloud, lattice=Lattice(0.3, -0.6))
    for axis in range(3):
        kept = np.sort(all_points(point_map)[:, axis])
        np.testing.assert_allclose(kept, np.sort(cloud[:, axis]), rtol=0, atol=2e-5)
    for content in point_map.tiles.values():
        assert content.points.dtype == np.float32
        assert content.points[:, :2].min() >= 0
        assert content.points[:, :2].max() < TILE_CELLS * CELL_SIZE


def test_the_name_of_a_map_follows_its_points() -> None:
    points = np.random.default_rng(3).uniform(-20.0, 20.0, (500, 3))
    assert map_from_points(points).map_id == map_from_points(points.copy()).map_id
    assert map_from_points(points).map_id != map_from_points(points[::2]).map_id
    assert map_from_points(points, map_id="street").map_id == "street"


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_values_that_an_edited_tile_takes_along_equal_computed_ones(seed: int, known: bool) -> None:
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
    for one in (tile, tile.without(np.array([True, False])), tile.with_new(points), tile.but(points=points)):
        for plane in (one.points, one.ground_z):
            with pytest.raises(ValueError, match="read-only"):
                plane[:] = 1.0
    points[:] = 1.0


def test_tiles_of_hardly_any_points_are_not_all_held() -> None:
    """Their planes take 1 MB each: a map that is long and thin would fill the memory of a vehicle."""
    lattice = Lattice(0.0, 0.0)
    made: list[TileIndex] = []

    def load(index: TileIndex) -> Tile:
        made.append(index)
        return Tile.empty(lattice.tile(index))

    long = [(0, col) for col in range(9)]
    tiles = LazyTiles(load, dict.fromkeys(long, 0), kept_points=3 * MAP_SIZES.tile_points)
    for index in (*long, *long[-3:]):
        assert tiles[index].index == index
    assert made == long
    assert tiles[0, 0].index == made[-1] == (0, 0)
