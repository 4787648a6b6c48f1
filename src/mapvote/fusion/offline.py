"""The offline server: a map and a handful of ballots in, the updated map out (paper IV)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from mapvote.codec.ballot import Ballot, encode, tile_key, unpack_planes
from mapvote.codec.tile_planes import base_hash
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.lazy_tiles import with_changed
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote.fusion.fuse import Decision, Rule, fuse_tile, rule_of, unspent
from mapvote.fusion.tile_vote import TileVote, newest_votes


def check_round(ballots: Sequence[Ballot], point_map: PointMap) -> Rule:
    """The one rule of a round. MapvoteError if ballots mix methods or settings, vote on another map or another
    version of it, or are two different ballots of the same drive."""
    if not ballots:
        raise MapvoteError("no ballots: give at least one ballot file")
    first = ballots[0]
    drives: dict[tuple[str, str], str] = {}
    for ballot in ballots:
        name = f"ballot {ballot.vehicle}/{ballot.drive}"
        if (ballot.method, ballot.stage, ballot.settings_hash) != (first.method, first.stage, first.settings_hash):
            raise MapvoteError(
                f"{name} was cast by {_method(ballot)}, {first.vehicle}/{first.drive} by {_method(first)}: "
                "one round never mixes methods; vote again with the same settings"
            )
        if ballot.map_id != point_map.map_id:
            raise MapvoteError(f"{name} is a vote on map {ballot.map_id!r}, not on {point_map.map_id!r}")
        digest = hashlib.sha256(encode(ballot)).hexdigest()
        if drives.setdefault((ballot.vehicle, ballot.drive), digest) != digest:
            raise MapvoteError(f"{name} is given twice with different votes: keep one of the two files")
        for tile in ballot.tiles:
            if not _on_this_tile(ballot, tile.tile, point_map):
                raise MapvoteError(
                    f"{name} voted on another version of tile {tile_key(tile.tile)} than this map holds: "
                    "use the map it was cast against, or vote again with this one"
                )
    return rule_of(first.method)


def _on_this_tile(ballot: Ballot, index: TileIndex, point_map: PointMap) -> bool:
    """Whether a ballot was cast against the current tile, or names the earlier version of the map."""
    if ballot.base[tile_key(index)] == base_hash(point_map.tiles.get(index)):
        return True
    memory = point_map.tile(index).memory
    older = ballot.version is not None and point_map.version is not None and ballot.version < point_map.version
    return older and memory is not None and len(memory.changed_after(ballot.version or 0)) > 0


def _method(ballot: Ballot) -> str:
    return f"{ballot.method}, {ballot.stage}, settings {ballot.settings_hash[:8]}"


def update_map(
    point_map: PointMap, ballots: Iterable[Ballot], settings: FuseSettings
) -> tuple[PointMap, dict[TileIndex, Decision]]:
    """Fuse a round of ballots and edit the map: (updated map, decisions by tile). Untouched tiles are the same objects.

    All ballots of one round; ``settings.min_votes`` applies as given (the paper's cases use 1). MapvoteError as in
    :func:`check_round`, or if a plane is damaged.
    """
    ballots = list(ballots)
    rule = check_round(ballots, point_map)
    unique = {hashlib.sha256(encode(ballot)).hexdigest(): ballot for ballot in ballots}
    changed: dict[TileIndex, Tile] = {}
    version = (point_map.version or 0) + 1
    decisions: dict[TileIndex, Decision] = {}
    for index in sorted({tile.tile for ballot in ballots for tile in ballot.tiles}):
        tile = point_map.tile(index)
        votes = [_unspent(vote, tile) for vote in newest_votes(_votes_on(index, unique), settings)]
        decision, edited = fuse_tile(tile, votes, rule, settings, version)
        decisions[index] = decision
        if edited is not tile:
            changed[index] = edited
    if point_map.version is not None and changed:
        point_map = replace(point_map, version=version)
    return replace(point_map, tiles=with_changed(point_map.tiles, changed)), decisions


def _unspent(vote: TileVote, tile: Tile) -> TileVote:
    """A vote that names no version was checked to be cast against the tile as it is."""
    return unspent(vote, tile) if vote.version else vote


def _votes_on(index: TileIndex, ballots: dict[str, Ballot]) -> Iterator[TileVote]:
    for digest, ballot in ballots.items():
        for tile in ballot.tiles:
            if tile.tile == index:
                yield TileVote.of(unpack_planes(tile), ballot.vehicle, ballot.end_ns, digest, ballot.version)
