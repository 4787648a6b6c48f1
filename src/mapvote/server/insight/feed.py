"""What happens in a store, in order, for those who listen: pages, integrators, webhooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from mapvote.server.store import schema
from mapvote.server.store.queries import current_number
from mapvote.server.store.store import Store

OF_THE_MAP = ("import", "publish", "rollback", "replay")
"""Kinds that concern the map alone: anybody who may read it may know by whom and why."""
_MOST = 500


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
        return int(connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one())


def events_after(store: Store, seq: int) -> list[Event]:
    """The events after ``seq``, oldest first, 500 at most. Writers take turns, so none ever appears in between."""
    e = schema.events
    query = sa.select(e.c.seq, e.c.at_ns, e.c.kind, e.c.actor, e.c.detail).where(e.c.seq > seq).order_by(e.c.seq)
    with store.database.reading() as connection:
        rows = connection.execute(query.limit(_MOST)).all()
        version = current_number(connection) if rows else 0
    return [Event(*row, version) for row in rows]


def without_names(events: Sequence[Event]) -> list[Event]:
    """For those who may not know which vehicle did what: that something happened, and when."""
    return [e if e.kind in OF_THE_MAP else Event(e.seq, e.at_ns, e.kind, "", "", e.version) for e in events]
