"""Sums over rows: what tells that a row is not what was written. Planes carry their own, see ``schema``."""

from __future__ import annotations

import hashlib
import json
import operator
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa


def sum_of(*parts: Any) -> str:
    """SHA-256 over the parts of a row, each with its length, so that none can pass for another.

    Parts are bytes, text, integers, what JSON can say, or None. No floats by themselves: databases round them.
    """
    pieces = []
    for part in parts:
        raw = part if isinstance(part, bytes) else _raw(part)
        pieces += [b"-1:" if part is None else b"%d:" % len(raw), raw]
    return hashlib.sha256(b"".join(pieces)).hexdigest()


def sum_of_planes(base: str, planes: Sequence[bytes | None]) -> str:
    """The sum of a ballot's votes on one tile, of all ``BALLOT_PLANES`` in their order."""
    return sum_of(base, *planes)


def sum_of_decision(states: bytes, tally: bytes, odds: bytes | None) -> str:
    """The sum of what was decided about one tile."""
    return sum_of(states, tally, odds)


def _raw(part: Any) -> bytes:
    if part is None:
        return b""
    if isinstance(part, str):
        return part.encode()
    if isinstance(part, dict | list):
        return json.dumps(part, sort_keys=True).encode()
    if isinstance(part, bytearray | memoryview):
        return bytes(part)
    return str(operator.index(part)).encode()


def sum_over(*names: str) -> sa.Column[str]:
    """A last column, of the sum over these: of all that is written once. Whoever inserts a row need not think of it."""

    def of_row(context: Any) -> str:
        row = context.get_current_parameters()
        return sum_of(*(row.get(name) for name in names))

    return sa.Column("sum", sa.String(64), nullable=False, default=of_row, info={"over": names})


def summed(table: sa.Table) -> Sequence[str]:
    """The columns that the table's sum is over; none where rows carry none, or another kind."""
    over: Sequence[str] = table.c["sum"].info.get("over", ()) if "sum" in table.c else ()
    return over


def with_sums(table: sa.Table, rows: Sequence[tuple[Any, ...]]) -> Sequence[tuple[Any, ...]]:
    """Rows, each with a value for every column but the sum, with their sums."""
    if not summed(table):
        return rows
    at = [list(table.c.keys()).index(name) for name in summed(table)]
    return [(*row, sum_of(*(row[i] for i in at))) for row in rows]
