"""The schema of the first release."""

from alembic import op

from mapvote_server.store.schema import metadata

revision = "0001"
down_revision = None


def upgrade() -> None:
    """All tables of an empty database, as ``schema`` describes them. The release freezes them here: from then on a
    change to the tables is a revision of its own, and this one is never edited."""
    metadata.create_all(op.get_bind())
