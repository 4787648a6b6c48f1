"""Keys of vehicles and operators: random, shown once, stored hashed, revocable."""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa

from mapvote.core.types import MapvoteError
from mapvote.server.errors import NotFound, Unauthorised
from mapvote.server.store import schema
from mapvote.server.store.queries import log_event
from mapvote.server.store.store import Store

Role = Literal["vehicle", "operator"]
UNKNOWN = "this key is unknown or revoked: ask the operator for a new one (mapvote keys)"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class Key:
    """Whose key it is."""

    name: str
    role: str
    created_ns: int
    revoked_ns: int | None


def issue(store: Store, name: str, role: Role, *, by: str = "operator") -> str:
    """A new key for a vehicle or an operator; the only time that it is seen. A name may hold several."""
    if not _NAME.fullmatch(name):
        raise MapvoteError(f"{name!r} is no name: 1-64 of letters, digits, dot, underscore, dash")
    secret = secrets.token_urlsafe(32)
    with store.database.writing() as connection:
        now = store.clock()
        row = {"name": name, "role": role, "hash": hash_of(secret), "created_ns": now}
        connection.execute(schema.keys.insert().values(**row))
        log_event(connection, now, "key issued", by, f"{role} {name}")
    return secret


def revoke(store: Store, name: str, *, by: str = "operator") -> int:
    """Revoke every key of a name; how many. NotFound if it has none that is valid."""
    k = schema.keys
    with store.database.writing() as connection:
        now = store.clock()
        done = connection.execute(k.update().where(k.c.name == name, k.c.revoked_ns.is_(None)).values(revoked_ns=now))
        if not done.rowcount:
            raise NotFound(f"{name!r} has no valid key")
        log_event(connection, now, "key revoked", by, name)
    return int(done.rowcount)


def listed(store: Store) -> list[Key]:
    """All keys ever issued, oldest first; never the keys themselves."""
    k = schema.keys
    with store.database.reading() as connection:
        rows = connection.execute(
            sa.select(k.c.name, k.c.role, k.c.created_ns, k.c.revoked_ns).order_by(k.c.created_ns)
        )
        return [Key(*row) for row in rows]


def check(store: Store, hashes: Sequence[str]) -> list[Key | Exception]:
    """Whose keys these are, by :func:`hash_of`; Unauthorised in the place of one that is unknown or revoked."""
    with store.database.reading() as connection:
        valid = of(connection, set(hashes))
    return [valid[digest] if digest in valid else Unauthorised(UNKNOWN) for digest in hashes]


def of(connection: sa.Connection, hashes: Collection[str]) -> dict[str, Key]:
    """The valid keys among these, by :func:`hash_of`."""
    if not hashes:
        return {}
    k = schema.keys
    query = sa.select(k.c.hash, k.c.name, k.c.role, k.c.created_ns, k.c.revoked_ns)
    rows = connection.execute(query.where(k.c.hash.in_(hashes), k.c.revoked_ns.is_(None)))
    return {row.hash: Key(row.name, row.role, row.created_ns, row.revoked_ns) for row in rows}


def hash_of(secret: str) -> str:
    """SHA-256: a key is 256 random bits, so no slow hash is needed."""
    return hashlib.sha256(secret.encode()).hexdigest()
