"""Integrity of a store: damage is found, put into quarantine, and a plane is put back from another copy.

A plane of a tile is named by the SHA-256 of its values. Every other row carries a SHA-256 over what is written once.
A ballot in quarantine does not count on its tile, and a tile with a damaged plane is not fused. All else goes on.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import sqlalchemy as sa

from mapvote.codec.ballot import tile_key
from mapvote.codec.planes import compress, unpack_bytes
from mapvote.codec.tile_planes import TILE_PLANE_SIZES
from mapvote.core.grid import TileIndex
from mapvote.core.types import MapvoteError
from mapvote_server.errors import NotFound
from mapvote_server.store import schema
from mapvote_server.store.database import DATABASE_SIZES, Question, insert_rows, is_sound
from mapvote_server.store.queries import log_event, oldest_kept, shows_in_kept, shows_in_target
from mapvote_server.store.store import Store


def check(store: Store, *, mend: bool = False, by: str = "operator") -> list[Damage]:
    """Everything that is damaged; with ``mend`` it is set aside."""
    with store.database.reading() as connection:
        damaged = [*_database(connection, store), *_planes(connection), *_chain(connection)]
        damaged += [*_rows(connection), *_ends(connection)]
    if mend and damaged:
        with store.database.writing() as connection:
            quarantine(connection, damaged, store.clock(), by)
        return [replace(damage, mended="set aside") for damage in damaged]
    return damaged


def restore_plane(store: Store, digest: str, raw: bytes, *, by: str) -> bool:
    """Put the plane of a tile back where it is damaged or lost, by its values in another copy.

    False if the store has it as it was written. MapvoteError if ``raw`` is not this plane, NotFound if no version shows
    it.
    """
    if hashlib.sha256(raw).hexdigest() != digest:
        raise MapvoteError(f"plane {digest[:12]}: the bytes sent are not what this hash says")
    b = schema.blobs
    q = schema.quarantine
    t = schema.version_tiles
    with store.database.writing() as connection:
        shows = sa.or_(*(t.c[name] == digest for name in schema.TILE_PLANES))
        if connection.execute(sa.select(t.c.version).where(shows).limit(1)).first() is None:
            raise NotFound(f"no version here shows plane {digest[:12]}")
        aside = connection.execute(q.delete().where(q.c.kind == "plane", q.c.name == digest)).rowcount
        held = connection.execute(sa.select(b.c.data).where(b.c.hash == digest)).scalar_one_or_none()
        if held is not None and not _wrong(digest, held) and not aside:
            return False
        connection.execute(b.delete().where(b.c.hash == digest))
        insert_rows(connection, b, [(digest, compress(raw, 3))])
        log_event(connection, store.clock(), MENDED, by, f"plane {digest}")
    return True


def _database(connection: sa.Connection, store: Store) -> Iterator[Damage]:
    """Damage that the database finds in its own pages."""
    if store.database.is_sqlite:
        for (said,) in connection.execute(sa.text("PRAGMA integrity_check(20)")).all():
            if said != "ok":
                yield Damage("database", "pages", str(said)[:180])


def _planes(connection: sa.Connection) -> Iterator[Damage]:
    for row in _in_batches(connection, sa.select(schema.blobs).order_by(schema.blobs.c.hash)):
        defect = _wrong(row.hash, row.data)
        if defect:
            yield Damage("plane", row.hash, defect)


def _wrong(digest: str, data: bytes) -> str:
    try:
        raw = unpack_bytes(data, TILE_PLANE_SIZES.plane_bytes, "plane")
    except MapvoteError as error:
        return str(error)[:120]
    return "" if hashlib.sha256(raw).hexdigest() == digest else "is not what its hash says"


def _chain(connection: sa.Connection) -> Iterator[Damage]:
    """Versions follow each other, and every plane is there that a kept version or a replay needs."""
    v = schema.versions
    t = schema.version_tiles
    last = None
    for number, parent in connection.execute(sa.select(v.c.number, v.c.parent).order_by(v.c.number)):
        if parent != last or (last is not None and number != last + 1):
            yield Damage("version", str(number), f"follows version {parent}, not {last}")
        last = number
    oldest = oldest_kept(connection)
    needed = shows_in_kept(oldest) | shows_in_target(oldest)
    for name in schema.TILE_PLANES:
        column = t.c[name]
        lost = sa.select(t.c.version, t.c.row, t.c.col, column).join(
            schema.blobs, schema.blobs.c.hash == column, isouter=True
        )
        for row in connection.execute(lost.where(column.is_not(None), schema.blobs.c.hash.is_(None), needed)):
            lacks = f"{name} of tile {tile_key((row.row, row.col))} in version {row.version} is lost"
            yield Damage("plane", row[3], lacks)


def _rows(connection: sa.Connection) -> Iterator[Damage]:
    """Rows that are not what their sums say."""
    for kind, table in schema.SUMMED.items():
        key = list(table.primary_key)
        for row in _in_batches(connection, sa.select(table).order_by(*key)):
            if not is_sound(table, row):
                name = " ".join(str(getattr(row, column.name))[:64] for column in key)
                votes = kind == "votes" and ballot_name(row.ballot, row.row, row.col)
                yield Damage("ballot" if votes else kind, votes or name, NOT_ITS_SUM)


def _ends(connection: sa.Connection) -> Iterator[Damage]:
    """Every row that was replaced, withdrawn or deleted names an existing event that is later than the row itself."""
    b = schema.ballots.c
    r = schema.reviews.c
    v = schema.versions.c
    e = schema.events.c
    for kind, name, came, ended in (
        ("ballot", b.seq, b.seq, b.gone_seq), ("review", r.seq, r.seq, r.gone_seq),
        ("version", v.number, v.mark, v.cleared_seq),
    ):  # fmt: skip
        lost = ended.not_in(sa.select(e.seq)) | (ended <= came)
        for row in connection.execute(sa.select(name, ended).where(ended.is_not(None), lost)):
            yield Damage(kind, str(row[0]), f"ended by event {row[1]}, which cannot be")


def _in_batches(connection: sa.Connection, query: sa.Select[Any]) -> Iterator[Any]:
    """Rows, so many at a time: a store is larger than memory."""
    yield from connection.execution_options(yield_per=DATABASE_SIZES.checked_together).execute(query)


MENDED = "mended"
"""The kind of the event by which a plane is again what it was."""
KINDS = ("plane", *schema.SUMMED.keys() - {"votes"}, "row", "database")
NOT_ITS_SUM = "is not what its sum says"


@dataclass(frozen=True, slots=True)
class Damage:
    """One item that differs from what was written."""

    kind: str
    """One of KINDS."""
    name: str
    """The plane's hash; or ballot, version and tile."""
    why: str
    mended: str = ""
    """The repair; empty: none yet."""

    def __str__(self) -> str:
        return f"{self.kind} {self.name}: {self.why}" + (f"; {self.mended}" if self.mended else "")


class DamagedBallots(MapvoteError):
    """Votes that are not what was sent."""

    def __init__(self, damaged: list[Damage]) -> None:
        super().__init__("; ".join(map(str, damaged)))
        self.found = damaged


def ballot_name(seq: int, row: int, col: int) -> str:
    """One ballot's votes on one tile."""
    return f"{seq} on tile {tile_key((row, col))}"


def set_aside(connection: sa.Connection) -> dict[tuple[str, str], str]:
    """Why each thing is in quarantine, by (kind, name)."""
    q = schema.quarantine
    return {(row.kind, row.name): row.why for row in connection.execute(sa.select(q.c.kind, q.c.name, q.c.why))}


def quarantine(connection: sa.Connection, damaged: Iterable[Damage], now_ns: int, by: str) -> None:
    """Quarantine items that are not quarantined yet; each is named in the log."""
    in_quarantine = set(set_aside(connection))
    for damage in damaged:
        if (damage.kind, damage.name) not in in_quarantine:
            seq = log_event(connection, now_ns, "quarantine", by, str(damage))
            row = {"kind": damage.kind, "name": damage.name[:160], "seq": seq, "why": damage.why[:200]}
            connection.execute(schema.quarantine.insert().values(**row))
            in_quarantine.add((damage.kind, damage.name))


def tiles_hurt_or_mended(connection: sa.Connection, since: int) -> set[TileIndex]:
    """Tiles that may be fused otherwise since an event: a ballot there was set aside, or one of their planes mended."""
    t = schema.ballot_tiles.c
    v = schema.version_tiles
    aside = _SET_ASIDE.ask(connection, since=since).scalars()
    ballots = {int(name.split()[0]) for name in aside}
    planes = {detail.removeprefix("plane ") for detail in _MENDED.ask(connection, since=since).scalars()}
    queries = []
    if ballots:
        queries.append(sa.select(t.row, t.col).where(t.ballot.in_(ballots)))
    if planes:
        shows = sa.or_(*(v.c[name].in_(planes) for name in schema.TILE_PLANES))
        queries.append(sa.select(v.c.row, v.c.col).where(shows))
    return {(row, col) for query in queries for row, col in connection.execute(query)}


def hurt_or_mended_since(connection: sa.Connection, since: int) -> bool:
    """Whether anything was set aside since an event, or a plane mended."""
    return any(question.ask(connection, since=since).first() is not None for question in (_ASIDE, _MENDED))


_Q, _E, _SINCE = schema.quarantine.c, schema.events.c, sa.bindparam("since", type_=sa.BigInteger)
_ASIDE = Question(sa.select(_Q.name).where(_Q.seq > _SINCE))
_SET_ASIDE = Question(sa.select(_Q.name).where(_Q.kind == sa.literal("ballot"), _Q.seq > _SINCE))
_MENDED = Question(sa.select(_E.detail).where(_E.kind == sa.literal(MENDED), _E.seq > _SINCE))
