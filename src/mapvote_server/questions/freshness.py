"""When a vehicle last passed each tile: worked out once, then only for tiles that an event touched."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from threading import Lock

import sqlalchemy as sa

from mapvote.core.answers import answer
from mapvote.core.grid import TileIndex
from mapvote.core.times import utc
from mapvote_server.questions.explain import seen
from mapvote_server.store import schema
from mapvote_server.store.database import DATABASE_SIZES, Question
from mapvote_server.store.queries import newest_seq, tile_of, tiles_of, tiles_set_between, version_of
from mapvote_server.store.retention import cleared_since
from mapvote_server.store.store import PerStore, Store
from mapvote_server.store.votes import standing_tiles


@answer
@dataclass(frozen=True, slots=True)
class CoveredTile:
    """Row and column of a tile, how many vehicles saw it, and when the last did."""

    row: int
    col: int
    vehicles: int
    last_seen: str | None


def tiles_seen(store: Store, exactly: bool) -> list[CoveredTile]:
    """Per tile of the map or of a standing ballot: number of vehicles, end of the last drive past it as far as may be
    ``exactly``, see :func:`mapvote_server.questions.explain.seen`."""
    kept = _kept.of(store)
    with kept.lock:
        with store.database.reading() as connection:
            kept.refresh(connection)
        return kept.told(exactly)


class _Seen:
    """The tiles of one store as of the last event that they know of."""

    def __init__(self) -> None:
        self.lock = Lock()
        """To be held while they are used."""
        self._mark: int | None = None
        self._version = 0
        self._tiles: dict[TileIndex, tuple[int, int | None]] = {}
        """(vehicles, end of the last drive)."""
        self._rows: dict[bool, dict[TileIndex, CoveredTile]] = {True: {}, False: {}}
        """Rows of earlier answers, by whether their times are exact; without tiles that have changed since."""

    def refresh(self, connection: sa.Connection) -> None:
        """Read the tiles on which ballots came or went, or which a version set: all of them at first, and once ballots
        were cleared away."""
        mark = newest_seq(connection)
        last = self._mark
        newest = version_of(connection).number
        if last is None or cleared_since(connection, last):
            touched = None
        elif last == mark:
            return
        else:
            touched = {*standing_tiles(connection, mark, last), *tiles_set_between(connection, self._version, newest)}
        if touched is None or len(touched) > DATABASE_SIZES.one_by_one:
            self._put_all(connection, newest)
        else:
            self._put(connection, newest, touched)
        self._version = newest
        self._mark = mark

    def _put_all(self, connection: sa.Connection, newest: int) -> None:
        b = schema.ballots.c
        t = schema.ballot_tiles.c
        passed = sa.select(t.row, t.col, sa.func.count(sa.distinct(b.vehicle)), sa.func.max(b.end_ns))
        passed = passed.join(schema.ballots, t.ballot == b.seq).where(b.gone_seq.is_(None)).group_by(t.row, t.col)
        passes: dict[TileIndex, tuple[int, int | None]] = dict.fromkeys(tiles_of(connection, newest), (0, None))
        passes |= {(row[0], row[1]): (row[2], row[3]) for row in connection.execute(passed)}
        for rows in self._rows.values():
            for index in [index for index in rows if passes.get(index) != self._tiles.get(index)]:
                del rows[index]
        self._tiles = dict(sorted(passes.items()))

    def _put(self, connection: sa.Connection, newest: int, touched: Iterable[TileIndex]) -> None:
        count = len(self._tiles)
        for index in touched:
            vehicles, last_ns = tuple(_ON_ONE.ask(connection, row=index[0], col=index[1]).one())
            for rows in self._rows.values():
                rows.pop(index, None)
            if vehicles or tile_of(connection, newest, index) is not None:
                self._tiles[index] = vehicles, last_ns
            else:
                self._tiles.pop(index, None)
        if len(self._tiles) != count:
            self._tiles = dict(sorted(self._tiles.items()))

    def told(self, exactly: bool) -> list[CoveredTile]:
        """All of them, in ascending order."""
        rows = self._rows[exactly]
        for index, (vehicles, last_ns) in self._tiles.items():
            if index not in rows:
                rows[index] = CoveredTile(*index, vehicles, utc(seen(last_ns, exactly)))
        return [rows[index] for index in self._tiles]


_kept = PerStore(_Seen)
_ON_ONE = Question(
    sa.select(sa.func.count(sa.distinct(schema.ballots.c.vehicle)), sa.func.max(schema.ballots.c.end_ns))
    .join(schema.ballot_tiles, schema.ballot_tiles.c.ballot == schema.ballots.c.seq)
    .where(schema.ballots.c.gone_seq.is_(None), schema.ballot_tiles.c.row == sa.bindparam("row"))
    .where(schema.ballot_tiles.c.col == sa.bindparam("col"))
)
