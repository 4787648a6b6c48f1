"""Verdicts of reviewers on a change before it is published: accept, hold, reject, and undo.

Nothing is overwritten: a review that is taken back or replaced is marked with the event that did so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import sqlalchemy as sa

from mapvote.codec.tile_planes import pack_cells, unpack_cells
from mapvote.core.answers import answer
from mapvote.core.grid import TileIndex
from mapvote.core.types import Bool
from mapvote_server.errors import Conflict, NotFound
from mapvote_server.store import schema
from mapvote_server.store.queries import log_event
from mapvote_server.store.store import Store

Verdict = Literal["accepted", "held", "rejected"]


@answer
@dataclass(frozen=True, slots=True)
class VerdictAnswer:
    """A reviewer's verdict on a change."""

    seq: int
    verdict: Verdict
    by: str
    comment: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class Review:
    """One standing verdict."""

    given: VerdictAnswer
    feature: Mapping[str, Any]
    """The change as GeoJSON, in the state of its review."""


def standing(store: Store) -> list[tuple[Review, dict[TileIndex, Bool]]]:
    """Every verdict that stands, oldest first, with the cells that it is about."""
    with store.database.reading() as connection:
        return _standing(connection)


def decide(
    store: Store,
    verdict: Verdict,
    feature: Mapping[str, Any],
    cells: Mapping[TileIndex, Bool],
    *,
    by: str,
    comment: str = "",
    after: int | None = None,
) -> int:
    """Record a verdict on a change of these cells; its number.

    ``after``: the verdict that who decides has seen, which this one replaces. Conflict, naming who and what, if
    another stands on some of these cells, or the one that was seen stands no more.
    """
    with store.database.writing() as connection:
        kind = feature["properties"]["kind"]
        alike = [earlier for earlier in _standing(connection) if earlier[0].feature["properties"]["kind"] == kind]
        on_it = [r for r, theirs in alike if any((cells[i] & theirs[i]).any() for i in cells.keys() & theirs.keys())]
        others = [review.given for review in on_it if review.given.seq != after]
        if others:
            raise Conflict(f"{others[0].by} has {others[0].verdict} this change meanwhile: look again, then decide")
        if after is not None and not on_it:
            raise Conflict("the verdict that you saw was taken back meanwhile: look again, then decide")
        now_ns = store.clock()
        seq = log_event(connection, now_ns, verdict, by, f"{feature['id']} {comment}".strip())
        _take_back(connection, [review.given.seq for review in on_it], seq)
        row = {"seq": seq, "verdict": verdict, "comment": comment, "feature": dict(feature)}
        connection.execute(schema.reviews.insert().values(**row))
        rows = [{"row": i[0], "col": i[1], "review": seq, "cells": pack_cells(plane)} for i, plane in cells.items()]
        connection.execute(schema.review_cells.insert(), rows)
    return seq


def undo(store: Store, seq: int, *, by: str) -> None:
    """Take a verdict back, so that its change is pending again. NotFound if there is none, Conflict if it is gone."""
    r = schema.reviews
    with store.database.writing() as connection:
        row = connection.execute(sa.select(r.c.gone_seq, r.c.feature).where(r.c.seq == seq)).one_or_none()
        if row is None:
            raise NotFound(f"there is no verdict {seq}")
        if row.gone_seq is not None:
            raise Conflict(f"verdict {seq} was taken back or replaced meanwhile: look again")
        event = log_event(connection, store.clock(), "verdict undone", by, str(row.feature["id"]))
        _take_back(connection, [seq], event)


def _take_back(connection: sa.Connection, reviews: list[int], seq: int) -> None:
    r = schema.reviews
    connection.execute(r.update().where(r.c.seq.in_(reviews)).values(gone_seq=seq))


def _standing(connection: sa.Connection) -> list[tuple[Review, dict[TileIndex, Bool]]]:
    r = schema.reviews
    e = schema.events
    c = schema.review_cells
    cells: dict[int, dict[TileIndex, Bool]] = {}
    about = sa.select(c).join(r, r.c.seq == c.c.review).where(r.c.gone_seq.is_(None))
    for row in connection.execute(about):
        cells.setdefault(row.review, {})[row.row, row.col] = unpack_cells(row.cells)
    query = sa.select(r.c.seq, r.c.verdict, e.c.actor, r.c.comment, e.c.at_ns, r.c.feature).join(e, e.c.seq == r.c.seq)
    rows = connection.execute(query.where(r.c.gone_seq.is_(None)).order_by(r.c.seq)).all()
    return [(Review(VerdictAnswer(*row[:-1]), row.feature), cells.get(row.seq, {})) for row in rows]
