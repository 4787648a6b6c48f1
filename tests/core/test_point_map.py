"""What a user meets in a notebook: a map says what it is, and arrays that cannot be are refused in one line."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from matplotlib import image

import mapvote
from hand_made import make_map, two_walls
from mapvote.core.grid import TILE_CELLS, Lattice
from mapvote.core.picture import SIDE, heights, paint
from mapvote.core.point_map import all_points, cut_tiles
from mapvote.core.sensors import SENSORS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, Drive, MapvoteError, Scan
from mapvote.localisation.ndt import PosePrior


def test_the_repr_of_a_map_is_one_line() -> None:
    assert repr(two_walls()) == "PointMap('test-map': 24 points in 2 tiles)"


def test_the_repr_of_a_tile_is_one_line() -> None:
    assert repr(two_walls().tiles[0, 0]) == "Tile(0, 0: 12 points)"


def picture_of(point_map: mapvote.PointMap) -> np.ndarray:
    """What a browser shows, read by somebody else's decoder; RGB in [0, 1]."""
    data = re.search(r'src="data:image/png;base64,([^"]+)"', point_map._repr_html_())
    assert data is not None
    return np.asarray(image.imread(io.BytesIO(base64.b64decode(data[1])), format="png"))


def test_a_notebook_shows_a_map_from_above_north_up() -> None:
    x, y = np.meshgrid(np.arange(0, 30, 0.2), np.arange(0, 30, 0.2))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    tower = np.array([[15.0 + dx, 27.0 + dy, z] for dx in (0, 0.3) for dy in (0, 0.3) for z in np.arange(0.5, 12, 0.3)])
    picture = picture_of(mapvote.map_from_points(np.vstack([floor, tower])))
    assert picture.shape == (100, 100, 3)  # 30 m in pixels of 0.3 m
    red = picture[..., 0] - picture[..., 2]
    row, col = np.unravel_index(np.argmax(red), red.shape)
    assert row < 15  # the north is above
    assert 45 <= col <= 55


def test_a_picture_stays_small_however_wide_the_map_is() -> None:
    far = np.array([[0.0, 0.0, 0.0], [5000.0, 900.0, 0.0]])
    rows, cols, _ = picture_of(mapvote.map_from_points(far)).shape
    assert SIDE - 1 <= cols <= SIDE
    assert rows == 87


def test_an_empty_map_has_no_picture() -> None:
    assert "<img" not in make_map({})._repr_html_()


def test_a_name_from_outside_cannot_inject_html() -> None:
    assert "<script>" not in mapvote.PointMap("<script>", Lattice(), {})._repr_html_()


def test_white_is_unknown_and_higher_is_another_colour() -> None:
    painted = paint(np.array([[np.nan, 0.0, 6.0, 20.0]], dtype=np.float32))[0]
    assert painted[0].tolist() == [255, 255, 255]
    assert len({tuple(pixel) for pixel in painted.tolist()}) == 4


def test_heights_are_above_the_ground_not_above_the_sea() -> None:
    sunk = Tile(
        Lattice().tile((0, 0)),
        np.array([[1, 1, 107.0]], dtype=np.float32),
        np.full((256, 256), 100.0, dtype=np.float32),
    )
    assert heights([sunk]).tolist() == [[7.0]]


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


def test_a_map_from_points_holds_them() -> None:
    points = np.random.default_rng(0).uniform(-100, 100, (500, 3))
    point_map = mapvote.map_from_points(points)
    found = all_points(point_map)
    order, stored = np.lexsort(points.T), np.lexsort(found.T)
    np.testing.assert_allclose(found[stored], points[order], atol=1e-5)


@pytest.mark.parametrize("side_m", [300.0, 90_000.0])
def test_points_are_cut_into_tiles_in_ascending_order_and_keep_theirs_within_each(side_m: float) -> None:
    """Of a few tiles as of more than two bytes can number."""
    points = np.random.default_rng(4).uniform(-side_m, side_m, (2000, 3))
    rows, cols = (cells // TILE_CELLS for cells in Lattice().cells_of(points))
    cut = list(cut_tiles(points, Lattice()))
    assert [tile for tile, _ in cut] == sorted(set(zip(rows.tolist(), cols.tolist(), strict=True)))
    np.testing.assert_array_equal(np.concatenate([mine for _, mine in cut]), np.lexsort((cols, rows)))
    assert all((rows[mine] == row).all() and (cols[mine] == col).all() for (row, col), mine in cut)
