"""What happens in a store, in order, for those who listen: pages, integrators, webhooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from mapvote.server.store import schema
from mapvote.server.store.keys import hash_of
from mapvote.server.store.queries import current_number
from mapvote.server.store.store import Store

OF_THE_MAP = ("import", "publish", "rollback", "replay")
"""Kinds that concern the map alone: anybody who may read it may know by whom and why."""
OF_VEHICLES = ("ballot", "withdraw")
"""Kinds that tell the minute of a pass."""
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


def taken_up_to(store: Store, address: str) -> int:
    """The last event that a listener at this address took; of one that was never heard of, the newest there is."""
    d = schema.deliveries
    with store.database.writing() as connection:
        taken = connection.execute(sa.select(d.c.seq).where(d.c.address == hash_of(address))).scalar_one_or_none()
        if taken is None:
            taken = connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one()
            connection.execute(d.insert().values(address=hash_of(address), seq=taken))
    return int(taken)


def take(store: Store, address: str, seq: int) -> None:
    """A listener that was heard of took everything up to this event."""
    d = schema.deliveries
    with store.database.writing() as connection:
        connection.execute(d.update().where(d.c.address == hash_of(address)).values(seq=seq))


def events_after(store: Store, seq: int) -> list[Event]:
    """The events after ``seq``, oldest first, 500 at most. Writers take turns, so none ever appears in between."""
    e = schema.events
    query = sa.select(e.c.seq, e.c.at_ns, e.c.kind, e.c.actor, e.c.detail).where(e.c.seq > seq).order_by(e.c.seq)
    with store.database.reading() as connection:
        rows = connection.execute(query.limit(_MOST)).all()
        version = current_number(connection) if rows else 0
    return [Event(*row, version) for row in rows]


def without_names(events: Sequence[Event]) -> list[Event]:
    """For those who may not know which vehicle did what, and when: nothing of ballots, of the rest that it happened."""
    told = [e for e in events if e.kind not in OF_VEHICLES]
    return [e if e.kind in OF_THE_MAP else Event(e.seq, e.at_ns, e.kind, "", "", e.version) for e in told]
