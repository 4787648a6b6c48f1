"""A store of the first schema, as dumped then, becomes one of today's without losing a bit; on both databases.

``stores/schema_0001.*.sql`` are dumps (sqlite3's .dump, pg_dump --inserts) of a store of two tiles: four versions
(import, publish, rollback, publish), a round under way, a ballot replaced and one withdrawn, keys issued and revoked.
They are never made anew: that they are old is what they are for.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from typer.testing import CliRunner

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.cli import app
from mapvote.codec.ballot import encode
from mapvote.config import FuseSettings
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.insight.explain import explain_cell
from mapvote.server.store import keys, migrate, schema
from mapvote.server.store.admission import accept, examine
from mapvote.server.store.ballots import Receipt
from mapvote.server.store.check import check
from mapvote.server.store.database import Database
from mapvote.server.store.policy import RoundPolicy, current_policy
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store

STORES = Path(__file__).parent / "stores"
POINTS = [24, 23, 24, 26]
"""Of every version in the dump."""


VERSIONS_DRIVEN = [(2, 1), (3, 1), (4, 1), (7, 3), (8, 3), (9, 3), (12, 4), (13, 4)]
"""Of the dump's ballots: three before version 2, three after the rollback to the same tiles, two on the newest."""


@pytest.fixture
def first_store(database_url: str) -> str:
    """The URL of a database into which the dump of the first schema was loaded."""
    url = sa.make_url(database_url)
    dump = (STORES / f"schema_0001.{url.get_backend_name()}.sql").read_text()
    if url.get_backend_name() == "sqlite":
        assert url.database is not None
        with sqlite3.connect(url.database) as connection:
            connection.executescript(dump)
        connection.close()
        return database_url
    engine = sa.create_engine(url)
    with engine.begin() as postgres:
        driver: Any = postgres.connection.driver_connection
        driver.execute(dump)
    engine.dispose()
    return database_url


@contextmanager
def database_at(url: str) -> Iterator[Database]:
    database = Database(url)
    yield database
    database.close()


def content(url: str) -> dict[str, list[dict[str, Any]]]:
    """Every row of every table as it is in the database, blobs as bytes, by the columns' names."""
    engine = sa.create_engine(url)
    found = sa.MetaData()
    with engine.connect() as connection:
        found.reflect(connection)
        rows = {
            table.name: sorted((dict(row._mapping) for row in connection.execute(sa.select(table))), key=repr)
            for table in found.sorted_tables
            if table.name != "alembic_version"
        }
    engine.dispose()
    return rows


def test_the_first_schema_becomes_todays_without_loss(first_store: str) -> None:
    before = content(first_store)
    assert len(before["ballots"]) == 8
    with database_at(first_store) as database:
        assert migrate.upgrade(database) == (migrate.FIRST, migrate.HEAD)
        assert migrate.upgrade(database) == (migrate.HEAD, migrate.HEAD)
    after = content(first_store)
    for table in schema.HEADS.values():
        assert all(len(row.pop("sum")) == 64 for row in after[table.name])
    ((one, other),) = zip(before.pop("maps"), after.pop("maps"), strict=True)
    assert one.pop("method") == "columns, two-stage"
    assert len(other.pop("secret")) == 64
    assert other.pop("surveyed_ns") is None
    assert one == other
    (logged,) = [event for event in after["events"] if event not in before["events"]]
    after["events"].remove(logged)
    (policy,) = after.pop("policies")
    assert {row["version"] for row in after["version_tiles"] if row["memory"] is None} == {1}
    assert sorted((b["seq"], b["version"]) for b in after["ballots"]) == VERSIONS_DRIVEN
    before.pop("bars")
    before_blobs = {row["hash"]: row["data"] for row in before.pop("blobs")}
    assert before_blobs.items() <= {row["hash"]: row["data"] for row in after.pop("blobs")}.items()
    assert policy["seq"] == logged["seq"]
    for name, rows in before.items():
        kept = [{column: row[column] for column in rows[0]} for row in after[name]] if rows else after[name]
        assert sorted(kept, key=repr) == sorted(rows, key=repr), f"{name} is as it was"
    assert {ballot["cast_by"] for ballot in after["ballots"]} == {"columns, two-stage"}
    assert all(ballot["bytes"] > 0 for ballot in after["ballots"])

    store = Store.open(first_store)
    assert check(store) == []
    assert current_policy(store).round == RoundPolicy(method="columns", stage="two-stage")
    assert [version.kind for version in store.versions()] == ["import", "publish", "rollback", "publish"]
    maps = [store.point_map(version.number) for version in store.versions()]
    assert [sum(len(tile.points) for tile in m.tiles.values()) for m in maps] == POINTS
    assert [(key.role, key.name, key.revoked_ns is None) for key in keys.listed(store)] == [
        ("operator", "ann", True),
        ("vehicle", "v1", False),
    ]
    say = {(0, 0): Say(states_plane({(10, 12): CellState.CHANGED_EMPTY}))}
    ballot = make_ballot(maps[-1], say, "v6", "d1", end_ns=1_700_000_100 * 10**9, settings_hash="s", method="columns")
    (receipt,) = accept(store, [examine(encode(ballot))])
    assert isinstance(receipt, Receipt), "a ballot like those that stand is taken in"
    done = publish(store, FuseSettings())
    assert (done.version, done.deleted) == (5, 3), "the round under way ends as it would have"
    story = explain_cell(store, 12.5 * 0.3, 10.5 * 0.3)
    assert story.decisions[-1] == (5, CellState.CHANGED_EMPTY.name.lower())
    store.close()


def test_metadata_and_migrations_agree(first_store: str, tmp_path: Path) -> None:
    """Today's tables, as the code describes them, are what the revisions make of an empty and of an old database."""
    new = f"sqlite:///{tmp_path / 'new.db'}"
    with database_at(first_store) as old, database_at(new) as empty, empty.writing() as connection:
        migrate.upgrade(old)
        migrate.run_migrations(connection)
    for url in (first_store, new):
        engine = sa.create_engine(url)
        with engine.connect() as connection:
            assert compare_metadata(MigrationContext.configure(connection), schema.metadata) == []
            other = sa.MetaData()
            for table in schema.metadata.sorted_tables:
                table.to_metadata(other)
            sa.Table("ballots", other, sa.Column("colour", sa.Integer), extend_existing=True)
            (difference,) = compare_metadata(MigrationContext.configure(connection), other)
            assert difference[0] == "add_column", "the comparison sees what is missing"
        engine.dispose()


def test_head_is_the_last_of_one_line_of_revisions() -> None:
    scripts = ScriptDirectory(str(Path(migrate.__file__).parent / "migrations"))
    assert scripts.get_heads() == [migrate.HEAD]
    assert scripts.get_bases() == [migrate.FIRST]


def test_an_older_store_is_refused_until_it_is_upgraded(first_store: str) -> None:
    refusal = r"schema 0001 of an older mapvote.*mapvote upgrade STORE"
    with pytest.raises(MapvoteError, match=refusal):
        Store.open(first_store)
    with pytest.raises(MapvoteError, match=refusal):
        Store.create(first_store, two_walls())
    for says in (f"schema 0001 is now {migrate.HEAD}", "nothing to do"):
        done = CliRunner().invoke(app, ["upgrade", first_store], catch_exceptions=False)
        assert done.exit_code == 0
        assert says in done.output
    Store.open(first_store).close()


def test_an_upgrade_that_fails_leaves_the_old_store(first_store: str) -> None:
    before = content(first_store)
    with database_at(first_store) as database:
        with suppress(ZeroDivisionError), database.writing() as connection:
            migrate.run_migrations(connection)
            assert migrate.revision_of(connection) == migrate.HEAD
            raise ZeroDivisionError
        with database.reading() as connection:
            assert migrate.revision_of(connection) == migrate.FIRST
    assert content(first_store) == before


def test_a_store_of_a_newer_mapvote_is_refused_and_left_alone(first_store: str) -> None:
    with database_at(first_store) as database:
        migrate.upgrade(database)
        with database.writing() as connection:
            connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
        for attempt in (lambda: Store.open(first_store), lambda: migrate.upgrade(database)):
            with pytest.raises(MapvoteError, match="schema 9999 of a newer mapvote"):
                attempt()


def test_what_holds_no_store_is_not_upgraded(database_url: str) -> None:
    with database_at(database_url) as database:
        with pytest.raises(MapvoteError, match="holds no map yet"):
            migrate.upgrade(database)
        assert sa.inspect(database.engine).get_table_names() == []
