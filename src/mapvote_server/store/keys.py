"""Keys and whose they are: random, shown once, stored hashed, with a role and perhaps an end."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import sqlalchemy as sa

from mapvote.core.answers import answer
from mapvote.core.types import MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.errors import Conflict, NotFound, Unauthorised
from mapvote_server.store import schema
from mapvote_server.store.queries import end_votes, log_event
from mapvote_server.store.store import Store

Role = Literal["vehicle", "reader", "reviewer", "operator"]
"""A vehicle votes; a reader looks; a reviewer also sees who voted what and judges pending changes; an operator does
all."""
ROLES: tuple[Role, ...] = get_args(Role)
UNKNOWN = "this key is unknown, revoked or past its end: ask the operator for a new one (mapvote keys)"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
MOST_DAYS = 36_500
"""A key is good for at most so many days, a century, or until it is revoked."""


@dataclass(frozen=True, slots=True)
class Key:
    """Name of the vehicle or person."""

    name: str
    role: str
    created_ns: int
    revoked_ns: int | None
    expires_ns: int | None = None

    def valid_at(self, now_ns: int) -> bool:
        """Whether it opens anything."""
        return self.revoked_ns is None and (self.expires_ns is None or self.expires_ns > now_ns)


def issue(store: Store, name: str, role: Role, *, by: str = "operator", days: float | None = None) -> str:
    """A new key, good for so many days (None: until it is revoked); the only time that it is seen. A name may hold
    several, all of one role: Conflict if it has valid keys of another. MapvoteError for a name that cannot be one."""
    with store.database.writing() as connection:
        return put_in(connection, store.clock(), name, role, by, days)


def put_in(connection: sa.Connection, now_ns: int, name: str, role: Role, by: str, days: float | None = None) -> str:
    """:func:`issue` within a transaction."""
    if not _NAME.fullmatch(name):
        raise MapvoteError(f"{name!r} is no name: 1-64 of letters, digits, dot, underscore, dash")
    if role not in ROLES:
        raise MapvoteError(f"{role!r} is no role; choose one of {', '.join(ROLES)}")
    if days is not None and not 0 < days <= MOST_DAYS:
        raise MapvoteError(f"a key for {days:g} days: give more than 0 and at most {MOST_DAYS}, or leave it out")
    others = {key.role for key in _keys_of(connection, name) if key.valid_at(now_ns)} - {role}
    if others:
        raise Conflict(f"{name!r} has a valid key of a {others.pop()}: a name has one role; revoke that one first")
    secret = secrets.token_urlsafe(32)
    end = None if days is None else now_ns + round(days * DAY_NS)
    row = {"name": name, "role": role, "hash": hash_of(secret), "created_ns": now_ns, "expires_ns": end}
    connection.execute(schema.keys.insert().values(**row))
    log_event(connection, now_ns, "key issued", by, f"{role} {name}" + ("" if days is None else f" for {days:g} days"))
    return secret


def rotate(store: Store, name: str, *, by: str = "operator", overlap_days: float = 1.0) -> str:
    """A new key for who has one, of the same role and length; those that were valid end after ``overlap_days``.

    NotFound if the name has no valid key.
    """
    k = schema.keys
    with store.database.writing() as connection:
        now_ns = store.clock()
        valid = [key for key in _keys_of(connection, name) if key.valid_at(now_ns)]
        if not valid:
            raise NotFound(f"{name!r} has no valid key to take the place of; issue one")
        last = valid[-1]
        end = now_ns + round(overlap_days * DAY_NS)
        later = (k.c.name == name) & k.c.revoked_ns.is_(None) & (k.c.expires_ns.is_(None) | (k.c.expires_ns > end))
        connection.execute(k.update().where(later).values(expires_ns=end))
        days = None if last.expires_ns is None else (last.expires_ns - last.created_ns) / DAY_NS
        return put_in(connection, now_ns, name, last.role, by, days)  # type: ignore[arg-type]


def revoke(store: Store, name: str, *, by: str = "operator", keep_votes: bool = False) -> tuple[int, int]:
    """Revoke every key of a name: (keys, ballots that count no more). NotFound if it has no valid key.

    Revoking a key also withdraws its holder's unpublished ballots, unless ``keep_votes``. Published votes stay
    (:func:`mapvote_server.store.rollback.replay` removes them too).
    """
    k = schema.keys
    now_ns = store.clock()
    valid = (k.c.name == name) & k.c.revoked_ns.is_(None) & (k.c.expires_ns.is_(None) | (k.c.expires_ns > now_ns))
    with store.database.writing() as connection:
        done = connection.execute(k.update().where(valid).values(revoked_ns=now_ns))
        if not done.rowcount:
            raise NotFound(f"{name!r} has no valid key")
        seq = log_event(connection, now_ns, "key revoked", by, f"{name}, its votes {'stay' if keep_votes else 'go'}")
        return int(done.rowcount), 0 if keep_votes else end_votes(connection, name, seq)


def ballots_standing(store: Store) -> dict[str, int]:
    """Number of standing ballots, by the name of their vehicle."""
    b = schema.ballots.c
    query = sa.select(b.vehicle, sa.func.count()).where(b.gone_seq.is_(None)).group_by(b.vehicle)
    with store.database.reading() as connection:
        return {vehicle: int(count) for vehicle, count in connection.execute(query)}


@answer
@dataclass(frozen=True, slots=True)
class KeyEntry(Key):
    """A key that was issued; never the key itself."""

    expires_ns: int | None
    valid: bool
    ballots: int
    """standing ballots of this name"""


def entries(store: Store) -> list[KeyEntry]:
    """All keys ever issued, oldest first."""
    standing = ballots_standing(store)
    now_ns = store.clock()
    return [
        KeyEntry(**asdict(key), valid=key.valid_at(now_ns), ballots=standing.get(key.name, 0)) for key in listed(store)
    ]


def listed(store: Store) -> list[Key]:
    """All keys ever issued, oldest first; never the keys themselves."""
    with store.database.reading() as connection:
        return _keys_of(connection)


def any_issued(store: Store) -> bool:
    """Whether the store has ever seen a key: one that is revoked closes an open server as well."""
    with store.database.reading() as connection:
        return connection.execute(sa.select(schema.keys.c.name).limit(1)).first() is not None


def check(store: Store, hashes: Sequence[str]) -> list[Key | Exception]:
    """Whose keys these are, by :func:`hash_of`; Unauthorised in the place of one that opens nothing."""
    with store.database.reading() as connection:
        valid = of(connection, set(hashes), store.clock())
    return [valid[digest] if digest in valid else Unauthorised(UNKNOWN) for digest in hashes]


def of(connection: sa.Connection, hashes: Collection[str], now_ns: int) -> dict[str, Key]:
    """The keys among these that are valid ``now_ns``, by :func:`hash_of`."""
    if not hashes:
        return {}
    k = schema.keys
    rows = connection.execute(sa.select(k.c.hash, *_COLUMNS).where(k.c.hash.in_(hashes)))
    return {digest: key for digest, *columns in rows if (key := Key(*columns)).valid_at(now_ns)}


def hash_of(secret: str) -> str:
    """SHA-256: a key is 256 random bits, so no slow hash is needed."""
    return hashlib.sha256(secret.encode()).hexdigest()


def pseudonyms(store: Store, names: Collection[str]) -> dict[str, str]:
    """The pseudonym of each vehicle for vehicles and readers: constant, and specific to this store."""
    with store.database.reading() as connection:
        secret = connection.execute(sa.select(schema.maps.c.secret)).scalar_one().encode()
    return {name: "vehicle-" + hmac.digest(secret, name.encode(), "sha256").hex()[:10] for name in names}


_COLUMNS = tuple(schema.keys.c[name] for name in ("name", "role", "created_ns", "revoked_ns", "expires_ns"))


def _keys_of(connection: sa.Connection, name: str | None = None) -> list[Key]:
    k = schema.keys
    query = sa.select(*_COLUMNS).order_by(k.c.created_ns)
    return [Key(*row) for row in connection.execute(query if name is None else query.where(k.c.name == name))]
