"""Which votes a version heard on a cell, and what became of those that stand no more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import sqlalchemy as sa

from mapvote.core.tile import Tile
from mapvote.core.types import U8
from mapvote.core.voting import decide
from mapvote.fusion.fuse import Heard, decide_tile, rule_of
from mapvote.fusion.tile_vote import TileVote
from mapvote.server.store import schema
from mapvote.server.store.queries import oldest_kept, tile_as_of, version_of
from mapvote.server.store.store import Store
from mapvote.server.store.votes import Electorate, StoredVote, counted_votes, from_sound_ballots

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
