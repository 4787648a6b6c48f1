"""A vote is spent once a version has changed its cell: tiles remember when each cell changed, ballots name a version.

What versions changed is read off their planes; a ballot is given the last version whose tiles have the hashes that it
names, of those that were there when its drive was first heard of. Rollbacks then need no bars of their own.
"""

import hashlib
from collections.abc import Iterator

import numpy as np
import sqlalchemy as sa
import zstandard
from alembic import op

revision = "0004"
down_revision = "0003"
_SIDE = 256
_CELL = 0.3


def upgrade() -> None:
    """Memories of all tiles, versions of all ballots."""
    connection = op.get_bind()
    op.add_column("version_tiles", sa.Column("memory", sa.String(64), nullable=True))
    op.add_column("ballots", sa.Column("version", sa.Integer(), nullable=False, server_default="0"))
    op.drop_table("bars")
    for row, col in connection.execute(sa.text('SELECT DISTINCT "row", "col" FROM version_tiles')).all():
        _remember(connection, row, col)
    for seq, first_seq in connection.execute(sa.text("SELECT seq, first_seq FROM ballots")).all():
        about = {"seq": seq, "version": _version_of(connection, seq, first_seq)}
        connection.execute(sa.text("UPDATE ballots SET version = :version WHERE seq = :seq"), about)


def _remember(connection: sa.Connection, row: int, col: int) -> None:
    """The memory of each version of a tile but the first."""
    where = {"row": row, "col": col}
    query = 'SELECT version, points, free FROM version_tiles WHERE "row" = :row AND "col" = :col ORDER BY version'
    first = connection.execute(sa.text("SELECT min(number) FROM versions")).scalar_one()
    lattice = connection.execute(sa.text("SELECT x0, y0 FROM maps")).one()
    corner = (lattice[0] + col * _SIDE * _CELL, lattice[1] + row * _SIDE * _CELL, *lattice, row, col)
    memory = np.zeros((4, _SIDE * _SIDE), dtype="<u4")
    before: tuple[list[bytes], np.ndarray] = ([b""] * (_SIDE * _SIDE), np.zeros(_SIDE * _SIDE, dtype="<u8"))
    for version, points, free in connection.execute(sa.text(query), where).all():
        now = _cells(connection, points, corner), _free(connection, free)
        if version > first:
            differ = np.array([a != b for a, b in zip(before[0], now[0], strict=True)]) | (before[1] != now[1])
            memory[0][differ] = version
            digest = _store(connection, memory.tobytes())
            update = 'UPDATE version_tiles SET memory = :m WHERE "row" = :row AND "col" = :col AND version = :v'
            connection.execute(sa.text(update), where | {"m": digest, "v": version})
        before = now


def _cells(connection: sa.Connection, digest: str | None, corner: tuple[float, ...]) -> list[bytes]:
    """The points of each flat cell of a tile, in their order."""
    out = [b""] * (_SIDE * _SIDE)
    if digest is None:
        return out
    points = np.frombuffer(_load(connection, digest), dtype="<f4").reshape(-1, 3)
    x0, y0, lattice_x, lattice_y, row, col = corner
    cols = np.floor((points[:, 0].astype(np.float64) + x0 - lattice_x) / _CELL).astype(np.int64) - int(col) * _SIDE
    rows = np.floor((points[:, 1].astype(np.float64) + y0 - lattice_y) / _CELL).astype(np.int64) - int(row) * _SIDE
    flat = np.clip(rows, 0, _SIDE - 1) * _SIDE + np.clip(cols, 0, _SIDE - 1)
    order = np.argsort(flat, kind="stable")
    for some in np.split(order, np.flatnonzero(np.diff(flat[order])) + 1):
        if len(some):
            out[flat[some[0]]] = points[some].tobytes()
    return out


def _free(connection: sa.Connection, digest: str | None) -> np.ndarray:
    return np.zeros(_SIDE * _SIDE, dtype="<u8") if digest is None else np.frombuffer(_load(connection, digest), "<u8")


def _load(connection: sa.Connection, digest: str) -> bytes:
    found = connection.execute(sa.text("SELECT data FROM blobs WHERE hash = :hash"), {"hash": digest}).scalar_one()
    return zstandard.ZstdDecompressor().decompressobj().decompress(bytes(found))


def _store(connection: sa.Connection, raw: bytes) -> str:
    digest = hashlib.sha256(raw).hexdigest()
    known = connection.execute(sa.text("SELECT 1 FROM blobs WHERE hash = :hash"), {"hash": digest}).first()
    if known is None:
        about = {"hash": digest, "data": zstandard.ZstdCompressor(level=3).compress(raw)}
        connection.execute(sa.text("INSERT INTO blobs (hash, data) VALUES (:hash, :data)"), about)
    return digest


def _version_of(connection: sa.Connection, seq: int, first_seq: int) -> int:
    query = sa.text("SELECT detail FROM events WHERE kind IN ('publish', 'rollback', 'replay') AND seq < :seq")
    published = [int(detail.removeprefix("v")) for (detail,) in connection.execute(query, {"seq": first_seq})]
    newest = max(published, default=connection.execute(sa.text("SELECT min(number) FROM versions")).scalar_one())
    rows = connection.execute(sa.text('SELECT "row", "col", base FROM ballot_tiles WHERE ballot = :seq'), {"seq": seq})
    return min((_last(connection, row, col, base, newest) for row, col, base in rows.all()), default=newest)


def _last(connection: sa.Connection, row: int, col: int, base: str, newest: int) -> int:
    """The last version up to ``newest`` in which the tile had the points ``base``."""
    until = newest
    for version, points in _history(connection, row, col, newest):
        if (points or "") == base:
            return until
        until = version - 1
    return until if base == "" else 0


def _history(connection: sa.Connection, row: int, col: int, newest: int) -> Iterator[tuple[int, str | None]]:
    query = (
        'SELECT version, points FROM version_tiles WHERE "row" = :row AND "col" = :col AND version <= :newest '
        "ORDER BY version DESC"
    )
    yield from connection.execute(sa.text(query), {"row": row, "col": col, "newest": newest}).all()
