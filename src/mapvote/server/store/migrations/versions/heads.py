"""What is written once of ballots, versions, the log and all else carries a sum."""

import hashlib
import json
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"

_OVER = {
    "maps": ("map_id", "georeference", "secret", "surveyed_ns"),
    "policies": ("seq", "policy"),
    "keys": ("name", "role", "hash", "created_ns"),
    "events": ("seq", "at_ns", "kind", "actor", "detail"),
    "versions": ("number", "parent", "kind", "target", "created_ns", "published_by", "reason", "mark", "policy"),
    "ballots": (
        "seq", "first_seq", "vehicle", "drive", "digest", "start_ns", "end_ns", "received_ns", "settings_hash",
        "cast_by", "version",
    ),
    "reviews": ("seq", "verdict", "comment", "feature"),
    "review_cells": ("row", "col", "review", "cells"),
}  # fmt: skip


def upgrade() -> None:
    """The sums are of what lies there now: nobody knows what was written."""
    connection = op.get_bind()
    for name, over in _OVER.items():
        table = sa.Table(name, sa.MetaData(), autoload_with=connection, resolve_fks=False)
        rows = [dict(row._mapping) for row in connection.execute(sa.select(table))]
        op.add_column(name, sa.Column("sum", sa.String(64), nullable=False, server_default=""))
        if rows:
            key = [column.name for column in table.primary_key]
            where = " AND ".join(f'"{column}" = :{column}' for column in key)
            sums = [{"sum": _sum(row[part] for part in over)} | {c: row[c] for c in key} for row in rows]
            connection.execute(sa.text(f'UPDATE {name} SET "sum" = :sum WHERE {where}'), sums)


def _sum(parts: Any) -> str:
    digest = hashlib.sha256()
    for part in parts:
        raw = _raw(part)
        digest.update(f"{-1 if part is None else len(raw)}:".encode() + raw)
    return digest.hexdigest()


def _raw(part: Any) -> bytes:
    if part is None or isinstance(part, bytes | memoryview):
        return bytes(part or b"")
    return (json.dumps(part, sort_keys=True) if isinstance(part, dict | list) else str(part)).encode()
