"""Planes of ballots and decisions carry a sum, and what is damaged is set aside by name."""

import hashlib
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """The sums are of what lies there now: nobody knows what was written."""
    connection = op.get_bind()
    op.create_table(
        "quarantine",
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("name", sa.String(160), nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.Column("why", sa.String(200), nullable=False),
        sa.ForeignKeyConstraint(["seq"], ["events.seq"], name=op.f("fk_quarantine_seq_events")),
        sa.PrimaryKeyConstraint("kind", "name", name=op.f("pk_quarantine")),
    )
    for table, key, parts in (
        ("ballot_tiles", "ballot", ("base", "states", "tally", "gone", "new_points", "free")),
        ("decisions", "version", ("states", "tally")),
    ):
        op.add_column(table, sa.Column("sum", sa.String(64), nullable=False, server_default=""))
        where = f'WHERE "row" = :row AND "col" = :col AND {key} = :key'
        keys = connection.execute(sa.text(f'SELECT "row", "col", {key} FROM {table}')).all()
        for row, col, number in keys:
            about = {"row": row, "col": col, "key": number}
            planes = connection.execute(sa.text(f"SELECT {', '.join(parts)} FROM {table} {where}"), about).one()
            connection.execute(sa.text(f"UPDATE {table} SET sum = :sum {where}"), about | {"sum": _sum(planes)})


def _sum(parts: sa.Row[Any]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        raw = b"" if part is None else part.encode() if isinstance(part, str) else bytes(part)
        digest.update(f"{-1 if part is None else len(raw)}:".encode() + raw)
    return digest.hexdigest()
