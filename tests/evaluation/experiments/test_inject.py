"""Objects injected into a map: what is cut is gone and known to be free, what is added stands where nothing was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.types import U8, CellState, MapvoteError
from mapvote.evaluation.experiments.inject import Injection, score_injection


def street() -> tuple[PointMap, Grid]:
    """60 x 30 m of flat ground, a wall 2.5 m high along y = 25 m, and everything else up to 3 m known to be free."""
    x, y = np.meshgrid(np.arange(0.15, 60.0, CELL_SIZE), np.arange(0.15, 30.0, CELL_SIZE))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.01)])
    a, z = np.meshgrid(np.arange(0.15, 60.0, CELL_SIZE), np.arange(0.45, 2.5, CELL_SIZE))
    wall = np.column_stack([a.ravel(), np.full(a.size, 25.05), z.ravel()])
    bare = map_from_points(np.concatenate([ground, wall]))
    tiles = {}
    for index, tile in bare.tiles.items():
        window = Grid(bare.lattice, 256 * index[0], 256 * index[1], 256, 256)
        tiles[index] = replace(tile, free=np.uint64(0b1111111110) & ~reference_window(bare, window).occupied)
    return replace(bare, tiles=tiles), Grid(bare.lattice, 0, 0, 100, 200)


PATH = np.column_stack([np.arange(5.0, 55.0, 1.0), np.full(50, 12.0)])


def inject(seed: int) -> tuple[PointMap, PointMap, Grid, Injection]:
    before, grid = street()
    injection = Injection(seed, PATH, objects=3)
    return before, injection(before, grid, np.zeros(grid.shape, np.bool_)), grid, injection


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_cut_object_leaves_free_space_and_a_phantom_takes_it(seed: int) -> None:
    before, after, grid, injection = inject(seed)
    old, new = reference_window(before, grid), reference_window(after, grid)
    assert old.free is not None
    assert new.free is not None
    built, demolished = injection.truth == 1, injection.truth == 2
    assert built.any()
    assert demolished.any()
    np.testing.assert_array_equal(new.occupied[built], 0)
    assert ((new.free & old.occupied) == old.occupied)[built].all()
    np.testing.assert_array_equal(old.occupied[demolished], 0)
    assert (new.occupied[demolished] != 0).all()
    np.testing.assert_array_equal(new.free[demolished], 0)
    elsewhere = injection.truth == 0
    np.testing.assert_array_equal(new.occupied[elsewhere], old.occupied[elsewhere])
    np.testing.assert_array_equal(new.free[elsewhere], old.free[elsewhere])


def test_points_that_were_not_cut_stay_to_the_bit_and_ground_is_never_cut() -> None:
    before, after, _, _ = inject(1)
    old, new = ({tuple(p) for p in all_points(m)} for m in (before, after))
    assert all(z >= 0.3 for _, _, z in old - new)
    assert all(z >= 0.3 for _, _, z in new - old)


def test_what_no_ray_met_again_is_not_asked_for_but_counted_beside() -> None:
    injection = inject(1)[3]
    built = injection.truth == 1
    rows, cols = np.nonzero(built)
    reached = built.copy()
    reached[rows[0], cols[0]] = False
    states: U8 = np.where(reached, CellState.CHANGED_OCCUPIED, CellState.UNDETERMINED).astype(np.uint8)
    score = score_injection(injection, states, "built", reached)
    assert (score.cell_recall, score.found, score.objects, score.precision_near) == (1.0, 3, 3, 1.0)
    assert score.recall_of_all == pytest.approx(1.0 - 1.0 / built.sum())
    nothing = score_injection(injection, states, "demolished", reached)
    assert (nothing.cell_recall, nothing.found, nothing.objects) == (0.0, 0, 3)


def test_a_map_without_room_is_refused() -> None:
    before, grid = street()
    with pytest.raises(MapvoteError, match="no room for another built"):
        Injection(1, PATH, objects=200)(before, grid, np.zeros(grid.shape, np.bool_))
