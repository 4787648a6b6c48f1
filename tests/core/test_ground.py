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
from mapvote.core.types import F32, F64

LATTICE = Lattice(-30.0, -30.0)
"""All that is tested lies well inside one tile."""


def ground_of(*clouds: F64, road: F64 | None = None, cells: int = 100) -> F32:
    """(cells, cells) the ground from (0, 0) upwards of a map of all clouds."""
    point_map = map_from_points(np.vstack(clouds), lattice=LATTICE, road=road)
    return reference_window(point_map, Grid(LATTICE, 100, 100, cells, cells)).ground_z


def spread(rng: np.random.Generator, count: int, x: tuple[float, float], y: tuple[float, float]) -> F64:
    return np.column_stack([rng.uniform(*x, count), rng.uniform(*y, count)])


def at(xy: F64, z: F64 | float) -> F64:
    return np.column_stack([xy, np.broadcast_to(z, len(xy))])


def driven(x: tuple[float, float], y: float, z: float = 0.0) -> F64:
    along = np.arange(*x, 0.15)
    return np.column_stack([along, np.full(len(along), y), np.full(len(along), z)])


def test_the_ground_follows_a_ramp_and_ignores_a_wall_and_an_awning() -> None:
    rng = np.random.default_rng(0)
    xy = spread(rng, 40_000, (0, 30), (0, 30))
    wall = np.column_stack([np.full(4000, 15.05), rng.uniform(0, 30, 4000), 1.5 + rng.uniform(0.2, 6.0, 4000)])
    awning = at(spread(rng, 2000, (20, 22), (5, 9)), 4.0)
    ground = ground_of(at(xy, 0.10 * xy[:, 0]), wall, awning)
    x = 0.3 * (np.arange(100) + 0.5)
    assert np.isfinite(ground).all()
    assert np.abs(ground - 0.10 * x[None, :]).max() < 0.1


def test_ground_far_from_any_point_is_unknown() -> None:
    ground = ground_of(np.array([[0.5, 0.5, 7.0], [0.8, 0.5, 7.0], [0.5, 0.8, 7.0]]))
    assert ground[1, 1] == 7.0
    assert np.isnan(ground[50, 50])


def test_the_ground_of_strays_costs_no_memory_and_changes_nothing_of_the_street() -> None:
    rng = np.random.default_rng(3)
    street = at(spread(rng, 20_000, (0, 30), (0, 30)), 0.0)
    strays = at(spread(rng, 5_000, (-90_000, 90_000), (-90_000, 90_000)), 0.0)
    strays = strays[np.abs(strays).max(axis=1) > 300.0]
    alone, among = (map_from_points(np.vstack(clouds), lattice=LATTICE) for clouds in ([street], [street, strays]))
    assert len(among.tiles) > 4_000
    assert len({tile.ground_z.ctypes.data for tile in among.tiles.values()}) < 20
    for index, tile in alone.tiles.items():
        np.testing.assert_array_equal(tile.ground_z, among.tiles[index].ground_z)


def test_reflections_below_the_road_do_not_sink_the_ground_alone_or_in_a_cluster() -> None:
    """As behind a van in KITTI drive 0005: twenty points within a metre, four metres below the road."""
    rng = np.random.default_rng(1)
    road = at(spread(rng, 40_000, (0, 30), (0, 30)), 0.0)
    alone = np.array([[9.0, 9.0, -5.4], [10.1, 9.6, -4.6], [21.0, 3.0, -23.0]])
    cluster = np.column_stack([spread(rng, 20, (12, 13), (12, 13)), rng.normal(-4.0, 0.1, 20)])
    assert np.abs(ground_of(road, alone, cluster)).max() < 0.05


def test_with_the_driven_path_known_even_a_mirrored_street_does_not_sink_the_ground() -> None:
    rng = np.random.default_rng(4)
    road = at(spread(rng, 40_000, (0, 30), (0, 30)), 0.0)
    mirrored = np.column_stack([spread(rng, 40_000, (0, 30), (6, 30)), rng.uniform(-5.0, -1.0, 40_000)])
    ground = ground_of(road, mirrored, road=driven((0, 30), 3.0))
    assert np.abs(ground).max() < 0.05


def test_a_kerb_and_a_sunken_yard_stay_ground() -> None:
    xy = spread(np.random.default_rng(3), 60_000, (0, 30), (0, 30))
    z = np.where(xy[:, 0] > 15.0, 0.15, 0.0) - 1.5 * ((xy[:, 1] > 20.0) & (xy[:, 1] < 26.0))
    for road in (None, driven((0, 14), 5.0)):
        ground = ground_of(at(xy, z), road=road)
        assert np.abs(ground[:30, :49]).max() < 0.05
        assert np.abs(ground[:30, 53:] - 0.15).max() < 0.06
        assert np.abs(ground[70:85, :49] + 1.5).max() < 0.05


def test_a_ramp_down_beside_a_retaining_wall_does_not_pull_the_street_down() -> None:
    """An underpass begins: the ramp falls to 3 m below the street, 0.3 m beside the lane."""
    xy = spread(np.random.default_rng(5), 60_000, (0, 30), (0, 30))
    ramp = xy[:, 1] > 10.0
    ground = ground_of(at(xy, np.where(ramp, -0.1 * xy[:, 0], 0.0)), road=driven((0, 30), 5.0))
    assert np.abs(ground[:32]).max() < 0.05
    x = 0.3 * (np.arange(100) + 0.5)
    assert np.abs(ground[36:] + 0.1 * x[None, :]).max() < 0.2


def test_a_point_may_lie_as_far_off_the_ground_beside_it_as_slopes_and_noise_allow() -> None:
    ground, gap = np.zeros(CELLS, np.float32), np.full(CELLS, UNREACHED, np.uint8)
    gap[0], gap[2] = 0, 0
    ground[2] = 0.02
    low, steep, high = _bounds(256, ground, gap, tiles_around([(0, 0)]))  # a row up: 0.3 m from one, 0.67 m from two
    assert low == pytest.approx(-0.15 * 0.3 - 0.06)
    assert steep == pytest.approx(-0.5 * 0.3 - 0.06)
    assert high == pytest.approx(0.15 * 0.3 + 0.06)


@pytest.mark.parametrize(("rows", "cols"), [(5, 0), (-5, 0), (0, 5), (0, -5), (5, 5), (6, 0), (-6, 0), (0, 6), (0, -6)])
def test_ground_that_is_five_cells_away_bounds_a_point_and_farther_ground_does_not(rows: int, cols: int) -> None:
    ground, gap = np.zeros(CELLS, np.float32), np.full(CELLS, UNREACHED, np.uint8)
    gap[(20 + rows) * TILE_CELLS + 20 + cols] = 0
    low, _, high = _bounds(20 * TILE_CELLS + 20, ground, gap, tiles_around([(0, 0)]))
    assert np.isfinite(low) == np.isfinite(high) == (max(abs(rows), abs(cols)) == 5)


@pytest.mark.parametrize(("higher", "raised_m"), [(3, 0.0), (4, 0.075), (8, 0.15)])
def test_a_lone_low_point_is_raised_to_the_mean_around_it_if_half_of_the_cells_there_are_a_kerb_higher(
    higher: int, raised_m: float
) -> None:
    middle = 10 * TILE_CELLS + 10
    beside = [middle + i * TILE_CELLS + j for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    start = (np.arange(CELLS + 1) > middle).astype(np.int32)
    ground, gap = np.zeros(CELLS, np.float32), np.ones(CELLS, np.uint8)
    gap[middle], around, out = 0, ground.copy(), ground.copy()
    around[beside[:higher]] = 0.15
    _raise_at_kerbs(start, np.zeros(1, np.float32), tiles_around([(0, 0)]), ground, gap, around, out)
    assert out[middle] == pytest.approx(raised_m)


@pytest.mark.parametrize(("z", "continues"), [(-1.51, False), (-1.5, True), (0.0, True), (1.5, True), (1.51, False)])
def test_across_a_gap_ground_may_rise_and_fall_as_far_as_a_slope_and_noise_allow(z: float, continues: bool) -> None:
    """Over 64 units, 9.6 m, at .15 m a metre and 6 cm: 1.5 m."""
    cells, ground = 10 * TILE_CELLS + np.arange(10, 13), np.full(CELLS, np.nan, np.float32)
    start = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=CELLS))]).astype(np.int32)
    heights, unreached = np.full(3, z, np.float32), np.full(CELLS, UNREACHED, np.uint8)
    found = _continued(cells[1], 0.0, 64, start, heights, ground, unreached, tiles_around([(0, 0)]))
    assert np.isfinite(found) == continues
    assert not continues or found == np.float32(z)


def test_of_24_cells_around_those_count_that_hold_a_point_at_a_like_height_and_the_cell_itself_never() -> None:
    around = [(r, c) for r in range(8, 13) for c in range(8, 13)]
    cells = np.array([r * TILE_CELLS + c for r, c in around])
    heights, middle = np.linspace(-0.05, 0.05, 25).astype(np.float32), 10 * TILE_CELLS + 10
    for held, count in ((cells == middle, 0), (cells == middle + TILE_CELLS, 1), (cells > 0, 24)):
        points = np.bincount(cells[held], minlength=CELLS)
        start = np.concatenate([[0], np.cumsum(points)]).astype(np.int32)
        assert _like(middle, 0.0, 0.0, np.inf, 0.0, start, heights[held], tiles_around([(0, 0)])) == count


def test_where_nothing_was_measured_the_gap_widens_by_two_from_cell_to_cell_and_by_three_across_a_corner() -> None:
    ground, gap = np.full(CELLS, np.nan, np.float32), np.full(CELLS, UNREACHED, np.uint8)
    ground[120 * TILE_CELLS + 90], gap[120 * TILE_CELLS + 90] = 7.0, SEED
    grow(np.zeros(CELLS + 1, np.int32), np.empty(0, np.float32), tiles_around([(0, 0)]), ground, gap)
    rows, cols = np.indices((TILE_CELLS, TILE_CELLS))
    apart = np.sort([abs(rows - 120), abs(cols - 90)], axis=0)
    away = 1 + 3 * apart[0] + 2 * (apart[1] - apart[0])
    assert np.array_equal(gap.reshape(rows.shape), np.where(away > WIDEST, UNREACHED, away))
    assert np.array_equal(np.isfinite(ground), gap <= WIDEST)
    assert (ground[gap <= WIDEST] == 7.0).all()


def test_tiles_know_those_around_them() -> None:
    around = tiles_around([(0, 0), (0, 1), (-1, 0)])
    assert around.tolist() == [
        [[-1, 2, -1], [-1, 0, 1], [-1, -1, -1]],
        [[2, -1, -1], [0, 1, -1], [-1, -1, -1]],
        [[-1, -1, -1], [-1, 2, -1], [-1, 0, 1]],
    ]


def _bridge(rng: np.random.Generator) -> F64:
    """A street along x at 0 m and, from x = 12 to 18, a bridge across it at 6 m; the street goes on below."""
    street = at(spread(rng, 60_000, (0, 30), (0, 30)), 0.0)
    return np.vstack([street, at(spread(rng, 12_000, (12, 18), (0, 30)), 6.0)])


def test_of_a_bridge_and_the_street_below_the_map_keeps_the_one_that_was_driven() -> None:
    rng = np.random.default_rng(6)
    below = ground_of(_bridge(rng), road=driven((0, 30), 15.0))
    assert np.abs(below).max() < 0.05
    across = driven((0, 30), 15.0, 6.0)[:, [1, 0, 2]]
    above = ground_of(_bridge(rng), road=across)
    assert np.abs(above[:, 41:59] - 6.0).max() < 0.05
    assert np.abs(above[:, :30]).max() < 0.05, "off the bridge the street is ground again"


def test_where_both_levels_were_driven_the_cells_below_both_paths_go_to_the_lower() -> None:
    rng = np.random.default_rng(7)
    both = np.vstack([driven((0, 30), 15.0), driven((0, 30), 15.0, 6.0)[:, [1, 0, 2]]])
    ground = ground_of(_bridge(rng), road=both)
    assert np.abs(ground[50]).max() < 0.05
    assert np.abs(ground[:40, 49:51] - 6.0).max() < 0.05
    assert np.abs(ground[48:53, 42]).max() < 0.05, "beside a path its level holds"


def test_a_parked_car_and_a_hedge_do_not_lift_the_ground() -> None:
    rng = np.random.default_rng(8)
    road = at(spread(rng, 40_000, (0, 30), (0, 30)), 0.0)
    free = ~((np.abs(road[:, 0] - 12) < 2.2) & (np.abs(road[:, 1] - 8) < 0.9))
    car = np.column_stack([spread(rng, 4000, (9.8, 14.2), (7.1, 8.9)), rng.uniform(0.2, 1.5, 4000)])
    hedge = np.column_stack([spread(rng, 4000, (0, 30), (20, 21)), rng.uniform(0.05, 1.2, 4000)])
    ground = ground_of(road[free], car, hedge, road=driven((0, 30), 3.0))
    assert np.abs(ground).max() < 0.2


def test_the_sidewalk_begins_a_cell_behind_its_kerb_at_most_though_mixed_pixels_lie_at_the_foot_of_it() -> None:
    rng = np.random.default_rng(9)
    street = spread(rng, 40_000, (0, 30), (0, 30))
    kerb = street[:, 1] > 10.0
    road, walk = at(street[~kerb], 0.0), at(street[kerb], 0.15)
    mixed = np.column_stack([spread(rng, 150, (0, 30), (9.9, 10.6)), rng.uniform(-0.4, -0.1, 150)])
    ground = ground_of(road, walk, mixed, road=driven((0, 30), 5.0))
    assert np.abs(ground[:32]).max() < 0.05
    assert ground[32:35].min() > -0.08, "gutter, sidewalk, or between"
    assert ground[32:35].max() < 0.16
    assert np.abs(ground[35:] - 0.15).max() < 0.05


def test_the_first_cells_behind_a_kerb_do_not_sink_to_the_gutter() -> None:
    """A few points of the gutter fall into them by pose errors, and some hold no point at all."""
    rng = np.random.default_rng(10)
    street = spread(rng, 60_000, (0, 30), (0, 30))
    kerb = street[:, 1] > 9.9
    bare = kerb & (street[:, 1] < 10.2) & (street[:, 0] % 1.5 < 0.3)
    strays = at(np.column_stack([np.arange(0.15, 30.0, 0.9), np.full(34, 10.05)]), 0.0)
    ground = ground_of(at(street[~kerb], 0.0), at(street[kerb & ~bare], 0.15), strays, road=driven((0, 30), 5.0))
    off = np.abs(ground[33, 1:-1] - 0.15)
    assert off.max() < 0.1, "0.15 where the gutter won"
    assert np.abs(ground[:33]).max() < 0.08


@pytest.mark.parametrize("turn", [np.flipud, np.fliplr, np.transpose, np.rot90])
def test_which_way_is_north_does_not_matter(turn: Callable[[F32], F32]) -> None:
    """A road on one side, a bank and a hedge on the other, a hole where something stood: laid out any way round."""
    rng = np.random.default_rng(6)
    xy = spread(rng, 50_000, (0, 30), (0, 30))
    xy = xy[~((abs(xy[:, 0] - 12.0) < 2.0) & (abs(xy[:, 1] - 14.0) < 1.5))]
    bank = np.maximum(0.0, 0.12 * (xy[:, 1] - 16.0)) + 0.04 * xy[:, 0]
    hedge = np.column_stack([spread(rng, 3000, (0, 30), (22, 23)), rng.uniform(3.0, 5.0, 3000)])
    points = np.vstack([at(xy, bank), hedge])
    road = driven((0, 30), 6.0)
    road[:, 2] = 0.04 * road[:, 0]
    ground = turn(ground_of(points, road=road))
    # the same cells of a square turned likewise, metres from its corner
    where = turn(np.arange(100 * 100, dtype=np.float32).reshape(100, 100)).ravel().astype(int)
    to = np.empty((10_000, 2))
    to[where] = np.argwhere(np.ones((100, 100)))
    cell = np.floor(points[:, :2] / CELL_SIZE).astype(int).clip(0, 99)
    turned = [np.column_stack([CELL_SIZE * (to[c[:, 1] * 100 + c[:, 0]][:, ::-1] + 0.5), z]) for c, z in (
        (cell, points[:, 2]), (np.floor(road[:, :2] / CELL_SIZE).astype(int).clip(0, 99), road[:, 2]))]  # fmt: skip
    again = ground_of(turned[0], road=turned[1])
    assert np.isnan(again).mean() == np.isnan(ground).mean()
    assert np.nanquantile(np.abs(again - ground), 0.999) < 0.05, "who comes first to a cell may differ"


@pytest.mark.parametrize("cells", [206, 207, 200])
def test_where_a_tile_ends_does_not_matter(cells: int) -> None:
    """A sloping road, a bank and a hole where something stood, with a corner of four tiles in their midst."""
    rng = np.random.default_rng(9)
    xy = spread(rng, 50_000, (0, 30), (0, 30))
    xy = xy[~((abs(xy[:, 0] - 14.0) < 2.0) & (abs(xy[:, 1] - 14.0) < 1.5))]
    points = at(xy, np.maximum(0.0, 0.12 * (xy[:, 1] - 16.0)) + 0.04 * xy[:, 0])
    road = driven((0, 30), 6.0)
    road[:, 2] = 0.04 * road[:, 0]
    far = Lattice(-CELL_SIZE * cells, -CELL_SIZE * cells)
    cut = map_from_points(points, lattice=far, road=road)
    assert len(cut.tiles) == 4
    ground, again = ground_of(points, road=road), reference_window(cut, Grid(far, cells, cells, 100, 100)).ground_z
    assert np.array_equal(np.isnan(again), np.isnan(ground))
    assert np.nanquantile(np.abs(again - ground), 0.999) < 0.05, "who comes first to a cell may differ"


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(-1e6, 1e6, width=32)), max_size=50))
def test_heights_are_sorted_within_their_cells_as_pairs_are(points: list[tuple[int, float]]) -> None:
    cells = np.array([cell for cell, _ in points], dtype=np.int64)
    z = np.array([height for _, height in points], dtype=np.float32)
    np.testing.assert_array_equal(_sorted_by_cell(cells, z), z[np.lexsort((z, cells))])


def test_of_points_that_lie_close_the_ground_takes_the_one_that_continues_it() -> None:
    rng = np.random.default_rng(8)
    xy = spread(rng, 60_000, (0, 30), (0, 30))
    lower = at(spread(rng, 6_000, (0, 30), (12, 30)), 9.95)  # worn tarmac, mixed pixels: five centimetres below
    ground = ground_of(at(xy, 10.0), lower, road=driven((0, 30), 5.0, 10.0))
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
    """As it does where all of it is looked at again."""
    rng = np.random.default_rng(11)
    cells = np.sort(rng.choice(CELLS, CELLS // 3, replace=False))
    heights = rng.normal(0.0, 0.03, len(cells)).astype(np.float32)
    start = np.searchsorted(cells, np.arange(CELLS + 1)).astype(np.int32)
    around = tiles_around([(0, 0)])
    ground, gap = np.full(CELLS, np.nan, np.float32), np.full(CELLS, UNREACHED, np.uint8)
    ground[10 * TILE_CELLS + 10], gap[10 * TILE_CELLS + 10] = 0.0, SEED
    grow(start, heights, around, ground, gap)
    before = ground.copy(), gap.copy()
    grow(start, heights, around, ground, gap)
    assert np.array_equal(ground, before[0], equal_nan=True)
    assert np.array_equal(gap, before[1])
    assert (gap[cells] == 0).mean() > 0.8
    ground[-1], gap[-1] = 5.0, SEED
    grow(start, heights, around, ground, gap)
    assert (gap <= before[1]).all()
    assert gap[-1] <= 1
