"""Fusion of a round, tile by tile, on any concurrent.futures.Executor: threads, or Dask on a cluster.

A worker reads the ballots from the database. It returns the decision and the planes that changed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import accumulate, groupby
from typing import Any, ClassVar

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.codec.planes import pack_plane
from mapvote.codec.tile_planes import pack_tile, unpack_free_plane, unpack_ground_plane, unpack_points_plane
from mapvote.config import FuseSettings
from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import TILE_CELLS, Grid, TileIndex
from mapvote.core.record import record
from mapvote.core.rule import rule_named
from mapvote.core.tile import Tile
from mapvote.core.types import I64, U8, Bool, MapvoteError
from mapvote.fusion.change_time import emptied_and_filled
from mapvote.fusion.copies import Copy
from mapvote.fusion.decision_record import (
    Record,
    pack_edit_votes,
    pack_fell,
    pack_standings,
    pack_tally,
)
from mapvote.fusion.fuse import Decision, fall_besides, fuse_tile
from mapvote.fusion.gravity import Fallen, Falling, Remains, fall_across, remains_of
from mapvote.fusion.loss_budget import PendingDeletions, pack_agreed
from mapvote.fusion.tile_vote import Vote, voter_of
from mapvote_server.errors import Unavailable
from mapvote_server.store.database import Database, address_of
from mapvote_server.store.integrity import Damage, DamagedBallots
from mapvote_server.store.queries import load_tile, tile_as_of
from mapvote_server.store.round_file import Bulk, OnDisk, RoundFile
from mapvote_server.store.votes import Electorate, Polled, judged_on, poll, recent_votes


@record()
@dataclass(frozen=True, slots=True)
class JobSizes:
    """Sizes of the jobs in which a round is fused."""

    group: int = 8
    """Neighbouring tiles that are fused within one database transaction, at most."""
    round_groups: int = 8
    """Groups of a round with an executor, at least: all its workers have work, and a round can be cancelled between
    groups."""
    sites: int = 32
    """Tiles that are kept while groups are followed, at most, 2 MB each; tiles that are kept open, about 6 MB each; and
    tiles of a round of which the large parts stay in memory, up to 2 MB each. Those of a larger round lie on disk."""


JOB_SIZES = JobSizes()
_NOWHERE, _NO_CELLS = np.empty(0, dtype=np.uint64), np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Task:
    """One tile to fuse: everything a worker needs but the ballots."""

    url: str
    """Address of the database, without its password."""
    window: Grid
    version: int
    """Number of the version to be made."""
    tile: TileHashes | Tile | None
    """The tile of the newest version: its hashes in the store, the tile itself, or None if there is none."""
    electorate: Electorate
    misread: Mapping[int, Bool] | None = None
    """See :func:`mapvote.fusion.fuse.unspent`; in a replay only."""
    fallen: Fallen | None = None
    """Points that lose their support, by the decisions of the tiles around."""


@dataclass(frozen=True, slots=True)
class Fused:
    """The result of fusing one tile."""

    index: TileIndex
    bulk: Bulk | OnDisk
    """Its large parts, in memory or on disk."""
    vehicles: int
    points: int
    """Number of points before the edit."""
    added: int
    deleted: int
    hashes: TileHashes | None
    """Hashes of the edited tile; None if the tile does not change."""
    cells_gone: I64
    """Flat cells whose last obstacle was deleted."""
    cells_new: I64
    """Flat cells that hold one for the first time."""
    freed: int
    """Number of cells in which free space was learned; 0 for a tile without known-free columns."""
    tile: Tile | None
    """The edited tile if the task held the tile itself (replay), else None."""
    damaged: Sequence[Damage] = ()
    """Damaged planes and ballots, which were left out."""
    copies: Sequence[Copy] = ()
    """Drives that did not count because another vehicle's drive is a copy of them."""
    pending: PendingDeletions = field(default_factory=PendingDeletions.none)
    """Deletions that wait because their probability of a false deletion exceeds the budget."""
    fell: Fallen = field(default_factory=Fallen.none)
    """Points that fell with a demolished object, see :class:`mapvote.fusion.fuse.Decision`; so are the next three."""
    waits: I64 = field(default_factory=lambda: _NO_CELLS)
    is_undecided: bool = False
    noise: tuple[I64, U8] = field(default_factory=lambda: (_NO_CELLS, np.empty(0, np.uint8)))
    """(flat cells (n,), states by which their points come and go (n,)) where these are not the decided ones."""

    @classmethod
    def nothing(cls, index: TileIndex, damaged: Sequence[Damage]) -> Fused:
        """The result for a tile that cannot be read."""
        return cls(index, Bulk(), 0, 0, 0, 0, None, _NO_CELLS, _NO_CELLS, 0, None, damaged)

    @property
    def record(self) -> Record | None:
        """The decision; None if the tile itself could not be read."""
        return self._read().record

    @property
    def planes(self) -> Mapping[str, bytes]:
        """Planes that the edited tile does not share with the one before, by hash."""
        return self._read().planes or {}

    @property
    def undecided(self) -> Remains | None:
        """Its remains, if tiles around it decide what falls in it."""
        return self._read().undecided if self.is_undecided else None

    def _read(self) -> Bulk:
        return self.bulk if isinstance(self.bulk, Bulk) else self.bulk.read()


@dataclass(frozen=True, slots=True)
class Open:
    """A tile that others decide: not packed yet, since more of it may fall."""

    task: Task
    tile: Tile
    edited: Tile
    decision: Decision
    standings: bytes
    """Packed."""
    damaged: Sequence[Damage] = ()

    @property
    def index(self) -> TileIndex:
        """Index of its tile."""
        return self.tile.index

    @property
    def undecided(self) -> Remains | None:
        """Its remains."""
        return self.decision.undecided

    is_undecided: ClassVar[bool] = True

    def packed(self) -> Fused:
        """The tile as it is."""
        return replace(_packed(self.task, self.tile, self.edited, self.decision, self.standings), damaged=self.damaged)

    def after(self, fallen: Fallen) -> Fused | None:
        """The tile after more has fallen; None if it must be fused again."""
        after_fall = fall_besides(self.decision, self.tile, self.edited, fallen, self.task.version)
        if after_fall is None:
            return None
        decision, edited = after_fall
        return replace(self, decision=decision, edited=edited).packed()


def fuse_stored(tasks: Sequence[Task], database: Database | None = None) -> list[Fused | Open]:
    """Read the votes that count on some tiles of a row, in one round, decide, edit. Pure but for reading the database.

    Damaged ballots are left out and named; a damaged tile stays as it is and is named. In another process, where there
    is no ``database`` at hand, one is opened by the tasks' ``url`` and kept.
    """
    with (database or _database(tasks[0].url)).reading() as connection:
        tiles = [task.window.tile_index for task in tasks]
        polled = poll(connection, tiles[0][0], [col for _, col in tiles], tasks[0].electorate)
        return [_fuse_sound(connection, task, polled) for task in tasks]


def _fuse_sound(connection: sa.Connection, task: Task, polled: Polled) -> Fused | Open:
    """One tile, without what is damaged."""
    damaged: list[Damage] = []
    while True:
        try:
            return replace(_fuse(connection, task, polled), damaged=damaged)
        except DamagedBallots as error:
            damaged += error.found
            task = replace(task, electorate=task.electorate.leaving_out(error.found))
        except Unavailable:
            raise
        except MapvoteError as error:
            lost = Damage("plane", _plane_of(task, str(error)), str(error)[:180])
            return Fused.nothing(task.window.tile_index, [*damaged, lost])


def _plane_of(task: Task, error: str) -> str:
    """Which plane an error is about: by its hash, so that mending it takes it out of quarantine."""
    if not isinstance(task.tile, TileHashes):
        return f"of tile {tile_key(task.window.tile_index)}"
    return next((digest for digest in task.tile.planes().values() if digest[:12] in error), task.tile.points)


def _fuse(connection: sa.Connection, task: Task, polled: Polled) -> Fused | Open:
    tile = _tile(connection, task)
    judged = judged_on(connection, tile, task.electorate, task.misread, polled)
    votes = [vote for vote in judged if not vote.why]
    cast = task.electorate.policy.round

    def history() -> list[Vote]:
        return recent_votes(connection, tile, task.electorate, task.misread, polled)

    recent = history if cast.stage == "two-stage" else None
    rule = rule_named(cast.method)
    settings = task.electorate.settings
    barred = [cells for _, cells in polled.bars[tile.index]]
    reviewed = np.logical_or.reduce(barred) if barred else None
    falling = Falling(reviewed, task.fallen)
    decision, edited = fuse_tile(tile, votes, rule, settings, task.version, recent, falling)
    standings = pack_standings(standings_of(judged, decision.copies, decision.heard, task.electorate.settings))
    if decision.undecided is not None:
        return Open(task, tile, edited, decision, standings)
    return _packed(task, tile, edited, decision, standings)


def _packed(task: Task, tile: Tile, edited: Tile, decision: Decision, standings: bytes) -> Fused:
    noise = np.flatnonzero(decision.states != decision.edits)
    stored = (tile, task.tile) if isinstance(task.tile, TileHashes) else None
    hashes, planes = (None, {}) if edited is tile else pack_tile(edited, stored)
    held, holds = (tile.obstacle_words, edited.obstacle_words) if hashes else (_NOWHERE, _NOWHERE)
    emptied, filled = emptied_and_filled(held.reshape(-1), holds.reshape(-1))
    record = Record(
        0,
        pack_plane(decision.states, 1),  # quick rather than small
        pack_tally(decision.tally),
        pack_agreed(decision.odds, decision.states),
        standings,
        pack_edit_votes(decision.edit_votes),
        pack_fell(decision.fell),
    )
    return Fused(
        index=tile.index,
        bulk=Bulk(record, planes, decision.undecided),
        vehicles=decision.vehicles,
        points=len(tile.points),
        added=decision.added,
        deleted=decision.deleted,
        hashes=hashes,
        cells_gone=emptied,
        cells_new=filled,
        freed=0 if tile.free is edited.free or tile.free is None else int((tile.free != edited.free).sum()),
        tile=None if task.misread is None else edited,
        copies=decision.copies,
        pending=decision.pending,
        fell=decision.fell,
        waits=decision.waits,
        is_undecided=decision.undecided is not None,
        noise=(noise, decision.edits.reshape(-1)[noise]),
    )


def standings_of(
    judged: Sequence[Vote], copies: Iterable[Copy], heard: Collection[str], settings: FuseSettings
) -> list[Vote]:
    """Every standing vote on a tile with the reason why it did not count, by the copies among them and the voters that
    counted."""
    copied = {(copy.vehicle, copy.digest): copy for copy in copies}
    ballots = {(voter_of(vote, settings), vote.digest): vote.ballot for vote in judged}
    standings = []
    for vote in judged:
        voter = voter_of(vote, settings)
        copy = copied.get((voter, vote.digest))
        if copy is not None:
            vote = replace(vote, why="copy", alike=ballots[copy.heard_vehicle, copy.heard_digest])
        elif not vote.why and voter not in heard:
            vote = replace(vote, why="opposes")
        standings.append(vote)
    return standings


def _tile(connection: sa.Connection, task: Task) -> Tile:
    if isinstance(task.tile, Tile):
        return task.tile
    if task.tile is not None:
        return load_tile(connection, task.window, task.tile)
    return tile_as_of(connection, task.window, task.version - 1)


class Watched(Executor):
    """Runs its work on another executor, and reports every tile that is done.

    ``report`` is called with (tiles done, tiles in all), the first time before any tile is fused. An exception that it
    raises ends the round; tiles that have not begun are not fused.
    """

    def __init__(self, within: Executor, report: Callable[[int, int], None]) -> None:
        self.within = within
        self._report = report

    def map(
        self, fn: Callable[..., Any], *iterables: Iterable[Any], timeout: float | None = None, chunksize: int = 1
    ) -> Iterator[Any]:
        """Results of the other executor, in order; the first of ``iterables`` holds groups of tiles."""
        groups = [list(tasks) for tasks in iterables]
        sizes = [len(group) for group in groups[0]]
        self._report(0, sum(sizes))
        results = self.within.map(fn, *groups, timeout=timeout, chunksize=chunksize)
        for done in accumulate(sizes):
            yield next(results)
            self._report(done, sum(sizes))


def fuse_round(
    tasks: Sequence[Task], database: Database, executor: Executor | None = None, sizes: JobSizes = JOB_SIZES
) -> list[Fused | Open]:
    """Fuse every tile of a round; results in the order of the tasks. Without an executor, one after another.

    A round of at most ``JobSizes.sites`` tiles stays in memory whole; the large parts of a larger one lie on disk.
    """
    pool = executor.within if isinstance(executor, Watched) else executor
    here = partial(fuse_stored, database=database)
    rows = [list(row) for _, row in groupby(tasks, lambda task: task.window.row0)]
    size = min(sizes.group, max(1, len(tasks) // sizes.round_groups)) if executor else sizes.group
    groups = [row[start : start + size] for row in rows for start in range(0, len(row), size)]
    work = here if executor is None or isinstance(pool, ThreadPoolExecutor) else fuse_stored
    file = RoundFile() if len(tasks) > sizes.sites else None
    done: list[Fused | Open] = []
    unpacked = 0
    for fused in (one for results in (executor.map if executor else map)(work, groups) for one in results):
        if isinstance(fused, Open):
            unpacked += 1
        small = fused.packed() if isinstance(fused, Open) and unpacked > sizes.sites else fused
        if file is not None and isinstance(small, Fused):
            small = replace(small, bulk=file.put(small.bulk)) if isinstance(small.bulk, Bulk) else small
        done.append(small)
    return done


@dataclass(frozen=True, slots=True)
class Settled:
    """The tiles of a round after all has fallen."""

    tiles: Mapping[TileIndex, Fused]
    """Those of the round, and those around in which something fell."""
    alone: Mapping[TileIndex, Fused]
    """Those of the round that were packed as each is without its neighbours."""
    fell: Collection[TileIndex]
    """Those in which more fell than each tile decides alone."""


def settled(
    alone: Mapping[TileIndex, Fused | Open], task_of: Callable[[TileIndex], Task], database: Database
) -> Settled:
    """The round of tiles that were each fused ``alone``, after what falls over their borders.

    ``task_of`` gives the task of any tile: those around the round's tiles are fused too where they decide.
    """
    undecided = _RemainsOf({index: fused for index, fused in alone.items() if fused.is_undecided})

    @lru_cache(maxsize=JOB_SIZES.sites)
    def remains_at(index: TileIndex) -> Remains:
        task = task_of(index)
        fused = alone[index] if index in alone else fuse_stored([task], database)[0]
        if fused.undecided is not None:
            return fused.undecided
        assert isinstance(fused, Fused)
        record = fused.record
        with database.reading() as connection:
            return _solid() if record is None else _remains_after(_tile(connection, task), fused, record)

    fallen = fall_across(undecided, remains_at)
    packed = {index: fused for index, fused in alone.items() if isinstance(fused, Fused)}
    tiles: dict[TileIndex, Fused] = dict(packed)
    tiles |= {index: one.packed() for index, one in alone.items() if isinstance(one, Open) and index not in fallen}
    for index, more in fallen.items():
        one = alone.get(index)
        after_fall = one.after(more) if isinstance(one, Open) else None
        tiles[index] = after_fall or _fused_with(more, task_of(index), database)
    return Settled(tiles, packed, fallen.keys())


class _RemainsOf(Mapping[TileIndex, Remains]):
    """The remains of undecided tiles, each read when it is asked for."""

    def __init__(self, fused: Mapping[TileIndex, Fused | Open]) -> None:
        self._fused = fused

    def __getitem__(self, index: TileIndex) -> Remains:
        remains = self._fused[index].undecided
        assert remains is not None
        return remains

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._fused)

    def __len__(self) -> int:
        return len(self._fused)


def _fused_with(fallen: Fallen, task: Task, database: Database) -> Fused:
    """The tile of a task, fused again with what falls besides."""
    fused = fuse_stored([replace(task, fallen=fallen)], database)[0]
    return fused.packed() if isinstance(fused, Open) else fused


def _remains_after(before: Tile, fused: Fused, record: Record) -> Remains:
    """The remains of a tile that was ``before`` its fusion."""
    after = before if fused.hashes is None else fused.tile or edited_tile(fused, before)
    cells, states = fused.noise
    edits = record.states.copy()
    edits.reshape(-1)[cells] = states
    return remains_of(before, after, edits, fused.waits, fused.fell)


def _solid() -> Remains:
    """The remains of a tile that cannot be read: what reaches into it stays."""
    every = np.full((TILE_CELLS, TILE_CELLS), EVERY_BIT)
    none = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.uint64)
    return Remains(every, every, none, np.zeros(every.shape, dtype=np.int32))


def edited_tile(fused: Fused, before: Tile) -> Tile:
    """The tile that was ``before`` as the round would make it: the planes that change are in ``fused``."""
    hashes = fused.hashes
    planes = fused.planes
    assert hashes is not None
    ground = before.ground_z
    free = before.free
    if hashes.ground in planes:
        ground = unpack_ground_plane(planes[hashes.ground], hashes.ground)
    if hashes.free is not None and hashes.free in planes:
        free = unpack_free_plane(planes[hashes.free], hashes.free)
    return Tile(before.window, unpack_points_plane(planes[hashes.points], hashes.points), ground, free)


@lru_cache(maxsize=4)
def _database(url: str) -> Database:
    """Opened by the worker's own MAPVOTE_STORE if that names the same database, because tasks carry no password."""
    own = os.environ.get("MAPVOTE_STORE", "")
    return Database(own if own and address_of(sa.make_url(own)) == url else url)
