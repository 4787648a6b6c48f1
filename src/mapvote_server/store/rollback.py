"""Going back: to an earlier version, or to the map as it would be, had a vehicle never taken part.

A replay (un-vote after publication) starts from the version before the vehicle's first vote. It goes through every
later version again, by the policy recorded in each and with the ballots that stood at its moment, without the vehicle.
The result is published as one new version. Versions before the oldest one kept are not replayed. A round that made no
version because of the vehicle left no record; the next publish decides its votes. A vote describes the version that its
vehicle used: it does not count in cells that differ now.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import sqlalchemy as sa
from msgspec import structs

from mapvote.codec.ballot import tile_key
from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import pack_memory, pack_tile
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import Bool
from mapvote.core.voxels import found_among
from mapvote.fusion.fuse import differing
from mapvote_server.errors import Conflict, NotFound
from mapvote_server.store import schema
from mapvote_server.store.database import address_of
from mapvote_server.store.fusion_jobs import Task, fuse_round, settled
from mapvote_server.store.publish import Published, write_version
from mapvote_server.store.queries import (
    Version,
    load_tile,
    newest_seq,
    tile_as_of,
    tile_of,
    tiles_of,
    version_of,
)
from mapvote_server.store.store import Store
from mapvote_server.store.votes import Electorate, ballots_aside, standing_tiles


def rollback(store: Store, to: int, *, by: str = "operator", reason: str = "") -> Version:
    """A new version that is ``to`` again. A change like any other: it spends the votes on every cell that turns back.

    NotFound if there is no such version, Conflict if it is the newest or another version is published meanwhile.
    """
    with store.database.reading() as connection:
        newest = version_of(connection)
        target = version_of(connection, to)
        if to == newest.number:
            raise Conflict(f"version {to} is the newest: there is nothing to roll back")
        number = newest.number + 1
        current = tiles_of(connection, newest.number)
        then = tiles_of(connection, to)
        tiles = {}
        planes = []
        for index in sorted(current.keys() | then.keys()):
            if current.get(index) != then.get(index):
                window = store.lattice.tile(index)
                old = tile_as_of(connection, window, newest.number)
                new = load_tile(connection, window, then.get(index))
                digest, plane = pack_memory(turned_back(number, old, new))
                tiles[index] = structs.replace(then.get(index) or TileHashes.none(), memory=digest)
                planes.append(plane)
    policy = dict(target.policy)
    version = Version(number, newest.number, "rollback", to, store.clock(), by, reason[:400], newest.mark, policy)
    return write_version(store, version, tiles, planes)


def turned_back(version: int, current: Tile, then: Tile) -> Memory:
    """The memory of a tile that returns to its state ``then``: cells that return lose what they recorded since."""
    differ = np.flatnonzero(differing(current, then))
    none = Memory.none()
    return (current.memory or none).but(differ, (then.memory or none).at(differ)).with_changed(differ, version)


class _Content(NamedTuple):
    """A tile of a state: what it holds, and whether the map has it; else it holds memory only."""

    tile: Tile
    there: bool


@dataclass(frozen=True, slots=True)
class _State:
    """A map under way: a published version, with some tiles changed."""

    root: int
    edited: Mapping[TileIndex, _Content] = field(default_factory=dict)


@dataclass(slots=True)
class _History:
    """The versions gone through again so far."""

    out: Mapping[str, int]
    """Excluded vehicles, each with the version before which it is excluded: later votes count again."""
    states: dict[int, _State]
    misread: dict[TileIndex, dict[int, Bool]] = field(default_factory=dict)
    """By tile and version, the cells that differed in the map that the vehicles used."""


def replay(
    store: Store, vehicle: str, *, by: str = "operator", dry_run: bool = True, executor: Executor | None = None
) -> Published:
    """Take a vehicle's votes out of every version; with ``dry_run`` only say what would change.

    NotFound if it never voted, Conflict if another version is published meanwhile.
    """
    history = store.versions()
    newest = history[-1]
    number = history[-1].number + 1
    out = {v.policy["unvoted"]: v.number for v in history if v.kind == "replay"} | {vehicle: number}
    with store.database.reading() as connection:
        b = schema.ballots
        heard = sa.select(b.c.vehicle, sa.func.min(b.c.first_seq)).where(b.c.vehicle.in_(out)).group_by(b.c.vehicle)
        first = {row[0]: row[1] for row in connection.execute(heard)}
        mark = newest_seq(connection)
    if vehicle not in first:
        raise NotFound(f"{vehicle!r} never voted here")
    touched = next((v for v in history if v.kind == "publish" and v.mark >= min(first.values())), None)
    start = newest.number if touched is None or touched.parent is None else touched.parent
    start = max(start, next(v.number for v in history if v.cleared_seq is None))
    gone_through = _History(out, {v.number: _State(v.number) for v in history if v.number <= start})
    for version in history:
        if version.number > start:
            _again(store, version, gone_through, executor)
    tiles: dict[TileIndex, TileHashes] = {}
    planes: list[Mapping[str, bytes]] = []
    added = deleted = 0
    last = gone_through.states[newest.number]
    for index, ours, theirs in _pairs(store, last, _State(newest.number)):
        own_hashes, packed = pack_tile(replace(ours.tile, memory=turned_back(number, theirs.tile, ours.tile)))
        if (own_hashes if ours.there else None) != (pack_tile(theirs.tile)[0] if theirs.there else None):
            tiles[index] = own_hashes if ours.there else structs.replace(TileHashes.none(), memory=own_hashes.memory)
            planes.append(packed)
            added += int((~found_among(ours.tile.points, theirs.tile.points)).sum())
            deleted += int((~found_among(theirs.tile.points, ours.tile.points)).sum())
    outcome = Published(newest.number, False, [tile_key(index) for index in sorted(tiles)], added, deleted, [], [])
    if dry_run:
        return outcome
    reason = f"as if {vehicle} had never voted, from version {start} on"
    policy = {"unvoted": vehicle}
    version = Version(number, newest.number, "replay", start, store.clock(), by, reason, mark, policy)
    write_version(store, version, tiles, planes, unvoted=vehicle)
    return replace(outcome, version=number, published=True)


def _again(store: Store, version: Version, history: _History, executor: Executor | None) -> None:
    """Add what a version would have been to the history."""
    assert version.parent is not None
    before = history.states[version.parent]
    state = before
    if version.kind == "rollback":
        assert version.target is not None
        state = _turned_back(store, version.number, before, history.states[version.target])
    elif version.kind == "publish":
        state = _fused(store, version, before, history, executor)
    history.states[version.number] = state
    for index, ours, theirs in _pairs(store, state, _State(version.number)):
        differ = differing(ours.tile, theirs.tile)
        if differ.any():
            history.misread.setdefault(index, {})[version.number] = differ


def _turned_back(store: Store, number: int, before: _State, target: _State) -> _State:
    edited = dict(before.edited)
    for index, current, then in _pairs(store, before, target):
        if current.there != then.there or pack_tile(current.tile)[0] != pack_tile(then.tile)[0]:
            tile = replace(then.tile, memory=turned_back(number, current.tile, then.tile))
            edited[index] = _Content(tile, then.there)
    return _State(before.root, edited)


def _fused(store: Store, version: Version, before: _State, history: _History, executor: Executor | None) -> _State:
    without = frozenset(name for name, until in history.out.items() if version.number < until)
    url = address_of(store.database.url)
    with store.database.reading() as connection:
        electorate = Electorate.of(version, without, ballots_aside(connection))
        standing = standing_tiles(connection, version.mark)

    def task_of(index: TileIndex) -> Task:
        with store.database.reading() as connection:
            tile = _content(store, connection, before, index).tile
            misread = history.misread.get(index, {})
        return Task(url, tile.window, version.number, tile, electorate, misread)

    alone = {fused.index: fused for fused in fuse_round(list(map(task_of, standing)), store.database, executor)}
    fused = settled(alone, task_of, store.database).tiles.values()
    edited = {f.index: _Content(f.tile, True) for f in fused if f.hashes and f.tile is not None}
    return _State(before.root, {**before.edited, **edited})


def _pairs(store: Store, a: _State, b: _State) -> Iterator[tuple[TileIndex, _Content, _Content]]:
    """Tiles in which two states may differ, with both of their contents."""
    with store.database.reading() as connection:
        old = tiles_of(connection, a.root)
        new = tiles_of(connection, b.root)
        candidates = {i for i in old.keys() | new.keys() if old.get(i) != new.get(i)} | set(a.edited) | set(b.edited)
        for index in sorted(candidates):
            yield index, _content(store, connection, a, index), _content(store, connection, b, index)


def _content(store: Store, connection: sa.Connection, state: _State, index: TileIndex) -> _Content:
    if index in state.edited:
        return state.edited[index]
    there = tile_of(connection, state.root, index) is not None
    return _Content(tile_as_of(connection, store.lattice.tile(index), state.root), there)
