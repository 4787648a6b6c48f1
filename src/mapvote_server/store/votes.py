"""The votes on a tile: which count, and their planes.

A vote counts if its ballot stands at an event number (``mark``), lies in the window of the policy and is not spent in
the cell. All queries take the mark, so that a past round can be fused again exactly. Unpacked votes are cached by the
sum of their row: two rows of one sum say the same. The cache ends with the process.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import Planes, decode_tile, unpack_planes
from mapvote.codec.tile_planes import unpack_cells
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import I64, Bool
from mapvote.fusion.change_time import history_days
from mapvote.fusion.fuse import unspent
from mapvote.fusion.tile_vote import DAY_NS, Vote, Why, newest_votes, silenced
from mapvote_server.errors import NotFound
from mapvote_server.store import schema
from mapvote_server.store.database import DATABASE_SIZES, Question, is_sound, remembered
from mapvote_server.store.integrity import NOT_ITS_SUM, Damage, DamagedBallots, ballot_name, set_aside
from mapvote_server.store.policy import Policy, policy_in
from mapvote_server.store.queries import Version, log_event
from mapvote_server.store.store import Store


@dataclass(frozen=True, slots=True)
class Electorate:
    """The votes that count: standing at ``mark``, received by ``received_by_ns``, not of vehicles ``without``."""

    mark: int
    policy: Policy
    received_by_ns: int
    without: Collection[str] = ()
    set_aside: Collection[str] = ()
    """Ballots that are damaged, by number or on one tile (:func:`mapvote_server.store.integrity.ballot_name`)."""

    @property
    def settings(self) -> FuseSettings:
        """The quorum, and the window of votes."""
        return self.policy.fuse

    @classmethod
    def of(cls, version: Version, without: Collection[str] = (), set_aside: Collection[str] = ()) -> Electorate:
        """The votes that counted in a version, by the policy of that version."""
        policy = Policy.model_validate(version.policy)
        received_by_ns = version.created_ns - round(policy.fuse.min_age_s * 1e9)
        return cls(version.mark, policy, received_by_ns, without, set_aside)

    def leaving_out(self, damaged: Iterable[Damage]) -> Electorate:
        """The same without ballots that turned out to be damaged."""
        return replace(self, set_aside=frozenset({*self.set_aside, *(damage.name for damage in damaged)}))


Read = TypeVar("Read")
FOREVER = (1 << 63) - 1


def _stands_at(mark: int | sa.BindParameter[int]) -> sa.ColumnElement[bool]:
    b = schema.ballots
    return (b.c.seq <= mark) & (b.c.gone_seq.is_(None) | (b.c.gone_seq > mark))


# Asked for the tiles of a round: building such a statement takes SQLAlchemy as long as the database takes to answer.
_B, _T = schema.ballots, schema.ballot_tiles
_ROW, _MARK = (sa.bindparam(name, type_=sa.BigInteger) for name in ("row", "mark"))
_COLS: sa.BindParameter[list[int]] = sa.bindparam("cols", expanding=True)
_VOTES = (
    sa.select(_T.c.col, _B.c.received_ns, _B.c.settings_hash, _B.c.cast_by)
    .add_columns(_B.c.vehicle, _B.c.end_ns, _B.c.digest, _B.c.version, _B.c.seq, _B.c.drive, _B.c.first_seq)
    .join(_T, _T.c.ballot == _B.c.seq)
    .order_by(_B.c.seq)
)
_VOTES_ON = _VOTES.where(_T.c.row == _ROW, _T.c.col.in_(_COLS), _stands_at(_MARK))
_W, _C = schema.reviews, schema.review_cells
_REVIEWS_ON = (
    sa.select(_C.c.col, _W.c.seq, _W.c.verdict, _C.c.cells)
    .join(_C, _C.c.review == _W.c.seq)
    .where(_C.c.row == _ROW, _C.c.col.in_(_COLS), _W.c.verdict.in_(("held", "rejected")))
    .where(_W.c.seq <= _MARK, _W.c.gone_seq.is_(None) | (_W.c.gone_seq > _MARK))
)


_SINCE = sa.bindparam("since", type_=sa.BigInteger)
_STANDING = Question(
    sa.select(_T.c.row, _T.c.col).distinct().join(_B, _B.c.seq == _T.c.ballot).where(_stands_at(_MARK))
)
_TOUCHED = Question(
    sa.union(  # each is answered by an index of its own
        *(
            sa.select(_T.c.row, _T.c.col).where(_T.c.ballot.in_(sa.select(_B.c.seq).where(one, _B.c.seq <= _MARK)))
            for one in (_B.c.seq > _SINCE, _B.c.gone_seq > _SINCE)
        ),
        sa.select(_C.c.row, _C.c.col)
        .join(_W, _W.c.seq == _C.c.review)
        .where(_W.c.seq <= _MARK, (_W.c.seq > _SINCE) | (_W.c.gone_seq > _SINCE)),
    )
)


@dataclass(frozen=True, slots=True)
class Polled:
    """Standing votes, reviews and damage on some tiles, each read by one statement."""

    standing: Mapping[TileIndex, Sequence[Vote]]
    """Votes without planes, in the order in which their ballots came; judged by the policy alone."""
    bars: Mapping[TileIndex, Sequence[tuple[int | None, Bool]]]
    """(event, cells (256, 256)) of changes that reviewers rejected then, or hold: None."""
    rows: Rows
    """The stored planes of the votes that count there."""
    read: dict[tuple[int, int, int], Planes] = field(default_factory=dict)
    """Planes by tile and ballot that were checked and unpacked: nothing is read twice for one round."""
    fresh: dict[tuple[int, int, int, Why], Vote] = field(default_factory=dict)
    """Votes in the cells in which they are not spent."""

    def key(self, index: TileIndex) -> Hashable:
        """All that decides a tile beside its content and the policy: two polls of one key give one decision."""
        votes = tuple((vote.ballot, vote.why) for vote in self.standing[index])
        rows = frozenset((row.ballot, row.sum) for row in self.rows.values() if (row.row, row.col) == index)
        return votes, rows, tuple((seq, cells.tobytes()) for seq, cells in self.bars[index])

    def unspent(self, vote: Vote, tile: Tile, misread: Mapping[int, Bool] | None) -> Vote:
        """The vote in the cells of ``tile`` in which it is not spent."""
        key = *tile.index, vote.ballot, vote.why
        if key not in self.fresh:
            self.fresh[key] = unspent(vote, tile, misread)
        return self.fresh[key]


def poll(connection: sa.Connection, row: int, cols: Sequence[int], electorate: Electorate) -> Polled:
    """All that :func:`judged_on` asks of some tiles of a row; of a few, for the planes of their votes lie in memory
    then."""
    standing = _standing_on(connection, row, cols, electorate)
    bars = defaultdict[TileIndex, list[Any]](list)
    reviewed = connection.execute(_REVIEWS_ON, {"row": row, "cols": cols, "mark": electorate.mark}).all()
    for col, seq, verdict, cells in reviewed:
        bars[row, col].append((None if verdict == "held" else seq, unpack_cells(cells)))
    counting = [(c, vote) for c in cols for vote in _judged(standing[row, c], (row, c), electorate) if not vote.why]
    return Polled(standing, bars, read_rows(connection, row, counting))


def _standing_on(
    connection: sa.Connection, row: int, cols: Sequence[int], electorate: Electorate
) -> Mapping[TileIndex, Sequence[Vote]]:
    """The votes that stand on tiles of a row, without planes, and why the policy does not count them."""
    standing = defaultdict[TileIndex, list[Vote]](list)
    rows = connection.execute(_VOTES_ON, {"row": row, "cols": cols, "mark": electorate.mark}).all()
    for stored in rows:
        standing[row, stored.col].append(_vote_of(stored, _unready(stored, electorate)))
    return standing


def _vote_of(stored: Any, reason: Why = "") -> Vote:
    """The vote of a row of ``_VOTES``, without its planes."""
    cast = stored.vehicle, stored.end_ns, stored.digest, stored.version
    return Vote(*cast, ballot=stored.seq, drive=stored.drive, first_seq=stored.first_seq, why=reason)


def stored_votes(connection: sa.Connection, index: TileIndex, ballots: Collection[int]) -> list[Vote]:
    """The votes of some ballots on a tile without planes, whether they stand or not, in the order of the ballots; none
    of ballots that were cleared away."""
    wanted = _VOTES.where(_T.c.row == index[0], _T.c.col == index[1], _B.c.seq.in_(ballots))
    return [_vote_of(stored) for stored in connection.execute(wanted).all()]


def standing_tiles(connection: sa.Connection, mark: int, since: int | None = None) -> list[TileIndex]:
    """Tiles that standing ballots vote on, ascending; with ``since``, those where a ballot or a review was added or
    removed after it."""
    values = {"mark": mark} if since is None else {"mark": mark, "since": since}
    rows = (_STANDING if since is None else _TOUCHED).ask(connection, **values)
    return sorted({(row.row, row.col) for row in rows})


def judged_votes(connection: sa.Connection, index: TileIndex, electorate: Electorate) -> list[Vote]:
    """Every standing vote on a tile, without planes, and why it does not count there. A vote that counts does so in
    cells where it is not spent (:func:`mapvote.fusion.fuse.unspent`)."""
    return _judged(_standing_on(connection, index[0], [index[1]], electorate)[index], index, electorate)


def judged_among(polled: Polled, index: TileIndex, electorate: Electorate) -> list[Vote]:
    """The same of votes that were polled."""
    return _judged(polled.standing[index], index, electorate)


def _judged(standing: Sequence[Vote], index: TileIndex, electorate: Electorate) -> list[Vote]:
    """The ``standing`` votes on a tile but those left out, and why each does not count: damaged ones and those outside
    the window too."""
    judged = [vote for vote in standing if vote.vehicle not in electorate.without]
    if electorate.set_aside:
        names = [{str(vote.ballot), ballot_name(vote.ballot, *index)} for vote in judged]
        aside = [not named.isdisjoint(electorate.set_aside) for named in names]
        judged = [replace(vote, why="damaged") if out else vote for vote, out in zip(judged, aside, strict=True)]
    inside = {vote.ballot for vote in newest_votes([vote for vote in judged if not vote.why], electorate.settings)}
    return [vote if vote.why or vote.ballot in inside else replace(vote, why="window") for vote in judged]


def electorate_now(
    connection: sa.Connection, now_ns: int, mark: int = FOREVER, settings: FuseSettings | None = None
) -> Electorate:
    """The votes that count in a publish at ``now_ns``, by the newest policy; ``settings`` replace its ``fuse`` if
    given."""
    policy = policy_in(connection)
    if settings is not None:
        policy = policy.model_copy(update={"fuse": settings})
    received_by_ns = now_ns - round(policy.fuse.min_age_s * 1e9)
    return Electorate(mark, policy, received_by_ns, set_aside=ballots_aside(connection))


def next_ripe_ns(connection: sa.Connection, electorate: Electorate) -> int | None:
    """Time at which the next standing ballot reaches the policy's minimum age; None if no ballot waits for it."""
    age_ns = round(electorate.settings.min_age_s * 1e9)
    if age_ns == 0:
        return None
    received = _B.c.received_ns
    young = sa.select(sa.func.min(received)).where(received > electorate.received_by_ns, _stands_at(electorate.mark))
    first = connection.execute(young).scalar_one()
    return None if first is None else int(first) + age_ns


def _unready(stored: Any, electorate: Electorate) -> Why:
    """Why the policy does not count a row of ``_VOTES``, on whatever tile; "" if it does."""
    round_now = electorate.policy.round
    if stored.cast_by != round_now.cast_by or not stored.settings_hash.startswith(round_now.settings_hash):
        return "otherwise"
    return "young" if stored.received_ns > electorate.received_by_ns else ""


def judged_on(
    connection: sa.Connection,
    tile: Tile,
    electorate: Electorate,
    misread: Mapping[int, Bool] | None = None,
    polled: Polled | None = None,
) -> list[Vote]:
    """Every standing vote on ``tile`` as it is now, in the order of the ballots; those that count with their planes, in
    the cells where they count.

    ``misread``: see :func:`mapvote.fusion.fuse.unspent`. ``polled``: what stands there, if it was asked before.
    """
    index = tile.index
    polled = polled or poll(connection, index[0], [index[1]], electorate)
    judged = _judged(polled.standing[index], index, electorate)
    votes = iter(read_votes(connection, index, [vote for vote in judged if not vote.why], polled))
    return [vote if vote.why else _where_it_counts(next(votes), tile, misread, polled) for vote in judged]


def _where_it_counts(sent: Vote, tile: Tile, misread: Mapping[int, Bool] | None, polled: Polled) -> Vote:
    """A vote in the cells of ``tile`` in which it is neither spent nor of a reviewed change; and the cells lost."""
    fresh = polled.unspent(sent, tile, misread)
    obedient = fresh
    # Changes that reviewers held, or rejected after the drive first arrived.
    for seq, cells in polled.bars[tile.index]:
        if seq is None or sent.first_seq < seq:
            obedient = silenced(obedient, np.flatnonzero(cells))
    return replace(obedient, spent=_cells_lost(sent, fresh), reviewed=_cells_lost(fresh, obedient))


def _cells_lost(before: Vote, after: Vote) -> I64:
    """(n,) flat cells that the vote ``before`` determines and ``after`` does not."""
    if before is after:
        return np.empty(0, dtype=np.int64)
    if before.states is not None and after.states is not None:
        return np.flatnonzero(before.states != after.states)
    return np.flatnonzero(before.spoken() != after.spoken())


def recent_votes(
    connection: sa.Connection,
    tile: Tile,
    electorate: Electorate,
    misread: Mapping[int, Bool] | None = None,
    polled: Polled | None = None,
) -> list[Vote]:
    """The votes that count on ``tile``, in the cells where they are not spent, of every vehicle and of the last
    :func:`history_days`: what has come and gone here, and since when?"""
    index = tile.index
    polled = polled or poll(connection, index[0], [index[1]], electorate)
    judged = _judged(polled.standing[index], index, electorate)
    ready = [vote for vote in judged if vote.why in ("", "window")]
    oldest = max((vote.end_ns for vote in ready), default=0) - history_days(electorate.settings) * DAY_NS
    chosen = [vote for vote in ready if vote.end_ns >= oldest]
    return [polled.unspent(vote, tile, misread) for vote in read_votes(connection, index, chosen, polled)]


def from_sound_ballots(connection: sa.Connection, electorate: Electorate, read: Callable[[Electorate], Read]) -> Read:
    """Result of ``read`` without the ballots that are set aside, and without those found damaged on the way."""
    electorate = replace(electorate, set_aside=frozenset({*electorate.set_aside, *ballots_aside(connection)}))
    while True:
        try:
            return read(electorate)
        except DamagedBallots as error:
            electorate = electorate.leaving_out(error.found)


def ballots_aside(connection: sa.Connection) -> frozenset[str]:
    """Ballots in quarantine, as an electorate leaves them out."""
    return frozenset(name for kind, name in set_aside(connection) if kind == "ballot")


_PLANES_OF = sa.select(_T).where(
    _T.c.row == sa.bindparam("row", type_=sa.BigInteger),
    _T.c.col.in_(sa.bindparam("cols", expanding=True)),
    _T.c.ballot.in_(sa.bindparam("ballots", expanding=True)),
)
Rows = Mapping[tuple[int, int, int], Any]
"""The stored planes of a vote, by tile and ballot."""


def read_rows(connection: sa.Connection, row: int, votes: Sequence[tuple[int, Vote]]) -> Rows:
    """The stored votes on tiles of a ``row``, each with its column."""
    stored_rows: dict[tuple[int, int, int], Any] = {}
    cols = sorted({col for col, _ in votes})
    ballots = sorted({vote.ballot for _, vote in votes})
    for start in range(0, len(ballots), DATABASE_SIZES.variables):
        asked_of = {"row": row, "cols": cols, "ballots": ballots[start : start + DATABASE_SIZES.variables]}
        rows = connection.execute(_PLANES_OF, asked_of).all()
        stored_rows |= {(stored.row, stored.col, stored.ballot): stored for stored in rows}
    return stored_rows


def read_votes(
    connection: sa.Connection, index: TileIndex, votes: Sequence[Vote], polled: Polled | None = None
) -> list[Vote]:
    """The ``votes`` with their planes, in their order, nothing silenced. DamagedBallots, naming them, if some are.

    ``polled``: what was read before.
    """
    stored, read = ({}, {}) if polled is None else (polled.rows, polled.read)
    unread = {vote.ballot: vote for vote in votes if (*index, vote.ballot) not in read}
    missing = [(index[1], vote) for vote in unread.values() if (*index, vote.ballot) not in stored]
    rows = {**stored, **read_rows(connection, index[0], missing)} if missing else stored
    rows_of = {ballot: rows[*index, ballot] for ballot in unread}
    # Whoever is remembered is read too, or what is decided would follow from what this process happened to read before
    # the disk lost it.
    damaged = [ballot_name(ballot, *index) for ballot, row in rows_of.items() if not is_sound(_T, row)]
    if damaged:
        raise DamagedBallots([Damage("ballot", name, NOT_ITS_SUM) for name in damaged])
    unpacked = remembered.get([row.sum for row in rows_of.values()])
    for ballot, row in rows_of.items():
        if row.sum not in unpacked:
            unpacked[row.sum] = unpack_planes(decode_tile(row.votes))
            remembered.put(row.sum, unpacked[row.sum])
        read[*index, ballot] = unpacked[row.sum]
    return [vote.with_planes(read[*index, vote.ballot]) for vote in votes]


def withdraw(store: Store, vehicle: str | None, drive: str | None = None, *, by: str) -> int:
    """Withdraw votes before publication: one drive of a vehicle, all its drives, or (None) every vehicle's. Returns the
    number of ballots.

    NotFound if there is none. Earlier versions keep them: see :func:`mapvote_server.store.rollback.replay`.
    """
    b = schema.ballots
    whose = f"{vehicle or '*'}/{drive or '*'}"
    wanted: sa.ColumnElement[bool] = b.c.gone_seq.is_(None)
    if vehicle is not None:
        wanted &= b.c.vehicle == vehicle
    if drive is not None:
        wanted &= b.c.drive == drive
    with store.database.writing() as connection:
        if connection.execute(sa.select(b.c.seq).where(wanted)).first() is None:
            raise NotFound(f"there is no standing ballot {whose}")
        seq = log_event(connection, store.clock(), "withdraw", by, whose)
        withdrawn = connection.execute(b.update().where(wanted).values(gone_seq=seq)).rowcount
    return int(withdrawn)
