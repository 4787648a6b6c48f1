"""Retention: deletes planes and decisions of old versions, and ballots that can decide nothing more.

The rows that record a version or a ballot stay. From the oldest kept version on, publish, rollback and replay work as
before: planes of an older version stay as long as a kept rollback went back to that version.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from mapvote.fusion.change_time import history_days
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.store import schema
from mapvote_server.store.database import DATABASE_SIZES, Question
from mapvote_server.store.policy import Policy, policy_in
from mapvote_server.store.queries import (
    current_number,
    log_event,
    oldest_kept,
    shows_in_kept,
    shows_in_target,
    version_of,
)
from mapvote_server.store.store import Store

CLEARED = "cleared"
"""The kind of the event by which something was deleted."""


@dataclass(frozen=True, slots=True)
class Cleared:
    """Rows that were deleted, or would be."""

    oldest: int
    """The oldest version that is kept."""
    versions: int
    planes: int
    decisions: int
    ballots: int
    """Votes of one drive on one tile."""
    size: int
    """Bytes of all these."""


def clear(store: Store, *, by: str = "operator", dry_run: bool = True) -> Cleared:
    """Delete what the policy does not keep, in one transaction; with ``dry_run`` only count it."""
    with store.database.reading() if dry_run else store.database.writing() as connection:
        v = schema.versions
        d = schema.decisions
        b = schema.ballots
        t = schema.ballot_tiles
        keep = policy_in(connection).keep.versions
        oldest = oldest_kept(connection)
        if keep:  # the first of the last so many versions; one that was not cleared yet if none may go
            oldest = max(oldest, current_number(connection) - keep + 1)
        old_planes = _planes(connection, oldest)
        old_ballots = _ballots(connection, oldest)
        length = (sa.func.length(d.c.states) + sa.func.length(d.c.tally)).label("size")
        decided = sa.select(d.c.version, d.c.row, d.c.col, length).where(d.c.version < oldest)
        old_decisions = list(connection.execute(decided).all())
        gone = (v.c.number < oldest) & v.c.cleared_seq.is_(None)
        versions = int(connection.execute(sa.select(sa.func.count()).where(gone)).scalar_one())
        size = sum(row.size for row in (*old_planes, *old_ballots, *old_decisions))
        cleared = Cleared(oldest, versions, len(old_planes), len(old_decisions), len(old_ballots), size)
        if dry_run or not (versions or old_planes or old_ballots or old_decisions):
            return cleared
        detail = f"{versions} versions before {oldest}, {len(old_ballots)} ballots on tiles, {size} bytes"
        seq = log_event(connection, store.clock(), CLEARED, by, detail)
        connection.execute(v.update().where(gone).values(cleared_seq=seq))
        _delete(connection, schema.decisions, ("version", "row", "col"), old_decisions)
        _delete(connection, schema.ballot_tiles, ("row", "col", "ballot"), old_ballots)
        _delete(connection, schema.blobs, ("hash",), old_planes)
        # A ballot of which nothing is left takes no room of its vehicle's quota any more.
        empty = (b.c.bytes > 0) & ~sa.exists().where(t.c.ballot == b.c.seq)
        connection.execute(b.update().where(empty).values(bytes=0))
    return cleared


def cleared_since(connection: sa.Connection, seq: int) -> bool:
    """Whether anything was deleted after an event."""
    return _CLEARED.ask(connection, seq=seq).first() is not None


_E = schema.events.c
_CLEARED = Question(
    sa.select(_E.seq)
    .where(_E.kind == sa.literal(CLEARED), _E.seq > sa.bindparam("seq", type_=sa.BigInteger))
    .limit(sa.literal_column("1"))
)


def _planes(connection: sa.Connection, oldest: int) -> list[Any]:
    """Planes that no version from ``oldest`` on shows, and no version to which one of these went back."""
    t = schema.version_tiles
    b = schema.blobs
    planes = schema.TILE_PLANES
    shown = shows_in_kept(oldest) | shows_in_target(oldest)
    needed = sa.union(*(sa.select(t.c[name]).where(t.c[name].is_not(None), shown) for name in planes))
    unused = sa.select(b.c.hash, sa.func.length(b.c.data).label("size")).where(b.c.hash.not_in(needed))
    return list(connection.execute(unused).all())


def _ballots(connection: sa.Connection, oldest: int) -> list[Any]:
    """Votes on a tile that no version after ``oldest`` has counted or can count: withdrawn or replaced before it, or
    older than every window of the policies since, counted from the newest vote on the tile that stood then and still
    does."""
    t = schema.ballot_tiles
    b = schema.ballots
    then = version_of(connection, oldest)
    newest = (
        sa.select(t.c.row, t.c.col, sa.func.max(b.c.end_ns).label("end_ns"))
        .join(b, b.c.seq == t.c.ballot)
        .where(b.c.seq <= then.mark, b.c.gone_seq.is_(None))
        .group_by(t.c.row, t.c.col)
        .subquery()
    )
    v = schema.versions
    made_by = connection.execute(sa.select(v.c.policy).where(v.c.number >= oldest, v.c.kind == "publish")).scalars()
    policies = [policy_in(connection), *(Policy.model_validate(one) for one in made_by)]
    window_ns = round(max(history_days(policy.fuse) for policy in policies) * DAY_NS)
    past = (b.c.gone_seq <= then.mark) | (b.c.end_ns < newest.c.end_ns - window_ns)
    query = (
        sa.select(t.c.row, t.c.col, t.c.ballot, sa.func.length(t.c.votes).label("size"))
        .join(b, b.c.seq == t.c.ballot)
        .join(newest, (newest.c.row == t.c.row) & (newest.c.col == t.c.col), isouter=True)
    )
    return list(connection.execute(query.where(past)).all())


def _delete(connection: sa.Connection, table: sa.Table, key: Iterable[str], rows: list[Any]) -> None:
    columns = sa.tuple_(*(table.c[name] for name in key))
    for start in range(0, len(rows), DATABASE_SIZES.variables):
        keys = [tuple(getattr(row, name) for name in key) for row in rows[start : start + DATABASE_SIZES.variables]]
        connection.execute(table.delete().where(columns.in_(keys)))
