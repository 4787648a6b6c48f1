"""The votes on cells: on one cell, each ballot and why it counted or not; on a tile, cell by cell.

The votes that a version counted are read from its decision record (store/decisions.py). Only the votes of the next
version are decided here, for the one tile.
"""

from __future__ import annotations

import math
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

import numpy as np
import sqlalchemy as sa

from mapvote.codec.ballot import UNSAID, in_nats
from mapvote.core.grid import TILE_CELLS, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.rule import rule_named
from mapvote.core.tile import Tile
from mapvote.core.times import utc
from mapvote.core.types import F64, I64, N_STATES, NO_VOTE, U8, CellState, MapvoteError
from mapvote.core.voting import decide_cells, plurality
from mapvote.fusion.change_time import expected_days
from mapvote.fusion.decision_record import Record, unpack_decided
from mapvote.fusion.edit import EditVotes
from mapvote.fusion.fuse import Decision, decide_tile, deletions
from mapvote.fusion.loss_budget import agreed_odds, alike_beside, change_probability
from mapvote.fusion.next_pass import Waiting, lacks_quorum_only
from mapvote.fusion.tile_vote import DAY_NS, REASONS, Vote, Why, folded, one_each
from mapvote_server.questions.falls import fell_with
from mapvote_server.store import schema
from mapvote_server.store.fusion_jobs import standings_of
from mapvote_server.store.integrity import DamagedBallots, ballot_name
from mapvote_server.store.keys import pseudonyms
from mapvote_server.store.policy import Policy, policy_in
from mapvote_server.store.queries import records_in, states_of, tile_as_of, version_of
from mapvote_server.store.store import PerStore, Store
from mapvote_server.store.votes import (
    FOREVER,
    Electorate,
    Polled,
    electorate_now,
    from_sound_ballots,
    judged_among,
    judged_on,
    judged_votes,
    poll,
    read_votes,
    recent_votes,
    stored_votes,
)


@record()
@dataclass(frozen=True, slots=True)
class ExplainSizes:
    """Limits of the story of a cell."""

    records: int = 30
    """Last versions that decided the cell that are asked which votes they counted."""
    votes: int = 100
    """Votes that are listed: those that count, then the newest that do not. A tile of a city has thousands."""
    tiles: int = 4
    """Tiles of which the decision of the next version is kept for further questions."""
    states: int = 256
    """Earlier decisions of which the unpacked states are kept, 64 kB each."""


EXPLAIN_SIZES = ExplainSizes()
UNREADABLE = "unreadable"
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
class Edit:
    """Voxels trimmed from a cell that stands, or points that noise carried in from the next cell."""

    state: str
    """changed_empty: points go; changed_occupied: points come."""
    votes: int
    """Vehicles that voted for it: the fewest for any voxel that went."""
    against: int
    """Vehicles that determined the cell and did not."""


@dataclass(frozen=True, slots=True)
class CellDecision:
    """The decision of one version about a cell."""

    version: int
    state: str
    edit: Edit | None = None
    """The points that it edited though it states no such change; None if there are none."""
    fell: str = ""
    """Text: with which demolished object its points fell; empty if none did."""


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
    clouds: str
    """The file in which the vehicle kept the clouds around a doubtful change on this tile; empty if it kept none. Newer
    ones may have displaced it."""
    end: str | None
    """End of the drive, ISO 8601."""
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
    unlisted: int
    """Further standing votes on the tile that do not count, older than those listed."""
    thing: str
    """Text: "outside the map", or what stands in the cell, whether a new object is temporary, and how many earlier
    objects stood there."""


@dataclass(frozen=True, slots=True)
class _Now:
    """A cell of the newest version, and the ballots that stand on its tile."""

    tile: Tile
    cell: tuple[int, int]
    electorate: Electorate
    standings: Sequence[Vote]
    """The standing votes on the tile that are listed, and why the next version does not count them."""
    unlisted: frozenset[int]
    """Ballots of all other standing votes on the tile."""
    said: Mapping[int, Vote]
    """The vote of each readable ballot on the tile as it was sent, by the ballot's number."""
    decided: Decision
    """The decision of the next version, if it were published now."""


FARTHEST_M = 1e7
"""No place of a map lies farther from its origin."""


def explain_cell(
    store: Store, x: float, y: float, *, with_names: bool = True, sizes: ExplainSizes = EXPLAIN_SIZES
) -> CellStory:
    """The votes behind the cell that holds (x, y), map metres. ``with_names``: with the names of vehicles and
    exact times, else see :func:`seen`. MapvoteError if (x, y) is no place on earth."""
    if not (abs(x) < FARTHEST_M and abs(y) < FARTHEST_M):
        raise MapvoteError(f"({x}, {y}): give map metres, within {FARTHEST_M / 1e3:,.0f} km of the map's origin")
    row, col = store.lattice.cell_of(x, y)
    index = (row // TILE_CELLS, col // TILE_CELLS)
    cell = (row % TILE_CELLS, col % TILE_CELLS)
    with store.database.reading() as connection:
        number = version_of(connection).number
        tile = tile_as_of(connection, store.lattice.tile(index), number)
        present = _as_of_now(store, connection, number, tile, cell, electorate_now(connection, store.clock()), sizes)
        states = {version: _state_in(packed, cell) for version, packed in states_of(connection, index)}
        deciding = [version for version, state in states.items() if state != state_name(NO_VOTE)]
        decisions = [(record, states[record.version]) for record in records_in(connection, index, deciding)]
        falls = [fell_with(store, connection, index, record, cell) for record, _ in decisions]
        votes = _votes(connection, present, [record for record, _ in decisions[-sizes.records :]], with_names)
    if not with_names:
        shown = pseudonyms(store, {vote.vehicle for vote in votes})
        votes = [replace(vote, vehicle=shown[vote.vehicle], drive="", clouds="") for vote in votes]
    probability = _probability(decisions[-1][0], cell) if decisions and not falls[-1] else None
    by_version = [
        CellDecision(record.version, state, _edit_of(record, cell), fell)
        for (record, state), fell in zip(decisions, falls, strict=True)
    ]
    thing = [*_lacks(present, votes), *_thing(present)]
    if not thing and not votes and not decisions and not len(present.tile.points):
        thing = ["outside the map"]
    unlisted = len(present.unlisted)
    return CellStory(row, col, votes, by_version, probability, unlisted, "; ".join(thing))


def seen(stamp_ns: int | None, exactly: bool) -> int | None:
    """The time of a drive, or only its day for readers that may not know the vehicle (not ``exactly``): on a road with
    few vehicles the minute would identify it."""
    return stamp_ns if exactly or stamp_ns is None else stamp_ns // DAY_NS * DAY_NS


def state_name(state: int) -> str:
    """A cell state as users read it."""
    return "no_vote" if state == NO_VOTE else CellState(state).name.lower()


def said_by(vote: Vote) -> U8:
    """(256, 256) the state of each cell by one vote: its states or, in one stage, the decision of its tally. A tie is
    undetermined, as in every decision."""
    if vote.states is not None:
        return vote.states
    assert vote.tally is not None
    return plurality(vote.tally.astype(np.int32))


def sound_votes(connection: sa.Connection, index: TileIndex, ballots: Collection[int]) -> dict[int, Vote]:
    """The votes of some ballots on a tile, standing or not, by ballot; without damaged and deleted ones."""
    stored = stored_votes(connection, index, ballots) if ballots else []
    while True:
        try:
            return {vote.ballot: vote for vote in read_votes(connection, index, stored)}
        except DamagedBallots as error:
            lost = {damage.name for damage in error.found}
            stored = [vote for vote in stored if lost.isdisjoint((str(vote.ballot), ballot_name(vote.ballot, *index)))]


def _as_of_now(
    store: Store,
    connection: sa.Connection,
    number: int,
    tile: Tile,
    cell: tuple[int, int],
    electorate: Electorate,
    sizes: ExplainSizes,
) -> _Now:
    """The standing ballots on a tile of version ``number``, without those that cannot be read."""
    index = tile.index

    def look(electorate: Electorate) -> tuple[Electorate, Polled, Sequence[Vote], Mapping[int, Vote]]:
        polled = poll(connection, index[0], [index[1]], electorate)
        listed = _listed(judged_among(polled, index, electorate), sizes.votes)
        readable = [vote for vote in listed if vote.why != "damaged"]
        return electorate, polled, listed, {v.ballot: v for v in read_votes(connection, index, readable, polled)}

    electorate, polled, listed, said = from_sound_ballots(connection, electorate, look)
    standings, decided = _decided.of(store).of(
        (number, index, electorate.policy.fuse, electorate.policy.round, electorate.set_aside, polled.key(index)),
        lambda: _decide(connection, tile, electorate, polled),
    )
    shown = {vote.ballot for vote in listed}
    unlisted = frozenset(vote.ballot for vote in standings) - shown
    return _Now(tile, cell, electorate, [v for v in standings if v.ballot in shown], unlisted, said, decided)


def _listed(judged: Sequence[Vote], most: int) -> list[Vote]:
    """The votes that are listed, in their order: those that count, and the newest others, ``most`` in all."""
    others = sorted((vote for vote in judged if vote.why), key=lambda vote: vote.end_ns, reverse=True)
    room = max(0, most - (len(judged) - len(others)))
    dropped = {vote.ballot for vote in others[room:]}
    return [vote for vote in judged if vote.ballot not in dropped]


def _decide(
    connection: sa.Connection, tile: Tile, electorate: Electorate, polled: Polled
) -> tuple[Sequence[Vote], Decision]:
    """(every standing vote, the decision) of the next version on a tile."""
    policy = electorate.policy
    judged = judged_on(connection, tile, electorate, polled=polled)
    counting = [vote for vote in judged if not vote.why]

    def history() -> Sequence[Vote]:
        return recent_votes(connection, tile, electorate, polled=polled)

    past = history if policy.round.stage == "two-stage" else None
    decided = decide_tile(tile, counting, rule_named(policy.round.method), policy.fuse, past)
    return standings_of(judged, decided.copies, decided.heard, policy.fuse), decided


class _Decided:
    """The latest decisions on tiles, by all that they follow from; thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._kept: OrderedDict[Hashable, tuple[Sequence[Vote], Decision]] = OrderedDict()

    def of(
        self, key: Hashable, decide: Callable[[], tuple[Sequence[Vote], Decision]]
    ) -> tuple[Sequence[Vote], Decision]:
        """The decision of this ``key``, made by ``decide`` if it is not at hand."""
        with self._lock:
            decided = self._kept.get(key)
        if decided is None:
            decided = decide()
        with self._lock:
            self._kept[key] = decided
            self._kept.move_to_end(key)
            while len(self._kept) > EXPLAIN_SIZES.tiles:
                self._kept.popitem(last=False)
        return decided


_decided = PerStore(_Decided)


def _votes(connection: sa.Connection, present: _Now, records: Sequence[Record], with_names: bool) -> list[CellVote]:
    """The standing votes that are listed, then those that some version counted on the cell and that stand no more."""
    flat = present.cell[0] * TILE_CELLS + present.cell[1]
    once = {standing.ballot for made in records for standing in _standings(made)}
    past = sound_votes(connection, present.tile.index, once - present.said.keys() - present.unlisted)
    said = {**present.said, **past}
    counted = defaultdict[int, list[int]](list)
    left_out = defaultdict[int, list[LeftOut]](list)
    for made in records:
        for standing in _standings(made):
            if standing.ballot in said and said[standing.ballot].speaks_of(present.cell):
                reason_code = standing.why_not(flat)
                if reason_code:
                    left_out[standing.ballot].append(LeftOut(made.version, REASONS[reason_code]))
                else:
                    counted[standing.ballot].append(made.version)
    gone = sorted(past.keys() & counted.keys())
    ended = _ended(connection, gone)
    everyone = [(standing, _why_not(standing, present)) for standing in present.standings]
    everyone += [(past[ballot], ended.get(ballot, "stands no more")) for ballot in gone]
    cell_votes = []
    for standing, reason in everyone:
        ballot = standing.ballot
        vote = said.get(ballot)
        text: tuple[str, int | None, float | None, str] = UNREADABLE, None, None, ""
        if vote is not None:
            row, col = present.tile.index
            clouds = f"{standing.drive}_{row}_{col}.mcap" if vote.clouds else ""
            text = (
                state_name(int(said_by(vote)[present.cell])),
                _marks(vote, present.cell),
                _sure(vote, present.cell),
                clouds,
            )
        whose = (standing.vehicle, standing.drive, standing.version)
        end = utc(seen(standing.end_ns, with_names))
        versions = tuple(counted[ballot]), tuple(left_out[ballot])
        state, marks, sure, clouds = text
        cell_votes.append(CellVote(*whose, state, marks, sure, clouds, end, not reason, reason, *versions))
    return cell_votes


def _ended(connection: sa.Connection, ballots: Collection[int]) -> dict[int, str]:
    """The reason why each of some ballots ended."""
    b = schema.ballots.c
    e = schema.events.c
    ends = sa.select(b.seq, e.kind).join(schema.events, e.seq == b.gone_seq).where(b.seq.in_(ballots))
    return {seq: ENDED.get(kind, kind) for seq, kind in connection.execute(ends)}


def _why_not(standing: Vote, present: _Now) -> str:
    """Why the next version would not count a standing ballot on the cell; "" if it would."""
    if not standing.why and not present.said[standing.ballot].speaks_of(present.cell):
        return "says nothing here"
    reason_code: Why = standing.why_not(present.cell[0] * TILE_CELLS + present.cell[1])
    fuse = present.electorate.settings
    memory = present.tile.memory
    if reason_code == "window":
        return f"older than {fuse.max_age_days:g} days or not among the last {fuse.latest_vehicles} vehicles"
    if reason_code == "spent" and memory is not None:
        return f"spent: version {memory.changed[present.cell]} has changed the cell since"
    return REASONS[reason_code] if reason_code else ""


def _standings(record: Record) -> Sequence[Vote]:
    """None of a record that is damaged."""
    try:
        return record.standings
    except MapvoteError:
        return ()


def _state_in(packed_states: bytes, cell: tuple[int, int]) -> str:
    try:
        return state_name(int(_states_of(packed_states)[cell]))
    except MapvoteError:
        return UNREADABLE


_states_of = lru_cache(maxsize=EXPLAIN_SIZES.states)(unpack_decided)


def _edit_of(record: Record, cell: tuple[int, int]) -> Edit | None:
    """None of a record that is damaged."""
    try:
        return _edit_in(record.edit_votes, cell)
    except MapvoteError:
        return None


def _edit_in(edits: EditVotes, cell: tuple[int, int]) -> Edit | None:
    at = np.flatnonzero(edits.cells == cell[0] * TILE_CELLS + cell[1])
    if not len(at):
        return None
    return Edit(state_name(int(edits.states[at[0]])), int(edits.votes[at[0]]), int(edits.against[at[0]]))


def _probability(record: Record, cell: tuple[int, int]) -> float | None:
    """Probability that the cell changed as the record states, without the changes in cells of other tiles. None if the
    record states no change or cannot be read any more."""
    try:
        states = record.states
        counted = record.votes[cell].astype(np.int64)
        odds = record.odds.at(np.array([cell[0] * TILE_CELLS + cell[1]]))
    except MapvoteError:
        return None
    state = int(states[cell])
    if state not in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        return None
    rows, cols = np.nonzero(states == state)
    beside = alike_beside(rows, cols, np.zeros(len(rows), np.int64))[(rows == cell[0]) & (cols == cell[1])]
    against = counted[: CellState.UNDETERMINED].sum() - counted[state]
    counts = np.array([counted[state]]), np.array([against])
    return round(float(change_probability(states[cell].reshape(1), *counts, beside, odds)[0]), 3)


def _lacks(present: _Now, votes: Sequence[CellVote]) -> list[str]:
    """Text: the change that lacks only the quorum, and the drives among ``votes`` that say so."""
    states = [vote.states for vote in present.decided.votes if vote.states is not None]
    if not states:
        return []
    change = int(
        lacks_quorum_only([plane[present.cell].reshape(1, 1) for plane in states], present.decided.quorum)[0, 0]
    )
    drives = [vote for vote in votes if vote.counts and vote.state == state_name(change)]
    if change == NO_VOTE or not drives:
        return []
    return [str(Waiting(1, len(drives), sorted({vote.vehicle for vote in drives}), present.decided.quorum))]


def _thing(present: _Now) -> list[str]:
    """Text: what stands in the cell or will, and how many earlier objects stood there, by the votes that count."""
    tile = present.tile
    cell = present.cell
    fuse = present.electorate.settings
    text = _waits(present)
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
    return text


def _waits(present: _Now) -> list[str]:
    """Decisions that do not change the map yet, or change it otherwise than voted, with the reason."""
    decided = present.decided
    cell = present.cell
    text = []
    if decided.passing is not None and decided.passing[cell]:
        text.append("temporary: a new object here is not expected to stay, so the map does not take it")
    elif decided.denied is not None and decided.denied[cell]:
        text.append("waits: the last vehicle that looked says otherwise")
    if decided.edits[cell] != decided.states[cell]:
        text.append("unchanged: the cell holds noise of a change in the next cell; its points follow that change")
    trim = (
        _edit_in(deletions(present.tile, decided)[1], cell)
        if decided.edits[cell] == CellState.UNCHANGED_OCCUPIED
        else None
    )
    if trim is not None:
        text.append(
            f"trimmed: the cell stands, and {trim.votes} of {trim.votes + trim.against} vehicles say that voxels of it "
            "are gone; a publish deletes these"
        )
    likely = decided.pending.at(cell)
    if likely is not None:
        text.append(
            f"pending: the probability that emptying it deletes something that stands is {likely:.2g}, and the policy "
            f"allows {present.electorate.settings.false_deletions:g}; the cell is emptied once further votes lower it"
        )
    return text


def _marks(vote: Vote, cell: tuple[int, int]) -> int | None:
    if vote.gone is None:
        return None
    words = vote.gone.words[vote.gone.cells == cell[0] * TILE_CELLS + cell[1]]
    return int(words[0]).bit_count() if len(words) else 0


def _sure(vote: Vote, cell: tuple[int, int]) -> float | None:
    """The probability that a vehicle gives a change of the cell; None if it gives none."""
    if vote.odds is None:
        return None
    said = vote.odds.at(np.array([cell[0] * TILE_CELLS + cell[1]]))
    return None if said[0] == UNSAID else round(1.0 / (1.0 + math.exp(-float(in_nats(said)[0]))), 4)


def _said_on(connection: sa.Connection, index: TileIndex, policy: Policy, wanted: Callable[[Vote], bool]) -> list[Vote]:
    """The standing votes on a tile, of any age, that are ``wanted``; without damaged ones."""

    def read(electorate: Electorate) -> list[Vote]:
        return read_votes(connection, index, [*filter(wanted, judged_votes(connection, index, electorate))])

    return from_sound_ballots(connection, Electorate(FOREVER, policy, FOREVER), read)


def votes_on(connection: sa.Connection, lattice: Lattice, index: TileIndex, policy: Policy) -> list[Vote]:
    """The standing votes on a tile inside the policy's window, one a vehicle."""
    return one_each(_said_on(connection, index, policy, lambda vote: not vote.why), lattice.tile(index))


_NEVER_SEEN = 255


def evidence(store: Store, index: TileIndex, vehicle: str | None = None) -> U8:
    """(256, 256, 4) the standing votes on a tile's cells, of all vehicles or of one.

    Vehicles that determined the cell (255: or more); days since the last drive that did, 254 at most (255: never);
    probability that the cell changed, in 1/255; the most frequent state (a tie is
    undetermined; NO_VOTE: no vote).
    """
    with store.database.reading() as connection:
        policy = policy_in(connection)

        def wanted(vote: Vote) -> bool:
            return vote.why != "damaged" and vehicle in (None, vote.vehicle)

        votes = _said_on(connection, index, policy, wanted)
    silent = Vote(states=np.full((TILE_CELLS, TILE_CELLS), NO_VOTE, np.uint8))
    newest: dict[str, Vote] = {}
    last = np.full((TILE_CELLS, TILE_CELLS), -1, dtype=np.int64)
    for vote in sorted(votes, key=lambda vote: (vote.end_ns, vote.digest)):
        states = said_by(vote)
        before = newest.get(vote.vehicle, silent)
        assert before.states is not None
        spoken = (states != NO_VOTE) & (states != CellState.UNDETERMINED)
        last[spoken] = vote.end_ns
        odds = folded([before, vote], [~spoken.reshape(-1), spoken.reshape(-1)])
        newest[vote.vehicle] = replace(silent, states=np.where(spoken, states, before.states), odds=odds)
    return _summary(list(newest.values()), last, store.clock(), policy.fuse.min_votes)


def _summary(votes: Sequence[Vote], last: I64, now_ns: int, quorum: int) -> U8:
    counts = np.zeros((N_STATES, TILE_CELLS**2), dtype=np.int64)
    said = counts[:4].reshape(4, TILE_CELLS, TILE_CELLS)
    for vote in votes:
        for state in range(4):
            said[state] += vote.states == state
    total = said.sum(axis=0)
    days = np.clip((now_ns - last) // DAY_NS, 0, _NEVER_SEEN - 1)
    out = np.empty((TILE_CELLS, TILE_CELLS, 4), dtype=np.uint8)
    out[..., 0] = np.minimum(total, 255)
    out[..., 1] = np.where(last < 0, _NEVER_SEEN, days)
    out[..., 2] = np.rint(255 * _probabilities(said, votes, quorum))
    out[..., 3] = decide_cells(counts, counts, True, 0).reshape(total.shape)
    return out


def _probabilities(said: I64, vehicles: Sequence[Vote], quorum: int) -> F64:
    """(256, 256) probability of each cell's more frequent change. ``said``: vehicles by state (4, 256, 256). 0 where no
    vehicle votes for a change."""
    changes = said[CellState.CHANGED_OCCUPIED : CellState.CHANGED_EMPTY + 1]
    rows, cols = np.nonzero(changes.any(axis=0))
    kinds = changes[:, rows, cols].argmax(axis=0)
    votes = changes[kinds, rows, cols]
    states = (kinds + CellState.CHANGED_OCCUPIED).astype(np.uint8)
    against = said[:, rows, cols].sum(axis=0) - votes
    out = np.zeros(said.shape[1:])
    claimed = np.full(said.shape[1:], NO_VOTE, dtype=np.uint8)
    claimed[rows, cols] = states
    odds = agreed_odds(vehicles, claimed, quorum).at(rows * TILE_CELLS + cols)
    out[rows, cols] = change_probability(states, votes, against, alike_beside(rows, cols, kinds), odds)
    return out
