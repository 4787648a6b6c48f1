"""The store does what its rules say in plain words (``plain_rules.py``), whatever happens: random histories.

``HISTORIES=2000 pytest -m slow tests/server/store/test_rules.py -k many`` lives through so many.
"""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import sqlalchemy as sa

from histories import START_S, live, street
from mapvote.config import FuseSettings
from mapvote.fusion import fuse
from mapvote.fusion.copies import Copy
from mapvote.fusion.tile_vote import Vote
from mapvote_server.store import schema, votes
from mapvote_server.store.database import remembered
from mapvote_server.store.store import Store
from stores import Clock

MakeStore = Callable[[Clock], Store]


@pytest.fixture
def sqlite_stores(tmp_path: Path) -> MakeStore:
    """New stores, each a copy of one that was made once."""
    first, names = tmp_path / "first.db", itertools.count()
    Store.create(f"sqlite:///{first}", street(), clock=Clock(START_S * 10**9)).close()
    return lambda clock: Store.open(f"sqlite:///{shutil.copy(first, tmp_path / f'{next(names)}.db')}", clock=clock)


def disagreements(make: MakeStore, seeds: range, steps: int = 25, *, troubled: bool = False) -> list[str]:
    return [found for seed in seeds if (found := live(seed, make, steps, troubled=troubled)) is not None]


@pytest.mark.slow
def test_store_and_rules_agree(sqlite_stores: MakeStore) -> None:
    assert disagreements(sqlite_stores, range(4)) == []


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 3])
def test_what_was_read_before_changes_nothing_that_is_decided(
    seed: int, sqlite_stores: MakeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    for most_bytes in (0, 300_000, remembered.most_bytes):  # nothing, a few votes, all
        remembered.clear()
        monkeypatch.setattr(remembered, "most_bytes", most_bytes)
        stores: list[Store] = []
        live(seed, lambda clock, stores=stores: stores.append(sqlite_stores(clock)) or stores[0], 25)  # type: ignore
        with stores[0].database.reading() as connection:
            tables = schema.version_tiles, schema.decisions, schema.quarantine
            written.append(
                [connection.execute(sa.select(table).order_by(*table.primary_key)).all() for table in tables]
            )
    assert written[0][1]
    assert written[0] == written[1] == written[2]


@pytest.mark.slow
def test_store_and_rules_agree_in_many_histories(sqlite_stores: MakeStore) -> None:
    assert disagreements(sqlite_stores, range(4, 4 + int(os.environ.get("HISTORIES", "10")))) == []


@pytest.mark.slow
def test_no_replay_fails_in_histories_full_of_rollbacks_and_clearings(sqlite_stores: MakeStore) -> None:
    seeds = range(1_000, 1_000 + int(os.environ.get("HISTORIES", "12")))
    assert disagreements(sqlite_stores, seeds, troubled=True) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(500, 530))
def test_store_and_rules_agree_on_postgresql(postgres_url: str, seed: int) -> None:
    assert live(seed, lambda clock: Store.create(postgres_url, street(), clock=clock), 25) is None


def test_the_rules_object_to_a_store_that_hears_copies(
    sqlite_stores: MakeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def whoever_speaks(drives: Sequence[Vote], _: FuseSettings) -> tuple[Sequence[Vote], list[Copy]]:
        return drives, []

    monkeypatch.setattr(fuse, "originals", whoever_speaks)
    assert disagreements(sqlite_stores, range(3, 4)) != []


@pytest.mark.slow
def test_the_rules_object_to_a_store_that_lets_votes_count_twice(
    sqlite_stores: MakeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def whatever_came_since(vote: Vote, *_: object) -> Vote:
        return vote

    monkeypatch.setattr(votes, "unspent", whatever_came_since)
    assert disagreements(sqlite_stores, range(6)) != []
