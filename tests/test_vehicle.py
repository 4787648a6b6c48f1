"""A vehicle drives past a wall that was built and one that was taken down; its ballot says so."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.config import Settings, VotingSettings
from mapvote.core.ballot import decode, encode, unpack_points, unpack_states, unpack_tally, validate
from mapvote.core.grid import TILE_CELLS, tile_grid
from mapvote.core.sensors import SENSORS
from mapvote.core.tiling import map_from_points
from mapvote.core.types import F64, CellState, MapvoteError, PointMap, Registration, Scan
from mapvote.vehicle import Vehicle, trust_prior

RNG = np.random.default_rng(7)
SENSOR_HEIGHT = 1.8


def wall(x: float, y0: float, y1: float, n: int = 4000) -> F64:
    """Points on a wall that stands across x, 3 m high."""
    return np.column_stack([np.full(n, x), RNG.uniform(y0, y1, n), RNG.uniform(0.0, 3.0, n)])


def road() -> F64:
    xy = RNG.uniform(-30.0, 30.0, (40_000, 2))
    return np.column_stack([xy, np.zeros(len(xy))])


OLD, NEW, BACK = wall(8.25, -3.0, 0.0), wall(8.25, 2.0, 5.0), wall(20.25, -12.0, 12.0, 12_000)


def street_map() -> PointMap:
    return map_from_points(np.vstack([road(), OLD, BACK]))


def scan_of(x: float, i: int) -> tuple[Scan, F64]:
    """What is visible now from (x, 0): the new wall, and the back wall where the new one does not hide it."""
    behind = BACK[~((BACK[:, 1] / (20.25 - x) * (8.25 - x) > 1.9) & (BACK[:, 1] / (20.25 - x) * (8.25 - x) < 5.1))]
    near_road = RNG.uniform([-5.0, -8.0], [7.9, 8.0], (8000, 2))
    points = np.vstack([NEW, behind, np.column_stack([near_road, np.zeros(len(near_road))])])
    T_map_lidar = np.eye(4)
    T_map_lidar[:3, 3] = x, 0.0, SENSOR_HEIGHT
    return Scan(i * 10**8, (points - T_map_lidar[:3, 3]).astype(np.float32)), T_map_lidar


def drive(vehicle: Vehicle) -> Vehicle:
    for i in range(6):
        vehicle.observe(*scan_of(-1.0 + 0.1 * i, i))
    return vehicle


def state_at(vehicle: Vehicle, x: float, y: float, voting: VotingSettings | None = None) -> int:
    ballot = vehicle.ballot(voting)
    for tile in ballot.tiles:
        grid = tile_grid(vehicle.point_map.lattice, tile.tile)
        rows, cols, inside = grid.indices_of(np.array([[x, y]]))
        if inside[0]:
            assert tile.states is not None
            return int(unpack_states(tile.states)[rows[0], cols[0]])
    raise AssertionError("no tile there")


def test_a_ballot_tells_what_was_built_and_taken_down() -> None:
    vehicle = drive(Vehicle("v1", SENSORS["hdl32e"], street_map()))
    assert state_at(vehicle, 8.25, 3.5) == CellState.CHANGED_OCCUPIED
    assert state_at(vehicle, 8.25, -1.5) == CellState.CHANGED_EMPTY
    assert state_at(vehicle, 20.25, -2.0) == CellState.UNCHANGED_OCCUPIED
    assert state_at(vehicle, 4.0, 0.0) == CellState.UNCHANGED_EMPTY
    assert state_at(vehicle, 20.25, 9.0) == CellState.UNDETERMINED  # behind the new wall


def test_new_points_lie_in_changed_occupied_cells_one_to_a_voxel() -> None:
    vehicle = drive(Vehicle("v1", SENSORS["hdl32e"], street_map()))
    total = 0
    for tile in vehicle.ballot().tiles:
        if tile.new_points is None:
            continue
        points = unpack_points(tile.new_points)
        assert tile.states is not None
        cells = np.floor(points.astype(np.float64) / 0.3).astype(int)
        states = unpack_states(tile.states)
        assert (states[cells[:, 1], cells[:, 0]] == CellState.CHANGED_OCCUPIED).all()
        assert len(np.unique(cells, axis=0)) == len(points)
        total += len(points)
    assert total >= 60  # ten columns of the wall, nine voxels above the ground in each, seen from inside the fan


def test_two_vehicles_with_the_same_scans_say_the_same_bytes() -> None:
    scans = [scan_of(-1.0 + 0.1 * i, i) for i in range(4)]
    point_map = street_map()
    said = []
    for _ in range(2):
        vehicle = Vehicle("v1", SENSORS["hdl32e"], point_map)
        for scan, pose in scans:
            vehicle.observe(scan, pose)
        said.append(encode(vehicle.ballot()))
    assert said[0] == said[1]
    validate(decode(said[0]))


def test_several_voters_share_one_pass_and_one_stage_ballots_carry_the_tally() -> None:
    plain = VotingSettings(skip_tall_cells=False)
    column = plain.model_copy(update={"occlusion": "column"})
    scans = [scan_of(-1.0 + 0.1 * i, i) for i in range(4)]
    point_map = street_map()
    together = Vehicle("v1", SENSORS["hdl32e"], point_map, voters=[plain, column])
    alone = Vehicle("v1", SENSORS["hdl32e"], point_map, Settings(voting=column))
    for scan, pose in scans:
        together.observe(scan, pose)
        alone.observe(scan, pose)
    assert [t.states for t in together.ballot(column).tiles] == [t.states for t in alone.ballot().tiles]
    one_stage = together.ballot(plain.model_copy(update={"two_stage": False}))
    assert all(t.states is None and t.tally is not None for t in one_stage.tiles)
    assert one_stage.tiles[0].tally is not None
    assert unpack_tally(one_stage.tiles[0].tally).shape == (TILE_CELLS, TILE_CELLS, 5)
    with pytest.raises(MapvoteError, match="no voter"):
        together.ballot(VotingSettings(n_min=9))


def test_a_lost_scan_casts_no_vote() -> None:
    def lost_at_first(scan: Scan, prior: F64 | None) -> Registration | None:
        return None if scan.stamp_ns < 2 * 10**8 else trust_prior(scan, prior)

    vehicle = Vehicle("v1", SENSORS["hdl32e"], street_map(), localise=lost_at_first)
    for i in range(2):
        vehicle.observe(*scan_of(-1.0, i))
    with pytest.raises(MapvoteError, match="none of 2 scans could be localised"):
        vehicle.ballot()
    vehicle.observe(*scan_of(-1.0, 2))
    assert vehicle.report.lost == [0, 1]
    assert vehicle.ballot().scans_localised == 1
    assert vehicle.ballot().scans == 3
