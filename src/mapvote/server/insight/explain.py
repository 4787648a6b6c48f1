"""Why the map is as it is: the votes behind a cell, what changed between two versions, how fresh each tile is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sqlalchemy as sa

from mapvote.codec.arrays import unpack_plane
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.fusion.fuse import hear
from mapvote.fusion.spent import unspent
from mapvote.fusion.tile_vote import TileVote, one_each
from mapvote.server.store import schema
from mapvote.server.store.eligible_votes import Electorate, judged_votes, read_votes
from mapvote.server.store.policy import Policy, policy_in
from mapvote.server.store.queries import current_version, tile_as_of
from mapvote.server.store.store import Store

FOREVER = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class CellVote:
    """What one standing drive says about a cell."""

    vehicle: str
    drive: str
    version: int
    """Of the map that the vehicle drove with."""
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


def explain_cell(store: Store, x: float, y: float) -> CellStory:
    """The votes behind the cell that holds (x, y), map metres. MapvoteError if that is no place on earth."""
    if not (abs(x) < 1e7 and abs(y) < 1e7):
        raise MapvoteError(f"({x}, {y}): give map metres, within 10,000 km of the map's origin")
    rows, cols = store.lattice.cells_of(np.array([[x, y]]))
    row, col = int(rows[0]), int(cols[0])
    index, cell = (row // TILE_CELLS, col // TILE_CELLS), (row % TILE_CELLS, col % TILE_CELLS)
    with store.database.reading() as connection:
        policy = policy_in(connection)
        settings = policy.fuse
        asked = Electorate(FOREVER, policy, store.clock() - round(settings.min_age_s * 1e9))
        number = current_version(connection).number
        tile = tile_as_of(connection, store.lattice.tile(index), number)
        everyone = judged_votes(connection, index, asked)
        said = read_votes(connection, index, [stored for stored, _ in everyone])
        query = sa.select(schema.decisions.c.version, schema.decisions.c.states)
        query = query.where(schema.decisions.c.row == index[0], schema.decisions.c.col == index[1])
        found = connection.execute(query.order_by(schema.decisions.c.version))
        decided = [(r.version, states_of(r.states)) for r in found]
    counting = [unspent(vote, tile) for vote, (_, why) in zip(said, everyone, strict=True) if not why]
    silenced = _silenced(store, index, counting, policy)
    votes = []
    for (stored, why), vote in zip(everyone, said, strict=True):
        if not vote.spoken()[cell]:
            why = "says nothing here"
        elif not why and not unspent(vote, tile).spoken()[cell]:
            assert tile.memory is not None
            why = f"spent: version {tile.memory.changed[cell]} has changed the cell since"
        elif not why and vote.vehicle in silenced:
            why = "opposes the others over most of this tile, or denies nearly all that changed on it"
        whose = stored.vehicle, stored.drive, stored.version
        votes.append(CellVote(*whose, _said(vote, cell), _marks(vote, cell), stored.end_ns, not why, why))
    story = [(version, state_name(int(states[cell]))) for version, states in decided if states[cell] != NO_VOTE]
    return CellStory(row, col, votes, story)


def _silenced(store: Store, index: TileIndex, drives: list[TileVote], policy: Policy) -> set[str]:
    """Vehicles that are not heard on a tile, of the votes that count there."""
    votes = one_each(drives, store.lattice.tile(index))
    heard = hear(votes, policy.round.method, policy.fuse)[0]
    return {vote.vehicle for vote in votes} - {vote.vehicle for vote in heard}


def states_of(data: bytes) -> U8:
    return unpack_plane(data, "<u1", (TILE_CELLS, TILE_CELLS), "decision: states")


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
