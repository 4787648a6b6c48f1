"""What comes and goes: the last who looked has the last word."""

from __future__ import annotations

import numpy as np

from hand_made import states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.tile import Tile
from mapvote.core.tile_history import Memory
from mapvote.core.types import CellState
from mapvote.fusion.fuse import fuse_tile
from mapvote.fusion.tile_vote import TileVote

UO, UE, CO, CE, UN = (int(state) for state in list(CellState)[:5])
WALL, LAWN = (10, 10), (20, 20)


def decided(tile: Tile, cell: tuple[int, int], *said: int, live: bool = True) -> int:
    """What is decided of a cell if vehicles pass one after the other and say this; ``live``: as a server does."""
    votes = [
        TileVote(vehicle=f"v{i}", end_ns=(i + 1) * 10**9, digest=f"{i:02}", states=states_plane({cell: state}))
        for i, state in enumerate(said)
    ]
    history = (lambda: votes) if live else None
    return int(fuse_tile(tile, votes, "columns", FuseSettings(), 2, history)[0].states[cell])


def brought(tile: Tile, cell: tuple[int, int]) -> Tile:
    """The tile, remembering that vehicles put there what stands in a cell."""
    planes = Memory.none().planes.copy()
    planes[1][cell] = 1
    return Tile(tile.window, tile.points, tile.ground_z, memory=Memory.of(planes))


def test_a_car_that_had_left_before_the_last_vehicle_passed_waits_for_the_next() -> None:
    tile = two_walls().tiles[0, 0]
    assert decided(tile, LAWN, CO, CO) == CO
    assert decided(tile, LAWN, CO, CO, UE) == UN
    assert decided(tile, LAWN, CO, CO, UE, CO) == CO
    assert decided(tile, LAWN, CO, CO, UN) == CO, "who is not sure says nothing"
    assert decided(tile, LAWN, CO, CO, UE, live=False) == CO, "one round on files is of one moment"


def test_what_vehicles_brought_goes_only_if_the_last_of_them_saw_it_gone() -> None:
    tile = brought(two_walls().tiles[0, 0], WALL)
    assert decided(tile, WALL, CE, CE) == CE
    assert decided(tile, WALL, CE, CE, UO) == UN


def test_what_was_surveyed_falls_by_a_quorum_so_that_no_one_vehicle_can_hold_it_up() -> None:
    assert decided(two_walls().tiles[0, 0], WALL, CE, CE, UO) == CE


def test_a_cell_waits_by_itself() -> None:
    tile = two_walls().tiles[0, 0]
    both = [states_plane({LAWN: CO, (21, 21): CO}), states_plane({LAWN: CO, (21, 21): CO}), states_plane({LAWN: UE})]
    votes = [TileVote(f"v{i}", i * 10**9, str(i), states=plane) for i, plane in enumerate(both)]
    states = fuse_tile(tile, votes, "columns", FuseSettings(), 2, lambda: votes)[0].states
    assert [int(states[cell]) for cell in (LAWN, (21, 21))] == [UN, CO]
    assert np.count_nonzero(states == CO) == 1
