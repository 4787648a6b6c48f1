"""A store of an older schema is upgraded in one transaction, or refused; on both databases.

Nothing older than this schema was ever released, so the tests add a revision after it.
"""

from __future__ import annotations

import shutil
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

from hand_made import two_walls
from mapvote.cli import app
from mapvote.core.types import MapvoteError
from mapvote_server.store import migrate, schema
from mapvote_server.store.database import Database
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
def next_release(old_store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The same, beside a program that has one more revision."""
    revisions = tmp_path / "migrations"
    shutil.copytree(migrate.REVISIONS, revisions)
    (revisions / "versions" / "next.py").write_text(NEXT.format(before=migrate.HEAD))
    monkeypatch.setattr(migrate, "REVISIONS", revisions)
    monkeypatch.setattr(migrate, "HEAD", "0002")
    return old_store


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
    scripts = ScriptDirectory(str(migrate.REVISIONS))
    assert (scripts.get_heads(), len(scripts.get_bases())) == ([migrate.HEAD], 1)
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


def test_an_older_store_is_refused_until_it_is_upgraded_and_nothing_is_lost(next_release: str) -> None:
    before, refusal = content(next_release), r"schema 0001 of an older mapvote.*mapvote serve STORE --upgrade"
    with pytest.raises(MapvoteError, match=refusal):
        Store.open(next_release)
    with pytest.raises(MapvoteError, match=refusal):
        Store.create(next_release, two_walls())
    for says in ("schema 0001 is now 0002", "nothing to do"):
        done = CliRunner().invoke(app, ["serve", next_release, "--upgrade"], catch_exceptions=False)
        assert done.exit_code == 0
        assert says in done.output
    Store.open(next_release).close()
    assert content(next_release) == before


def test_an_upgrade_that_fails_leaves_the_old_store(next_release: str) -> None:
    before = content(next_release)
    with database_at(next_release) as database:
        with suppress(ZeroDivisionError), database.writing() as connection:
            migrate.run_migrations(connection)
            assert migrate.revision_of(connection) == migrate.HEAD
            raise ZeroDivisionError
        with database.reading() as connection:
            assert migrate.revision_of(connection) == "0001"
            columns = {column["name"] for column in sa.inspect(connection).get_columns("ballots")}
    assert "colour" not in columns
    assert content(next_release) == before


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
