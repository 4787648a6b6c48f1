"""What came or went since a version is found without reading every ballot."""

from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """An index."""
    op.create_index("ix_ballots_gone_seq", "ballots", ["gone_seq"])
