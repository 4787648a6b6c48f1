"""How sure vehicles are of their changed cells, and those of a decision who voted for it."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Two columns, empty: nobody said so before."""
    op.add_column("ballot_tiles", sa.Column("odds", sa.LargeBinary(), nullable=True))
    op.add_column("decisions", sa.Column("odds", sa.LargeBinary(), nullable=True))
