"""Vehicles that lie: an honest ballot in, a false one out. All liars tell the same lie, the worst for a vote.

Pure functions of the ballot, the map it voted on, and of another vehicle's ballot for those who replay it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import msgspec
import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile, pack_plane, unpack_states, unpack_sureness
from mapvote.codec.odds import MOST, changed_cells_of, pack_odds
from mapvote.codec.points import pack_points, unpack_points
from mapvote.codec.words import pack_words, unpack_words
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.point_map import PointMap
from mapvote.core.types import F32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.fusion.loss_budget import Odds

Attack = Callable[[Ballot, PointMap, Ballot], Ballot]
"""(the liar's honest ballot, the map, an honest vehicle's ballot) -> what the liar sends."""

SHIFT_CELLS = 3
FALSE_HEIGHTS_M = (0.75, 1.05, 1.35, 1.65, 1.95)
"""Above the ground, where false points stand."""
_ALL = ~np.uint64(0)
Plane = TypeVar("Plane", U8, U64)


def invert(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """Says of every cell that it determined the opposite: what stands is gone, what is free is built on, and back."""
    opposite = np.array([3, 2, 1, 0, 4], dtype=np.uint8)

    def lie(states: U8, occupied: Bool) -> U8:
        return np.where(states == NO_VOTE, states, opposite[np.minimum(states, 4)])

    return _claim(ballot, point_map, lie)


def all_changed(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """Says of every cell of its tiles that it changed: the whole map is gone, and all free ground built on."""

    def lie(states: U8, occupied: Bool) -> U8:
        return np.where(occupied, CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED).astype(np.uint8)

    return _claim(ballot, point_map, lie)


def stale(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """Replays a drive from before the change: everything is as the map has it."""
    as_mapped = np.array([0, 1, 1, 0, 4], dtype=np.uint8)

    def lie(states: U8, occupied: Bool) -> U8:
        return np.where(states == NO_VOTE, states, as_mapped[np.minimum(states, 4)])

    return _claim(ballot, point_map, lie)


def replayed(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """Sends another vehicle's ballot under its own name: that vehicle's errors get more votes."""
    return msgspec.structs.replace(other, vehicle=ballot.vehicle, drive=ballot.drive)


def jitter(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """As :func:`replayed`, all of it moved by a cell to the north-east so that nothing is the same."""
    return _moved(replayed(ballot, point_map, other), 1)


def shift(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """Everything :data:`SHIFT_CELLS` cells to the north-east of where it is, states, masks and points."""
    return _moved(ballot, SHIFT_CELLS)


def false_points(ballot: Ballot, point_map: PointMap, other: Ballot) -> Ballot:
    """The right states, but new points that nobody measured, and masks that delete whole columns."""
    return _claim(ballot, point_map, lambda states, occupied: states)


ATTACKS: Mapping[str, Attack] = {
    "inverting": invert,
    "everything changed": all_changed,
    "replaying the old street": stale,
    "replaying another vehicle": replayed,
    "replaying another vehicle, moved by a cell": jitter,
    "shifting by 3 cells": shift,
    "right states, false points": false_points,
}


def _claim(ballot: Ballot, point_map: PointMap, lie: Callable[[U8, Bool], U8]) -> Ballot:
    """The ballot with ``lie``'s states, as sure of them as can be; all that is mapped gone, false points where
    changed-occupied."""

    def told(tile: BallotTile) -> BallotTile:
        if tile.states is None:
            raise ValueError("liars need two-stage ballots")
        mapped = point_map.tile(tile.tile)
        occupied = mapped.obstacle_words != 0
        states = lie(unpack_states(tile.states), occupied)
        gone = np.where(occupied | (states == CellState.CHANGED_EMPTY), _ALL, np.uint64(0))
        ground_z = np.nan_to_num(mapped.ground_z, nan=0.0)
        points = made_up(states == CellState.CHANGED_OCCUPIED, ground_z)
        return msgspec.structs.replace(
            tile,
            states=pack_plane(states),
            gone=pack_words(gone),
            new_points=pack_points(points) if len(points) else None,
            intensity=None,
            odds=pack_odds(np.full(len(changed_cells_of(states)), MOST, dtype=np.int8)),
        )

    return msgspec.structs.replace(ballot, tiles=[told(tile) for tile in ballot.tiles])


def made_up(cells: Bool, ground_z: F32) -> F32:
    """A pole of points in the middle of each of ``cells`` (256, 256), (m, 3) from the tile's corner."""
    rows, cols = np.nonzero(cells)
    x, y = (cols + 0.5) * CELL_SIZE, (rows + 0.5) * CELL_SIZE
    poles = [np.column_stack([x, y, ground_z[rows, cols] + height]) for height in FALSE_HEIGHTS_M]
    return np.concatenate(poles).astype(np.float32)


def _moved(ballot: Ballot, by: int) -> Ballot:
    """The ballot with everything so many cells to the north-east of where it is, tile by tile."""

    def moved(tile: BallotTile) -> BallotTile:
        points = None
        if tile.new_points is not None:
            way = np.array([by * CELL_SIZE, by * CELL_SIZE, 0.0], dtype=np.float32)
            shifted = unpack_points(tile.new_points) + way
            points = shifted[(shifted[:, :2] < TILE_CELLS * CELL_SIZE - 0.01).all(axis=1)]
        states = odds = None
        if tile.states is not None:
            before = unpack_states(tile.states)
            states = _shifted(before, NO_VOTE, by)
            said = Odds.of(before, unpack_sureness(tile.odds, before))
            if said is not None:
                odds = pack_odds(said.at(changed_cells_of(states) - by * (TILE_CELLS + 1)))
        return msgspec.structs.replace(
            tile,
            states=None if states is None else pack_plane(states),
            odds=odds,
            gone=None if tile.gone is None else pack_words(_shifted(unpack_words(tile.gone, "gone"), 0, by)),
            free=None if tile.free is None else pack_words(_shifted(unpack_words(tile.free, "free"), 0, by)),
            new_points=None if points is None else pack_points(points),
            intensity=None,
        )

    return msgspec.structs.replace(ballot, tiles=[moved(tile) for tile in ballot.tiles])


def _shifted(plane: Plane, vacated: int, by: int) -> Plane:
    out = np.full_like(plane, vacated)
    out[by:, by:] = plane[:-by, :-by]
    return out
