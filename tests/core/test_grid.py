"""The one lattice: half-open cells, windows that are slices of one another, tiles that cover without overlap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.columns import flat_cells
from mapvote.core.grid import CELL_SIZE, Grid, Lattice, window_around

small = st.integers(-2000, 2000)
sizes = st.integers(1, 600)
grids = st.builds(Grid, st.just(Lattice(0.9, -1.2)), small, small, sizes, sizes)


def test_a_point_on_a_cell_border_belongs_to_the_upper_cell() -> None:
    rows, cols = Lattice().cells_of(np.array([[0.0, 0.0], [0.29999, 0.30001], [-1e-9, 0.6]]))
    assert cols.tolist() == [0, 0, -1]
    assert rows.tolist() == [0, 1, 2]


def test_the_vehicle_stands_in_the_middle_cell_of_its_window() -> None:
    grid = window_around(Lattice(), 12.34, -56.78, 80.0)
    rows, cols, inside = grid.indices_of(np.array([[12.34, -56.78]]))
    assert (grid.shape, rows[0], cols[0], inside[0]) == ((267, 267), 133, 133, True)


@given(grids, grids)
def test_intersection_and_union_bound_both(a: Grid, b: Grid) -> None:
    union, common = a.union(b), a.intersection(b)
    a.slices_in(union)
    b.slices_in(union)
    if common.rows and common.cols:
        common.slices_in(a)
        common.slices_in(b)
    assert a.intersection(a) == a == a.union(a)
    assert (common.rows, common.cols) == (b.intersection(a).rows, b.intersection(a).cols)


@given(grids)
def test_tiles_cover_a_window_once(grid: Grid) -> None:
    seen = np.zeros(grid.shape, dtype=np.int64)
    for tile in grid.tiles():
        common = grid.lattice.tile(tile).intersection(grid)
        seen[common.slices_in(grid)] += 1
    assert (seen == 1).all()


def test_grids_of_different_lattices_never_mix() -> None:
    with pytest.raises(ValueError, match="different lattices"):
        Grid(Lattice(), 0, 0, 5, 5).intersection(Grid(Lattice(0.15), 0, 0, 5, 5))
    with pytest.raises(ValueError, match="not inside"):
        Grid(Lattice(), 0, 0, 5, 5).slices_in(Grid(Lattice(), 1, 0, 5, 5))


@given(x0=st.floats(-1e3, 1e3), row0=st.integers(-500, 500), seed=st.integers(0, 2**32 - 1))
def test_flat_cells_are_those_of_the_points_in_map_metres(x0: float, row0: int, seed: int) -> None:
    grid = Grid(Lattice(x0, -x0), row0, -3 * row0, 40, 50)
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 15.0, (100, 3)).astype(np.float32)
    points[:50, :2] = rng.integers(0, 50, (50, 2)) * np.float32(CELL_SIZE)
    rows, cols, _ = grid.indices_of(grid.to_map(points))
    np.testing.assert_array_equal(flat_cells(grid, points), rows.clip(0, 39) * 50 + cols.clip(0, 49))
