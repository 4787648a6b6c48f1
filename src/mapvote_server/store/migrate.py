"""The schema's history: a new store gets the newest schema, ``mapvote serve --upgrade`` upgrades an older one, and a
newer one is refused.

The revisions lie in ``migrations/versions``, one file each. Alembic runs them within one transaction: a store is at one
revision or at the next, never in between. There is no way down: restore the backup instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from mapvote.core.types import MapvoteError
from mapvote_server.store.database import COPIED, Database


@dataclass(frozen=True, slots=True)
class History:
    """The revisions of the schema that a program has."""

    head: str = "0001"
    """The revision that :mod:`mapvote_server.store.schema` describes."""
    folder: Path = Path(__file__).parent / "migrations"
    """The folder of alembic's scripts."""


HISTORY = History()


def revision_of(connection: sa.Connection) -> str | None:
    """The schema revision of a database; None if it holds no store."""
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar_one_or_none()


def check(connection: sa.Connection, history: History = HISTORY) -> None:
    """MapvoteError, with the way out, unless the database holds a store of exactly this program's schema."""
    revision = revision_of(connection)
    address = connection.engine.url.render_as_string()
    if revision is None:
        copied = f" ({COPIED})" if connection.dialect.name == "sqlite" else ""
        raise MapvoteError(
            f"{address}: holds no map yet; create the store with `mapvote serve STORE --map MAP`{copied}"
        )
    if revision == history.head:
        return
    if revision in _revisions(history):
        raise MapvoteError(
            f"{address}: schema {revision} of an older mapvote, this one works with {history.head}: stop the server, "
            "make a backup, then run `mapvote serve STORE --upgrade`"
        )
    raise MapvoteError(
        f"{address}: schema {revision} of a newer mapvote, this one knows up to {history.head}: install that one"
    )


def run_migrations(connection: sa.Connection, history: History = HISTORY) -> None:
    """Bring an empty or older database to the newest revision, within the transaction of ``connection``."""
    from alembic import command

    config = _config(history)
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def upgrade(database: Database, history: History = HISTORY) -> tuple[str, str]:
    """Upgrade a store in one transaction: (revision before, revision after). MapvoteError if there is none, or it is
    newer than this program."""
    with database.writing() as connection:
        before = revision_of(connection)
        if before is None or before not in _revisions(history):
            check(connection, history)
        assert before is not None
        run_migrations(connection, history)
    return before, history.head


def _revisions(history: History) -> set[str]:
    from alembic.script import ScriptDirectory

    return {script.revision for script in ScriptDirectory.from_config(_config(history)).walk_revisions()}


def _config(history: History) -> Any:
    # Imported only when a store is created or does not fit: alembic comes with the server's extra.
    try:
        from alembic.config import Config
    except ImportError as error:
        raise MapvoteError("creating or upgrading a store needs alembic: pip install 'mapvote[server]'") from error
    config = Config()
    config.set_main_option("script_location", str(history.folder))
    return config
