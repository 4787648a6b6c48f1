"""The schema's history: a new store gets the newest schema, ``mapvote serve --upgrade`` upgrades an older one, and a
newer one is refused.

The revisions lie in ``migrations/versions``, one file each. Alembic runs them within one transaction: a store is at one
revision or at the next, never in between. There is no way down: restore the backup instead.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import sqlalchemy as sa

from mapvote.core.types import MapvoteError
from mapvote_server.store.database import COPIED, Database

HEAD = "0001"
"""The revision that :mod:`mapvote_server.store.schema` describes."""
REVISIONS = Path(__file__).parent / "migrations"


def revision_of(connection: sa.Connection) -> str | None:
    """The schema revision of a database; None if it holds no store."""
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar_one_or_none()


def check(connection: sa.Connection) -> None:
    """MapvoteError, with the way out, unless the database holds a store of exactly this program's schema."""
    revision, where = revision_of(connection), connection.engine.url.render_as_string()
    if revision is None:
        copied = f" ({COPIED})" if connection.dialect.name == "sqlite" else ""
        raise MapvoteError(f"{where}: holds no map yet; create the store with `mapvote serve STORE --map MAP`{copied}")
    if revision == HEAD:
        return
    if revision in _known():
        raise MapvoteError(
            f"{where}: schema {revision} of an older mapvote, this one works with {HEAD}: stop the server, make a "
            "backup, then run `mapvote serve STORE --upgrade`"
        )
    raise MapvoteError(f"{where}: schema {revision} of a newer mapvote, this one knows up to {HEAD}: install that one")


def run_migrations(connection: sa.Connection) -> None:
    """Bring an empty or older database to HEAD, within the transaction of ``connection``."""
    from alembic import command

    config = _config()
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def upgrade(database: Database) -> tuple[str, str]:
    """Upgrade a store in one transaction: (revision before, revision after). MapvoteError if there is none, or it is
    newer than this program."""
    with database.writing() as connection:
        before = revision_of(connection)
        if before is None or before not in _known():
            check(connection)
        assert before is not None
        run_migrations(connection)
    return before, HEAD


def _known() -> set[str]:
    from alembic.script import ScriptDirectory

    return {script.revision for script in ScriptDirectory.from_config(_config()).walk_revisions()}


def _config() -> Any:
    # Imported only when a store is created or does not fit: alembic comes with the server's extra.
    try:
        from alembic.config import Config
    except ImportError as error:
        raise MapvoteError("creating or upgrading a store needs alembic: pip install 'mapvote[server]'") from error
    config = Config()
    config.set_main_option("script_location", str(REVISIONS))
    return config
