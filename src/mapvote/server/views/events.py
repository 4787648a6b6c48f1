"""The log of a store in order, for its listeners: pages, integrators, webhooks. They share one poll of the database."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

import sqlalchemy as sa

from mapvote.server.store import schema
from mapvote.server.store.keys import hash_of
from mapvote.server.store.queries import current_number, newest_seq
from mapvote.server.store.store import Store

OF_THE_MAP = ("import", "publish", "rollback", "replay")
"""Kinds that concern the map alone: actor and reason are open to every reader."""
OF_VEHICLES = ("ballot", "withdraw")
"""Kinds that reveal the minute of a drive."""
_MOST = 500
POLL_S = 0.9
"""Least time between two polls of the database."""


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the log."""

    seq: int
    at_ns: int
    kind: str
    actor: str
    detail: str
    version: int
    """The newest version when the event was read."""


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
        rows = connection.execute(query.limit(_MOST)).all()
        version = current_number(connection) if rows else 0
    return [Event(*row, version) for row in rows]


def last_events(store: Store, limit: int = 100) -> list[dict[str, Any]]:
    """The last events, newest first."""
    e = schema.events.c
    query = sa.select(e.seq, e.at_ns, e.kind, e.actor, e.detail).order_by(schema.events.c.seq.desc()).limit(limit)
    with store.database.reading() as connection:
        return [dict(row._mapping) for row in connection.execute(query)]


class Feed:
    """The latest events of one store, kept for all listeners; thread-safe.

    Of the listeners that call :meth:`after` within ``poll_s`` seconds, the first polls the database.
    """

    def __init__(self, store: Store, poll_s: float = POLL_S, seconds: Callable[[], float] = time.monotonic) -> None:
        self._store, self._poll_s, self._seconds = store, poll_s, seconds
        self._lock = Lock()
        self._recent: deque[Event] = deque(maxlen=_MOST)
        self._newest: int | None = None
        self._polled_s = -poll_s

    def after(self, seq: int) -> list[Event]:
        """The events after ``seq``, oldest first, at most 500. Older events than those kept are read from the log."""
        with self._lock:
            now = self._seconds()
            if self._newest is None:
                self._newest, self._polled_s = newest_event(self._store), now
            elif now - self._polled_s >= self._poll_s:
                found = events_after(self._store, self._newest)
                self._recent.extend(found)
                self._newest, self._polled_s = (found[-1].seq if found else self._newest), now
            if seq >= self._newest:
                return []
            if self._recent and self._recent[0].seq <= seq + 1:
                return [event for event in self._recent if event.seq > seq]
        return events_after(self._store, seq)


def without_names(events: Sequence[Event]) -> list[Event]:
    """Events for readers that may not see vehicles' names: none of ballots, others without actor and detail."""
    shown = [e for e in events if e.kind not in OF_VEHICLES]
    return [e if e.kind in OF_THE_MAP else Event(e.seq, e.at_ns, e.kind, "", "", e.version) for e in shown]
