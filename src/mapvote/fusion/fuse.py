"""Ballots of a tile -> decisions -> edited tile (paper IV). Pure: no files, no database, no clock.

The order in which votes are given never matters: tallies are integer sums, and of several points for one voxel the
same one is always taken. A vote is spent once a version has changed its cell. Comparing the cell's content is no
test: an object that appeared and disappeared leaves it bit for bit as at first, and its old votes would add it again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.ballot import Ballot, Odds, encode, tile_key, unpack_planes
from mapvote.codec.planes import nothing_reached
from mapvote.codec.tile_planes import base_hash
from mapvote.config import FuseSettings
from mapvote.core.grid import CELLS, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap, with_changed
from mapvote.core.rule import Rule, rule_named
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import I64, N_STATES, NO_VOTE, U8, U64, Bool, CellState, MapvoteError, read_only
from mapvote.core.voting import VOTE_UNIT, add_tally, decide_cells, tally_of
from mapvote.fusion.change_time import denied_last, doubtful, lately_changed, remembered, temporary
from mapvote.fusion.copies import Copy, liars_among, originals, without
from mapvote.fusion.distrust import contradictors, deniers
from mapvote.fusion.edit import EditVotes, add_points, delete_points, words_gone
from mapvote.fusion.gravity import (
    FALLING,
    GRAVITY,
    Fallen,
    Falling,
    Gravity,
    Remains,
    fall_across,
    fall_within,
    remains_of,
    remains_without_votes,
)
from mapvote.fusion.loss_budget import PendingDeletions, agreed_odds, beyond_budget
from mapvote.fusion.neighbour_noise import without_spilled, without_spilled_in
from mapvote.fusion.tile_vote import Vote, by_voter, newest_votes, offered, one_each, silenced

History = Callable[[], Sequence[Vote]]
"""Gives the votes of a tile over a longer time."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The vehicles' decision on one tile, and its effects."""

    states: U8
    """(256, 256) CellState or NO_VOTE; where noise spilled over what the world is, not what was voted
    (fusion/neighbour_noise.py)."""
    tally: NDArray[Any]
    """(256, 256, 5) in VOTE_UNITs, see :func:`count`."""
    edits: U8
    """(256, 256) the states by which the tile's points come and go: others where noise spilled over."""
    quorum: int
    heard: Collection[str] = ()
    """The voters whose votes were counted, see :func:`mapvote.fusion.tile_vote.voter_of`."""
    votes: Sequence[Vote] = ()
    """Their votes; as all that only the edit needs, none once the tile is edited."""
    denied: Bool | None = None
    """Changes that wait because the last vehicle that observed them disagrees."""
    passing: Bool | None = None
    """New objects that stay out because they are temporary."""
    past: History | None = None
    """The votes of a longer time, without copies, read at first use; None if there is no history."""
    copies: Sequence[Copy] = ()
    """Drives that do not count because another vehicle's, which is alike, does."""
    odds: Odds = field(default_factory=Odds.none)
    """The agreed confidence of the voters for each changed cell, see :func:`agreed_odds`."""
    pending: PendingDeletions = field(default_factory=PendingDeletions.none)
    """Deletions that wait because they are beyond the budget; undetermined among the states."""
    edit_votes: EditVotes = field(default_factory=EditVotes.none)
    """Votes behind what comes and goes in cells of which ``states`` state no such change; none before the edit."""
    fell: Fallen = field(default_factory=Fallen.none)
    """Voxels that fell with a demolished object (fusion/gravity.py); cells that they leave empty are changed-empty."""
    waits: I64 = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(n,) flat cells from which nothing falls, because their change waits."""
    undecided: Remains | None = None
    """The tile, if other tiles decide whether more of it falls."""
    added: int = 0
    """Points added to the tile."""
    deleted: int = 0
    """Points deleted from the tile."""

    @property
    def vehicles(self) -> int:
        """How many were counted."""
        return len(self.heard)


def count(votes: Sequence[Vote], rule: Rule, min_votes: int) -> tuple[U8, NDArray[Any]]:
    """(states, tally) of one vote per vehicle: the rule of core.voting, then the quorum (docs/decisions/voting.md).

    Where ``rule.undetermined_competes`` a plain majority decides; else undetermined abstains, and a change needs a
    majority of the vehicles that determined the cell. A change that fewer than ``min_votes`` vehicles back is
    undetermined; in one stage a vehicle backs what its own tally alone would decide. The tally is (256, 256, 5) in
    VOTE_UNITs, class by class in memory, uint8 or uint16 where no sum can exceed that.
    """
    abstain = not rule.undetermined_competes
    quorum = min_votes if min_votes > 1 else 0
    if any(vote.tally is not None for vote in votes):
        tally, backers = (np.zeros((N_STATES, CELLS), dtype=np.int32) for _ in range(2))
        for vote in votes:
            assert vote.tally is not None
            add_tally(
                np.ascontiguousarray(np.moveaxis(vote.tally, -1, 0)).reshape(N_STATES, -1), abstain, tally, backers
            )
        states = decide_cells(tally, backers, abstain, quorum)
    else:
        tally = tally_of([vote.states.reshape(-1) for vote in votes if vote.states is not None], CELLS)
        states = decide_cells(tally, tally, abstain, quorum * VOTE_UNIT)
    shape = (TILE_CELLS, TILE_CELLS)
    return states.reshape(shape), np.moveaxis(tally.reshape(N_STATES, *shape), 0, -1)


def fuse_tile(
    tile: Tile,
    drives: Iterable[Vote],
    rule: Rule,
    settings: FuseSettings,
    version: int = 0,
    history: History | None = None,
    falling: Falling = FALLING,
) -> tuple[Decision, Tile]:
    """Decide one tile and edit it. A tile that does not change is returned as the same object. Where the map has no
    tile, give :meth:`mapvote.core.tile.Tile.empty`. ``version``: of the map that this makes; the edited tile remembers
    it. ``falling``: what decides besides the votes which groups fall. The rest as in :func:`decide_tile`.
    """
    decided = decide_tile(tile, drives, rule, settings, history)
    gone, edit_votes = deletions(tile, decided)
    edited, added, deleted = _edit(tile, decided.votes, decided.edits, decided.quorum, gone)
    if not rule.undetermined_competes:
        decided, edited, more = _let_fall(decided, tile, edited, falling)
        deleted += more
    if edited is not tile:
        changed = np.flatnonzero(differing(tile, edited))
        memory = (tile.memory or Memory.none()).with_changed(changed, version)
        runs = None if decided.past is None else (decided.past, settings.min_votes)
        edited = edited.but(memory=remembered(memory, tile, edited, decided.votes, decided.edits, runs))
    decided = replace(decided, votes=(), denied=None, passing=None, past=None, added=added, deleted=deleted)
    return replace(decided, edit_votes=edit_votes), edited


def decide_tile(
    tile: Tile, drives: Iterable[Vote], rule: Rule, settings: FuseSettings, history: History | None = None
) -> Decision:
    """The decision of the votes: counted, then in the order of time, then within the budget of false deletions.

    ``drives`` are the votes that count on this tile (``newest_votes`` in fusion/tile_vote.py, ``unspent`` in
    fusion/fuse.py), any order. ``history``: called, where objects are temporary, for all votes that count of the last
    ``history_days`` (fusion/change_time.py); without it all is of one moment, and everything new stays.
    """
    given = by_voter(drives, settings)
    drives, copies = originals(given, settings)
    past = None if history is None else cache(partial(_originals_of, history, given, copies, settings))
    silenced = liars_among(copies, drives)
    votes, states, tally, quorum = hear(one_each(drives, tile.window), rule, settings, silenced, tile)
    names = frozenset(vote.vehicle for vote in votes)
    if any(vote.states is None for vote in votes):
        return Decision(states, tally, states, quorum, names, votes, past=past)
    spoken = [drive for drive in drives if drive.vehicle in names]
    states = states if rule.undetermined_competes else lately_changed(states, spoken, tally, quorum)
    denied = passing = None
    if past is not None:
        denied = denied_last(states, tile.memory, spoken)
        doubt = doubtful(states, tile.memory, settings).any()
        passing = temporary(states, tile, past(), settings) if doubt else np.zeros_like(denied)
        states = states.copy()
        states[denied | passing] = int(CellState.UNDETERMINED)
    odds = agreed_odds(votes, states, quorum)
    pending = beyond_budget(states, odds, settings)
    if len(pending.cells):
        states = states.copy()
        states.reshape(-1)[pending.cells] = int(CellState.UNDETERMINED)
    stated = without_spilled(states, tile, votes) if len(odds.cells) else states  # of surfaces' ballots alone
    return Decision(stated, tally, states, quorum, names, votes, denied, passing, past, copies, odds, pending)


def _originals_of(
    history: History, drives: Sequence[Vote], copies: Sequence[Copy], settings: FuseSettings
) -> Sequence[Vote]:
    """The votes that ``history`` gives, without copies. Where they are those of the ``drives``, their ``copies`` are
    known."""
    votes = by_voter(history(), settings)
    same = {(vote.vehicle, vote.digest) for vote in votes} == {(drive.vehicle, drive.digest) for drive in drives}
    return without(copies, votes) if same else originals(votes, settings)[0]


def deletions(tile: Tile, decided: Decision) -> tuple[U64 | None, EditVotes]:
    """((256, 256) the voxels that a decision deletes from the tile, None if none; its edit votes)."""
    gone, trimmed = words_gone(decided.votes, decided.edits, decided.quorum, tile)
    cells = np.flatnonzero(decided.states != decided.edits)
    if not len(cells):
        return gone, trimmed
    states = decided.edits.reshape(-1)[cells]
    tally = decided.tally[cells // TILE_CELLS, cells % TILE_CELLS].astype(np.int32) // VOTE_UNIT
    votes = tally[np.arange(len(cells)), states]
    against = tally[:, : CellState.UNDETERMINED].sum(axis=1, dtype=np.int32) - votes
    return gone, trimmed.and_of(EditVotes(cells, states, votes, against))


def _edit(tile: Tile, votes: Sequence[Vote], states: U8, quorum: int, gone: U64 | None) -> tuple[Tile, int, int]:
    """(the tile as decided without the voxels ``gone`` (256, 256), points added, points deleted)."""
    edited = tile
    deleted = 0
    if gone is not None:
        edited, deleted = delete_points(edited, gone)
    added = 0
    if (states == int(CellState.CHANGED_OCCUPIED)).any():
        edited, added = add_points(edited, *offered(votes, states, tile.window), quorum)
    return _learn_free(edited, votes, quorum, points_added=added > 0), added, deleted


def _let_fall(decided: Decision, tile: Tile, edited: Tile, falling: Falling) -> tuple[Decision, Tile, int]:
    """(the decision, the tile ``edited`` by votes, without what falls, how many points that were)."""
    # From cells whose change waits nothing falls.
    waiting = [np.flatnonzero(cells) for cells in (decided.denied, falling.reviewed) if cells is not None]
    waits = np.unique(np.concatenate([decided.pending.cells, *waiting]))
    decided = replace(decided, waits=waits)
    if edited.points is tile.points and falling.fallen is None:
        return decided, edited, 0
    # What falls by this tile alone, and what the tiles around decide.
    left = remains_of(tile, edited, decided.edits, waits, gravity=falling.gravity)
    fell, missing = fall_within(tile.index, left, falling.gravity)
    fell = fell if falling.fallen is None else fell.joined(falling.fallen)
    decided = replace(decided, undecided=left if missing else None)
    return _without(fell, decided, tile, edited, left) if len(fell.cells) else (decided, edited, 0)


def fall_besides(
    decided: Decision, tile: Tile, edited: Tile, fallen: Fallen, version: int
) -> tuple[Decision, Tile] | None:
    """The result of :func:`fuse_tile` with ``fallen``, from its result without: ``decided`` and ``edited``, of a tile
    that other tiles decide.

    None if votes are needed again: to say how long something stood that vehicles had put there, and that falls now.
    """
    assert decided.undecided is not None
    memory = edited.memory or Memory.none()
    if (memory.at(fallen.cells)[1] > 0).any():
        return None
    decided, fewer, more = _without(decided.fell.joined(fallen), decided, tile, edited, decided.undecided)
    decided = replace(decided, deleted=decided.deleted + more)
    return decided, fewer.but(memory=memory.with_changed(fallen.cells, version))


def _without(fell: Fallen, decided: Decision, tile: Tile, edited: Tile, left: Remains) -> tuple[Decision, Tile, int]:
    """(the decision, the tile ``edited``, without all that ``fell``, how many points that were); ``left``: the remains
    of the edited tile."""
    plane = fell.plane()
    edited, deleted = delete_points(edited, plane)
    left = replace(left, rest=left.rest & ~plane)
    # A cell that the fall leaves empty is changed-empty; its points may be noise of a cell beside it.
    emptied = fell.cells[left.rest.reshape(-1)[fell.cells] == 0]
    edits = decided.edits.copy()
    edits.reshape(-1)[emptied] = int(CellState.CHANGED_EMPTY)
    states = decided.states.copy()
    stated = without_spilled_in(emptied, edits, tile) if len(decided.odds.cells) else edits
    states.reshape(-1)[emptied] = stated.reshape(-1)[emptied]
    undecided = None if decided.undecided is None else left
    return replace(decided, fell=fell, states=states, edits=edits, undecided=undecided), edited, deleted


def hear(
    votes: Sequence[Vote],
    rule: Rule,
    settings: FuseSettings,
    silenced: int = 0,
    tile: Tile | None = None,
) -> tuple[Sequence[Vote], U8, NDArray[Any], int]:
    """(the votes that count, states, tally, quorum), of one vote a vehicle on a tile; see :func:`count`.

    The quorum falls by one for each excluded vehicle, because it is one of those that the quorum guards against, and by
    ``silenced``, those excluded before; but never below two. Vehicles that send tallies are not judged: their weights
    differ. ``tile``: as it is now, see :func:`deniers`.
    """
    heard = list(votes)
    quorum = max(settings.min_votes - silenced, min(settings.min_votes, 2))
    states, tally = count(heard, rule, quorum)
    if quorum < 2 or any(vote.states is None for vote in heard):
        return heard, states, tally, quorum
    for judged in (contradictors, partial(deniers, tile=tile)):
        is_excluded = judged(heard, states, tally, quorum, settings)
        if is_excluded.any():
            heard = [vote for vote, out in zip(heard, is_excluded, strict=True) if not out]
            quorum = max(2, quorum - int(is_excluded.sum()))
            states, tally = count(heard, rule, quorum)
    return heard, states, tally, quorum


def _learn_free(tile: Tile, votes: Sequence[Vote], min_votes: int, points_added: bool) -> Tile:
    """Known-free columns with the voxels that at least ``min_votes`` vehicles passed through, minus the occupied ones.

    Only in cells on which the vehicle voted. Free space is remembered once learned; a voxel that holds a point of the
    map is never free. Until enough vehicles have passed, a tile without free space stays so: a plane without any free
    voxel would mean that nothing new can be known there.
    """
    passed = [vote for vote in votes if vote.free is not None]
    if tile.free is None and len(passed) < max(min_votes, 1):
        return tile
    if not passed and not points_added:
        return tile
    free = tile.free if tile.free is not None else np.zeros((TILE_CELLS, TILE_CELLS), dtype=np.uint64)
    reached = nothing_reached(min_votes if len(passed) >= min_votes else 1)
    for vote in passed if len(passed) >= min_votes else []:
        vote.mark_passed(reached)
    learned = reached[-1].reshape(free.shape)
    learned |= free
    learned &= ~tile.obstacle_words
    return tile.but(free=learned) if tile.free is None or (learned != free).any() else tile


def states_over(lattice: Lattice, decisions: Mapping[TileIndex, Decision]) -> tuple[U8, Grid]:
    """Decided states (rows, cols) over the smallest window of whole tiles that holds them all; elsewhere NO_VOTE."""
    rows = [t[0] for t in decisions] or [0]
    cols = [t[1] for t in decisions] or [0]
    grid = lattice.tile((min(rows), min(cols))).union(lattice.tile((max(rows), max(cols))))
    states = np.full(grid.shape, NO_VOTE, dtype=np.uint8)
    for index, decision in decisions.items():
        states[lattice.tile(index).slices_in(grid)] = decision.states
    return states, grid


def unspent(vote: Vote, tile: Tile, misread: Mapping[int, Bool] | None = None) -> Vote:
    """The vote in the cells where it counts on ``tile``: those that have not changed since the version that its vehicle
    drove with. ``misread``: by version, (256, 256) cells in which that version showed what no longer is history."""
    spent = None if tile.memory is None else tile.memory.changed_after(vote.version)
    wrong = None if misread is None else misread.get(vote.version)
    if wrong is not None:
        spent = np.union1d(np.flatnonzero(wrong), [] if spent is None else spent).astype(np.int64)
    return vote if spent is None else silenced(vote, spent)


def differing(a: Tile, b: Tile) -> Bool:
    """(256, 256) cells in which two versions of a tile hold other points, or know other voxels to be free. Learning
    that nothing is free is no difference."""
    differ = _other_points(a, b).reshape(TILE_CELLS, TILE_CELLS)
    if a.free is b.free:
        return differ
    nothing = np.uint64(0)
    return np.asarray(differ | ((nothing if a.free is None else a.free) != (nothing if b.free is None else b.free)))


def _other_points(a: Tile, b: Tile) -> Bool:
    """(65536,) cells that hold other points."""
    if a.points is b.points:
        return np.zeros(CELLS, dtype=np.bool_)
    sides = [(tile.cells, np.ascontiguousarray(tile.points).view(np.uint32)) for tile in (a, b)]
    missing = np.zeros(CELLS, dtype=np.uint8)
    (cells_a, words_a), (cells_b, words_b) = sides
    _out_of_step(cells_a, read_only(words_a), cells_b, read_only(words_b), missing)
    differ = missing > 0
    unsure = missing == 3
    if unsure.any():
        differ[unsure] = _other_sequences(*(_of_cells(*side, unsure) for side in sides))[unsure]
    return np.asarray(differ)


@kernel
def _out_of_step(
    cells_a: I64, words_a: NDArray[np.uint32], cells_b: I64, words_b: NDArray[np.uint32], missing: U8
) -> None:
    """Into ``missing`` (65536,), zeros, of which side a cell has points (n, 3) that do not follow in the other: 1 and
    2, or 3 of both.

    Each point of b is matched with at most one of a, in order. So cells of 0 hold the same points; those of 1 and 2
    hold more on one side; and of an edit few are 3.
    """
    k = 0
    for i in range(len(cells_a)):
        if k < len(cells_b) and (
            words_a[i, 0] == words_b[k, 0] and words_a[i, 1] == words_b[k, 1] and words_a[i, 2] == words_b[k, 2]
        ):
            k += 1
        else:
            missing[cells_a[i]] |= 1
    for i in range(k, len(cells_b)):
        missing[cells_b[i]] |= 2


def _of_cells(cells: I64, words: NDArray[np.uint32], among: Bool) -> tuple[I64, NDArray[np.uint32]]:
    """Cells (m,), ascending, and words (m, 3) of the points in the cells ``among`` (65536,), each cell's in order."""
    chosen = np.flatnonzero(among[cells])
    chosen = chosen[np.argsort(cells[chosen], kind="stable")]
    return cells[chosen], words[chosen]


def _other_sequences(a: tuple[I64, NDArray[np.uint32]], b: tuple[I64, NDArray[np.uint32]]) -> Bool:
    """(65536,) which cells hold other points, or as many in another order; see :func:`_of_cells`."""
    other = np.bincount(a[0], minlength=CELLS) != np.bincount(b[0], minlength=CELLS)
    same_a = ~other[a[0]]
    same_b = ~other[b[0]]
    other[a[0][same_a][(a[1][same_a] != b[1][same_b]).any(axis=1)]] = True
    return np.asarray(other)


# Offline: a map and a handful of ballots in, the updated map out.


def update_map(
    point_map: PointMap, ballots: Iterable[Ballot], settings: FuseSettings, gravity: Gravity = GRAVITY
) -> tuple[PointMap, dict[TileIndex, Decision]]:
    """Fuse a round of ballots and edit the map: (updated map, decisions by tile). Untouched tiles are the same objects.

    All ballots of one round; ``settings.min_votes`` applies as given (the paper's cases use 1). MapvoteError if they
    mix methods or settings, vote on another map or another version of it, or are two different ballots of the same
    drive, or if a plane is damaged.
    """
    unique = {hashlib.sha256(encode(ballot)).hexdigest(): ballot for ballot in ballots}
    rule = _rule_of_all(unique, point_map)
    changed: dict[TileIndex, Tile] = {}
    version = (point_map.version or 0) + 1
    decisions: dict[TileIndex, Decision] = {}

    def fuse(index: TileIndex, fallen: Fallen | None = None) -> None:
        tile = point_map.tile(index)
        votes = [unspent(vote, tile) for vote in newest_votes(_votes_on(index, unique), settings)]
        falling = Falling(fallen=fallen, gravity=gravity)
        decisions[index], edited = fuse_tile(tile, votes, rule, settings, version, falling=falling)
        if edited is not tile:
            changed[index] = edited

    def remains_at(index: TileIndex) -> Remains:
        tile = point_map.tile(index)
        decided = decisions.get(index)
        if decided is None:
            return remains_without_votes(tile, gravity)
        return remains_of(tile, changed.get(index, tile), decided.edits, decided.waits, decided.fell, gravity)

    for index in sorted({tile.tile for ballot in unique.values() for tile in ballot.tiles}):
        fuse(index)
    undecided = {index: one.undecided for index, one in decisions.items() if one.undecided is not None}
    for index, fallen in fall_across(undecided, remains_at, gravity).items():
        tile = point_map.tile(index)
        after_fall = None
        if index in undecided:
            after_fall = fall_besides(decisions[index], tile, changed.get(index, tile), fallen, version)
        if after_fall is None:
            fuse(index, fallen)
        else:
            decisions[index], changed[index] = after_fall
    if point_map.version is not None and changed:
        point_map = replace(point_map, version=version)
    return replace(point_map, tiles=with_changed(point_map.tiles, changed)), decisions


def _rule_of_all(ballots: Mapping[str, Ballot], point_map: PointMap) -> Rule:
    """The one rule of a round of ballots, by the hash of each; MapvoteError as in :func:`update_map`."""
    if not ballots:
        raise MapvoteError("no ballots: give at least one ballot file")
    first = next(iter(ballots.values()))
    drives: dict[tuple[str, str], str] = {}
    for digest, ballot in ballots.items():
        name = f"ballot {ballot.vehicle}/{ballot.drive}"
        if (ballot.method, ballot.stage, ballot.settings_hash) != (first.method, first.stage, first.settings_hash):
            raise MapvoteError(
                f"{name} uses {_method(ballot)}; {first.vehicle}/{first.drive} uses {_method(first)}. "
                "All ballots of a round use one method and one configuration: vote again with the same settings"
            )
        if ballot.map_id != point_map.map_id:
            raise MapvoteError(f"{name} is a vote on map {ballot.map_id!r}, not on {point_map.map_id!r}")
        if drives.setdefault((ballot.vehicle, ballot.drive), digest) != digest:
            raise MapvoteError(f"{name} is given twice with different votes: keep one of the two files")
        for tile in ballot.tiles:
            if not _on_this_tile(ballot, tile.tile, point_map):
                raise MapvoteError(
                    f"{name} voted on another version of tile {tile_key(tile.tile)} than this map holds: "
                    "use the map it was cast against, or vote again with this one"
                )
    return rule_named(first.method)


def _on_this_tile(ballot: Ballot, index: TileIndex, point_map: PointMap) -> bool:
    """Whether a ballot was cast against the current tile, or names the earlier version of the map."""
    if ballot.base[tile_key(index)] == base_hash(point_map.tiles.get(index)):
        return True
    memory = point_map.tile(index).memory
    older = point_map.version is not None and ballot.version < point_map.version
    return older and memory is not None and len(memory.changed_after(ballot.version)) > 0


def _method(ballot: Ballot) -> str:
    return f"{ballot.method}, {ballot.stage}, settings {ballot.settings_hash[:8]}"


def _votes_on(index: TileIndex, ballots: Mapping[str, Ballot]) -> list[Vote]:
    return [
        Vote(ballot.vehicle, ballot.end_ns, digest, ballot.version).with_planes(unpack_planes(tile))
        for digest, ballot in ballots.items()
        for tile in ballot.tiles
        if tile.tile == index
    ]
