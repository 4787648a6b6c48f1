"""What the verbs on a STORE share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapvote.fleet.store import Store

StoreName = Annotated[str, typer.Argument(metavar="STORE", help="SQLite file, or URL (postgresql+psycopg://...)")]


@contextmanager
def opened_store(name: str) -> Iterator[Store]:
    """An existing store, closed at the end."""
    from mapvote.fleet.store import Store, url_of

    store = Store.open(url_of(name))
    try:
        yield store
    finally:
        store.close()


def when(stamp_ns: int) -> str:
    """A stamp as a reader of a terminal wants it, UTC."""
    from datetime import UTC, datetime

    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%SZ")
