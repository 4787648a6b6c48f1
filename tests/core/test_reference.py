"""The reference around a vehicle on the move is the one laid out for its place, however it was prepared."""

from __future__ import annotations

from dataclasses import fields
from typing import cast

import numpy as np
import pytest

from hand_made import make_map, make_tile, wall
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.reference import LAYOUT_STEPS, LocalMap, above_ground_points, reference_window
from mapvote.core.types import F64, Reference

WINDOW_M = 20.0
BESIDE = LAYOUT_STEPS.beyond_cells + int(np.ceil(0.5 * WINDOW_M / CELL_SIZE))
"""Cells around a vehicle's middle tile: half a window, and the way for which the planes do without the next ones."""


@pytest.fixture(scope="module")
def point_map() -> PointMap:
    rng = np.random.default_rng(5)
    cells = [(int(r), int(c)) for r, c in rng.integers(0, 256, (300, 2))]
    return make_map({(0, c): make_tile(wall(cells, [0.05, 1.0, 2.5]), index=(0, c)) for c in range(4)})


def assert_same(one: Reference, other: Reference) -> None:
    for each in fields(Reference):
        np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name))


def along(metres: F64) -> list[F64]:
    return [np.array([x, 30.0, 1.8]) for x in metres]


def test_a_reference_prepared_on_the_way_is_the_one_laid_out_at_once(point_map: PointMap) -> None:
    local = LocalMap(point_map, WINDOW_M)
    laid_out: list[Reference] = []
    for position in along(np.arange(20.0, 250.0, 4.0)):
        _, outer = local.at(position)
        if not laid_out or outer is not laid_out[-1]:
            laid_out.append(outer)
    assert len(laid_out) == 3
    for outer, tile in zip(laid_out, ((0, 0), (0, 1), (0, 2)), strict=True):
        assert outer.grid == point_map.lattice.tile(tile).padded(BESIDE)
        assert_same(outer, reference_window(point_map, outer.grid))


def test_a_reference_without_measures_has_the_same_ground_and_obstacles(point_map: PointMap) -> None:
    for position in along(np.array([20.0, 100.0, 300.0])):
        whole, light = (LocalMap(point_map, WINDOW_M, measured=measured).at(position)[1] for measured in (True, False))
        for name in ("grid", "ground_z", "base", "occupied", "free"):
            np.testing.assert_array_equal(getattr(light, name), getattr(whole, name))
        assert light.occupied.any()
        assert not light.counts.any()


def test_an_unused_preparation_does_no_harm(point_map: PointMap) -> None:
    local = LocalMap(point_map, WINDOW_M)
    there, back, elsewhere = along(np.array([70.0, 80.0])), along(np.array([60.0])), along(np.array([250.0]))
    for position in (*there, *back, *there, *elsewhere):
        cut, _ = local.at(position)
        np.testing.assert_array_equal(cut.occupied, reference_window(point_map, cut.grid).occupied)
    assert cast(Reference, local.outer).grid == point_map.lattice.tile((0, 3)).padded(BESIDE)


def test_new_things_are_believed_only_over_ground_that_the_map_measured() -> None:
    x, y = np.meshgrid(np.arange(0.15, 6.0, 0.3), np.arange(0.15, 6.0, 0.3))
    road = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    sign = np.array([[9.15, 3.15, 2.0], [9.15, 3.15, 2.3], [9.45, 3.15, 2.0]])  # nobody measured the ground under it
    point_map = map_from_points(np.vstack([road, sign]))
    words = above_ground_points(point_map, Grid(point_map.lattice, 0, 0, 20, 40))
    assert (words[:, :20] == ~np.uint64(0)).all()
    assert (words[:, 20] != 0).all(), "the cell next to measured ground counts too"
    assert not words[:, 22:28].any()
