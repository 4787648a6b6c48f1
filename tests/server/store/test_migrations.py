"""A store of an older schema is upgraded in one transaction, or refused; on both databases.

Nothing older than this schema was ever released, so the tests add a revision after it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from command_line import typed
from hand_made import two_walls
from mapvote.core.types import MapvoteError
from mapvote_server.store import migrate, schema
from mapvote_server.store.database import Database
from mapvote_server.store.migrate import HISTORY, History
from mapvote_server.store.store import Store

NEXT = """
import sqlalchemy as sa
from alembic import op

revision, down_revision = "0002", "{before}"


def upgrade() -> None:
    op.add_column("ballots", sa.Column("colour", sa.Integer(), nullable=True))
    op.execute("UPDATE ballots SET colour = 7")
"""


@pytest.fixture
def old_store(database_url: str) -> str:
    """The URL of a store of this schema."""
    Store.create(database_url, two_walls()).close()
    return database_url


@pytest.fixture
def next_release(tmp_path: Path) -> History:
    """The revisions of a program that has one more."""
    revisions = tmp_path / "migrations"
    shutil.copytree(HISTORY.folder, revisions)
    (revisions / "versions" / "next.py").write_text(NEXT.format(before=HISTORY.head))
    return History("0002", revisions)


@contextmanager
def database_at(url: str) -> Iterator[Database]:
    database = Database(url)
    yield database
    database.close()


def content(url: str) -> dict[str, list[dict[str, Any]]]:
    """Every row of every table as it is in the database, by the columns' names."""
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


@pytest.mark.contract
def test_the_tables_are_those_that_the_code_describes_by_one_line_of_revisions(old_store: str) -> None:
    scripts = ScriptDirectory(str(HISTORY.folder))
    assert (scripts.get_heads(), len(scripts.get_bases())) == ([HISTORY.head], 1)
    engine = sa.create_engine(old_store)
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), schema.metadata) == []
        other = sa.MetaData()
        for table in schema.metadata.sorted_tables:
            table.to_metadata(other)
        sa.Table("ballots", other, sa.Column("colour", sa.Integer), extend_existing=True)
        (difference,) = compare_metadata(MigrationContext.configure(connection), other)
        assert difference[0] == "add_column", "the comparison sees what is missing"
    engine.dispose()


def test_an_older_store_is_refused_until_it_is_upgraded_and_nothing_is_lost(
    old_store: str, next_release: History
) -> None:
    before = content(old_store)
    with database_at(old_store) as database:
        with (
            database.reading() as connection,
            pytest.raises(MapvoteError, match=r"schema 0001 of an older mapvote.*mapvote serve STORE --upgrade"),
        ):
            migrate.check(connection, next_release)
        assert migrate.upgrade(database, next_release) == ("0001", "0002")
        assert migrate.upgrade(database, next_release) == ("0002", "0002")
        with database.reading() as connection:
            migrate.check(connection, next_release)
    after = content(old_store)
    assert all(row.pop("colour") == 7 for row in after["ballots"])
    assert after == before


@pytest.mark.slow
def test_the_next_release_refuses_an_older_store_and_serve_upgrades_it(old_store: str, tmp_path: Path) -> None:
    """The next release is a copy of the server's package with one more revision."""
    package = tmp_path / "release" / "mapvote_server"
    shutil.copytree(HISTORY.folder.parents[1], package)
    (package / "store/migrations/versions/next.py").write_text(NEXT.format(before=HISTORY.head))
    module = package / "store/migrate.py"
    module.write_text(module.read_text().replace(f'head: str = "{HISTORY.head}"', 'head: str = "0002"'))
    paths = os.pathsep.join([str(package.parent), str(HISTORY.folder.parents[2])])

    def next_mapvote(*arguments: str) -> str:
        command = [sys.executable, "-m", "mapvote", *arguments]
        done = subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True)
        return done.stdout + done.stderr

    refusal = "schema 0001 of an older mapvote, this one works with 0002: stop the server"
    assert refusal in " ".join(next_mapvote("log", old_store).split())
    assert "schema 0001 is now 0002" in next_mapvote("serve", old_store, "--upgrade")
    assert "schema 0002: nothing to do" in next_mapvote("serve", old_store, "--upgrade")
    assert "import" in next_mapvote("log", old_store)


def test_serve_upgrade_says_that_a_store_of_this_schema_needs_nothing(old_store: str) -> None:
    assert f"schema {HISTORY.head}: nothing to do" in typed("serve", old_store, "--upgrade")


def test_an_upgrade_that_fails_leaves_the_old_store(old_store: str, next_release: History) -> None:
    before = content(old_store)
    with database_at(old_store) as database:
        with suppress(ZeroDivisionError), database.writing() as connection:
            migrate.run_migrations(connection, next_release)
            assert migrate.revision_of(connection) == "0002"
            raise ZeroDivisionError
        with database.reading() as connection:
            assert migrate.revision_of(connection) == "0001"
            columns = {column["name"] for column in sa.inspect(connection).get_columns("ballots")}
    assert "colour" not in columns
    assert content(old_store) == before


def test_what_holds_no_store_or_one_of_a_newer_mapvote_is_refused_and_left_alone(
    old_store: str, tmp_path: Path
) -> None:
    with database_at(f"sqlite:///{tmp_path / 'none.db'}") as database:
        with pytest.raises(MapvoteError, match="holds no map yet"):
            migrate.upgrade(database)
        assert sa.inspect(database.engine).get_table_names() == []
    with database_at(old_store) as database:
        with database.writing() as connection:
            connection.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
        for attempt in (lambda: Store.open(old_store), lambda: migrate.upgrade(database)):
            with pytest.raises(MapvoteError, match="schema 9999 of a newer mapvote"):
                attempt()
