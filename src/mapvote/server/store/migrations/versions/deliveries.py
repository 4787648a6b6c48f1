"""What a webhook has taken is remembered, so that a restart neither loses nor repeats an event."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """One table; nothing has been taken yet."""
    op.create_table(
        "deliveries",
        sa.Column("address", sa.String(64), nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("address", name=op.f("pk_deliveries")),
    )
