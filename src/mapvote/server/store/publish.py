"""New versions: publish what the vehicles decided, roll back, un-vote by replay. One transaction each.

Fusion runs before the transaction and on a snapshot; of several publishers exactly one wins, the others get Conflict.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from mapvote.config import FuseSettings
from mapvote.core.grid import Grid, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.server.errors import Conflict, Held
from mapvote.server.store import schema
from mapvote.server.store.blobs import TileHashes, pack_cells, same_cells, unpack_tile
from mapvote.server.store.database import address_of
from mapvote.server.store.eligible_votes import Round, standing_tiles
from mapvote.server.store.policy import policy_in
from mapvote.server.store.queries import (
    Version,
    add_blobs,
    current_version,
    load_tile,
    log_event,
    tile_row,
    tiles_of,
    version_of,
    version_row,
)
from mapvote.server.store.store import Store
from mapvote.server.store.tile_jobs import Fused, Task, fuse_round

Gate = Callable[[PointMap, PointMap], Sequence[str]]
"""Looks at (old map, new map) and gives the reasons to hold the new one; none lets it through."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a publish did, or with ``dry_run`` would do."""

    version: int
    """The new version, or the current one if nothing was published."""
    published: bool
    tiles: Sequence[TileIndex]
    """Tiles that changed."""
    added: int
    deleted: int
    held: Sequence[str]
    """Why the policy holds it back (in a dry run), or what the operator overrode."""
    fused: Sequence[Fused] = field(default=(), repr=False)


def publish(
    store: Store,
    settings: FuseSettings | None = None,
    *,
    by: str = "operator",
    reason: str = "",
    parent: int | None = None,
    dry_run: bool = False,
    override: bool = False,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> Outcome:
    """Fuse what stands, and publish it as the next version if anything changed.

    By the store's policy; ``settings`` take the place of its ``fuse``, in simulations of one round.
    ``parent``: publish only if that is still the newest version. ``override``: in spite of the reasons to hold it.
    Raises Held with the reasons, or Conflict if somebody else published first.
    """
    with store.database.reading() as connection:
        newest = current_version(connection)
        if parent is not None and parent != newest.number:
            raise Conflict(f"the newest version is {newest.number}, not {parent}: look at it, then publish")
        mark = connection.execute(sa.select(sa.func.max(schema.events.c.seq))).scalar_one()
        hashes = tiles_of(connection, newest.number)
        policy = policy_in(connection)
        if settings is not None:
            policy = policy.model_copy(update={"fuse": settings})
        made_by = policy.model_dump(mode="json")
        nothing_but_votes = newest.kind == "publish" and newest.policy == made_by and policy.fuse.min_age_s == 0
        dirty = standing_tiles(connection, mark, newest.mark if nothing_but_votes else None)
    now = store.clock()
    asked = Round(mark, policy, now - round(policy.fuse.min_age_s * 1e9))
    url = address_of(store.database.url)
    tasks = [Task(url, store.lattice.tile(index), hashes.get(index), asked) for index in dirty]
    fused = fuse_round(tasks, store.database, executor)
    changed = [f for f in fused if f.hashes is not None]
    held = hold_reasons(changed, policy.fuse)
    if gate is not None and changed:
        old = store.point_map(newest.number)
        edited = {f.index: _edited(f, store.lattice.tile(f.index)) for f in changed}
        held += gate(old, replace(old, tiles=dict(old.tiles) | edited))
    added, deleted = sum(f.added for f in changed), sum(f.deleted for f in changed)
    outcome = Outcome(newest.number, False, [f.index for f in changed], added, deleted, held, fused)
    if dry_run or not changed:
        return outcome
    if held and not override:
        raise Held(held)
    number = newest.number + 1
    why = reason + (f" (in spite of: {'; '.join(held)})" if held else "")
    version = Version(number, newest.number, "publish", None, now, by, why[:400], mark, made_by)
    write_version(store, version, {f.index: f.hashes for f in changed}, [f.planes for f in changed], fused)
    return replace(outcome, version=number, published=True)


def hold_reasons(changed: Sequence[Fused], settings: FuseSettings) -> list[str]:
    """What the policy says against publishing these tiles."""
    points, deleted = sum(f.points for f in changed), sum(f.deleted for f in changed)
    if points and deleted > settings.max_deleted_share * points:
        share = deleted / points
        return [
            f"deletes {share:.0%} of the points of {len(changed)} tiles, more than {settings.max_deleted_share:.0%}"
        ]
    return []


def rollback(store: Store, to: int, *, by: str = "operator", reason: str = "") -> Version:
    """A new version that is ``to`` again, and a bar on the change votes that led away from it.

    Votes that were known before count no more for a change of the cells that now turn back; new drives do.
    NotFound if there is no such version, Conflict if it is the newest or somebody publishes meanwhile.
    """
    with store.database.reading() as connection:
        newest = current_version(connection)
        target = version_of(connection, to)
        if to == newest.number:
            raise Conflict(f"version {to} is the newest: there is nothing to roll back")
        now, then = tiles_of(connection, newest.number), tiles_of(connection, to)
        differ = sorted(index for index in now.keys() | then.keys() if now.get(index) != then.get(index))
        barred = {}
        for index in differ:
            window = store.lattice.tile(index)
            pair = [load_tile(connection, window, state.get(index)).points for state in (now, then)]
            barred[index] = pack_cells(~same_cells(pair[0], pair[1], window))
    number = newest.number + 1
    version = Version(
        number, newest.number, "rollback", to, store.clock(), by, reason[:400], newest.mark, dict(target.policy)
    )
    return write_version(store, version, {index: then.get(index) for index in differ}, [], (), barred)


def write_version(
    store: Store,
    version: Version,
    tiles: Mapping[TileIndex, TileHashes | None],
    planes: Sequence[Mapping[str, bytes]],
    fused: Sequence[Fused] = (),
    barred: Mapping[TileIndex, bytes] | None = None,
    unvoted: str | None = None,
) -> Version:
    """The one transaction by which a version appears; Conflict if its parent is the newest no more."""
    try:
        with store.database.writing() as connection:
            if current_version(connection).number != version.parent:
                raise Conflict(f"version {version.number} was published by somebody else meanwhile; look at it first")
            seq = log_event(connection, version.created_ns, version.kind, version.published_by, f"v{version.number}")
            if version.kind != "publish":
                version = replace(version, mark=seq)
            connection.execute(schema.versions.insert().values(**version_row(version)))
            for some in planes:
                add_blobs(connection, some)
            if tiles:
                rows = [tile_row(version.number, index, hashes) for index, hashes in tiles.items()]
                connection.execute(schema.version_tiles.insert(), rows)
            if fused:
                connection.execute(schema.decisions.insert(), [_decision_row(version.number, f) for f in fused])
            if barred:
                r = [
                    {"version": version.number, "row": i[0], "col": i[1], "seq": seq, "cells": c}
                    for i, c in barred.items()
                ]
                connection.execute(schema.bars.insert(), r)
            if unvoted is not None:
                b = schema.ballots
                mine = (b.c.vehicle == unvoted) & b.c.gone_seq.is_(None)
                connection.execute(b.update().where(mine).values(gone_seq=seq))
    except IntegrityError as error:
        raise Conflict(
            f"version {version.number} was published by somebody else meanwhile; look at it first"
        ) from error
    return version


def _decision_row(number: int, fused: Fused) -> dict[str, object]:
    return {
        "version": number,
        "row": fused.index[0],
        "col": fused.index[1],
        "states": fused.states,
        "tally": fused.tally,
        "vehicles": fused.vehicles,
        "added": fused.added,
        "deleted": fused.deleted,
    }


def _edited(fused: Fused, window: Grid) -> Tile:
    hashes = fused.hashes
    assert hashes is not None
    free = None if hashes.free is None else fused.planes[hashes.free]
    return unpack_tile(window, hashes, fused.planes[hashes.points], fused.planes[hashes.ground], free)
