"""Fixtures that tests of several rooms share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from mapvote.core.point_map import PointMap
    from mapvote_server.store.store import Store
    from stores import NewStore


@pytest.fixture
def new_store(tmp_path: Path) -> Iterator[NewStore]:
    """Makes stores as ``Store.create`` does, in SQLite files named so, of two walls if nothing else is said."""
    from hand_made import two_walls
    from mapvote_server.store.store import Store

    made: list[Store] = []

    def make(point_map: PointMap | None = None, *more: Any, name: str = "s.db", **settings: Any) -> Store:
        made.append(Store.create(f"sqlite:///{tmp_path / name}", point_map or two_walls(), *more, **settings))
        return made[-1]

    yield make
    for store in made:
        store.close()
