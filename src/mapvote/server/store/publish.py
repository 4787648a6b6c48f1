"""New versions: publish what the vehicles decided, or go back. Plan, fuse, hold or let through, commit.

Planning and fusion run before the transaction and on a snapshot; of several publishers exactly one wins, the others get
Conflict. What is published follows from the versions, the ballots, the policy and one reading of the clock: tiles on
which nothing has come or gone since they were last fused would give what they gave then, and are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np
import sqlalchemy as sa

from mapvote.config import FuseSettings
from mapvote.core.grid import Grid, TileIndex
from mapvote.core.lazy_tiles import with_changed
from mapvote.core.memory import Memory
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote.fusion.spent import differing
from mapvote.server.errors import Conflict, Held
from mapvote.server.store import schema
from mapvote.server.store.blobs import (
    TileHashes,
    pack_memory,
    unpack_free_plane,
    unpack_ground_plane,
    unpack_points_plane,
)
from mapvote.server.store.clearing import clear
from mapvote.server.store.commit import NewTiles, write_version
from mapvote.server.store.database import address_of
from mapvote.server.store.eligible_votes import Electorate, electorate_now, standing_tiles
from mapvote.server.store.hold import hold_reasons
from mapvote.server.store.policy import GatePolicy
from mapvote.server.store.quarantine import quarantine, tiles_hurt_or_mended
from mapvote.server.store.queries import (
    Version,
    current_version,
    load_tile,
    log_event,
    memory_of,
    tiles_of,
    tiles_set_by,
    version_of,
)
from mapvote.server.store.store import Store
from mapvote.server.store.tile_jobs import Fused, Task, fuse_round

Gate = Callable[[GatePolicy, PointMap, PointMap], Sequence[str]]
"""Looks at (old map, new map) as the policy asks and gives the reasons to hold the new one; none lets it through."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a publish did, or would do."""

    version: int
    """The new version, or the current one if nothing was published."""
    published: bool
    tiles: Sequence[TileIndex]
    """Tiles that changed."""
    added: int
    deleted: int
    held: Sequence[str]
    """Why the policy would hold it back, or what the operator overrode."""
    fused: Sequence[Fused] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True)
class Plan:
    """What there is to fuse, as of one moment."""

    newest: Version
    asked: Electorate
    tasks: Sequence[Task]
    now: int


def preview(
    store: Store,
    settings: FuseSettings | None = None,
    *,
    parent: int | None = None,
    gate: Gate | None = None,
    executor: Executor | None = None,
    every: bool = False,
) -> Outcome:
    """What :func:`publish` would do now. Nothing is written. ``every``: look again at the tiles, too, on which nothing
    has come or gone, for what waits there."""
    return _decide(store, settings, parent, gate, executor, every)[1]


def publish(
    store: Store,
    settings: FuseSettings | None = None,
    *,
    by: str = "operator",
    reason: str = "",
    parent: int | None = None,
    override: bool = False,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> Outcome:
    """Fuse what stands, and publish it as the next version if anything changed.

    By the store's policy; ``settings`` take the place of its ``fuse``, in simulations of one round. ``parent``: publish
    only if that is still the newest version. ``override``: in spite of the reasons to hold it. Raises Held with the
    reasons, Conflict if somebody else published first, MapvoteError if the policy asks for a reference drive and there
    is no ``gate`` to judge by it.
    """
    plan, outcome = _decide(store, settings, parent, gate, executor)
    damaged = [damage for one in outcome.fused for damage in one.damaged]
    copies = {str(copy) for one in outcome.fused for copy in one.copies}
    if damaged or copies:
        with store.database.writing() as connection:
            quarantine(connection, damaged, plan.now, by)
            _log_copies(connection, copies, plan.now, by)
    if gate is None and plan.asked.policy.gate.drive:
        asked = plan.asked.policy.gate.drive
        raise MapvoteError(f"the policy judges versions by {asked}: publish by the server or mapvote publish")
    if not outcome.tiles:
        return outcome
    if outcome.held and not override:
        raise Held(list(outcome.held))
    why = reason + (f" (in spite of: {'; '.join(outcome.held)})" if outcome.held else "")
    number = commit(store, plan, outcome.fused, by, why)
    if plan.asked.policy.keep.automatic:
        clear(store, by=by, dry_run=False)
    return replace(outcome, version=number, published=True)


def _decide(
    store: Store,
    settings: FuseSettings | None,
    parent: int | None,
    gate: Gate | None,
    executor: Executor | None,
    every: bool = False,
) -> tuple[Plan, Outcome]:
    """What there is to publish, and what speaks against it."""
    plan = make_plan(store, settings, every)
    if parent is not None and parent != plan.newest.number:
        raise Conflict(f"the newest version is {plan.newest.number}, not {parent}: look at it, then publish")
    fused = fuse_round(plan.tasks, store.database, executor)
    changed = [f for f in fused if f.hashes is not None]
    held = reasons_to_hold(store, plan, changed, gate)
    added, deleted = sum(f.added for f in changed), sum(f.deleted for f in changed)
    return plan, Outcome(plan.newest.number, False, [f.index for f in changed], added, deleted, held, fused)


def make_plan(store: Store, settings: FuseSettings | None = None, every: bool = False) -> Plan:
    """Which tiles to fuse, with whose votes: all that a ballot touched since they were last fused, or ``every`` one.
    The clock is read here and nowhere else."""
    now = store.clock()
    with store.database.reading() as connection:
        newest = current_version(connection)
        mark = connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one()
        asked = electorate_now(connection, now, mark, settings)
        dirty = standing_tiles(connection, mark) if every else _dirty(connection, newest, asked)
        hashes = tiles_of(connection, newest.number, dirty)
    made, url = newest.number + 1, address_of(store.database.url)
    tasks = [Task(url, store.lattice.tile(i), made, hashes.get(i), asked) for i in dirty]
    return Plan(newest, asked, tasks, now)


def _dirty(connection: sa.Connection, newest: Version, asked: Electorate) -> list[TileIndex]:
    """Tiles that may give something else than when they were last fused.

    Where the newest version changed something, votes are spent that decided together with others. With another policy,
    or after a version that was not fused, everything may; with a minimum age votes ripen without any event.
    """
    policy = asked.policy
    fused = newest.kind == "publish" and newest.policy == policy.model_dump(mode="json")
    if not fused or policy.fuse.min_age_s > 0:
        return standing_tiles(connection, asked.mark)
    touched = standing_tiles(connection, asked.mark, newest.mark)
    touched += tiles_hurt_or_mended(connection, newest.mark)
    return sorted({*touched, *tiles_set_by(connection, newest.number)})


def reasons_to_hold(store: Store, plan: Plan, changed: Sequence[Fused], gate: Gate | None) -> list[str]:
    """What speaks against the version."""
    held, asked = hold_reasons(changed, plan.asked.settings), plan.asked.policy.gate
    if gate is None or not asked.drive or not changed:
        return held
    old = store.point_map(plan.newest.number)
    edited = {
        f.index: edited_tile(f, old.tiles.get(f.index) or Tile.empty(store.lattice.tile(f.index))) for f in changed
    }
    return [*held, *gate(asked, old, replace(old, tiles=with_changed(old.tiles, edited)))]


def commit(store: Store, plan: Plan, fused: Sequence[Fused], by: str, why: str) -> int:
    """Write the version; its number."""
    newest, made_by = plan.newest.number, plan.asked.policy.model_dump(mode="json")
    version = Version(newest + 1, newest, "publish", None, plan.now, by, why[:400], plan.asked.mark, made_by)
    tiles = {f.index: f.hashes for f in fused if f.hashes is not None}
    write_version(store, version, NewTiles(tiles, [f.planes for f in fused], fused))
    return version.number


def _log_copies(connection: sa.Connection, copies: Iterable[str], now: int, by: str) -> None:
    """Each is named once."""
    e = schema.events.c
    known = set(connection.execute(sa.select(e.detail).where(e.kind == "copy")).scalars())
    for copy in sorted(set(copies) - known):
        log_event(connection, now, "copy", by, copy)


def rollback(store: Store, to: int, *, by: str = "operator", reason: str = "") -> Version:
    """A new version that is ``to`` again. A change like any other: it spends the votes on every cell that turns back.

    NotFound if there is no such version, Conflict if it is the newest or somebody publishes meanwhile.
    """
    with store.database.reading() as connection:
        newest = current_version(connection)
        target = version_of(connection, to)
        if to == newest.number:
            raise Conflict(f"version {to} is the newest: there is nothing to roll back")
        number = newest.number + 1
        now, then = tiles_of(connection, newest.number), tiles_of(connection, to)
        tiles, planes = {}, []
        for index in sorted(now.keys() | then.keys()):
            if now.get(index) != then.get(index):
                old, new = _of_two(connection, store.lattice.tile(index), number, now.get(index), then.get(index))
                digest, plane = pack_memory(turned_back(number, old, new))
                tiles[index] = replace(then.get(index) or TileHashes.none(), memory=digest)
                planes.append(plane)
    policy = dict(target.policy)
    version = Version(number, newest.number, "rollback", to, store.clock(), by, reason[:400], newest.mark, policy)
    return write_version(store, version, NewTiles(tiles, planes))


def turned_back(version: int, now: Tile, then: Tile) -> Memory:
    """What a tile remembers that is again as it was ``then``: cells that turn back forget what came and went since."""
    differ, none = np.flatnonzero(differing(now, then)), Memory.none()
    return (now.memory or none).but(differ, (then.memory or none).at(differ)).with_changed(differ, version)


def _of_two(
    connection: sa.Connection, window: Grid, number: int, now: TileHashes | None, then: TileHashes | None
) -> tuple[Tile, Tile]:
    """A tile now and then; where there is none now, the memory of one."""
    old = load_tile(connection, window, now)
    if now is None:
        old = replace(old, memory=memory_of(connection, number, window.tile_index))
    return old, load_tile(connection, window, then)


def edited_tile(fused: Fused, before: Tile) -> Tile:
    """What the tile that was ``before`` would be: fusion made the planes that do not stay."""
    hashes, planes = fused.hashes, fused.planes
    assert hashes is not None
    ground, free = before.ground_z, before.free
    if hashes.ground in planes:
        ground = unpack_ground_plane(planes[hashes.ground], hashes.ground)
    if hashes.free is not None and hashes.free in planes:
        free = unpack_free_plane(planes[hashes.free], hashes.free)
    return Tile(before.window, unpack_points_plane(planes[hashes.points], hashes.points), ground, free)
