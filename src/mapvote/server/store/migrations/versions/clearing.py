"""Old versions can be cleared away, and a map says when it was surveyed."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Nothing was cleared so far, and of no map is it known when it was surveyed."""
    op.add_column("maps", sa.Column("surveyed_ns", sa.BigInteger(), nullable=True))
    op.add_column("versions", sa.Column("cleared_seq", sa.BigInteger(), nullable=True))
