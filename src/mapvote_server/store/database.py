"""Transactions on SQLite (WAL, durable) or PostgreSQL, by URL: many readers, one writer at a time. Rows with sums over
what is written once, and a cache of what rows of votes hold."""

from __future__ import annotations

import hashlib
import json
import operator
import os
import sqlite3
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from threading import Lock
from typing import Any

import sqlalchemy as sa
from sqlalchemy import exc
from sqlalchemy.sql.compiler import SQLCompiler

from mapvote.codec.ballot import Planes
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote_server.errors import Unavailable
from mapvote_server.work import check_time, is_late, remaining_s


@record()
@dataclass(frozen=True, slots=True)
class DatabaseSizes:
    """Sizes of the work of one database connection."""

    writers_lock: int = 0x6D617076
    """Number of PostgreSQL's advisory lock of the writers."""
    page_bytes: int = 16384
    """Page of a SQLite file, bytes: a ballot's planes are a few kB each, and in SQLite's own 4 kB pages they waste half
    of the file and of the writing."""
    steps_per_look: int = 20_000
    """Steps of SQLite's machine between two looks at the time limit: about a millisecond."""
    variables: int = 500
    """Values in one statement: SQLite limits its variables."""
    remembered_bytes: int = 128 << 20
    """Memory of unpacked votes, bytes: some 1,500 votes of a vehicle on a tile."""
    one_by_one: int = 200
    """Tiles up to which each is asked for by itself, instead of reading all of the map's."""
    checked_together: int = 500
    """Rows that are checked in one transaction."""


DATABASE_SIZES = DatabaseSizes()


COPIED = (
    "if this file was copied while a server had it open, its -wal file is missing: "
    'copy by `sqlite3 STORE ".backup COPY"`'
)


class Database:
    """One database. A transaction is committed when its block ends without an error, else nothing has happened.

    ``timeout_s``: how long a writer waits for its turn.
    """

    def __init__(self, url: str | sa.URL, *, timeout_s: float = 30.0) -> None:
        self.url = sa.make_url(url)
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            self.engine = sa.create_engine(
                self.url, pool_size=16, max_overflow=64, connect_args={"timeout": timeout_s, "check_same_thread": False}
            )
            sa.event.listen(self.engine, "connect", _prepare_sqlite)
            sa.event.listen(self.engine, "begin", _begin_sqlite)
        else:
            self.engine = sa.create_engine(
                self.url,
                pool_size=16,
                max_overflow=64,
                pool_pre_ping=True,
                connect_args={"connect_timeout": 5, "options": f"-c lock_timeout={round(timeout_s * 1e3)}"},
            )
        sa.event.listen(self.engine, "before_cursor_execute", _in_time)

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A consistent snapshot: what is committed later stays out of sight. Unavailable if the database is gone."""
        with _clear_errors(), self.engine.connect() as connection:
            if not self.is_sqlite:
                connection = connection.execution_options(isolation_level="REPEATABLE READ")
            with connection.begin():
                limit_s = remaining_s()
                if not self.is_sqlite and limit_s is not None:
                    connection.exec_driver_sql(f"SET LOCAL statement_timeout = {max(1, round(limit_s * 1e3))}")
                yield connection

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """The one writer. Unavailable if nothing can be written now (disk full, read-only, database gone)."""
        with _clear_errors(), self.engine.connect() as connection:
            connection = connection.execution_options(mapvote_writes=True)
            with connection.begin():
                if not self.is_sqlite:
                    connection.execute(sa.select(sa.func.pg_advisory_xact_lock(DATABASE_SIZES.writers_lock)))
                yield connection

    def make_private_file(self) -> None:
        """An empty SQLite file that only its owner can read and write, if there is none yet; its WAL takes after it.

        MapvoteError if it cannot be made.
        """
        file = self.url.database
        if not self.is_sqlite or not file or file == ":memory:":
            return
        try:
            os.close(os.open(file, os.O_CREAT | os.O_RDWR, 0o600))
        except OSError as error:
            raise MapvoteError(f"{file}: cannot be made ({error.strerror})") from error

    def close(self) -> None:
        """Give every connection back."""
        self.engine.dispose()


class Question:
    """A statement without lists, asked for every tile or in every publish: made into SQL once for each kind of
    database, for SQLAlchemy's own work takes longer than the database's."""

    def __init__(self, statement: sa.Select[*tuple[Any, ...]] | sa.CompoundSelect[*tuple[Any, ...]]) -> None:
        self._statement = statement
        self._made: dict[str, SQLCompiler] = {}

    def ask(self, connection: sa.Connection, **values: object) -> sa.CursorResult[Any]:
        """The rows; values as the driver takes and gives them."""
        made = self._made.get(connection.dialect.name)
        if made is None:
            made = self._statement.compile(dialect=connection.dialect)
            self._made[connection.dialect.name] = made
        given = made.construct_params(values)
        ordered = made.positiontup
        return connection.exec_driver_sql(made.string, given if ordered is None else tuple(given[n] for n in ordered))


def address_of(url: sa.URL) -> str:
    """A database URL without its password: what may be shown, logged, and sent to a cluster."""
    return url._replace(password=None).render_as_string()


def insert_rows(connection: sa.Connection, table: sa.Table, rows: Sequence[tuple[Any, ...]]) -> None:
    """Many rows, each with a value for every column of ``table`` in its order, as the driver takes them. A last column
    of :func:`sum_but` is added where it is left out.

    SQLAlchemy's own work on each row would cost more than the database's.
    """
    quote = connection.dialect.identifier_preparer.quote
    columns = ", ".join(quote(column.name) for column in table.columns)
    mark = "?" if connection.dialect.name == "sqlite" else "%s"
    values = ", ".join([mark] * len(table.columns))
    statement = f"INSERT INTO {quote(table.name)} ({columns}) VALUES ({values})"
    if len(rows[0]) < len(table.columns):
        at = [table.columns.keys().index(name) for name in summed(table)]
        rows = [(*row, sum_of(*(row[i] for i in at))) for row in rows]
    connection.exec_driver_sql(statement, list(rows))


@contextmanager
def _clear_errors() -> Iterator[None]:
    try:
        yield
    except exc.IntegrityError:
        raise
    except exc.DBAPIError as error:
        if error.statement is None and not isinstance(error.orig, sqlite3.Error):  # its text holds the address
            raise Unavailable("the database cannot be reached; try again") from error
        check_time()
        reason = (str(error.orig).strip().splitlines() or ["no reason given"])[0]
        copied = f": {COPIED}" if "malformed" in reason or "not a database" in reason else ""
        raise Unavailable(f"the database refuses ({reason}){copied}{_mend(reason)}") from error
    except exc.TimeoutError as error:
        raise Unavailable("all connections to the database are busy; try again") from error


def _mend(reason: str) -> str:
    """The end of an error's sentence: what helps."""
    if "readonly" in reason or "read-only" in reason:
        return "; give the user of the server the right to write its file and folder, or mount the disk writable"
    if "is full" in reason or "No space" in reason:
        return "; free space on its disk, then try again"
    return "; try again"


def _in_time(*_: Any) -> None:
    """Before each statement."""
    check_time()


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # transactions are begun by _begin_sqlite, not guessed by the driver
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA page_size={DATABASE_SIZES.page_bytes}")  # heeded only while the file is empty
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()
    connection.set_progress_handler(is_late, DATABASE_SIZES.steps_per_look)


def _begin_sqlite(connection: sa.Connection) -> None:
    writes = connection.get_execution_options().get("mapvote_writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def sum_of(*parts: Any) -> str:
    """SHA-256 over the parts of a row, each with its length, so that none can pass for another.

    Parts are bytes, text, integers, what JSON can say, or None. No floats by themselves: databases round them.
    """
    pieces = []
    for part in parts:
        raw = part if isinstance(part, bytes) else _raw(part)
        pieces += [b"-1:" if part is None else b"%d:" % len(raw), raw]
    return hashlib.sha256(b"".join(pieces)).hexdigest()


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


def sum_but(*names: str) -> sa.Column[str]:
    """A last column, of the sum over all others but these: over what is written once. Whoever inserts a row need not
    think of it."""

    def of_row(context: Any) -> str:
        row = context.get_current_parameters()
        return sum_of(*(row.get(name) for name in summed(context.current_column.table)))

    return sa.Column("sum", sa.String(64), nullable=False, default=of_row, info={"but": {"sum", *names}})


@cache
def summed(table: sa.Table) -> Sequence[str]:
    """The columns that the table's sum is over, in their order."""
    return [column.name for column in table.c if column.name not in table.c["sum"].info["but"]]


def is_sound(table: sa.Table, row: Any) -> bool:
    """Whether a row with all columns of its table's sum is what was written."""
    return bool(row.sum == sum_of(*operator.attrgetter(*summed(table))(row)))


class Remembered:
    """A cache of unpacked planes, by the sum of their row: two rows of one sum say the same. The least recently used
    leave it first. Thread-safe; it ends with the process."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.bytes = 0
        self._planes: OrderedDict[str, Planes] = OrderedDict()
        self._lock = Lock()

    def get(self, sums: Iterable[str]) -> dict[str, Planes]:
        """Those that are known, by sum."""
        with self._lock:
            planes_of = {digest: planes for digest in sums if (planes := self._planes.get(digest)) is not None}
            for digest in planes_of:
                self._planes.move_to_end(digest)
        return planes_of

    def put(self, digest: str, planes: Planes) -> None:
        """Remember these too."""
        with self._lock:
            if digest not in self._planes:
                self._planes[digest] = planes
                self.bytes += planes.nbytes
            while self.bytes > self.most_bytes:
                self.bytes -= self._planes.popitem(last=False)[1].nbytes

    def clear(self) -> None:
        """Forget everything, as in a new process."""
        with self._lock:
            self._planes.clear()
            self.bytes = 0


remembered = Remembered(DATABASE_SIZES.remembered_bytes)
"""The cache of this process: what admission unpacks is not unpacked again when a round is fused soon after."""
