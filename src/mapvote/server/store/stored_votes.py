"""A ballot's votes on one tile as they are stored, read, and remembered for the next time.

What was unpacked is kept by the sum over all that is in the row: it is what it was whatever was published, rolled back,
replaced or set aside since, and two rows of the same sum say the same. So of a tile on which one vehicle voted anew
only that ballot is unpacked. Nothing of it outlives the process.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import unpack_offer, unpack_sound_states, unpack_sureness, unpack_tally
from mapvote.codec.points import unpack_sound_points
from mapvote.core.grid import TileIndex
from mapvote.fusion.odds import Odds
from mapvote.fusion.sparse_columns import Words
from mapvote.fusion.tile_vote import TileVote
from mapvote.server.store import schema
from mapvote.server.store.database import MOST_ASKED
from mapvote.server.store.quarantine import Damage, DamagedBallots, ballot_name, ballot_sum

REMEMBERED_BYTES = 128 << 20
"""Some 1,500 votes of a vehicle on a tile."""
_T = schema.ballot_tiles
_PLANES_OF = sa.select(_T.c.row, _T.c.col, _T.c.ballot, *(_T.c[p] for p in schema.BALLOT_PLANES), _T.c.base, _T.c.sum)
_PLANES_OF = _PLANES_OF.where(
    _T.c.row == sa.bindparam("row", type_=sa.BigInteger),
    _T.c.col.in_(sa.bindparam("cols", expanding=True)),
    _T.c.ballot.in_(sa.bindparam("ballots", expanding=True)),
)
Rows = Mapping[tuple[int, int, int], Any]
"""By tile and ballot, what is stored of its planes."""


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
    version: int
    """Of the map that its vehicle drove with."""
    settings_hash: str
    cast_by: str


class Remembered:
    """Votes as they were unpacked, by the sum of their rows; those not asked for longest go first. Threads may share
    it."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes, self.bytes = most_bytes, 0
        self._votes: OrderedDict[str, TileVote] = OrderedDict()
        self._lock = Lock()

    def get(self, sums: Iterable[str]) -> dict[str, TileVote]:
        """Those that are known, by sum."""
        with self._lock:
            found = {digest: vote for digest in sums if (vote := self._votes.get(digest)) is not None}
            for digest in found:
                self._votes.move_to_end(digest)
        return found

    def put(self, votes: dict[str, TileVote]) -> None:
        """Remember these too."""
        with self._lock:
            for digest, vote in votes.items():
                if digest not in self._votes:
                    self._votes[digest] = vote
                    self.bytes += _size(vote)
            while self.bytes > self.most_bytes:
                self.bytes -= _size(self._votes.popitem(last=False)[1])

    def clear(self) -> None:
        """As a process that has just begun."""
        with self._lock:
            self._votes.clear()
            self.bytes = 0


remembered = Remembered(REMEMBERED_BYTES)
"""What this process unpacked."""


def read_rows(connection: sa.Connection, row: int, votes: Sequence[tuple[int, StoredVote]]) -> Rows:
    """What is stored of votes on tiles of a ``row``, each beside its column."""
    found: dict[tuple[int, int, int], Any] = {}
    cols, ballots = sorted({col for col, _ in votes}), sorted({vote.seq for _, vote in votes})
    for start in range(0, len(ballots), MOST_ASKED):
        asked_of = {"row": row, "cols": cols, "ballots": ballots[start : start + MOST_ASKED]}
        rows = connection.execute(_PLANES_OF, asked_of).all()
        found |= {(stored.row, stored.col, stored.ballot): stored for stored in rows}
    return found


def read_votes(
    connection: sa.Connection, index: TileIndex, stored: Sequence[StoredVote], known: Rows | None = None
) -> list[TileVote]:
    """The planes of stored votes, in their order, nothing silenced. DamagedBallots, naming them, if some are.

    ``known``: rows that were read before.
    """
    rows = dict(known or {})
    rows |= read_rows(connection, index[0], [(index[1], vote) for vote in stored if (*index, vote.seq) not in rows])
    mine = {vote.seq: rows[*index, vote.seq] for vote in stored}
    _check(mine.values())
    sums = [mine[vote.seq].sum for vote in stored]
    unpacked = remembered.get(sums)
    new = {row.sum: _unpacked(row) for row in mine.values() if row.sum not in unpacked}
    remembered.put(new)
    unpacked |= new
    return [_said_by(vote, unpacked[digest]) for digest, vote in zip(sums, stored, strict=True)]


def _said_by(stored: StoredVote, said: TileVote) -> TileVote:
    return replace(said, vehicle=stored.vehicle, end_ns=stored.end_ns, digest=stored.digest, version=stored.version)


def _check(rows: Iterable[Any]) -> None:
    """DamagedBallots if some are not what their sums say. Whoever is remembered is read too, or what is decided would
    follow from what this process happened to read before the disk lost it."""
    not_so = "is not what its sum says"
    names = [ballot_name(row.ballot, row.row, row.col) for row in rows if row.sum != ballot_sum(row)]
    if names:
        raise DamagedBallots([Damage("ballot", name, not_so) for name in names])


def _unpacked(row: Any) -> TileVote:
    """A row's planes, of nobody yet."""
    new_points, intensity = unpack_offer(row.new_points, row.intensity, unpack_sound_points)
    states = None if row.states is None else unpack_sound_states(row.states)
    sureness = unpack_sureness(row.odds, states)
    return TileVote(
        vehicle="",
        end_ns=0,
        digest="",
        states=states,
        tally=None if row.tally is None else unpack_tally(row.tally),
        gone=None if row.gone is None else Words.unpack(row.gone, "gone"),
        new_points=new_points,
        intensity=intensity,
        free=None if row.free is None else Words.unpack(row.free, "free"),
        odds=None if states is None else Odds.of(states, sureness),
    )


def _size(vote: TileVote) -> int:
    """Bytes of all planes."""
    planes: list[np.ndarray | None] = [vote.states, vote.tally, vote.new_points, vote.intensity]
    for words in (vote.gone, vote.free):
        planes += [] if words is None else [words.cells, words.words]
    planes += [] if vote.odds is None else [vote.odds.cells, vote.odds.steps]
    return sum(plane.nbytes for plane in planes if plane is not None)
