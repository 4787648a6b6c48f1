"""Votes of a change rule on each tile, and the points of possible new objects.

They are kept tile by tile, so that memory follows the road, not its length in scans.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mapvote.codec.ballot import Planes
from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M, column_bit, height_above
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap, cut_tiles
from mapvote.core.points import Fields, Values, point_field
from mapvote.core.record import record
from mapvote.core.rule import Rule
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, I64, N_STATES, U8, U64, Bool
from mapvote.core.voting import cast
from mapvote.core.voxels import enter_first, first_of_each, voxel_keys
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.rules.packed_tiles import Shelf, Slot


class Counted(NamedTuple):
    """The votes of one drive on one tile, before its new points are chosen."""

    planes: Planes
    """``states`` that this vehicle decided alone. ``tally``: None for one vote for each cell's state. ``free``: voxels
    that the map did not know to be free. No new points and no odds yet."""
    new: U64
    """(256, 256) words of the voxels whose points are new; used in cells with a vote for changed-occupied."""
    log_odds: Callable[[F32], F64] | None = None
    """The log-odds (m,), nats, of each changed cell, ascending, from the new points (n, 3) of the tile, metres from its
    corner; None: the rule has none."""


class Voter(Protocol):
    """How a vehicle counts by one rule (core/rule.py), for instance the paper's (rules/paper.py)."""

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of the voxels of its view whose points may be new."""

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, Counted]]:
        """The votes of the scans so far, for every tile with votes, in any order: one by one, so that no drive is too
        long for memory. ``only``: of these tiles. The call changes nothing."""


def make_voter(rule: Rule, settings: Settings, sensor: Sensor, point_map: PointMap) -> Voter:
    """The voter of a rule, nothing counted yet. MapvoteError if the rule's voter cannot be imported."""
    voter: Voter = rule.load_voter()(settings, sensor, point_map)
    return voter


class Tally:
    """Votes per cell and class over a drive: :func:`mapvote.core.voting.cast` on the tiles that a window touches."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, I32] = {}
        """(256, 256, 5) int32 in VOTE_UNITs."""

    def cast(self, grid: Grid, states: U8, weights: I32) -> None:
        """Cast one scan's ``states`` (rows, cols of ``grid``) with ``weights``."""
        for tile in grid.tiles():
            window = self.lattice.tile(tile)
            common = window.intersection(grid)
            if tile not in self.tiles:
                self.tiles[tile] = np.zeros((TILE_CELLS, TILE_CELLS, N_STATES), dtype=np.int32)
            inner = common.slices_in(window)
            outer = common.slices_in(grid)
            cast(self.tiles[tile][inner], states[outer], weights[outer])


@record(votes=True)
@dataclass(frozen=True, slots=True)
class NewPointsRule:
    """Points of possible new objects."""

    sorted_together: int = 50_000
    """Points sorted by tile together: so many take a few milliseconds, so that no scan waits longer."""
    reach_m: float = 70.0
    """Range up to which new points are taken, metres, farther than votes are cast: the map is at hand for a tile's
    width around the vehicle."""


NEW_POINTS_RULE = NewPointsRule()
# Kernels take no records: they read these names.
REACH_M = NEW_POINTS_RULE.reach_m


def select(up: F32, origin_z: float, cell: I32, wanted: Bool, unwanted: Bool, words: U64, base: I32) -> I64:
    """Indices of the points (n,), ``wanted`` and not ``unwanted``, that lie in a voxel of ``words`` (cells,).

    ``up`` (n,) the height of each point above ``origin_z``, map metres; ``cell`` (n,) its flat cell, -1 outside;
    ``base`` (cells,) the lowest layer of each column.
    """
    chosen = np.empty(len(cell) + 1, np.int64)
    return chosen[: _select(up, origin_z, cell, wanted, unwanted, words, base, chosen)].copy()


@kernel
def _select(
    up: F32, origin_z: float, cell: I32, wanted: Bool, unwanted: Bool, words: U64, base: I32, chosen: I64
) -> np.int64:
    """:func:`select` into the first of ``chosen`` (n + 1,); returns how many. Each index is written, and written over
    if its point is not chosen: a branch could not be predicted."""
    count = np.uint64(0)
    for i in range(np.uint64(0), np.uint64(len(cell))):
        chosen[count] = i
        count += np.uint64(wanted[i] & (not unwanted[i]))
    near = np.uint64(0)
    for w in range(np.uint64(0), count):
        point = np.uint64(chosen[w])
        chosen[near] = point
        near += np.uint64((cell[point] >= 0) & (words[np.uint64(max(cell[point], np.int32(0)))] != 0))
    found = np.uint64(0)
    for w in range(np.uint64(0), near):
        point = np.uint64(chosen[w])
        k = np.uint64(cell[point])
        chosen[found] = point
        found += words[k] >> np.uint64(column_bit(np.float64(up[point]) + origin_z, base[k])) & np.uint64(1)
    return np.int64(found)


@kernel
def _beyond(
    points: F32, cell: I32, origin: F64, ground_z: F32, base: I32, occupied: U64, lattice: tuple[float, float],
    corner: tuple[int, int], found: I64,
) -> int:  # fmt: skip
    """Into the first of ``found`` (n + 1,) which of the points (3, n) from ``origin`` outside the local grid, whose
    ``cell`` is -1, are obstacles, within reach, and in voxels that the map does not hold; returns how many. The map is
    the planes (rows, cols) whose first cell is ``corner`` (row, col) of the ``lattice`` with that origin (x, y)."""
    rows, cols = occupied.shape
    (x0, y0), (row0, col0) = lattice, corner
    outside = np.uint64(0)
    for i in range(np.uint64(0), np.uint64(len(cell))):  # as in _select
        found[outside] = i
        outside += np.uint64(cell[i] < 0)
    n = 0
    for w in range(outside):
        p = np.uint64(found[w])
        if points[0, p] ** 2 + points[1, p] ** 2 >= np.float32(REACH_M**2):
            continue
        c = int(np.floor((np.float64(points[0, p]) + origin[0] - x0) / CELL_SIZE)) - col0
        r = int(np.floor((np.float64(points[1, p]) + origin[1] - y0) / CELL_SIZE)) - row0
        if not (0 <= r < rows and 0 <= c < cols):
            continue
        z = np.float64(points[2, p]) + origin[2]
        if height_above(z, ground_z[r, c], base[r, c]) < GROUND_MARGIN_M:
            continue
        if not (occupied[r, c] >> np.uint64(column_bit(z, base[r, c]))) & np.uint64(1):
            found[n] = p
            n += 1
    return n


class NewPoints:
    """One point per 0.3 m voxel, the first one offered: candidates for changed-occupied cells."""

    def __init__(
        self,
        lattice: Lattice,
        beyond: bool = True,
        names: Sequence[str] = (),
        numbers: NewPointsRule = NEW_POINTS_RULE,
    ) -> None:
        """``beyond``: also take points outside the local grid. The paper takes none, and the filter of moving objects
        does not reach there, so a rule that uses them must require more of a new voxel than one hit. ``names``:
        attributes that are kept with each point."""
        self.lattice = lattice
        self.beyond = beyond
        self.names = tuple(names)
        self._numbers = numbers
        self._shelf = Shelf()
        self._runs = defaultdict[TileIndex, list[Slot]](list)
        """The runs of each tile: points in the order in which they were offered, one point per voxel."""
        self._waiting = np.empty((2 * numbers.sorted_together, 3 + len(self.names)))
        """Room for the points since the last run, ... An array for each scan would lie between the scans' own, and keep
        the heap from giving back what they leave."""
        self._count = 0
        """... how many there are, ..."""
        self._seen = np.zeros(1 << (4 * numbers.sorted_together).bit_length(), np.int64)
        """... and the table of their voxels' keys (core/voxels.py). It is half full at most: with twice
        ``sorted_together``."""

    def gather(self, seen: Observation, may_be_new: U64) -> None:
        """Offer the points of one scan that lie in ``may_be_new`` (rows, cols) of its view, or outside the view."""
        scan = seen.scan
        words = may_be_new.ravel()
        base = np.ascontiguousarray(scan.reference.base).ravel()
        up = scan.rows[2]
        chosen = select(up, float(scan.origin_map[2]), scan.cell, scan.obstacle, seen.moving, words, base)
        if self.beyond:
            chosen = np.concatenate([chosen, self._strange_beyond(scan)])
        fields = {name: scan.fields[name][chosen] for name in self.names if name in scan.fields}
        self.offer(scan.points_at(chosen), fields)

    def _strange_beyond(self, scan: PlacedScan) -> I64:
        """(m,) obstacle points outside the local grid, within reach, in voxels that the map does not hold.

        They cast no vote. But the upper storeys of what is new can be seen only from afar, below the sensor's top beam.
        """
        grid = scan.outer.grid
        outer = scan.outer
        lattice = (grid.lattice.x0, grid.lattice.y0)
        corner = (grid.row0, grid.col0)
        found = np.empty(len(scan.cell) + 1, np.int64)
        n = _beyond(
            scan.rows, scan.cell, scan.origin_map, outer.ground_z, outer.base, outer.occupied, lattice, corner,
            found,
        )  # fmt: skip
        return found[:n].copy()

    def offer(self, points_map: F64, fields: Fields | None = None) -> None:
        """Points (n, 3), map metres, and those of their attributes (n,) that a scan has."""
        scanned = fields or {}
        for first in self._unseen(voxel_keys(points_map, self.lattice.x0, self.lattice.y0)):
            self._keep(points_map.take(first, axis=0), {name: values[first] for name, values in scanned.items()})

    def _unseen(self, keys: I64) -> Iterator[I64]:
        """The indices of the keys (n,) that have not come since the last run, part by part: each must be kept before
        the next is asked for."""
        most = self._numbers.sorted_together
        for begin in range(0, len(keys), most):
            part = keys[begin : begin + most]
            first = np.empty(len(part), np.int64)
            yield first[: enter_first(part, self._seen, first)] + begin

    def _keep(self, points_map: F64, scanned: Fields) -> None:
        """Points (n, 3) in voxels that have not come since the last run."""
        n = len(points_map)
        rows = {name: point_field(name) for name in self.names}
        sent = [row.in_ballot(scanned[name]) if name in scanned else row.unknown(n) for name, row in rows.items()]
        for column, values in zip(self._waiting[self._count : self._count + n].T, [*points_map.T, *sent], strict=True):
            column[:] = values
        self._count += n
        if self._count > self._numbers.sorted_together:
            for tile, points in self._of_tiles(self._last()).items():
                self._runs[tile].append(self._shelf.put(points.tobytes()))
            self._count = 0
            self._seen.fill(0)

    def _last(self) -> F64:
        """The points since the last run."""
        return self._waiting[: self._count]

    def _none(self) -> F64:
        return np.zeros((0, 3 + len(self.names)))

    def _run(self, place: Slot) -> F64:
        return np.frombuffer(self._shelf.read(place)).reshape(-1, 3 + len(self.names))

    def _one_a_voxel(self, clouds: list[F64]) -> F64:
        every = np.concatenate([self._none(), *clouds])
        keys = voxel_keys(every, self.lattice.x0, self.lattice.y0)
        first = first_of_each(keys, 1 << len(keys).bit_length())  # half of the points have a voxel of their own
        return every.take(first[np.argsort(keys[first])], axis=0)

    def by_tile(self) -> Callable[[TileIndex], F64]:
        """Reader of the points (m, 3) of a tile, map metres, sorted by voxel key; (m, 3 + k) with the k attributes of
        ``names`` as in ballots. The points of all tiles of a long drive are never held together."""
        rest = self._of_tiles(self._last())

        def of_tile(tile: TileIndex) -> F64:
            last = [rest[tile]] if tile in rest else []
            return self._one_a_voxel([*map(self._run, self._runs.get(tile, [])), *last])

        return of_tile

    def _of_tiles(self, points: F64) -> dict[TileIndex, F64]:
        return {tile: points[chosen] for tile, chosen in cut_tiles(points, self.lattice)}


def points_in(
    window: Grid, points_map: F64, words: U64, base: I32, names: Sequence[str] = ()
) -> tuple[F32, dict[str, Values]]:
    """Those of ``points_map`` (n, 3 + k) that lie in voxels of ``words`` (256, 256) of a tile: (m, 3) float32 from its
    corner, and their k attributes (m,) by ``names``, as in ballots."""
    rows, cols, _ = window.indices_of(points_map)
    cell = (rows * window.cols + cols).astype(np.int32)
    every = np.ones(len(points_map), np.bool_)
    z0 = float(points_map[:, 2].min()) if len(points_map) else 0.0
    up = (points_map[:, 2] - z0).astype(np.float32)
    kept = points_map[select(up, z0, cell, every, ~every, words.ravel(), base.ravel())]
    sent = {name: kept[:, 3 + k].astype(point_field(name).dtype) for k, name in enumerate(names)}
    return window.from_map(kept[:, :3]), sent
