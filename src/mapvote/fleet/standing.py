"""Which votes count on a tile (DESIGN 4): standing at a moment, in the window, on cells that are still what they were.

Everything is asked as of an event number (``mark``), so that a past round can be fused again exactly.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.config import FuseSettings
from mapvote.core.ballot import unpack_points, unpack_states, unpack_tally
from mapvote.core.grid import TILE_CELLS, Lattice, TileIndex, tile_grid
from mapvote.core.types import F32, U8, Bool, CellState
from mapvote.fleet import schema
from mapvote.fleet.content import same_cells, unpack_cells, unpack_points_plane
from mapvote.fleet.fuse import TileVote, restrict, select
from mapvote.fleet.store import load_blob
from mapvote.fleet.words import Words


@dataclass(frozen=True, slots=True)
class Bar:
    """What a rollback silenced on one tile: change votes on ``cells`` of drives first heard of before ``seq``."""

    seq: int
    cells: Bool


@dataclass(frozen=True, slots=True)
class Round:
    """Whose votes are asked for: standing at ``mark``, received by ``received_by_ns``, not of ``without``."""

    mark: int
    settings: FuseSettings
    received_by_ns: int
    without: Collection[str] = ()


@dataclass(frozen=True, slots=True)
class StoredVote:
    """A standing ballot's row for one tile, planes not read yet."""

    seq: int
    first_seq: int
    vehicle: str
    drive: str
    end_ns: int
    received_ns: int
    digest: str
    base: str


def standing_tiles(connection: sa.Connection, mark: int, since: int | None = None) -> list[TileIndex]:
    """Tiles that standing ballots vote on, ascending; with ``since``, those where a ballot came or went after it."""
    b, t = schema.ballots, schema.ballot_tiles
    wanted = _stands_at(mark) if since is None else (b.c.seq <= mark) & ((b.c.seq > since) | (b.c.gone_seq > since))
    tiles = sa.select(t.c.row, t.c.col).distinct().join(b, b.c.seq == t.c.ballot).where(wanted)
    return [(row.row, row.col) for row in connection.execute(tiles.order_by(t.c.row, t.c.col))]


def stored_votes(connection: sa.Connection, index: TileIndex, asked: Round) -> list[StoredVote]:
    """Every standing vote on a tile, in no order that matters."""
    b, t = schema.ballots, schema.ballot_tiles
    columns = [b.c.seq, b.c.first_seq, b.c.vehicle, b.c.drive, b.c.end_ns, b.c.received_ns, b.c.digest, t.c.base]
    query = sa.select(*columns).join(t, t.c.ballot == b.c.seq).where(t.c.row == index[0], t.c.col == index[1])
    query = query.where(_stands_at(asked.mark), b.c.received_ns <= asked.received_by_ns).order_by(b.c.seq)
    return [StoredVote(*row) for row in connection.execute(query) if row.vehicle not in asked.without]


def bars_on(connection: sa.Connection, index: TileIndex, mark: int) -> list[Bar]:
    """What rollbacks up to ``mark`` silenced on a tile."""
    r = schema.bars
    query = sa.select(r.c.seq, r.c.cells).where(r.c.row == index[0], r.c.col == index[1], r.c.seq <= mark)
    return [Bar(row.seq, unpack_cells(row.cells)) for row in connection.execute(query)]


def counting_votes(
    connection: sa.Connection,
    lattice: Lattice,
    index: TileIndex,
    points: F32 | None,
    asked: Round,
    bars: Sequence[Bar] | None = None,
    digest: str | None = None,
) -> list[TileVote]:
    """The votes that count on a tile whose points are now ``points``, each restricted to the cells where it counts.

    ``bars``: instead of those recorded. ``digest``: the hash of ``points``, where it is known: votes with that base
    need no comparison.
    """
    chosen = select(stored_votes(connection, index, asked), asked.settings)
    barred = bars_on(connection, index, asked.mark) if bars is None else bars

    @cache
    def unchanged(base: str) -> Bool | None:
        if base == digest:
            return None
        old = None if not base else unpack_points_plane(load_blob(connection, base), base)
        same = same_cells(old, points, tile_grid(lattice, index))
        return None if same.all() else same

    votes = []
    for stored, vote in zip(chosen, read_votes(connection, index, chosen), strict=True):
        votes.append(silence(restrict(vote, unchanged(stored.base)), stored.first_seq, barred))
    return votes


def silence(vote: TileVote, first_seq: int, bars: Sequence[Bar]) -> TileVote:
    """The vote without what rollbacks have barred."""
    for bar in bars:
        if first_seq < bar.seq:
            cells = np.flatnonzero(bar.cells)
            change = vote.supports(CellState.CHANGED_OCCUPIED, cells) | vote.supports(CellState.CHANGED_EMPTY, cells)
            counts = np.ones(bar.cells.shape, dtype=np.bool_)
            counts.reshape(-1)[cells[change]] = False
            vote = restrict(vote, counts)
    return vote


def _stands_at(mark: int) -> sa.ColumnElement[bool]:
    b = schema.ballots
    return (b.c.seq <= mark) & (b.c.gone_seq.is_(None) | (b.c.gone_seq > mark))


def read_votes(connection: sa.Connection, index: TileIndex, stored: Sequence[StoredVote]) -> list[TileVote]:
    """The planes of stored votes, in their order, nothing silenced."""
    planes = _planes(connection, index, [vote.seq for vote in stored])
    # One block for all states: thousands of small planes, freed at once, go back to the system and cost page faults.
    block = np.empty((len(stored), TILE_CELLS, TILE_CELLS), dtype=np.uint8)
    return [_vote(vote, planes[vote.seq], room) for vote, room in zip(stored, block, strict=True)]


def _planes(connection: sa.Connection, index: TileIndex, ballots: Sequence[int]) -> dict[int, Any]:
    t = schema.ballot_tiles
    out: dict[int, Any] = {}
    for start in range(0, len(ballots), 500):  # SQLite's limit on variables in one statement
        some = ballots[start : start + 500]
        query = sa.select(t).where(t.c.row == index[0], t.c.col == index[1], t.c.ballot.in_(some))
        out |= {row.ballot: row for row in connection.execute(query)}
    return out


def _vote(stored: StoredVote, planes: Any, room: U8) -> TileVote:
    if planes.states is not None:
        room[:] = unpack_states(planes.states)
    return TileVote(
        vehicle=stored.vehicle,
        end_ns=stored.end_ns,
        digest=stored.digest,
        states=None if planes.states is None else room,
        tally=None if planes.tally is None else unpack_tally(planes.tally),
        gone=None if planes.gone is None else Words.unpack(planes.gone, "gone"),
        new_points=None if planes.new_points is None else unpack_points(planes.new_points),
        free=None if planes.free is None else Words.unpack(planes.free, "free"),
    )
