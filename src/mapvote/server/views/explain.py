"""Why the map is as it is: the votes on a cell, which versions counted them, and what stands there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.codec.arrays import unpack_plane
from mapvote.codec.odds import UNSAID, in_nats
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.core.voting import VOTE_UNIT, decide
from mapvote.fusion.copies import originals
from mapvote.fusion.fuse import Heard, decide_tile, rule_of
from mapvote.fusion.odds import unpack_agreed
from mapvote.fusion.persistence import expected_days
from mapvote.fusion.probability import alike_beside, change_probability
from mapvote.fusion.spent import unspent
from mapvote.fusion.tile_vote import TileVote
from mapvote.server.store import schema
from mapvote.server.store.decisions import unpack_tally_plane
from mapvote.server.store.queries import current_version, oldest_kept, tile_as_of, version_of
from mapvote.server.store.store import Store
from mapvote.server.store.votes import (
    DAMAGED,
    Electorate,
    StoredVote,
    counted_votes,
    electorate_now,
    from_sound_ballots,
    judged_votes,
    read_votes,
    recent_votes,
)

_LOOKED_INTO = 30
"""So many of the last versions that decided a cell are asked which votes they heard."""
UNREADABLE = "unreadable"
REVIEWED = "of a change that a reviewer held or rejected"
OPPOSES = "opposes the others over most of this tile, or denies nearly all that changed on it"
COPY = "a copy: what it determined on this tile is what another vehicle's drive did, and that one is heard for both"


@dataclass(frozen=True, slots=True)
class CellVote:
    """What one drive says about a cell, or said when a version heard it."""

    vehicle: str
    drive: str
    version: int
    """Of the map that the vehicle drove with."""
    state: str
    """Lower case; no_vote where it says nothing."""
    marks: int | None
    """Voxels of the map that it says are gone here, of a changed cell or beside what stands; None: it sent no mask."""
    sure: float | None
    """Probability that the cell did change so, by its own evidence; None where it does not say."""
    end_ns: int
    counts: bool
    """Whether the next version hears it."""
    why: str
    """Why it does not count; empty if it does."""
    heard: tuple[int, ...]
    """Versions in which it was heard on this cell, of the last 30 that decided it."""


@dataclass(frozen=True, slots=True)
class CellStory:
    """One cell: who says what now, and what was decided when."""

    row: int
    col: int
    votes: list[CellVote]
    decisions: list[tuple[int, str]]
    """(version, state) of every version that decided this cell."""
    probability: float | None
    """That it changed as the last of them says (fusion/probability.py); None if that one says of no change."""
    thing: str
    """What stands there, and whether something new is temporary; what came and went before."""


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
        tile = tile_as_of(connection, store.lattice.tile(index), current_version(connection).number)
        now = _undamaged(connection, Place(tile, cell, electorate_now(connection, store.clock())))
        decided = _decisions(connection, index, cell)
        heard: dict[int, list[int]] = {}
        past: dict[int, tuple[StoredVote, TileVote]] = {}
        for version, _ in decided[-_LOOKED_INTO:]:
            for stored, vote in heard_by(connection, store, version, now):
                heard.setdefault(stored.seq, []).append(version)
                past[stored.seq] = stored, vote
        counted = counted_votes(connection, tile, now.asked)
        everyone = _everyone(connection, now, counted)
        everyone += ended(connection, [past[seq] for seq in past.keys() - {stored.seq for stored, _, _ in everyone}])
        votes = [_vote(*each, now, tuple(heard.get(each[0].seq, ()))) for each in everyone]
        probability = _probability(connection, index, cell, decided[-1][0]) if decided else None
        thing = _thing(connection, now, [vote for _, vote in counted])
    return CellStory(row, col, votes, decided, probability, thing)


def as_told(story: CellStory) -> dict[str, Any]:
    """A story as JSON."""
    votes = [asdict(vote) for vote in story.votes]
    decisions = [{"version": version, "state": state} for version, state in story.decisions]
    told = {"row": story.row, "col": story.col, "thing": story.thing, "votes": votes, "decisions": decisions}
    return {**told, "probability": None if story.probability is None else round(story.probability, 3)}


def _decisions(connection: sa.Connection, index: TileIndex, cell: tuple[int, int]) -> list[tuple[int, str]]:
    d = schema.decisions
    query = sa.select(d.c.version, d.c.states).where(d.c.row == index[0], d.c.col == index[1]).order_by(d.c.version)
    found = [(row.version, _state_in(row.states, cell)) for row in connection.execute(query)]
    return [(version, state) for version, state in found if state != state_name(NO_VOTE)]


def _state_in(states: bytes, cell: tuple[int, int]) -> str:
    try:
        return state_name(int(states_of(states)[cell]))
    except MapvoteError:
        return UNREADABLE


def _probability(connection: sa.Connection, index: TileIndex, cell: tuple[int, int], version: int) -> float | None:
    """That the cell changed as ``version`` decided; cells of other tiles are not asked for what changed beside it. None
    if it decided on no change, or on what cannot be read any more."""
    d = schema.decisions
    query = sa.select(d.c.states, d.c.tally, d.c.odds).where(
        d.c.row == index[0], d.c.col == index[1], d.c.version == version
    )
    row = connection.execute(query).one()
    try:
        states, counted = states_of(row.states), unpack_tally_plane(row.tally)[cell].astype(np.int64) // VOTE_UNIT
        odds = unpack_agreed(row.odds, states).at(np.array([cell[0] * TILE_CELLS + cell[1]]))
    except MapvoteError:
        return None
    state = int(states[cell])
    if state not in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        return None
    rows, cols = np.nonzero(states == state)
    beside = alike_beside(rows, cols, np.zeros(len(rows), np.int64))[(rows == cell[0]) & (cols == cell[1])]
    against = counted[: CellState.UNDETERMINED].sum() - counted[state]
    asked = np.array([counted[state]]), np.array([against])
    return float(change_probability(states[cell].reshape(1), *asked, beside, odds)[0])


def _undamaged(connection: sa.Connection, place: Place) -> Place:
    """The same, without ballots that cannot be read."""
    index = place.tile.index

    def readable(asked: Electorate) -> Electorate:
        read_votes(connection, index, [vote for vote, why in judged_votes(connection, index, asked) if why != DAMAGED])
        return asked

    return replace(place, asked=from_sound_ballots(connection, place.asked, readable))


def _everyone(
    connection: sa.Connection, now: Place, counted: Sequence[tuple[StoredVote, TileVote]]
) -> list[tuple[StoredVote, TileVote | None, str]]:
    """Every standing vote on the tile, what it says, and why it does not count on the cell ("" if it does).

    ``counted``: those that count on the tile.
    """
    judged = judged_votes(connection, now.tile.index, now.asked)
    readable = [vote for vote, why in judged if why != DAMAGED]
    said = dict(zip((vote.seq for vote in readable), read_votes(connection, now.tile.index, readable), strict=True))
    obeyed = {stored.seq: vote for stored, vote in counted}
    heard = decided_on(now, [vote for _, vote in counted])
    return [
        (stored, said.get(stored.seq), why or _why_not(said[stored.seq], obeyed.get(stored.seq), now, heard))
        for stored, why in judged
    ]


def _why_not(vote: TileVote, obeyed: TileVote | None, now: Place, heard: Heard) -> str:
    """Of a vote that counts on the tile: why not on this cell."""
    if not vote.spoken()[now.cell]:
        return "says nothing here"
    if not unspent(vote, now.tile).spoken()[now.cell]:
        assert now.tile.memory is not None
        return f"spent: version {now.tile.memory.changed[now.cell]} has changed the cell since"
    if obeyed is not None and not obeyed.spoken()[now.cell]:
        return REVIEWED
    if is_copy(vote, heard):
        return COPY
    return OPPOSES if is_silenced(vote, heard) else ""


def _vote(stored: StoredVote, vote: TileVote | None, why: str, now: Place, heard: tuple[int, ...]) -> CellVote:
    whose = stored.vehicle, stored.drive, stored.version
    told: tuple[str, int | None, float | None] = UNREADABLE, None, None
    if vote is not None:
        told = state_name(int(said_by(vote)[now.cell])), _marks(vote, now.cell), _sure(vote, now.cell)
    return CellVote(*whose, *told, stored.end_ns, not why, why, heard)


def _thing(connection: sa.Connection, now: Place, drives: Sequence[TileVote]) -> str:
    """In words: what stands in the cell or is about to, and what came and went, by the votes that count there."""
    tile, cell, policy = now.tile, now.cell, now.asked.policy
    here = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.bool_)
    here[cell] = True
    told = []
    if policy.round.stage == "two-stage":
        recent, _ = originals(recent_votes(connection, tile, now.asked), policy.fuse)
        found = decide_tile(
            tile, drives, rule_of(policy.round.method), policy.fuse, lambda: originals(recent, policy.fuse)[0]
        )
        if found.passing is not None and found.passing[cell]:
            told.append("temporary: what is new here is not expected to stay, and stays out of the map")
        elif found.denied is not None and found.denied[cell]:
            told.append("waits: the last vehicle that looked says otherwise")
        if found.edits[cell] != found.states[cell]:
            told.append(
                "unchanged: it holds the noise of what changed in the next cell, and its points come or go with that"
            )
        likely = found.pending.at(cell)
        if likely is not None:
            told.append(
                f"pending: that emptying it deletes something that stands is likelier ({likely:.2g}) than the policy "
                f"allows ({policy.fuse.false_deletions:g}); it goes once vehicles that drive by are surer"
            )
    if tile.obstacle_words[cell]:
        brought = tile.memory is not None and tile.memory.came_s[cell] > 0
        told.append("stands: brought by vehicles" if brought else "stands: surveyed")
    stays = 0 if tile.memory is None else int(tile.memory.stays[cell])
    if stays and tile.memory is not None:
        days = int(tile.memory.stayed_s[cell]) / 86_400 / stays
        expected = float(expected_days(tile.memory, here, 0.0, policy.fuse)[0])
        past = f"{stays} things came and went here, after {days:.1f} days on average"
        told.append(f"{past}; the next can be expected to stay {expected:.1f}")
    return "; ".join(told)


def states_of(data: bytes) -> U8:
    return unpack_plane(data, "<u1", (TILE_CELLS, TILE_CELLS), "decision: states")


def _marks(vote: TileVote, cell: tuple[int, int]) -> int | None:
    if vote.gone is None:
        return None
    mine = vote.gone.words[vote.gone.cells == cell[0] * TILE_CELLS + cell[1]]
    return int(mine[0]).bit_count() if len(mine) else 0


def _sure(vote: TileVote, cell: tuple[int, int]) -> float | None:
    """The probability that a vehicle gives a change of the cell; None if it gives none."""
    if vote.odds is None:
        return None
    said = vote.odds.at(np.array([cell[0] * TILE_CELLS + cell[1]]))
    return None if said[0] == UNSAID else round(1.0 / (1.0 + math.exp(-float(in_nats(said)[0]))), 4)


ENDED = {
    "ballot": "replaced by a later ballot of this drive",
    "withdraw": "withdrawn",
    "key revoked": "its vehicle's key was revoked",
}
"""By the kind of the event that ended a ballot."""


@dataclass(frozen=True, slots=True)
class Place:
    """A cell, as of one version."""

    tile: Tile
    cell: tuple[int, int]
    asked: Electorate


def said_by(vote: TileVote) -> U8:
    """(256, 256) what a vote says of each cell: its states or, of one stage, what its tally alone decides. A tie is
    undetermined, as in every decision."""
    if vote.states is not None:
        return vote.states
    assert vote.tally is not None
    return decide(vote.tally.astype(np.int32))


def decided_on(place: Place, drives: Sequence[TileVote]) -> Heard:
    """What comes of the votes that count on a tile."""
    policy = place.asked.policy
    return decide_tile(place.tile, drives, rule_of(policy.round.method), policy.fuse)


def is_copy(vote: TileVote, heard: Heard) -> bool:
    """Whether another vehicle's drive is heard in its place."""
    return any((vote.vehicle, vote.digest) == (copy.vehicle, copy.digest) for copy in heard.copies)


def is_silenced(vote: TileVote, heard: Heard) -> bool:
    """Whether its vehicle is not heard on the tile."""
    return all(vote.vehicle != other.vehicle for other in heard.votes)


def heard_by(connection: sa.Connection, store: Store, number: int, now: Place) -> list[tuple[StoredVote, TileVote]]:
    """The votes that a version heard on the cell."""
    version = version_of(connection, number)
    if number <= oldest_kept(connection):
        return []  # what it was made of was cleared away
    asked = Electorate.of(version, set_aside=now.asked.set_aside)
    then = replace(now, asked=asked, tile=tile_as_of(connection, now.tile.window, number - 1))
    counted = from_sound_ballots(connection, asked, partial(counted_votes, connection, then.tile))
    heard = decided_on(then, [vote for _, vote in counted])
    speaking = [(stored, vote) for stored, vote in counted if vote.spoken()[now.cell]]
    return [one for one in speaking if not is_copy(one[1], heard) and not is_silenced(one[1], heard)]


def ended(
    connection: sa.Connection, past: Sequence[tuple[StoredVote, TileVote]]
) -> list[tuple[StoredVote, TileVote | None, str]]:
    """Votes that some version heard and that stand no more, oldest first, and what ended them."""
    b, e = schema.ballots.c, schema.events.c
    ends = sa.select(b.seq, e.kind).join(schema.events, e.seq == b.gone_seq).where(b.seq.in_([s.seq for s, _ in past]))
    why = {seq: ENDED.get(kind, kind) for seq, kind in connection.execute(ends)}
    ordered = sorted(past, key=lambda one: one[0].seq)
    return [(stored, vote, why.get(stored.seq, "stands no more")) for stored, vote in ordered]
