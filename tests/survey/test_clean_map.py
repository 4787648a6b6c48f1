"""Scans become a map that holds what stands, near and far: no trails, noise or reflections."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import make_map, make_tile, one_scan, wall
from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, I64, Drive, Scan
from mapvote.core.voxels import VoxelCloud, thin, voxel_downsample
from mapvote.survey.clean_map import (
    CLEANING,
    Mapper,
    _leave_out,
    _unbroken,
    lone_points,
    mirrored,
    seen_through,
    specks,
    strays,
    trails,
    without_lone_points,
)
from mapvote.survey.pose_graph import DriveTrack

LATTICE = Lattice()


def road(places: int) -> F64:
    """Twice past the origin, ten metres off: ``places`` positions, a metre or more apart."""
    x = np.linspace(-15.0, 15.0, places // 2)
    return np.concatenate([np.column_stack([x, np.full(len(x), y), np.zeros(len(x))]) for y in (-10.0, -11.5)])


def test_a_point_that_one_scan_of_sixty_met_is_no_surface_and_where_few_scans_were_taken_one_is_enough() -> None:
    points, scans = np.array([[0.1, 0.1, 2.0], [3.1, 0.1, 2.0], [6.1, 0.1, 2.0]]), np.array([1, 2, 40], np.int32)
    assert strays(points, scans, road(60), LATTICE).tolist() == [True, False, False]
    waiting = np.concatenate([road(40), np.repeat([[5.0, -10.0, 0.0]], 600, axis=0)])  # at a light
    for driven in (road(14), road(60) - np.array([0.0, CLEANING.near_m, 0.0]), np.zeros((0, 3))):
        assert not strays(points, scans, driven, LATTICE).any()
    assert not strays(points, scans + 2, waiting, LATTICE).any()


def test_a_point_is_tested_against_all_places_within_twenty_metres() -> None:
    """One after the other, as the words have it."""
    rng = np.random.default_rng(2)
    driven = np.concatenate([road(60), road(60) * 1.3 + [40.0, 5.0, 0.0], [[200.0, 0.0, 0.0]]])
    points, scans = rng.uniform(-45.0, 90.0, (3000, 3)), rng.integers(1, 6, 3000).astype(np.int32)
    places = driven[thin(driven, 1.0)]
    passed = (np.hypot(*(points[:, None, :2] - places[None, :, :2]).transpose(2, 0, 1)) < CLEANING.near_m).sum(axis=1)
    assert 0 < (scans < CLEANING.hit_share * passed).sum() < 3000
    apart = voxel_downsample(points, 3.0)
    expected = (scans < CLEANING.hit_share * passed)[apart]
    np.testing.assert_array_equal(strays(points[apart], scans[apart], driven, LATTICE), expected)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_wall_two_centimetres_from_a_face_is_one_wall(axis: int, side: float) -> None:
    rng = np.random.default_rng(1)
    face = 3.0
    cloud = VoxelCloud(LATTICE)
    for _ in range(50):
        wall = np.column_stack([np.full(200, face + 0.02 * side), rng.uniform(0, 3, 200), rng.uniform(1, 3, 200)])
        wall[:, 0] += rng.normal(0.0, 0.02, 200)
        cloud.enter(wall if axis == 0 else wall[:, [1, 0, 2]])
    points, scans = cloud.points()
    kept = points[~strays(points, scans, np.zeros((0, 3)), LATTICE)]
    over = (points[:, axis] - face) * side < 0
    assert over.any(), "noise carries some over the face"
    assert ((kept[:, axis] - face) * side > 0).all()
    assert len(kept) == np.count_nonzero(~over)


@pytest.mark.parametrize("lattice", [Lattice(), Lattice(100.1, -57.2)])
def test_voxels_begin_where_the_lattice_says(lattice: Lattice) -> None:
    face = np.array([lattice.x0 + 30 * 0.3, lattice.y0 + 7.1 * 0.3, 2.1])
    points = face + np.array([[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0], [0.62, 0.0, 0.0]])
    spilled = strays(points, np.array([3, 30, 3], np.int32), np.zeros((0, 3)), lattice)
    assert spilled.tolist() == [True, False, False]


def test_two_walls_a_hand_apart_stay_two() -> None:
    cloud = VoxelCloud(LATTICE)
    for x in (2.93, 3.05):
        cloud.enter(np.column_stack([np.full(100, x), np.linspace(0, 3, 100), np.full(100, 2.0)]))
    points, scans = cloud.points()
    assert not strays(points, scans, np.zeros((0, 3)), LATTICE).any()


def row_of(n: int) -> F64:
    """(n, 3) a point in each of ``n`` voxels that touch."""
    return np.column_stack([np.arange(n) * 0.3 + 0.1, np.full(n, 0.1), np.full(n, 2.1)])


@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), unique=True, max_size=25), st.data())
@settings(max_examples=60, deadline=None)
def test_specks_are_the_small_groups_of_touching_voxels_that_were_hit_once_each(
    voxels: list[tuple[int, int, int]], data: st.DataObject
) -> None:
    times = data.draw(st.lists(st.integers(1, 2), min_size=len(voxels), max_size=len(voxels)))
    left, expected = set(range(len(voxels))), np.zeros(len(voxels), np.bool_)
    while left:
        group, ring = set[int](), {left.pop()}
        while ring:
            group |= ring
            ring = {j for j in left if any(np.abs(np.subtract(voxels[i], voxels[j])).max() <= 1 for i in ring)}
            left -= ring
        expected[list(group)] = len(group) <= CLEANING.largest_speck and all(times[i] == 1 for i in group)
    points = 0.3 * (np.array(voxels, dtype=np.float64).reshape(-1, 3) + 0.5)
    np.testing.assert_array_equal(specks(points, np.array(times, np.int32), LATTICE), expected)
    twice = np.concatenate([points, points[:1] + 0.01])  # a second point in the first voxel
    alone = specks(twice, np.ones(len(twice), np.int32), LATTICE)[: len(points)]
    assert not alone[:1].any()


@pytest.mark.parametrize("n", [CLEANING.largest_speck, CLEANING.largest_speck + 1])
def test_five_voxels_in_a_row_are_a_speck_and_six_are_an_object(n: int) -> None:
    assert (specks(row_of(n), np.ones(n, np.int32), LATTICE) == (n <= CLEANING.largest_speck)).all()


def test_a_voxel_that_rays_crossed_often_and_few_scans_hit_was_a_trail() -> None:
    hit_passed_crossed = np.array(
        [[1, 9, CLEANING.seen_through], [0, 9, CLEANING.seen_through - 1], [9, 9, 9], [2, 40, 0]]
    )
    assert seen_through(hit_passed_crossed).tolist() == [True, False, False, False]


def test_a_lone_point_of_a_foreign_map_is_dropped_and_a_wall_or_a_pole_stays() -> None:
    ground = wall([(r, c) for r in range(10, 40) for c in range(10, 40)], [0.05])
    pole = wall([(20, 20)], [0.45 + 0.3 * k for k in range(8)])
    lone = np.array([[9.1, 9.1, 3.1]])
    at_the_edge = np.array([[0.1, 9.1, 3.1]])
    points = np.concatenate([ground, pole, lone, at_the_edge]) - [0.0, 0.0, 20.0]  # below zero as anywhere else
    tile = make_tile(points.astype(np.float32), ground=-20.0)
    assert np.flatnonzero(lone_points(tile)).tolist() == [len(ground) + len(pole)]
    cleaned, dropped = without_lone_points(make_map({(0, 0): tile}))
    assert (dropped, cleaned.n_points) == (1, len(tile.points) - 1)


def test_cells_taller_than_a_lorry_or_of_unknown_height_are_no_trail() -> None:
    points, passed = row_of(3), np.full(3, -5)
    assert trails(points, passed, np.array([1.0, CLEANING.tall_m, np.nan]), LATTICE).tolist() == [True, False, False]
    column = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, 5.0]])
    assert not trails(column, np.full(2, -5), column[:, 2], LATTICE).any(), "one cell, and it rises to five metres"


def test_a_map_without_a_point_has_no_trails_and_no_strays() -> None:
    none = np.zeros((0, 3))
    assert trails(none, np.zeros(0, np.int64), np.zeros(0), LATTICE).shape == (0,)
    assert strays(none, np.zeros(0, np.int32), road(60), LATTICE).shape == (0,)


def by_hand(cells: dict[tuple[int, int], int]) -> set[tuple[int, int]]:
    """The cells whose 8-connected group has a sum below zero."""
    left, out = set(cells), set()
    while left:
        group, ring = set(), {left.pop()}
        while ring:
            group |= ring
            ring = {(r + i, c + k) for r, c in ring for i in (-1, 0, 1) for k in (-1, 0, 1)} & left
            left -= ring
        out |= group if sum(cells[cell] for cell in group) < 0 else set()
    return out


VOXELS = st.tuples(st.integers(-300, -290), st.integers(-6, 6), st.integers(-9, 9))


@given(st.lists(VOXELS, min_size=1, max_size=50))
def test_trails_are_the_groups_of_cells_that_touch_and_were_passed_more_often_on_either_side_of_the_origin(
    voxels: list[tuple[int, int, int]],
) -> None:
    """Several voxels of a cell are one."""
    points = np.array([[(c + 0.5) * CELL_SIZE, (r + 0.5) * CELL_SIZE, 1.0] for r, c, _ in voxels])
    balance: I64 = np.array([hit for _, _, hit in voxels])
    cells: dict[tuple[int, int], int] = {}
    for r, c, hit in voxels:
        cells[r, c] = cells.get((r, c), 0) + hit
    trail = by_hand(cells)
    assert trails(points, balance, points[:, 2], LATTICE).tolist() == [(r, c) in trail for r, c, _ in voxels]


OFF_ORIGIN = Lattice(-30.0, -30.0)


def box(*steps: tuple[float, ...]) -> F64:
    """(n, 3) points on the grid of three ranges (from, to, step); one number is that coordinate of all points."""
    return np.stack(np.meshgrid(*(np.arange(*s) if len(s) == 3 else np.array(s) for s in steps)), axis=-1).reshape(
        -1, 3
    )


def sheet(x: tuple[float, float], y: tuple[float, float], z: float) -> F64:
    """A level surface, a point every 0.15 m."""
    return box((*x, 0.15), (*y, 0.15), (z,))


def road_along(y: float, z: float = 0.0) -> F64:
    along = np.arange(0.0, 30.0, 0.15)
    return np.column_stack([along, np.full(len(along), y), np.full(len(along), z)])


def left_out(cloud: F64, driven: F64, asked: F64) -> list[bool]:
    """Which of the points ``asked`` are taken for reflections in a map of ``cloud`` and them."""
    points = np.vstack([cloud, asked])
    out = mirrored(points, map_from_points(points, lattice=OFF_ORIGIN, road=driven), driven)
    return [bool(left) for left in out[len(cloud) :]]


def test_points_metres_below_the_road_are_reflections_and_the_road_is_none() -> None:
    street = sheet((0, 30), (0, 20), 0.0)
    below = np.array([[10.0, 5.0, -1.2], [12.0, 9.0, -7.0], [12.1, 9.1, -7.1], [20.0, 5.0, -0.3], [21.0, 5.0, 0.0]])
    assert left_out(street, road_along(5.0), below) == [True, True, True, False, False]
    assert not any(left_out(street[::2], road_along(5.0), street[1::2]))


def test_the_wall_down_to_a_yard_beside_the_street_stays() -> None:
    street, yard = sheet((0, 30), (0, 10), 0.0), sheet((0, 30), (10, 20), -3.0)
    wall = np.column_stack([np.full(10, 15.0), np.full(10, 10.0), np.linspace(-2.8, -0.2, 10)])
    assert not any(left_out(np.vstack([street, yard]), road_along(5.0), wall))
    assert left_out(np.vstack([street, yard]), road_along(5.0), np.array([[15.0, 15.0, -5.0]])) == [True]


def test_ground_is_broken_up_to_two_cells_beside_a_leap_and_beside_what_is_not_known() -> None:
    step = np.where(np.arange(20) < 10, 0.0, 0.6) + np.zeros((20, 1))
    step[:, 18:] = np.nan
    for ground_z in (step, step.T):
        broken = ~_unbroken(ground_z.astype(np.float32))
        expected = np.isin(np.arange(20), [8, 9, 10, 11, 16, 17, 18, 19])
        assert (broken == (expected if ground_z is step else expected[:, None])).all()
    assert _unbroken((0.8 * step[:, :18]).astype(np.float32)).all(), "a step of less than half a metre is none"


def test_points_below_a_bridge_that_vehicles_drove_under_stay() -> None:
    street, bridge = sheet((0, 30), (0, 30), 0.0), sheet((12, 18), (0, 30), 6.0)
    over, under = road_along(15.0, 6.0)[:, [1, 0, 2]], road_along(15.0)
    kerb = np.array([[15.0, 5.0, 0.1]])  # below the bridge, beside its path: there the map keeps the bridge
    assert left_out(np.vstack([street, bridge]), np.vstack([under, over]), kerb) == [False]
    assert left_out(np.vstack([street, bridge]), over, kerb) == [True], "one level a cell: the street was not driven"


def test_a_bridge_that_is_far_away_protects_no_reflection() -> None:
    street, bridge = sheet((0, 120), (12, 18), 0.0), sheet((6, 9), (12, 18), 6.0)
    under = np.column_stack([np.arange(0.0, 120.0, 0.15), np.full(800, 15.0), np.zeros(800)])
    over = np.column_stack([np.full(40, 7.5), np.arange(12.0, 18.0, 0.15), np.full(40, 6.0)])
    below = np.array([[20.0, 15.0, -3.0], [110.0, 15.0, -3.0]])
    assert left_out(np.vstack([street, bridge]), np.vstack([under, over]), below) == [False, True]


AHEAD_M = 60.0
WALL_X = 100.0


def scene(sensor_x: float) -> F64:
    """A road to a wall across its end, and the back of a van that keeps 60 m ahead of the sensor."""
    wall = box((WALL_X,), (-8.0, 8.0, 0.3), (0.1, 6.0, 0.3))
    rest = np.concatenate([box((-20.0, WALL_X, 0.5), (-8.0, 8.0, 0.5), (0.0,)), wall])
    hidden = (rest[:, 0] > sensor_x + AHEAD_M) & (np.abs(rest[:, 1]) < 1.7) & (rest[:, 2] < 2.6)
    back = box((sensor_x + AHEAD_M,), (-1.0, 1.1, 0.25), (0.4, 2.6, 0.25))
    return np.concatenate([rest[~hidden], back])


def mapped(seen: Callable[[int], F64], x: F64, draft: F64, **mapping: object) -> F64:
    """The points of the map of a drive at 10 m/s that ``seen`` gives the world at each scan, from ``x`` (n,)."""
    poses = np.array([from_xyz_rpy(at, 0.0, 1.8) for at in x])
    stamps_ns = np.arange(1, len(x) + 1) * 100_000_000

    def read_scan(i: int) -> Scan:
        return Scan(int(stamps_ns[i]), transform(inverse(poses[i]), seen(i)).astype(np.float32))

    drive = Drive(Path("d"), "survey", "d", SENSORS["hdl32e"], stamps_ns, read_scan)
    own = Settings().mapping.model_copy(update=mapping)
    mapper = Mapper(map_from_points(draft), Settings().model_copy(update={"mapping": own}))
    for _ in mapper.enter(DriveTrack(drive, poses, np.ones(len(x), np.bool_), (), np.full(len(x), np.nan))):
        pass
    return all_points(mapper.finish())


@pytest.mark.parametrize(("passed", "stays"), [(3, False), (0, True)])
def test_a_row_that_more_scans_passed_than_hit_stays_out_of_the_map(passed: int, stays: bool) -> None:
    road = wall([(r, c) for r in range(40) for c in range(40)], [0.05]).astype(np.float64)
    street, row = make_map({(0, 0): make_tile(road.astype(np.float32))}), row_of(8) + np.array([3.0, 3.0, -0.45])
    mapper = Mapper(street, Settings())
    hit = one_scan(street, np.concatenate([road, row]))
    mapper._add([hit, *[one_scan(street, road)] * passed])
    assert (all_points(mapper.finish())[:, 2] > 1.0).any() == stays


@pytest.mark.parametrize(
    ("cells", "z", "out"),
    [
        (
            [(1, 2), (1, 2), (1, 3), (0, 1), (2, 3), (1, 0), (3, 2), (1, 3)],
            [0.8, 0.05, 0.2, 0.2, 0.2, 0.2, 0.2, 0.8],
            [True, False, True, True, True, False, False, False],
        ),
        ([(0, 0), (0, 0), (0, 1), (2, 0)], [0.8, 0.2, 0.2, 0.2], [True, True, True, False]),
        ([(2, 2), (0, 2), (3, 3), (2, 0)], [0.8, 0.2, 0.2, 0.2], [True, False, True, False]),
    ],
)
def test_in_and_beside_cells_where_something_moves_low_points_stay_out_but_for_the_road_itself(
    cells: list[tuple[int, int]], z: list[float], out: list[bool]
) -> None:
    """The first of the points moves."""
    n, flat = len(z), np.array([4 * r + c for r, c in cells], np.int32)
    points, found = np.column_stack([np.ones((n, 2)), z]), np.zeros(n, np.bool_)
    obstacle, scratch = points[:, 2] >= 0.3, np.zeros(16, np.bool_)
    ground_z = np.zeros((4, 4), np.float32)
    _leave_out(points, np.zeros(3), 1e4, CLEANING.road_m, np.arange(n) == 0, obstacle, flat, ground_z, scratch, found)
    assert found.tolist() == out


def test_points_beyond_the_reach_in_the_plane_stay_out() -> None:
    origin = np.array([20.0, -70.0, 900.0])
    points = np.array([[3.0, 3.9, 50.0], [3.0, 4.1, 0.0], [-3.1, 4.0, 0.0], [-2.9, -4.0, -9.0]]) + origin
    outside, out = np.full(4, -1, np.int32), np.zeros(4, np.bool_)
    nothing, ground_z = np.zeros(4, np.bool_), np.zeros((1, 1), np.float32)
    _leave_out(points, origin, 25.0, CLEANING.road_m, nothing, nothing, outside, ground_z, np.zeros(1, np.bool_), out)
    assert out.tolist() == [False, True, True, False]


@pytest.mark.parametrize("ground_m", [0.0, 6.3, -9.3])
def test_scans_that_hit_a_voxel_and_scans_that_passed_it_are_counted_apart(ground_m: float) -> None:
    road = wall([(r, c) for r in range(40) for c in range(40)], [0.05]) + np.array([0, 0, ground_m], np.float32)
    street = make_map({(0, 0): make_tile(road, ground_m + 0.05)})
    one, other = np.array([[3.15, 3.15, ground_m + 1.65]]), np.array([[9.15, 9.15, ground_m + 1.65]])
    mapper = Mapper(street, Settings())
    mapper._add([one_scan(street, one), one_scan(street, one), one_scan(street, other)])
    assert mapper._counts(np.concatenate([one, other]))[:, :2].tolist() == [[2, 1], [1, 2]]


def test_a_van_that_is_never_nearer_than_60_m_leaves_no_trail_and_a_wall_never_nearer_than_70_m_stays() -> None:
    """Three seconds at 10 m/s behind the van, which is at 89 m when they end."""
    points = mapped(lambda i: scene(float(i)), np.arange(30.0), np.concatenate([scene(float(x)) for x in range(30)]))
    trail = (points[:, 0] > 61.0) & (points[:, 0] < 87.5) & (np.abs(points[:, 1]) < 1.5) & (points[:, 2] > 0.3)
    assert not trail.any()
    assert (np.abs(points[:, 0] - WALL_X) < 0.2).sum() > 700  # of 54 x 20 voxels, less what the van hid
    assert points[:, 0].min() > -20.5


def test_returns_from_farther_than_the_reach_do_not_enter_the_map() -> None:
    points = mapped(lambda i: scene(0.0), np.zeros(2), scene(0.0), reach_m=65.0)
    assert 60.0 < np.hypot(*points[:, :2].T).max() <= 65.0


@pytest.mark.parametrize("drop", [True, False])
def test_a_point_that_one_scan_of_many_hit_stays_out_unless_strays_are_kept(drop: bool) -> None:
    street = box((-20.0, 80.0, 0.5), (-8.0, 8.0, 0.5), (0.0,))
    stray = np.concatenate([street, [[30.1, 5.1, 2.0]]])
    points = mapped(lambda i: stray if i == 50 else street, np.arange(60.0), street, drop_strays=drop)
    assert (points[:, 2] > 1.0).any() != drop


def test_a_vehicle_that_drove_past_a_parked_car_leaves_no_trail_beside_it() -> None:
    """Hits on the car strike the voxels next to it too; all scans but the two that hit the other see through those."""
    ground, house = box((-20.0, 60.0, 0.5), (-8.0, 8.0, 0.5), (0.0,)), box((-20, 60, 0.3), (8.0,), (0.15, 6.0, 0.3))
    parked, passing = (box((20.0, 24.0, 0.1), (y,), (0.5, 1.5, 0.1)) for y in (5.0, 4.65))
    street = np.concatenate([ground, house, parked])
    both = np.concatenate([street, passing])
    points = mapped(lambda i: both if 15 <= i < 17 else street, np.arange(40.0), both)
    standing = points[(points[:, 2] > 0.3) & (points[:, 0] > 20.5) & (points[:, 0] < 23.5)]
    assert not (np.abs(standing[:, 1] - 4.65) < 0.1).any()
    assert (np.abs(standing[:, 1] - 5.0) < 0.1).sum() > 30
