"""Ballots of a tile -> decisions -> edited tile (paper IV, DESIGN 4). Pure: no files, no database, no clock.

The order in which votes are given never matters: drives of a vehicle fold by a commutative rule, tallies are
integer sums, and of several points for one voxel the same one is always taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapvote.config import FuseSettings
from mapvote.core.grid import TILE_CELLS, Grid, Lattice, TileIndex, tile_grid
from mapvote.core.types import F32, I32, I64, N_STATES, NO_VOTE, U8, U16, U64, Bool, CellState, MapTile
from mapvote.core.voting import VOTE_UNIT, add_states, add_tally, decide_cells
from mapvote.fleet.edit import add_points, cells_of, delete_points, empty_tile, obstacle_bits
from mapvote.fleet.hearing import ASKED, contradicting
from mapvote.fleet.words import CELLS, Words, at_least, union

Rule = Literal["paper", "columns"]
_BATCH = 32
"""Votes counted in one call: their states are copied side by side, into no more than stays in the cache."""
DAY_NS = 86_400_000_000_000
CHANGES = (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)


@dataclass(frozen=True, slots=True)
class TileVote:
    """What one drive, or one vehicle after :func:`fold`, says about one tile."""

    vehicle: str
    end_ns: int
    digest: str
    """Hash of the ballot: breaks ties between drives that end at the same moment."""
    states: U8 | None = None
    """(256, 256): two-stage."""
    tally: U16 | None = None
    """(256, 256, 5): one-stage."""
    gone: Words | None = None
    """Column words to delete where the vote is changed-empty; None: the whole column above ground."""
    new_points: F32 | None = None
    """(m, 3) from the tile's corner; used only where the vote is changed-occupied."""
    free: Words | None = None
    """Column words that rays passed through."""

    def spoken(self) -> Bool:
        """(256, 256) where this vote says anything at all."""
        if self.states is not None:
            return self.states != NO_VOTE
        assert self.tally is not None
        return np.asarray(self.tally.any(axis=-1))

    def supports(self, change: CellState, cells: NDArray[np.intp]) -> Bool:
        """(n,) at which of the flat ``cells`` this vote is, or in one stage also counts, for ``change``."""
        if self.states is not None:
            return np.asarray(self.states.reshape(-1)[cells] == int(change))
        assert self.tally is not None
        return np.asarray(self.tally[cells // TILE_CELLS, cells % TILE_CELLS, int(change)] > 0)

    def deletes(self, among: Words) -> Words:
        """The voxels that this vote says are gone, of the cells that ``among`` names."""
        marked = among if self.gone is None else self.gone.where(among)
        return marked.at(self.supports(CellState.CHANGED_EMPTY, marked.cells))


@dataclass(frozen=True, slots=True)
class Decision:
    """What the vehicles decided about one tile, and what came of it."""

    states: U8
    """(256, 256) CellState or NO_VOTE."""
    tally: NDArray[Any]
    """(256, 256, 5) in VOTE_UNITs, see :func:`count`."""
    vehicles: int
    added: int
    """Points added to the tile."""
    deleted: int
    """Points deleted from the tile."""


class Dated(Protocol):
    """Anything that a vehicle said at a moment."""

    @property
    def vehicle(self) -> str: ...
    @property
    def end_ns(self) -> int: ...


D = TypeVar("D", bound=Dated)


def select(votes: Iterable[D], settings: FuseSettings) -> list[D]:
    """The votes inside the window (DESIGN 4): drives within ``max_age_days`` of the newest on this tile, then those
    of the ``latest_vehicles`` vehicles that passed last. Ties between vehicles go to the later name."""
    votes = list(votes)
    if not votes:
        return []
    newest = max(v.end_ns for v in votes)
    recent = [v for v in votes if newest - v.end_ns <= settings.max_age_days * DAY_NS]
    last: dict[str, int] = {}
    for vote in recent:
        last[vote.vehicle] = max(last.get(vote.vehicle, vote.end_ns), vote.end_ns)
    ranked = sorted(last, key=lambda vehicle: (last[vehicle], vehicle), reverse=True)
    if len(ranked) <= settings.latest_vehicles:
        return recent
    chosen = set(ranked[: settings.latest_vehicles])
    return [v for v in recent if v.vehicle in chosen]


def restrict(vote: TileVote, counts: Bool | None) -> TileVote:
    """The vote with every cell outside ``counts`` (256, 256) silenced; None means that all of it counts."""
    if counts is None or counts.all():
        return vote
    return replace(
        vote,
        states=None if vote.states is None else np.where(counts, vote.states, np.uint8(NO_VOTE)),
        tally=None if vote.tally is None else np.where(counts[..., None], vote.tally, np.uint16(0)),
        free=None if vote.free is None else vote.free.within(counts),
    )


def fold(drives: Sequence[TileVote], grid: Grid) -> TileVote:
    """One vehicle's drives as one vote: in every cell the drive that ended last speaks, ties by hash; a drive that
    is silent there never overrides. Passed-through voxels add up. Commutative, and idempotent for one drive.

    ``grid`` is the tile's window (:func:`mapvote.core.grid.tile_grid`).
    """
    if len(drives) == 1:
        return drives[0]
    ordered = sorted(drives, key=lambda drive: (drive.end_ns, drive.digest))
    source = np.full((TILE_CELLS, TILE_CELLS), -1, dtype=np.int32)
    for i, drive in enumerate(ordered):
        source[drive.spoken()] = i
    states = None if ordered[0].states is None else np.full(source.shape, NO_VOTE, dtype=np.uint8)
    tally = None if ordered[0].tally is None else np.zeros((*source.shape, N_STATES), dtype=np.uint16)
    gone: list[Words] = []
    points: list[F32] = []
    for i, drive in enumerate(ordered):
        mine = source == i
        if states is not None and drive.states is not None:
            states[mine] = drive.states[mine]
        if tally is not None and drive.tally is not None:
            tally[mine] = drive.tally[mine]
        gone.append(drive.deletes(Words.whole(mine)))
        if drive.new_points is not None:
            points.append(drive.new_points[mine.ravel()[cells_of(grid, drive.new_points)]])
    free = [drive.free for drive in ordered if drive.free is not None]
    return TileVote(
        vehicle=ordered[-1].vehicle,
        end_ns=ordered[-1].end_ns,
        digest=ordered[-1].digest,
        states=states,
        tally=tally,
        gone=union(gone),
        new_points=np.concatenate(points) if points else None,
        free=union(free) if free else None,
    )


def one_each(drives: Iterable[TileVote], grid: Grid) -> list[TileVote]:
    """One vote a vehicle, by name: :func:`fold` of all its drives on the tile whose window is ``grid``."""
    by_vehicle: dict[str, list[TileVote]] = {}
    for drive in drives:
        by_vehicle.setdefault(drive.vehicle, []).append(drive)
    return [fold(by_vehicle[vehicle], grid) for vehicle in sorted(by_vehicle)]


def count(votes: Sequence[TileVote], rule: Rule, min_votes: int) -> tuple[U8, NDArray[Any]]:
    """(states, tally) of one vote per vehicle: the rule of core.voting, then the quorum (DESIGN 4, "enough votes").

    ``paper``: undetermined competes and a plain majority decides. ``columns``: undetermined abstains and a change
    needs a majority of the vehicles that determined the cell. A change that fewer than ``min_votes`` vehicles back is
    undetermined; in one stage a vehicle backs what its own tally alone would decide. The tally is (256, 256, 5) in
    VOTE_UNITs, class by class in memory, uint16 where no sum can exceed that.
    """
    abstain = rule == "columns"
    quorum = min_votes if min_votes > 1 else 0
    one_stage = any(vote.tally is not None for vote in votes)
    small = not one_stage and len(votes) * VOTE_UNIT <= np.iinfo(np.uint16).max
    tally = np.zeros((N_STATES, CELLS), dtype=np.uint16 if small else np.int32)
    if one_stage:
        backers = np.zeros((N_STATES, CELLS), dtype=np.int32)
        for vote in votes:
            assert vote.tally is not None
            add_tally(
                np.ascontiguousarray(np.moveaxis(vote.tally, -1, 0)).reshape(N_STATES, -1), abstain, tally, backers
            )
        states = decide_cells(tally, backers, abstain, quorum)
    else:
        for start in range(0, len(votes), _BATCH):
            add_states(_states_of(votes[start : start + _BATCH]), tally)
        states = decide_cells(tally, tally, abstain, quorum * VOTE_UNIT)
    shape = (TILE_CELLS, TILE_CELLS)
    return states.reshape(shape), np.moveaxis(tally.reshape(N_STATES, *shape), 0, -1)


def _states_of(votes: Sequence[TileVote], cells: slice = slice(None)) -> U8:
    """(votes, cells) what each vehicle decided, in some or all of the flat cells; nothing in one stage."""
    planes = [vote.states.reshape(-1)[cells] for vote in votes if vote.states is not None]
    return np.stack(planes) if planes else np.empty((0, CELLS), dtype=np.uint8)[:, cells]


def fuse_tile(
    lattice: Lattice,
    index: TileIndex,
    tile: MapTile | None,
    drives: Iterable[TileVote],
    rule: Rule,
    settings: FuseSettings,
) -> tuple[Decision, MapTile | None]:
    """Decide one tile and edit it. A tile that does not change is returned as the same object (None if there was none).

    ``drives`` are the votes that count on this tile (see :func:`select`, :func:`restrict`), any order.
    """
    grid = tile_grid(lattice, index)
    votes = one_each(drives, grid)
    states, tally = count(votes, rule, settings.min_votes)
    silenced = unheard(votes, tally, settings)
    if silenced:
        votes = [vote for vote in votes if vote.vehicle not in silenced]
        states, tally = count(votes, rule, settings.min_votes)
    before = tile if tile is not None else empty_tile()
    edited, deleted = before, 0
    if (states == CellState.CHANGED_EMPTY).any():
        gone = supported_words(votes, states, settings.min_votes)
        edited, deleted = delete_points(edited, grid, gone)
    added = 0
    if (states == CellState.CHANGED_OCCUPIED).any():
        edited, added = add_points(edited, grid, *_offered(votes, states, grid), settings.min_votes)
    edited = _learn_free(edited, grid, votes, settings.min_votes, points_added=added > 0)
    unchanged = edited is before
    return Decision(states, tally, len(votes), added, deleted), tile if unchanged else edited


def unheard(votes: Sequence[TileVote], tally: NDArray[Any], settings: FuseSettings) -> set[str]:
    """Vehicles that contradict the others on this tile (:mod:`mapvote.fleet.hearing`). ``votes`` one a vehicle, and
    ``tally`` (256, 256, 5) their sum. Of those that send tallies nobody is judged: theirs do not weigh alike."""
    if settings.min_votes < 2 or settings.max_contradiction >= 1.0:
        return set()
    planes = np.moveaxis(tally, -1, 0).reshape(N_STATES, -1)
    found = contradicting(_states_of(votes, ASKED), planes[:, ASKED], settings.max_contradiction)
    return {votes[int(i)].vehicle for i in np.flatnonzero(found)}


def supported_words(votes: Sequence[TileVote], states: U8, min_votes: int) -> U64:
    """(256, 256) delete mask: in cells decided changed-empty, the voxels that ``min_votes`` voters for it mark."""
    decided = Words.whole(states == CellState.CHANGED_EMPTY)
    return at_least([vote.deletes(decided) for vote in votes], min_votes)


def _offered(votes: Sequence[TileVote], states: U8, grid: Grid) -> tuple[F32, I64, I32]:
    """(points, cells, voters) offered for cells decided changed-occupied, by vehicles that voted so there."""
    offers = [np.empty((0, 3), np.float32) if vote.new_points is None else vote.new_points for vote in votes]
    if not any(map(len, offers)):
        return np.empty((0, 3), np.float32), np.empty(0, np.int64), np.empty(0, np.int32)
    points = np.concatenate(offers)
    cells = cells_of(grid, points)
    voters = np.repeat(np.arange(len(votes), dtype=np.int32), [len(offer) for offer in offers])
    wanted = np.flatnonzero((states == CellState.CHANGED_OCCUPIED).reshape(-1)[cells])
    first = np.searchsorted(voters[wanted], np.arange(len(votes) + 1))
    meant = [
        mine[vote.supports(CellState.CHANGED_OCCUPIED, cells[mine])]
        for vote, mine in zip(votes, np.split(wanted, first[1:-1]), strict=True)
    ]
    keep = np.concatenate(meant)
    return points[keep], cells[keep], voters[keep]


def _learn_free(tile: MapTile, grid: Grid, votes: Sequence[TileVote], min_votes: int, points_added: bool) -> MapTile:
    """Known-free columns with the voxels that at least ``min_votes`` vehicles passed through, minus the occupied ones.

    Free space is remembered once learned; a voxel that holds a point of the map is never free. Until enough vehicles
    have passed, a tile that never learned stays so: no free voxel at all would say that nothing new can be known there.
    """
    passed = [v.free for v in votes if v.free is not None]
    if tile.free is None and len(passed) < max(min_votes, 1):
        return tile
    if not passed and not points_added:
        return tile
    free = tile.free if tile.free is not None else np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.uint64)
    if len(passed) >= min_votes:
        free = free | at_least(passed, min_votes)
    free = free & ~obstacle_bits(tile, grid)
    return tile if tile.free is not None and np.array_equal(free, tile.free) else replace(tile, free=free)


def states_over(lattice: Lattice, decisions: Mapping[TileIndex, Decision]) -> tuple[U8, Grid]:
    """Decided states (rows, cols) over the smallest window of whole tiles that holds them all; elsewhere NO_VOTE."""
    rows, cols = [t[0] for t in decisions] or [0], [t[1] for t in decisions] or [0]
    grid = tile_grid(lattice, (min(rows), min(cols))).union(tile_grid(lattice, (max(rows), max(cols))))
    states = np.full(grid.shape, NO_VOTE, dtype=np.uint8)
    for index, decision in decisions.items():
        states[tile_grid(lattice, index).slices_in(grid)] = decision.states
    return states, grid
