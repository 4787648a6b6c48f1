"""What points carry besides their place: fields of the map's, intensity of those that ballots offer."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Two columns, empty: nobody kept any before."""
    op.add_column("version_tiles", sa.Column("fields", sa.String(64), nullable=True))
    op.add_column("ballot_tiles", sa.Column("intensity", sa.LargeBinary(), nullable=True))
