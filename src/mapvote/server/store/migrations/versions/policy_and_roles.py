"""The policy moves into the store, keys may expire, ballots say how they were cast and how large they were."""

import json
import secrets

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """The first policy: the round that was under way, and the settings of the last version that was published."""
    connection = op.get_bind()
    op.create_table(
        "policies",
        sa.Column("seq", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("policy", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["seq"], ["events.seq"], name=op.f("fk_policies_seq_events")),
        sa.PrimaryKeyConstraint("seq", name=op.f("pk_policies")),
    )
    op.add_column("keys", sa.Column("expires_ns", sa.BigInteger(), nullable=True))
    op.add_column("ballots", sa.Column("cast_by", sa.String(32), nullable=False, server_default="columns, two-stage"))
    op.add_column("ballots", sa.Column("bytes", sa.BigInteger(), nullable=False, server_default="0"))
    op.add_column("maps", sa.Column("secret", sa.String(64), nullable=False, server_default=""))
    method = connection.execute(sa.text("SELECT method FROM maps")).scalar_one_or_none()
    op.drop_column("maps", "method")
    if connection.execute(sa.text("SELECT count(*) FROM maps")).scalar_one() == 0:
        return
    connection.execute(sa.text("UPDATE maps SET secret = :secret"), {"secret": secrets.token_hex(32)})
    planes = " + ".join(f"coalesce(length({p}), 0)" for p in ("states", "tally", "gone", "new_points", "free"))
    size = f"SELECT coalesce(sum({planes}), 0) FROM ballot_tiles WHERE ballot = ballots.seq"
    connection.execute(sa.text(f"UPDATE ballots SET bytes = ({size})"))
    one_stage = "EXISTS (SELECT 1 FROM ballot_tiles WHERE ballot = ballots.seq AND tally IS NOT NULL)"
    asked = _round(method)
    stages = {"ruled": asked.get("method", "columns")}
    said = f"CAST(:ruled AS VARCHAR) || CASE WHEN {one_stage} THEN ', one-stage' ELSE ', two-stage' END"
    connection.execute(sa.text(f"UPDATE ballots SET cast_by = {said}"), stages)
    _log(connection, {"round": asked, "fuse": _fuse(connection)})


def _round(method: str | None) -> dict[str, str]:
    """ "columns, two-stage, settings ab12..." as the policy says it."""
    if method is None:
        return {}
    rule, stage, *rest = method.split(", ")
    digest = rest[0].removeprefix("settings ") if rest else ""
    lawful = len(digest) >= 8 and set(digest) <= set("0123456789abcdef")
    return {"method": rule, "stage": stage, "settings_hash": digest if lawful else ""}


def _fuse(connection: sa.Connection) -> dict[str, object]:
    last = "SELECT policy FROM versions WHERE kind = 'publish' ORDER BY number DESC LIMIT 1"
    found = connection.execute(sa.text(last)).scalar_one_or_none()
    return json.loads(found) if isinstance(found, str) else dict(found or {})


def _log(connection: sa.Connection, policy: dict[str, object]) -> None:
    newest = "SELECT seq, at_ns FROM events ORDER BY seq DESC LIMIT 1"
    seq, at_ns = connection.execute(sa.text(newest)).one()
    about = {"seq": seq + 1, "at": at_ns, "policy": json.dumps(policy)}
    event = "INSERT INTO events (seq, at_ns, kind, actor, detail) VALUES (:seq, :at, 'policy', 'upgrade', 'as before')"
    connection.execute(sa.text(event), about)
    connection.execute(sa.text("INSERT INTO policies (seq, policy) VALUES (:seq, :policy)"), about)
