"""The content of a store and its history: changes between versions, and its log in order, for its listeners (pages,
integrators, webhooks), who share one poll of the database."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from threading import Lock
from typing import Annotated, Any, Literal

import sqlalchemy as sa
from pydantic import Field

from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import names_in_plane
from mapvote.core.answers import answer
from mapvote.core.record import record
from mapvote.core.times import utc
from mapvote.core.types import MapvoteError
from mapvote_server.errors import Unavailable
from mapvote_server.store import schema
from mapvote_server.store.integrity import set_aside
from mapvote_server.store.keys import hash_of
from mapvote_server.store.policy import without_drive
from mapvote_server.store.queries import (
    Version,
    current_number,
    load_blob,
    newest_seq,
    oldest_kept,
    tiles_of,
    version_of,
)
from mapvote_server.store.store import Store


@record()
@dataclass(frozen=True, slots=True)
class EventPolls:
    """Numbers of the content and the log of a store."""

    field_tiles: int = 3
    """Tiles with fields that are read for their names."""
    most: int = 500
    """Events of one poll, at most."""
    poll_s: float = 0.9
    """Least time between two polls of the database, seconds."""


EVENT_POLLS = EventPolls()


@answer
@dataclass(frozen=True, slots=True)
class Info:
    """The content of the store."""

    map_id: str
    version: int
    published_ns: int
    oldest_version: int
    tiles: int
    fields: str
    ballots: int
    vehicles: int
    votes_on_tiles: int
    planes: int
    plane_bytes: int
    quarantined: int


@answer
@dataclass(frozen=True, slots=True)
class VersionEntry:
    """The origin of a version."""

    number: int
    parent: int | None
    kind: Literal["import", "publish", "rollback", "replay"]
    target: Annotated[int | None, Field(description="of a rollback or replay: the version it goes back to")]
    published_by: str
    reason: str


@answer
@dataclass(frozen=True, slots=True)
class DatedVersion(VersionEntry):
    """A version with the policy that it was made by."""

    created: str
    policy: dict[str, Any]


@answer
@dataclass(frozen=True, slots=True)
class LoggedVersion(VersionEntry):
    """A version in the log."""

    created_ns: int


@answer
@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """One line of the log."""

    seq: int
    at_ns: int
    kind: str
    actor: str
    detail: str


@dataclass(frozen=True, slots=True)
class Event(LoggedEvent):
    """One line of the log, as listeners get it."""

    version: int
    """The newest version when the event was read."""


@answer
@dataclass(frozen=True, slots=True)
class Log:
    """Versions oldest first, events newest first."""

    versions: list[LoggedVersion]
    events: list[LoggedEvent]


def overview(store: Store) -> Info:
    """The figures of `mapvote info`."""
    b = schema.ballots
    t = schema.ballot_tiles
    standing = sa.select(sa.func.count(), sa.func.count(sa.distinct(b.c.vehicle))).where(b.c.gone_seq.is_(None))
    with store.database.reading() as connection:
        newest = version_of(connection)
        ballots, vehicles = connection.execute(standing).one()
        planes, size = connection.execute(
            sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(sa.func.length(schema.blobs.c.data)), 0))
        ).one()
        votes = connection.execute(sa.select(sa.func.count()).select_from(t)).scalar_one()
        tiles = tiles_of(connection, newest.number)
        return Info(
            map_id=store.map_id,
            version=newest.number,
            published_ns=newest.created_ns,
            oldest_version=oldest_kept(connection),
            tiles=len(tiles),
            fields=_fields(connection, tiles.values()),
            ballots=ballots,
            vehicles=vehicles,
            votes_on_tiles=votes,
            planes=planes,
            plane_bytes=int(size),
            quarantined=len(set_aside(connection)),
        )


def _fields(connection: sa.Connection, tiles: Iterable[TileHashes]) -> str:
    """Names of the point fields, by the first readable tiles that have any."""
    names: dict[str, None] = {}
    for digest in islice((hashes.fields for hashes in tiles if hashes.fields is not None), EVENT_POLLS.field_tiles):
        try:
            names |= dict.fromkeys(names_in_plane(load_blob(connection, digest), digest))
        except Unavailable:
            raise
        except MapvoteError:
            continue
    return ", ".join(names) or "none"


def _origin_of(version: Version) -> dict[str, Any]:
    """The members of a :class:`VersionEntry`."""
    return {member.name: getattr(version, member.name) for member in fields(VersionEntry)}


def dated_versions(store: Store, with_names: bool) -> list[DatedVersion]:
    """The versions, oldest first. Without ``with_names`` the name of the policy's gate drive is left out."""
    return [
        DatedVersion(
            **_origin_of(version),
            created=utc(version.created_ns),
            policy=dict(version.policy if with_names else without_drive(version.policy)),
        )
        for version in store.versions()
    ]


def log_of(store: Store, last: int, before: int | None = None) -> Log:
    """The versions, oldest first, and the ``last`` so many events (``before`` one of this number), newest first."""
    versions = [LoggedVersion(**_origin_of(version), created_ns=version.created_ns) for version in store.versions()]
    return Log(versions, last_events(store, last, before) if last else [])


OF_THE_MAP = ("import", "publish", "rollback", "replay")
"""Kinds that concern the map alone: actor and reason are open to every reader."""
OF_VEHICLES = ("ballot", "withdraw", "two places")
"""Kinds that reveal the minute of a drive."""


def newest_event(store: Store) -> int:
    """Number of the last event."""
    with store.database.reading() as connection:
        return newest_seq(connection)


def taken_up_to(store: Store, address: str) -> int:
    """The last event that the listener at this address took; of a new listener the newest event."""
    d = schema.deliveries
    with store.database.writing() as connection:
        taken = connection.execute(sa.select(d.c.seq).where(d.c.address == hash_of(address))).scalar_one_or_none()
        if taken is None:
            taken = newest_seq(connection)
            connection.execute(d.insert().values(address=hash_of(address), seq=taken))
    return int(taken)


def take(store: Store, address: str, seq: int) -> None:
    """Note that a known listener took all events up to this one."""
    d = schema.deliveries
    with store.database.writing() as connection:
        connection.execute(d.update().where(d.c.address == hash_of(address)).values(seq=seq))


def events_after(store: Store, seq: int) -> list[Event]:
    """The events after ``seq``, oldest first, 500 at most. Writing transactions are serial, so none appears later."""
    e = schema.events
    query = sa.select(e.c.seq, e.c.at_ns, e.c.kind, e.c.actor, e.c.detail).where(e.c.seq > seq).order_by(e.c.seq)
    with store.database.reading() as connection:
        rows = connection.execute(query.limit(EVENT_POLLS.most)).all()
        version = current_number(connection) if rows else 0
    return [Event(*row, version) for row in rows]


def last_events(store: Store, limit: int = 100, before: int | None = None) -> list[LoggedEvent]:
    """The last events (``before`` one of this number), newest first."""
    e = schema.events.c
    query = sa.select(e.seq, e.at_ns, e.kind, e.actor, e.detail).order_by(schema.events.c.seq.desc()).limit(limit)
    if before is not None:
        query = query.where(e.seq < before)
    with store.database.reading() as connection:
        return [LoggedEvent(*row) for row in connection.execute(query)]


class Feed:
    """The latest events of one store, kept for all listeners; thread-safe.

    The first listener that calls :meth:`after` within ``poll_s`` seconds polls the database.
    """

    def __init__(
        self, store: Store, poll_s: float = EVENT_POLLS.poll_s, seconds: Callable[[], float] = time.monotonic
    ) -> None:
        self._store = store
        self._poll_s = poll_s
        self._seconds = seconds
        self._lock = Lock()
        self._recent: deque[Event] = deque(maxlen=EVENT_POLLS.most)
        self._newest: int | None = None
        self._polled_s = -poll_s

    def after(self, seq: int) -> list[Event]:
        """The events after ``seq``, oldest first, at most 500. Older events than those kept are read from the log."""
        with self._lock:
            now_s = self._seconds()
            if self._newest is None:
                self._newest = newest_event(self._store)
                self._polled_s = now_s
            elif now_s - self._polled_s >= self._poll_s:
                events = events_after(self._store, self._newest)
                self._recent.extend(events)
                self._newest = events[-1].seq if events else self._newest
                self._polled_s = now_s
            if seq >= self._newest:
                return []
            if self._recent and self._recent[0].seq <= seq + 1:
                return [event for event in self._recent if event.seq > seq]
        return events_after(self._store, seq)


def without_names(events: Sequence[Event]) -> list[Event]:
    """Events for readers that may not see vehicles' names: none of ballots, others without actor and detail."""
    shown = [e for e in events if e.kind not in OF_VEHICLES]
    return [e if e.kind in OF_THE_MAP else Event(e.seq, e.at_ns, e.kind, "", "", e.version) for e in shown]
