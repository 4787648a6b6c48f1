"""Why the map is as it is: the votes on a cell, which versions counted them, and what stands there.

What a version counted is read from its decision record (store/decisions.py). Only what the next version would count is
decided here, of the one tile.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import sqlalchemy as sa

from mapvote.codec.odds import UNSAID, in_nats
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.core.voting import VOTE_UNIT, plurality
from mapvote.fusion.fuse import Heard, decide_tile, rule_of
from mapvote.fusion.loss_budget import alike_beside, change_probability
from mapvote.fusion.persistence import expected_days
from mapvote.fusion.tile_vote import TileVote
from mapvote.server.store import schema
from mapvote.server.store.decisions import REASONS, Record, Standing, records_of
from mapvote.server.store.integrity import DamagedBallots, ballot_name
from mapvote.server.store.queries import current_version, tile_as_of
from mapvote.server.store.store import Store
from mapvote.server.store.votes import (
    DAMAGED,
    Electorate,
    Judged,
    StoredVote,
    electorate_now,
    from_sound_ballots,
    judged_on,
    read_votes,
    recent_votes,
    stored_votes,
)

MOST_RECORDS = 30
"""So many of the last versions that decided a cell are asked which votes they counted."""
UNREADABLE = "unreadable"
REVIEWED = "of a change that a reviewer held or rejected"
OPPOSES = "opposes the others over most of this tile, or denies nearly all that changed on it"
COPY = "a copy: its cells on this tile equal those of another vehicle's ballot, which counts for both"
ENDED = {
    "ballot": "replaced by a later ballot of this drive",
    "withdraw": "withdrawn",
    "key revoked": "its vehicle's key was revoked",
}
"""Reasons by the kind of the event that ended a ballot."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A version that did not count a ballot, though the ballot stood."""

    version: int
    why: str


@dataclass(frozen=True, slots=True)
class CellDecision:
    """The decision of one version about a cell."""

    version: int
    state: str


@dataclass(frozen=True, slots=True)
class CellVote:
    """One ballot's vote on a cell. The ballot stands, or a version counted it and it was withdrawn since."""

    vehicle: str
    drive: str
    version: int
    """Version of the map that the vehicle used."""
    state: str
    """Lower case; no_vote where it says nothing."""
    marks: int | None
    """Voxels of the map that it says are gone here, of a changed cell or beside what stands; None: it sent no mask."""
    sure: float | None
    """Probability that the cell did change so, by its own evidence; None where it does not say."""
    end_ns: int
    counts: bool
    """Whether the next version counts it."""
    why: str
    """Why it does not count; empty if it does."""
    counted_in: tuple[int, ...]
    """Versions that counted it on this cell, of the last 30 that decided the cell."""
    left_out_of: tuple[LeftOut, ...]
    """Those of the 30 that did not."""


@dataclass(frozen=True, slots=True)
class CellStory:
    """One cell: every standing vote on it, and every decision about it."""

    row: int
    col: int
    votes: list[CellVote]
    decisions: list[CellDecision]
    """One for each version that decided this cell."""
    probability: float | None
    """Probability that the cell changed as the last decision states (fusion/loss_budget.py); None if it states no
    change."""
    thing: str
    """Text: what stands in the cell, whether a new object is temporary, and how many earlier objects stood there."""


@dataclass(frozen=True, slots=True)
class _Now:
    """A cell of the newest version, and the ballots that stand on its tile."""

    tile: Tile
    cell: tuple[int, int]
    asked: Electorate
    judged: Sequence[Judged]
    said: Mapping[int, TileVote]
    """The vote of each readable ballot on the tile, by the ballot's ``seq``."""
    decided: Heard
    """The decision of the next version, if it were published now."""


def explain_cell(store: Store, x: float, y: float) -> CellStory:
    """The votes behind the cell that holds (x, y), map metres. MapvoteError if that is no place on earth."""
    if not (abs(x) < 1e7 and abs(y) < 1e7):
        raise MapvoteError(f"({x}, {y}): give map metres, within 10,000 km of the map's origin")
    rows, cols = store.lattice.cells_of(np.array([[x, y]]))
    row, col = int(rows[0]), int(cols[0])
    index, cell = (row // TILE_CELLS, col // TILE_CELLS), (row % TILE_CELLS, col % TILE_CELLS)
    with store.database.reading() as connection:
        tile = tile_as_of(connection, store.lattice.tile(index), current_version(connection).number)
        now = _as_of_now(connection, tile, cell, electorate_now(connection, store.clock()))
        found = [(record, _state_in(record, cell)) for record in records_of(connection, index)]
        decisions = [(record, state) for record, state in found if state != state_name(NO_VOTE)]
        votes = _votes(connection, now, [record for record, _ in decisions[-MOST_RECORDS:]])
    probability = _probability(decisions[-1][0], cell) if decisions else None
    by_version = [CellDecision(record.version, state) for record, state in decisions]
    return CellStory(row, col, votes, by_version, probability, _thing(now))


def story_as_json(story: CellStory) -> dict[str, Any]:
    """A story as JSON."""
    return asdict(story) | {"probability": None if story.probability is None else round(story.probability, 3)}


def state_name(state: int) -> str:
    """A cell state as users read it."""
    return "no_vote" if state == NO_VOTE else CellState(state).name.lower()


def said_by(vote: TileVote) -> U8:
    """(256, 256) the state of each cell by one vote: its states or, in one stage, the decision of its tally. A tie is
    undetermined, as in every decision."""
    if vote.states is not None:
        return vote.states
    assert vote.tally is not None
    return plurality(vote.tally.astype(np.int32))


def sound_votes(
    connection: sa.Connection, index: TileIndex, ballots: Collection[int]
) -> dict[int, tuple[StoredVote, TileVote]]:
    """The votes of some ballots on a tile, standing or not, by their ``seq``; without damaged and deleted ones."""
    stored = stored_votes(connection, index, ballots) if ballots else []
    while True:
        try:
            said = read_votes(connection, index, stored)
        except DamagedBallots as error:
            lost = {damage.name for damage in error.found}
            stored = [one for one in stored if lost.isdisjoint((str(one.seq), ballot_name(one.seq, *index)))]
        else:
            return {one.seq: (one, vote) for one, vote in zip(stored, said, strict=True)}


def _as_of_now(connection: sa.Connection, tile: Tile, cell: tuple[int, int], asked: Electorate) -> _Now:
    """The standing ballots on a tile, without those that cannot be read."""

    def look(asked: Electorate) -> tuple[Electorate, Sequence[Judged], Mapping[int, TileVote]]:
        judged = judged_on(connection, tile, asked)
        readable = [one.stored for one in judged if one.why != DAMAGED]
        said = read_votes(connection, tile.index, readable)
        return asked, judged, {stored.seq: vote for stored, vote in zip(readable, said, strict=True)}

    asked, judged, said = from_sound_ballots(connection, asked, look)
    policy, counting = asked.policy, [one.vote for one in judged if one.vote is not None]

    def history() -> Sequence[TileVote]:
        return recent_votes(connection, tile, asked)

    past = history if policy.round.stage == "two-stage" else None
    return _Now(
        tile, cell, asked, judged, said, decide_tile(tile, counting, rule_of(policy.round.method), policy.fuse, past)
    )


def _votes(connection: sa.Connection, now: _Now, records: Sequence[Record]) -> list[CellVote]:
    """Every standing vote, then those that some version counted on the cell and that stand no more."""
    flat = now.cell[0] * TILE_CELLS + now.cell[1]
    past = sound_votes(connection, now.tile.index, {s.ballot for r in records for s in _standings(r)} - now.said.keys())
    said = {**now.said, **{seq: vote for seq, (_, vote) in past.items()}}
    counted, left_out = defaultdict[int, list[int]](list), defaultdict[int, list[LeftOut]](list)
    for record in records:
        for standing in _standings(record):
            if standing.ballot in said and said[standing.ballot].spoken()[now.cell]:
                why = standing.why_not(flat)
                if why:
                    left_out[standing.ballot].append(LeftOut(record.version, REASONS[why]))
                else:
                    counted[standing.ballot].append(record.version)
    ended = _ended(connection, past.keys() & counted.keys())
    everyone = [(one.stored, _why_not(one, now)) for one in now.judged]
    everyone += [(past[seq][0], ended.get(seq, "stands no more")) for seq in sorted(past.keys() & counted.keys())]
    return [
        _vote(stored, said.get(stored.seq), why, now.cell, (counted[stored.seq], left_out[stored.seq]))
        for stored, why in everyone
    ]


def _ended(connection: sa.Connection, ballots: Collection[int]) -> dict[int, str]:
    """The reason why each of some ballots ended."""
    b, e = schema.ballots.c, schema.events.c
    ends = sa.select(b.seq, e.kind).join(schema.events, e.seq == b.gone_seq).where(b.seq.in_(ballots))
    return {seq: ENDED.get(kind, kind) for seq, kind in connection.execute(ends)}


def _why_not(one: Judged, now: _Now) -> str:
    """Why the next version would not count a standing ballot on the cell; "" if it would."""
    if one.why:
        return one.why
    assert one.vote is not None
    flat, sent = now.cell[0] * TILE_CELLS + now.cell[1], now.said[one.stored.seq]
    if not sent.spoken()[now.cell]:
        return "says nothing here"
    if flat in one.spent:
        assert now.tile.memory is not None
        return f"spent: version {now.tile.memory.changed[now.cell]} has changed the cell since"
    if flat in one.reviewed:
        return REVIEWED
    if any((sent.vehicle, sent.digest) == (copy.vehicle, copy.digest) for copy in now.decided.copies):
        return COPY
    return "" if any(sent.vehicle == other.vehicle for other in now.decided.votes) else OPPOSES


def _vote(
    stored: StoredVote,
    vote: TileVote | None,
    why: str,
    cell: tuple[int, int],
    versions: tuple[Sequence[int], Sequence[LeftOut]],
) -> CellVote:
    """``versions``: those that counted it, and those that did not and why."""
    whose = stored.vehicle, stored.drive, stored.version
    text: tuple[str, int | None, float | None] = UNREADABLE, None, None
    if vote is not None:
        text = state_name(int(said_by(vote)[cell])), _marks(vote, cell), _sure(vote, cell)
    return CellVote(*whose, *text, stored.end_ns, not why, why, tuple(versions[0]), tuple(versions[1]))


def _standings(record: Record) -> Sequence[Standing]:
    """None of a record that is damaged."""
    try:
        return record.standings
    except MapvoteError:
        return ()


def _state_in(record: Record, cell: tuple[int, int]) -> str:
    try:
        return state_name(int(record.states[cell]))
    except MapvoteError:
        return UNREADABLE


def _probability(record: Record, cell: tuple[int, int]) -> float | None:
    """Probability that the cell changed as the record states, without the changes in cells of other tiles. None if the
    record states no change or cannot be read any more."""
    try:
        states, counted = record.states, record.tally[cell].astype(np.int64) // VOTE_UNIT
        odds = record.odds.at(np.array([cell[0] * TILE_CELLS + cell[1]]))
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


def _thing(now: _Now) -> str:
    """Text: what stands in the cell or will, and how many earlier objects stood there, by the votes that count."""
    tile, cell, fuse = now.tile, now.cell, now.asked.settings
    text = _waits(now)
    if tile.obstacle_words[cell]:
        brought = tile.memory is not None and tile.memory.came_s[cell] > 0
        text.append("stands: brought by vehicles" if brought else "stands: surveyed")
    stays = 0 if tile.memory is None else int(tile.memory.stays[cell])
    if stays and tile.memory is not None:
        here = np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.bool_)
        here[cell] = True
        days = int(tile.memory.stayed_s[cell]) / 86_400 / stays
        expected = float(expected_days(tile.memory, here, 0.0, fuse)[0])
        past = f"{stays} things came and went here, after {days:.1f} days on average"
        text.append(f"{past}; the next can be expected to stay {expected:.1f}")
    return "; ".join(text)


def _waits(now: _Now) -> list[str]:
    """Decisions that do not change the map yet, or change it otherwise than voted, with the reason."""
    found, cell, text = now.decided, now.cell, []
    if found.passing is not None and found.passing[cell]:
        text.append("temporary: a new object here is not expected to stay, so the map does not take it")
    elif found.denied is not None and found.denied[cell]:
        text.append("waits: the last vehicle that looked says otherwise")
    if found.edits[cell] != found.states[cell]:
        text.append("unchanged: the cell holds noise of a change in the next cell; its points follow that change")
    likely = found.pending.at(cell)
    if likely is not None:
        text.append(
            f"pending: the probability that emptying it deletes something that stands is {likely:.2g}, and the policy "
            f"allows {now.asked.settings.false_deletions:g}; the cell is emptied once further votes lower it"
        )
    return text


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
