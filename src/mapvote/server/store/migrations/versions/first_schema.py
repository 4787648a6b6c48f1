"""The first schema, that of 0.1.0. Never edit: a change to the tables is a new revision."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """All tables of an empty database."""
    op.create_table(
        "blobs",
        sa.Column("hash", sa.String(length=64), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("hash", name=op.f("pk_blobs")),
    )
    op.create_table(
        "events",
        sa.Column("seq", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("at_ns", sa.BigInteger(), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("actor", sa.String(length=80), nullable=False),
        sa.Column("detail", sa.String(length=400), nullable=False),
        sa.PrimaryKeyConstraint("seq", name=op.f("pk_events")),
    )
    op.create_table(
        "keys",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=16), nullable=False),
        sa.Column("hash", sa.String(length=64), nullable=False),
        sa.Column("created_ns", sa.BigInteger(), nullable=False),
        sa.Column("revoked_ns", sa.BigInteger(), nullable=True),
        sa.PrimaryKeyConstraint("name", "role", "hash", name=op.f("pk_keys")),
        sa.UniqueConstraint("hash", name=op.f("uq_keys_hash")),
    )
    op.create_table(
        "maps",
        sa.Column("map_id", sa.String(length=200), nullable=False),
        sa.Column("x0", sa.Double(), nullable=False),
        sa.Column("y0", sa.Double(), nullable=False),
        sa.Column("georeference", sa.JSON(), nullable=False),
        sa.Column("method", sa.String(length=64), nullable=True),
        sa.PrimaryKeyConstraint("map_id", name=op.f("pk_maps")),
    )
    op.create_table(
        "versions",
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("target", sa.Integer(), nullable=True),
        sa.Column("created_ns", sa.BigInteger(), nullable=False),
        sa.Column("published_by", sa.String(length=80), nullable=False),
        sa.Column("reason", sa.String(length=400), nullable=False),
        sa.Column("mark", sa.BigInteger(), nullable=False),
        sa.Column("policy", sa.JSON(), nullable=False),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_versions")),
    )
    op.create_table(
        "ballots",
        sa.Column("seq", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("first_seq", sa.BigInteger(), nullable=False),
        sa.Column("gone_seq", sa.BigInteger(), nullable=True),
        sa.Column("vehicle", sa.String(length=64), nullable=False),
        sa.Column("drive", sa.String(length=64), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("received_ns", sa.BigInteger(), nullable=False),
        sa.Column("settings_hash", sa.String(length=128), nullable=False),
        sa.ForeignKeyConstraint(["seq"], ["events.seq"], name=op.f("fk_ballots_seq_events")),
        sa.PrimaryKeyConstraint("seq", name=op.f("pk_ballots")),
    )
    op.create_index("ix_ballots_drive", "ballots", ["vehicle", "drive"], unique=False)
    op.create_table(
        "bars",
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("col", sa.Integer(), nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.Column("cells", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["version"], ["versions.number"], name=op.f("fk_bars_version_versions")),
        sa.PrimaryKeyConstraint("version", "row", "col", name=op.f("pk_bars")),
    )
    op.create_table(
        "decisions",
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("col", sa.Integer(), nullable=False),
        sa.Column("states", sa.LargeBinary(), nullable=False),
        sa.Column("tally", sa.LargeBinary(), nullable=False),
        sa.Column("vehicles", sa.Integer(), nullable=False),
        sa.Column("added", sa.Integer(), nullable=False),
        sa.Column("deleted", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["version"], ["versions.number"], name=op.f("fk_decisions_version_versions")),
        sa.PrimaryKeyConstraint("version", "row", "col", name=op.f("pk_decisions")),
    )
    op.create_table(
        "version_tiles",
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("col", sa.Integer(), nullable=False),
        sa.Column("points", sa.String(length=64), nullable=True),
        sa.Column("ground", sa.String(length=64), nullable=True),
        sa.Column("free", sa.String(length=64), nullable=True),
        sa.ForeignKeyConstraint(["version"], ["versions.number"], name=op.f("fk_version_tiles_version_versions")),
        sa.PrimaryKeyConstraint("version", "row", "col", name=op.f("pk_version_tiles")),
    )
    op.create_index("ix_version_tiles_tile", "version_tiles", ["row", "col", "version"], unique=False)
    op.create_table(
        "ballot_tiles",
        sa.Column("row", sa.Integer(), nullable=False),
        sa.Column("col", sa.Integer(), nullable=False),
        sa.Column("ballot", sa.BigInteger(), nullable=False),
        sa.Column("base", sa.String(length=64), nullable=False),
        sa.Column("states", sa.LargeBinary(), nullable=True),
        sa.Column("tally", sa.LargeBinary(), nullable=True),
        sa.Column("gone", sa.LargeBinary(), nullable=True),
        sa.Column("new_points", sa.LargeBinary(), nullable=True),
        sa.Column("free", sa.LargeBinary(), nullable=True),
        sa.ForeignKeyConstraint(["ballot"], ["ballots.seq"], name=op.f("fk_ballot_tiles_ballot_ballots")),
        sa.PrimaryKeyConstraint("row", "col", "ballot", name=op.f("pk_ballot_tiles")),
    )
    op.create_index("ix_ballot_tiles_ballot", "ballot_tiles", ["ballot"], unique=False)
