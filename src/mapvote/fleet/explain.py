"""Why the map is as it is: the votes behind a cell, what changed between two versions, how fresh each tile is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import sqlalchemy as sa
from backports import zstd

from mapvote.config import FuseSettings
from mapvote.core.grid import TILE_CELLS, TileIndex, tile_grid
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.core.voting import decide
from mapvote.fleet import schema
from mapvote.fleet.changes import Decided, change_objects, changed_cells, to_geojson
from mapvote.fleet.consensus import Compared, Spoken, Standing, compare, judge
from mapvote.fleet.content import unpack_points_plane
from mapvote.fleet.fuse import Rule, hear
from mapvote.fleet.rounds import unpack_tally_plane
from mapvote.fleet.standing import Round, counting_votes, read_votes, rule_in_use, standing_tiles, stored_votes
from mapvote.fleet.store import Store, current_version, load_blob, load_tile, tiles_of, version_of
from mapvote.fleet.votes import TileVote, one_each, select

_FOREVER = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class CellVote:
    """What one standing drive says about a cell."""

    vehicle: str
    drive: str
    state: str
    """Lower case; no_vote where it says nothing."""
    marks: int | None
    """Voxels of the map that it says are gone here, of a changed cell or beside what stands; None: it sent no mask."""
    end_ns: int
    counts: bool
    why: str
    """Why it does not count; empty if it does."""


@dataclass(frozen=True, slots=True)
class CellStory:
    """One cell: who says what now, and what was decided when."""

    row: int
    col: int
    votes: list[CellVote]
    decisions: list[tuple[int, str]]
    """(version, state) of every version that decided this cell."""


def state_name(state: int) -> str:
    """A cell state as users read it."""
    return "no_vote" if state == NO_VOTE else CellState(state).name.lower()


def explain_cell(store: Store, x: float, y: float, settings: FuseSettings) -> CellStory:
    """The votes behind the cell that holds (x, y), map metres. MapvoteError if that is no place on earth."""
    if not (abs(x) < 1e7 and abs(y) < 1e7):
        raise MapvoteError(f"({x}, {y}): give map metres, within 10,000 km of the map's origin")
    rows, cols = store.lattice.cells_of(np.array([[x, y]]))
    row, col = int(rows[0]), int(cols[0])
    index, cell = (row // TILE_CELLS, col // TILE_CELLS), (row % TILE_CELLS, col % TILE_CELLS)
    asked = Round(_FOREVER, settings, store.clock() - round(settings.min_age_s * 1e9))
    with store.database.reading() as connection:
        hashes = tiles_of(connection, current_version(connection).number, index).get(index)
        points = None if hashes is None else unpack_points_plane(load_blob(connection, hashes.points), hashes.points)
        everyone = stored_votes(connection, index, Round(_FOREVER, settings, _FOREVER))
        old_enough = [vote for vote in everyone if vote.received_ns <= asked.received_by_ns]
        inside = {vote.seq for vote in select(old_enough, settings)}
        counting = {v.digest: v for v in counting_votes(connection, store.lattice, index, points, asked)}
        rule = rule_in_use(connection) or "columns"
        silenced = _silenced(store, index, list(counting.values()), rule, settings)
        plain = read_votes(connection, index, everyone)
        query = sa.select(schema.decisions.c.version, schema.decisions.c.states)
        query = query.where(schema.decisions.c.row == index[0], schema.decisions.c.col == index[1])
        found = connection.execute(query.order_by(schema.decisions.c.version))
        decided = [(r.version, _states(r.states)) for r in found]
    votes = []
    for stored, vote in zip(everyone, plain, strict=True):
        spoken = bool(vote.spoken()[cell])
        counts = spoken and stored.seq in inside and bool(counting[stored.digest].spoken()[cell])
        why = ""
        if not spoken:
            why = "says nothing here"
        elif stored.received_ns > asked.received_by_ns:
            why = "waits for the minimum age"
        elif stored.seq not in inside:
            why = f"older than {settings.max_age_days:g} days or not among the last {settings.latest_vehicles} vehicles"
        elif not counts:
            why = "the cell has changed since its base, or a rollback has barred it"
        elif vote.vehicle in silenced:
            counts, why = False, "opposes the others over most of this tile, or denies nearly all that changed on it"
        said, marks = _said(vote, cell), _marks(vote, cell)
        votes.append(CellVote(stored.vehicle, stored.drive, said, marks, stored.end_ns, counts, why))
    story = [(version, state_name(int(states[cell]))) for version, states in decided if states[cell] != NO_VOTE]
    return CellStory(row, col, votes, story)


def _silenced(store: Store, index: TileIndex, drives: list[TileVote], rule: Rule, settings: FuseSettings) -> set[str]:
    """Vehicles that are not heard on a tile, of the votes that count there."""
    votes = one_each(drives, tile_grid(store.lattice, index))
    return {vote.vehicle for vote in votes} - {vote.vehicle for vote in hear(votes, rule, settings)[0]}


def changes_between(store: Store, old: int, new: int, min_cells: int = 1) -> dict[str, Any]:
    """Change objects from version ``old`` to ``new`` as GeoJSON in map metres. NotFound if one does not exist."""
    with store.database.reading() as connection:
        for number in (old, new):
            version_of(connection, number)
        before, after = tiles_of(connection, old), tiles_of(connection, new)
        found = []
        for index in sorted(before.keys() | after.keys()):
            pair = before.get(index), after.get(index)
            if pair[0] is not None and pair[1] is not None and pair[0].points == pair[1].points:
                continue
            tiles = [None if hashes is None else load_tile(connection, hashes) for hashes in pair]
            decided = list(_decided(store, connection, index, min(old, new), max(old, new)))
            found.append(changed_cells(store.lattice, index, tiles[0], tiles[1], decided))
    objects = change_objects(found, min_cells)
    return to_geojson(
        objects,
        store.lattice,
        map_id=store.map_id,
        from_version=old,
        to_version=new,
        georeference=store.georeference,
    )


def _decided(store: Store, connection: sa.Connection, index: TileIndex, old: int, new: int) -> Iterable[Decided]:
    d = schema.decisions
    query = sa.select(d.c.version, d.c.states, d.c.tally).where(d.c.row == index[0], d.c.col == index[1])
    for row in connection.execute(query.where(d.c.version > old, d.c.version <= new).order_by(d.c.version)).all():
        version = version_of(connection, row.version)
        before = tiles_of(connection, row.version - 1, index).get(index)
        points = None if before is None else unpack_points_plane(load_blob(connection, before.points), before.points)
        policy = FuseSettings.model_validate(version.policy)
        asked = Round(version.mark, policy, version.created_ns - round(policy.min_age_s * 1e9))
        votes = counting_votes(connection, store.lattice, index, points, asked)
        drives = [(vote.end_ns, vote.states) for vote in votes if vote.states is not None]
        yield Decided(row.version, _states(row.states), unpack_tally_plane(row.tally), drives)


def coverage(store: Store) -> list[dict[str, Any]]:
    """Per tile of the map or of a standing ballot: when it was last driven past (ns), by how many vehicles."""
    b, t = schema.ballots, schema.ballot_tiles
    seen = sa.select(t.c.row, t.c.col, sa.func.max(b.c.end_ns), sa.func.count(sa.distinct(b.c.vehicle)))
    seen = seen.join(b, b.c.seq == t.c.ballot).where(b.c.gone_seq.is_(None)).group_by(t.c.row, t.c.col)
    with store.database.reading() as connection:
        tiles: dict[TileIndex, tuple[int | None, int]] = dict.fromkeys(
            tiles_of(connection, current_version(connection).number), (None, 0)
        )
        tiles |= {(row[0], row[1]): (row[2], row[3]) for row in connection.execute(seen)}
    return [
        {"row": index[0], "col": index[1], "last_seen_ns": last, "vehicles": vehicles}
        for index, (last, vehicles) in sorted(tiles.items())
    ]


def vehicle_standings(store: Store, settings: FuseSettings) -> list[Standing]:
    """How each vehicle stands to what the others say, over every vote inside the window, in order of name.

    What is compared is the world (occupied or empty now), so votes on an older base count here too.
    """
    asked = Round(_FOREVER, settings, _FOREVER)
    with store.database.reading() as connection:
        compared: list[Compared] = []
        for index in standing_tiles(connection, _FOREVER):
            chosen = select(stored_votes(connection, index, asked), settings)
            folded = one_each(read_votes(connection, index, chosen), tile_grid(store.lattice, index))
            compared += compare(index, [Spoken(vote.vehicle, vote.end_ns, _decided_states(vote)) for vote in folded])
    return judge(compared, store.lattice)


def events(store: Store, limit: int = 100) -> list[dict[str, Any]]:
    """The last events, newest first."""
    query = sa.select(schema.events).order_by(schema.events.c.seq.desc()).limit(limit)
    with store.database.reading() as connection:
        return [dict(row._mapping) for row in connection.execute(query)]


def _states(data: bytes) -> U8:
    return np.frombuffer(zstd.decompress(data), dtype=np.uint8).reshape(TILE_CELLS, TILE_CELLS)


def _decided_states(vote: TileVote) -> U8:
    if vote.states is not None:
        return vote.states
    assert vote.tally is not None
    return decide(vote.tally.astype(np.int32))


def _said(vote: TileVote, cell: tuple[int, int]) -> str:
    if vote.states is not None:
        return state_name(int(vote.states[cell]))
    assert vote.tally is not None
    return state_name(int(vote.tally[cell].argmax())) if vote.tally[cell].any() else "no_vote"


def _marks(vote: TileVote, cell: tuple[int, int]) -> int | None:
    if vote.gone is None:
        return None
    mine = vote.gone.words[vote.gone.cells == cell[0] * TILE_CELLS + cell[1]]
    return int(mine[0]).bit_count() if len(mine) else 0
