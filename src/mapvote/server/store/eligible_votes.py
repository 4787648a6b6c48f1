"""Which votes count on a tile: standing at a moment, in the window, on cells that are still what they were.

Everything is asked as of an event number (``mark``), so that a past round can be fused again exactly.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import unpack_many_states, unpack_points, unpack_tally
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import U8, Bool
from mapvote.fusion.sparse_columns import Words
from mapvote.fusion.tile_vote import TileVote, restrict, select
from mapvote.server.store import schema
from mapvote.server.store.blobs import same_cells, unpack_cells, unpack_points_plane
from mapvote.server.store.policy import Policy
from mapvote.server.store.queries import load_blob


@dataclass(frozen=True, slots=True)
class Bar:
    """What a rollback silenced on one tile: change votes on ``cells`` of drives first heard of before ``seq``."""

    seq: int
    cells: Bool


@dataclass(frozen=True, slots=True)
class Round:
    """Whose votes are asked for: standing at ``mark``, received by ``received_by_ns``, not of ``without``."""

    mark: int
    policy: Policy
    received_by_ns: int
    without: Collection[str] = ()

    @property
    def settings(self) -> FuseSettings:
        """How many votes are enough, and which are in the window."""
        return self.policy.fuse


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
    settings_hash: str
    cast_by: str


class _Planes(NamedTuple):
    """What a ballot holds of a tile, compressed."""

    states: bytes | None
    tally: bytes | None
    gone: bytes | None
    new_points: bytes | None
    free: bytes | None


def _stands_at(mark: int | sa.BindParameter[int]) -> sa.ColumnElement[bool]:
    b = schema.ballots
    return (b.c.seq <= mark) & (b.c.gone_seq.is_(None) | (b.c.gone_seq > mark))


# Asked for every tile of a round: building such a statement takes SQLAlchemy as long as the database takes to answer.
_B, _T, _R = schema.ballots, schema.ballot_tiles, schema.bars
_ROW, _COL, _MARK = (sa.bindparam(name, type_=sa.BigInteger) for name in ("row", "col", "mark"))
_VOTES_ON = (
    sa.select(_B.c.seq, _B.c.first_seq, _B.c.vehicle, _B.c.drive, _B.c.end_ns, _B.c.received_ns, _B.c.digest, _T.c.base)
    .add_columns(_B.c.settings_hash, _B.c.cast_by)
    .join(_T, _T.c.ballot == _B.c.seq)
    .where(_T.c.row == _ROW, _T.c.col == _COL, _stands_at(_MARK))
    .where(_B.c.received_ns <= sa.bindparam("received_by", type_=sa.BigInteger))
    .order_by(_B.c.seq)
)
_BARS_ON = sa.select(_R.c.seq, _R.c.cells).where(_R.c.row == _ROW, _R.c.col == _COL, _R.c.seq <= _MARK)
_PLANES_OF = sa.select(_T.c.ballot, _T.c.states, _T.c.tally, _T.c.gone, _T.c.new_points, _T.c.free).where(
    _T.c.row == _ROW, _T.c.col == _COL, _T.c.ballot.in_(sa.bindparam("ballots", expanding=True))
)


def standing_tiles(connection: sa.Connection, mark: int, since: int | None = None) -> list[TileIndex]:
    """Tiles that standing ballots vote on, ascending; with ``since``, those where a ballot came or went after it."""
    b, t = schema.ballots, schema.ballot_tiles
    wanted = _stands_at(mark) if since is None else (b.c.seq <= mark) & ((b.c.seq > since) | (b.c.gone_seq > since))
    tiles = sa.select(t.c.row, t.c.col).distinct().join(b, b.c.seq == t.c.ballot).where(wanted)
    return [(row.row, row.col) for row in connection.execute(tiles.order_by(t.c.row, t.c.col))]


def stored_votes(connection: sa.Connection, index: TileIndex, asked: Round) -> list[StoredVote]:
    """Every standing vote of the round on a tile, in no order that matters."""
    cast = asked.policy.round
    asked_of = {"row": index[0], "col": index[1], "mark": asked.mark, "received_by": asked.received_by_ns}
    found = [StoredVote(*row) for row in connection.execute(_VOTES_ON, asked_of).all()]
    return [
        vote
        for vote in found
        if vote.vehicle not in asked.without
        and vote.cast_by == cast.cast_by
        and vote.settings_hash.startswith(cast.settings_hash)
    ]


def bars_on(connection: sa.Connection, index: TileIndex, mark: int) -> list[Bar]:
    """What rollbacks up to ``mark`` silenced on a tile."""
    found = connection.execute(_BARS_ON, {"row": index[0], "col": index[1], "mark": mark})
    return [Bar(seq, unpack_cells(cells)) for seq, cells in found]


def counting_votes(
    connection: sa.Connection,
    tile: Tile,
    asked: Round,
    bars: Sequence[Bar] | None = None,
    digest: str | None = None,
) -> list[TileVote]:
    """The votes that count on ``tile`` as it is now, each restricted to the cells where it counts.

    ``bars``: instead of those recorded. ``digest``: the hash of the tile's points, where it is known: votes with that
    base need no comparison.
    """
    index = tile.index
    chosen = select(stored_votes(connection, index, asked), asked.settings)
    barred = bars_on(connection, index, asked.mark) if bars is None else bars

    @cache
    def unchanged(base: str) -> Bool | None:
        if base == digest:
            return None
        old = None if not base else unpack_points_plane(load_blob(connection, base), base)
        same = same_cells(old, tile.points, tile.window)
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
            counts = np.ones(bar.cells.shape, dtype=np.bool_)
            counts.reshape(-1)[cells[vote.alters(cells)]] = False
            vote = restrict(vote, counts)
    return vote


def read_votes(connection: sa.Connection, index: TileIndex, stored: Sequence[StoredVote]) -> list[TileVote]:
    """The planes of stored votes, in their order, nothing silenced."""
    found = _planes(connection, index, [vote.seq for vote in stored])
    planes = [found[vote.seq] for vote in stored]
    decided = iter(unpack_many_states([mine.states for mine in planes if mine.states is not None]))
    return [
        _vote(vote, mine, None if mine.states is None else next(decided))
        for vote, mine in zip(stored, planes, strict=True)
    ]


def _planes(connection: sa.Connection, index: TileIndex, ballots: Sequence[int]) -> dict[int, _Planes]:
    out: dict[int, _Planes] = {}
    for start in range(0, len(ballots), 500):  # SQLite's limit on variables in one statement
        asked_of = {"row": index[0], "col": index[1], "ballots": ballots[start : start + 500]}
        out |= {ballot: _Planes(*planes) for ballot, *planes in connection.execute(_PLANES_OF, asked_of).all()}
    return out


def _vote(stored: StoredVote, planes: _Planes, states: U8 | None) -> TileVote:
    return TileVote(
        vehicle=stored.vehicle,
        end_ns=stored.end_ns,
        digest=stored.digest,
        states=states,
        tally=None if planes.tally is None else unpack_tally(planes.tally),
        gone=None if planes.gone is None else Words.unpack(planes.gone, "gone"),
        new_points=None if planes.new_points is None else unpack_points(planes.new_points),
        free=None if planes.free is None else Words.unpack(planes.free, "free"),
    )
