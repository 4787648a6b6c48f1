"""Warnings on the voters of a round: the rules decide it, and yet it may be an attack.

A change is decided by the latest vehicles, or by all since some moment. So k liars who drive last can undo what more
vehicles said before, and as many strangers as the quorum asks for can change everything. Real changes look the same. So
the desk and the log warn of them, and the policy can hold such a version for an operator.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sqlalchemy as sa

from mapvote.config import FuseSettings
from mapvote.core.grid import TILE_CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import U8, CellState, MapvoteError
from mapvote.fusion.tile_vote import DAY_NS, Vote, by_voter, one_each
from mapvote_server.errors import Unavailable
from mapvote_server.store import schema
from mapvote_server.store.fusion_jobs import Fused
from mapvote_server.store.queries import memory_of
from mapvote_server.store.store import Store
from mapvote_server.store.votes import Electorate, recent_votes


@dataclass(frozen=True, slots=True)
class Doubts:
    """Doubts on one round; cells are those that a publish would change."""

    overturned: int = 0
    """Cells of which at least as many vehicles said otherwise as vote for the change."""
    votes_for: int = 0
    """Fewest votes for the change among these cells."""
    said_otherwise: int = 0
    """Most vehicles that said otherwise in one of these cells, at any time that is still read."""
    by_newcomers: int = 0
    """Cells that would not change without newcomers."""
    newcomers: tuple[str, ...] = ()
    """Vehicles that vote for the change of these cells, and first voted within ``fuse.newcomer_days``."""
    copies: tuple[tuple[str, str, int], ...] = ()
    """(vehicle, vehicle that counts for both, tiles): drives that share what two drives cannot share."""

    def told(self, settings: FuseSettings) -> list[str]:
        """One sentence each."""
        return [text for text in (self._overturns(), self._rests(settings), *self._alike()) if text]

    def holding(self, settings: FuseSettings) -> list[str]:
        """Those for which the policy holds the version."""
        reasons = ((settings.hold_overturned, self._overturns()), (settings.hold_newcomers, self._rests(settings)))
        return [text for held, text in reasons if held and text]

    def _overturns(self) -> str:
        if not self.overturned:
            return ""
        return (
            f"overturns what as many vehicles or more said, in {self.overturned} cells: {self.votes_for} votes for a "
            f"change where up to {self.said_otherwise} vehicles said otherwise"
        )

    def _rests(self, settings: FuseSettings) -> str:
        if not self.by_newcomers:
            return ""
        who = ", ".join(self.newcomers)
        since = f"within the last {settings.newcomer_days:g} days"
        return f"rests on vehicles that first voted {since}, in {self.by_newcomers} cells: {who}"

    def _alike(self) -> list[str]:
        return [
            f"{vehicle} sends what {heard} sends, on {tiles} tile{'s' if tiles > 1 else ''}: they count as one vehicle"
            for vehicle, heard, tiles in self.copies
        ]


def doubts_about(
    store: Store, newest: int, electorate: Electorate, changed: Sequence[Fused], decided: Sequence[Fused]
) -> Doubts:
    """The doubts about a round on version ``newest``. ``changed``: the tiles that a publish would change; ``decided``:
    all that the round decided. Tiles and ballots that are damaged are left out here; the round names them."""
    by_tile = []
    with store.database.reading() as connection:
        veterans = _KnownVehicles(connection, electorate)
        for fused in changed if electorate.policy.round.stage == "two-stage" else ():
            try:
                # Only what the tile remembers makes votes spent.
                memory = memory_of(connection, newest, fused.index)
                tile = replace(Tile.empty(store.lattice.tile(fused.index)), memory=memory)
                by_tile.append(
                    _on_tile(fused, tile, recent_votes(connection, tile, electorate), electorate.settings, veterans)
                )
            except Unavailable:
                raise
            except MapvoteError:
                continue
    overturned = [one for one in by_tile if one.overturned]
    names = sorted({name for one in by_tile for name in one.newcomers})
    return Doubts(
        overturned=sum(one.overturned for one in overturned),
        votes_for=min((one.votes_for for one in overturned), default=0),
        said_otherwise=max((one.said_otherwise for one in overturned), default=0),
        by_newcomers=sum(one.by_newcomers for one in by_tile),
        newcomers=tuple(names),
        copies=_copies_in(decided),
    )


class _KnownVehicles:
    """Which vehicles voted before the newcomers did."""

    def __init__(self, connection: sa.Connection, electorate: Electorate) -> None:
        self._connection = connection
        self._since_ns = electorate.received_by_ns - round(electorate.settings.newcomer_days * DAY_NS)
        b = schema.ballots.c
        older = sa.select(b.seq).where(b.received_ns <= self._since_ns).limit(1)
        # Where nobody has voted for longer, all are new, and nobody stands out.
        self.any = electorate.settings.newcomer_days > 0 and connection.execute(older).first() is not None
        self._known: dict[str, bool] = {}

    def __contains__(self, vehicle: str) -> bool:
        if vehicle not in self._known:
            b = schema.ballots.c
            first = sa.select(b.seq).where(b.vehicle == vehicle, b.received_ns <= self._since_ns).limit(1)
            self._known[vehicle] = self._connection.execute(first).first() is not None
        return self._known[vehicle]


def _on_tile(
    fused: Fused, tile: Tile, drives: Sequence[Vote], settings: FuseSettings, veterans: _KnownVehicles
) -> Doubts:
    """The doubts about one tile. ``drives``: all that count there, of every vehicle and of a longer time."""
    record = fused.record
    assert record is not None
    states = record.states.reshape(-1)
    cells = np.flatnonzero((states == CellState.CHANGED_OCCUPIED) | (states == CellState.CHANGED_EMPTY))
    votes_for = record.votes[cells // TILE_CELLS, cells % TILE_CELLS, states[cells]].astype(np.int64)
    # The last word of every voter, also of those that are no more among the latest.
    named = by_voter(drives, settings)
    vehicle_of = {voter.vehicle: drive.vehicle for voter, drive in zip(named, drives, strict=True)}
    voters = one_each(named, tile.window)
    said = np.stack([_states(vote)[cells] for vote in voters]) if voters else np.empty((0, len(cells)))
    agrees = said == states[cells]
    otherwise = ((said < CellState.UNDETERMINED) & ~agrees).sum(axis=0)
    overturned = otherwise >= votes_for
    # Without newcomers the quorum would be missing.
    new = np.array([vehicle_of[vote.vehicle] not in veterans for vote in voters], dtype=np.bool_) & veterans.any
    rests = (agrees[new].any(axis=0)) & (agrees[~new].sum(axis=0) < settings.min_votes)
    resting = np.flatnonzero((agrees & rests).any(axis=1) & new)
    names = {vehicle_of[voters[i].vehicle] for i in resting.tolist()}
    return Doubts(
        overturned=int(overturned.sum()),
        votes_for=int(votes_for[overturned].min(initial=np.iinfo(np.int32).max)),
        said_otherwise=int(otherwise[overturned].max(initial=0)),
        by_newcomers=int(rests.sum()),
        newcomers=tuple(names),
    )


def _states(vote: Vote) -> U8:
    """(65536,) of a vote in two stages."""
    assert vote.states is not None
    return vote.states.reshape(-1)


def _copies_in(decided: Sequence[Fused]) -> tuple[tuple[str, str, int], ...]:
    """(vehicle, vehicle that counts for both, tiles) of the copies that a round left out."""
    pairs = [{(copy.vehicle, copy.heard_vehicle) for copy in fused.copies} for fused in decided]
    tiles = Counter(pair for on_tile in pairs for pair in on_tile)
    return tuple((*pair, number) for pair, number in sorted(tiles.items()))
