"""Changes that wait for one more vote, the drives that saw them, and the road from which to see them again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import tile_key, unpack_path
from mapvote.core.answers import answer
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, TileIndex
from mapvote.core.record import record
from mapvote.core.types import F64, NO_VOTE, U8, MapvoteError
from mapvote.fusion.next_pass import Stretch, Waiting, Witness, lacks_quorum_only, one_vote_short, stretches
from mapvote.fusion.tile_vote import Vote, by_voter, one_each
from mapvote.shapes.geojson import MAP_METRES, Geometry, PlacedFeature, Places
from mapvote_server.errors import Unavailable
from mapvote_server.questions.explain import said_by
from mapvote_server.questions.kept import KeptTiles
from mapvote_server.store import schema
from mapvote_server.store.database import Question
from mapvote_server.store.queries import tile_as_of, version_of
from mapvote_server.store.store import PerStore, Store
from mapvote_server.store.votes import Electorate, electorate_now, from_sound_ballots, judged_on


@dataclass(frozen=True, slots=True)
class _Waits:
    """The changes on one tile that lack only the quorum."""

    cells: int
    drives: frozenset[str]
    vehicles: frozenset[str]


@dataclass(frozen=True, slots=True)
class _Tile:
    """Changes that one more pass would decide on one tile."""

    waits: _Waits | None
    stretches: Sequence[Stretch] = ()
    cells: int = 0
    """Cells that one more vote would decide."""
    without_path: int = 0
    """Those of them that no drive with a path saw."""
    damaged: str = ""
    """The tile's key if it cannot be read."""


class _Kept:
    """Waiting changes on the tiles of one store, where there are any."""

    def __init__(self) -> None:
        self.few: KeptTiles[_Tile] = KeptTiles()
        """Tiles on which fewer vehicles than the quorum vote."""
        self.every: KeptTiles[_Tile] = KeptTiles()


_kept = PerStore(_Kept)


@record()
@dataclass(frozen=True, slots=True)
class CoverageSizes:
    """Numbers of the road on which one more pass would decide changes."""

    reach_m: float = 200.0
    """Distance from its path up to which a vehicle votes, metres."""
    stretches: int = 1_000
    """Stretches with most cells that are listed: more than a fleet drives in a day."""


COVERAGE_SIZES = CoverageSizes()


def waiting_votes(store: Store) -> Waiting | None:
    """The changes that lack only the quorum; None if there are none. Tiles on which the quorum votes are not read."""
    tiles = _kept.of(store).few
    with tiles.lock:
        with store.database.reading() as connection:
            now_ns = store.clock()
            electorate = electorate_now(connection, now_ns)
            quorum = electorate.settings.min_votes
            newest = version_of(connection).number

            def look(index: TileIndex) -> _Tile | None:
                if _vehicles_on(connection, index) >= quorum:
                    return None
                window = store.lattice.tile(index)
                counting = _counting(connection, newest, electorate, window)
                if counting is None:
                    return None
                drives = list(counting.values())
                states = [said_by(vote) for vote in one_each(by_voter(drives, electorate.settings), window)]
                waits = _waits(drives, states, quorum)
                return None if waits is None else _Tile(waits)

            tiles.refresh(connection, electorate, now_ns, look)
        return _together(tiles.found.values(), quorum)


def _vehicles_on(connection: sa.Connection, index: TileIndex) -> int:
    """Vehicles with a standing ballot on a tile."""
    return int(_VEHICLES.ask(connection, row=index[0], col=index[1]).scalar_one())


_B, _T = schema.ballots.c, schema.ballot_tiles.c
_VEHICLES = Question(
    sa.select(sa.func.count(sa.distinct(_B.vehicle)))
    .join(schema.ballot_tiles, _B.seq == _T.ballot)
    .where(_T.row == sa.bindparam("row"), _T.col == sa.bindparam("col"), _B.gone_seq.is_(None))
)


def _counting(connection: sa.Connection, newest: int, electorate: Electorate, window: Grid) -> dict[int, Vote] | None:
    """By ballot the votes on a tile of the newest version that count, in the cells where they do; None if the tile
    cannot be read."""
    try:
        tile = tile_as_of(connection, window, newest)
    except Unavailable:
        raise
    except MapvoteError:
        return None
    judged = from_sound_ballots(connection, electorate, lambda sound: judged_on(connection, tile, sound))
    return {vote.ballot: vote for vote in judged if not vote.why}


def _waits(drives: Sequence[Vote], states: Sequence[U8], quorum: int) -> _Waits | None:
    """The changes that lack only the quorum, by the ``drives`` on a tile and the ``states`` (256, 256) of each voter;
    None if there are none."""
    if not states:
        return None
    change = lacks_quorum_only(states, quorum)
    waits = change != NO_VOTE
    if not waits.any():
        return None
    for_it = [drive for drive in drives if (said_by(drive)[waits] == change[waits]).any()]
    digests = frozenset(drive.digest for drive in for_it)
    return _Waits(int(waits.sum()), digests, frozenset(drive.vehicle for drive in for_it))


def _together(tiles: Iterable[_Tile], quorum: int) -> Waiting | None:
    """Changes that lack only the quorum, over some tiles."""
    all_waits = [tile.waits for tile in tiles if tile.waits is not None]
    drives = frozenset[str]().union(*(waits.drives for waits in all_waits))
    vehicles = frozenset[str]().union(*(waits.vehicles for waits in all_waits))
    cells = sum(waits.cells for waits in all_waits)
    return Waiting(cells, len(drives), sorted(vehicles), quorum) if cells else None


@answer
@dataclass(frozen=True, slots=True)
class Passes(Places):
    """Stretches of road, and the changes that wait for one more vote."""

    cells: int
    """that one more vote would decide"""
    without_path: int
    """of these cells those that no drive with a path saw"""
    waits: str
    """changes that lack only the quorum"""
    damaged: list[str]
    """tiles that cannot be read, and are left out"""


def wanted_passes(store: Store) -> Passes:
    """Stretches of road on which one more pass would decide cells, those with most cells first: GeoJSON lines in map
    metres, each in the direction to drive, with its decisions there; at most ``CoverageSizes.stretches``.
    """
    tiles = _kept.of(store).every
    with tiles.lock:
        with store.database.reading() as connection:
            now_ns = store.clock()
            electorate = electorate_now(connection, now_ns)
            newest = version_of(connection).number

            @lru_cache(maxsize=100)
            def path_of(ballot: int) -> F64:
                return _driven(connection, store, ballot)

            def look(index: TileIndex) -> _Tile | None:
                if not _vehicles_on(connection, index):
                    return None
                return _look(connection, newest, electorate, store.lattice.tile(index), path_of)

            tiles.refresh(connection, electorate, now_ns, look)
        kept = list(tiles.found.values())
    waits = _together(kept, electorate.settings.min_votes)
    every = _in_order([stretch for tile in kept for stretch in tile.stretches])
    return Passes(
        type="FeatureCollection",
        frame=MAP_METRES,
        features=[_line(stretch) for stretch in every[: COVERAGE_SIZES.stretches]],
        cells=sum(tile.cells for tile in kept),
        without_path=sum(tile.without_path for tile in kept),
        waits="" if waits is None else str(waits),
        damaged=sorted(tile.damaged for tile in kept if tile.damaged),
    )


def _look(
    connection: sa.Connection, newest: int, electorate: Electorate, window: Grid, path_of: Callable[[int], F64]
) -> _Tile | None:
    """Changes that one more pass would decide on a tile of the newest version; None without any."""
    quorum = electorate.settings.min_votes
    counting = _counting(connection, newest, electorate, window)
    if counting is None:
        return _Tile(None, damaged=tile_key(window.tile_index))
    if not counting:
        return None
    drives = list(counting.values())
    named = by_voter(drives, electorate.settings)
    vehicles = {voter.vehicle: drive.vehicle for voter, drive in zip(named, drives, strict=True)}
    voters = one_each(named, window)
    states = [said_by(vote) for vote in voters]
    short = one_vote_short(states, quorum)
    waiting = short != NO_VOTE
    waits = _waits(drives, states, quorum)
    if not waiting.any():
        return None if waits is None else _Tile(waits)
    paths = defaultdict[str, list[F64]](list)
    for ballot, drive in counting.items():
        paths[drive.vehicle] += _part_near(window, path_of(ballot))
    witnesses = [Witness(said_by(vote), paths[vehicles[vote.vehicle]]) for vote in voters]
    seen = [w.states == short for w in witnesses if any(len(path) > 1 for path in w.paths_m)]
    unseen = int((waiting & ~np.any(seen, axis=0)).sum() if seen else waiting.sum())
    return _Tile(waits, stretches(window, witnesses, quorum), int(waiting.sum()), unseen)


def _part_near(window: Grid, path: F64) -> list[F64]:
    """The part of a path from where it first comes near a tile to where it leaves, (n, 2) map metres; none without."""
    low = np.array([window.x0, window.y0]) - COVERAGE_SIZES.reach_m
    high = low + 2 * COVERAGE_SIZES.reach_m + TILE_CELLS * CELL_SIZE
    near = np.flatnonzero(((path >= low) & (path <= high)).all(axis=1))
    return [path[near[0] : near[-1] + 1]] if len(near) else []


def _driven(connection: sa.Connection, store: Store, ballot: int) -> F64:
    """(n, 2) the path of a ballot's drive, map metres; empty if the ballot has none."""
    path = _PATH.ask(connection, ballot=ballot).scalar_one_or_none()
    if path is None:
        return np.zeros((0, 2))
    return np.array([store.lattice.x0, store.lattice.y0]) + (unpack_path(path)[:, ::-1] + 0.5) * CELL_SIZE


_PATH = Question(sa.select(schema.paths.c.path).where(schema.paths.c.ballot == sa.bindparam("ballot")))


def _in_order(every: Sequence[Stretch]) -> list[Stretch]:
    return sorted(every, key=lambda one: (-one.cells, one.tile, one.heading_rad))


def _line(stretch: Stretch) -> PlacedFeature:
    """A stretch of road."""
    line = Geometry("LineString", np.round(stretch.path_m, 2).tolist())
    counts = {"cells": stretch.cells, "built": stretch.built, "gone": stretch.gone}
    heading_deg = round(float(np.degrees(stretch.heading_rad)))
    about = {"row": stretch.tile[0], "col": stretch.tile[1], "heading_deg": heading_deg}
    return PlacedFeature("Feature", line, about | counts)
