"""Listeners share one poll of the database, and each hears every event once and in order."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from hand_made import two_walls
from mapvote.server.store.queries import log_event
from mapvote.server.store.store import Store
from mapvote.server.views.history import Feed, newest_event

LISTENERS, SECONDS = 20, 30


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    yield store
    store.close()


def log(store: Store, detail: str) -> int:
    with store.database.writing() as connection:
        return log_event(connection, store.clock(), "publish", "boss", detail)


def test_twenty_listeners_cost_one_poll_a_second(store: Store) -> None:
    now, statements = [0.0], [0]
    feed = Feed(store, seconds=lambda: now[0])
    start = newest_event(store)
    at, heard = [start] * LISTENERS, [list[str]() for _ in range(LISTENERS)]

    def asked(*_: Any) -> None:
        statements[0] += 1

    for second in range(SECONDS):
        if second % 10 == 5:
            log(store, f"e{second}")
        sa.event.listen(store.database.engine, "before_cursor_execute", asked)
        for i in range(LISTENERS):
            now[0] = second + i / LISTENERS
            for event in feed.after(at[i]):
                heard[i].append(event.detail)
                at[i] = event.seq
        sa.event.remove(store.database.engine, "before_cursor_execute", asked)
    now[0] += 1.0
    for i in range(LISTENERS):
        heard[i] += [event.detail for event in feed.after(at[i])]
    assert heard == [["e5", "e15", "e25"]] * LISTENERS
    assert statements[0] <= 3 * (SECONDS / 0.9 + 1), "begin, events, and the version where there are any"


def test_who_comes_back_after_long_reads_the_log_and_misses_nothing(store: Store) -> None:
    now = [0.0]
    feed = Feed(store, seconds=lambda: now[0])
    feed.after(newest_event(store))
    with store.database.writing() as connection:
        told = [log_event(connection, store.clock(), "publish", "boss", f"e{i}") for i in range(600)]
    for _ in range(3):
        now[0] += 1.0
        feed.after(told[-1])
    seq, heard = told[0] - 1, list[int]()
    while found := feed.after(seq):
        heard += [event.seq for event in found]
        seq = heard[-1]
    assert heard == told
