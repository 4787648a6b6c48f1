"""The map side of NDT: every voxel's distribution is that of its points, however and whenever they came."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import make_map, make_tile, wall
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64
from mapvote.matching.ndt_map import NDT_WINDOW, MapWindow, NdtMap, build_ndt, tiles_within
from mapvote.matching.ndt_voxels import Level, NdtGrid

SIZE, FLOOR_M = 2.0, 0.1
MIDDLE = np.array([3.0, -3.0, 1.0])
"""Middle of the voxel in which a cloud lies."""


def one_level(size: float = SIZE, half_m: float = 10.0) -> NdtMap:
    return NdtMap(
        np.zeros(3), (Level(size, FLOOR_M, points_m=0.1, iterations=1),), replace(NDT_WINDOW, half_window_m=half_m)
    )


def grid_of(*clouds: F64) -> NdtGrid:
    """Voxels of clouds that come one after the other."""
    made = one_level()
    for cloud in clouds:
        made.enter(cloud)
    return made.levels[0]


def precision(of: NdtGrid, row: int = 0) -> F64:
    c = of.voxels.cells[row, 3:]
    return np.array([[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]])


def row_at(of: NdtGrid, point: F64) -> int:
    i, j, k = np.floor(point / SIZE).astype(int) - of.window.lowest
    return int(of.window.rows[i, j, k])


def cloud(seed: int, n: int = 300) -> F64:
    """A slanted ellipsoid in the voxel from (2, -4, 0), too thick to count as flat."""
    rng = np.random.default_rng(seed)
    shape = rng.uniform(-0.1, 0.1, (3, 3)) + np.diag([0.15, 0.15, 0.3])
    return np.asarray(np.clip(rng.normal(0, 1, (n, 3)) @ shape.T, -0.99, 0.99) + MIDDLE)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_voxel_has_the_mean_of_its_points_and_the_inverse_of_their_widened_covariance(seed: int) -> None:
    """Less the precision of an even filling (less two deviations of its sample variance), but never below none."""
    points = cloud(seed)
    made = grid_of(points)
    assert (made.n, made.voxels.place[0].tolist()) == (1, [1, -2, 0])
    np.testing.assert_allclose(made.voxels.cells[0, :3], points.mean(axis=0) - MIDDLE, atol=1e-12)
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    even = 1.0 / (SIZE**2 / 12.0 * (1.0 - 2.0 * np.sqrt(0.8 / len(points))) + FLOOR_M**2)
    weights = np.maximum(0.0, 1.0 / (values + FLOOR_M**2) - even)
    np.testing.assert_allclose(precision(made), vectors @ np.diag(weights) @ vectors.T, atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_points_that_come_in_pieces_make_the_same_map(seed: int, pieces: int) -> None:
    points = np.random.default_rng(seed).uniform(-8.0, 8.0, (400, 3))
    at_once, bit_by_bit = grid_of(points), grid_of(*np.array_split(points, pieces))
    assert at_once.n == bit_by_bit.n == len({tuple(v) for v in np.floor(points / SIZE).astype(int).tolist()})
    np.testing.assert_array_equal(at_once.window.rows, bit_by_bit.window.rows)
    np.testing.assert_allclose(at_once.voxels.cells[: at_once.n], bit_by_bit.voxels.cells[: at_once.n], atol=1e-9)


def test_too_few_points_make_no_distribution_and_more_do() -> None:
    """Less two deviations of its sample variance, an even filling by three points is as sharp as any."""
    points = np.array([[2.5, -3.0, 1.0], [2.6, -3.1, 1.5], [2.5, -3.1, 0.5], [2.6, -3.0, 0.2]])
    assert [bool(precision(grid_of(points[:n])).any()) for n in (1, 2, 3, 4)] == [False, False, False, True]


def test_a_surface_knows_across_and_not_along_and_a_single_ring_on_the_road_is_no_wall() -> None:
    """A line is thin to all sides: taken at face value it would hold the next scan's ring where this one was."""
    rng = np.random.default_rng(2)
    patch = np.column_stack([rng.uniform(0.1, 1.9, (500, 2)), rng.normal(1.0, 0.01, 500)])
    along = rng.uniform(0.1, 1.9, 200)
    ring = np.column_stack([along, 0.3 * along + 0.6, np.full(200, 1.0)]) + rng.normal(0, 0.005, (200, 3))
    for points, across in ((patch, 2), (patch[:, [0, 2, 1]], 1), (ring, 2)):
        known = np.diag(precision(grid_of(points)))
        assert known[across] > 50.0
        assert np.delete(known, across).max() < 0.8
    assert np.abs(precision(grid_of(patch))[np.triu_indices(3, 1)]).max() < 1.0


def test_points_outside_the_window_are_left_out_and_found_again_when_it_has_moved() -> None:
    near, far = cloud(5), cloud(6) + np.array([14.0, 0.0, 0.0])
    whole = one_level()
    made = whole.levels[0]
    whole.enter(np.concatenate([near, far]))
    assert made.n == 1
    whole.recentre(np.array([20.0, 0.0, 0.0]))
    assert (made.window.rows >= 0).sum() == 0, "what was entered before lies outside now"
    whole.enter(far)
    assert row_at(made, far[0]) == 1
    whole.recentre(np.zeros(3))
    assert row_at(made, near[0]) == 0
    before = made.voxels.cells[0].copy()
    whole.recentre(np.array([10.0, 0.0, 0.0]))
    assert {row_at(made, near[0]), row_at(made, far[0])} == {0, 1}
    np.testing.assert_array_equal(made.voxels.cells[0], before)


@pytest.mark.parametrize("voxels", [1023, 1024, 1025, 2500])
def test_there_is_room_for_any_number_of_voxels(voxels: int) -> None:
    made, index = one_level(size=0.5, half_m=20.0), np.arange(voxels)
    points = np.column_stack([index % 60, index // 60, 0 * index]) * 0.5 + np.array([-14.75, -14.75, 0.25])
    made.enter(np.repeat(points, 2, axis=0))
    (grid,) = made.levels
    assert grid.n == voxels == (grid.window.rows >= 0).sum()
    assert (grid.voxels.sums[:voxels, 0] == 2.0).all()
    assert len(grid.voxels.place) <= max(2 * voxels, 1024), "rows are made for voxels, not for points"


ROAD = [np.array([x, 40.0, 1.8]) for x in np.arange(10.0, 150.0, 5.0)]


@pytest.fixture(scope="module")
def point_map() -> PointMap:
    """Two by three tiles of scattered points, some far below and far above."""
    rng = np.random.default_rng(3)
    tiles = {}
    for index in np.ndindex(2, 3):
        points = rng.uniform((0.0, 0.0, -3.0), (76.799, 76.799, 9.0), (4000, 3))
        points[:20, 2] = rng.choice([-900.0, -20.0, 35.0, 700.0], 20)
        tiles[index] = make_tile(points.astype(np.float32), index=index)
    return make_map(tiles)


def by_place(grid: NdtGrid) -> dict[tuple[int, ...], F64]:
    """Sums and distribution of every voxel that the window finds."""
    place, sums, cells = grid.voxels
    rows = grid.window.rows[grid.window.rows >= 0]
    return {tuple(place[k].tolist()): np.concatenate([sums[k, :10], cells[k]]) for k in rows}


def assert_whole(joined: NdtMap, point_map: PointMap, position: F64) -> None:
    """The result equals the map of all points at once of the tiles that the window around ``position`` touches."""
    clouds = [point_map.tiles[tile].points_map for tile in tiles_within(point_map, position)]
    whole = build_ndt(np.concatenate([np.zeros((0, 3)), *clouds]), position)
    for ours, theirs in zip(joined.levels, whole.levels, strict=True):
        found, expected = by_place(ours), by_place(theirs)
        assert found.keys() == expected.keys()
        values = np.array([found[place] for place in expected])
        np.testing.assert_allclose(values, np.array([*expected.values()]), rtol=1e-9, atol=1e-9)


def test_tiles_joined_are_the_map_of_all_their_points_also_if_they_were_made_ready_ahead(point_map: PointMap) -> None:
    for position in (ROAD[0], ROAD[-1], np.array([-60.0, 200.0, 30.0])):
        assert_whole(MapWindow(point_map)(position), point_map, position)
    around = MapWindow(point_map)
    around(ROAD[0])
    for position in ROAD:
        for _ in range(4):
            around.prepare(position)
        ready = {tile: len(levels) for tile, levels in around._ready.items()}
        around(position)
        assert {tile: len(levels) for tile, levels in around._ready.items()} == ready, "nothing was left to do"
    assert around.ndt_map is not None
    assert_whole(around.ndt_map, point_map, around.ndt_map.centre)


def test_tiles_left_behind_are_forgotten() -> None:
    tiles = {(0, c): make_tile(np.array([[1.0, 1.0, 0.0]] * 4, np.float32), index=(0, c)) for c in range(30)}
    around = MapWindow(make_map(tiles))
    for x in np.arange(0.0, 2200.0, 20.0):
        around.prepare(np.array([x, 40.0, 1.8]))
        around(np.array([x, 40.0, 1.8]))
    assert len(around._ready) <= 8


def test_the_map_around_a_vehicle_is_built_anew_only_when_it_leaves_the_middle(point_map: PointMap) -> None:
    around = MapWindow(point_map)
    ways = [(0.0, 0.0), (24.0, -24.0), (24.1, 0.0), (20.0, 0.0)]
    middles = [around(np.array([x, y, 1.8])).centre.tolist() for x, y in ways]
    assert middles == [[0.0, 0.0, 1.8]] * 2 + [[24.1, 0.0, 1.8]] * 2


def test_a_window_holds_the_tiles_that_it_touches_and_no_others() -> None:
    nine = list(np.ndindex(3, 3))
    point_map = make_map({tile: make_tile(wall([(1, 1)], [0.0]), index=tile) for tile in nine})
    for x, y, half_m, touched in (
        (115.2, 115.2, 10.0, [(1, 1)]),
        (115.2, 115.2, 39.0, nine),
        (115.2, 76.8, 10.0, [(0, 1), (1, 1)]),
        (76.8, 115.2, 10.0, [(1, 0), (1, 1)]),
    ):
        assert tiles_within(point_map, np.array([x, y, 0.0]), half_m) == touched
