"""What drives and ballots are put through that they did not meet when they were recorded: to see what the method can
bear, and which of its stages holds it back.

Vehicles that lie: an honest ballot in, a false one out. All liars tell the same lie, the worst for a vote. Pure
functions of the ballot, the map it voted on, and of another vehicle's ballot for those who replay it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import msgspec
import numpy as np

from mapvote.codec.arrays import pack_plane
from mapvote.codec.ballot import (
    MOST_STEPS,
    Ballot,
    BallotTile,
    changed_cells_of,
    pack_odds,
    pack_points,
    unpack_points,
    unpack_states,
    unpack_sureness,
)
from mapvote.codec.sparse_columns import pack_words, unpack_words
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I64, NO_VOTE, U8, U64, Bool, CellState, Drive, PosePrior, Scan
from mapvote.localisation.localiser import Localise
from mapvote.localisation.odometry import Fix
from mapvote.perception.frontend import Movers
from mapvote_lab.evaluation.truths import Truth
from mapvote_lab.simulation.routes import ar1, erring
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world


@dataclass(frozen=True, slots=True)
class Conditions:
    """The default is nothing: everything as recorded, and as the method finds it."""

    scans: str | None = None
    """Which scans of every drive, surveys and vehicles, are there at all: "::5" makes 2 Hz of 10 Hz."""
    true_poses: bool = False
    """Oracle: surveys and vehicles know where they are."""
    true_moving: bool = False
    """Oracle: vehicles know which points hit moving bodies (the first map is still made by our own removal)."""
    true_ground: bool = False
    """Oracle: the first map knows the height of the ground everywhere."""
    noise_m: float = 0.0
    noise_deg: float = 0.0
    """Standard deviations of AR(1) errors added to the vehicles' poses, on each axis."""
    noise_told: bool = False
    """The noise is added to the covariance too: the vehicle knows of it."""


class Shaken:
    """``localise`` with noise added to the poses it finds; its own search goes on undisturbed.

    ``stamps_ns`` (n,) of every scan that will come; ``seed`` decides the noise.
    """

    def __init__(self, localise: Localise, stamps_ns: I64, conditions: Conditions, seed: tuple[int, ...]) -> None:
        self._localise, self._told = localise, conditions.noise_told
        self._sigma = np.repeat([conditions.noise_m, float(np.radians(conditions.noise_deg))], 3)
        errors = ar1(1e-9 * np.diff(stamps_ns), self._sigma, np.random.default_rng(seed))
        self._error_at = {int(stamp): error for stamp, error in zip(stamps_ns, errors, strict=True)}

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        return [self._shake(fix) for fix in self._localise.push(scan, prior)]

    def flush(self) -> list[Fix]:
        return [self._shake(fix) for fix in self._localise.flush()]

    def _shake(self, fix: Fix) -> Fix:
        error = self._error_at[fix.scan.stamp_ns]
        T_map_lidar = erring(fix.registration.T_map_lidar, error)
        covariance = fix.registration.covariance + (np.diag(self._sigma**2) if self._told else 0.0)
        return replace(fix, registration=replace(fix.registration, T_map_lidar=T_map_lidar, covariance=covariance))


class TrueMovers(Movers):
    """The simulator's own word on which points move, instead of the filter."""

    def __init__(self, truth: Truth, whole: Drive) -> None:
        """``whole``: the drive with all of its scans, whose numbers the truth goes by."""
        self._truth, self._name = truth, whole.path.name
        self._number = {int(stamp): i for i, stamp in enumerate(whole.stamps_ns)}

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, stamp_ns: int) -> list[Bool]:
        moving = self._truth.moving(self._name, self._number[stamp_ns])
        if len(moving) != len(points_map):
            raise ValueError(f"{self._name}: {len(points_map)} points, but the truth labels {len(moving)}")
        return [moving]

    def flush(self) -> list[Bool]:
        return []


def with_true_ground(point_map: PointMap, scenario: str, seed: int, overrides: Mapping[str, Any]) -> PointMap:
    """``point_map`` with the simulated terrain's height in every cell of every tile. Points stay as they are."""
    terrain = make_world(load_scenario(scenario, overrides), seed).terrain
    tiles: dict[tuple[int, int], Tile] = {}
    for index, tile in point_map.tiles.items():
        x, y = point_map.lattice.tile(index).centres()
        height = terrain.height(x[None, :], y[:, None]).astype(np.float32)
        tiles[index] = replace(tile, ground_z=height)
    return replace(point_map, tiles=tiles)


Attack = Callable[[Ballot, PointMap, Ballot], Ballot]
"""(the liar's honest ballot, the map, an honest vehicle's ballot) -> what the liar sends."""

SHIFT_CELLS = 3
FALSE_HEIGHTS_M = (0.75, 1.05, 1.35, 1.65, 1.95)
"""Above the ground, where false points stand."""
_ALL = ~np.uint64(0)
Plane = TypeVar("Plane", U8, U64)


def _all_changed(states: U8, occupied: Bool) -> U8:
    """The whole map is gone, and all free ground is built on."""
    return np.where(occupied, CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED).astype(np.uint8)


def _replayed(ballot: Ballot, other: Ballot) -> Ballot:
    """Another vehicle's ballot under this one's name: that vehicle's errors get more votes."""
    return msgspec.structs.replace(other, vehicle=ballot.vehicle, drive=ballot.drive)


ATTACKS: Mapping[str, Attack] = {
    # The opposite of what it determined: what stands is gone, what is free is built on, and back.
    "inverting": lambda mine, point_map, other: _relabelled(mine, point_map, (3, 2, 1, 0, 4)),
    "everything changed": lambda mine, point_map, other: _claim(mine, point_map, _all_changed),
    # A drive from before the change: everything is as the map has it.
    "replaying the old street": lambda mine, point_map, other: _relabelled(mine, point_map, (0, 1, 1, 0, 4)),
    "replaying another vehicle": lambda mine, point_map, other: _replayed(mine, other),
    # So that nothing is the same to the bit.
    "replaying another vehicle, moved by a cell": lambda mine, point_map, other: _moved(_replayed(mine, other), 1),
    "shifting by 3 cells": lambda mine, point_map, other: _moved(mine, SHIFT_CELLS),
    # New points that nobody measured, and masks that delete whole columns.
    "right states, false points": lambda mine, point_map, other: _claim(mine, point_map, lambda states, _: states),
}
"""What liars do, to the north-east where something moves."""


def _relabelled(ballot: Ballot, point_map: PointMap, instead: Sequence[int]) -> Ballot:
    """The ballot with ``instead`` (5,) of each state that a cell has."""
    states_instead = np.array(instead, dtype=np.uint8)

    def lie(states: U8, occupied: Bool) -> U8:
        return np.where(states == NO_VOTE, states, states_instead[np.minimum(states, 4)])

    return _claim(ballot, point_map, lie)


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
            odds=pack_odds(np.full(len(changed_cells_of(states)), MOST_STEPS, dtype=np.int8)),
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
            said = unpack_sureness(tile.odds, before)
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
