"""The ground follows the road, stays under what stands on it, and above what only mirrors it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.columns import base_layers
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Grid, Lattice
from mapvote.core.ground import (
    SEED,
    UNREACHED,
    WIDEST,
    _bounds,
    _continued,
    _like,
    _raise_at_kerbs,
    _sorted_by_cell,
    grow,
    tiles_around,
)
from mapvote.core.point_map import map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.types import F32, F64, I32, I64, U8

LATTICE = Lattice(-30.0, -30.0)
"""All that is tested lies well inside one tile."""
X = 0.3 * (np.arange(100) + 0.5)
"""Coordinates of the middles of a hundred cells."""
ONE_TILE = tiles_around([(0, 0)])


def ground_of(*clouds: F64, road: F64 | None = None, lattice: Lattice = LATTICE, cells: int = 100) -> F32:
    """(100, 100) the ground from (0, 0) upwards, ``cells`` from the lattice's corner, of a map of all clouds."""
    point_map = map_from_points(np.vstack(clouds), lattice=lattice, road=road)
    return reference_window(point_map, Grid(lattice, cells, cells, 100, 100)).ground_z


def spread(seed: int, count: int = 40_000, x: tuple[float, float] = (0, 30), y: tuple[float, float] = (0, 30)) -> F64:
    return np.random.default_rng(seed).uniform((x[0], y[0]), (x[1], y[1]), (count, 2))


def at(xy: F64, z: F64 | float) -> F64:
    return np.column_stack([xy, np.broadcast_to(z, len(xy))])


def between(seed: int, count: int, low: float, high: float) -> F64:
    return np.random.default_rng(seed).uniform(low, high, count)


def driven(x: tuple[float, float], y: float, z: float = 0.0) -> F64:
    along = np.arange(*x, 0.15)
    return np.column_stack([along, np.full(len(along), y), np.full(len(along), z)])


def test_the_ground_follows_a_ramp_and_ignores_a_wall_and_an_awning() -> None:
    xy = spread(0)
    wall = np.column_stack([np.full(4000, 15.05), between(1, 4000, 0, 30), between(2, 4000, 1.7, 7.5)])
    ground = ground_of(at(xy, 0.10 * xy[:, 0]), wall, at(spread(3, 2000, (20, 22), (5, 9)), 4.0))
    assert np.isfinite(ground).all()
    assert np.abs(ground - 0.10 * X).max() < 0.1


def test_the_ground_of_strays_costs_no_memory_and_changes_nothing_of_the_street() -> None:
    street = at(spread(3, 20_000), 0.0)
    strays = at(spread(4, 5_000, (-90_000, 90_000), (-90_000, 90_000)), 0.0)
    strays = strays[np.abs(strays).max(axis=1) > 300.0]
    alone, among = (map_from_points(np.vstack(clouds), lattice=LATTICE) for clouds in ([street], [street, strays]))
    assert len(among.tiles) > 4_000
    assert len({tile.ground_z.ctypes.data for tile in among.tiles.values()}) < 20
    for index, tile in alone.tiles.items():
        np.testing.assert_array_equal(tile.ground_z, among.tiles[index].ground_z)


def test_reflections_below_the_road_do_not_sink_the_ground() -> None:
    """A scene as behind a van in KITTI drive 0005: twenty points within a metre, four metres below the road. Where the
    driven path is known not even a mirrored street sinks it."""
    road = at(spread(1), 0.0)
    alone = np.array([[9.0, 9.0, -5.4], [10.1, 9.6, -4.6], [21.0, 3.0, -23.0]])
    cluster = at(spread(2, 20, (12, 13), (12, 13)), np.random.default_rng(3).normal(-4.0, 0.1, 20))
    assert np.abs(ground_of(road, alone, cluster)).max() < 0.05
    mirrored = at(spread(4, y=(6, 30)), between(5, 40_000, -5.0, -1.0))
    assert np.abs(ground_of(road, mirrored, road=driven((0, 30), 3.0))).max() < 0.05


def test_a_kerb_and_a_sunken_yard_stay_ground_and_far_from_any_point_it_is_unknown() -> None:
    xy = spread(3, 60_000)
    z = np.where(xy[:, 0] > 15.0, 0.15, 0.0) - 1.5 * ((xy[:, 1] > 20.0) & (xy[:, 1] < 26.0))
    for road in (None, driven((0, 14), 5.0)):
        ground = ground_of(at(xy, z), road=road)
        assert np.abs(ground[:30, :49]).max() < 0.05
        assert np.abs(ground[:30, 53:] - 0.15).max() < 0.06
        assert np.abs(ground[70:85, :49] + 1.5).max() < 0.05
    ground = ground_of(np.array([[0.5, 0.5, 7.0], [0.8, 0.5, 7.0], [0.5, 0.8, 7.0]]))
    assert ground[1, 1] == 7.0
    assert np.isnan(ground[50, 50])


@pytest.mark.parametrize(("rows", "begins"), [(5, False), (6, True)])
def test_apart_from_the_driven_path_ground_begins_only_where_more_than_thirty_cells_agree(
    rows: int, begins: bool
) -> None:
    """Farther from the street than ground goes on across a gap."""
    patch = np.array([(0.3 * (90.5 + c), 0.3 * (90.5 + r), -3.0) for r in range(rows) for c in range(6)])
    ground = ground_of(at(spread(12, y=(0, 10)), 0.0), patch, road=driven((0, 30), 5.0))
    assert np.isfinite(ground[92, 92]) == begins


def test_a_ramp_down_beside_a_retaining_wall_does_not_pull_the_street_down() -> None:
    """An underpass begins: the ramp falls to 3 m below the street, 0.3 m beside the lane."""
    xy = spread(5, 60_000)
    ground = ground_of(at(xy, np.where(xy[:, 1] > 10.0, -0.1 * xy[:, 0], 0.0)), road=driven((0, 30), 5.0))
    assert np.abs(ground[:32]).max() < 0.05
    assert np.abs(ground[36:] + 0.1 * X).max() < 0.2


def nothing_known() -> tuple[F32, U8]:
    """(ground, gap) of a tile."""
    return np.full(CELLS, np.nan, np.float32), np.full(CELLS, UNREACHED, np.uint8)


def starts(cells: I64) -> I32:
    """Where the points of each cell of a tile begin, of points in these cells, ascending."""
    return np.searchsorted(cells, np.arange(CELLS + 1)).astype(np.int32)


def test_a_point_may_lie_as_far_off_the_ground_beside_it_as_slopes_and_noise_allow() -> None:
    ground, gap = nothing_known()
    gap[[0, 2]], ground[[0, 2]] = 0, (0.0, 0.02)
    low, steep, high = _bounds(256, ground, gap, ONE_TILE)  # a row up: 0.3 m from one, 0.67 m from two
    assert (low, steep, high) == pytest.approx((-0.15 * 0.3 - 0.06, -0.5 * 0.3 - 0.06, 0.15 * 0.3 + 0.06))


@pytest.mark.parametrize(("rows", "cols"), [(5, 0), (-5, 0), (0, 5), (0, -5), (5, 5), (6, 0), (-6, 0), (0, 6), (0, -6)])
def test_ground_that_is_five_cells_away_bounds_a_point_and_farther_ground_does_not(rows: int, cols: int) -> None:
    ground, gap = np.zeros(CELLS, np.float32), nothing_known()[1]
    gap[(20 + rows) * TILE_CELLS + 20 + cols] = 0
    low, _, high = _bounds(20 * TILE_CELLS + 20, ground, gap, ONE_TILE)
    assert np.isfinite(low) == np.isfinite(high) == (max(abs(rows), abs(cols)) == 5)


@pytest.mark.parametrize(("higher", "raised_m"), [(3, 0.0), (4, 0.075), (8, 0.15)])
def test_a_lone_low_point_is_raised_to_the_mean_around_it_if_half_of_the_cells_there_are_a_kerb_higher(
    higher: int, raised_m: float
) -> None:
    middle = 10 * TILE_CELLS + 10
    beside = [middle + i * TILE_CELLS + j for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    ground, gap = np.zeros(CELLS, np.float32), np.ones(CELLS, np.uint8)
    gap[middle], around, out = 0, ground.copy(), ground.copy()
    around[beside[:higher]] = 0.15
    _raise_at_kerbs(starts(np.array([middle])), np.zeros(1, np.float32), ONE_TILE, ground, gap, around, out)
    assert out[middle] == pytest.approx(raised_m)


@pytest.mark.parametrize(("z", "continues"), [(-1.51, False), (-1.5, True), (0.0, True), (1.5, True), (1.51, False)])
def test_across_a_gap_ground_may_rise_and_fall_as_far_as_a_slope_and_noise_allow(z: float, continues: bool) -> None:
    """Over 64 units, 9.6 m, at .15 m a metre and 6 cm: 1.5 m."""
    cells, heights = 10 * TILE_CELLS + np.arange(10, 13), np.full(3, z, np.float32)
    found = _continued(cells[1], 0.0, 64, starts(cells), heights, *nothing_known(), ONE_TILE)
    assert np.isfinite(found) == continues
    assert not continues or found == np.float32(z)


def test_cells_around_count_if_they_hold_a_point_at_a_like_height_and_the_cell_itself_never() -> None:
    cells = np.array([r * TILE_CELLS + c for r in range(8, 13) for c in range(8, 13)])
    heights, middle = np.linspace(-0.05, 0.05, 25).astype(np.float32), 10 * TILE_CELLS + 10
    for held, count in ((cells == middle, 0), (cells == middle + TILE_CELLS, 1), (cells > 0, 24)):
        assert _like(middle, 0.0, 0.0, np.inf, 0.0, starts(cells[held]), heights[held], ONE_TILE) == count


def test_the_gap_widens_by_two_from_cell_to_cell_and_by_three_across_a_corner() -> None:
    ground, gap = nothing_known()
    ground[120 * TILE_CELLS + 90], gap[120 * TILE_CELLS + 90] = 7.0, SEED
    grow(np.zeros(CELLS + 1, np.int32), np.empty(0, np.float32), ONE_TILE, ground, gap)
    rows, cols = np.indices((TILE_CELLS, TILE_CELLS))
    apart = np.sort([abs(rows - 120), abs(cols - 90)], axis=0)
    away = 1 + 3 * apart[0] + 2 * (apart[1] - apart[0])
    assert np.array_equal(gap.reshape(rows.shape), np.where(away > WIDEST, UNREACHED, away))
    assert np.array_equal(np.isfinite(ground), gap <= WIDEST)
    assert (ground[gap <= WIDEST] == 7.0).all()


def test_tiles_know_those_around_them() -> None:
    assert tiles_around([(0, 0), (0, 1), (-1, 0)]).tolist() == [
        [[-1, 2, -1], [-1, 0, 1], [-1, -1, -1]],
        [[2, -1, -1], [0, 1, -1], [-1, -1, -1]],
        [[-1, -1, -1], [-1, 2, -1], [-1, 0, 1]],
    ]


def test_the_map_keeps_the_driven_level_of_a_bridge_and_its_street_and_the_lower_if_both_were() -> None:
    """A street along x at 0 m and, from x = 12 to 18, a bridge across it at 6 m; the street goes on below."""
    clouds = at(spread(6, 60_000), 0.0), at(spread(7, 12_000, (12, 18)), 6.0)
    below, across = driven((0, 30), 15.0), driven((0, 30), 15.0, 6.0)[:, [1, 0, 2]]
    assert np.abs(ground_of(*clouds, road=below)).max() < 0.05
    above = ground_of(*clouds, road=across)
    assert np.abs(above[:, 41:59] - 6.0).max() < 0.05
    assert np.abs(above[:, :30]).max() < 0.05, "off the bridge the street is ground again"
    both = ground_of(*clouds, road=np.vstack([below, across]))
    assert np.abs(both[50]).max() < 0.05
    assert np.abs(both[:40, 49:51] - 6.0).max() < 0.05
    assert np.abs(both[48:53, 42]).max() < 0.05, "beside a path its level holds"


def test_a_parked_car_and_a_hedge_do_not_lift_the_ground() -> None:
    road = at(spread(8), 0.0)
    free = ~((np.abs(road[:, 0] - 12) < 2.2) & (np.abs(road[:, 1] - 8) < 0.9))
    car = at(spread(9, 4000, (9.8, 14.2), (7.1, 8.9)), between(10, 4000, 0.2, 1.5))
    hedge = at(spread(11, 4000, y=(20, 21)), between(12, 4000, 0.05, 1.2))
    assert np.abs(ground_of(road[free], car, hedge, road=driven((0, 30), 3.0))).max() < 0.2


def test_the_sidewalk_begins_a_cell_behind_its_kerb_at_most_though_mixed_pixels_lie_at_the_foot_of_it() -> None:
    street = spread(9)
    mixed = at(spread(10, 150, y=(9.9, 10.6)), between(11, 150, -0.4, -0.1))
    ground = ground_of(at(street, np.where(street[:, 1] > 10.0, 0.15, 0.0)), mixed, road=driven((0, 30), 5.0))
    assert np.abs(ground[:32]).max() < 0.05
    assert np.quantile(ground[32:35], 0.01) > -0.08, "gutter, sidewalk, or between"
    assert ground[32:35].max() < 0.16
    assert np.mean(np.abs(ground[35:] - 0.15) > 0.05) < 0.001


def test_the_first_cells_behind_a_kerb_do_not_sink_to_the_gutter() -> None:
    """A few points of the gutter fall into them by pose errors, and some hold no point at all."""
    street = spread(10, 60_000)
    kerb = street[:, 1] > 9.9
    bare = kerb & (street[:, 1] < 10.2) & (street[:, 0] % 1.5 < 0.3)
    strays = at(np.column_stack([np.arange(0.15, 30.0, 0.9), np.full(34, 10.05)]), 0.0)
    ground = ground_of(at(street, np.where(kerb, 0.15, 0.0))[~bare], strays, road=driven((0, 30), 5.0))
    assert np.abs(ground[33, 1:-1] - 0.15).max() < 0.1, "0.15 where the gutter won"
    assert np.abs(ground[:33]).max() < 0.08


def sloping(seed: int) -> tuple[F64, F64]:
    """(points, road): a sloping road, a bank beside it and a hole where something stood."""
    xy, road = spread(seed, 50_000), driven((0, 30), 6.0)
    xy = xy[~((abs(xy[:, 0] - 14.0) < 2.0) & (abs(xy[:, 1] - 14.0) < 1.5))]
    road[:, 2] = 0.04 * road[:, 0]
    return at(xy, np.maximum(0.0, 0.12 * (xy[:, 1] - 16.0)) + 0.04 * xy[:, 0]), road


def assert_alike(again: F32, ground: F32) -> None:
    assert np.isnan(again).mean() == np.isnan(ground).mean()
    assert np.nanquantile(np.abs(again - ground), 0.999) < 0.05, "who comes first to a cell may differ"


@pytest.mark.parametrize("turn", [np.flipud, np.fliplr, np.transpose, np.rot90])
def test_which_way_is_north_does_not_matter(turn: Callable[[F32], F32]) -> None:
    points, road = sloping(6)
    points = np.vstack([points, at(spread(7, 3000, y=(22, 23)), between(8, 3000, 3.0, 5.0))])  # a hedge
    # the same cells of a square turned likewise, metres from its corner
    where = turn(np.arange(100 * 100, dtype=np.float32).reshape(100, 100)).ravel().astype(int)
    to = np.empty((10_000, 2))
    to[where] = np.argwhere(np.ones((100, 100)))

    def turned(cloud: F64) -> F64:
        cell = np.floor(cloud[:, :2] / CELL_SIZE).astype(int).clip(0, 99)
        return at(CELL_SIZE * (to[cell[:, 1] * 100 + cell[:, 0]][:, ::-1] + 0.5), cloud[:, 2])

    assert_alike(ground_of(turned(points), road=turned(road)), turn(ground_of(points, road=road)))


@pytest.mark.parametrize("cells", [206, 207, 200])
def test_the_border_of_a_tile_does_not_matter(cells: int) -> None:
    """With a corner of four tiles in the midst."""
    points, road = sloping(9)
    far = Lattice(-CELL_SIZE * cells, -CELL_SIZE * cells)
    assert len(map_from_points(points, lattice=far).tiles) == 4
    again, ground = ground_of(points, road=road, lattice=far, cells=cells), ground_of(points, road=road)
    assert np.array_equal(np.isnan(again), np.isnan(ground))
    assert_alike(again, ground)


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(-1e6, 1e6, width=32)), max_size=50))
def test_heights_are_sorted_within_their_cells_as_pairs_are(points: list[tuple[int, float]]) -> None:
    cells = np.array([cell for cell, _ in points], dtype=np.int64)
    z = np.array([height for _, height in points], dtype=np.float32)
    np.testing.assert_array_equal(_sorted_by_cell(cells, z), z[np.lexsort((z, cells))])


def test_the_ground_takes_the_point_among_close_ones_that_continues_it() -> None:
    lower = at(spread(9, 6_000, y=(12, 30)), 9.95)  # worn tarmac, mixed pixels: five centimetres below
    ground = ground_of(at(spread(8, 60_000), 10.0), lower, road=driven((0, 30), 5.0, 10.0))
    assert np.mean(np.abs(ground - 10.0) > 0.01) < 0.01, "but where no other point lies"


def test_a_column_without_ground_begins_no_higher_than_a_gentle_slope_from_any_known_ground_reaches() -> None:
    rng = np.random.default_rng(1)
    ground = rng.uniform(-3.0, 3.0, (24, 40)).astype(np.float32)
    ground[rng.random(ground.shape) < 0.9] = np.nan
    known = np.argwhere(np.isfinite(ground))
    for (row, col), layer in np.ndenumerate(base_layers(ground)):
        apart = np.sort(np.abs(known - (row, col)), axis=1)
        way = (apart[:, 1] - apart[:, 0]) + np.sqrt(2.0) * apart[:, 0]
        lowest = np.min(ground[tuple(known.T)].astype(np.float64) + 0.02 * CELL_SIZE * way)
        lowest = lowest if np.isnan(ground[row, col]) else np.float64(ground[row, col])
        assert layer in (np.floor(lowest / CELL_SIZE - 1e-9), np.floor(lowest / CELL_SIZE + 1e-9))


def test_ground_that_is_sown_later_grows_and_what_had_grown_stays() -> None:
    """The result is that of examining all of it again."""
    rng = np.random.default_rng(11)
    cells = np.sort(rng.choice(CELLS, CELLS // 3, replace=False))
    seen = starts(cells), rng.normal(0.0, 0.03, len(cells)).astype(np.float32), ONE_TILE
    ground, gap = nothing_known()
    ground[10 * TILE_CELLS + 10], gap[10 * TILE_CELLS + 10] = 0.0, SEED
    grow(*seen, ground, gap)
    before = ground.copy(), gap.copy()
    grow(*seen, ground, gap)
    np.testing.assert_array_equal(ground, before[0])
    np.testing.assert_array_equal(gap, before[1])
    assert (gap[cells] == 0).mean() > 0.8
    ground[-1], gap[-1] = 5.0, SEED
    grow(*seen, ground, gap)
    assert (gap <= before[1]).all()
    assert gap[-1] <= 1
