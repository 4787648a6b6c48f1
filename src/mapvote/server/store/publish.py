"""New versions: publish the round, or roll back.

A round is decided on a snapshot, before the transaction that writes it. Of several publishers exactly one wins; the
others get Conflict.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np
import sqlalchemy as sa
from msgspec import structs
from sqlalchemy.exc import IntegrityError

from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import (
    pack_memory,
)
from mapvote.config import FuseSettings
from mapvote.core.grid import Grid, TileIndex
from mapvote.core.tile import Tile
from mapvote.core.tile_history import Memory
from mapvote.core.types import MapvoteError
from mapvote.fusion.fuse import differing
from mapvote.server.errors import Conflict, Held
from mapvote.server.store import schema
from mapvote.server.store.database import insert_rows
from mapvote.server.store.fusion_jobs import Fused
from mapvote.server.store.integrity import quarantine
from mapvote.server.store.queries import (
    Version,
    add_blobs,
    current_number,
    current_version,
    end_votes,
    load_tile,
    log_event,
    memory_of,
    set_tiles,
    tiles_of,
    version_of,
    version_row,
)
from mapvote.server.store.retention import clear
from mapvote.server.store.round import Gate, Round, reasons_to_hold, round_at
from mapvote.server.store.store import Store


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a publish, or of a dry run."""

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


def preview(
    store: Store,
    settings: FuseSettings | None = None,
    *,
    parent: int | None = None,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> Outcome:
    """The result of :func:`publish` if it ran now. Nothing is written."""
    return _outcome(store, _round(store, store.clock(), settings, parent, executor), gate)


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
    """Fuse the standing ballots, and publish the next version if anything changed.

    The store's policy applies; ``settings`` replace its ``fuse`` in simulations of one round. ``parent``: publish only
    if this is still the newest version. ``override``: publish in spite of the reasons to hold the version. Raises Held
    with the reasons, Conflict if another version was published first, MapvoteError if the policy names a reference
    drive and there is no ``gate``.
    """
    now = store.clock()
    found = _round(store, now, settings, parent, executor)
    outcome = _outcome(store, found, gate)
    damaged = [damage for one in outcome.fused for damage in one.damaged]
    copies = {str(copy) for one in outcome.fused for copy in one.copies}
    if damaged or copies:
        with store.database.writing() as connection:
            quarantine(connection, damaged, now, by)
            _log_copies(connection, copies, now, by)
    policy = found.asked.policy
    if gate is None and policy.gate.drive:
        asked = policy.gate.drive
        raise MapvoteError(f"the policy judges versions by {asked}: publish by the server or mapvote publish")
    if not outcome.tiles:
        return outcome
    if outcome.held and not override:
        raise Held(list(outcome.held))
    why = reason + (f" (in spite of: {'; '.join(outcome.held)})" if outcome.held else "")
    number = _commit(store, found, now, by, why)
    if policy.keep.automatic:
        clear(store, by=by, dry_run=False)
    return replace(outcome, version=number, published=True)


def _round(
    store: Store, now: int, settings: FuseSettings | None, parent: int | None, executor: Executor | None
) -> Round:
    found = round_at(store, now, settings, executor)
    if parent is not None and parent != found.newest.number:
        raise Conflict(f"the newest version is {found.newest.number}, not {parent}: look at it, then publish")
    return found


def _outcome(store: Store, found: Round, gate: Gate | None) -> Outcome:
    changed, held = found.changed, reasons_to_hold(store, found, gate)
    added, deleted = sum(f.added for f in changed), sum(f.deleted for f in changed)
    fused = list(found.decided.values())
    return Outcome(found.newest.number, False, [f.index for f in changed], added, deleted, held, fused)


def _commit(store: Store, found: Round, now: int, by: str, why: str) -> int:
    """Write the version; its number."""
    newest, made_by = found.newest.number, found.asked.policy.model_dump(mode="json")
    version = Version(newest + 1, newest, "publish", None, now, by, why[:400], found.asked.mark, made_by)
    fused = list(found.decided.values())
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

    NotFound if there is no such version, Conflict if it is the newest or another version is published meanwhile.
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
                tiles[index] = structs.replace(then.get(index) or TileHashes.none(), memory=digest)
                planes.append(plane)
    policy = dict(target.policy)
    version = Version(number, newest.number, "rollback", to, store.clock(), by, reason[:400], newest.mark, policy)
    return write_version(store, version, NewTiles(tiles, planes))


def turned_back(version: int, now: Tile, then: Tile) -> Memory:
    """The memory of a tile that returns to its state ``then``: cells that return lose what they recorded since."""
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


@dataclass(frozen=True, slots=True)
class NewTiles:
    """The tiles that a version sets, and all planes that the store may not hold yet."""

    tiles: Mapping[TileIndex, TileHashes]
    """A tile without points is one that the version does not have."""
    planes: Sequence[Mapping[str, bytes]]
    fused: Sequence[Fused] = field(default=(), repr=False)
    """All decided tiles, also those that do not change."""


def write_version(store: Store, version: Version, new: NewTiles, unvoted: str | None = None) -> Version:
    """Publish a version; Conflict if its parent is the newest no more. ``unvoted``: this vehicle's votes are gone."""
    try:
        with store.database.writing() as connection:
            if current_number(connection) != version.parent:
                raise Conflict(f"version {version.number} was published by somebody else meanwhile; look at it first")
            if version.target is not None:
                version_of(connection, version.target)
            seq = log_event(connection, version.created_ns, version.kind, version.published_by, f"v{version.number}")
            if version.kind != "publish":
                version = replace(version, mark=seq)
            connection.execute(schema.versions.insert().values(**version_row(version)))
            add_blobs(connection, {digest: data for some in new.planes for digest, data in some.items()})
            set_tiles(connection, version.number, new.tiles)
            rows = [_decision_row(version.number, fused) for fused in new.fused if not fused.lost]
            if rows:
                insert_rows(connection, schema.decisions, rows)
            if unvoted is not None:
                end_votes(connection, unvoted, seq)
    except IntegrityError as error:
        raise Conflict(
            f"version {version.number} was published by somebody else meanwhile; look at it first"
        ) from error
    return version


def _decision_row(number: int, fused: Fused) -> tuple[object, ...]:
    """In the order of the table's columns."""
    counts = fused.vehicles, fused.added, fused.deleted
    return number, *fused.index, fused.states, fused.tally, *counts, fused.odds, fused.standings
