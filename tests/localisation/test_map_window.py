"""The NDT map around a vehicle, joined from tiles, is the one of all their points at once."""

from __future__ import annotations

import numpy as np
import pytest

from hand_made import make_map, make_tile
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64
from mapvote.localisation.map_window import MapWindow, tiles_within
from mapvote.localisation.ndt import NdtGrid, NdtMap, build_ndt

ROAD = [np.array([x, 40.0, 1.8]) for x in np.arange(10.0, 150.0, 5.0)]


@pytest.fixture(scope="module")
def point_map() -> PointMap:
    """Two by three tiles of scattered points, some far below and far above."""
    rng = np.random.default_rng(3)

    def cloud() -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        points = rng.uniform((0.0, 0.0, -3.0), (76.799, 76.799, 9.0), (4000, 3))
        points[:20, 2] = rng.choice([-900.0, -20.0, 35.0, 700.0], 20)
        return points.astype(np.float32)

    return make_map({(r, c): make_tile(cloud(), index=(r, c)) for r in range(2) for c in range(3)})


def window_points(point_map: PointMap, position: F64) -> F64:
    """Points (n, 3) in map metres of the tiles that the window around ``position`` (3,) touches."""
    clouds = [point_map.tiles[tile].points_map for tile in tiles_within(point_map, position)]
    return np.concatenate([np.zeros((0, 3)), *clouds])


def by_place(grid: NdtGrid) -> dict[tuple[int, ...], F64]:
    """Sums and distribution of every voxel that the window finds."""
    rows = grid.window.rows[grid.window.rows >= 0]
    return {
        tuple(grid.voxels.place[k].tolist()): np.concatenate([grid.voxels.sums[k, :10], grid.voxels.cells[k]])
        for k in rows
    }


def assert_same(joined: NdtMap, whole: NdtMap) -> None:
    for ours, theirs in zip(joined.levels, whole.levels, strict=True):
        found, expected = by_place(ours), by_place(theirs)
        assert found.keys() == expected.keys()
        if found:
            mine = np.stack([found[place] for place in expected])
            np.testing.assert_allclose(mine, np.stack(list(expected.values())), rtol=1e-9, atol=1e-9)


def test_tiles_joined_are_the_map_of_all_their_points(point_map: PointMap) -> None:
    for position in (ROAD[0], ROAD[-1], np.array([-60.0, 200.0, 30.0])):
        whole = build_ndt(window_points(point_map, position), position)
        assert_same(MapWindow(point_map)(position), whole)


def test_what_was_made_ready_ahead_is_the_same_and_leaves_nothing_to_do(point_map: PointMap) -> None:
    around = MapWindow(point_map)
    around(ROAD[0])
    for position in ROAD:
        for _ in range(4):
            around.prepare(position)
        ready = {tile: len(levels) for tile, levels in around._ready.items()}
        around(position)
        assert {tile: len(levels) for tile, levels in around._ready.items()} == ready
    assert around.ndt_map is not None
    centre = around.ndt_map.centre
    assert_same(around.ndt_map, build_ndt(window_points(point_map, centre), centre))


def test_tiles_left_behind_are_forgotten() -> None:
    tiles = {(0, c): make_tile(np.array([[1.0, 1.0, 0.0]] * 4, np.float32), index=(0, c)) for c in range(30)}
    around = MapWindow(make_map(tiles))
    for x in np.arange(0.0, 2200.0, 20.0):
        around.prepare(np.array([x, 40.0, 1.8]))
        around(np.array([x, 40.0, 1.8]))
    assert len(around._ready) <= 8
