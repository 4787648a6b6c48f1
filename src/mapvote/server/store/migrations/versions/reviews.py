"""Reviews: changes that people accepted, held or rejected."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Two tables; nobody has reviewed anything yet."""
    op.create_table(
        "reviews",
        sa.Column("seq", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("gone_seq", sa.BigInteger(), nullable=True),
        sa.Column("verdict", sa.String(16), nullable=False),
        sa.Column("comment", sa.String(400), nullable=False),
        sa.Column("feature", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["seq"], ["events.seq"], name=op.f("fk_reviews_seq_events")),
        sa.PrimaryKeyConstraint("seq", name=op.f("pk_reviews")),
    )
    op.create_table(
        "review_cells",
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("col", sa.Integer(), nullable=False),
        sa.Column("review", sa.BigInteger(), nullable=False),
        sa.Column("cells", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["review"], ["reviews.seq"], name=op.f("fk_review_cells_review_reviews")),
        sa.PrimaryKeyConstraint("row", "col", "review", name=op.f("pk_review_cells")),
    )
