"""Where vehicles drove, for people to look at."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """One table; no ballot has told of its path yet."""
    op.create_table(
        "paths",
        sa.Column("ballot", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("path", sa.LargeBinary(), nullable=False),
        sa.Column("sum", sa.String(64), nullable=False),
        sa.ForeignKeyConstraint(["ballot"], ["ballots.seq"], name=op.f("fk_paths_ballot_ballots")),
        sa.PrimaryKeyConstraint("ballot", name=op.f("pk_paths")),
    )
