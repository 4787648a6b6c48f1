"""What waits for one more vote: the changes, the drives that saw them, and the road from which to see them again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import tile_key, unpack_path
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, Grid, TileIndex
from mapvote.core.types import F64, NO_VOTE, U8, MapvoteError
from mapvote.fusion.next_pass import Stretch, Waiting, Witness, lacks_quorum_only, one_vote_short, stretches
from mapvote.fusion.tile_vote import TileVote, by_voter, one_each
from mapvote.shapes.geojson import collection
from mapvote_server.errors import Unavailable
from mapvote_server.questions.explain import said_by
from mapvote_server.store import schema
from mapvote_server.store.queries import tile_as_of, version_of
from mapvote_server.store.store import Store
from mapvote_server.store.votes import (
    FOREVER,
    Electorate,
    electorate_now,
    from_sound_ballots,
    judged_on,
    standing_tiles,
)


@dataclass(slots=True)
class _Tally:
    """The changes that lack only the quorum, over some tiles."""

    cells: int = 0
    drives: set[str] = field(default_factory=set)
    vehicles: set[str] = field(default_factory=set)

    def add(self, drives: Sequence[TileVote], states: Sequence[U8], quorum: int) -> None:
        """Another tile: its ``drives``, and the ``states`` (256, 256) of each voter."""
        if not states:
            return
        change = lacks_quorum_only(states, quorum)
        waits = change != NO_VOTE
        self.cells += int(waits.sum())
        for drive in drives:
            if (said_by(drive)[waits] == change[waits]).any():
                self.drives.add(drive.digest)
                self.vehicles.add(drive.vehicle)

    def waiting(self, quorum: int) -> Waiting | None:
        """All of them; None if there are none."""
        return Waiting(self.cells, len(self.drives), sorted(self.vehicles), quorum) if self.cells else None


def waiting_votes(store: Store) -> Waiting | None:
    """The changes that lack only the quorum; None if there are none. Tiles on which the quorum votes are not read."""
    found = _Tally()
    with store.database.reading() as connection:
        asked = electorate_now(connection, store.clock())
        for window, drives in _counting(connection, store, asked, _few_vehicles(connection, asked.settings), []):
            found.add(drives, _states(drives, window, asked.settings), asked.settings.min_votes)
    return found.waiting(asked.settings.min_votes)


def _few_vehicles(connection: sa.Connection, settings: FuseSettings) -> list[TileIndex]:
    """Tiles that fewer vehicles than the quorum vote on."""
    b, t = schema.ballots.c, schema.ballot_tiles.c
    vehicles = sa.func.count(sa.distinct(b.vehicle))
    few = sa.select(t.row, t.col).join(schema.ballots, b.seq == t.ballot).where(b.gone_seq.is_(None))
    rows = connection.execute(few.group_by(t.row, t.col).having(vehicles < settings.min_votes))
    return sorted((row.row, row.col) for row in rows)


def _counting(
    connection: sa.Connection, store: Store, asked: Electorate, tiles: Sequence[TileIndex], damaged: list[str]
) -> Iterator[tuple[Grid, list[TileVote]]]:
    """Of some tiles: the window, and the votes of the drives that count, in the cells where they do. A tile that cannot
    be read is left out and named in ``damaged``."""
    newest = version_of(connection).number
    for index in tiles:
        window = store.lattice.tile(index)
        try:
            tile = tile_as_of(connection, window, newest)
        except Unavailable:
            raise
        except MapvoteError:
            damaged.append(tile_key(index))
            continue
        judged = from_sound_ballots(connection, asked, lambda now, tile=tile: judged_on(connection, tile, now))  # type: ignore[misc]
        yield window, [one.vote for one in judged if one.vote is not None]


def _states(drives: Sequence[TileVote], window: Grid, settings: FuseSettings) -> list[U8]:
    """(256, 256) of each voter."""
    return [said_by(vote) for vote in one_each(by_voter(drives, settings), window)]


def wanted_passes(store: Store) -> dict[str, Any]:
    """Stretches of road on which one more pass would decide cells, those with most cells first: GeoJSON lines in map
    metres, each in the direction to drive, with what the pass would decide there.

    Besides, "cells" that one more vote would decide; "without_path", those of them that no drive with a path saw;
    "waits", text: what lacks only the quorum; "damaged" tiles, which are left out.
    """
    found: list[Stretch] = []
    damaged: list[str] = []
    tally = _Tally()
    cells = without_path = 0
    with store.database.reading() as connection:
        asked = electorate_now(connection, store.clock())
        quorum, driven = asked.settings.min_votes, _driven(connection, store)
        for window, drives in _counting(connection, store, asked, standing_tiles(connection, FOREVER), damaged):
            named = by_voter(drives, asked.settings)
            vehicles = {voter.vehicle: drive.vehicle for voter, drive in zip(named, drives, strict=True)}
            voters = one_each(named, window)
            witnesses = [Witness(said_by(vote), driven[vehicles[vote.vehicle]]) for vote in voters]
            found += stretches(window, witnesses, quorum)
            tally.add(drives, [witness.states for witness in witnesses], quorum)
            if witnesses:
                short = one_vote_short([witness.states for witness in witnesses], quorum)
                seen = [w.states == short for w in witnesses if any(len(path) > 1 for path in w.paths_m)]
                waiting = short != NO_VOTE
                cells += int(waiting.sum())
                without_path += int((waiting & ~np.any(seen, axis=0)).sum() if seen else waiting.sum())
    waits = tally.waiting(quorum)
    told = {"cells": cells, "without_path": without_path, "waits": "" if waits is None else str(waits)}
    return collection([_line(stretch) for stretch in _in_order(found)]) | told | {"damaged": damaged}


def _in_order(found: Sequence[Stretch]) -> list[Stretch]:
    return sorted(found, key=lambda one: (-one.cells, one.tile, one.heading_rad))


def _line(stretch: Stretch) -> tuple[dict[str, Any], dict[str, Any]]:
    """Geometry and properties of a stretch of road."""
    line = {"type": "LineString", "coordinates": np.round(stretch.path_m, 2).tolist()}
    counts = {"cells": stretch.cells, "built": stretch.built, "gone": stretch.gone}
    heading_deg = round(float(np.degrees(stretch.heading_rad)))
    return line, {"row": stretch.tile[0], "col": stretch.tile[1], "heading_deg": heading_deg} | counts


def _driven(connection: sa.Connection, store: Store) -> dict[str, list[F64]]:
    """By vehicle: the path of each of its standing drives, (n, 2) map metres."""
    b, p = schema.ballots.c, schema.paths.c
    query = sa.select(b.vehicle, p.path).join(schema.ballots, b.seq == p.ballot).where(b.gone_seq.is_(None))
    out = defaultdict[str, list[F64]](list)
    for vehicle, path in connection.execute(query.order_by(b.seq)):
        corner = np.array([store.lattice.x0, store.lattice.y0])
        out[vehicle].append(corner + (unpack_path(path)[:, ::-1] + 0.5) * CELL_SIZE)
    return out
