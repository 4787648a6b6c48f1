"""Un-vote after publication: the map as it would be, had a vehicle never taken part.

Starts from the version before its first vote and goes through every later version again, by the policy recorded in
each and with the ballots that stood at its moment, without the vehicle. The result is published as one new version.
A round that made no version because of the vehicle left no trace: the next publish makes up for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field

import sqlalchemy as sa

from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import F32
from mapvote.server.errors import NotFound
from mapvote.server.store import schema
from mapvote.server.store.blobs import TileHashes, pack_tile, same_cells
from mapvote.server.store.database import address_of
from mapvote.server.store.eligible_votes import Bar, Round, bars_on, standing_tiles
from mapvote.server.store.policy import recorded
from mapvote.server.store.publish import Outcome, write_version
from mapvote.server.store.queries import Version, load_tile, tiles_of
from mapvote.server.store.store import Store
from mapvote.server.store.tile_jobs import Task, fuse_round


@dataclass(frozen=True, slots=True)
class _State:
    """A map under way: a published version, with some tiles changed."""

    root: int
    edited: Mapping[TileIndex, Tile] = field(default_factory=dict)


def replay(
    store: Store, vehicle: str, *, by: str = "operator", dry_run: bool = True, executor: Executor | None = None
) -> Outcome:
    """Take a vehicle's votes out of every version; with ``dry_run`` only say what would change.

    NotFound if it never voted, Conflict if somebody publishes meanwhile.
    """
    with store.database.reading() as connection:
        b = schema.ballots
        first = connection.execute(sa.select(sa.func.min(b.c.first_seq)).where(b.c.vehicle == vehicle)).scalar_one()
        mark = connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one()
    if first is None:
        raise NotFound(f"{vehicle!r} never voted here")
    history = store.versions()
    newest = history[-1]
    without = {vehicle} | {v.policy["unvoted"] for v in history if v.kind == "replay"}
    touched = next((v for v in history if v.kind == "publish" and v.mark >= first), None)
    start = newest.number if touched is None or touched.parent is None else touched.parent
    states = {number: _State(number) for number in range(1, start + 1)}
    kept = history[start - 1].mark  # rollbacks up to here hold as recorded, later ones are drawn anew
    bars: dict[TileIndex, list[Bar]] = {}
    for version in history[start:]:
        states[version.number] = _again(store, version, states, bars, kept, without, executor)
    tiles: dict[TileIndex, TileHashes | None] = {}
    planes: list[Mapping[str, bytes]] = []
    added = deleted = 0
    for index, ours, theirs in _pairs(store, states[newest.number], _State(newest.number)):
        mine, packed = (None, {}) if ours is None else pack_tile(ours)
        if mine != (None if theirs is None else pack_tile(theirs)[0]):
            tiles[index] = mine
            planes.append(packed)
            grown = _count(ours) - _count(theirs)
            added, deleted = added + max(grown, 0), deleted + max(-grown, 0)
    if dry_run:
        return Outcome(newest.number, False, sorted(tiles), added, deleted, [])
    why = f"as if {vehicle} had never voted, from version {start} on"
    policy = {"unvoted": vehicle}
    number = newest.number + 1
    version = Version(number, newest.number, "replay", start, store.clock(), by, why, mark, policy)
    write_version(store, version, tiles, planes, unvoted=vehicle)
    return Outcome(number, True, sorted(tiles), added, deleted, [])


def _again(
    store: Store,
    version: Version,
    states: Mapping[int, _State],
    bars: dict[TileIndex, list[Bar]],
    kept: int,
    without: set[str],
    executor: Executor | None,
) -> _State:
    """What a version would have been."""
    assert version.parent is not None
    before = states[version.parent]
    if version.kind == "rollback":
        assert version.target is not None
        target = states[version.target]
        for index, now, then in _pairs(store, before, target):
            differ = ~same_cells(_points(now), _points(then), store.lattice.tile(index))
            bars.setdefault(index, []).append(Bar(version.mark, differ))
        return target
    if version.kind != "publish":
        return before
    policy = recorded(version.policy)
    asked = Round(version.mark, policy, version.created_ns - round(policy.fuse.min_age_s * 1e9), frozenset(without))
    tasks = []
    with store.database.reading() as connection:
        hashes = tiles_of(connection, before.root)
        for index in standing_tiles(connection, version.mark):
            tile = before.edited.get(index)
            if tile is None and index in hashes:
                tile = load_tile(connection, store.lattice.tile(index), hashes[index])
            barred = (*bars_on(connection, index, kept), *bars.get(index, ()))
            tasks.append(Task(address_of(store.database.url), store.lattice.tile(index), tile, asked, barred))
    edited = {f.index: f.tile for f in fuse_round(tasks, store.database, executor) if f.hashes and f.tile is not None}
    return _State(before.root, dict(before.edited) | edited)


def _pairs(store: Store, a: _State, b: _State) -> Iterator[tuple[TileIndex, Tile | None, Tile | None]]:
    """Tiles in which two states may differ, with both of their contents."""
    with store.database.reading() as connection:
        old, new = tiles_of(connection, a.root), tiles_of(connection, b.root)
        candidates = {i for i in old.keys() | new.keys() if old.get(i) != new.get(i)} | set(a.edited) | set(b.edited)

        def content(index: TileIndex, state: _State, hashes: Mapping[TileIndex, TileHashes]) -> Tile | None:
            if index in state.edited:
                return state.edited[index]
            return load_tile(connection, store.lattice.tile(index), hashes[index]) if index in hashes else None

        for index in sorted(candidates):
            yield index, content(index, a, old), content(index, b, new)


def _points(tile: Tile | None) -> F32 | None:
    return None if tile is None else tile.points


def _count(tile: Tile | None) -> int:
    return 0 if tile is None else len(tile.points)
