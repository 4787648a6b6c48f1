"""What a user meets in a notebook: a map says what it is, and arrays that cannot be are refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import mapvote
from hand_made import make_map, two_walls
from mapvote.core.grid import TILE_CELLS, Lattice
from mapvote.core.point_map import cut_tiles
from mapvote.core.sensors import SENSORS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, Drive, MapvoteError, PosePrior, Scan


def test_the_repr_of_a_map_and_of_a_tile_is_one_line() -> None:
    assert repr(two_walls()) == "PointMap('test-map': 24 points in 2 tiles)"
    assert repr(two_walls().tiles[0, 0]) == "Tile(0, 0: 12 points)"


POINTS = np.zeros((5, 3), dtype=np.float32)


def with_nan(array: F32) -> F32:
    array = array.copy()
    array.flat[4] = np.nan
    return array


@pytest.mark.parametrize(
    ("give", "says"),
    [
        (lambda: Scan(0, POINTS.astype(np.float64)), r"Scan\.points: expected float32 \(n, 3\), got float64 \(5, 3\)"),
        (lambda: Scan(0, POINTS[:, :2]), r"expected float32 \(n, 3\), got float32 \(5, 2\)"),
        (lambda: Scan(0, cast(Any, POINTS.tolist())), r"expected float32 \(n, 3\), got a list"),
        (lambda: Scan(0, with_nan(POINTS)), r"Scan\.points: 1 numbers are not finite, the first at \[1, 1\]"),
        (lambda: Scan(0, POINTS, np.zeros(4, np.float32)), r"Scan\.time_s: expected float32 \(5\), got float32 \(4,\)"),
        (lambda: Scan(0, POINTS, None, with_nan(POINTS[:, 0])), r"Scan\.intensity: 1 numbers are not finite"),
        (
            lambda: PosePrior(np.eye(3), 1.0, 1.0),
            r"T_map_lidar of the prior: expected float64 \(4, 4\), got .*\(3, 3\)",
        ),
        (lambda: PosePrior(np.eye(4) * np.nan, 1.0, 1.0), r"16 numbers are not finite"),
        (lambda: mapvote.map_from_points(np.zeros((4, 2))), r"got an array of shape \(4, 2\), expected \(n, 3\)"),
        (lambda: mapvote.map_from_points(np.full((4, 3), np.nan)), r"4 of 4 map points are not finite"),
        (lambda: drive(np.arange(3.0)), r"Drive\.stamps_ns: expected int64 \(n\), got float64 \(3,\)"),
        (lambda: drive(np.arange(3), np.zeros((2, 4, 4))), r"Drive\.T_map_lidar_prior: expected float64 \(3, 4, 4\)"),
        (lambda: tile(POINTS[:, :2]), r"Tile\.points: expected float32 \(n, 3\)"),
        (
            lambda: tile(POINTS, np.zeros((3, 3), np.float32)),
            r"Tile\.ground_z: expected float32 \(256, 256\)",
        ),
        (lambda: tile(POINTS, None, np.zeros((256, 256))), r"Tile\.free: expected uint64"),
    ],
)
def test_arrays_that_cannot_be_are_refused_in_one_line(give: Callable[[], object], says: str) -> None:
    with pytest.raises(MapvoteError, match=says) as refused:
        give()
    assert "\n" not in str(refused.value)


def drive(stamps_ns: np.ndarray, prior: np.ndarray | None = None) -> Drive:
    return Drive(Path("d"), "v", "d", SENSORS["vlp16"], stamps_ns, lambda i: Scan(i, POINTS), prior)


def tile(points: np.ndarray, ground_z: np.ndarray | None = None, free: np.ndarray | None = None) -> Tile:
    window = Lattice().tile((0, 0))
    return Tile(window, points, np.zeros((256, 256), np.float32) if ground_z is None else ground_z, free)


def test_what_lies_under_points_is_that_of_their_tiles_and_nothing_beyond_the_map() -> None:
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
    """Of a few tiles as of more than two bytes can number."""
    points = np.random.default_rng(4).uniform(-side_m, side_m, (2000, 3))
    rows, cols = (cells // TILE_CELLS for cells in Lattice().cells_of(points))
    cut = list(cut_tiles(points, Lattice()))
    assert [tile for tile, _ in cut] == sorted(set(zip(rows.tolist(), cols.tolist(), strict=True)))
    np.testing.assert_array_equal(np.concatenate([mine for _, mine in cut]), np.lexsort((cols, rows)))
    assert all((rows[mine] == row).all() and (cols[mine] == col).all() for (row, col), mine in cut)
